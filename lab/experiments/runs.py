"""What experiments on grasps share: scenes of the twin or recordings of one's own, read with key points and scored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree
from typing import Any

from numpy.typing import NDArray

from finforce.gripper_frames import SIDES
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.contact_source import ContactChoice
from finforce_eval.evaluation.keypoint_source import KeypointSource
from finforce_eval.evaluation.scoring import Evaluation
from finforce_eval.evaluation.setup import EvaluationSetup, hash_files
from finforce_eval.recordings.bags import bag_source
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import AXES
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.settings import EstimatorSettings
from lab.scenes import TwinScene, find_scene

RECORDINGS = "recordings"
FARTHEST = 0.3  # [m] of depth that is kept; jaws are nearer


@dataclass(frozen=True, kw_only=True)
class Case:
    """One run of an experiment.

    Attributes:
        name: unlike the others', and a part of file names.
        settings: that decide its figures, as JSON has them; what stands under `words` becomes part of them.
    """

    name: str
    settings: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How recordings are solved.

    Attributes:
        bags: recordings of one's own; none for scenes of the twin.
        jaw: shipped name or jaw file.
        calibration: shipped name or file; empty for the jaw file's own material.
        source: of the key points, see `KeypointSource`; empty for images of the twin, and for what bags have.
        seed: of the first scene.
        size: of the twin's images, WIDTHxHEIGHT.
        keep: keep the twin's recordings when they have been scored.
        quick: few and small cases.
    """

    bags: Sequence[str] = ()
    jaw: str = "bench"
    calibration: str = "twin"
    source: str = ""
    seed: int = 100
    size: str = "640x480"
    keep: bool = False
    quick: bool = False

    @property
    def shared(self) -> dict[str, Any]:
        """The settings that every case has."""
        files = hash_files((self.jaw, self.calibration))
        return {"jaw": self.jaw, "calibration": self.calibration, "source": self.source, "files": files}

    def scene_case(self, name: str, scene: str, changes: Mapping[str, Any], number: int, **more: Any) -> Case:
        """Return a case that is a scene of the twin; `more` is kept in its settings, too."""
        made = {"scene": scene, "changes": dict(changes), "seed": self.seed + number, "size": self.size}
        return Case(name=name, settings=self.shared | made | more)

    def bag_cases(self, needed: Sequence[str] = SIDES) -> list[Case]:
        """Return the recordings of one's own as cases; see `read_bags`."""
        return [case for case, _ in self.read_bags(needed)]

    def read_bags(self, needed: Sequence[str] = SIDES) -> list[tuple[Case, Recording]]:
        """Return the recordings of one's own, each as a case and as it was read.

        Args:
            needed: jaws whose measured force, and about which the object's poses, an experiment cannot do without.

        Raises:
            RecordingError: a recording lacks something, and which it is.
        """
        read = []
        for bag in self.bags:
            recording = read_recording(bag)
            missing = list_missing(recording, needed)
            if missing:
                raise RecordingError(f"{bag}: this experiment needs {'; '.join(missing)}, which is not in it")
            source = bag_source(Path(bag))
            files = sorted(source.glob("*")) if source.is_dir() else [source]
            size = sum(path.stat().st_size for path in files)
            settings = self.shared | {"bag": str(bag), "bytes": size}
            read.append((Case(name=recording.name, settings=settings), recording))
        return read

    @contextmanager
    def open_case(self, case: Case, folder: Path) -> Iterator[Recording]:
        """Give the recording of a case with its key points; a scene is rendered first, and forgotten once it is scored.

        Raises:
            FinforceError: the scene cannot be rendered, the recording not be read, or no key points are found.
        """
        settings, source = case.settings, case.settings["source"]
        is_own = "bag" in settings
        if is_own:
            bag = Path(settings["bag"])
        else:
            bag, source = find_scene(build_scene(settings), folder / RECORDINGS), source or "images"
        yield KeypointSource(source=source, jaw_file=settings["jaw"]).apply(read_recording(bag))
        if not is_own and not self.keep:
            rmtree(bag, ignore_errors=True)


def build_scene(settings: Mapping[str, Any]) -> TwinScene:
    """Return the scene of the twin that a case's settings name."""
    about = {name: settings[name] for name in ("changes", "seed", "size")}
    return TwinScene(scenario=settings["scene"], farthest=FARTHEST, **about)


def list_missing(recording: Recording, needed: Sequence[str]) -> list[str]:
    """Return what a recording lacks: measured forces of jaws, or the object's poses."""
    sides = [side for side in needed if side not in recording.jaws or recording.jaws[side].truth is None]
    missing = [f"/{side}/ground_truth_wrench" for side in sides]
    return missing if recording.object_pose is not None else [*missing, "/object_pose"]


def build_setup(settings: Mapping[str, Any], contact: ContactChoice | None = None) -> EvaluationSetup:
    """Return the setup that a case's settings name.

    Raises:
        FinforceError: jaw or calibration cannot be used.
    """
    return EvaluationSetup(
        jaw=load_jaw(settings["jaw"]),
        settings=EstimatorSettings(),
        calibration=load_calibration(settings["calibration"]) if settings["calibration"] else None,
        contacts=contact or ContactChoice(mode="estimate"),
        about={},
    )


SHARP = {f"sharpness {axis}": f"sharp {axis}" for axis in AXES}  # headings by column of `tabulate`


def axis_sharpness(evaluation: Evaluation) -> dict[str, float | None]:
    """Return how sharp the stated deviations of all jaws' forces were along x, y and z, see `Stats.sharpness`."""
    return dict(zip(AXES, evaluation.total.all.sharpness or (None,) * 3, strict=True))


def keep_poses(recording: Recording, seen: NDArray) -> Recording:
    """Return a recording with those poses of the object (n,) alone that are seen."""
    track = recording.object_pose
    kept = {name: getattr(track, name)[seen] for name in ("stamps", "position", "quaternion")}
    return replace(recording, object_pose=replace(track, **kept))
