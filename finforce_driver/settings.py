"""What can be set on a gripper: defaults, units, bounds and meanings."""

from __future__ import annotations

from dataclasses import dataclass

from finforce.settings import check_bounds, setting
from finforce_driver.errors import TargetError

LEAST_WATCHDOG = 0.2  # [s]
LEAST_CURRENT = 0.15  # [A] below which the gripper is unstable
FORCE_PER_CURRENT = 47.7  # [N/A], slope of the maker's curve of grip force
PINION_RADIUS = 0.006  # [m] of the pinion between the two racks


@dataclass(frozen=True, kw_only=True)
class GripperSettings:
    """Settings of `Gripper`; each field's metadata says unit, bounds and meaning.

    Attributes:
        telemetry_period: between two questions for temperature, supply or errors [s]; no ROS parameter.
    """

    node_id: int = setting(0, "CAN node of the gripper", "", 0, 15)
    poll_rate: float = setting(50.0, "Rate of state requests", "Hz", 5.0, 200.0)
    reply_timeout: float = setting(0.05, "Maximum wait for a reply", "s", 0.005, 1.0)
    stroke: float = setting(0.048, "Stroke of the opening between the end stops", "m", 0.001, 0.5)
    closed_opening: float = setting(0.0, "Opening between the jaws' inner faces at the closed stop", "m", 0.0, 0.2)
    largest_current: float = setting(1.3, "Maximum current limit of a command", "A", 0.15, 1.5)
    default_speed: float = setting(0.02, "Speed of the opening where a command names none", "m/s", 1e-4, 0.37)
    default_current: float = setting(0.5, "Current limit where a command names no force", "A", 0.15, 1.5)
    watchdog: float = setting(
        0.0, "Silence of the driver after which the gripper goes limp; 0: it keeps its last order", "s", 0, 60
    )
    release_on_stop: bool = setting(False, "Whether the jaws go limp when the driver ends; else they hold", "")
    telemetry_period: float = 1.0

    @property
    def largest_opening(self) -> float:
        """Opening at the open stop [m]."""
        return self.closed_opening + self.stroke

    def check_opening(self, name: str, opening: float) -> None:
        """Refuses an opening [m] at which the jaws can never be.

        Raises:
            TargetError: it is no number, or outside the stroke.
        """
        if not self.closed_opening <= opening <= self.largest_opening:
            raise TargetError(
                f"{name}: got {opening:g} m, expected {self.closed_opening:g} to {self.largest_opening:g} m, what the "
                "gripper can open"
            )

    def __post_init__(self) -> None:
        """Refuses values out of bounds.

        Raises:
            TargetError: a value is out of its bounds, the watchdog too short, or the default current lies outside the
                currents' range.
        """
        check_bounds(self, TargetError)
        if 0.0 < self.watchdog < LEAST_WATCHDOG:
            raise TargetError(
                f"watchdog: got {self.watchdog:g} s, expected 0 for none, or {LEAST_WATCHDOG:g} s at least: a computer "
                "stands still for a moment now and then"
            )
        if not LEAST_CURRENT <= self.default_current <= self.largest_current:
            raise TargetError(
                f"default_current: got {self.default_current:g} A, expected {LEAST_CURRENT:g} to "
                f"{self.largest_current:g} A, up to largest_current"
            )
