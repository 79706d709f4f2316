"""The CAN bus behind any interface that python-can knows, SocketCAN for one."""

from __future__ import annotations

import re
from contextlib import suppress
from threading import Lock
from time import monotonic
from types import ModuleType
from typing import Any

from finforce.errors import MissingDependencyError
from finforce.optional import import_library
from finforce_driver.can.bus import LARGEST_DATA, LARGEST_ID, Bus, Frame
from finforce_driver.errors import LinkError

_OLDEST = (4, 3)  # as Ubuntu 24.04 has it; earlier ones raise what their documentation does not name
_BROKEN = (4, 6, 0)  # its slcan cannot open: "invalid data bitrate"
_SLEEP_AFTER_OPEN = 0.1  # [s] python-can waits 2 s otherwise
_FAILURES = 5  # in a row; single ones are garbled lines
_ADVICE = {
    "socketcan": "`sudo ip link set {channel} up type can bitrate {bit_rate}`; if it is up, check 24 V and CANH/CANL",
    "slcan": "check that the adapter is plugged in and that no other program has it",
}


class PythonCanBus(Bus):
    """CAN frames through an interface of python-can, whose errors become ours.

    `send` may be called from any thread while another one waits in `receive`.
    """

    def __init__(self, interface: str, channel: str, bit_rate: int = 1_000_000) -> None:
        """Remember what to open; nothing is opened yet.

        Args:
            interface: python-can's name of it: "socketcan", "slcan", "virtual", ...
            channel: python-can's name of the port, "can0" for one.
            bit_rate: of the CAN bus [bit/s], where the interface sets it; the gripper's is 1,000,000.
        """
        self._interface, self._channel, self._bit_rate = interface, channel, bit_rate
        self._can: Any = None
        self._bus: Any = None
        self._errors: tuple[type[Exception], ...] = ()
        self._failures = 0
        self._reading, self._writing = Lock(), Lock()
        self._counts = dict.fromkeys(("opened", "sent", "frames", "garbage", "extended", "bus_errors"), 0)

    def open(self) -> None:
        """Open the interface; one that is open is opened anew.

        Raises:
            LinkError: the interface does not exist or cannot be opened.
            MissingDependencyError: python-can is absent or of a version that does not work.
        """
        self.close()
        self._can = can = _import_can()
        # what its interfaces raise: their own, and those of parsers and of the system
        self._errors = (can.CanError, ValueError, IndexError, OSError)
        extra = {"sleep_after_open": _SLEEP_AFTER_OPEN} if self._interface == "slcan" else {}
        with self._reading, self._writing:
            try:
                self._bus = can.Bus(interface=self._interface, channel=self._channel, bitrate=self._bit_rate, **extra)
            except (*self._errors, TypeError, ImportError) as error:
                raise LinkError(self._explain(error)) from error
            self._failures = 0
            self._counts["opened"] += 1

    def close(self) -> None:
        """Leave the bus, also one that is gone; a `receive` under way ends first."""
        with self._reading, self._writing:
            if self._bus is not None:
                # the interfaces raise all sorts of things when their port is gone
                with suppress(Exception):
                    self._bus.shutdown()
                self._bus = None

    def send(self, frame: Frame) -> None:
        """Put a frame on the way.

        Raises:
            LinkError: the bus is closed or gone, or took nothing for 0.1 s.
        """
        with self._writing:
            bus = self._opened()
            message = self._can.Message(
                arbitration_id=frame.id, data=frame.data, is_remote_frame=frame.remote, is_extended_id=False
            )
            try:
                bus.send(message, timeout=0.1)
            except self._errors as error:
                raise LinkError(self._explain(error)) from error
            self._counts["sent"] += 1

    def receive(self, timeout: float) -> Frame | None:
        """Return the next frame, None when none came within `timeout` [s].

        A single failure of the interface is a garbled line: it is counted, and what the interface holds is flushed.

        Raises:
            LinkError: the bus is closed or gone, or failed five times in a row.
        """
        end = monotonic() + timeout
        with self._reading:
            while True:
                left = max(0.0, end - monotonic())
                frame = self._receive_one(left)
                if frame is not None or left == 0.0:
                    return frame

    def _receive_one(self, timeout: float) -> Frame | None:
        """Return the next message as a frame; None when there is none, or it is of no use."""
        bus = self._opened()
        try:
            message = bus.recv(timeout)
        except self._errors as error:
            self._recover(bus, error)
            return None
        if message is None:
            return None
        frame = self._frame_of(message)
        if frame is not None:
            self._failures = 0
            self._counts["frames"] += 1
        return frame

    def _recover(self, bus: Any, error: Exception) -> None:
        """Flush what an interface stumbled over, else every later frame fails, too."""
        self._counts["garbage"] += 1
        self._failures += 1
        # only serial interfaces have what can be flushed; on others an error is the bus's
        if self._failures >= _FAILURES or not hasattr(bus, "flush"):
            raise LinkError(self._explain(error)) from error
        try:
            bus.flush()
        except Exception as failure:
            raise LinkError(self._explain(failure)) from failure

    def _frame_of(self, message: Any) -> Frame | None:
        """Return a message as a frame; None when it is none of ours, which is counted."""
        if message.is_error_frame:
            self._counts["bus_errors"] += 1
        elif message.is_extended_id:
            self._counts["extended"] += 1
        elif _is_sound(message):
            return Frame(id=message.arbitration_id, data=bytes(message.data or b""), remote=message.is_remote_frame)
        else:
            self._counts["garbage"] += 1
        return None

    def _opened(self) -> Any:
        """Return the open bus."""
        if self._bus is None:
            raise LinkError(f"{self._interface} {self._channel} is not open: expected open() first")
        return self._bus

    def _explain(self, error: Exception) -> str:
        """Return what failed and what would help, in one line."""
        fallback = "check interface, channel and cables"
        advice = _ADVICE.get(self._interface, fallback).format(channel=self._channel, bit_rate=self._bit_rate)
        return f"CAN interface {self._interface} {self._channel}: {' '.join(str(error).split())}: {advice}"

    @property
    def counts(self) -> dict[str, int]:
        """Events since the bus was made.

        `opened`; `sent`; `frames`; `garbage` (failures of the interface, and frames whose length is wrong); `extended`
        (29-bit identifiers); `bus_errors` (error frames).
        """
        return dict(self._counts)

    @property
    def suspicion(self) -> str:
        """What the received frames say is wrong with the bus, with advice, in one sentence; empty: nothing."""
        if self._counts["bus_errors"] and not self._counts["frames"]:
            return (
                f"CAN interface {self._interface} {self._channel} reports only errors: check 24 V, CANH/CANL, "
                f"termination, and that the bus runs at {self._bit_rate:,} bit/s"
            )
        return ""


def _is_sound(message: Any) -> bool:
    """Return whether a message of python-can is a classic frame as long as it says."""
    size = len(message.data or b"")
    whole = size == message.dlc <= LARGEST_DATA or (message.is_remote_frame and size == 0)
    return whole and not message.is_fd and 0 <= message.arbitration_id <= LARGEST_ID


def _import_can() -> ModuleType:
    """Return python-can, of a version that works."""
    can = import_library("can", "This CAN interface", "python-can")
    check_version(can.__version__)
    return can


def check_version(version: str) -> None:
    """Refuse versions of python-can that are known not to work.

    Raises:
        MissingDependencyError: the version is one of them; the message names one that works.
    """
    numbers = tuple(int(word) for word in re.findall(r"\d+", version)[:3])
    if numbers < _OLDEST or numbers == _BROKEN:
        raise MissingDependencyError(
            f"python-can {version} does not work here: expected 4.3 or later, not 4.6.0: "
            "pip install 'python-can>=4.3,!=4.6.0'"
        )
