"""Rendered scenes with truth for benchmarks, none of whose seeds a network was trained on; kept once they are made.

A scene is rendered as a camera of 180 Hz would see it, without what no camera of 30, 60 or 90 Hz sees, and cut into
sections that are played on end.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any

from finforce.stamps import NANOSECONDS
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.images import CAMERA_INFO, IMAGE
from finforce_eval.recordings.recording import POSE
from finforce_eval.replay.playback import Playback, RawMessage
from finforce_keypoints.parameters import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC

if TYPE_CHECKING:
    from finforce_sim.gripper.gripper import TwinState
    from finforce_sim.scenes.scenarios import Scenario

SCRIPT_SLOTS = 6  # slots from one state of a script to the next
EVERY_RATE = (0, 2, 3, 4)  # slots of those six that a camera of 30, 60 or 90 Hz sees
SIZE = "640x480"
FARTHEST = 0.4  # [m]; depth beyond it is left away, which makes a recording smaller


@dataclass(frozen=True, kw_only=True)
class BenchScene:
    """One scene.

    Attributes:
        scenario: its name in the twin.
        seed: of textures, lights, background and noise.
        changes: numbers of the scenario that differ.
        slots: of six, those that are rendered; (0,) is a camera of 30 Hz.
    """

    scenario: str
    seed: int
    changes: Mapping[str, Any] = field(default_factory=dict)
    slots: tuple[int, ...] = (0,)

    def build(self) -> Scenario:
        """Return the scenario.

        Raises:
            ScenarioError: there is none of this name, or a number is out of its bounds.
        """
        from finforce_sim.scenes.scenarios import build_scenario

        return build_scenario(self.scenario, **self.changes)


# [s] of rest at each level and of its record: a grasp of five seconds
_SHORT = {"settle": 0.3, "record": 0.8}
GRASP = BenchScene(scenario="grasp_cylinder", seed=101, changes=_SHORT)
GRASP_FAST = replace(GRASP, slots=EVERY_RATE)
DIM = BenchScene(scenario="grasp_asymmetric", seed=102, changes={**_SHORT, "light": "dim"})
CALIBRATION = BenchScene(scenario="shifting", seed=103, changes={"shift_time": 0.4, "settle": 0.1, "record": 0.1})

# Name of a case: scene, and what is changed in it; no object is one of the shapes trained on.
UNSEEN: dict[str, tuple[str, dict[str, Any]]] = {
    "cylinder": ("grasp_cylinder", {}),
    "cube": ("grasp_cube", {}),
    "asymmetric": ("grasp_asymmetric", {}),
    "bottle": ("grasp_cylinder", {"object": "bottle", "scale": 0.45, "turn_x": 1.5708}),
    "shifting": ("shifting", {}),
    "fast close": ("fast_close", {}),
    "bench middle": ("bench_cylinder", {}),
    "bench lower": ("bench_cylinder_lower", {}),
    "weight": ("weight_turn", {}),
    "weight, dim": ("weight_turn_dim", {}),
}
FIRST_SEED = 101
BENCH = "bench"  # the jaw that the scenes are made for


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


def find_scene(scene: BenchScene, folder: Path | None = None) -> Path:
    """Return the recording of a scene, rendered under a progress bar unless it is there already.

    Args:
        scene: what is rendered.
        folder: of the scenes that were rendered; that in the user's cache without one.

    Raises:
        FinforceError: the scene cannot be rendered, or a library is missing.
    """
    folder = folder or scene_folder()
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


def scene_folder() -> Path:
    """Return where rendered scenes are kept: `finforce/scenes` in XDG_CACHE_HOME, or in ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "finforce" / "scenes"


def fingerprint(scene: BenchScene) -> str:
    """Return a text that is another one for another scene, and for another twin."""
    import finforce_sim

    content = hashlib.sha256(json.dumps({**asdict(scene), "size": SIZE}, sort_keys=True).encode())
    for source in sorted(Path(finforce_sim.__path__[0]).rglob("*.py")):
        content.update(source.read_bytes())
    return content.hexdigest()[:12]


def _render(scene: BenchScene, path: Path) -> None:
    """Render a scene into a new folder."""
    from tqdm import tqdm

    from finforce_eval.recordings.twin_writer import RecordingForm, write_footage
    from finforce_sim.gripper.footage import FINGER, Footage, parse_size, set_stage
    from finforce_sim.gripper.gripper import TwinGripper
    from finforce_sim.rendering.photographer import Photographer

    gripper = TwinGripper(scene.build(), FINGER)
    setting = set_stage(gripper, parse_size(SIZE), 1e-3)
    smooth = SmoothGripper(gripper, scene.slots)
    footage = Footage(smooth, Photographer(setting, scene.seed), setting, scene.seed)
    case = {"scene": scene.scenario, "seed": scene.seed, "finger": FINGER, "object": {"kind": scene.build().object}}
    with tqdm(total=len(footage), unit="image", desc=scene.scenario, disable=None, leave=False) as bar:
        write_footage(footage, path, form=RecordingForm(farthest=FARTHEST), case=case, seen=lambda _: bar.update())


def record_unseen(name: str, seed: int, folder: Path, jaw: str = BENCH) -> Path:
    """Record a case of `UNSEEN` with a seed into a folder, unless that was done before; return where.

    Args:
        name: of the case.
        seed: of textures, light and noise.
        folder: of the recordings.
        jaw: shipped jaw or jaw file.

    Raises:
        FinforceError: the scene cannot be recorded.
    """
    from finforce_eval.recordings.twin_writer import RecordingForm, record_scene
    from finforce_sim.gripper.footage import parse_size
    from finforce_sim.scenes.scenarios import build_scenario

    scene, changes = UNSEEN[name]
    label = name.replace(",", "").replace(" ", "_")
    bag = folder / (f"{label}_{seed}" if jaw == BENCH else f"{label}_{Path(jaw).stem}_{seed}")
    if not bag.exists():
        scenario = build_scenario(scene, **changes, jaw=jaw)
        record_scene(scenario, seed, bag, camera=parse_size(SIZE), form=RecordingForm())
    return bag


PHASE_TOPIC, OBJECT_TOPIC, MASK_TOPIC = "/bench/phase", "/object_pose", "/object_mask"
PLAYED = {COLOR_TOPIC: IMAGE, DEPTH_TOPIC: IMAGE, INFO_TOPIC: CAMERA_INFO, OBJECT_TOPIC: POSE, MASK_TOPIC: IMAGE}
RATE = 30.0  # Hz


@dataclass(frozen=True, kw_only=True)
class StreamPart:
    """A stretch of time in which the images of one section are played, over and over where they do not suffice.

    Attributes:
        section: of the recording.
        seconds: how long.
        name: under which it is measured; empty: it is not.
    """

    section: str
    seconds: float
    name: str = ""


@dataclass(frozen=True, kw_only=True)
class Span:
    """When a part is played, from the beginning of all [s]."""

    part: StreamPart
    begin: float
    end: float


class SceneStream:
    """The messages of the sections of a recording, in the order and as long as the parts have them.

    It is played as a `Playback` is; every iteration gives the same.

    Attributes:
        begin: time of the first message [ns].
        types: of the topics.
        spans: of the parts.

    Args:
        sections: images by section: each a list of the messages that belong to one image.
        parts: what is played.
        rate: of the images [Hz].

    Raises:
        RecordingError: a part asks for a section that has no images.
    """

    def __init__(
        self, sections: Mapping[str, Sequence[Sequence[RawMessage]]], parts: Sequence[StreamPart], rate: float = RATE
    ) -> None:
        for part in parts:
            if not sections.get(part.section):
                raise RecordingError(f"the recording has no images of the section {part.section!r}")
        self._sections, self._parts, self._rate = sections, tuple(parts), rate
        self.begin = NANOSECONDS
        kinds = {
            message.topic: message.msgtype for images in sections.values() for image in images for message in image
        }
        self.types = kinds
        self.spans = tuple(self._lay_out())

    def _lay_out(self) -> Iterator[Span]:
        """Yield when each part is played."""
        begin = 0.0
        for part in self._parts:
            end = begin + round(part.seconds * self._rate) / self._rate
            yield Span(part=part, begin=begin, end=end)
            begin = end

    def __len__(self) -> int:
        return sum(1 for _ in self._images())

    def _images(self) -> Iterator[Sequence[RawMessage]]:
        for part in self._parts:
            images = self._sections[part.section]
            for index in range(round(part.seconds * self._rate)):
                yield images[index % len(images)]

    def __iter__(self) -> Iterator[RawMessage]:
        for index, image in enumerate(self._images()):
            time = self.begin + round(index * NANOSECONDS / self._rate)
            for message in image:
                yield message._replace(time=time, data=message.restamped(time))


def cut_sections(messages: Playback, names: Mapping[str, str]) -> dict[str, list[list[RawMessage]]]:
    """Return the images of a recording by section, each with all that has its stamp.

    Args:
        messages: camera images, poses of the object, and the words of `/bench/phase`.
        names: section by the beginning of such a word; images of other phases are left out.
    """
    sections: dict[str, list[list[RawMessage]]] = {}
    section = ""
    for _, group in groupby(messages, key=attrgetter("time")):
        image = list(group)
        for message in image:
            if message.topic == PHASE_TOPIC:
                word = read_word(message.data)
                section = next((name for start, name in names.items() if word.startswith(start)), "")
        kept = [message for message in image if message.topic in PLAYED]
        if section and any(message.topic == COLOR_TOPIC for message in kept):
            sections.setdefault(section, []).append(kept)
    return sections


def read_word(data: bytes) -> str:
    """Return the text of a std_msgs/String in CDR: four bytes of encapsulation, four of length, text and a zero."""
    size = int.from_bytes(data[4:8], "little")
    return data[8 : 8 + size].rstrip(b"\0").decode()
