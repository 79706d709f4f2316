"""Stress families: their trials, results and violated rules."""

from __future__ import annotations

import gc
import math
import signal
import threading
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from time import thread_time
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_eval.evaluation.scoring import measure_sharpness
from lab.harness import format_table

TIME_LIMIT = 60.0
# No step may take more medians than this.
LONGEST_STEP = 10.0
AXES = ("x", "y", "z", "magnitude", "torque")  # of an answer: force, its magnitude, torque about y
NO_ERROR = 1e-9  # [N, N m], which needs no standard deviation


class _HangError(BaseException):
    """A step took longer than the time limit; no handler of errors inside the step must catch it."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One question put to the code under stress, and what came back.

    Attributes:
        seed: of the trial, so that it can be run alone.
        level: setting of this trial, such as "noise 2 mm".
        sure: True if it was given as one that may be published.
        errors: sizes of the errors along `AXES` [N, N m]; none where there is no truth to compare with.
        stated: standard deviations that were stated along `AXES` [N, N m].
        step_time: CPU time of the step [s]; NaN where it is not to be compared with the others.
        nan: True if something that is not finite left in an answer that was sure.
        outcome: "answer", "refused" by one of our errors, "crashed" by any other, or "hung".
        note: the error's words, or what else is to be known.
    """

    seed: int = 0
    level: str = ""
    sure: bool = False
    errors: tuple[float, ...] = ()
    stated: tuple[float, ...] = ()
    step_time: float = math.nan
    nan: bool = False
    outcome: str = "answer"
    note: str = ""

    @property
    def force_error(self) -> float:
        """Norm of the difference of the forces [N]; NaN without truth."""
        return float(np.linalg.norm(self.errors[:3])) if self.errors else math.nan

    @property
    def sigmas(self) -> float:
        """Largest error in stated standard deviations, infinite where none was stated; NaN without truth."""
        if not self.errors:
            return math.nan
        errors, stated = np.array(self.errors), np.array(self.stated)
        ratio = np.divide(errors, stated, out=np.full(len(errors), np.inf), where=stated > 0.0)
        return float(np.where(errors > NO_ERROR, ratio, 0.0).max())


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The options of one run of a family.

    Attributes:
        seed: of everything that is drawn.
        solver: name of the estimator's solver.
        mesh: name of its mesh density.
        count: trials; None for as many as the family takes for enough.
        jaw: shipped jaw or jaw file of the families about key points, contacts and places.
    """

    jaw: str = "bench"
    seed: int = 0
    solver: str = "default"
    mesh: str = "default"
    count: int | None = None

    def random(self, *keys: int | str) -> np.random.Generator:
        """Return a generator for these keys that no other keys share."""
        numbers = [zlib.crc32(key.encode()) if isinstance(key, str) else int(key) for key in keys]
        return np.random.default_rng([self.seed, *numbers])

    def share(self, default: int) -> int:
        """Return the number of trials: what was asked for, else `default`."""
        return default if self.count is None else self.count


@dataclass(frozen=True, kw_only=True)
class Family:
    """Trials of one kind.

    Attributes:
        name: one word or two, for the command line.
        what: summary, in one line.
        run: yields the trials of a plan.
        least_sure: share of the trials that must be answered surely; a code that is never sure is honest and useless.
        timed: True if no step may exceed ten times the median; not where the trials differ in size on purpose.
        ruled: True if the exit status asks for the rule; not where what the estimator is told is false on purpose.
    """

    name: str
    what: str
    run: Callable[[Plan], Iterable[Trial]]
    least_sure: float = 0.0
    timed: bool = True
    ruled: bool = True


def attempt(
    seed: int,
    work: Callable[[], Any],
    judge: Callable[[Any], Trial],
    *,
    level: str = "",
    limit: float = TIME_LIMIT,
) -> Trial:
    """Run one step and return what became of it; it is timed, judging it is not.

    Args:
        seed: of the trial.
        work: the step.
        judge: returns the trial of the step's result.
        level: setting of this trial.
        limit: wall time [s] after which the step counts as hung; kept in the main thread alone.
    """
    begin = thread_time()
    try:
        with _limit_time(limit):
            result = work()
    except FinforceError as error:
        return Trial(seed=seed, level=level, outcome="refused", step_time=thread_time() - begin, note=str(error))
    except _HangError:
        return Trial(seed=seed, level=level, outcome="hung", note=f"no answer within {limit:g} s")
    except Exception as error:
        return Trial(seed=seed, level=level, outcome="crashed", note=f"{type(error).__name__}: {error}")
    taken = thread_time() - begin
    trial = judge(result)
    time = taken if math.isnan(trial.step_time) else trial.step_time
    return replace(trial, seed=seed, level=trial.level or level, step_time=time)


@contextmanager
def _limit_time(limit: float) -> Iterator[None]:
    """Raise `_HangError` inside the block after `limit` [s]."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGALRM, _raise_hang)
    signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _raise_hang(_signal: int, _frame: Any) -> None:
    raise _HangError


def run_family(family: Family, plan: Plan) -> list[Trial]:
    """Return the trials of a family; a step that seems long is timed again.

    A machine that does other things now and then makes any step look long. The trials being those of a seed, a family
    with a step beyond `LONGEST_STEP` medians is run once more, and the shorter time of each step stands.
    """
    trials = _run_once(family, plan)
    if family.timed and measure_longest(trials) > LONGEST_STEP:
        again = _run_once(family, plan)
        if len(again) == len(trials):
            pairs = zip(trials, again, strict=True)
            return [replace(t, step_time=float(np.fmin(t.step_time, other.step_time))) for t, other in pairs]
    return trials


def measure_longest(trials: Sequence[Trial]) -> float:
    """Return the longest step time over the median of those that are compared; NaN without any."""
    times = np.array([trial.step_time for trial in trials])
    known = times[~np.isnan(times)]
    return float(known.max() / np.median(known)) if len(known) else math.nan


def _run_once(family: Family, plan: Plan) -> list[Trial]:
    """Return the trials of a family; an error outside of its attempts ends it as one crashed trial.

    The garbage collector rests meanwhile: its pauses are not those of a step.
    """
    trials: list[Trial] = []
    collects = gc.isenabled()
    gc.disable()
    try:
        for trial in family.run(plan):
            trials.append(trial)
            if len(trials) % 1000 == 0:
                gc.collect()
    except Exception as error:
        note = f"{type(error).__name__}: {error}"
        trials.append(Trial(seed=plan.seed, level="outside of a step", outcome="crashed", note=note))
    finally:
        if collects:
            gc.enable()
    return trials


SIGMAS = 3.0
SHARE_WITHIN = 0.99
TRIAL = ("sure", "step_time", "nan", "outcome")
JUDGED = ("force_error", "sigmas")
# the figures of a summary that are printed: heading and factor
PRINTED = {
    "n": ("n", 1),
    "sure": ("trusted %", 100),
    "worst_error": ("error N", 1),
    "worst_sigmas": ("worst σ", 1),
    "within": ("in 3σ %", 100),
    "median_sigmas": ("median σ", 1),
    **{f"sharpness_{axis}": (f"sharp {axis}", 1) for axis in AXES[:4]},
    "step_p50": ("p50 ms", 1000),
    "step_ratio": ("max/p50", 1),
    "nans": ("NaN", 1),
    "refused": ("refused", 1),
    "crashed": ("crashed", 1),
    "hung": ("hung", 1),
}


def summarise(name: str, trials: Sequence[Trial], *, least_sure: float = 0.0, timed: bool = True) -> dict[str, Any]:
    """Return what the trials of a family or of one of its levels come to, and which rules they break.

    The rules: an answer that is sure is within three stated standard deviations in 99 % of cases; nothing hangs,
    crashes, or leaves that is not finite; no step exceeds ten times the median; enough answers are sure.
    """
    table = pd.DataFrame([vars(trial) for trial in trials], columns=TRIAL)
    table[list(JUDGED)] = np.array([[getattr(trial, name) for name in JUDGED] for trial in trials]).reshape(-1, 2)
    sure = table[table.sure.astype(bool)]
    judged, outcomes = sure.sigmas.dropna(), Counter(table.outcome)
    figures = {
        "n": len(table),
        "sure": table.sure.mean(),
        "worst_error": sure.force_error.max(),
        "worst_sigmas": judged.max(),
        "within": (judged <= SIGMAS).mean(),
        "median_sigmas": judged.median(),
        "step_p50": table.step_time.median(),
        "step_ratio": measure_longest(trials),
        **dict(zip((f"sharpness_{axis}" for axis in AXES), _measure_sharpness(trials), strict=True)),
    }
    counts = {"nans": int(table.nan.sum()), **{name: outcomes[name] for name in ("refused", "crashed", "hung")}}
    figures = {key: value if key == "n" else float(value) for key, value in figures.items()} | counts
    return {"name": name, **figures, "broken": list(_find_broken(figures, least_sure, timed))}


def _measure_sharpness(trials: Sequence[Trial]) -> NDArray:
    """Return the sharpness of the sure answers along `AXES`, see `measure_sharpness`."""
    judged = [trial for trial in trials if trial.sure and trial.errors]
    stated, errors = (
        np.array([getattr(trial, name) for trial in judged]).reshape(-1, len(AXES)) for name in ("stated", "errors")
    )
    return measure_sharpness(stated, errors)


def summarise_family(family: Family, trials: Sequence[Trial]) -> dict[str, Any]:
    """Return the summary of all trials of a family."""
    return summarise(family.name, trials, least_sure=family.least_sure, timed=family.timed)


def summarise_levels(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Return one summary per level, in the order in which they came.

    A level is held to the same rules as its family, but for its time.
    """
    levels = dict.fromkeys(trial.level for trial in trials)
    return [summarise(level, [t for t in trials if t.level == level], timed=False) for level in levels]


def _find_broken(figures: Mapping[str, Any], least_sure: float, timed: bool) -> Iterable[str]:
    if not figures["n"]:
        yield "no trial was run"
        return
    if figures["within"] < SHARE_WITHIN:
        yield f"{100 * figures['within']:.1f} % of the sure answers are within 3 sigma, expected 99 %"
    if figures["sure"] < least_sure:
        yield f"{100 * figures['sure']:.1f} % of the answers are sure, expected {100 * least_sure:g} %"
    if timed and figures["step_ratio"] > LONGEST_STEP:
        yield f"the longest step took {figures['step_ratio']:.1f} times the median, expected at most {LONGEST_STEP:g}"
    for name, words in (("nans", "answers are not finite"), ("crashed", "trials crashed"), ("hung", "trials hung")):
        if figures[name]:
            yield f"{figures[name]} {words}"


def format_summaries(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Return a row for each summary, in Markdown."""
    rows = [
        {"family": summary["name"], **{title: factor * summary[key] for key, (title, factor) in PRINTED.items()}}
        for summary in summaries
    ]
    return format_table(pd.DataFrame(rows))
