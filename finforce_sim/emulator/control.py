"""The firmware's control loop: moves, their object code, the calibration; and what a careful driver does not send."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from finforce_driver.can.protocol import LARGEST_CURRENT_MA, Move
from finforce_sim.emulator.mechanism import Jaws

AT_POSITION = 3  # object code
_SLOWEST = 40  # [ticks/s], of the speed byte 0
_SPEED_RANGE = 79960  # [ticks/s], more of the speed byte 255
_LARGEST = 255


@dataclass(frozen=True, kw_only=True)
class Firmware:
    """The differences of firmware versions.

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
        confirm_time: time for which a stop must be felt [ms].
        calibration_timeout: after which a calibration is given up [ms].
        watchdog_length: data bytes without which the watchdog's setter is ignored.
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
    ),
}


class Mode(Enum):
    """The state of the control loop."""

    IDLE = 0
    GRIPPER = 6
    CALIBRATE = 7


def divide(dividend: int, divisor: int) -> int:
    """Return an integer quotient, truncated towards zero as in C."""
    quotient = abs(dividend) // abs(divisor)
    return quotient if (dividend < 0) == (divisor < 0) else -quotient


@dataclass
class Endpoints:
    """Encoder counts that the firmware takes for the end stops; before a calibration they are mere defaults."""

    open: int = 10329
    closed: int = -229

    def target(self, position: int) -> int:
        """Return the count of a position byte."""
        return divide(position * (self.closed - self.open), _LARGEST) + self.open

    def position(self, count: int) -> int:
        """Return the position byte of a count; 0 where calibration found no way between the stops."""
        if self.closed == self.open:
            return 0
        return min(max(divide((count - self.open) * _LARGEST, self.closed - self.open), 0), _LARGEST)


def ticks_per_second(speed: int) -> float:
    """Return the speed [ticks/s] of a speed byte."""
    return float(_SLOWEST + divide(speed * _SPEED_RANGE, _LARGEST))


class MoveControl:
    """Follows the last order, and remembers having reached its target until another order comes.

    Attributes:
        order: the last five bytes.
        object_code: 0 moving, 1 and 2 contact, 3 at position.
        latched: the target was reached; what follows is position control without a speed.
    """

    def __init__(self, firmware: Firmware) -> None:
        self._firmware = firmware
        self.order = Move(position=0, speed=0, current_mA=0, flags=0)
        self.object_code = AT_POSITION
        self.latched = False

    def take(self, order: Move) -> None:
        """Follow an order; the same one again changes nothing, not even after an interruption."""
        if order != self.order:
            self.latched = False
        self.order = order

    def step(self, jaws: Jaws, endpoints: Endpoints, position: int, may_move: bool) -> None:
        """Go on for one step.

        Args:
            jaws: to move.
            endpoints: that the orders are meant in.
            position: the present position byte.
            may_move: calibrated, and configured as a gripper.
        """
        if not (may_move and self.order.activated and self.order.action):
            jaws.rest()
            if self._firmware.tick_tolerance:  # older ones keep the last code
                self.object_code = 0
            return
        target = endpoints.target(self.order.position)
        limit = max(min(self.order.current_mA, LARGEST_CURRENT_MA), -LARGEST_CURRENT_MA)
        self.latched = self.latched or self._reached(jaws, target, position)
        if self.latched:
            self.object_code = AT_POSITION
            jaws.hold(target, limit)
            return
        error = target - jaws.encoder
        # byte equality may want one tick more than the target, and the sign of the speed is kept there
        reach = abs(error) + (0 if self._firmware.tick_tolerance else 1)
        speed = ticks_per_second(self.order.speed)
        jaws.drive(speed if error > 0 else -speed, limit, reach)
        self.object_code = self._contact_code(jaws)

    def _reached(self, jaws: Jaws, target: int, position: int) -> bool:
        if self._firmware.tick_tolerance:
            return abs(target - jaws.encoder) < self._firmware.tick_tolerance
        return position == self.order.position

    def _contact_code(self, jaws: Jaws) -> int:
        if abs(jaws.velocity) > self._firmware.contact_speed or not self._strains(abs(jaws.current)):
            return 0
        return self._firmware.opening_code if jaws.current > 0.0 else self._firmware.closing_code

    def _strains(self, current: float) -> bool:
        if self._firmware.contact_ratio:
            return current > self._firmware.contact_ratio * self.order.current_mA
        return abs(current - self.order.current_mA) <= self._firmware.contact_margin


_PAUSE = 20  # [ms] of a calibration between its two ways


def find_stops(firmware: Firmware, jaws: Jaws, endpoints: Endpoints) -> Iterator[None]:
    """Look for the open stop, then for the closed one, a step at a time, and write what is found into `endpoints`.

    Whoever stops asking leaves the search where it is.
    """
    yield from _seek(firmware, jaws, 1.0)
    endpoints.open = jaws.encoder
    yield
    for _ in range(_PAUSE):
        jaws.drive(0.0, 0.0)
        yield
    yield from _seek(firmware, jaws, -1.0)
    endpoints.closed = jaws.encoder


def _seek(firmware: Firmware, jaws: Jaws, direction: float) -> Iterator[None]:
    """Drive towards a stop until it was felt for long enough."""
    felt = 0
    while True:
        jaws.drive(direction * firmware.calibration_speed, firmware.calibration_current)
        strains = abs(abs(jaws.current) - firmware.calibration_current) <= firmware.calibration_margin
        felt = felt + 1 if strains and abs(jaws.velocity) <= 700.0 else 0
        if felt >= firmware.confirm_time:
            return
        yield


_WEAK_CURRENT = 150  # [mA], least current that the maker advises
_STRONG_CURRENT = 1500  # [mA], largest current that the maker advises
_SLOW_SPEED = 3  # byte below which contact is felt while the jaws still move


def list_violations(order: Move, control: MoveControl, mode: Mode) -> Iterator[str]:
    """Yield what is wrong with an order, given the control that has not taken it yet, and the present mode."""
    if mode is Mode.CALIBRATE and not order.estop:
        yield "order during calibration"
    if not _WEAK_CURRENT <= order.current_mA <= _STRONG_CURRENT:
        yield "current out of range"
    if not order.drives:
        return
    if order.speed < _SLOW_SPEED:
        yield "too slow"
    if order == control.order and mode is Mode.GRIPPER:
        yield "repeated order"
    if order == control.order and mode is not Mode.GRIPPER and control.latched:
        yield "stale latch"
