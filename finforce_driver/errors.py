"""Errors of a gripper, its link and its commands."""

from finforce.errors import FinforceError


class DriverError(FinforceError):
    """The base of the errors of this package."""


class LinkError(DriverError, OSError):
    """The port to the CAN adapter is absent, busy, gone, or does not take what is sent."""


class TargetError(DriverError, ValueError):
    """An opening, speed, force or time that was asked for is no number or out of bounds."""


class GripperStateError(DriverError, RuntimeError):
    """The gripper is not in a state in which it could do what was asked: absent, not calibrated, faulty, stopped."""


class GripperTimeoutError(DriverError, TimeoutError):
    """The gripper did not reach what was waited for in time."""


class GraspError(DriverError, RuntimeError):
    """A force-controlled grasp was ended for safety; the message says why."""


class BackOffError(GraspError):
    """A grasp pressed harder than it may; the jaws go back to where it began."""


class UnseenForceError(BackOffError):
    """The motor presses much harder than the camera says: the camera does not see the force."""
