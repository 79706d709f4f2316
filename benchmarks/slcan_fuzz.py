"""A million lines of rubbish and damaged messages through the reader of SLCAN lines; table and JSON.

    python benchmarks/slcan_fuzz.py [--json report/slcan_fuzz.json] [--lines 1000000] [--seed 1]

What is a message is decided a second time here, letter by letter and without the reader's patterns. A false message is
one that the reader finds and this does not. `hypothesis` adds streams of its own where it is installed.
"""

from __future__ import annotations

import argparse
import random
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from tqdm import tqdm

from finforce_driver.can.bus import CanMessage
from finforce_driver.can.slcan import LONGEST_LINE, SlcanParser, encode_message
from finforce_eval.evaluation.machine import describe_machine, write_figures

BATCH = 500  # lines that are fed as one stream, in pieces
LARGEST_PIECE = 200  # [bytes]
EXAMPLES = 2000  # streams of hypothesis
TIMED = 20_000
HEX = b"0123456789ABCDEFabcdef"
LETTERS = b"trTRzZVNF\r\a" + HEX
WORTHWHILE = bytes(range(256)) + 8 * LETTERS  # half of what is inserted could belong there


@dataclass(kw_only=True)
class FuzzTally:
    """What one kind of stream gave."""

    lines: int = 0
    messages: int = 0
    false_messages: int = 0
    missed_messages: int = 0
    exceptions: int = 0
    errors: list[str] = field(default_factory=list)


def message_of(line: bytes) -> CanMessage | None:
    """Return the message that a line is by the letter of the protocol, None when it is none."""
    if not 5 <= len(line) <= LONGEST_LINE or line[0] not in b"tr" or line[1] not in b"01234567":
        return None
    if any(letter not in HEX for letter in line[2:4]) or line[4] not in b"012345678":
        return None
    remote = line[0] == ord("r")
    size = 0 if remote else 2 * (line[4] - ord("0"))
    rest = line[5:]
    if len(rest) not in (size, size + 4) or any(letter not in HEX for letter in rest):
        return None
    return CanMessage(id=int(line[1:4], 16), data=bytes.fromhex(rest[:size].decode()), remote=remote)


def random_message(chance: random.Random) -> CanMessage:
    """Return any message."""
    if chance.random() < 0.1:
        return CanMessage(id=chance.randrange(0x800), remote=True)
    return CanMessage(id=chance.randrange(0x800), data=chance.randbytes(chance.randrange(9)))


def random_line(chance: random.Random) -> bytes:
    """Return any bytes, with an end."""
    return chance.randbytes(chance.randrange(40)) + b"\r"


def lettered_line(chance: random.Random) -> bytes:
    """Return any letters that the protocol knows, with an end."""
    return bytes(chance.choices(LETTERS, k=chance.randrange(30))) + b"\r"


def damaged_line(chance: random.Random) -> bytes:
    """Return a message's line with none to three damages."""
    line = encode_message(random_message(chance))
    for _ in range(chance.randrange(4)):
        line = chance.choice(DAMAGES)(line, chance)
    return line


def _flip(line: bytes, chance: random.Random) -> bytes:
    """Flip one bit."""
    place = chance.randrange(len(line) or 1)
    return (
        line[:place] + bytes([byte ^ 1 << chance.randrange(8) for byte in line[place : place + 1]]) + line[place + 1 :]
    )


def _replace(line: bytes, chance: random.Random) -> bytes:
    """Put another byte in the place of one."""
    place = chance.randrange(len(line) or 1)
    return line[:place] + bytes([chance.choice(WORTHWHILE)]) + line[place + 1 :]


def _insert(line: bytes, chance: random.Random) -> bytes:
    """Put a byte between."""
    place = chance.randrange(len(line) + 1)
    return line[:place] + bytes([chance.choice(WORTHWHILE)]) + line[place:]


def _cut(line: bytes, chance: random.Random) -> bytes:
    """Lose a stretch, perhaps with the end."""
    begin, end = sorted(chance.choices(range(len(line) + 1), k=2))
    return line[:begin] + line[end:]


def _repeat(line: bytes, chance: random.Random) -> bytes:
    """Send a stretch twice."""
    begin, end = sorted(chance.choices(range(len(line) + 1), k=2))
    return line[:end] + line[begin:]


def _change_kind(line: bytes, chance: random.Random) -> bytes:
    """Make another kind of line of it."""
    return bytes([chance.choice(b"tTrRzZ")]) + line[1:]


DAMAGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (_flip, _replace, _insert, _cut, _repeat, _change_kind)
KINDS: dict[str, Callable[[random.Random], bytes]] = {
    "any bytes": random_line,
    "letters of the protocol": lettered_line,
    "damaged messages": damaged_line,
}


def cut_stream(stream: bytes, chance: random.Random) -> Iterator[bytes]:
    """Yield a stream in pieces of random lengths, some of them empty."""
    begin = 0
    while begin < len(stream):
        end = begin + chance.randrange(LARGEST_PIECE)
        yield stream[begin:end]
        begin = end


def check_stream(stream: bytes, chance: random.Random, tally: FuzzTally) -> None:
    """Feed one stream and compare the messages with those that are in it."""
    lines = (stream + b"\r").replace(b"\a", b"\r").split(b"\r")[:-1]
    expected = [message for message in map(message_of, lines) if message is not None]
    parser, found = SlcanParser(), []
    try:
        for piece in cut_stream(stream + b"\r", chance):
            found += parser.feed(piece)
    except Exception as error:
        tally.exceptions += 1
        tally.errors.append(repr(error))
    tally.lines += len(lines)
    tally.messages += len(expected)
    if found != expected:
        tally.false_messages += sum(message not in expected for message in found) or max(0, len(found) - len(expected))
        tally.missed_messages += sum(message not in found for message in expected)


def fuzz(kind: str, count: int, seed: int, bar: tqdm) -> FuzzTally:
    """Return what `count` lines of a kind gave."""
    chance, tally = random.Random(seed), FuzzTally()
    while tally.lines < count:
        before = tally.lines
        check_stream(b"".join(KINDS[kind](chance) for _ in range(BATCH)), chance, tally)
        bar.update(tally.lines - before)
    return tally


def fuzz_by_hypothesis(seed: int) -> FuzzTally | None:
    """Return what the streams of hypothesis gave; None where it is not installed."""
    try:
        from hypothesis import given, settings, strategies
    except ImportError:
        return None
    tally, chance = FuzzTally(), random.Random(seed)
    valid = strategies.randoms(use_true_random=False).map(lambda source: encode_message(random_message(source)))
    letters = strategies.lists(strategies.sampled_from(list(LETTERS)), max_size=80).map(bytes)
    pieces = strategies.one_of(strategies.binary(max_size=80), letters, valid)

    @settings(max_examples=EXAMPLES, deadline=None, database=None, derandomize=True)
    @given(strategies.lists(pieces, max_size=12).map(b"".join))
    def check(stream: bytes) -> None:
        check_stream(stream, chance, tally)

    check()
    return tally


def time_replies(seed: int) -> dict[str, float]:
    """Return the time that one reply takes from bytes to a message [us]."""
    chance, parser = random.Random(seed), SlcanParser()
    lines = [encode_message(CanMessage(id=0x78, data=chance.randbytes(4))) for _ in range(TIMED)]
    times = []
    for line in lines:
        begin = time.perf_counter()
        parser.feed(line)
        times.append(1e6 * (time.perf_counter() - begin))
    p50, p95, p99 = (float(value) for value in np.percentile(times, [50, 95, 99]))
    return {"median": p50, "p95": p95, "p99": p99, "max": max(times), "n": TIMED}


def print_table(tallies: dict[str, FuzzTally], reply_us: dict[str, float]) -> None:
    """Print a line per kind of stream, and the time of a reply."""
    print(f"{'':<26}{'lines':>10}{'messages':>10}{'exceptions':>12}{'false':>8}{'missed':>8}")
    for name, tally in tallies.items():
        counts = f"{tally.exceptions:>12}{tally.false_messages:>8}{tally.missed_messages:>8}"
        print(f"{name:<26}{tally.lines:>10}{tally.messages:>10}{counts}")
    times = ", ".join(f"{name} {value:.1f}" for name, value in reply_us.items() if name != "n")
    machine = describe_machine()
    print(f"one reply read, us: {times} ({reply_us['n']} replies)")
    print(f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}, {machine['commit']}")


def main() -> None:
    """Fuzz, print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument("--lines", type=int, default=1_000_000, help="lines, shared by the kinds (1000000)")
    parser.add_argument("--seed", type=int, default=1, help="of the streams (1)")
    options = parser.parse_args()
    share = -(-options.lines // len(KINDS))
    with tqdm(total=options.lines, unit="lines", disable=None, leave=False) as bar:
        tallies = {kind: fuzz(kind, share, options.seed, bar) for kind in KINDS}
    extra = fuzz_by_hypothesis(options.seed)
    if extra is not None:
        tallies["hypothesis"] = extra
    reply_us = time_replies(options.seed)
    print_table(tallies, reply_us)
    if options.json:
        rows: dict[str, Any] = {name: asdict(tally) for name, tally in tallies.items()}
        write_figures(options.json, {"seed": options.seed, "kinds": rows, "reply_us": reply_us})


if __name__ == "__main__":
    main()
