"""Recordings, estimators that answer by rule, and pictures for tests of evaluation."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from finforce_eval.evaluation.forces import ImageRun, check_keypoint_count, check_solved, find_forces
from finforce_eval.recordings.tracks import JawTrack, KeypointTrack, PoseTrack, Recording, WrenchTrack, parse_phases
from finforce_ifea.errors import ContactError
from finforce_ifea.jaw.section import FaceLine
from finforce_ifea.observation import Contact
from lab.scenes import GRASP
from lab.stress.stress import Family, Trial, attempt

# a grasp of three seconds, of which both jaws touch the rod in one
QUICK_GRASP = replace(
    GRASP, size="320x240", changes={"settle": 0.1, "record": 0.4, "closing_speed": 0.04, "clearance": 0.004}
)

PERIOD = 33_333_333
START = 1_000_000_000_000
MIRROR, MIRROR_MOMENT = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])  # y -> -y; moments are axial vectors


def make_phases(frames, *, cycles=2, name="case"):
    """Two steps in and one step out per cycle, each with a settle and a record part."""
    steps = [("load", 0), ("load", 2), ("unload", 0)]
    stages = ("settle", "record")
    parts = [(cycle, *step, stage) for cycle in range(cycles) for step in steps for stage in stages]
    begins = START + PERIOD * (np.arange(len(parts)) * frames // len(parts))
    texts = [f"{cycle}:{direction}:{depth}:{stage}" for cycle, direction, depth, stage in parts]
    return parse_phases(begins.tolist(), texts, name)


def make_recording(name="case", *, frames=60, keypoints=4, phases=True, truth=True, side="left", seed=0):
    """A recording whose true force rises and falls twice between 0 and 2 N along -x."""
    random = np.random.default_rng(seed)
    stamps = START + PERIOD * np.arange(frames, dtype=np.int64)
    points = random.uniform(-0.02, 0.08, (1, keypoints, 3)) + random.normal(0, 1e-4, (frames, keypoints, 3))
    points[3, 1] = np.nan
    force = np.zeros((frames, 3))
    force[:, 0] = -np.abs(2.0 * np.sin(np.linspace(0, 2 * np.pi, frames)))
    torque = np.cross([0.014, 0.0, 0.04], force)
    track = JawTrack(
        keypoints=KeypointTrack(
            stamps_ns=stamps,
            points=points.astype(np.float32).astype(np.float64),
            likelihood=random.uniform(0, 1, (frames, keypoints)).astype(np.float32).astype(np.float64),
        ),
        truth=WrenchTrack(stamps_ns=stamps, force=force, torque=torque) if truth else None,
        pose=make_poses(stamps[::3]),
    )
    return Recording(
        name=name,
        path=Path(name),
        jaws={side: track},
        object_pose=make_poses(stamps[::3]),
        phases=make_phases(frames, name=name) if phases else None,
        case={"object": {"kind": "cylinder", "diameter": 25, "z": 40.0}},
    )


def pack_mcap(bag, path, compression):
    """Write the messages of a bag to an mcap file as rosbag2 does: chunks with checksums."""
    from mcap.writer import CompressionType, Writer
    from rosbags.rosbag2 import Reader

    kinds = {"": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}
    with Reader(bag) as reader, path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 16, compression=kinds[compression])
        writer.start("ros2", "test")
        channels = {}
        for each in reader.connections:
            schema = writer.register_schema(each.msgtype, "ros2msg", each.msgdef.data.encode())
            channels[each.id] = writer.register_channel(each.topic, "cdr", schema)
        for each, time, data in reader.messages():
            writer.add_message(channels[each.id], time, bytes(data), time)
        writer.finish()
    return path


def make_poses(stamps):
    """Poses that do not move."""
    count = len(stamps)
    return PoseTrack(
        stamps_ns=stamps,
        position=np.tile([0.03, 0.02, 0.11], (count, 1)),
        quaternion=np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        frame_id="camera_color_optical_frame",
    )


@dataclass(frozen=True)
class FakeJaw:
    """A jaw of four key points."""

    name: str = "fake"
    keypoint_names: tuple = ("a", "b", "c", "d")
    keypoints: np.ndarray = None
    inner_face_x: float = 0.014
    side: str = "left"
    face: FaceLine = FaceLine.flat(0.014)


BOX = np.array([[x, y, z] for z in (0.0, 0.08) for y in (-0.01, 0.01) for x in (-0.014, 0.014)])
BOX_TRIANGLES = np.array(
    [
        [0, 2, 3],
        [0, 3, 1],
        [4, 5, 7],
        [4, 7, 6],
        [0, 1, 5],
        [0, 5, 4],
        [2, 6, 7],
        [2, 7, 3],
        [0, 4, 6],
        [0, 6, 2],
        [1, 3, 7],
        [1, 7, 5],
    ]
)


@dataclass(frozen=True)
class FakeSolution:
    """What a step said."""

    status: str
    force: np.ndarray
    keypoints_used: np.ndarray
    message: str = ""
    magnitude_stddev: float = 0.05
    force_stddev: tuple = (0.05, 0.01, 0.02)
    torque_stddev: tuple = (0.0, 0.002, 0.0)
    residual: float = 2e-4
    contact_location: tuple = (0.014, 0.0, 0.04)
    torque: tuple = (0.0, -0.04, 0.0)
    contact_point: tuple = (0.013, 0.0, 0.04)

    @property
    def trusted(self):
        return self.status in ("ok", "unloaded")

    @property
    def touching(self):
        return self.status == "ok"


class FakeEstimator:
    """Answers with `forces[k]` at its k-th step; None is a step without a trusted answer."""

    surface_triangles = BOX_TRIANGLES

    def __init__(self, forces):
        self.forces = list(forces)
        self.observations = []
        self.contacts = []

    def update(self, observation, contact):
        force = self.forces[len(self.observations)]
        self.observations.append(observation)
        self.contacts.append(contact)
        used = np.isfinite(observation.points).all(axis=1)
        if force is None:
            return FakeSolution("not_enough_points", np.zeros(3), np.zeros_like(used), "all are hidden")
        return FakeSolution("ok", np.asarray(force, dtype=float), used)

    def warm_up(self):
        """Nothing to compile."""

    def forget(self):
        """Begin again."""
        self.observations, self.contacts = [], []

    def expect_friction(self, friction):
        """Answer as before."""

    def surface(self):
        return BOX + np.array([1e-3 * len(self.observations), 0, 0])


@dataclass(frozen=True)
class FakeEstimate:
    """What a contact estimator said."""

    contact: Contact | None
    touching: bool
    status: str
    message: str = ""


class FakeContactEstimator:
    """Puts the contact at the height of the object it knows, from its first update on; notes every call in order."""

    jaw = SimpleNamespace(inner_face_x=0.014)
    needs_surface = True

    def __init__(self, touching=lambda update: True):
        self.calls = []
        self._touching, self._pose, self._updates = touching, None, 0

    def take_pose(self, stamp, T_jaw_object, covariance=None, *, camera=None):
        self.calls.append(("pose", stamp, T_jaw_object))
        self._pose = T_jaw_object

    def update(self, stamp, surface=None):
        self.calls.append(("update", stamp, surface))
        self._updates += 1
        if self._pose is None:
            return FakeEstimate(None, False, "no_pose", "no pose yet")
        touching = self._touching(self._updates - 1)
        points = np.array([[0.014, 0.0, self._pose[2, 3] - 1e-3], [0.014, 0.0, self._pose[2, 3] + 3e-3]])
        contact = Contact(points=points, weights=np.array([0.75, 0.25]), touching=touching, free=True)
        return FakeEstimate(contact, touching, "touching" if touching else "apart")


def cut(recording, start, stop):
    """The part with start <= stamp < stop [ns], without images; a phase under way at start begins there."""

    def part(track):
        rows = (track.stamps_ns >= start) & (track.stamps_ns < stop)
        return replace(
            track, **{name: each[rows] for name, each in vars(track).items() if isinstance(each, np.ndarray)}
        )

    phases = recording.phases
    if phases is not None:
        running = np.flatnonzero(phases.stamps_ns <= start)[-1:]
        begins = np.where(np.isin(np.arange(len(phases.stamps_ns)), running), start, phases.stamps_ns)
        phases = part(replace(phases, stamps_ns=begins))
    jaws = {
        side: replace(track, **{name: part(each) for name, each in vars(track).items() if each is not None})
        for side, track in recording.jaws.items()
    }
    pose = recording.object_pose and part(recording.object_pose)
    return replace(recording, jaws=jaws, object_pose=pose, phases=phases, images=None)


def with_both_jaws(recording, seconds):
    """The first seconds of a recording of the left jaw, with its mirror image as the right jaw."""
    start = int(recording.jaw("left").keypoints.stamps_ns[0])
    part = cut(recording, start, start + int(seconds * 1e9))
    left, truth = part.jaw("left"), part.truth("left")
    right = JawTrack(
        keypoints=replace(left.keypoints, points=left.keypoints.points * MIRROR),
        truth=replace(truth, force=truth.force * MIRROR, torque=truth.torque * MIRROR_MOMENT),
    )
    return replace(part, jaws={"left": left, "right": right})


def drawn_hues(path):
    """How many of twelve hues a picture shows in more than a few pixels; none where nothing but axes and text is."""
    from colorsys import rgb_to_hsv

    from PIL import Image

    picture = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3).astype(int)
    colours, counts = np.unique(picture[np.ptp(picture, axis=1) > 60], axis=0, return_counts=True)
    hues = np.zeros(12, int)
    for colour, count in zip(colours, counts, strict=True):
        hues[int(11.99 * rgb_to_hsv(*(colour / 255))[0])] += count
    return int((hues > 15).sum())


def answers(count, *, error=0.01, stddev=0.01, **fields):
    """Sure, converged answers with the same error and the same stated standard deviation [N]."""
    told = {"errors": (error, 0.0, 0.0, error, 0.0), "stated": (stddev,) * 5}
    usual = {"sure": True, **told, "step_time": 1e-3}
    return [Trial(seed=i, **{**usual, **fields}) for i in range(count)]


def family_of(trials, **fields):
    return Family(name="made", what="made up", run=lambda plan: iter(trials), **fields)


def refuse():
    raise ContactError("not on the jaw")


def divide():
    return 1 / 0


def fail_with(work, **options):
    """The trial of a step that does not return."""
    return attempt(7, work, lambda got: Trial(sure=True), level="made", **options)


def evaluate_recording(recording, jaw, source, estimator, side="left"):
    """The forces on one jaw of a recording with ground truth, by an estimator and a contact that a test gives."""
    recording.truth(side)
    check_keypoint_count(recording, side, jaw)
    result = find_forces(recording, jaw, source, estimator, side, ImageRun(strict=True))
    check_solved(result, recording)
    return result


def change_info(**changes):
    """What changes entries of the `meta/info.json` in a dataset's folder."""

    def change(folder):
        info = json.loads((folder / "meta/info.json").read_text())
        (folder / "meta/info.json").write_text(json.dumps(info | changes))

    return change
