"""A scenario as its wrist camera and an object tracker would record it, image by image, ready for messages."""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics
from finforce.camera_file import cut_camera
from finforce.messages import NANOSECONDS
from finforce.transforms import invert_pose
from finforce_sim.gripper import FINGER, TwinGripper, TwinState
from finforce_sim.scenarios import Scenario, ScenarioError
from finforce_sim.sensor import D405, LENSES, build_d405_vga
from finforce_sim.simulated_camera import Shot, SimulatedCamera, TrueJaw

START = 1_000 * NANOSECONDS  # [ns] stamp of the first image
POSITION_STDDEV = 0.3e-3  # [m] of a tracked pose, along each axis
ANGLE_STDDEV = np.radians(0.3)  # about each axis
LEAST_SIZE = 16  # [px]
LARGEST_SIZE = 4096  # [px]
WORKERS = min(os.cpu_count() or 1, 4)  # threads, of which each renders an image


@dataclass(frozen=True, kw_only=True, eq=False)
class TwinFrame(Shot):
    """One image and all that is recorded with it.

    Attributes:
        stamp: image time [ns].
        phase: as in `/bench/phase`.
        T_camera_object: (4, 4) as a tracker measures it; None where it did not, or without an object.
    """

    stamp: int
    phase: str
    T_camera_object: NDArray | None


class SimulatedRecording:
    """The images of a gripper; every iteration takes them anew and the same.

    Attributes:
        camera: intrinsics.
        T_gripper_camera: (4, 4).
        mesh: of the object in its own frame; None without one.
        depth_step: of the depth images [m].

    Args:
        gripper: the gripper to render.
        simulated_camera: that renders it.
        seed: of the object tracker's noise.
    """

    def __init__(self, gripper: TwinGripper, simulated_camera: SimulatedCamera, seed: int) -> None:
        self._gripper, self._simulated_camera, self._seed = gripper, simulated_camera, seed
        self.camera, self.T_gripper_camera = simulated_camera.camera, simulated_camera.T_gripper_camera
        self.mesh, self.depth_step = simulated_camera.mesh, simulated_camera.depth_step

    def __len__(self) -> int:
        return len(self._gripper)

    def __iter__(self) -> Iterator[TwinFrame]:
        rng = np.random.default_rng((self._seed, 3))
        T_camera_gripper = invert_pose(self.T_gripper_camera)
        last = -1
        for state, shot in self._shoot_ahead():
            period = int(state.stamp * self._gripper.scenario.tracking + 1e-5)
            tracked = state.T_gripper_object is not None and period > last
            last = period if tracked else last
            yield TwinFrame(
                **vars(shot),
                stamp=START + round(state.stamp * NANOSECONDS),
                phase=state.phase,
                T_camera_object=disturb_pose(T_camera_gripper @ state.T_gripper_object, rng) if tracked else None,
            )

    def _shoot_ahead(self) -> Iterator[tuple[TwinState, Shot]]:
        """Yield states and their images, of which a few are rendered at once; a view stays while nothing moves."""
        pool, coming, before, stood, view = ThreadPoolExecutor(WORKERS), deque(), None, False, None
        try:
            for state in self._gripper.states():
                stands = state.looks_like(before)
                if not (stands and stood):  # the upper rows of a rolling shutter show the state before
                    view = pool.submit(self._simulated_camera.look, state, before)
                coming.append((state, pool.submit(self._shoot, state, before, view)))
                before, stood = state, stands
                if len(coming) > WORKERS:
                    taken, shot = coming.popleft()
                    yield taken, shot.result()
            for taken, shot in coming:
                yield taken, shot.result()
        finally:
            pool.shutdown(cancel_futures=True)

    def _shoot(self, state: TwinState, before: TwinState | None, view: Future[Shot]) -> Shot:
        return self._simulated_camera.shoot(state, before, view.result())


def build_simulated_recording(
    scenario: Scenario,
    seed: int,
    camera: CameraIntrinsics | None = None,
    *,
    finger: int = FINGER,
    depth_step: float = 1e-3,
) -> SimulatedRecording:
    """Return the recording of a scenario.

    Args:
        scenario: motion, light and camera.
        seed: of textures, light and noise.
        camera: intrinsics; those of a D405 at 640 x 480 when absent.
        finger: seed of the jaws' material; what shows the same finger can share a calibration.
        depth_step: of the depth images [m].

    Raises:
        FinforceError: the scenario's object or jaw cannot be used, or a library is missing.
    """
    gripper = TwinGripper(scenario, finger)
    return SimulatedRecording(gripper, SimulatedCamera(gripper, camera or build_d405_vga(), seed, depth_step), seed)


def parse_size(text: str, lens: str = D405) -> CameraIntrinsics:
    """Return a colour camera with images of a size such as 640x480.

    The lens stays: other sizes are those of the 640 x 480 image scaled to the width and cut, or extended, about its
    principal point.

    Raises:
        ScenarioError: the text is no size, or there is no such lens.
    """
    if lens not in LENSES:
        raise ScenarioError(f"lens {lens!r}: expected one of {', '.join(LENSES)}")
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    width, height = (int(number) for number in found.groups()) if found else (0, 0)
    if not (LEAST_SIZE <= width <= LARGEST_SIZE and LEAST_SIZE <= height <= LARGEST_SIZE):
        raise ScenarioError(f"size {text!r}: expected WIDTHxHEIGHT, each {LEAST_SIZE} to {LARGEST_SIZE} pixels")
    return cut_camera(LENSES[lens], (height, width), width / LENSES[lens].width)


def disturb_pose(T: NDArray, rng: np.random.Generator) -> NDArray:
    """Return a pose (4, 4) as a tracker measures it."""
    measured = T.copy()
    measured[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, ANGLE_STDDEV, 3)).as_matrix() @ T[:3, :3]
    measured[:3, 3] += rng.normal(0.0, POSITION_STDDEV, 3)
    return measured


FARTHEST = 65535.0  # steps in 16 bits


def encode_depth(depth: NDArray, step: float = 1e-3) -> NDArray[np.uint16]:
    """Return a depth image (h, w) [m] in steps [m], 0 where it is NaN or too far for 16 bits."""
    steps = np.round(np.nan_to_num(np.asarray(depth, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0) / step)
    return np.where((steps > 0.0) & (steps <= FARTHEST), steps, 0.0).astype(np.uint16)


def info_fields(camera: CameraIntrinsics) -> dict[str, Any]:
    """Return the numbers of a sensor_msgs/CameraInfo: size, model, d, k, r, p."""
    k = np.array([camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0])
    p = np.array([camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0])
    return {
        "height": camera.height,
        "width": camera.width,
        "distortion_model": camera.model,
        "d": np.array(camera.distortion, dtype=np.float64),
        "k": k,
        "r": np.eye(3).ravel(),
        "p": p,
    }


def detection_truth_columns(jaw: TrueJaw) -> dict[str, NDArray]:
    """Return the columns of a cloud of true key points: x y z [m] jaw frame, u v [px], visible."""
    columns = {axis: jaw.points[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    columns |= {name: jaw.pixels[:, i].astype(np.float32) for i, name in enumerate("uv")}
    return {**columns, "visible": jaw.visible.astype(np.uint8)}
