"""The gripper's controller: CAN messages in, messages out, in steps of a millisecond; faults that it latches."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

from finforce_driver.can.protocol import CanMessage, Command, Move, decode_move, encode
from finforce_driver.errors import TargetError
from finforce_sim.emulator.control import (
    VARIANTS,
    Endpoints,
    Mode,
    MoveControl,
    find_stops,
    list_violations,
)
from finforce_sim.emulator.mechanism import STEP, Jaws

_BOOT_TIME = 0.3  # [s] of silence after a reset
_FIFO = 3  # messages that the CAN controller keeps while the firmware is busy
_ADVISED_BURST = 2


class EmulatedGripper:
    """An SSG-48 on its own clock.

    What it does follows the maker's firmware to the byte; `violations` counts what a careful driver never sends.

    Attributes:
        jaws: mechanism with the truth: opening, object, wall, load.
        protection: temperature, supply, encoder and the latched faults.
        node_id: on the CAN bus.
        mode: of the control loop.
        calibrated: True if the firmware believes in its end stops.
        configured: as a gripper; else it calibrates, but never moves nor changes its position byte.
        violations: of good practice by name.
    """

    def __init__(
        self,
        variant: str = "new",
        node_id: int = 0,
        object_opening: float | None = None,
        load: Callable[[float], float] | None = None,
    ) -> None:
        """Make a gripper that has been powered for long.

        Args:
            variant: "new" or "old" firmware.
            node_id: on the CAN bus, 0 to 15.
            object_opening: at which a rigid object stops the closing jaws [m].
            load: elastic grip force [N] of what is between the jaws at an opening [m].

        Raises:
            TargetError: there is no such variant or node.
        """
        if variant not in VARIANTS:
            raise TargetError(f"variant: got {variant!r}, expected one of {', '.join(VARIANTS)}")
        if not 0 <= node_id <= 15:
            raise TargetError(f"node_id: got {node_id!r}, expected 0 to 15")
        self.variant = variant
        self.node_id = node_id
        self.jaws = Jaws()
        self.jaws.object_opening, self.jaws.load = object_opening, load
        self.protection = _Protection()
        self.violations: Counter[str] = Counter()
        self.configured = True
        self._firmware = VARIANTS[variant]
        self._steps = self._deaf_until = 0
        self._rest = 0.0
        self._received = 0
        self._power_up()

    @property
    def now(self) -> float:
        """Return the gripper's own time [s]."""
        return self._steps * STEP

    @property
    def booting(self) -> bool:
        """Return whether it is deaf and mute because it boots."""
        return self._steps < self._deaf_until

    @property
    def faults(self) -> set[Fault]:
        """Return what is latched."""
        return self.protection.faults

    @property
    def order(self) -> Move:
        """Return the last order of five bytes."""
        return self._control.order

    @property
    def reported_current(self) -> int:
        """Return the current as it is reported [mA]."""
        return max(min(int(self.jaws.current), 0x7FFF), -0x8000)

    def step(self, dt: float = STEP) -> None:
        """Go on for `dt` [s] in whole milliseconds, keeping the rest."""
        self._rest += dt
        self._received = 0
        count = int(self._rest / STEP + 1e-6)
        self._rest -= count * STEP
        for _ in range(count):
            self._step_once()

    def handle(self, message: CanMessage) -> list[CanMessage]:
        """Take a message from the bus and return the answers."""
        if self.booting or message.node != self.node_id:
            return []
        self._received += 1
        if self._received > _ADVISED_BURST:
            self.violations["burst"] += 1
        if self._received > _FIFO:
            return []
        command = message.command
        if message.remote:
            answer = self._answer(command)
            if answer is None:
                return []
            self.protection.feed()
            return [self._send(command, answer)]
        if command == Command.MOVE:
            return [self._take_order(message)]
        self._obey(command, message.data)
        return []

    def reboot(self) -> None:
        """Reset: silence while booting, then the state after power-up; whole encoder turns are lost."""
        self._power_up()
        self.jaws.reset_encoder()
        self._deaf_until = self._steps + round(_BOOT_TIME / STEP)

    def _answer(self, command: int) -> bytes | None:
        """Return the data that answers a remote message; None where nothing does."""
        match command:
            case Command.PING:
                return b""
            case Command.TEMPERATURE:
                return struct.pack(">h", round(self.protection.temperature))
            case Command.SUPPLY:
                return struct.pack(">H", round(1000.0 * self.protection.voltage))
            case Command.ERRORS:
                return self.protection.error_bytes
            case Command.CURRENT:
                return struct.pack(">h", self.reported_current)
            case Command.ENCODER:
                return struct.pack(">ii", self.jaws.encoder, round(self.jaws.velocity))
        return None

    def _obey(self, command: int, data: bytes) -> None:
        """Do what a command says that nothing answers."""
        match command, len(data):
            case Command.ESTOP, _:
                self.faults.add(Fault.ESTOP_COMMAND)
            case Command.CLEAR, _:
                self.faults.clear()
                self.mode = Mode.IDLE
            case Command.IDLE, _:
                self.mode = Mode.IDLE
            case Command.RESET, _:
                self.reboot()
            case Command.CALIBRATE, 0:
                self.mode = Mode.CALIBRATE
            case Command.WATCHDOG, self._firmware.watchdog_length:
                self.protection.watchdog_period = int.from_bytes(data[:4], "big", signed=True)
                self.protection.feed()

    def _power_up(self) -> None:
        self.protection.restart()
        self.calibrated = False
        self.mode = Mode.IDLE
        self.endpoints = Endpoints()
        self._control = MoveControl(self._firmware)
        self._restart_calibration()
        self._position = self.endpoints.position(self.jaws.encoder) if self.configured else 0

    def _step_once(self) -> None:
        self._steps += 1
        if self.booting and self.mode is Mode.IDLE:
            self.jaws.rest()
            return
        if self.protection.step():
            self.mode = Mode.IDLE
        if self.configured:
            self._position = self.endpoints.position(self.jaws.encoder)
        if self.mode is Mode.GRIPPER:
            self._control.step(self.jaws, self.endpoints, self._position, self.calibrated and self.configured)
        elif self.mode is Mode.CALIBRATE:
            self._calibrating += 1
            finished = next(self._stops, True)
            if finished or self._calibrating >= self._firmware.calibration_timeout:
                self.calibrated = bool(finished)
                self.mode = Mode.IDLE
                self._restart_calibration()
        else:
            self.jaws.rest()

    def _restart_calibration(self) -> None:
        self._stops = find_stops(self._firmware, self.jaws, self.endpoints)
        self._calibrating = 0  # [ms], not counted anew after an abort

    def _send(self, command: int, data: bytes) -> CanMessage:
        message = encode(self.node_id, command, data)
        return replace(message, id=message.id | bool(self.faults))

    def _take_order(self, message: CanMessage) -> CanMessage:
        if len(message.data) in (0, 5):
            self.protection.feed()
        if len(message.data) == 5:
            order = decode_move(message)
            self.violations.update(list_violations(order, self._control, self.mode))
            self._control.take(order)
            self.protection.estop_flag = order.estop
            if not self.faults:
                self.mode = Mode.GRIPPER
        return self._send(Command.REPLY, self._reply())

    def _reply(self) -> bytes:
        code = self._control.object_code
        status = (
            0x80 * self.order.activated
            | 0x40 * self.order.action
            | 0x20 * (code & 1)
            | 0x10 * (code >> 1)
            | self.protection.reply_bits
            | self.calibrated
        )
        return struct.pack(">BhB", self._position, self.reported_current, status)


_COLDEST = -20.0  # [deg C], of the motor
_HOTTEST = 75.0  # [deg C], of the motor
_LEAST_SUPPLY = 9.0  # [V]
_LARGEST_SUPPLY = 29.0  # [V]


class Fault(Enum):
    """Errors that can be latched: their bits in a reply, and in the two bytes of the error state."""

    TEMPERATURE = (0x08, 0x40, 0x00)
    ENCODER = (0x00, 0x20, 0x00)
    SUPPLY = (0x00, 0x10, 0x00)
    ESTOP_COMMAND = (0x00, 0x01, 0x00)
    ESTOP_FLAG = (0x02, 0x00, 0x00)
    WATCHDOG = (0x04, 0x00, 0x20)
    MOTOR_UNCALIBRATED = (0x00, 0x00, 0x00)


@dataclass
class _Protection:
    """The environment that the firmware watches, and what it has latched.

    Attributes:
        temperature: of the motor [deg C].
        voltage: of the supply [V].
        magnet: True if the encoder sees its magnet.
        motor_calibrated: True if the motor itself was ever calibrated.
        estop_flag: of the last order; it latches its fault again and again.
        watchdog_period: longest silence [ms]; 0: any.
        faults: that are latched.
        silence: since the watchdog was fed [ms].
    """

    temperature: float = 26.0
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
        self.watchdog_period = self.silence = 0

    def step(self) -> bool:
        """Watch for one millisecond and return whether a fault is latched."""
        self.silence += 1
        if self.watchdog_period > 0 and self.silence >= self.watchdog_period:
            self.faults.add(Fault.WATCHDOG)
        if not _COLDEST <= self.temperature <= _HOTTEST:
            self.faults.add(Fault.TEMPERATURE)
        if not _LEAST_SUPPLY <= self.voltage <= _LARGEST_SUPPLY:
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
        return sum(fault.value[0] for fault in self.faults)

    @property
    def error_bytes(self) -> bytes:
        """Return the two bytes of the error state."""
        first, second = (sum(fault.value[number] for fault in self.faults) for number in (1, 2))
        return bytes([0x80 * bool(self.faults) | first, 0x80 * self.motor_calibrated | second])
