"""Harmful and damaged files given to what reads them, each within a limit of memory and time: what became of them.

    python -m lab.benchmarks.fuzz --count 100000 --json fuzz.json

A reader may read a file or refuse it with an error of the package. It fails with any other error, where it takes 1 GB
more than a good file does, or 20 s; and where a damaged recording gives other key points without a word.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import select
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from lab.benchmarks.fuzz_files import KINDS, TEXTS, Kind, mutate

MEMORY, SECONDS = 1 << 30, 20.0  # beyond the good file's, and of one file
READ, REFUSED, TRACEBACK, OUT_OF_MEMORY, TOO_LONG, WRONG = OUTCOMES = (
    "read", "refused", "traceback", "memory", "time", "wrong"
)  # fmt: skip
FAILURES = (TRACEBACK, OUT_OF_MEMORY, TOO_LONG, WRONG)


@dataclass
class Tally:
    """What became of the files of a kind.

    Attributes:
        counts: files by outcome.
        failures: what failed: what was tried, and how.
    """

    counts: Counter[str] = field(default_factory=Counter)
    failures: list[dict[str, str]] = field(default_factory=list)

    def add(self, label: str, outcome: str, said: str) -> None:
        """Count a file."""
        self.counts[outcome] += 1
        if outcome in FAILURES:
            self.failures.append({"file": label, "outcome": outcome, "said": said})


class Reader:
    """A process that reads files of a kind, and another one where it had to be ended.

    Args:
        kind: of the files.
        good: files that are read first, to know what they take.
    """

    def __init__(self, kind: Kind, good: Sequence[Path]) -> None:
        self._kind, self._good = kind, good
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def read(self, path: Path) -> tuple[str, str]:
        """Return the outcome of a file, and what was said of it."""
        if self._process is None:
            self._start()
        answer = self._ask(str(path), SECONDS)
        if answer is None:
            ended = self._process.poll() if self._process else None
            self._end()
            return (TOO_LONG, f"more than {SECONDS:g} s") if ended is None else (OUT_OF_MEMORY, f"died with {ended}")
        return answer["outcome"], answer["said"]

    def _start(self) -> None:
        command = [sys.executable, "-m", "lab.benchmarks.fuzz", "--worker", self._kind.name]
        self._process = subprocess.Popen(
            [*command, *map(str, self._good)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        if self._ask(None, 120.0) is None:
            raise RuntimeError(f"{self._kind.name}: the good files cannot be read")

    def _ask(self, line: str | None, seconds: float) -> dict[str, Any] | None:
        """Send a line, and return the answer; None where none comes in time."""
        assert self._process is not None and self._process.stdin is not None and self._process.stdout is not None
        try:
            if line is not None:
                self._process.stdin.write(line.encode() + b"\n")
                self._process.stdin.flush()
        except OSError:
            return None
        until = monotonic() + seconds
        while select.select([self._process.stdout], [], [], max(until - monotonic(), 0.0))[0]:
            text = self._process.stdout.readline()
            if not text:
                self._process.wait()
                return None
            if text.startswith(b"{"):
                return json.loads(text)
        return None

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def work(kind: Kind, good: Sequence[Path]) -> None:
    """Read the good files, bound the memory, then read what is named on standard input, and answer line by line."""
    import logging
    import resource
    import warnings

    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    known = [kind.read(path) for path in good]
    _is_wrong(_damage(known[0]), known)  # what judges is compiled before its time counts
    grown = _data_size() + MEMORY
    resource.setrlimit(resource.RLIMIT_DATA, (grown, grown))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _answer(READ, "")
    for line in sys.stdin:
        _answer(*_judge(kind, Path(line.rstrip("\n")), known))


def _data_size() -> int:
    """Return what counts against RLIMIT_DATA of this process [bytes]."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmData")) << 10


def _answer(outcome: str, said: str) -> None:
    print(json.dumps({"outcome": outcome, "said": said}), flush=True)


def _judge(kind: Kind, path: Path, known: Sequence[Any]) -> tuple[str, str]:
    """Return what became of a file."""
    try:
        found = kind.read(path)
    except FinforceError as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, MemoryError):
                return OUT_OF_MEMORY, str(error)[:200]
            cause = cause.__cause__ or cause.__context__
        said = str(error)
        return (TRACEBACK, f"several lines: {said[:200]}") if "\n" in said.strip() else (REFUSED, said[:200])
    except MemoryError as error:
        return OUT_OF_MEMORY, str(error)[:200]
    except Exception as error:
        import traceback

        place = traceback.extract_tb(error.__traceback__)[-1]
        return TRACEBACK, f"{type(error).__name__}: {str(error)[:150]} ({Path(place.filename).name}:{place.lineno})"
    return (WRONG, "another force, and no note") if _is_wrong(found, known) else (READ, "")


def _is_wrong(found: Any, known: Sequence[Any]) -> bool:
    """Say whether a recording gives another force than the good one, beyond what is stated, without a word.

    A sum over all bytes is in few formats: where a bit of a key point is another, only the estimator may notice.
    """
    if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[0], dict)):
        return False
    (jaws, notes), (good, _) = found, known[0]
    if notes:
        return False
    for side, (stamps, points) in jaws.items():
        if side not in good:
            return True
        theirs, right = good[side]
        rows = np.searchsorted(theirs, stamps).clip(max=len(theirs) - 1)
        same = np.array_equal(theirs[rows], stamps) and np.array_equal(right[rows], points, equal_nan=True)
        if not same and _is_force_wrong(side, stamps, points, (theirs, right)):
            return True
    return False


def _damage(found: Any) -> Any:
    """Return what a recording gives with its last image left out; of other files, what they give."""
    if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[0], dict)):
        return found
    jaws, notes = found
    return {side: (stamps[:-1], 1.0001 * points[:-1]) for side, (stamps, points) in jaws.items()}, notes


def _is_force_wrong(side: str, stamps: NDArray, points: NDArray, good: tuple[NDArray, NDArray]) -> bool:
    """Say whether a force from some key points is further from that of the good ones than both state."""
    (found, stated), (true, more) = (_find_forces(side, *each) for each in ((stamps, points), good))
    shared, mine, theirs = np.intersect1d(stamps, good[0], return_indices=True)
    error = np.abs(found[mine] - true[theirs])
    allowed = 0.02 + 3.0 * (stated[mine] + more[theirs])
    both = np.isfinite(error) & np.isfinite(allowed)
    return bool((error[both] > allowed[both]).any()) or (not len(shared) and bool(np.nanmax(found, initial=0.0) > 0.1))


def _find_forces(side: str, stamps: NDArray, points: NDArray) -> tuple[NDArray, NDArray]:
    """Return force and standard deviation (n, 3) [N] of key points, the object at 42 mm."""
    from finforce_ifea.estimator import JawEstimator
    from finforce_ifea.jaw.calibration import load_calibration
    from finforce_ifea.jaw.jaw import load_jaw
    from finforce_ifea.observation import Contact, Observation

    jaw, calibration = load_jaw("bench", side), load_calibration("bench")
    estimator, contact = JawEstimator(jaw, calibration=calibration), Contact.fixed(jaw, 0.042)
    force, stddev = np.full((len(stamps), 3), np.nan), np.full((len(stamps), 3), np.nan)
    for number, (stamp, row) in enumerate(zip(stamps, points, strict=True)):
        try:
            observation = Observation(stamp=1e-9 * stamp, points=row, likelihood=np.ones(len(row)))
            solution = estimator.update(observation, contact)
        except FinforceError:
            continue
        if solution.trusted:
            force[number], stddev[number] = solution.force, solution.force_stddev
    return force, stddev


def list_files(kind: Kind, folder: Path, good: Sequence[Path], count: int, seed: int) -> Iterator[tuple[str, Path]]:
    """Yield what a kind's crafted files and so many damaged ones are, and their places."""
    crafted = folder / "crafted"
    crafted.mkdir(exist_ok=True)
    yield from kind.craft(crafted)
    contents = [(path, path.read_bytes()) for path in good]
    for number in range(count):
        path, content = contents[number % len(contents)]
        rng = random.Random(f"{kind.name} {seed} {number}")
        target = path.with_name(f"damaged{number % 8}{path.suffix}")
        target.write_bytes(mutate(content, rng, text=path.suffix in TEXTS))
        yield f"damaged {path.name} {seed} {number}", target
        target.unlink(missing_ok=True)


def fuzz(kinds: Iterable[Kind], count: int, seed: int, *, shown: bool = True) -> dict[str, Tally]:
    """Try the crafted files of kinds, and so many damaged ones of all together, and return what became of them."""
    from tqdm import tqdm

    kinds = list(kinds)
    share = count / sum(1.0 / kind.cost for kind in kinds)
    tallies = {}
    for kind in kinds:
        tally = tallies[kind.name] = Tally()
        with TemporaryDirectory(prefix="finforce_fuzz_") as name:
            folder = Path(name)
            own = folder / "good"
            own.mkdir()
            good = kind.make(own)
            files = list_files(kind, folder, good, round(share / kind.cost), seed)
            with (
                Reader(kind, good) as reader,
                tqdm(desc=kind.name, unit="file", disable=None if shown else True) as bar,
            ):
                for label, path in files:
                    tally.add(label, *reader.read(path))
                    bar.update()
    return tallies


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print a table, write JSON; 1 where a file failed."""
    parser = argparse.ArgumentParser(prog="python -m lab.benchmarks.fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="damaged files of all kinds together (2,000)")
    parser.add_argument("--seed", type=int, default=0, help="of the damage (0)")
    parser.add_argument("--kinds", nargs="+", choices=tuple(KINDS), default=tuple(KINDS), help="of files (all)")
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument("--worker", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.worker:
        name, *good = options.worker
        work(KINDS[name], [Path(path) for path in good])
        return 0
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    tallies = fuzz((KINDS[name] for name in options.kinds), options.count, options.seed)
    print(f"{'kind':<16}" + "".join(f"{outcome:>11}" for outcome in OUTCOMES))
    for name, tally in tallies.items():
        print(f"{name:<16}" + "".join(f"{tally.counts[outcome]:>11}" for outcome in OUTCOMES))
    total: Counter[str] = sum((tally.counts for tally in tallies.values()), Counter())
    print(f"{'all':<16}" + "".join(f"{total[outcome]:>11}" for outcome in OUTCOMES))
    for name, tally in tallies.items():
        for failure in tally.failures[:20]:
            print(f"{name}: {failure['file']}: {failure['outcome']}: {failure['said']}")
    if options.json:
        from finforce_eval.machine import write_figures

        kinds = {name: {"counts": dict(tally.counts), "failures": tally.failures} for name, tally in tallies.items()}
        write_figures(options.json, {"kinds": kinds, "count": options.count, "seed": options.seed})
    return int(any(total[outcome] for outcome in FAILURES))


if __name__ == "__main__":
    sys.exit(main())
