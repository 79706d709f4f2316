"""Recordings as frozen records of NumPy arrays, with what a camera truly saw and what a detector reported."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.messages import NANOSECONDS, NOTHING_SHARED, SECOND, SharedStddev
from finforce.settings import TimeParameters
from finforce_eval.errors import RecordingError
from finforce_ifea.observation import Observation
from finforce_ifea.posture import WristPosture

if TYPE_CHECKING:
    from finforce_eval.recordings.images import ImageTrack
    from finforce_eval.recordings.salvage import SalvagedCopy

DIRECTIONS = ("load", "unload")
STAGES = ("ramp", "settle", "record")


class Timed:
    """Gives the times of what a recording holds in seconds; whole nanoseconds tell what belongs to one image."""

    stamps_ns: NDArray[np.int64]

    @property
    def stamps(self) -> NDArray[np.float64]:
        """Times (n,) [s]."""
        return SECOND * self.stamps_ns


@dataclass(frozen=True, kw_only=True)
class KeypointTrack(Timed):
    """Key points of one jaw over time.

    Attributes:
        stamps_ns: (n,) image time [ns], strictly increasing.
        points: (n, K, 3) [m], jaw frame; NaN = none.
        likelihood: (n, K) in [0, 1].
        stddev: (n, K, 3) one standard deviation [m], jaw frame, NaN = not known; None when nothing says.
        shared: (n, 4) standard deviations of what the points of an image share, see `SharedStddev`; None: 0.
    """

    stamps_ns: NDArray[np.int64]
    points: NDArray[np.float64]
    likelihood: NDArray[np.float64]
    stddev: NDArray[np.float64] | None = None
    shared: NDArray[np.float64] | None = None

    @classmethod
    def empty(cls, count: int = 0) -> KeypointTrack:
        """Return a track of no image, which stands where key points are still to be found."""
        return cls(stamps_ns=np.zeros(0, np.int64), points=np.zeros((0, count, 3)), likelihood=np.zeros((0, count)))

    @property
    def count(self) -> int:
        """Key points per image, K."""
        return self.points.shape[1]

    def observation(self, index: int) -> Observation:
        """Return what an estimator is given of image `index`."""
        return Observation(
            stamp=float(SECOND * self.stamps_ns[index]),
            points=self.points[index],
            likelihood=self.likelihood[index],
            stddev=None if self.stddev is None else self.stddev[index],
            shared=NOTHING_SHARED if self.shared is None else SharedStddev(*self.shared[index].tolist()),
        )


@dataclass(frozen=True, kw_only=True)
class WrenchTrack(Timed):
    """Wrenches that an object applies to a jaw over time.

    Attributes:
        stamps_ns: (n,) [ns].
        force: (n, 3) [N], jaw frame.
        torque: (n, 3) [N m], about the origin of the jaw frame.
    """

    stamps_ns: NDArray[np.int64]
    force: NDArray[np.float64]
    torque: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PoseTrack(Timed):
    """Poses over time.

    Attributes:
        stamps_ns: (n,) [ns].
        position: (n, 3) [m], in `frame_id`.
        quaternion: (n, 4), x y z w.
        frame_id: the frame in which the pose is given.
    """

    stamps_ns: NDArray[np.int64]
    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    frame_id: str


@dataclass(frozen=True, kw_only=True)
class GravityTrack(Timed):
    """Direction of gravity and elevation of the gripper over time.

    Attributes:
        stamps_ns: (n,) [ns], strictly increasing.
        direction: (n, 3) unit vectors in `gripper_base`.
        elevation: (n,) above any level [m]; NaN if unknown.
    """

    stamps_ns: NDArray[np.int64]
    direction: NDArray[np.float64]
    elevation: NDArray[np.float64]

    def at(self, stamp: int) -> WristPosture | None:
        """Return the gripper's posture at a time [ns], the nearest one; None if that is older than the nodes accept."""
        after = int(np.searchsorted(self.stamps_ns, stamp))
        beside = range(max(after - 1, 0), min(after + 1, len(self.stamps_ns)))
        row = min(beside, key=lambda row: abs(int(self.stamps_ns[row]) - stamp))
        if abs(int(self.stamps_ns[row]) - stamp) > NANOSECONDS * TimeParameters.max_age:
            return None
        return WristPosture(self.direction[row], float(self.elevation[row]))


@dataclass(frozen=True, kw_only=True)
class PhaseTrack(Timed):
    """The phase of the bench, published on change.

    Attributes:
        stamps_ns: (m,) [ns], begin of each phase.
        cycle: (m,) number of the loading cycle.
        direction: (m,) "load" or "unload".
        displacement_mm: (m,) commanded displacement [mm].
        stage: (m,) "ramp", "settle" or "record".
    """

    stamps_ns: NDArray[np.int64]
    cycle: NDArray[np.int64]
    direction: NDArray[np.str_]
    displacement_mm: NDArray[np.float64]
    stage: NDArray[np.str_]

    def index_at(self, stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return for each stamp [ns] the row of its phase, -1 before the first."""
        return np.searchsorted(self.stamps_ns, stamps, side="right") - 1

    def displacement_at(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the displacement (n,) [mm] at stamps [ns]: linear over a ramp, held in other phases, 0 before all."""
        held = np.r_[0.0, self.displacement_mm]
        begins = np.where(self.stage == "ramp", held[:-1], held[1:])
        # a ramp that nothing follows has no known end
        ends = np.r_[held[1:-1], begins[-1]] if self.stage[-1] == "ramp" else held[1:]
        times = np.stack([self.stamps_ns, np.r_[self.stamps_ns[1:], self.stamps_ns[-1]]], axis=1).ravel()
        return np.interp(stamps, times, np.stack([begins, ends], axis=1).ravel(), left=0.0)


@dataclass(frozen=True, kw_only=True)
class JawTrack:
    """The data of one jaw in a recording.

    Attributes:
        keypoints: as they were recorded, or as they were found in images; empty before that.
        truth: measured wrenches.
        pose: T_camera_jaw over time, of the key point detector.
        sight: true key points, `true_pose` the true T_camera_jaw: of a synthetic recording.
        detection: report of the detector, where this call found the key points in images.
    """

    keypoints: KeypointTrack
    truth: WrenchTrack | None = None
    pose: PoseTrack | None = None
    sight: DetectionTruth | None = None
    true_pose: PoseTrack | None = None
    detection: DetectionTrack | None = None

    @property
    def is_awaited(self) -> bool:
        """True if key points and poses are still to come from images."""
        return not len(self.keypoints.stamps_ns)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One recording.

    Attributes:
        name: its name, from the folder or the file.
        path: where it was read from.
        jaws: "left" and/or "right" -> what was recorded of that jaw.
        object_pose: T_camera_object over time.
        gravity: posture of the gripper over time; None if nothing says.
        phases: phases of the bench, None outside the bench.
        case: content of `case.json`, empty without it.
        notes: content that was not read, one sentence each.
        images: its RGB-D images, read one by one; None without any.
        copy: of what could be read of it, where it is damaged; None where it is whole.
    """

    name: str
    path: Path
    jaws: Mapping[str, JawTrack]
    object_pose: PoseTrack | None = None
    gravity: GravityTrack | None = None
    phases: PhaseTrack | None = None
    case: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    images: ImageTrack | None = None
    copy: SalvagedCopy | None = field(default=None, compare=False)

    @property
    def source(self) -> Path:
        """The bag that can be read to its end: the recording itself, or the copy of its good part."""
        return self.path if self.copy is None else self.copy.path

    def jaw(self, side: str) -> JawTrack:
        """Return what was recorded of the jaw `side`.

        Raises:
            RecordingError: the recording has no key points of that jaw.
        """
        if side not in self.jaws:
            have = ", ".join(self.jaws)
            raise RecordingError(f"{self.name}: no key points of the {side} jaw; the recording has {have}")
        return self.jaws[side]

    def truth(self, side: str) -> WrenchTrack:
        """Return the measured wrenches of the jaw `side`.

        Raises:
            RecordingError: there are none.
        """
        truth = self.jaw(side).truth
        if truth is None:
            topic = f"/{side}/ground_truth_wrench"
            raise RecordingError(
                f"{self.name}: no ground truth: {topic} has no messages, where a sensor's WrenchStamped is expected, "
                "the force of the object on the jaw in its frame; forces without a score: annotate"
            )
        return truth

    def phases_at(self, stamps: NDArray[np.int64]) -> dict[str, NDArray]:
        """Return `cycle`, `direction` and `scored` of the table of forces for each stamp (n,) [ns]."""
        frames, phases = len(stamps), self.phases
        if phases is None:
            nothing, every = np.full(frames, "", dtype="U6"), np.ones(frames, dtype=bool)
            return {"cycle": np.zeros(frames, dtype=np.int64), "direction": nothing, "scored": every}
        row = phases.index_at(stamps)
        return {
            "cycle": np.where(row >= 0, phases.cycle[row], 0),
            "direction": np.where(row >= 0, phases.direction[row], ""),
            "scored": (row >= 0) & (phases.stage[row] == "record"),
        }


def stack_vectors(vectors: Iterable[Any], axes: str = "xyz") -> NDArray[np.float64]:
    """Return vectors, points or quaternions of messages as rows (n, 3) or (n, 4)."""
    rows = [[getattr(vector, axis) for axis in axes] for vector in vectors]
    return np.array(rows, dtype=np.float64).reshape(-1, len(axes))


def check_stamps(stamps: Iterable[int], topic: str, name: str, *, strict: bool = True) -> NDArray[np.int64]:
    """Return the stamps of a topic (n,) [ns]; raises RecordingError where they go back or, if `strict`, stand still."""
    times = np.array(list(stamps), dtype=np.int64)
    steps = np.diff(times)
    wrong = np.flatnonzero(steps <= 0 if strict else steps < 0)
    if wrong.size:
        what, message = "go back" if steps[wrong[0]] < 0 else "stand still", wrong[0] + 1
        where = f"message {message}, {times[message] / NANOSECONDS:.3f} s"
        unset = "" if times[message] else ": 0 is no time: leave out what was recorded before its clock, /clock, ran"
        raise RecordingError(f"{name}: the stamps of {topic}, in the order of receipt, {what} at {where}{unset}")
    return times


def parse_phases(stamps: Sequence[int], texts: Sequence[str], name: str) -> PhaseTrack:
    """Read phases written `cycle:load|unload:displacement_mm:ramp|settle|record`.

    Args:
        stamps: begin of each phase [ns].
        texts: the messages.
        name: recording name, for the message of an error.

    Raises:
        RecordingError: a text reads otherwise, or the stamps go back.
    """
    rows = [_parse_phase(text, name) for text in texts]
    cycle, direction, displacement, stage = zip(*rows, strict=True)
    order = np.asarray(stamps, dtype=np.int64)
    if (np.diff(order) < 0).any():
        raise RecordingError(f"{name}: the stamps of /bench/phase go back")
    return PhaseTrack(
        stamps_ns=order,
        cycle=np.asarray(cycle, dtype=np.int64),
        direction=np.asarray(direction),
        displacement_mm=np.asarray(displacement, dtype=np.float64),
        stage=np.asarray(stage),
    )


class _Phase(NamedTuple):
    """One message on /bench/phase."""

    cycle: int
    direction: str
    displacement_mm: float
    stage: str


def _parse_phase(text: str, name: str) -> _Phase:
    """Split one phase."""
    try:
        cycle, direction, displacement, stage = text.split(":")
        if direction in DIRECTIONS and stage in STAGES and np.isfinite(float(displacement)):
            return _Phase(int(cycle), direction, float(displacement), stage)
    except ValueError:
        pass
    expected = "cycle:load|unload:displacement_mm:ramp|settle|record"
    raise RecordingError(f"{name}: /bench/phase says '{text}'; expected {expected}")


@dataclass(frozen=True, kw_only=True)
class DetectionTruth(Timed):
    """The true key points of one jaw, and which of them the camera could see.

    Attributes:
        stamps_ns: (n,) image time [ns], strictly increasing.
        points: (n, K, 3) [m], jaw frame.
        pixels: (n, K, 2) column and row in the raw image [px].
        visible: (n, K) neither occluded nor outside the image.
    """

    stamps_ns: NDArray[np.int64]
    points: NDArray[np.float64]
    pixels: NDArray[np.float64]
    visible: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class DetectionTrack(Timed):
    """The report of the key point detector on one jaw in addition to the key points, image by image.

    Attributes:
        stamps_ns: (n,) image time [ns], strictly increasing.
        pixels: (n, K, 2) column and row in the raw image [px], NaN = not found.
        points: (n, K, 3) [m], jaw frame, NaN = no depth.
        accepted: (n, K) handed on to the solver.
        reasons: (n, K) why a point was not, one word; "" where it was, or where the jaw was not found.
        step_ms: (n,) wall time from image to key points of all jaws [ms], NaN where it was not timed.
    """

    stamps_ns: NDArray[np.int64]
    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    accepted: NDArray[np.bool_]
    reasons: NDArray[np.str_]
    step_ms: NDArray[np.float64]
