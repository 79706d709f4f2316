"""Stress by friction that nobody has stated: grasps in and out of objects of any coefficient, from the first one on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.interpolate import PchipInterpolator

from finforce_ifea.contact_mechanics.indenter import RoundIndenter
from finforce_ifea.errors import ContactError
from finforce_ifea.settings import EstimatorSettings
from lab.presses import PressHistory, rub_jaw
from lab.stress.session import Bench, open_session
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


def rub(bench: Bench, random: np.random.Generator, coefficient: float) -> tuple[PressHistory, np.ndarray]:
    """Return a drawn path in and out of a cylinder, by its length, and the lengths at which it turns (t,) [m].

    The truth is the estimator's own mechanics. A path without equilibrium is drawn anew.
    """
    contact = bench.estimator.mechanics.contact
    probe = contact.model.attach(bench.jaw.keypoints, max_distance=1.0)
    contact.set_indenter(RoundIndenter())
    while True:
        height, radius = bench.find_height(random.uniform(0.022, 0.060)), random.uniform(6e-3, 20e-3)
        turns = bench.find_depth(random.uniform(2e-3, 7e-3)) * np.array(_TURNS)
        lengths = np.concatenate([[0.0], np.abs(np.diff(turns)).cumsum()])
        path = np.unique(np.r_[np.arange(0.0, lengths[-1], _SPACING), lengths])
        depths = np.interp(path, lengths, turns)
        try:
            rubbed = rub_jaw(contact, [np.array([depth, radius, height]) for depth in depths], coefficient)
        except ContactError:
            continue
        forces = np.array([pressed.force if pressed.touches else np.zeros(3) for _, pressed in rubbed])
        centres = np.array([pressed.pressure_point if pressed.touches else np.zeros(3) for _, pressed in rubbed])
        keypoints = [contact.model.positions(probe, q) for q, _ in rubbed]
        history = PressHistory(
            height=height,
            radius=radius,
            depth=float(lengths[-1]),
            keypoints=PchipInterpolator(path, keypoints),
            forces=PchipInterpolator(path, forces),
            torques=PchipInterpolator(path, np.cross(centres, forces)),
        )
        return history, lengths


def run_friction(plan: Plan) -> Iterator[Trial]:
    """Yield grasps of objects whose friction is not stated, each of them new."""
    stated = EstimatorSettings()
    bench = Bench(plan, friction=stated.friction, friction_stddev=stated.friction_stddev)
    for seed in range(plan.share(2 * len(_LEVELS))):
        low, high = _LEVELS[seed % len(_LEVELS)]
        random = plan.random("friction", seed)
        history, lengths = rub(bench, random, float(random.uniform(low, high)))
        bench.estimator.forget()
        session = open_session(bench, random, history=history, level=f"friction {low:g} to {high:g}")
        yield from session.play(seed, session.steps(_plan_images(lengths)))


def _plan_images(lengths: np.ndarray) -> np.ndarray:
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
