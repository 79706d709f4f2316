"""A grasp before the camera while a gripper moves, with the truth at that moment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.transforms import invert_pose
from finforce_driver.emulator.settings import EmulatorSettings
from finforce_twin.errors import ScenarioError
from finforce_twin.gripper.footage import FINGER, TRACKED_EVERY, TwinFrame, disturb_pose, set_stage
from finforce_twin.gripper.pressing import PressedGrasp, RelaxedGrasp, Wrench
from finforce_twin.gripper.reel import Reel, choose_openings, film_grasp
from finforce_twin.rendering.depth_camera import build_d405_vga
from finforce_twin.rendering.photographer import Photographer
from finforce_twin.scenes.scenarios import Scenario

T = TypeVar("T")
LEAST_CLEARANCE = 2e-3  # [m] of opening that the open gripper leaves around the object


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment(Generic[T]):
    """What is seen and what is true when an image is taken.

    Attributes:
        picture: what was kept of an image at the nearest opening.
        wrenches: on the jaws, by side, relaxed.
        T_camera_object: (4, 4) as a tracker measures it; None where it did not, or without an object.
    """

    picture: T
    wrenches: Mapping[str, Wrench]
    T_camera_object: NDArray | None


class LiveScene(Generic[T]):
    """A grasp that follows a gripper's opening.

    Attributes:
        grasp: what is filmed.
        camera: intrinsics.
        depth_step: of the depth images [m].
        reel: the images that were filmed; None before.

    Args:
        grasp: what is filmed.
        photographer: who films it.
        seed: of the object tracker's noise.

    Raises:
        ScenarioError: the object is too wide for the gripper.
    """

    def __init__(self, grasp: PressedGrasp, photographer: Photographer, seed: int) -> None:
        gripper = EmulatorSettings()
        self._low, self._high = gripper.closed_opening, gripper.closed_opening + gripper.stroke
        if grasp.touch_opening + LEAST_CLEARANCE > self._high:
            raise ScenarioError(
                f"{grasp.assembly.scenario.name}: the object is {1e3 * grasp.touch_opening:.0f} mm wide between the "
                f"jaws, expected at most {1e3 * (self._high - LEAST_CLEARANCE):.0f} mm; give another object or scene"
            )
        self.grasp = grasp
        self.camera, self.depth_step = photographer.setting.camera, photographer.setting.depth_step
        self.reel: Reel[T] | None = None
        self._photographer = photographer
        self._relaxed = RelaxedGrasp(grasp)
        self._T_camera_gripper = invert_pose(photographer.setting.T_gripper_camera)
        self._rng = np.random.default_rng((seed, 3))
        self._count, self._last = 0, None

    def film(self, keep: Callable[[TwinFrame], T], tell: Callable[[int, int], None]) -> None:
        """Takes the images at all openings of the gripper; see `film_grasp`."""
        openings = choose_openings(self.grasp, self._low, self._high)
        self.reel = film_grasp(self.grasp, self._photographer, openings, keep, tell)

    def take(self, opening: float, now: float) -> Moment[T]:
        """Returns the moment at an opening [m], at a time [s] that never goes back; `film` comes first."""
        place = self.reel.find(opening)
        takes = self.reel.takes[place]
        wrenches = self._relaxed.update(opening, 0.0 if self._last is None else now - self._last)
        T_gripper_object = self.grasp.object_pose(float(self.reel.openings[place]))
        tracked = T_gripper_object is not None and self._count % TRACKED_EVERY == 0
        picture = takes[self._count % len(takes)]
        self._count, self._last = self._count + 1, now
        return Moment(
            picture=picture,
            wrenches=wrenches,
            T_camera_object=disturb_pose(self._T_camera_gripper @ T_gripper_object, self._rng) if tracked else None,
        )


def build_live_scene(
    scenario: Scenario,
    seed: int,
    camera: CameraIntrinsics | None = None,
    *,
    finger: int = FINGER,
    depth_step: float = 1e-3,
) -> LiveScene:
    """Return the scene of a scenario's jaws and object that waits for a gripper; see `build_footage`.

    Raises:
        FinforceError: the scenario's object or jaw cannot be used, or a library is missing.
    """
    grasp = PressedGrasp(scenario, finger)
    setting = set_stage(grasp.assembly, camera or build_d405_vga(), depth_step)
    return LiveScene(grasp, Photographer(setting, seed), seed)
