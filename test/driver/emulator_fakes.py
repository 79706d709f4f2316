"""A host that talks to an emulated gripper message by message, without any driver."""

from finforce_driver.can.bus import CanMessage
from finforce_driver.can.slcan import decode_line, encode_message
from finforce_driver.emulator.adapter import EmulatedAdapter
from finforce_driver.emulator.firmware import EmulatedGripper

VARIANTS = ("new", "old")
CLEAR, ESTOP, IDLE, RESET, CALIBRATE = "t0020", "t0000", "t0180", "t01C0", "t07C0"


class Host:
    """CanMessages in, messages out, in the gripper's own time."""

    def __init__(self, *arguments, **named):
        self.gripper = EmulatedGripper(*arguments, **named)

    def ask(self, line: str) -> list[str]:
        """Return the answers to a line of SLCAN, as such lines, a message's way of 0.2 ms later or not at all."""
        return [encode_message(answer)[:-1].decode() for answer in self.gripper.handle(decode_line(line.encode()))]

    def tell(self, *lines: str) -> None:
        """Send lines that nothing answers, a step apart."""
        for line in lines:
            assert self.ask(line) == []
            self.gripper.step()

    def poll(self) -> bytes:
        """Return the data of a reply to an empty request."""
        self.gripper.step()
        return self.gripper.handle(CanMessage(id=self.gripper.node_id << 7 | 0x7A))[0].data

    def order(self, position=0, speed=50, current=500, flags=0xC0) -> bytes:
        """Send five bytes and return the data of the reply."""
        data = bytes([position, speed]) + current.to_bytes(2, "big", signed=True) + bytes([flags])
        self.gripper.step()
        return self.gripper.handle(CanMessage(id=self.gripper.node_id << 7 | 0x7A, data=data))[0].data

    def wait(self, seconds: float) -> None:
        self.gripper.step(seconds)

    def calibrate(self) -> None:
        self.tell(CALIBRATE)
        self.wait(4.0)
        assert self.poll()[3] & 1


def calibrated_host(variant="new", **named) -> Host:
    """Return a host of a gripper that was calibrated on empty jaws and then got its object."""
    load, opening = named.pop("load", None), named.pop("object_opening", None)
    host = Host(variant, **named)
    host.calibrate()
    host.order(0, 255, 500)
    host.wait(1.0)
    host.gripper.jaws.load, host.gripper.jaws.object_opening = load, opening
    return host


def current_of(reply: bytes) -> int:
    """Return the current in a reply [mA]."""
    return int.from_bytes(reply[1:3], "big", signed=True)


def code_of(reply: bytes) -> int:
    """Return the wire bits of the object code in a reply."""
    return reply[3] & 0x30


class LineHost:
    """Bytes in, bytes out, through an emulated adapter."""

    def __init__(self, *grippers, ack_mode="none", opened=True):
        self.adapter = EmulatedAdapter(grippers or EmulatedGripper(), ack_mode, latency=0.0)
        if opened:
            self.say(b"C\rS8\rO\r")

    def say(self, data: bytes) -> bytes:
        """Return what the adapter says within a millisecond."""
        self.adapter.write(data)
        self.adapter.step(0.001)
        return self.adapter.read()
