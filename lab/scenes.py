"""Rendered scenes of the twin with truth, none of whose seeds a network was trained on; kept once they are made."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from finforce.caches import cache_folder
from finforce_eval.recordings.writer import new_folder

if TYPE_CHECKING:
    from finforce_sim.scenarios import Scenario

SIZE = "640x480"


@dataclass(frozen=True, kw_only=True)
class TwinScene:
    """One scene.

    Attributes:
        scenario: its name in the twin.
        seed: of textures, lights, background and noise.
        changes: numbers of the scenario that differ.
        size: of the images, WIDTHxHEIGHT.
        lens: of the camera.
    """

    scenario: str
    seed: int
    changes: Mapping[str, Any] = field(default_factory=dict)
    size: str = SIZE
    lens: str = "d405"

    def build(self) -> Scenario:
        """Return the scenario.

        Raises:
            ScenarioError: there is none of this name, or a number is out of its bounds.
        """
        from finforce_sim.scenarios import build_scenario

        return build_scenario(self.scenario, **self.changes)


# [s] of rest at each level and of its record: a grasp of five seconds
GRASP = TwinScene(scenario="grasp_cylinder", seed=101, changes={"settle": 0.3, "record": 0.8})


def find_scene(scene: TwinScene, folder: Path | None = None) -> Path:
    """Return the recording of a scene, rendered under a progress bar unless it is there already.

    Args:
        scene: the scene to render.
        folder: of the scenes that were rendered; that in the user's cache without one.

    Raises:
        FinforceError: the scene cannot be rendered, or a library is missing.
    """
    folder = folder or cache_folder() / "scenes"
    path = folder / f"{scene.scenario}_{scene.seed}_{fingerprint(scene)}"
    if path.exists():
        return path
    try:
        with new_folder(path) as new:
            _render(scene, new)
    except OSError:
        if not path.exists():  # else another process was faster
            raise
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
    from finforce_eval.cli.twin import record_simulation
    from finforce_sim.simulated_recording import build_simulated_recording, parse_size

    scenario = scene.build()
    record_simulation(
        build_simulated_recording(scenario, scene.seed, parse_size(scene.size, scene.lens)), scenario, scene.seed, path
    )
