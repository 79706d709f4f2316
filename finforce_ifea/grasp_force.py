"""Two jaws as one gripper: grasp and manipulation force from the forces on the jaws (Zuo, Yang and Chua, Eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass
from time import monotonic
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from finforce.gripper_frames import SIDES, jaw_in_gripper
from finforce.stamps import Synchronizer

Side = Literal["left", "right"]

R_GRIPPER_JAW = {side: jaw_in_gripper(side, 0.0)[:3, :3] for side in SIDES}


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """What the object does to the gripper; all in `gripper_base`.

    Attributes:
        grasp: (3,) [N], along x: how hard the object is held.
        manipulation: (3,) [N], the net force on the gripper.
    """

    grasp: NDArray[np.float64]
    manipulation: NDArray[np.float64]


def combine_forces(left: NDArray[np.float64], right: NDArray[np.float64]) -> Grasp:
    """Return grasp force min(|F_left|, |F_right|) and manipulation force R_left F_left + R_right F_right.

    Seen in the gripper's frame the jaws' forces oppose each other, so that the sum is the difference
    F_left - F_right of the paper.

    Args:
        left: (3,) [N], force the object applies to the left jaw, in `left_jaw`.
        right: (3,) [N], likewise for the right jaw, in `right_jaw`.
    """
    held = min(float(np.linalg.norm(left)), float(np.linalg.norm(right)))
    net = R_GRIPPER_JAW["left"] @ left + R_GRIPPER_JAW["right"] @ right
    return Grasp(grasp=np.array([held, 0.0, 0.0]), manipulation=net)


def single_jaw_grasp(force: NDArray[np.float64], side: Side) -> Grasp:
    """Return what one jaw alone says: its force is the grasp force and the net force."""
    held = float(np.linalg.norm(force))
    return Grasp(grasp=np.array([held, 0.0, 0.0]), manipulation=R_GRIPPER_JAW[side] @ force)


class ForcePairing:
    """Brings together the forces of both jaws that belong to one image, whichever comes first.

    Args:
        side: the jaw whose forces come first-hand.
        depth: images that may wait for the other jaw.
    """

    def __init__(self, side: Side, depth: int = 16) -> None:
        self._own, self._other = side, "right" if side == "left" else "left"
        self._forces = Synchronizer({self._own: depth, self._other: depth})
        self._heard = -float("inf")

    @property
    def silence(self) -> float:
        """Time since the other jaw was heard of [s], infinite before."""
        return monotonic() - self._heard

    def add(self, stamp: int, force: NDArray[np.float64], *, own: bool) -> Grasp | None:
        """Take a force (3,) [N] in its jaw's frame; return the grasp once the stamp has both forces."""
        if not own:
            self._heard = monotonic()
        mine, peer = (self._own, self._other) if own else (self._other, self._own)
        found = self._forces.take(peer, stamp)
        if found is None:
            self._forces.add(mine, stamp, force)
            return None
        forces = {mine: force, peer: found.value}
        return combine_forces(forces["left"], forces["right"])
