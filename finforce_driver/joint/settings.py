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

    names: tuple[str, ...] = setting(("gripper_joint",), "of the joints that are commanded, alike; the first is read")
    states: str = setting("joint_states", "topic with the joint's state")
    closed: float = setting(0.0, "value of the joint when the jaws are closed, in its own unit", "", -1e4, 1e4)
    open: float = setting(1.0, "value of the joint when the jaws are open", "", -1e4, 1e4)
    resolution: float = setting(0.0002, "smallest step of the opening that the joint follows", "m", 1e-6, 0.01)
    rate: float = setting(
        25.0,
        "how often a setpoint is sent on the way; 0: once, the joint keeps to the speed by itself",
        "Hz",
        0.0,
        500.0,
    )
    largest_speed: float = setting(0.1, "of the opening", "m/s", 1e-4, 2.0)
    largest_force: float = setting(
        0.0, "greatest effort that may be asked for; 0: the joint takes none", "N", 0.0, 1000.0
    )
    effort_is_force: bool = setting(
        False, "the joint's effort is its grip force [N]: the second witness of a grasp by force", ""
    )
    silence: float = setting(0.5, "without a state after which the joint counts as away", "s", 0.05, 10.0)

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
