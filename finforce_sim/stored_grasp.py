"""A grasp before the camera while a gripper moves, by images that were rendered at many openings beforehand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.transforms import invert_pose
from finforce_ifea.grasp_force import Wrench
from finforce_sim.emulator.mechanism import STROKE
from finforce_sim.gripper import PressedGrasp
from finforce_sim.scenarios import Scenario, ScenarioError
from finforce_sim.simulated_camera import Shot, SimulatedCamera
from finforce_sim.simulated_recording import WORKERS, disturb_pose

LEAST_CLEARANCE = 2e-3  # [m] of opening that the open gripper leaves around the object
TRACKED_EVERY = 3  # images: the object is tracked at 10 Hz


class Moment(NamedTuple):
    """The image and the truth at one instant.

    Attributes:
        picture: stored image at the nearest opening.
        wrenches: on the jaws, by side, relaxed.
        T_camera_object: (4, 4) as a tracker measures it; None where it did not, or without an object.
    """

    picture: Any
    wrenches: Mapping[str, Wrench]
    T_camera_object: NDArray | None


class LiveScene:
    """A grasp that follows a gripper's opening.

    Attributes:
        grasp: the grasp to render.
        camera: intrinsics.
        depth_step: of the depth images [m].
        openings: (n,) at which images were rendered, growing [m]; none before.

    Args:
        grasp: the grasp to render.
        simulated_camera: that renders it.
        seed: of the object tracker's noise.

    Raises:
        ScenarioError: the object is too wide for the gripper.
    """

    def __init__(self, grasp: PressedGrasp, simulated_camera: SimulatedCamera, seed: int) -> None:
        if grasp.touch_opening + LEAST_CLEARANCE > STROKE:
            raise ScenarioError(
                f"{grasp.scenario.name}: the object is {1e3 * grasp.touch_opening:.0f} mm wide between the "
                f"jaws, expected at most {1e3 * (STROKE - LEAST_CLEARANCE):.0f} mm; give another object or scene"
            )
        self.grasp = grasp
        self.camera, self.depth_step = simulated_camera.camera, simulated_camera.depth_step
        self.openings, self._takes = np.zeros(0), []
        self._simulated_camera = simulated_camera
        self._relaxation = grasp.relaxation()
        self._T_camera_gripper = invert_pose(simulated_camera.T_gripper_camera)
        self._rng = np.random.default_rng((seed, 3))
        self._count, self._last = 0, None

    def render(self, keep: Callable[[Shot], Any], tell: Callable[[int, int], None]) -> None:
        """Take the images at all openings of the gripper.

        Args:
            keep: makes of an image what is kept of it; its wrenches are elastic.
            tell: hears how many openings of how many are done; what it raises ends the rendering.
        """
        openings, pool = choose_openings(self.grasp), ThreadPoolExecutor(WORKERS)
        try:
            for shots in pool.map(self._shoot, openings.tolist(), range(len(openings))):
                tell(len(self._takes) + 1, len(openings))
                self._takes.append([keep(shot) for shot in shots])
        finally:
            pool.shutdown(cancel_futures=True)
        self.openings = openings

    def _shoot(self, opening: float, index: int) -> list[Shot]:
        """Return all takes at one opening [m]."""
        view = self._simulated_camera.look(self.grasp.state(opening))
        return [self._simulated_camera.develop(view, _APART * (TAKES * index + take)) for take in range(TAKES)]

    def find(self, opening: float) -> int:
        """Return the index of the image that was taken nearest to an opening [m]."""
        return int(np.abs(self.openings - opening).argmin())

    def take(self, opening: float, now: float) -> Moment:
        """Return the moment at an opening [m], at a time [s] that never goes back; `render` comes first."""
        index = self.find(opening)
        takes, dt = self._takes[index], 0.0 if self._last is None else now - self._last
        wrenches = self.grasp.wrenches(opening)
        wrenches = {side: self._relaxation[side].update(wrench, dt) for side, wrench in wrenches.items()}
        T_gripper_object = self.grasp.pose_at(float(self.openings[index]))
        tracked = T_gripper_object is not None and self._count % TRACKED_EVERY == 0
        picture = takes[self._count % len(takes)]
        self._count, self._last = self._count + 1, now
        return Moment(
            picture=picture,
            wrenches=wrenches,
            T_camera_object=disturb_pose(self._T_camera_gripper @ T_gripper_object, self._rng) if tracked else None,
        )


def build_live_scene(
    scenario: Scenario, seed: int, camera: CameraIntrinsics, *, finger: int, depth_step: float
) -> LiveScene:
    """Return the scene of a scenario's jaws and object that waits for a gripper; see `build_simulated_recording`.

    Raises:
        FinforceError: the scenario's object or jaw cannot be used, or a library is missing.
    """
    grasp = PressedGrasp(scenario, finger)
    return LiveScene(grasp, SimulatedCamera(grasp, camera, seed, depth_step), seed)


TAKES = 2  # of every opening: a camera that stands still never gives the same image twice
COUNTS = 255  # steps of the gripper's position over its stroke
OPEN_STRIDE = 4  # of those steps between two images where nothing touches
BEFORE_TOUCH = 1e-3  # [m] of opening from which on every step has its image
_APART = 10.0  # [s] between the stamps that seed the noise, too far for motion blur


def choose_openings(grasp: PressedGrasp) -> NDArray:
    """Return the openings (n,) [m] of the gripper that deserve an image.

    In contact these are the gripper's own steps, at which it comes to rest; where nothing touches they are coarser.
    """
    steps = STROKE * np.arange(COUNTS + 1) / COUNTS
    near = steps < grasp.touch_opening + BEFORE_TOUCH
    kept = near | (np.arange(COUNTS + 1)[::-1] % OPEN_STRIDE == 0)
    return steps[kept & (steps >= grasp.least_opening)]
