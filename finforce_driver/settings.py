"""What can be set on a gripper: defaults, units, bounds and meanings."""

from __future__ import annotations

from dataclasses import dataclass

from finforce.settings import check_bounds, setting
from finforce_driver.errors import TargetError

LEAST_WATCHDOG = 0.2  # [s]


@dataclass(frozen=True, kw_only=True)
class GripperSettings:
    """Settings of `Gripper`; each field's metadata says unit, bounds and meaning."""

    node_id: int = setting(0, "CAN node of the gripper", "", 0, 15)
    poll_rate: float = setting(50.0, "how often the gripper is asked for its state", "Hz", 5.0, 200.0)
    reply_timeout: float = setting(0.05, "longest wait for a reply", "s", 0.005, 1.0)
    missed_replies: int = setting(25, "requests in a row without a reply after which the port is reopened", "", 2, 1000)
    stroke: float = setting(0.048, "opening of the mechanism between its end stops", "m", 0.001, 0.5)
    closed_opening: float = setting(0.0, "between the jaws' inner faces when the mechanism is closed", "m", 0.0, 0.2)
    stroke_tolerance: float = setting(
        0.04, "share of the stroke by which a calibration may find another one; beyond, it is refused", "", 0.001, 1.0
    )
    pinion_radius: float = setting(0.006, "of the pinion between the two racks", "m", 0.001, 0.1)
    force_per_current: float = setting(47.7, "slope of the maker's curve of grip force", "N/A", 1.0, 500.0)
    least_current: float = setting(0.15, "below it the gripper is unstable", "A", 0.05, 1.0)
    largest_current: float = setting(1.3, "greatest current limit that may be asked for", "A", 0.15, 1.5)
    default_speed: float = setting(0.02, "of the opening, where a command names none", "m/s", 1e-4, 0.37)
    default_current: float = setting(0.5, "current limit where a command names no force", "A", 0.15, 1.5)
    telemetry_period: float = setting(1.0, "between two questions for temperature, supply or errors", "s", 0.05, 3600.0)
    watchdog: float = setting(
        0.0,
        "silence of the driver after which the gripper goes limp by itself; 0: it goes on with its order",
        "s",
        0,
        60,
    )
    release_on_stop: bool = setting(False, "let go when the driver ends; else it goes on holding", "")

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
        if not self.least_current <= self.default_current <= self.largest_current:
            raise TargetError(
                f"default_current: got {self.default_current:g} A, expected {self.least_current:g} to "
                f"{self.largest_current:g} A, the range of least_current and largest_current"
            )
