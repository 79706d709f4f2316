"""The CAN bus behind any interface that python-can knows, SocketCAN for one; SLCAN adapters are `SerialBus`'s."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from finforce.errors import one_line
from finforce.optional import import_library
from finforce_driver.can.protocol import LARGEST_DATA, LARGEST_ID, Bus, CanMessage
from finforce_driver.errors import LinkError

BIT_RATE = 1_000_000  # [bit/s] of the gripper, where the interface sets it
_ADVICE = {
    "socketcan": "`sudo ip link set {channel} up type can bitrate {bit_rate}`; if it is up, check 24 V and CANH/CANL"
}


class PythonCanBus(Bus):
    """CAN messages through an interface of python-can, whose errors become ours.

    Args:
        interface: python-can's name of it: "socketcan", "gs_usb", "virtual", ...
        channel: python-can's name of the port, "can0" for one.
    """

    def __init__(self, interface: str, channel: str) -> None:
        super().__init__(f"{interface} {channel}")
        self._interface, self._channel = interface, channel
        self._can: Any = None
        self._errors: tuple[type[Exception], ...] = ()

    def _connect(self) -> Any:
        self._can = can = import_library("can", "This CAN interface", "python-can")
        # what its interfaces raise: their own, and those of parsers and of the system
        self._errors = (can.CanError, ValueError, IndexError, OSError)
        try:
            return can.Bus(interface=self._interface, channel=self._channel, bitrate=BIT_RATE)
        except (*self._errors, TypeError, ImportError) as error:
            raise LinkError(self._explain(error)) from error

    def _disconnect(self, port: Any) -> None:
        # the interfaces raise all sorts of things when their port is gone
        with suppress(Exception):
            port.shutdown()

    def _write(self, port: Any, message: CanMessage) -> None:
        sent = self._can.Message(
            arbitration_id=message.id, data=message.data, is_remote_frame=message.remote, is_extended_id=False
        )
        try:
            port.send(sent, timeout=0.1)
        except self._errors as error:
            raise LinkError(self._explain(error)) from error

    def _read(self, port: Any, timeout: float) -> list[CanMessage]:
        try:
            received = port.recv(timeout)
        except self._errors as error:
            raise LinkError(self._explain(error)) from error
        message = None if received is None else self._accept(received)
        return [] if message is None else [message]

    def _accept(self, received: Any) -> CanMessage | None:
        """Return a message of python-can as ours; None when it is none, which is counted by what it is."""
        data = bytes(received.data or b"")
        whole = len(data) == received.dlc <= LARGEST_DATA or (received.is_remote_frame and not data)
        kind, message = "messages", None
        if received.is_error_frame:
            kind = "bus_errors"
        elif received.is_extended_id:
            kind = "extended"
        elif not whole or received.is_fd or not 0 <= received.arbitration_id <= LARGEST_ID:
            kind = "garbage"
        else:
            message = CanMessage(id=received.arbitration_id, data=data, remote=received.is_remote_frame)
        self._counts[kind] += 1
        return message

    def _explain(self, error: Exception) -> str:
        """Return what failed and what would help, in one line."""
        fallback = "check interface, channel and cables"
        advice = _ADVICE.get(self._interface, fallback).format(channel=self._channel, bit_rate=BIT_RATE)
        return f"CAN interface {self._interface} {self._channel}: {one_line(error)}: {advice}"

    @property
    def suspicion(self) -> str:
        """The fault of the bus by the received messages, with advice, in one sentence; empty: none."""
        if self._counts["bus_errors"] and not self._counts["messages"]:
            return (
                f"CAN interface {self._interface} {self._channel} reports only errors: check 24 V, CANH/CANL, "
                f"termination, and that the bus runs at {BIT_RATE:,} bit/s"
            )
        return ""
