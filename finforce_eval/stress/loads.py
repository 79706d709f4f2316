"""Stress by loads: forces from 1e-4 to 1e3 N, a jaw that is not as modelled, targets that jump between images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from finforce_eval.stress.press import Bench
from finforce_eval.stress.session import Session, SessionStep, open_session, take_another
from finforce_eval.stress.stress import Family, Plan, Trial

FORCES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
JUMPS = ("teleport", "walk", "alternate", "between presses")
DEPTH, LEAST_DEPTH, RADIUS = 4e-3, 1e-4, 12e-3


def run_forces(plan: Plan) -> Iterator[Trial]:
    """Yields presses with 1e-4 to 1e3 N: on jaws that it bends by millimetres, and on the usual one up to 1 N."""
    usual = Bench(plan)
    for seed in range(plan.share(2 * len(FORCES))):
        random = plan.random("forces", seed)
        force = FORCES[seed % len(FORCES)]
        height = random.uniform(0.02, 0.06)
        course = usual.course(height=height, radius=RADIUS, depth=DEPTH)
        full = float(np.linalg.norm(course.forces(DEPTH)))
        if seed // len(FORCES) % 2 and force < full:
            bench, level = usual, f"{force:g} N, the usual jaw"
            depth = DEPTH * force / full
            course = replace(bench.course(height=height, radius=RADIUS, depth=max(depth, LEAST_DEPTH)), depth=depth)
        else:
            bench, level = Bench(plan, modulus=force / full), f"{force:g} N, a jaw to match"
            course = bench.course(height=height, radius=RADIUS, depth=DEPTH)
        session = open_session(bench, random, course=course, level=level)
        yield from session.play(seed, session.press())


def run_model_error(plan: Plan) -> Iterator[Trial]:
    """Yields presses of a jaw whose key points move by 1 % more or less each, and whose force is 1 % off."""
    bench = Bench(plan)
    for seed in range(plan.share(30)):
        random = plan.random("model", seed)
        session = open_session(bench, random, level="1 %")
        stretch, stiffer = 0.01 * random.normal(size=(len(bench.jaw.keypoints), 1)), 1 + 0.01 * random.normal()
        steps = []
        for step in session.press():
            way = step.points - bench.jaw.keypoints - session.offsets
            steps.append(
                replace(
                    step, points=step.points + stretch * way, force=stiffer * step.force, torque=stiffer * step.torque
                )
            )
        yield from session.play(seed, steps)


def run_jumps(plan: Plan) -> Iterator[Trial]:
    """Yields loads that jump: to any depth, in a random walk, on and off, from one press to another."""
    bench = Bench(plan)
    for seed in range(plan.share(8 * len(JUMPS))):
        random = plan.random("jumps", seed)
        kind = JUMPS[seed % len(JUMPS)]
        session = open_session(bench, random, level=kind)
        yield from session.play(seed, _jump(session, kind, random))


def _jump(session: Session, kind: str, random: np.random.Generator, count: int = 60) -> list[SessionStep]:
    """Returns `count` steps whose depth changes as `kind` says."""
    deepest = session.course.depth
    if kind == "teleport":
        return session.steps(np.repeat(random.uniform(0.0, deepest, count // 4), 4))
    if kind == "walk":
        walk = np.cumsum(random.normal(0.0, 0.2 * deepest, count))
        return session.steps(np.abs((walk + deepest) % (2 * deepest) - deepest))
    if kind == "alternate":
        return session.steps(np.where(np.arange(count) % 2, deepest, 0.0))
    other = take_another(session, random)
    first, second = session.steps(np.full(count, deepest)), other.steps(np.full(count, other.course.depth))
    return [pair[i // 10 % 2] for i, pair in enumerate(zip(first, second, strict=True))]


FAMILIES = (
    Family(name="forces", what="forces from 1e-4 to 1e3 N", run=run_forces, timed=False),
    Family(name="model", what="a jaw that is 1 % off its model", run=run_model_error),
    Family(name="jumps", what="targets that jump between images", run=run_jumps),
)
