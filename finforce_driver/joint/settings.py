"""What can be set on a gripper that is a joint."""

from __future__ import annotations

from dataclasses import dataclass

from finforce.settings import check_bounds, setting
from finforce_driver.errors import TargetError


@dataclass(frozen=True, kw_only=True)
class JointSettings:
    """How a joint's value goes with the opening, and how it follows its commands; units stand in the metadata.

    The opening is linear between the two ends: `gripper.closed_opening` at `closed`, that and `gripper.stroke` at
    `open`.
    """

    names: tuple[str, ...] = setting(("gripper_joint",), "Names of the commanded joints; the first is read")
    closed: float = setting(0.0, "Joint value of the closed gripper, in the joint's unit", "", -1e4, 1e4)
    open: float = setting(1.0, "Joint value of the open gripper, in the joint's unit", "", -1e4, 1e4)
    resolution: float = setting(0.0002, "Smallest step of the opening that the joint follows", "m", 1e-6, 0.01)
    rate: float = setting(
        25.0, "Rate of setpoints on the way; 0: one command, the joint keeps the speed itself", "Hz", 0.0, 500.0
    )
    largest_speed: float = setting(0.1, "Maximum speed of the opening", "m/s", 1e-4, 2.0)
    largest_force: float = setting(0.0, "Maximum effort of a command; 0: the joint takes none", "N", 0.0, 1000.0)
    effort_is_force: bool = setting(
        False, "Whether the joint's effort is its grip force [N], as a check of the camera's", ""
    )

    def __post_init__(self) -> None:
        """Refuses what no joint is.

        Raises:
            TargetError: a value is out of bounds, there is no joint, or both ends are the same.
        """
        check_bounds(self, TargetError)
        if not self.names or not all(self.names) or len(set(self.names)) != len(self.names):
            raise TargetError(f"joint.names: got {self.names!r}, expected one name or more, each once")
        if self.closed == self.open:
            raise TargetError(f"joint.closed and joint.open: both are {self.open:g}, expected two values")
