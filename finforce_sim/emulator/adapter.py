"""A USB-CAN adapter that speaks SLCAN, with a gripper on its bus."""

from __future__ import annotations

import re
from collections import Counter, deque

from finforce_driver.can.protocol import CanMessage
from finforce_driver.can.slcan import BELL, END, EXTENDED, LONGEST_LINE, decode_line, encode_message
from finforce_driver.errors import TargetError
from finforce_sim.emulator.firmware import EmulatedGripper

ACK_MODES = ("none", "lawicel")
_RATE = re.compile(r"S[0-8]|s[0-9A-Fa-f]{4,}")


class EmulatedAdapter:
    """The adapter on its own clock: bytes of the host in, bytes for the host out.

    Attributes:
        gripper: on the bus.
        latency: from a message on the bus to its line at the host [s].
        counts: lines that were no command, messages sent, messages refused, messages lost to a wrong bit rate.
    """

    def __init__(self, gripper: EmulatedGripper, ack_mode: str = "none", latency: float = 0.0005) -> None:
        """Make an adapter whose channel is closed.

        Args:
            gripper: on the bus.
            ack_mode: "none" stays silent as CANable does, "lawicel" answers every line.
            latency: from a message on the bus to its line at the host [s].

        Raises:
            TargetError: there is no such mode.
        """
        if ack_mode not in ACK_MODES:
            raise TargetError(f"ack_mode: got {ack_mode!r}, expected one of {', '.join(ACK_MODES)}")
        self.gripper, self.latency = gripper, latency
        self.counts: Counter[str] = Counter()
        self.now = 0.0
        self._acknowledges = ack_mode == "lawicel"
        self._opened, self._rate, self._line = False, "", bytearray()
        self._output: deque[tuple[float, bytes]] = deque()

    @property
    def joined(self) -> bool:
        """Return whether the channel is open at the gripper's bit rate."""
        return self._opened and self._rate == "S8"

    @property
    def has_output(self) -> bool:
        """Return whether bytes wait for the host, also such that are not due yet."""
        return bool(self._output)

    def write(self, data: bytes) -> None:
        """Take bytes from the host."""
        for byte in data:
            if byte == END[0]:
                self._take_line(bytes(self._line).decode("latin-1"))
                self._line.clear()
            elif len(self._line) < LONGEST_LINE:
                self._line.append(byte)

    def read(self) -> bytes:
        """Return the bytes for the host that are due."""
        due = bytearray()
        while self._output and self._output[0][0] <= self.now + 1e-9:
            due += self._output.popleft()[1]
        return bytes(due)

    def step(self, dt: float) -> None:
        """Let `dt` [s] pass for the adapter and the gripper."""
        self.now += dt
        self.gripper.step(dt)

    def deliver(self, message: CanMessage) -> None:
        """Send a message from the bus to the host, if the channel is open."""
        if self.joined:
            self._output.append((self.now + self.latency, encode_message(message)))

    def _take_line(self, line: str) -> None:
        if not line:
            return
        if line[0] in "trTR":
            self._transmit(line)
        elif line in ("O", "C"):
            self._obey(self._opened != (line == "O"))
            self._opened = line == "O"
        elif _RATE.fullmatch(line):
            self._rate = self._rate if self._opened else line
            self._obey(not self._opened)
        else:
            self._refuse("garbage")

    def _transmit(self, line: str) -> None:
        raw = line.encode("latin-1")
        message = decode_line(raw, stamped=False)
        if message is None and not EXTENDED.fullmatch(raw):
            self._refuse("garbage")
        elif not self._opened:
            self._refuse("refused")
        else:
            self._say(b"z" if line[0] in "tr" else b"Z")
            if message is None:  # the firmware would misread a long identifier; what it reads is not known
                self.gripper.violations["long identifier"] += 1
            elif not self.joined:
                self.counts["wrong bit rate"] += 1
            else:
                self.counts["messages"] += 1
                for answer in self.gripper.handle(message):
                    self.deliver(answer)

    def _obey(self, possible: bool) -> None:
        """Acknowledge a command, or refuse one that the channel's state does not allow."""
        if possible:
            self._say(b"")
        else:
            self._refuse("refused")

    def _say(self, word: bytes) -> None:
        if self._acknowledges:
            self._output.append((self.now, word + END))

    def _refuse(self, name: str) -> None:
        self.counts[name] += 1
        if self._acknowledges:
            self._output.append((self.now, BELL))
