"""Stress by friction that nobody has stated: grasps in and out of objects of any coefficient, from the first one on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from finforce_ifea.contact_mechanics.indenter import OutlineIndenter, RoundIndenter
from finforce_ifea.errors import ContactError
from finforce_ifea.observation import Contact
from finforce_ifea.settings import EstimatorSettings
from lab.presses import PressHistory, rub_jaw
from lab.stress.objects import rectangle
from lab.stress.session import POSE, Bench, open_session, tell_pose
from lab.stress.stress import Family, Plan, Trial

# Coefficients of friction that are drawn [-]: bounds of each level.
_LEVELS = ((0.0, 0.0), (0.0, 0.3), (0.3, 0.6), (0.6, 0.9))
# Depths at which a path turns, as shares of the deepest: a first loading with a short way back, and two cycles.
_TURNS = (0.0, 0.6, 0.45, 1.0, 0.0, 1.0, 0.0)
# Speed of the object [m/s], and images of each hold.
_SPEED = 4e-3
_HOLD = 10
# Distance of the places at which the path is kept [m].
_SPACING = 0.05e-3
# Height [m] above which the lower edge of a box stays: what leans on the clamp is another family's.
_CLAMPED = 0.012


@dataclass(frozen=True, kw_only=True, eq=False)
class RubbedObject:
    """A drawn path in and out of an object.

    Attributes:
        history: of the press, by the length of the path.
        turns: lengths at which the path turns (t,) [m].
        polygon: outline of a box (n, 2) [m]; None for a cylinder, of which only the height is told.
        states: of the contact (p, 3), and their lengths (p,) [m].
        front: distance from the box's origin to its leading point [m].
    """

    history: PressHistory
    turns: NDArray
    polygon: NDArray | None
    states: tuple[NDArray, NDArray]
    front: float

    def tell(self, bench: Bench, length: float, off: NDArray) -> Contact:
        """Return the outline at a length of the path [m], its pose off by x, z [m] and turn [rad] (3,)."""
        state = np.array([np.interp(length, self.states[1], column) for column in self.states[0].T])
        return tell_pose(bench, self.polygon, self.front, state, off)


def rub(bench: Bench, random: np.random.Generator, coefficient: float, *, flat: bool) -> RubbedObject:
    """Return a drawn path in and out of a box, if it is flat, or of a cylinder.

    The truth is the estimator's own mechanics. A path without equilibrium is drawn anew.
    """
    contact = bench.estimator.mechanics.contact
    probe = contact.model.attach(bench.jaw.keypoints, max_distance=1.0)
    while True:
        height, shape, polygon = bench.find_height(random.uniform(0.022, 0.060)), random.uniform(6e-3, 20e-3), None
        if flat:
            polygon, shape = _draw_box(random, height), random.uniform(-0.05, 0.05)
        contact.set_indenter(OutlineIndenter((polygon,)) if flat else RoundIndenter())
        turns = bench.find_depth(random.uniform(2e-3, 7e-3)) * np.array(_TURNS)
        lengths = np.concatenate([[0.0], np.abs(np.diff(turns)).cumsum()])
        path = np.unique(np.r_[np.arange(0.0, lengths[-1], _SPACING), lengths])
        touch = contact.find_touch(np.array([0.0, shape, height]))
        states = np.array([[touch + depth, shape, height] for depth in np.interp(path, lengths, turns)])
        try:
            rubbed = rub_jaw(contact, states, coefficient)
        except ContactError:
            continue
        forces = np.array([pressed.force if pressed.touches else np.zeros(3) for _, pressed in rubbed])
        centres = np.array([pressed.pressure_point if pressed.touches else np.zeros(3) for _, pressed in rubbed])
        keypoints = [contact.model.positions(probe, q) for q, _ in rubbed]
        history = PressHistory(
            height=height,
            radius=shape,
            depth=float(lengths[-1]),
            keypoints=PchipInterpolator(path, keypoints),
            forces=PchipInterpolator(path, forces),
            torques=PchipInterpolator(path, np.cross(centres, forces)),
        )
        front = contact.indenter.pressed.front
        return RubbedObject(history=history, turns=lengths, polygon=polygon, states=(states, path), front=front)


def _draw_box(random: np.random.Generator, height: float) -> NDArray:
    """Return the outline (4, 2) [m] of a box at a height [m]."""
    return rectangle(random.uniform(0.012, min(2.0 * (height - _CLAMPED), 0.045)), random.uniform(0.020, 0.045))


def run_friction(plan: Plan) -> Iterator[Trial]:
    """Yield grasps of objects whose friction is not stated, each of them new."""
    stated = EstimatorSettings()
    bench = Bench(plan, friction=stated.friction, friction_stddev=stated.friction_stddev)
    for seed in range(plan.share(4 * len(_LEVELS))):
        (low, high), flat = _LEVELS[seed % len(_LEVELS)], seed // len(_LEVELS) % 2 == 1
        random = plan.random("friction", seed)
        rubbed = rub(bench, random, float(random.uniform(low, high)), flat=flat)
        bench.estimator.forget()
        level = f"friction {low:g} to {high:g}, {'box' if flat else 'cylinder'}"
        session = open_session(bench, random, history=rubbed.history, level=level)
        images, off = _plan_images(rubbed.turns), POSE * random.normal(size=3)
        steps = session.steps(images)
        if flat:
            steps = [replace(s, contact=rubbed.tell(bench, w, off)) for s, w in zip(steps, images, strict=True)]
        yield from session.play(seed, steps)


def _plan_images(lengths: NDArray) -> NDArray:
    """Return the way of each image (n,) [m] along a path that is held where it turns."""
    parts = [np.zeros(3)]
    for start, end in zip(lengths[:-1], lengths[1:], strict=True):
        count = max(round((end - start) / _SPEED * 30.0), 1)
        parts += [np.linspace(start, end, count + 1)[1:], np.full(_HOLD, end)]
    return np.concatenate(parts)


FAMILIES = (
    Family(
        name="friction",
        what="objects of any friction, in and out, from the first grasp on",
        run=run_friction,
        least_sure=0.9,
    ),
)
