"""Two jaws as one gripper: grasp and manipulation force from the forces on the jaws (Zuo, Yang and Chua, Eq. 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.gripper_frames import SIDES, jaw_in_gripper
from finforce.messages import SECOND, Synchronizer
from finforce_ifea.posture import WristPosture

Side = Literal["left", "right"]

R_GRIPPER_JAW = {side: jaw_in_gripper(side, 0.0)[:3, :3] for side in SIDES}


def to_jaw(posture: WristPosture | None, side: str) -> WristPosture | None:
    """Return the posture of a jaw for that of `gripper_base`; None for None."""
    return None if posture is None else posture._replace(gravity=posture.gravity @ R_GRIPPER_JAW[side])


class Wrench(NamedTuple):
    """The object's load on a jaw: force (3,) [N] and torque (3,) [N m] about the jaw's origin, in the jaw frame."""

    force: NDArray[np.float64]
    torque: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """The load of the object on the gripper; all in `gripper_base`.

    Attributes:
        grasp: (3,) [N], along x: how hard the object is held.
        manipulation: (3,) [N], the net force on the gripper.
        torque: (3,) [N m] of the net force about the origin, of one jaw alone about that jaw's; None where the jaws are
            is not known.
        stddev: (3,) standard deviation of the net force [N]; None if unknown.
    """

    grasp: NDArray[np.float64]
    manipulation: NDArray[np.float64]
    torque: NDArray[np.float64] | None
    stddev: NDArray[np.float64] | None = None


def combine_wrenches(left: Wrench, right: Wrench, distance: float | None, stddevs: Sequence[NDArray] = ()) -> Grasp:
    """Return grasp force min(|F_left|, |F_right|) and manipulation force R_left F_left + R_right F_right.

    Seen in the gripper's frame the jaws' forces oppose each other, so that the sum is the difference
    F_left - F_right of the paper. With p = -+distance / 2 along x its torque is the sum of R T + p x R F.

    Args:
        left: of the left jaw.
        right: of the right jaw.
        distance: between the jaws' origins, half way between which the gripper's is [m]; None unknown.
        stddevs: standard deviations (3,) of the forces [N] of both jaws, of one where the other's is alike, or none.
    """
    held = min(float(np.linalg.norm(left.force)), float(np.linalg.norm(right.force)))
    forces = [R_GRIPPER_JAW["left"] @ left.force, R_GRIPPER_JAW["right"] @ right.force]
    torque = None
    if distance is not None:
        # x cross F = (0, -F_z, F_y)
        couple = (0.5 * distance * (forces[1] - forces[0]))[[0, 2, 1]] * [0.0, -1.0, 1.0]
        torque = R_GRIPPER_JAW["left"] @ left.torque + R_GRIPPER_JAW["right"] @ right.torque + couple
    # the jaws' frames are turned about z by half a turn: their axes are those of the gripper
    stddev = np.sqrt(2.0 * np.mean(np.square(stddevs), axis=0)) if len(stddevs) else None
    grasp = np.array([held, 0.0, 0.0])
    return Grasp(grasp=grasp, manipulation=forces[0] + forces[1], torque=torque, stddev=stddev)


def single_jaw_grasp(wrench: Wrench, side: Side) -> Grasp:
    """Return what one jaw alone says: its force is the grasp force, its wrench the net wrench."""
    held, R = float(np.linalg.norm(wrench.force)), R_GRIPPER_JAW[side]
    return Grasp(grasp=np.array([held, 0.0, 0.0]), manipulation=R @ wrench.force, torque=R @ wrench.torque)


class JawDistance:
    """The distance between the jaws' origins, by their poses in the camera's frame."""

    def __init__(self, max_age: float) -> None:
        """Keep the greatest distance in time of a pose from what it is used for [s]."""
        self._max_age = round(max_age / SECOND)
        self._poses: dict[str, tuple[int, NDArray]] = {}

    def take(self, side: str, stamp: int, T_camera_jaw: NDArray) -> None:
        """Take the pose (4, 4) of a jaw in an image [ns]."""
        self._poses[side] = stamp, T_camera_jaw

    def at(self, stamp: int) -> float | None:
        """Return the distance in an image [ns] along the closing axis [m]; None where one of them is not known."""
        poses = [T for taken, T in self._poses.values() if abs(taken - stamp) <= self._max_age]
        if len(poses) < len(SIDES):
            return None
        left, right = self._poses["left"][1], self._poses["right"][1]
        return float((right[:3, 3] - left[:3, 3]) @ left[:3, 0])


class ForcePairing:
    """Brings together the wrenches of both jaws that belong to one image, whichever comes first.

    Args:
        side: the jaw whose wrenches come first-hand.
        depth: images that may wait for the other jaw.

    Attributes:
        distance: between the jaws.
    """

    def __init__(self, side: Side, depth: int = 16) -> None:
        self.distance = JawDistance(max_age=0.5)
        self._own, self._other = side, "right" if side == "left" else "left"
        self._wrenches = Synchronizer({self._own: depth, self._other: depth})
        self._heard = -float("inf")

    @property
    def silence(self) -> float:
        """Time since the other jaw was heard of, or was to be [s], infinite before."""
        return monotonic() - self._heard

    def resume(self) -> None:
        """Note that nothing was to be heard of the other jaw so far."""
        self._heard = monotonic()

    def add(self, stamp: int, wrench: Wrench, stddev: NDArray | None = None, *, own: bool) -> Grasp | None:
        """Take the wrench on a jaw; return the grasp once the stamp [ns] has both.

        Args:
            stamp: of the image [ns].
            wrench: of a jaw.
            stddev: standard deviation of its force (3,) [N]; None if unknown.
            own: True for the jaw whose wrenches come first-hand.
        """
        if not own:
            self._heard = monotonic()
        mine, peer = (self._own, self._other) if own else (self._other, self._own)
        found = self._wrenches.take(peer, stamp)
        if found is None:
            self._wrenches.add(mine, stamp, (wrench, stddev))
            return None
        pair = {mine: (wrench, stddev), peer: found.value}
        stddevs = [each for _, each in pair.values() if each is not None]
        return combine_wrenches(pair["left"][0], pair["right"][0], self.distance.at(stamp), stddevs)
