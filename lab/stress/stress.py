"""What a stress family is, how one of its trials is run, what they come to, and which rules they break."""

from __future__ import annotations

import gc
import math
import pkgutil
import signal
import threading
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np

from finforce.errors import FinforceError
from finforce_eval.evaluation.tables import markdown_rows

TIME_LIMIT = 60.0
# No step may take more medians than this.
LONGEST_STEP = 10.0


class HangError(BaseException):
    """A step took longer than the time limit; no handler of errors inside the step must catch it."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One question put to the code under stress, and what came back.

    Attributes:
        seed: of the trial, so that it can be run alone.
        level: what was set in this trial, such as "noise 2 mm".
        converged: whether the answer is a converged one.
        sure: whether it was given as one that may be published.
        residual: what is left of the equations, scaled as the family says.
        kkt: scaled residual of the optimality conditions.
        force_error: norm of the difference of the forces [N]; NaN where there is no truth to compare with.
        stddev: standard deviation of the force that was stated [N].
        deviation: largest error over its stated standard deviation; NaN for force_error / stddev.
        step_time: CPU time of the step [s]; NaN where it is not to be compared with the others.
        condition: condition number of what was solved.
        energy_balance: work done less energy stored, relative to the larger of the two.
        nan: whether something that is not finite left in an answer that was sure.
        outcome: "answer", "refused" by one of our errors, "crashed" by any other, or "hung".
        note: the error's words, or what else is to be known.
    """

    seed: int = 0
    level: str = ""
    converged: bool = False
    sure: bool = False
    residual: float = math.nan
    kkt: float = math.nan
    force_error: float = math.nan
    stddev: float = math.nan
    deviation: float = math.nan
    step_time: float = math.nan
    condition: float = math.nan
    energy_balance: float = math.nan
    nan: bool = False
    outcome: str = "answer"
    note: str = ""

    @property
    def sigmas(self) -> float:
        """Error in stated standard deviations, infinite where none was stated; NaN without truth."""
        if not math.isnan(self.deviation):
            return self.deviation
        if math.isnan(self.force_error) or self.force_error == 0.0:
            return self.force_error
        return self.force_error / self.stddev if self.stddev > 0.0 else math.inf


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What one run of a family is asked for.

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
        what: what is done, in one line.
        run: yields the trials of a plan.
        least_sure: share of the trials that must be answered surely; a code that is never sure is honest and useless.
        timed: whether no step may exceed ten times the median; not where the trials differ in size on purpose.
        ruled: whether the exit status asks for the rule; not where what the estimator is told is false on purpose.
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
        level: what was set in this trial.
        limit: wall time [s] after which the step counts as hung; kept in the main thread alone.
    """
    begin = thread_time()
    try:
        with _limit_time(limit):
            result = work()
    except FinforceError as error:
        return Trial(seed=seed, level=level, outcome="refused", step_time=thread_time() - begin, note=str(error))
    except HangError:
        return Trial(seed=seed, level=level, outcome="hung", note=f"no answer within {limit:g} s")
    except Exception as error:
        return Trial(seed=seed, level=level, outcome="crashed", note=f"{type(error).__name__}: {error}")
    taken = thread_time() - begin
    trial = judge(result)
    time = taken if math.isnan(trial.step_time) else trial.step_time
    return replace(trial, seed=seed, level=trial.level or level, step_time=time)


@contextmanager
def _limit_time(limit: float) -> Iterator[None]:
    """Raise `HangError` inside the block after `limit` [s]."""
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
    raise HangError


def run_family(family: Family, plan: Plan) -> list[Trial]:
    """Returns the trials of a family; a step that seems long is timed again.

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
    """Returns the longest step time over the median of those that are compared; NaN without any."""
    times = np.array([trial.step_time for trial in trials])
    known = times[~np.isnan(times)]
    return float(known.max() / np.median(known)) if len(known) else math.nan


def _run_once(family: Family, plan: Plan) -> list[Trial]:
    """Returns the trials of a family; an error outside of its attempts ends it as one crashed trial.

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


def find_families() -> dict[str, Family]:
    """Return every family by name: the `FAMILIES` of this package's modules."""
    folder = Path(__file__).parent
    modules = [import_module(f"{__package__}.{module.name}") for module in pkgutil.iter_modules([str(folder)])]
    return {family.name: family for module in modules for family in getattr(module, "FAMILIES", ())}


SIGMAS = 3.0
SHARE_WITHIN = 0.99


@dataclass(frozen=True, kw_only=True)
class Summary:
    """The trials of one family, or of one of its levels.

    Attributes:
        name: of the family or the level.
        n: trials.
        converged: share of them.
        sure: share of them.
        worst_residual: of converged answers, as the family scales it.
        worst_kkt: of sure answers.
        worst_error: of the force where the answer was sure [N].
        worst_sigmas: the same in stated standard deviations.
        within: share of the sure answers within three of them; NaN when none can be judged.
        median_sigmas: error over stated standard deviation in the median; 0.7 where it is stated exactly.
        median_stddev: of the sure answers [N].
        step_p50: median CPU time of a step [s].
        step_ratio: longest step over that.
        worst_condition: largest condition number.
        worst_balance: largest energy balance in magnitude.
        nans: answers with something that is not finite.
        refused: trials ended by one of our errors.
        crashed: trials ended by any other.
        hung: trials that met the time limit.
        broken: rules that are broken, in words.
    """

    name: str
    n: int
    converged: float
    sure: float
    worst_residual: float
    worst_kkt: float
    worst_error: float
    worst_sigmas: float
    within: float
    median_sigmas: float
    median_stddev: float
    step_p50: float
    step_ratio: float
    worst_condition: float
    worst_balance: float
    nans: int
    refused: int
    crashed: int
    hung: int
    broken: tuple[str, ...]


def summarise(name: str, trials: Sequence[Trial], *, least_sure: float = 0.0, timed: bool = True) -> Summary:
    """Return what trials come to and which rules they break.

    The rules: an answer that is sure is within three stated standard deviations in 99 % of cases; nothing hangs,
    crashes, or leaves that is not finite; no step exceeds ten times the median; enough answers are sure.
    """
    sure = [trial for trial in trials if trial.sure]
    sigmas = np.array([trial.sigmas for trial in sure])
    judged = sigmas[~np.isnan(sigmas)]
    steps = _known(trial.step_time for trial in trials)
    outcomes = Counter(trial.outcome for trial in trials)
    figures = {
        "n": len(trials),
        "converged": _share(trial.converged for trial in trials),
        "sure": _share(trial.sure for trial in trials),
        "worst_residual": _worst(trial.residual for trial in trials if trial.converged),
        "worst_kkt": _worst(trial.kkt for trial in sure),
        "worst_error": _worst(trial.force_error for trial in sure),
        "worst_sigmas": _worst(judged),
        "within": _share(judged <= SIGMAS),
        "median_sigmas": _median(judged),
        "median_stddev": _median(_known(trial.stddev for trial in sure)),
        "step_p50": _median(steps),
        "step_ratio": measure_longest(trials),
        "worst_condition": _worst(trial.condition for trial in trials),
        "worst_balance": _worst(abs(trial.energy_balance) for trial in trials),
        "nans": sum(trial.nan for trial in trials),
        **{name: outcomes[name] for name in ("refused", "crashed", "hung")},
    }
    return Summary(name=name, **figures, broken=tuple(_find_broken(figures, least_sure, timed)))


def summarise_family(family: Family, trials: Sequence[Trial]) -> Summary:
    """Return the summary of all trials of a family."""
    return summarise(family.name, trials, least_sure=family.least_sure, timed=family.timed)


def summarise_levels(trials: Sequence[Trial]) -> list[Summary]:
    """Return one summary per level, in the order in which they came; nothing is demanded of a level's time."""
    levels = dict.fromkeys(trial.level for trial in trials)
    return [summarise(level, [t for t in trials if t.level == level], timed=False) for level in levels]


def _find_broken(figures: dict, least_sure: float, timed: bool) -> Iterable[str]:
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


def _known(values: Iterable[float]) -> np.ndarray:
    """Return the values (n,) that are not NaN."""
    array = np.array(list(values), float)
    return array[~np.isnan(array)]


def _worst(values: Iterable[float]) -> float:
    known = _known(values)
    return float(known.max()) if len(known) else float("nan")


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _share(values: Iterable[bool]) -> float:
    array = np.array(list(values), float)
    return float(array.mean()) if len(array) else float("nan")


HEAD = (
    *("family", "n", "conv. %", "sure %", "residual", "KKT", "error N", "worst σ", "in 3σ %", "median σ", "stated N"),
    *("p50 ms", "max/p50", "cond.", "energy", "NaN", "refused", "crashed", "hung"),
)


def summary_cells(summary: Summary) -> list[str]:
    """Return one row of the table."""
    numbers = (
        _cell(100 * summary.converged, ".1f"),
        _cell(100 * summary.sure, ".1f"),
        _cell(summary.worst_residual, ".1e"),
        _cell(summary.worst_kkt, ".1e"),
        _cell(summary.worst_error, ".3g"),
        _cell(summary.worst_sigmas, ".2f"),
        _cell(100 * summary.within, ".2f"),
        _cell(summary.median_sigmas, ".2f"),
        _cell(summary.median_stddev, ".3g"),
        _cell(1e3 * summary.step_p50, ".3g"),
        _cell(summary.step_ratio, ".1f"),
        _cell(summary.worst_condition, ".1e"),
        _cell(summary.worst_balance, ".1e"),
    )
    counts = (summary.nans, summary.refused, summary.crashed, summary.hung)
    return [summary.name, str(summary.n), *numbers, *map(str, counts)]


def _cell(value: float, form: str) -> str:
    return "" if np.isnan(value) else format(value, form)


def format_summaries(summaries: Sequence[Summary], first: str = "family") -> str:
    """Return the table as text with aligned columns."""
    rows = [[first, *HEAD[1:]], *(summary_cells(summary) for summary in summaries)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEAD))]
    lines = [
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def markdown_summaries(summaries: Sequence[Summary], first: str = "family") -> list[str]:
    """Return the lines of the table in Markdown."""
    return markdown_rows([first, *HEAD[1:]], [summary_cells(summary) for summary in summaries])
