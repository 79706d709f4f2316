"""SI units at the edge, bytes inside, and the refusal of what the gripper cannot do."""

from __future__ import annotations

import math
from dataclasses import dataclass

from finforce_driver.can.protocol import LARGEST_BYTE
from finforce_driver.errors import TargetError
from finforce_driver.settings import FORCE_PER_CURRENT, LEAST_CURRENT, PINION_RADIUS, GripperSettings

TICKS_PER_TURN = 16384  # of the encoder
OPENING_PER_TICK = 4.0 * math.pi * PINION_RADIUS / TICKS_PER_TURN  # [m]: both racks move by the pinion's circumference
SLOWEST_TICKS = 40  # per second, at speed byte 0
TICKS_SPAN = 79960  # per second, from speed byte 0 to 255
SLOWEST_BYTE = 3  # below it the gripper mistakes slow motion for contact
LEAST_SPEED = 1e-5  # [m/s] of the opening: a stroke in 80 minutes
MOST_EXCESS = 2.0  # times the fastest speed; more is not cut but refused
ROUNDING = 1e-9  # [m], [N]: what a value may lie out of bounds by arithmetic alone


@dataclass(frozen=True, kw_only=True)
class Pace:
    """How a speed is carried out.

    Attributes:
        byte: speed byte of the messages.
        speed: of the opening that results [m/s].
        stepped: the speed is below what the byte can do, the target has to be moved on in steps.
        note: what was changed in what was asked for; empty when nothing was.
    """

    byte: int
    speed: float
    stepped: bool = False
    note: str = ""


def is_number(value: object) -> bool:
    """Return whether a value is a number that is one: no truth value, no text, not NaN."""
    return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)


def check_numbers(**values: object) -> None:
    """Refuse what is no number among the values of a move, by name; None stands for a default.

    Raises:
        TargetError: a value is none.
    """
    for name, value in values.items():
        if value is not None and not is_number(value):
            raise TargetError(f"{name}: got {value!r}, expected a number; the gripper stays as it was")


class GripperScale:
    """Converts openings, speeds and forces into bytes and back.

    Args:
        settings: stroke and offset of the gripper, limit of its current.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self._settings = settings
        self._closed = settings.closed_opening
        self._stroke = settings.stroke
        self._largest_current = settings.largest_current

    @property
    def resolution(self) -> float:
        """Opening per count of the position byte [m]."""
        return self._stroke / LARGEST_BYTE

    @property
    def largest_opening(self) -> float:
        """Opening at the open stop [m]."""
        return self._settings.largest_opening

    @property
    def slowest_direct(self) -> float:
        """Slowest speed of the opening without steps [m/s]."""
        return self.speed_of(SLOWEST_BYTE)

    @property
    def fastest(self) -> float:
        """Fastest speed of the opening [m/s]."""
        return self.speed_of(LARGEST_BYTE)

    def opening_of(self, position: float) -> float:
        """Return the opening [m] of a position [counts]: closed + stroke (1 - position / 255)."""
        return self._closed + self._stroke * (1.0 - position / LARGEST_BYTE)

    def counts_of(self, opening: float) -> float:
        """Return the position [counts] of an opening [m], neither rounded nor bounded."""
        return LARGEST_BYTE * (1.0 - (opening - self._closed) / self._stroke)

    def position_of(self, opening: float) -> int:
        """Return the position byte next to an opening [m].

        Raises:
            TargetError: it is no number, or outside the stroke.
        """
        low, high = self._closed, self.largest_opening
        if not low - ROUNDING <= opening <= high + ROUNDING:
            self._settings.check_opening("opening", opening)
        return round(min(max(self.counts_of(opening), 0.0), float(LARGEST_BYTE)))

    def speed_of(self, byte: int) -> float:
        """Return the speed of the opening [m/s] of a speed byte."""
        return (SLOWEST_TICKS + byte * TICKS_SPAN // LARGEST_BYTE) * OPENING_PER_TICK

    def pace_of(self, speed: float) -> Pace:
        """Return how a speed of the opening [m/s] is carried out; the byte never gives a faster one.

        Raises:
            TargetError: it is no number, not positive, below 0.01 mm/s, or far beyond the gripper: another unit.
        """
        if not LEAST_SPEED <= speed <= MOST_EXCESS * self.fastest:
            raise TargetError(f"speed: got {speed:g} m/s, expected {LEAST_SPEED:g} to {self.fastest:.3g} m/s")
        if speed < self.slowest_direct:
            return Pace(byte=SLOWEST_BYTE, speed=speed, stepped=True)
        if speed > self.fastest:
            note = f"speed {speed:g} m/s is more than the gripper can do: {self.fastest:.3g} m/s"
            return Pace(byte=LARGEST_BYTE, speed=self.fastest, note=note)
        byte = int((speed / OPENING_PER_TICK * (1.0 + 1e-9) - SLOWEST_TICKS) * LARGEST_BYTE / TICKS_SPAN) + 1
        while self.speed_of(byte) > speed * (1.0 + 1e-9) or byte > LARGEST_BYTE:
            byte -= 1
        return Pace(byte=byte, speed=self.speed_of(byte))

    def force_of(self, current: float) -> float:
        """Return the grip force [N] of a current [A] by the maker's curve; both positive when driving closed."""
        return FORCE_PER_CURRENT * current

    def force_for(self, current: float, force: float | None) -> float:
        """Return the grip force [N] that stands for a current limit [A].

        Raises:
            TargetError: the current is no number or out of range, or a force is given beside it.
        """
        if force is not None:
            raise TargetError(f"force {force!r} N and current {current!r} A: expected one of them")
        low, high = LEAST_CURRENT, self._largest_current
        if not (is_number(current) and low - ROUNDING <= current <= high + ROUNDING):
            raise TargetError(f"current: got {current!r} A, expected {low:g} to {high:g} A")
        return self.force_of(current)

    def current_of(self, force: float) -> int:
        """Return the current limit [mA] of a grip force [N] by the maker's curve.

        Raises:
            TargetError: it is no number, or outside the range of the current limit.
        """
        low, high = self.force_of(LEAST_CURRENT), self.force_of(self._largest_current)
        if not low - ROUNDING <= force <= high + ROUNDING:
            raise TargetError(
                f"force: got {force:g} N, expected {low:.3g} to {high:.3g} N, the range of the current limit; "
                "a smaller force needs vision"
            )
        return round(1e3 * force / FORCE_PER_CURRENT)
