"""What is asked for now and then: temperature, supply, errors; a value is believed when it goes on or is repeated."""

from __future__ import annotations

import math
from collections.abc import Callable

from finforce_driver.can.bus import CanMessage
from finforce_driver.can.protocol import Command, ErrorReport, decode_errors, decode_supply, decode_temperature

LARGEST_STEP = {Command.TEMPERATURE: 3.0, Command.SUPPLY: 0.5}  # [deg C], [V] between two answers, without repetition
VALUES: dict[Command, tuple[str, Callable[[CanMessage], float | ErrorReport]]] = {
    Command.TEMPERATURE: ("temperature", decode_temperature),
    Command.SUPPLY: ("voltage", decode_supply),
    Command.ERRORS: ("errors", decode_errors),
}
ORDER = tuple(VALUES)
SILENCES = 3  # at the beginning, after which an adapter or firmware is taken not to know these requests
PATIENCE = 60.0  # [s] until it is asked again


class Telemetry:
    """Asks one question per period, round robin.

    Attributes:
        temperature: of the motor [deg C]; NaN unknown.
        voltage: of the supply [V]; NaN unknown.
        errors: what is latched; None unknown.

    Args:
        period: between two questions [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.temperature = self.voltage = math.nan
        self.errors: ErrorReport | None = None
        self._doubt: dict[Command, float | ErrorReport] = {}
        self._turn = self._silences = 0
        self._answered = False
        self._next_time = -math.inf

    def ask_errors(self, now: float) -> None:
        """Ask for the errors next: one has come or gone."""
        self.errors = None
        self._doubt.pop(Command.ERRORS, None)
        self._turn = ORDER.index(Command.ERRORS)
        if self._answered or self._silences < SILENCES:
            self._next_time = now

    @property
    def next_time(self) -> float:
        """When the next question is due [s]."""
        return self._next_time

    def question(self, now: float) -> Command | None:
        """Return what to ask now, None when nothing is due."""
        return ORDER[self._turn] if now >= self._next_time else None

    def miss(self, now: float) -> None:
        """Note that a question was not answered."""
        self._silences += 1
        unknown = self._silences >= SILENCES and not self._answered
        self._next_time = now + (PATIENCE if unknown else self._period)

    def take(self, command: Command, message: CanMessage, now: float) -> None:
        """Take an answer; one that is doubted is asked for again at once."""
        self._silences, self._answered = 0, True
        if self._believe(command, message):
            self._turn = (ORDER.index(command) + 1) % len(ORDER)
            self._next_time = now + self._period

    def _believe(self, command: Command, message: CanMessage) -> bool:
        """Keep a value that goes on from the last one or repeats itself; return whether it was kept."""
        name, decode = VALUES[command]
        value = decode(message)
        known = any(_goes_on(command, value, other) for other in (getattr(self, name), self._doubt.get(command)))
        self._doubt[command] = value
        if known:
            setattr(self, name, value)
            self._doubt.pop(command)
        return known


def _goes_on(command: Command, value: float | ErrorReport, other: float | ErrorReport | None) -> bool:
    """Return whether a value needs no repetition after another one."""
    if other is None or command is Command.ERRORS:
        return value == other
    return abs(value - other) <= LARGEST_STEP[command]
