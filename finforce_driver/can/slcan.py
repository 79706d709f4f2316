"""CAN messages as lines of the SLCAN (Lawicel) protocol, and the strict reading of them."""

from __future__ import annotations

import re

from finforce_driver.can.bus import CanMessage

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
    """

    def __init__(self) -> None:
        """Start with an empty line and nothing counted."""
        self.unexplained = 0
        self.refused = 0
        self._line = bytearray()
        names = ("messages", "acknowledgements", "bells", "garbage", "overlong", "extended")
        self._counts = dict.fromkeys(names, 0)

    @property
    def counts(self) -> dict[str, int]:
        """How many lines came, by what they were.

        `messages`; `acknowledgements`; `bells` (refusals); `garbage` (no message, to the letter); `overlong` (no end
        within 64 bytes); `extended` (29-bit identifiers, which this bus has no use for).
        """
        return dict(self._counts)

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
            self._counts["bells"] += 1
            self.refused += 1
            if not line:
                return None
        message = decode_line(line)
        if message is not None:
            self._counts["messages"] += 1
            self.unexplained = self.refused = 0
        else:
            self._count_other(line)
        return message

    def _count_other(self, line: bytes) -> None:
        """Count a line that is no message."""
        if len(line) > LONGEST_LINE:
            self._counts["overlong"] += 1
        elif line in _ACKNOWLEDGEMENTS:
            self._counts["acknowledgements"] += 1
            self.unexplained -= len(line)
        elif EXTENDED.fullmatch(line):
            self._counts["extended"] += 1
            self.unexplained -= len(line)
        else:
            self._counts["garbage"] += 1
