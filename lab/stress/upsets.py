"""Stress by what goes wrong around a jaw: a camera that is bumped or hangs, points that creep, contacts that walk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.observation import Contact
from lab.stress.inputs import FARTHEST_SHIFT, draw_wrong
from lab.stress.session import Bench, Session, SessionStep, open_session
from lab.stress.stress import Family, Plan, Trial

HOLD = 80
# What moves all key points at once: along x, y and z [m], and a turn about the camera [rad].
BUMPS = {"0.5 mm": (0.5e-3, 0.0), "2 mm": (2e-3, 0.0), "1 degree": (0.0, np.radians(1.0))}
CAMERA_DISTANCE = 0.11
CREEPING, CREEP = 5, 0.1e-3
WALK = 2e-3
TOGETHER = 8 / 15


def run_upsets(plan: Plan) -> Iterator[Trial]:
    """Yield presses that are held while something goes wrong."""
    bench = Bench(plan)
    for seed in range(plan.share(8 * len(UPSETS))):
        kind = tuple(UPSETS)[seed % len(UPSETS)]
        random = plan.random("upsets", seed)
        session = open_session(bench, random, level=kind)
        steps = session.press(hold=HOLD)
        start = int(random.integers(4, 50))
        yield from session.play(seed, steps[:start] + UPSETS[kind](session, steps[start:], random))


def _bump(kind: str) -> Callable[[Session, list[SessionStep], np.random.Generator], list[SessionStep]]:
    """Return what moves all key points as a bumped camera does."""

    def bump(session: Session, steps: list[SessionStep], random: np.random.Generator) -> list[SessionStep]:
        shift, turn = BUMPS[kind]
        way = random.normal(size=3)
        way *= shift / np.linalg.norm(way)
        axis = random.normal(size=3)
        axis *= turn / np.linalg.norm(axis)
        camera = session.bench.jaw.keypoints.mean(0) + [0.0, CAMERA_DISTANCE, 0.0]
        return [replace(s, points=s.points + way + np.cross(axis, s.points - camera)) for s in steps]

    return bump


def _freeze(_session: Session, steps: list[SessionStep], _random: np.random.Generator) -> list[SessionStep]:
    """Show one image for ever while the force falls."""
    gone = np.linspace(1.0, 0.0, len(steps))
    return [
        replace(s, points=steps[0].points.copy(), force=share * s.force, torque=share * s.torque)
        for s, share in zip(steps, gone, strict=True)
    ]


def _creep(_session: Session, steps: list[SessionStep], random: np.random.Generator) -> list[SessionStep]:
    """Let five key points creep, each its own way."""
    points = random.permutation(len(steps[0].points))[:CREEPING]
    way = random.normal(size=(CREEPING, 3))
    way *= CREEP / np.linalg.norm(way, axis=1)[:, None]
    return [_shift(step, points, way * (index + 1)) for index, step in enumerate(steps)]


def _walk(session: Session, steps: list[SessionStep], random: np.random.Generator) -> list[SessionStep]:
    """Let the stated contact walk along the jaw, which the force does not."""
    heights = session.bench.jaw.candidates[:, 2]
    here, sign = session.history.height, random.choice([-1.0, 1.0])
    walked = [np.clip(here + sign * WALK * (i + 1), heights[0], heights[-1]) for i in range(len(steps))]
    return [
        replace(step, contact=Contact.fixed(session.bench.jaw, float(height)))
        for step, height in zip(steps, walked, strict=True)
    ]


def _err_together(session: Session, steps: list[SessionStep], random: np.random.Generator) -> list[SessionStep]:
    """Shift more than half of the key points alike."""
    points = draw_wrong(session.bench, random, TOGETHER)
    shift = random.uniform(-FARTHEST_SHIFT, FARTHEST_SHIFT, 3)
    return [_shift(step, points, shift) for step in steps]


def _shift(step: SessionStep, points: NDArray, way: NDArray) -> SessionStep:
    moved = step.points.copy()
    moved[points] += way
    return replace(step, points=moved)


UPSETS = {
    "camera moved by 0.5 mm": _bump("0.5 mm"),
    "camera moved by 2 mm": _bump("2 mm"),
    "camera turned by 1 degree": _bump("1 degree"),
    "frozen camera": _freeze,
    "five points creep": _creep,
    "stated contact walks": _walk,
    "more than half of the points off together": _err_together,
}
FAMILIES = (Family(name="upsets", what="bumped and frozen cameras, creeping points, walking contacts", run=run_upsets),)
