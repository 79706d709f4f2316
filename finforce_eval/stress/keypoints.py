"""Stress by key points: few of them, noisy ones, gross errors alone and in clusters."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from finforce_eval.stress.press import Bench
from finforce_eval.stress.session import noise_of, open_session
from finforce_eval.stress.stress import Family, Plan, Trial

NOISES = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
SHARES = (0.1, 0.2, 0.3, 0.4)
USUAL = 0.2
WORKSPACE = 0.03
FARTHEST_SHIFT = 0.01


def run_subsets(plan: Plan) -> Iterator[Trial]:
    """Yields trials with random subsets of the key points, down to none; some hidden for good, some now and then."""
    bench = Bench(plan)
    count = len(bench.jaw.keypoints)
    for seed in range(plan.share(3 * (count + 1))):
        random = plan.random("subsets", seed)
        kept, flickers = seed % (count + 1), bool(seed // (count + 1) % 2)
        level = f"{kept:2d} key points, {'others each time' if flickers else 'the same'}"
        session = open_session(bench, random, level=level)
        steps = session.press()
        order = random.permutation(count)
        for step in steps:
            order = random.permutation(count) if flickers else order
            step.points[order[kept:]] = np.nan
        yield from session.play(seed, steps)


def run_noise(plan: Plan) -> Iterator[Trial]:
    """Yields trials with noise from 0 to 10 mm, from the start or only after a tare that saw the usual noise."""
    bench = Bench(plan)
    for seed in range(plan.share(6 * len(NOISES))):
        random = plan.random("noise", seed)
        noise, late = NOISES[seed % len(NOISES)], bool(seed // len(NOISES) % 2)
        level = f"{noise:g} mm {'after the tare' if late else 'from the start'}"
        session = open_session(bench, random, tare=1.0 if late else noise / USUAL, level=level)
        yield from session.play(seed, session.press(scale=noise / USUAL))


def run_gross(plan: Plan) -> Iterator[Trial]:
    """Yields trials in which a share of the key points lies anywhere in the workspace, with high likelihood."""
    bench = Bench(plan)
    for seed in range(plan.share(10 * len(SHARES))):
        random = plan.random("gross", seed)
        share, lasts = SHARES[seed % len(SHARES)], bool(seed // len(SHARES) % 2)
        session = open_session(bench, random, level=f"{100 * share:g} %, {'lasting' if lasts else 'drawn anew'}")
        steps = session.press()
        wrong, places = _draw_wrong(bench, random, share), _draw_places(bench, random)
        for step in steps:
            if not lasts:
                wrong, places = _draw_wrong(bench, random, share), _draw_places(bench, random)
            step.points[wrong] = places[wrong] + noise_of(random, (len(wrong),))
        yield from session.play(seed, steps)


def run_clusters(plan: Plan) -> Iterator[Trial]:
    """Yields trials in which a share of the key points errs together: shifted alike, or as of another press."""
    bench = Bench(plan)
    for seed in range(plan.share(10 * len(SHARES))):
        random = plan.random("clusters", seed)
        share, alike = SHARES[seed % len(SHARES)], bool(seed // len(SHARES) % 2)
        session = open_session(bench, random, level=f"{100 * share:g} %, {'shifted' if alike else 'another press'}")
        steps = session.press()
        wrong = _draw_wrong(bench, random, share)
        shift = random.uniform(-FARTHEST_SHIFT, FARTHEST_SHIFT, 3)
        other = bench.press(random)
        elsewhere = other.keypoints(other.depth)[wrong]
        for step in steps[int(random.integers(0, len(steps) - 5)) :]:
            if alike:
                step.points[wrong] += shift
            else:
                step.points[wrong] = elsewhere + noise_of(random, (len(wrong),))
        yield from session.play(seed, steps)


def _draw_wrong(bench: Bench, random: np.random.Generator, share: float) -> NDArray:
    """Returns the indices of the key points that are wrong."""
    count = len(bench.jaw.keypoints)
    return random.permutation(count)[: round(share * count)]


def _draw_places(bench: Bench, random: np.random.Generator) -> NDArray:
    """Returns places (K, 3) [m] anywhere in the workspace."""
    return bench.jaw.keypoints + random.uniform(-WORKSPACE, WORKSPACE, bench.jaw.keypoints.shape)


FAMILIES = (
    Family(name="subsets", what="random subsets of the key points, down to none", run=run_subsets),
    Family(name="noise", what="key point noise from 0 to 10 mm, known to the tare or not", run=run_noise),
    Family(name="gross", what="up to 40 % of the key points anywhere in the workspace", run=run_gross),
    Family(name="clusters", what="up to 40 % of the key points wrong together", run=run_clusters),
)
