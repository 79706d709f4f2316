"""A grasp before the camera while a gripper moves, by images that were rendered at many openings beforehand."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.transforms import invert_pose
from finforce_ifea.grasp_force import Wrench
from finforce_sim.emulator.adapter import EmulatedAdapter
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.emulator.mechanism import STROKE
from finforce_sim.emulator.pty_port import PtyPort
from finforce_sim.footage import FINGER, TwinFrame, disturb_pose, set_stage, true_jaw
from finforce_sim.gripper import PressedGrasp, RelaxedGrasp
from finforce_sim.photographer import Photographer
from finforce_sim.scenarios import Scenario, ScenarioError
from finforce_sim.sensor import build_d405_vga

T = TypeVar("T")
LEAST_CLEARANCE = 2e-3  # [m] of opening that the open gripper leaves around the object
TRACKED_EVERY = 3  # images: the object is tracked at 10 Hz


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
        grasp: what is rendered.
        camera: intrinsics.
        depth_step: of the depth images [m].
        table: the images that were rendered; None before.

    Args:
        grasp: what is rendered.
        photographer: that renders it.
        seed: of the object tracker's noise.

    Raises:
        ScenarioError: the object is too wide for the gripper.
    """

    def __init__(self, grasp: PressedGrasp, photographer: Photographer, seed: int) -> None:
        if grasp.touch_opening + LEAST_CLEARANCE > STROKE:
            raise ScenarioError(
                f"{grasp.assembly.scenario.name}: the object is {1e3 * grasp.touch_opening:.0f} mm wide between the "
                f"jaws, expected at most {1e3 * (STROKE - LEAST_CLEARANCE):.0f} mm; give another object or scene"
            )
        self.grasp = grasp
        self.camera, self.depth_step = photographer.setting.camera, photographer.setting.depth_step
        self.table: ImageTable[T] | None = None
        self._photographer = photographer
        self._relaxed = RelaxedGrasp(grasp)
        self._T_camera_gripper = invert_pose(photographer.setting.T_gripper_camera)
        self._rng = np.random.default_rng((seed, 3))
        self._count, self._last = 0, None

    def render(self, keep: Callable[[TwinFrame], T], tell: Callable[[int, int], None]) -> None:
        """Take the images at all openings of the gripper; see `render_openings`."""
        openings = choose_openings(self.grasp, 0.0, STROKE)
        self.table = render_openings(self.grasp, self._photographer, openings, keep, tell)

    def take(self, opening: float, now: float) -> Moment[T]:
        """Return the moment at an opening [m], at a time [s] that never goes back; `render` comes first."""
        place = self.table.find(opening)
        takes = self.table.takes[place]
        wrenches = self._relaxed.update(opening, 0.0 if self._last is None else now - self._last)
        T_gripper_object = self.grasp.object_pose(float(self.table.openings[place]))
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


TAKES = 2  # of every opening: a camera that stands still never gives the same image twice
COUNTS = 255  # steps of the gripper's position over its stroke
OPEN_STRIDE = 4  # of those steps between two images where nothing touches
BEFORE_TOUCH = 1e-3  # [m] of opening from which on every step has its image
MOST_WORKERS = 4  # threads, of which each renders an image
_APART = 10.0  # [s] between the stamps that seed the noise, too far for motion blur


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageTable(Generic[T]):
    """Images by opening, in whatever form they were kept.

    Attributes:
        openings: (n,) [m], growing.
        takes: n lists of the same opening's images.
    """

    openings: NDArray
    takes: Sequence[Sequence[T]]

    def find(self, opening: float) -> int:
        """Return the place of the image that was taken nearest to an opening [m]."""
        return int(np.abs(self.openings - opening).argmin())


def choose_openings(grasp: PressedGrasp, low: float, high: float) -> NDArray:
    """Return the openings (n,) [m] between two of a gripper's [m] that deserve an image.

    In contact these are the gripper's own steps, at which it comes to rest; where nothing touches they are coarser.
    """
    steps = low + (high - low) * np.arange(COUNTS + 1) / COUNTS
    near = steps < grasp.touch_opening + BEFORE_TOUCH
    kept = near | (np.arange(COUNTS + 1)[::-1] % OPEN_STRIDE == 0)
    return steps[kept & (steps >= grasp.least_opening)]


def render_openings(
    grasp: PressedGrasp,
    photographer: Photographer,
    openings: NDArray,
    keep: Callable[[TwinFrame], T],
    tell: Callable[[int, int], None] = lambda done, count: None,
) -> ImageTable[T]:
    """Return the images of a grasp.

    Args:
        grasp: what is rendered.
        photographer: that renders it.
        openings: (n,) [m], growing.
        keep: makes of an image what is kept of it; its wrenches are elastic, and it has no stamp and no object's pose.
        tell: hears how many openings of how many are done; what it raises ends the rendering.
    """
    render = partial(_render_opening, grasp, photographer)
    takes, pool = [], ThreadPoolExecutor(min(os.cpu_count() or 1, MOST_WORKERS))
    try:
        for frames in pool.map(render, openings.tolist(), range(len(openings))):
            tell(len(takes) + 1, len(openings))
            takes.append([keep(frame) for frame in frames])
    finally:
        pool.shutdown(cancel_futures=True)
    return ImageTable(openings=openings, takes=takes)


def _render_opening(grasp: PressedGrasp, photographer: Photographer, opening: float, index: int) -> list[TwinFrame]:
    """Return all takes at one opening [m]."""
    state = grasp.state(opening)
    view, frames = photographer.look(state), []
    for take in range(TAKES):
        shot = photographer.develop(view, _APART * (TAKES * index + take))
        jaws = {side: true_jaw(state, shot, side) for side in state.jaws}
        frames.append(TwinFrame(stamp=0, phase="", color=shot.color, depth=shot.depth, jaws=jaws, T_camera_object=None))
    return frames


class CoupledGripper:
    """A gripper that any driver can open by a link, and that closes on the object of a grasp.

    Args:
        grasp: what its jaws press on, before anything relaxes.
        link: path of a symbolic link to the port; empty: none, the port has a name of its own.
        variant: of the firmware, "new" or "old".
    """

    def __init__(self, grasp: PressedGrasp, link: str, variant: str = "new") -> None:
        self.gripper = EmulatedGripper(variant, load=grasp.elastic_force)
        self._port = PtyPort(EmulatedAdapter(self.gripper), link or None)

    @property
    def opening(self) -> float:
        """The true opening between the undeformed inner faces [m]."""
        return self.gripper.jaws.opening

    @property
    def path(self) -> str:
        """What a driver opens."""
        return self._port.path

    def open(self) -> None:
        """Make the port and start the gripper.

        Raises:
            LinkError: something that is no link lies where the link should be.
        """
        self._port.open()

    def close(self) -> None:
        """Stop the gripper and remove the port; may be called again."""
        self._port.close()
