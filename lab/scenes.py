"""Rendered scenes of the twin with truth, none of whose seeds a network was trained on; kept once they are made.

A scene is rendered as a camera of 180 Hz would see it, without what no camera of 30, 60 or 90 Hz sees.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from finforce_sim.gripper import TwinState
    from finforce_sim.scenarios import Scenario

SCRIPT_SLOTS = 6  # slots from one state of a script to the next
EVERY_RATE = (0, 2, 3, 4)  # slots of those six that a camera of 30, 60 or 90 Hz sees
SIZE = "640x480"


@dataclass(frozen=True, kw_only=True)
class TwinScene:
    """One scene.

    Attributes:
        scenario: its name in the twin.
        seed: of textures, lights, background and noise.
        changes: numbers of the scenario that differ.
        slots: of six, those that are rendered; (0,) is a camera of 30 Hz.
        size: of the images, WIDTHxHEIGHT.
    """

    scenario: str
    seed: int
    changes: Mapping[str, Any] = field(default_factory=dict)
    slots: tuple[int, ...] = (0,)
    size: str = SIZE

    def build(self) -> Scenario:
        """Return the scenario.

        Raises:
            ScenarioError: there is none of this name, or a number is out of its bounds.
        """
        from finforce_sim.scenarios import build_scenario

        return build_scenario(self.scenario, **self.changes)


# [s] of rest at each level and of its record: a grasp of five seconds
GRASP = TwinScene(scenario="grasp_cylinder", seed=101, changes={"settle": 0.3, "record": 0.8})
GRASP_FAST = replace(GRASP, slots=EVERY_RATE)


class SmoothGripper:
    """A gripper of the twin between the states of its script, too: straight from one to the next.

    Args:
        gripper: that plays the scenario at 30 Hz.
        slots: of the six between two of its states, those that there are.
    """

    def __init__(self, gripper: Any, slots: tuple[int, ...]) -> None:
        self._gripper, self._slots = gripper, slots

    def __len__(self) -> int:
        """Return the number of states."""
        return (len(self._gripper) - 1) * len(self._slots) + 1

    def states(self) -> Iterator[TwinState]:
        """Yield the states, always from the beginning."""
        states = iter(self._gripper.states())
        before = next(states)
        for after in states:
            for slot in self._slots:
                yield before if slot == 0 else before.blend(after, slot / SCRIPT_SLOTS)
            before = after
        yield before


def find_scene(scene: TwinScene, folder: Path | None = None) -> Path:
    """Return the recording of a scene, rendered under a progress bar unless it is there already.

    Args:
        scene: what is rendered.
        folder: of the scenes that were rendered; that in the user's cache without one.

    Raises:
        FinforceError: the scene cannot be rendered, or a library is missing.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = folder or cache / "finforce" / "scenes"
    path = folder / f"{scene.scenario}_{scene.seed}_{fingerprint(scene)}"
    if path.exists():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = Path(mkdtemp(dir=folder))
    try:
        _render(scene, unfinished / path.name)
        (unfinished / path.name).replace(path)
    except OSError:
        if not path.exists():  # else another process was faster
            raise
    finally:
        rmtree(unfinished, ignore_errors=True)
    return path


def fingerprint(scene: TwinScene) -> str:
    """Return a text that is another one for another scene, and for another twin."""
    import finforce_sim

    content = hashlib.sha256(json.dumps(asdict(scene), sort_keys=True).encode())
    for source in sorted(Path(finforce_sim.__path__[0]).rglob("*.py")):
        content.update(source.read_bytes())
    return content.hexdigest()[:12]


def _render(scene: TwinScene, path: Path) -> None:
    """Render a scene into a new folder."""
    from finforce_eval.cli.twin import record_footage
    from finforce_sim.footage import FINGER, Footage, parse_size
    from finforce_sim.gripper import TwinGripper
    from finforce_sim.photographer import Photographer

    scenario = scene.build()
    gripper = TwinGripper(scenario, FINGER)
    smooth = SmoothGripper(gripper, scene.slots)
    footage = Footage(smooth, Photographer(gripper, parse_size(scene.size), scene.seed), scene.seed)
    record_footage(footage, scenario, scene.seed, path)
