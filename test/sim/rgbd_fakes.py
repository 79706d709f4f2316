"""Cameras and grippers that are quick to render, for tests of images."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from threading import Lock

import numpy as np

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import BENCH_CAMERA, ROBOT_CAMERA, jaw_in_camera
from finforce.messages import NOTHING_SHARED, SharedStddev
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_keypoints.errors import DetectionError
from finforce_keypoints.images import ImageWatch
from finforce_sim.gripper import JawState, TwinState
from finforce_sim.scenarios import Scenario
from finforce_sim.simulated_camera import Shot, TrueJaw
from finforce_sim.simulated_recording import SimulatedRecording

CAMERA = CameraIntrinsics(width=64, height=48, fx=43.0, fy=43.0, cx=31.5, cy=23.5, distortion=np.full(5, 0.01))
KEYPOINTS = 4
REST = np.array([[0.010, 0.01, 0.01], [0.010, 0.01, 0.03], [-0.010, 0.01, 0.02], [0.0, 0.01, 0.07]])
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.01
CUBE_TRIANGLES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    + [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)
MESH = ObjectMesh(vertices=CUBE, triangles=CUBE_TRIANGLES, watertight=True, name="cube")


@dataclass
class FakeGripper:
    """One or two jaws that are pressed from image `onset` on, by 0.1 N more in every image."""

    count: int = 12
    sides: tuple = ("left",)
    onset: int = 6
    has_object: bool = True
    scenario: Scenario = field(default_factory=lambda: Scenario(name="fake"))

    def __len__(self):
        return self.count

    def states(self):
        for index in range(self.count):
            force = np.array([-0.1 * max(index - self.onset + 1, 0), 0.0, 0.0])
            jaw = JawState(
                origin_x=-0.055,
                vertices=np.zeros((3, 3)),
                keypoints=REST - [1e-4 * index, 0, 0],
                force=force,
                torque=np.cross([0.014, 0.0, 0.04], force),
            )
            T = np.eye(4)
            T[:3, 3] = (-0.02, 0.0, 0.04)
            yield TwinState(
                stamp=index / 30.0,
                phase=f"0:load:{index // 4}:record",
                jaws=dict.fromkeys(self.sides, jaw),
                T_gripper_object=T if self.has_object else None,
                gravity=np.array([0.0, 0.0, 1.0]),
            )


@dataclass
class FakeCamera:
    """Noise for pictures; the last key point is hidden in every image."""

    black: tuple = ()
    frozen: tuple = ()
    mesh: ObjectMesh | None = MESH
    camera = CAMERA
    T_gripper_camera = BENCH_CAMERA
    depth_step = 1e-3

    def look(self, state, before=None):
        return None

    def shoot(self, state, before=None, view=None):
        number = round(30 * state.stamp)
        rng = np.random.default_rng(0 if number in self.frozen else round(1e6 * state.stamp) + 1)
        size = (CAMERA.height, CAMERA.width)
        patches = rng.integers(0, 255, (size[0] // 8, size[1] // 8, 3), dtype=np.uint8)
        color = patches.repeat(8, axis=0).repeat(8, axis=1)
        if number in self.black:
            color[:] = 0
        depth = rng.uniform(0.1, 0.2, size).astype(np.float32)
        depth[:4] = np.nan
        return Shot(color=color, depth=depth, jaws={side: true_jaw(state, side) for side in state.jaws})


def true_jaw(state, side, T_gripper_camera=BENCH_CAMERA, hidden=1):
    """Where the key points are in the picture; the last ones are hidden."""
    jaw = state.jaws[side]
    T = jaw_in_camera(T_gripper_camera, side, jaw.origin_x)
    pixels = project(jaw.keypoints @ T[:3, :3].T + T[:3, 3], CAMERA)
    visible = np.arange(len(pixels)) < len(pixels) - hidden
    return TrueJaw(
        T_camera_jaw=T, points=jaw.keypoints, pixels=pixels, visible=visible, force=jaw.force, torque=jaw.torque
    )


def make_fake_recording(gripper=None, simulated_camera=None, seed=0):
    """A simulated recording of 64 x 48 pixels."""
    gripper = gripper or FakeGripper()
    simulated_camera = simulated_camera or FakeCamera()
    simulated_camera.mesh = MESH if gripper.has_object else None
    return SimulatedRecording(gripper, simulated_camera, seed)


@dataclass(frozen=True)
class FakeKeypoints:
    """What a detector found of a jaw."""

    points: np.ndarray
    likelihood: np.ndarray
    pixels: np.ndarray
    valid: np.ndarray
    stddev: np.ndarray
    T_camera_jaw: np.ndarray
    reasons: np.ndarray
    shared: SharedStddev = NOTHING_SHARED


@dataclass
class FakeDetector:
    """Knows a recording's truth and shifts it; accepts what it is told to; loses the jaw or refuses at some images."""

    recording: object
    shift: tuple = (3e-4, 0.0, 0.0)
    pixel_shift: tuple = (0.6, 0.8)
    accepted: tuple = (True, True, False, False)
    lost: tuple = ()
    refused: tuple = ()
    stamps: list = field(default_factory=list)
    warnings: dict = field(default_factory=dict)
    watch: ImageWatch = field(default_factory=ImageWatch)

    def detect(self, image) -> Mapping[str, FakeKeypoints]:
        index = int(np.argmin(np.abs(self.recording.images.stamps - image.stamp)))
        self.watch.check(image)
        self.stamps.append(image.stamp)
        if index in self.refused:
            raise DetectionError("no picture for this detector")
        return {} if index in self.lost else {side: self._find(side, index) for side in self.recording.jaws}

    def _find(self, side, index):
        sight = self.recording.jaws[side].sight
        return FakeKeypoints(
            points=sight.points[index] + self.shift,
            likelihood=np.array([0.9, 0.9, 0.2, 0.1]),
            pixels=sight.pixels[index] + self.pixel_shift,
            valid=np.array(self.accepted),
            stddev=np.full((KEYPOINTS, 3), 2e-4),
            T_camera_jaw=jaw_in_camera(BENCH_CAMERA, side, -0.055 if side == "left" else 0.055),
            reasons=np.where(self.accepted, "", "likelihood"),
        )


CAMERA_POSE = ROBOT_CAMERA


class FakeLens:
    """Takes what `SimulatedCamera` takes, of 64 x 48 pixels; every key point is visible."""

    camera, T_gripper_camera, depth_step = CAMERA, CAMERA_POSE, 1e-3

    def __init__(self):
        self.looks = 0
        self._lock = Lock()

    def look(self, state):
        with self._lock:
            self.looks += 1
        return Shot(color=None, depth=None, jaws={side: true_jaw(state, side, CAMERA_POSE, 0) for side in state.jaws})

    def develop(self, view, stamp):
        rng = np.random.default_rng(round(stamp * 1e6))
        size = (CAMERA.height, CAMERA.width)
        depth = rng.uniform(0.1, 0.2, size).astype(np.float32)
        return Shot(color=rng.integers(0, 255, (*size, 3), dtype=np.uint8), depth=depth, jaws=view.jaws)
