"""The grasp by force as one blocking call, in real or in stepped time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import Lock
from typing import TYPE_CHECKING, Protocol

from finforce_driver.errors import DriverError, GraspError, GripperTimeoutError
from finforce_driver.grasp.controller import ForceGrasp
from finforce_driver.grasp.force_feed import ForceSample, TouchSample
from finforce_driver.grasp.settings import GraspGoal, GraspSettings
from finforce_driver.grasp.status import GraspPhase, GraspStatus

if TYPE_CHECKING:
    from finforce_driver.gripper import Gripper

_CYCLE = 0.05  # [s] in which silence is noticed


class ForceSource(Protocol):
    """Where forces come from."""

    def take(self) -> Sequence[ForceSample | TouchSample]:
        """Return what has come since the last call, oldest first, without waiting."""


class ForceInbox:
    """A force source that another thread fills."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._samples: list[ForceSample | TouchSample] = []

    def put(self, sample: ForceSample | TouchSample) -> None:
        """Add what has come."""
        with self._lock:
            self._samples.append(sample)

    def take(self) -> Sequence[ForceSample | TouchSample]:
        """Return what was put since the last call."""
        with self._lock:
            samples, self._samples = self._samples, []
        return samples


def hold_force(
    gripper: Gripper,
    forces: ForceSource,
    goal: GraspGoal,
    settings: GraspSettings | None = None,
    *,
    until: Callable[[GraspStatus], bool] | None = None,
) -> GraspStatus:
    """Close until the force is reached, and return how the grasp is; the jaws then stay where they are.

    Args:
        gripper: calibrated and ready.
        forces: what the camera says, on the gripper's clock.
        goal: force, speed, limits.
        settings: of the grasp.
        until: asked with every status; the force is held, with feedback, until it returns true. None: returns as soon
            as the force is held.

    Raises:
        TargetError: the set force is above the limit of the settings.
        GraspError: the grasp was ended for safety. Here, and whatever else is raised, the gripper holds in place, if
            it can.
    """
    grasp = ForceGrasp(goal, settings, resolution=gripper.resolution, closed_opening=gripper.settings.closed_opening)
    is_done = until or (lambda status: status.phase is GraspPhase.HOLDING)
    try:
        while not is_done(status := _turn(gripper, forces, grasp)):
            _await_reply(gripper)
    except BaseException:
        with suppress(DriverError):
            gripper.hold()
        raise
    return status


def _turn(gripper: Gripper, forces: ForceSource, grasp: ForceGrasp) -> GraspStatus:
    """Hand what has come to the grasp and do what it asks for.

    Raises:
        GraspError: it has ended.
        DriverError: the gripper refuses.
    """
    for sample in forces.take():
        if isinstance(sample, TouchSample):
            grasp.take_touch(sample.touching, sample.stamp)
        else:
            grasp.take_force(sample)
    step = grasp.update(gripper.state, gripper.clock.now(), gripper.opening_at)
    if step.status.phase is GraspPhase.STOPPED:
        raise GraspError(step.status.reason)
    if step.move is not None:
        gripper.move(step.move.opening, step.move.speed, step.move.force)
    return step.status


def _await_reply(gripper: Gripper) -> None:
    """Return with the next reply of the gripper, or when silence has to be looked at."""
    last = gripper.state.stamp
    with suppress(GripperTimeoutError):
        gripper.wait(lambda state: state.stamp != last, _CYCLE)
