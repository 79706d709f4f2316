"""Poses of jaw and object that belong to one image, whichever comes first."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.stamps import Stamped, Synchronizer
from finforce.transforms import invert_pose

JAW, OBJECT = "jaw", "object"
DEPTH = 16  # images that may wait for their other pose
BRIDGED = 250_000_000  # [ns] between two poses of a jaw that stand for the time between, while it does not move
UNMOVED = 0.2e-3  # [m] and, for its axes, [1]: a jaw that differs by less has not moved


class PoseStep(NamedTuple):
    """What is to be done next.

    Attributes:
        stamp: of the image [ns].
        T_jaw_object: (4, 4), a new pose of the object in the jaw frame; None when the image has none (yet).
        T_jaw_camera: (4, 4), of the same image.
        covariance: (6, 6) of the object's pose, camera axes; None when unknown.
        is_due: the contact of this image is due; else only its pose came late.
    """

    stamp: int
    T_jaw_object: NDArray | None
    T_jaw_camera: NDArray
    covariance: NDArray | None
    is_due: bool


class PosePairing:
    """Brings the poses of jaw and object together by their stamps.

    An image is due when its jaw pose comes. It waits for its object pose, at most until the next jaw pose, as long as
    object poses have kept up so far; a slow tracker delays nothing. Of a jaw that stands still not every image is told:
    an object pose between two equal poses of the jaw is used with them.

    Args:
        tolerance: greatest distance of stamps that belong together [ns].
    """

    def __init__(self, tolerance: int) -> None:
        self._tolerance = tolerance
        self._poses = Synchronizer({JAW: DEPTH, OBJECT: DEPTH}, tolerance)
        self.reset()

    def reset(self) -> None:
        """Forget all poses."""
        self._poses.reset()
        self._waiting = self._in_step = False

    def add_jaw(self, stamp: int, T_camera_jaw: NDArray) -> list[PoseStep]:
        """Take the pose (4, 4) of the jaw in an image [ns]; return what is to be done now."""
        jaws = self._poses.entries(JAW)
        overdue = [self._step(jaws[-1], None)] if self._waiting else []
        self._in_step &= not self._waiting
        self._poses.add(JAW, stamp, invert_pose(T_camera_jaw))
        last = list(jaws)[-2:]
        between = [step for pose in self._poses.entries(OBJECT) for step in self._bridge(pose, last[0], last[-1])]
        found = self._poses.find(OBJECT, stamp)
        self._waiting = found is None and self._in_step
        steps = [*overdue, *between[-1:]]
        return steps if self._waiting else [*steps, self._step(jaws[-1], found)]

    def add_object(self, stamp: int, T_camera_object: NDArray, covariance: NDArray | None = None) -> list[PoseStep]:
        """Take the pose (4, 4) of the object in an image [ns]; return what is to be done now."""
        self._poses.add(OBJECT, stamp, (T_camera_object, covariance))
        jaws, pose = self._poses.entries(JAW), self._poses.entries(OBJECT)[-1]
        jaw = self._poses.find(JAW, stamp)
        if jaw is None:
            return [step for last in pairwise(jaws) for step in self._bridge(pose, *last)]
        is_newest = jaw is jaws[-1]
        is_due = is_newest and self._waiting
        self._in_step |= is_newest
        self._waiting &= not is_newest
        return [self._step(jaw, pose, is_due=is_due)]

    def _bridge(self, pose: Stamped, before: Stamped, after: Stamped) -> list[PoseStep]:
        """Return what is to be done with an object pose between two poses of a jaw, nothing if the jaw has moved."""
        is_between = before.stamp + self._tolerance < pose.stamp < after.stamp - self._tolerance
        is_near = after.stamp - before.stamp <= BRIDGED
        if not (is_between and is_near and np.abs(after.value - before.value).max() <= UNMOVED):
            return []
        return [self._step(Stamped(pose.stamp, before.value), pose, is_due=False)]

    def has_object(self, stamp: int) -> bool:
        """Say whether the object's pose in an image [ns] is known."""
        return self._poses.find(OBJECT, stamp) is not None

    def add_late(self, stamp: int, T_camera_jaw: NDArray) -> list[PoseStep]:
        """Take the pose (4, 4) of the jaw in an image [ns] that is not due any more; return what is to be done now."""
        found = self._poses.find(OBJECT, stamp)
        return [self._step(Stamped(stamp, invert_pose(T_camera_jaw)), found, is_due=False)] if found else []

    def is_waiting(self, stamp: int) -> bool:
        """Say whether an image [ns] waits for its object pose."""
        return self._waiting and self.belong(self._poses.entries(JAW)[-1].stamp, stamp)

    def belong(self, one: int, other: int) -> bool:
        """Say whether two stamps [ns] are those of one image."""
        return self._poses.belong(one, other)

    def _step(self, jaw: Stamped, pose: Stamped | None, *, is_due: bool = True) -> PoseStep:
        """Return the step of a jaw's inverted pose and the object's pose with its covariance."""
        T_camera_object, covariance = pose.value if pose else (None, None)
        T_jaw_object = jaw.value @ T_camera_object if pose else None
        return PoseStep(jaw.stamp, T_jaw_object, jaw.value, covariance, is_due)
