"""Faults that the firmware latches, and its watchdog."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

_COLDEST, _HOTTEST = -20.0, 75.0  # [deg C] of the motor
_LEAST_SUPPLY = 9.0  # [V]


class Fault(Enum):
    """What can be latched."""

    TEMPERATURE = "temperature"
    ENCODER = "encoder"
    SUPPLY = "supply"
    ESTOP_COMMAND = "estop command"
    ESTOP_FLAG = "estop flag"
    WATCHDOG = "watchdog"
    MOTOR_UNCALIBRATED = "motor uncalibrated"


_FIRST_BYTE = {Fault.TEMPERATURE: 0x40, Fault.ENCODER: 0x20, Fault.SUPPLY: 0x10, Fault.ESTOP_COMMAND: 0x01}


@dataclass
class Protection:
    """The environment that the firmware watches, and what it has latched.

    Attributes:
        supply_limit: above which the supply is a fault [V].
        temperature: of the motor [deg C].
        thermistor: whether it is enabled; else the firmware says 23 deg C and watches nothing.
        voltage: of the supply [V].
        magnet: whether the encoder sees its magnet.
        motor_calibrated: whether the motor itself was ever calibrated.
        estop_flag: of the last order; it latches its fault again and again.
        watchdog_period: longest silence [ms]; 0: any.
        faults: that are latched.
    """

    supply_limit: float
    temperature: float = 26.0
    thermistor: bool = True
    voltage: float = 24.0
    magnet: bool = True
    motor_calibrated: bool = True
    estop_flag: bool = False
    watchdog_period: int = 0
    faults: set[Fault] = field(default_factory=set)
    silence: int = 0

    def feed(self) -> None:
        """Restart the watchdog."""
        self.silence = 0

    def restart(self) -> None:
        """Forget what does not outlive a reset."""
        self.faults = set()
        self.estop_flag = False
        self.silence = 0

    def step(self) -> bool:
        """Watch for one millisecond and return whether a fault is latched."""
        self.silence += 1
        if self.watchdog_period > 0 and self.silence >= self.watchdog_period:
            self.faults.add(Fault.WATCHDOG)
        if self.thermistor and not _COLDEST <= self.temperature <= _HOTTEST:
            self.faults.add(Fault.TEMPERATURE)
        if not _LEAST_SUPPLY <= self.voltage <= self.supply_limit:
            self.faults.add(Fault.SUPPLY)
        if not self.magnet:
            self.faults.add(Fault.ENCODER)
        if self.estop_flag:
            self.faults.add(Fault.ESTOP_FLAG)
        if not self.motor_calibrated:
            self.faults.add(Fault.MOTOR_UNCALIBRATED)
        return bool(self.faults)

    @property
    def reply_bits(self) -> int:
        """Return the fault bits of the gripper's reply."""
        faults = self.faults
        return (
            0x08 * (Fault.TEMPERATURE in faults)
            | 0x04 * (Fault.WATCHDOG in faults)
            | 0x02 * (Fault.ESTOP_FLAG in faults)
        )

    @property
    def error_bytes(self) -> bytes:
        """Return the two bytes of the error state."""
        first = 0x80 * bool(self.faults)
        for fault in self.faults:
            first |= _FIRST_BYTE.get(fault, 0)
        return bytes([first, 0x80 * self.motor_calibrated | 0x20 * (Fault.WATCHDOG in self.faults)])

    @property
    def reported_temperature(self) -> int:
        """Return what the firmware says of the temperature [deg C]."""
        return round(self.temperature) if self.thermistor else 23
