"""The CAN bus behind an SLCAN adapter on a serial port, with what helps when the port fails."""

from __future__ import annotations

import errno
import os
import select
import termios
from collections import deque
from contextlib import suppress
from math import ceil
from threading import Lock
from time import monotonic, sleep
from types import ModuleType
from typing import Any

from finforce.optional import import_library
from finforce_driver.can.bus import Bus, CanMessage
from finforce_driver.can.slcan import END, SlcanParser, encode_message
from finforce_driver.errors import LinkError, TargetError

BIT_RATES = {10_000: 0, 20_000: 1, 50_000: 2, 100_000: 3, 125_000: 4, 250_000: 5, 500_000: 6, 800_000: 7, 1_000_000: 8}

_PORT_ERRORS = (OSError, termios.error)  # pyserial passes the second one through
_SETTLE = 0.02  # [s] in which an adapter that was left open stops sending after "C"
_WRITE_TIMEOUT = 0.1  # [s] a line takes 1.4 ms on a real 115200 baud port
_CHUNK = 4096  # [bytes]
_SUSPICIOUS_BYTES = 32  # two replies' worth; an adapter's greeting is forgotten with the first message
_SUSPICIOUS_REFUSALS = 5  # one is normal: "C" on a channel that is closed


class SerialBus(Bus):
    """CAN messages through a USB-CAN adapter that speaks SLCAN, acknowledging or silent.

    `send` may be called from any thread while another one waits in `receive`.
    """

    def __init__(self, port: str, baud_rate: int = 115_200, bit_rate: int = 1_000_000) -> None:
        """Remember what to open; nothing is opened yet.

        Args:
            port: path of the serial port.
            baud_rate: of the serial port [baud]; an adapter that is a USB device itself does not care.
            bit_rate: of the CAN bus [bit/s]; the gripper's is 1,000,000.

        Raises:
            TargetError: a rate is none that ports or SLCAN know.
        """
        if not baud_rate > 0:
            raise TargetError(f"baud_rate: got {baud_rate!r}, expected a positive number, 115200 for most adapters")
        if bit_rate not in BIT_RATES:
            known = ", ".join(f"{rate:,}" for rate in BIT_RATES)
            raise TargetError(f"bit_rate: got {bit_rate!r}, expected one of {known} bit/s (the gripper's is 1,000,000)")
        self._port, self._baud_rate, self._bit_rate = port, baud_rate, bit_rate
        self._serial: Any = None
        self._poll = select.poll()
        self._torn = b""  # what ends a line that went out only in part
        self._parser = SlcanParser()
        self._messages: deque[CanMessage] = deque()
        self._reading, self._writing = Lock(), Lock()
        self._counts = {"opened": 0, "sent": 0}

    def open(self) -> None:
        """Open the port for this program alone and the adapter's channel; a port that is open is opened anew.

        What the adapter answers is ignored, since many answer nothing.

        Raises:
            LinkError: the port is absent, busy, no serial port, may not be opened, or goes while it is opened.
            MissingDependencyError: pyserial is not installed.
        """
        self.close()
        port = open_port(self._port, self._baud_rate)
        with self._reading, self._writing:
            self._serial = port
            try:
                self._join()
            except _PORT_ERRORS as error:
                self._drop()
                raise self._gone(error) from error
            self._poll = select.poll()
            self._poll.register(port.fileno(), select.POLLIN)
            self._counts["opened"] += 1

    def _join(self) -> None:
        """Take the adapter from any state onto the bus, and forget what it had received before."""
        # the empty line ends what an earlier program left half written: no move may come of it and a letter of ours
        write_all(self._serial, END + b"C" + END)
        sleep(_SETTLE)
        self._serial.reset_input_buffer()
        self._parser.discard()
        self._messages.clear()
        write_all(self._serial, b"S%d\rO\r" % BIT_RATES[self._bit_rate])

    def close(self) -> None:
        """Leave the bus and close the port, also one that is gone; a `receive` under way ends first."""
        with self._reading, self._writing:
            if self._serial is not None:
                try:
                    write_all(self._serial, END + b"C" + END)
                except _PORT_ERRORS:
                    # else the system waits up to 30 s for an adapter that hangs to take the rest
                    with suppress(*_PORT_ERRORS):
                        self._serial.reset_output_buffer()
                self._drop()

    def _drop(self) -> None:
        """Close the port, whatever state it is in."""
        with suppress(*_PORT_ERRORS):
            self._serial.close()
        self._serial = None
        self._messages.clear()

    def send(self, message: CanMessage) -> None:
        """Write a message's line, whole, at once.

        Raises:
            LinkError: the port is closed or gone, or the adapter takes nothing.
        """
        line = encode_message(message)
        with self._writing:
            port = self._opened()
            try:
                write_all(port, self._torn + line)
            except _PORT_ERRORS as error:
                self._torn = END
                raise self._gone(error) from error
            self._torn = b""
            self._counts["sent"] += 1

    def receive(self, timeout: float) -> CanMessage | None:
        """Return the next message as soon as its last byte is there, None when none came within `timeout` [s].

        Raises:
            LinkError: the port is closed or gone.
        """
        end = monotonic() + timeout
        with self._reading:
            while not self._messages:
                port = self._opened()
                left = max(0.0, end - monotonic())
                if not self._poll.poll(ceil(1e3 * left)):
                    return None
                self._messages.extend(self._parser.feed(self._read(port)))
                if not self._messages and left == 0.0:
                    return None
            return self._messages.popleft()

    def _read(self, port: Any) -> bytes:
        """Return what has come; the port is known to have something, or to be gone."""
        try:
            data = os.read(port.fileno(), _CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._gone(error) from error
        if not data:
            raise self._gone("it reads as empty")
        return data

    def _opened(self) -> Any:
        """Return the open port."""
        if self._serial is None:
            raise LinkError(f"{self._port} is not open: expected open() first")
        return self._serial

    def _gone(self, cause: Exception | str) -> LinkError:
        """Return the error of a port that fails while it is open."""
        if isinstance(cause, TimeoutError):
            return LinkError(
                f"{self._port} took nothing for {_WRITE_TIMEOUT:g} s: expected an adapter that reads; "
                "unplug it and plug it in again"
            )
        return LinkError(f"{self._port} is gone ({cause}): was the adapter unplugged? plug it in, then open it again")

    @property
    def counts(self) -> dict[str, int]:
        """Events since the bus was made: `opened`, `sent`, and what `SlcanParser.counts` names."""
        return {**self._counts, **self._parser.counts}

    @property
    def suspicion(self) -> str:
        """What the received bytes say is wrong with the adapter, with advice, in one sentence; empty: nothing."""
        if self._parser.unexplained >= _SUSPICIOUS_BYTES:
            return (
                f"only garbage comes from {self._port} at {self._baud_rate} baud: wrong adapter speed? set baud_rate "
                "to the adapter's, and make sure that it speaks SLCAN"
            )
        if self._parser.refused >= _SUSPICIOUS_REFUSALS:
            return (
                f"the adapter at {self._port} refuses what is sent (BELL): does it know "
                f"{self._bit_rate:,} bit/s? its queue also fills when no gripper listens: check 24 V, CANH/CANL"
            )
        return ""


def write_all(port: Any, data: bytes) -> None:
    """Write bytes to an open port of pyserial, whole.

    pyserial's own `write` fails on a machine that was busy for longer than the time-out, even if all bytes are out.

    Raises:
        TimeoutError: the port has not taken all of them in time.
        OSError: it is gone.
    """
    end, descriptor = monotonic() + _WRITE_TIMEOUT, port.fileno()
    room = select.poll()
    room.register(descriptor, select.POLLOUT)
    while data:
        try:
            data = data[os.write(descriptor, data) :]
        except BlockingIOError:
            if not room.poll(ceil(1e3 * max(0.0, end - monotonic()))):
                raise TimeoutError("the port takes no more") from None


def open_port(path: str, baud_rate: int) -> Any:
    """Return a serial port of pyserial that is opened for this program alone.

    Raises:
        LinkError: it is absent, busy, no serial port, or may not be opened; the message says what would help.
        MissingDependencyError: pyserial is not installed.
    """
    serial = _import_serial()
    try:
        port = serial.Serial(path, baud_rate, timeout=0, write_timeout=_WRITE_TIMEOUT, exclusive=True)
    except (*_PORT_ERRORS, ValueError) as error:
        raise LinkError(explain_refusal(path, baud_rate, error)) from error
    # USB serial chips hold bytes back for up to 16 ms otherwise; pseudo terminals and some drivers have no such setting
    with suppress(OSError, ValueError, NotImplementedError):
        port.set_low_latency_mode(True)
    return port


def _import_serial() -> ModuleType:
    """Return pyserial."""
    return import_library("serial", "A gripper on a serial port", "pyserial")


def explain_refusal(path: str, baud_rate: int, error: Exception) -> str:
    """Return why a port cannot be opened and what would help, in one line."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOTDIR):
        return f"there is no port {path!r}: ports here: {name_ports()}; is the adapter plugged in?"
    if number in (errno.EBUSY, errno.EAGAIN):
        return f"{path} is in use by another program: end that first (`fuser -v {path}` names it)"
    if number in (errno.EACCES, errno.EPERM):
        return f"no permission to open {path}: `sudo usermod -aG dialout $USER`, then log in again"
    return f"{path} is no serial port, or knows no {baud_rate} baud ({error}): ports here: {name_ports()}"


def name_ports() -> str:
    """Return the serial ports of this machine with what is plugged into them, "none" without any."""
    from serial.tools import list_ports

    found = [f"{item.device} ({item.description})".removesuffix(" (n/a)") for item in sorted(list_ports.comports())]
    return ", ".join(found) or "none"
