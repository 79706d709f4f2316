"""Stress by time: stamps that stall, jitter, repeat or leap, and very many steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from finforce_eval.replay.cpu_share import resident_bytes
from finforce_eval.stress.press import Bench
from finforce_eval.stress.session import PERIOD, Session, SessionStep, open_session, take_another
from finforce_eval.stress.stress import Family, Plan, Trial

STAMPS = ("jitter", "gaps", "stall", "repeat", "backwards", "not finite")
LONGEST_GAP = 1e5
SHORTEST = 1e-9
MANY = 20_000
# One in so many steps of the long run is kept: what is kept must not be what grows.
KEPT = 10
PRESSES = 8


def run_stamps(plan: Plan) -> Iterator[Trial]:
    """Yields presses whose stamps are not those of a camera."""
    bench = Bench(plan)
    for seed in range(plan.share(8 * len(STAMPS))):
        random = plan.random("stamps", seed)
        kind = STAMPS[seed % len(STAMPS)]
        session = open_session(bench, random, level=kind)
        steps = session.press()
        stamps = session.start + np.cumsum(_draw_periods(kind, random, len(steps)))
        yield from session.play(seed, [replace(s, stamp=float(t)) for s, t in zip(steps, stamps, strict=True)])


def _draw_periods(kind: str, random: np.random.Generator, count: int) -> np.ndarray:
    """Returns the time [s] from each image to the next."""
    periods = np.full(count, PERIOD)
    odd = random.random(count) < 0.3
    match kind:
        case "jitter":
            return PERIOD * random.uniform(0.05, 3.0, count)
        case "gaps":
            periods[odd] = np.exp(random.uniform(np.log(PERIOD), np.log(LONGEST_GAP), odd.sum()))
        case "stall":
            periods[odd] = SHORTEST
        case "repeat":
            periods[odd] = 0.0
        case "backwards":
            periods[odd] = -random.uniform(0.0, 3 * PERIOD, odd.sum())
        case _:
            periods[-1] = np.nan if random.random() < 0.5 else np.inf
    return periods


def run_long(plan: Plan) -> Iterator[Trial]:
    """Yields one in ten steps of a long run of presses; each tenth of the run is a level, so that drift shows."""
    bench, random = Bench(plan), plan.random("long")
    session = open_session(bench, random)
    presses = [session, *(take_another(session, random) for _ in range(PRESSES - 1))]
    total = plan.share(MANY)
    done, worst, nan, memory = 0, 0.0, False, resident_bytes()
    for trial in session.play(plan.seed, _press_on(presses, random, total)):
        done, worst, nan = done + 1, float(np.fmax(worst, trial.step_time)), nan or trial.nan
        if done % KEPT == 0 or done == total:
            grown = f"memory {(resident_bytes() - memory) / 1e6:+.1f} MB" if done == total else ""
            note = grown or (trial.note if trial.sigmas > 3.0 else "")
            tenth = f"tenth {min(10, 1 + 10 * (done - 1) // total):2d} of {total} steps"
            yield replace(trial, step_time=worst, nan=nan, level=tenth, note=note)
            worst, nan = 0.0, False


def _press_on(presses: list[Session], random: np.random.Generator, count: int) -> Iterator[SessionStep]:
    """Yields `count` steps: rest, a ramp, a hold, a ramp back, with one press after the other."""
    done = 0
    while done < count:
        session = presses[int(random.integers(len(presses)))]
        depth = random.uniform(0.2, 1.0) * session.course.depth
        up = np.linspace(0.0, depth, int(random.integers(5, 40)))
        depths = np.concatenate([np.zeros(20), up, np.full(int(random.integers(10, 90)), depth), up[::-1]])
        for step in session.steps(depths)[: count - done]:
            done += 1
            yield replace(step, stamp=session.start + done * PERIOD)


FAMILIES = (
    Family(name="stamps", what="stamps that stall, jitter, repeat or leap", run=run_stamps),
    Family(name="long", what="one in ten of many steps without a new start", run=run_long),
)
