"""SLCAN: CAN messages as lines of the Lawicel protocol, their strict reading, and the bus behind a serial adapter.

python-can's own `slcan` is not used: it raises on a damaged line and then on every later one, ignores refusals (BELL),
shares the port with other programs, and its writes may block for ever.
"""

from __future__ import annotations

import errno
import os
import re
import select
import termios
from collections import Counter
from contextlib import suppress
from math import ceil
from time import monotonic, sleep
from typing import Any

from finforce.optional import import_library
from finforce_driver.can.protocol import Bus, CanMessage
from finforce_driver.errors import LinkError

END = b"\r"
BELL = b"\a"  # an adapter's refusal; it stands alone, no END follows
LONGEST_LINE = 64  # [bytes] more than twice the longest valid line

_LINE_ENDS = re.compile(rb"[\r\a]")
_DATA = re.compile(rb"t([0-7][0-9A-Fa-f]{2})([0-8])((?:[0-9A-Fa-f]{2})*)")
_REMOTE = re.compile(rb"r([0-7][0-9A-Fa-f]{2})[0-8]([0-9A-Fa-f]{4})?")
EXTENDED = re.compile(rb"[TR][01][0-9A-Fa-f]{7}[0-8](?:[0-9A-Fa-f]{2})*")
_ACKNOWLEDGEMENTS = (b"", b"z", b"Z")
_STAMP = 2  # [bytes] after the data, where an adapter was told to stamp what it receives


def encode_message(message: CanMessage) -> bytes:
    """Return the line that makes an adapter send a message, with its end."""
    kind = "r" if message.remote else "t"
    return f"{kind}{message.id:03X}{len(message.data)}{message.data.hex().upper()}\r".encode("ascii")


def decode_line(line: bytes, *, stamped: bool = True) -> CanMessage | None:
    """Return the message of 11-bit identifier that a line (without its end) is, None when it is not exactly one.

    Where lines may be `stamped`, a time stamp of four hex digits after the data is read over.
    """
    match = _DATA.fullmatch(line)
    if match:
        data, size = bytes.fromhex(match[3].decode("ascii")), int(match[2])
        return CanMessage(id=int(match[1], 16), data=data[:size]) if len(data) - size in (0, _STAMP * stamped) else None
    match = _REMOTE.fullmatch(line)
    return CanMessage(id=int(match[1], 16), remote=True) if match and (stamped or not match[2]) else None


class SlcanParser:
    """Finds messages in what an adapter sends, however it is cut into pieces; what is not exactly a message is counted.

    Attributes:
        unexplained: bytes since the last message that belong to no message, acknowledgement or refusal.
        refused: refusals since the last message.
        counts: lines that came: `messages`; `acknowledgements`; `bells` (refusals); `garbage` (no message
            exactly); `overlong` (no end within 64 bytes); `extended` (29-bit identifiers).
    """

    def __init__(self) -> None:
        self.unexplained = self.refused = 0
        self.counts: Counter[str] = Counter()
        self._line = bytearray()

    def feed(self, data: bytes) -> list[CanMessage]:
        """Return the messages that `data` completes; takes any bytes."""
        messages = []
        begin = 0
        for end in _LINE_ENDS.finditer(data):
            self._extend(data[begin : end.start()])
            message = self._finish(refused=end[0] == BELL)
            if message is not None:
                messages.append(message)
            begin = end.end()
        self._extend(data[begin:])
        return messages

    def discard(self) -> None:
        """Forget an unfinished line and what came since the last message, for a port opened anew; the counts stay."""
        self._line.clear()
        self.unexplained = self.refused = 0

    def _extend(self, piece: bytes) -> None:
        """Add to the line; beyond its longest only that it is too long is kept."""
        self.unexplained += len(piece)
        self._line += piece[: LONGEST_LINE + 1 - len(self._line)]

    def _finish(self, refused: bool) -> CanMessage | None:
        """Return the message of the line that ends here, if it is one, and start the next."""
        line = bytes(self._line)
        self._line.clear()
        if refused:
            self.counts["bells"] += 1
            self.refused += 1
            if not line:
                return None
        message = decode_line(line)
        if message is not None:
            kind = "messages"
            self.unexplained = self.refused = 0
        elif len(line) > LONGEST_LINE:
            kind = "overlong"
        elif line in _ACKNOWLEDGEMENTS or EXTENDED.fullmatch(line):
            kind = "acknowledgements" if line in _ACKNOWLEDGEMENTS else "extended"
            self.unexplained -= len(line)
        else:
            kind = "garbage"
        self.counts[kind] += 1
        return message


_PORT_ERRORS = (OSError, termios.error)  # pyserial passes the second one through
_SETTLE = 0.02  # [s] in which an adapter that was left open stops sending after "C"
_WRITE_TIMEOUT = 0.1  # [s] a line takes 1.4 ms on a real 115200 baud port
_CHUNK = 4096  # [bytes]
_SUSPICIOUS_BYTES = 32  # two replies' worth; an adapter's greeting is forgotten with the first message
_SUSPICIOUS_REFUSALS = 5  # one is normal: "C" on a channel that is closed


class SerialBus(Bus):
    """CAN messages through a USB-CAN adapter that speaks SLCAN, acknowledging or silent.

    The port is opened for this program alone. What the adapter answers is ignored, since many answer nothing.

    Args:
        port: path of the serial port.
        baud_rate: of the serial port [baud]; an adapter that is a USB device itself does not care.
    """

    def __init__(self, port: str, baud_rate: int = 115_200) -> None:
        super().__init__(port)
        self._baud_rate = baud_rate
        self._poll = select.poll()
        self._torn = b""  # what ends a line that went out only in part
        self._parser = SlcanParser()

    def _connect(self) -> Any:
        port = open_port(self._name, self._baud_rate)
        try:
            # the empty line ends what an earlier program left half written: no move may come of it and what we send
            write_all(port, END + b"C" + END)
            sleep(_SETTLE)
            port.reset_input_buffer()
            self._parser.discard()
            write_all(port, b"S8\rO\r")  # 1 Mbit/s
        except _PORT_ERRORS as error:
            with suppress(*_PORT_ERRORS):
                port.close()
            raise self._gone(error) from error
        self._poll = select.poll()
        self._poll.register(port.fileno(), select.POLLIN)
        return port

    def _disconnect(self, port: Any) -> None:
        try:
            write_all(port, END + b"C" + END)
        except _PORT_ERRORS:
            # else the system waits up to 30 s for an adapter that hangs to take the rest
            with suppress(*_PORT_ERRORS):
                port.reset_output_buffer()
        with suppress(*_PORT_ERRORS):
            port.close()

    def _write(self, port: Any, message: CanMessage) -> None:
        try:
            write_all(port, self._torn + encode_message(message))
        except _PORT_ERRORS as error:
            self._torn = END
            raise self._gone(error) from error
        self._torn = b""

    def _read(self, port: Any, timeout: float) -> list[CanMessage]:
        if not self._poll.poll(ceil(1e3 * timeout)):
            return []
        try:
            data = os.read(port.fileno(), _CHUNK)
        except BlockingIOError:
            return []
        except OSError as error:
            raise self._gone(error) from error
        if not data:
            raise self._gone("it reads as empty")
        return self._parser.feed(data)

    def _gone(self, cause: Exception | str) -> LinkError:
        """Return the error of a port that fails while it is open."""
        if isinstance(cause, TimeoutError):
            return LinkError(
                f"{self._name} took nothing for {_WRITE_TIMEOUT:g} s: expected an adapter that reads; "
                "unplug it and plug it in again"
            )
        return LinkError(f"{self._name} is gone ({cause}): was the adapter unplugged? plug it in, then open it again")

    @property
    def counts(self) -> Counter[str]:
        """Events since the bus was made: `opened`, `sent`, and what `SlcanParser.counts` names."""
        return self._counts + self._parser.counts

    @property
    def suspicion(self) -> str:
        """The fault of the adapter by the received bytes, with advice, in one sentence; empty: none."""
        if self._parser.unexplained >= _SUSPICIOUS_BYTES:
            return (
                f"only garbage comes from {self._name} at {self._baud_rate} baud: wrong adapter speed? set baud_rate "
                "to the adapter's, and make sure that it speaks SLCAN"
            )
        if self._parser.refused >= _SUSPICIOUS_REFUSALS:
            return (
                f"the adapter at {self._name} rejects messages (BELL): does it support 1 Mbit/s? Its queue also fills "
                "when no gripper answers: check 24 V, CANH/CANL"
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
    space = select.poll()
    space.register(descriptor, select.POLLOUT)
    while data:
        try:
            data = data[os.write(descriptor, data) :]
        except BlockingIOError:
            if not space.poll(ceil(1e3 * max(0.0, end - monotonic()))):
                raise TimeoutError("the port takes no more") from None


def open_port(path: str, baud_rate: int) -> Any:
    """Return a serial port of pyserial that is opened for this program alone.

    Raises:
        LinkError: it is absent, busy, no serial port, or may not be opened; the message says what would help.
        MissingDependencyError: pyserial is not installed.
    """
    serial = import_library("serial", "A gripper on a serial port", "pyserial")
    try:
        port = serial.Serial(path, baud_rate, timeout=0, write_timeout=_WRITE_TIMEOUT, exclusive=True)
    except (*_PORT_ERRORS, ValueError) as error:
        raise LinkError(explain_refusal(path, baud_rate, error)) from error
    # USB serial chips hold bytes back for up to 16 ms otherwise; pseudo terminals and some drivers have no such setting
    with suppress(OSError, ValueError, NotImplementedError):
        port.set_low_latency_mode(True)
    return port


def explain_refusal(path: str, baud_rate: int, error: Exception) -> str:
    """Return why a port cannot be opened and what would help, in one line."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOTDIR):
        kernel = "" if "/" in path else " A channel of the kernel, as can0, needs the interface socketcan"
        return f"there is no port {path!r}: ports here: {_name_ports()}; is the adapter plugged in?{kernel}"
    if number in (errno.EBUSY, errno.EAGAIN):
        return f"{path} is in use by another program: end that first (`fuser -v {path}` names it)"
    if number in (errno.EACCES, errno.EPERM):
        return f"no permission to open {path}: `sudo usermod -aG dialout $USER`, then log in again"
    return f"{path} is not a serial port, or knows no {baud_rate} baud ({error}): ports here: {_name_ports()}"


def _name_ports() -> str:
    """Return the serial ports of this machine with what is plugged into them, "none" without any."""
    from serial.tools import list_ports

    found = [f"{item.device} ({item.description})".removesuffix(" (n/a)") for item in sorted(list_ports.comports())]
    return ", ".join(found) or "none"
