"""Stress by what goes wrong around a jaw: a camera that is bumped or hangs, points that creep, contacts that walk."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.observation import Contact
from lab.stress.inputs import FARTHEST_SHIFT, draw_wrong, press_family
from lab.stress.session import Session, SessionStep

Upset = Callable[[Session, list[SessionStep]], list[SessionStep]]
HOLD = 80
# Images of rest before an upset, and a time before which it comes.
FIRST, LAST = 4, 50
CAMERA_DISTANCE = 0.11
CREEPING, CREEP = 5, 0.1e-3
WALK = 2e-3
TOGETHER = 8 / 15


def upset_hold(session: Session, upset: Upset) -> Iterable[SessionStep]:
    """Return a press in which something goes wrong, mostly while it is held."""
    steps = session.press(hold=HOLD)
    start = int(session.random.integers(FIRST, LAST))
    return steps[:start] + upset(session, steps[start:])


def bump_camera(shift: float, turn: float) -> Upset:
    """Return what moves all key points as a camera that is shifted [m] and turned [rad] does."""

    def bump(session: Session, steps: list[SessionStep]) -> list[SessionStep]:
        way, axis = (_draw_way(session, length) for length in (shift, turn))
        camera = session.bench.jaw.keypoints.mean(0) + [0.0, CAMERA_DISTANCE, 0.0]
        return [replace(s, points=s.points + way + np.cross(axis, s.points - camera)) for s in steps]

    return bump


def freeze_camera(_session: Session, steps: list[SessionStep]) -> list[SessionStep]:
    """Show one image for ever while the force falls."""
    gone = np.linspace(1.0, 0.0, len(steps))
    return [
        replace(s, points=steps[0].points.copy(), force=share * s.force, torque=share * s.torque)
        for s, share in zip(steps, gone, strict=True)
    ]


def let_points_creep(session: Session, steps: list[SessionStep]) -> list[SessionStep]:
    """Let five key points creep, each its own way."""
    creeping = session.random.permutation(len(session.bench.jaw.keypoints))[:CREEPING]
    way = np.stack([_draw_way(session, CREEP) for _ in creeping])
    for index, step in enumerate(steps):
        step.points[creeping] += way * (index + 1)
    return steps


def let_contact_walk(session: Session, steps: list[SessionStep]) -> list[SessionStep]:
    """Let the stated contact walk along the jaw, which the force does not."""
    heights = session.bench.jaw.candidates[:, 2]
    walk = session.random.choice([-WALK, WALK]) * np.arange(1, len(steps) + 1)
    walked = np.clip(session.history.height + walk, heights[0], heights[-1])
    return [
        replace(step, contact=Contact.fixed(session.bench.jaw, float(height)))
        for step, height in zip(steps, walked, strict=True)
    ]


def shift_most(session: Session, steps: list[SessionStep]) -> list[SessionStep]:
    """Shift more than half of the key points alike."""
    wrong = draw_wrong(session, TOGETHER)
    shift = session.random.uniform(-FARTHEST_SHIFT, FARTHEST_SHIFT, 3)
    for step in steps:
        step.points[wrong] += shift
    return steps


def _draw_way(session: Session, length: float) -> NDArray:
    """Return a vector (3,) of some length in any direction."""
    way = session.random.normal(size=3)
    return way * (length / np.linalg.norm(way))


UPSETS: dict[str, Upset] = {
    "camera moved by 0.5 mm": bump_camera(0.5e-3, 0.0),
    "camera moved by 2 mm": bump_camera(2e-3, 0.0),
    "camera turned by 1 degree": bump_camera(0.0, np.radians(1.0)),
    "frozen camera": freeze_camera,
    "five points creep": let_points_creep,
    "stated contact walks": let_contact_walk,
    "more than half of the points off together": shift_most,
}
FAMILIES = (
    press_family(
        "upsets",
        "bumped and frozen cameras, creeping points, walking contacts",
        lambda _: UPSETS,
        upset_hold,
        rounds=8,
    ),
)
