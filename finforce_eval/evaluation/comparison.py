"""Two evaluations of the same recordings: which got better or worse, and whether that is more than chance.

The same recording is met twice, so that its own difficulty cancels: what counts is the difference of the mean squared
errors, second by second. Neighbouring seconds err alike; the spread of the mean over blocks of some seconds says by how
much it would differ in other recordings like it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, nan, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from finforce.files import FileError, read_json
from finforce_eval.errors import OptionError
from finforce_eval.table import ForceSeries

BETTER, WORSE, SAME, UNSURE, GAINED, LOST = "better", "worse", "same", "unsure", "new", "gone"
LEAST = 0.002  # [N], difference below which an outcome is "same", however certain
SIGMAS = 3.0  # [sigma], certainty of a difference that counts
LEAST_ANSWERS = 5.0  # fewer percents of the frames answered, from which on a recording got worse whatever its error
_BLOCK = 4  # [s], of correlated errors
_FEWEST = 4  # blocks for a standard deviation
_SECOND = 1_000_000_000


@dataclass(frozen=True, kw_only=True)
class Change:
    """The outcome of one recording.

    Attributes:
        name: of the recording, or of one of its jaws.
        before: root mean square error in the first evaluation [N], NaN without.
        after: in the second [N], NaN without.
        stddev: of the difference [N]; infinite where nobody can tell.
        answered: share of the frames to be answered that were, before and after [%].
        outcome: "better", "worse", "same", "unsure", "new" or "gone".
    """

    name: str
    before: float
    after: float
    stddev: float
    answered: tuple[float, float]
    outcome: str

    @property
    def difference(self) -> float:
        """Error after minus error before [N]."""
        return self.after - self.before


def error_blocks(result: ForceSeries) -> list[list[float]]:
    """Return second, mean squared error [N^2] and number of its frames, of every second with counted frames."""
    seconds = (result.stamps_ns - result.stamps_ns[:1]) // _SECOND
    squares = pd.Series(result.error[result.counted] ** 2).groupby(seconds[result.counted])
    return [list(row) for row in squares.agg(["mean", "size"]).itertuples()]


def read_evaluation(path: str | Path) -> dict[str, Any]:
    """Return the content of a file that `evaluate --json` wrote.

    Raises:
        OptionError: it is no such file.
    """
    try:
        content = read_json(path)
        cases = content["cases"]
        for case in cases.values():
            float(case["all"]["rmse_N"] or 0.0), float(case["record_frames"]), float(case["record_skipped"])
            np.array(case.get("seconds", ()), dtype=float).reshape(-1, 3)
    except (FileError, KeyError, TypeError, ValueError, AttributeError) as error:
        why = error if isinstance(error, FileError) else "holds no scores"
        raise OptionError(f"{path}: {why}; expected what finforce evaluate --json writes") from error
    return content


def compare_evaluations(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[Change]:
    """Return what became of each recording that one of two evaluations has, the largest differences first."""
    names = dict.fromkeys([*before["cases"], *after["cases"]])
    changes = [_compare(name, before["cases"].get(name), after["cases"].get(name)) for name in names]
    return sorted(changes, key=lambda change: -abs(np.nan_to_num(change.difference)))


def total_change(changes: Sequence[Change]) -> Change:
    """Return the change of the mean error of the recordings that both evaluations have."""
    both = [change for change in changes if np.isfinite(change.difference)]
    if not both:
        return Change(name="mean", before=nan, after=nan, stddev=inf, answered=(nan, nan), outcome=UNSURE)
    before, after = (float(np.mean([getattr(change, side) for change in both])) for side in ("before", "after"))
    stddev = sqrt(sum(change.stddev**2 for change in both)) / len(both)
    answered = tuple(float(np.mean([change.answered[side] for change in both])) for side in (0, 1))
    outcome = _judge(after - before, stddev)
    return Change(name="mean", before=before, after=after, stddev=stddev, answered=answered, outcome=outcome)


def differing_settings(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return the settings that two evaluations do not share, of the first and of the second."""
    names = dict.fromkeys([*before, *after])
    pairs = {name: (before.get(name, "-"), after.get(name, "-")) for name in names}
    return {name: pair for name, pair in pairs.items() if all(isinstance(v, str) for v in pair) and pair[0] != pair[1]}


def _compare(name: str, before: Mapping[str, Any] | None, after: Mapping[str, Any] | None) -> Change:
    """Return what became of one recording."""
    old, new = _error(before), _error(after)
    answered, stddev = (_answered(before), _answered(after)), inf
    if before is None or after is None:
        outcome = GAINED if before is None else LOST
    else:
        stddev = _find_stddev(before, after, old, new)
        outcome = WORSE if answered[1] < answered[0] - LEAST_ANSWERS else _judge(new - old, stddev)
    return Change(name=name, before=old, after=new, stddev=stddev, answered=answered, outcome=outcome)


def _error(case: Mapping[str, Any] | None) -> float:
    value = None if case is None else case["all"]["rmse_N"]
    return nan if value is None else float(value)


def _answered(case: Mapping[str, Any] | None) -> float:
    """Return the share of the frames to be answered that were [%]."""
    if case is None or not case["record_frames"]:
        return nan
    return 100.0 * (1.0 - case["record_skipped"] / case["record_frames"])


def _judge(difference: float, stddev: float) -> str:
    if not np.isfinite(difference) or not np.isfinite(stddev):
        return SAME if difference == 0.0 else UNSURE
    if abs(difference) < LEAST:
        return SAME
    if abs(difference) < SIGMAS * stddev:
        return UNSURE
    return BETTER if difference < 0.0 else WORSE


def _find_stddev(before: Mapping[str, Any], after: Mapping[str, Any], first: float, second: float) -> float:
    """Return the standard deviation of the difference of two errors [N], infinite where nobody can tell.

    With d the difference of the mean squares, the errors differ by d / (first + second).
    """
    if not first + second > 0.0:
        return 0.0 if first == second == 0.0 else inf
    rows, others = (np.array(case.get("seconds", ()), dtype=float).reshape(-1, 3) for case in (before, after))
    _, mine, theirs = np.intersect1d(rows[:, 0], others[:, 0], return_indices=True)
    starts, frames = np.arange(0, len(mine), _BLOCK), rows[mine, 2]
    if len(starts) < _FEWEST:
        return inf
    sums = np.add.reduceat(frames * (others[theirs, 1] - rows[mine, 1]), starts)
    means = sums / np.maximum(np.add.reduceat(frames, starts), 1.0)
    return float(np.std(means, ddof=1) / sqrt(len(means)) / (first + second))
