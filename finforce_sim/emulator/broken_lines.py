"""Ways in which an adapter's line for a message can go wrong."""

from __future__ import annotations

from random import Random

Pieces = list[tuple[float, bytes]]  # delays after the piece before [s], and what then comes

_DIGITS = b"0123456789ABCDEF"


def lose(_line: bytes, _random: Random) -> Pieces:
    """Return nothing."""
    return []


def delay(line: bytes, random: Random) -> Pieces:
    """Return the line, late by up to 120 ms, longer than drivers wait."""
    return [(random.uniform(0.005, 0.12), line)]


def double(line: bytes, _random: Random) -> Pieces:
    """Return the line twice."""
    return [(0.0, line + line)]


def refuse(line: bytes, _random: Random) -> Pieces:
    """Return the line after a BELL."""
    return [(0.0, b"\a" + line)]


def split(line: bytes, random: Random) -> Pieces:
    """Return the line in two pieces, up to 20 ms apart."""
    cut = random.randrange(1, len(line))
    return [(0.0, line[:cut]), (random.uniform(0.001, 0.02), line[cut:])]


def litter(line: bytes, random: Random) -> Pieces:
    """Return the line after random bytes, of which at least one is no ASCII."""
    return [(0.0, random.randbytes(random.randrange(1, 40)) + b"\xff" + random.choice((b"", b"\r")) + line)]


def truncate(line: bytes, random: Random) -> Pieces:
    """Return the beginning of the line, with or without its end."""
    return [(0.0, line[: random.randrange(1, len(line) - 1)] + random.choice((b"", b"\r")))]


def change_length(line: bytes, random: Random) -> Pieces:
    """Return a sound line of another number of data bytes."""
    length = random.choice([size for size in range(9) if size != int(line[4:5])])
    data = (line[5:-1] + b"00" * 8)[: 2 * length]
    return [(0.0, line[:4] + b"%d" % length + data + b"\r")]


def intersperse_foreign(line: bytes, random: Random) -> Pieces:
    """Return the line after the reply of another node."""
    node = int(line[1:4], 16) >> 7
    other = random.choice([number for number in range(16) if number != node])
    return [(0.0, b"t%03X4%s\r" % (other << 7 | 0x78, random.randbytes(4).hex().upper().encode()) + line)]


def intersperse_heartbeat(line: bytes, _random: Random) -> Pieces:
    """Return the line after a heartbeat of the same node."""
    return [(0.0, b"t%03X0\r" % (int(line[1:4], 16) & 0x780 | 0x12) + line)]


def flip(line: bytes, random: Random) -> Pieces:
    """Return the line with one hex digit turned into another one: a sound line that lies."""
    place = random.randrange(1, len(line) - 1)
    digit = random.choice([digit for digit in _DIGITS if digit != line[place]])
    return [(0.0, line[:place] + bytes([digit]) + line[place + 1 :])]


def set_stale_code(line: bytes, _random: Random) -> Pieces:
    """Return a reply whose object code says at position, as it can right after a command."""
    if len(line) < 14:
        return [(0.0, line)]
    return [(0.0, line[:11] + b"%02X" % (int(line[11:13], 16) | 0x30) + line[13:])]
