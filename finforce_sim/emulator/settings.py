"""What can be chosen of an emulated gripper: its build, its firmware and its environment."""

from __future__ import annotations

from dataclasses import dataclass

from finforce.settings import check_bounds, setting
from finforce_driver.errors import TargetError


@dataclass(frozen=True, kw_only=True)
class Firmware:
    """Where firmware versions differ.

    Attributes:
        closing_code: object code of contact while the current drives closed.
        opening_code: object code of contact while the current drives open.
        contact_speed: largest reading of speed that counts as standing [ticks/s].
        contact_ratio: share of the current limit above which standing is contact; 0: `contact_margin` decides.
        contact_margin: largest distance of the current from its limit that counts as contact [mA].
        tick_tolerance: distance from the target that counts as reached [ticks]; 0: equal position bytes count.
        calibration_speed: while looking for the end stops [ticks/s].
        calibration_current: limit meanwhile [mA].
        calibration_margin: largest distance of the current from that limit at a stop [mA].
        confirm_time: how long a stop must be felt [ms].
        calibration_timeout: after which a calibration is given up [ms].
        watchdog_length: data bytes without which the watchdog's setter is ignored.
        has_torque_constant: whether the request for it is answered.
    """

    closing_code: int
    opening_code: int
    contact_speed: float
    contact_ratio: float
    contact_margin: float
    tick_tolerance: int
    calibration_speed: float
    calibration_current: float
    calibration_margin: float
    confirm_time: int
    calibration_timeout: int
    watchdog_length: int
    has_torque_constant: bool


VARIANTS = {
    "new": Firmware(  # source of 2026-03-13
        closing_code=1,
        opening_code=2,
        contact_speed=500.0,
        contact_ratio=0.8,
        contact_margin=0.0,
        tick_tolerance=5,
        calibration_speed=12582.0,
        calibration_current=500.0,
        calibration_margin=90.0,
        confirm_time=640,
        calibration_timeout=30_000,
        watchdog_length=5,
        has_torque_constant=True,
    ),
    "old": Firmware(  # the maker's prebuilt file of 2024-09-02
        closing_code=2,
        opening_code=1,
        contact_speed=700.0,
        contact_ratio=0.0,
        contact_margin=30.0,
        tick_tolerance=0,
        calibration_speed=14150.0,
        calibration_current=450.0,
        calibration_margin=30.0,
        confirm_time=1,
        calibration_timeout=14_000,
        watchdog_length=4,
        has_torque_constant=False,
    ),
}


@dataclass(frozen=True, kw_only=True)
class EmulatorSettings:
    """Settings of `EmulatedGripper`; each field's metadata says unit, bounds and meaning."""

    stop_open: int = setting(10329, "of the motor at the open end stop", "ticks", 0, 16383)
    stop_closed: int = setting(-229, "of the motor at the closed end stop", "ticks", -16384, 0)
    stroke: float = setting(0.048, "opening of the mechanism between its end stops", "m", 0.001, 0.5)
    closed_opening: float = setting(0.0, "between the jaws' inner faces when the mechanism is closed", "m", 0.0, 0.2)
    start_opening: float = setting(0.048, "between the jaws when the emulation begins", "m", 0.0, 0.7)
    force_per_current: float = setting(47.7, "grip force per motor current", "N/A", 1.0, 500.0)
    current_lag: float = setting(0.02, "time constant of the current", "s", 0.001, 1.0)
    free_current: float = setting(0.06, "that moves the unloaded jaws, at most a fifth of the limit", "A", 0.0, 0.5)
    limp_force: float = setting(0.0, "grip force below which jaws without power stay where they are", "N", 0.0, 100.0)
    hold_speed: float = setting(80_000.0, "of the drive's own position control", "ticks/s", 1000.0, 800_000.0)
    rest_error: int = setting(0, "that the position control leaves, positive on the open side", "ticks", -4, 4)
    boot_time: float = setting(0.3, "of silence after a reset", "s", 0.0, 10.0)
    save_time: float = setting(0.5, "of deafness while the configuration is written", "s", 0.0, 10.0)
    resets_integrators: bool = setting(False, "each order of five bytes lets the current start anew", "")
    supply_limit: float = setting(29.0, "supply above which a fault is latched", "V", 9.0, 30.0)

    def __post_init__(self) -> None:
        """Refuses values out of bounds.

        Raises:
            TargetError: a value is out of its bounds, or the jaws would start beyond an end stop.
        """
        check_bounds(self, TargetError)
        widest = self.closed_opening + self.stroke
        if not self.closed_opening <= self.start_opening <= widest:
            raise TargetError(
                f"start_opening: got {self.start_opening:g} m, expected {self.closed_opening:g} to {widest:g} m"
            )


@dataclass(frozen=True, kw_only=True)
class StoredConfiguration:
    """What outlives a reset once it was saved.

    Attributes:
        node_id: on the CAN bus.
        watchdog: longest silence [ms]; 0: any.
        heartbeat: period [ms]; 0: none.
    """

    node_id: int
    watchdog: int = 0
    heartbeat: int = 0
