"""Recordings of a pressed bench finger: shapes and forces of an independent program, with seeded camera noise.

lab/data/pressed_bench.npz is described in test_truth.py.
"""

from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from mechanics_fakes import BENCH, MODULUS, bench_mechanics
from scipy.interpolate import PchipInterpolator

from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE
from finforce_ifea.observation import Contact, ObjectOutline, Observation, Solution
from finforce_ifea.settings import EstimatorSettings
from lab.presses import RigidOutline, press_jaw
from lab.stress.session import FRICTIONLESS

PERIOD = 1 / 30
# The objects of the truth have no friction.
SMOOTH = FRICTIONLESS
TRUTH = np.load(Path(__file__).parents[2] / "lab" / "data" / "pressed_bench.npz")
PLACES = {20: "lower", 40: "middle", 60: "upper"}
# The modulus of the truth; the mechanics is 2 % off on the average, see test_truth.py.
CALIBRATION = Calibration(young_modulus=MODULUS, force_error=0.02)
# Standard deviations [m] of a key point across and along the line of sight, and of its constant offset.
ACROSS, ALONG, OFFSET = 0.2e-3, 0.45e-3, 0.35e-3
SIGHT = np.array([0.25, -0.95, 0.18]) / np.linalg.norm([0.25, -0.95, 0.18])


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Observations of a finger with the truth behind them: depths (n,) [m] and forces (n, 3) [N]."""

    observations: list
    contact: Contact
    depths: np.ndarray
    forces: np.ndarray

    def changed(self, frames, change):
        """A copy in which change(points, likelihood) has edited the copies of some frames in place."""
        observations = list(self.observations)
        for i in frames:
            points, likelihood = observations[i].points.copy(), observations[i].likelihood.copy()
            change(points, likelihood)
            observations[i] = replace(observations[i], points=points, likelihood=likelihood)
        return replace(self, observations=observations)

    def first(self, count):
        """The first frames alone."""
        return replace(self, observations=self.observations[:count], forces=self.forces[:count])


def true_course(depths, diameter, height):
    """Key points (n, K, 3) [m] and forces (n, 3) [N] at depths (n,) [m] of a cylinder [mm] at a height [mm]."""
    name = f"{diameter}_{PLACES[height]}"
    grid = np.r_[0.0, 1e-3 * TRUTH[f"{name}_depth"]]
    moved = TRUTH[f"{name}_keypoints"] - TRUTH["keypoints0"]
    points = PchipInterpolator(grid, np.concatenate([0 * moved[:1], moved]))(depths)
    forces = PchipInterpolator(grid, np.concatenate([np.zeros((1, 3)), TRUTH[f"{name}_force"]]))(depths)
    return BENCH.keypoints + 1e-3 * points, forces


def ramp(*stops, speed=2e-3, hold=1.0, rest=2.0):
    """Depths (n,) [m] frame by frame: at rest, then to each stop [mm] and held there."""
    depths = [np.zeros(round(rest / PERIOD))]
    for stop in stops:
        start, end = depths[-1][-1], 1e-3 * stop
        steps = max(1, round(abs(end - start) / speed / PERIOD))
        depths += [np.linspace(start, end, steps + 1)[1:], np.full(round(hold / PERIOD), end)]
    return np.concatenate(depths)


def record(depths, *, diameter=25, height=40, seed=0, noise=1.0, offsets=1.0, common=(0.0, 0.0, 0.0)):
    """Key points of a press with noise and offsets, as shares of the bench's, and an offset common to all [m]."""
    random = np.random.default_rng(seed)
    clean, forces = true_course(depths, diameter, height)
    scatter = noise * ACROSS * random.normal(size=clean.shape)
    scatter += noise * ALONG * random.normal(size=(*clean.shape[:2], 1)) * SIGHT
    constant = offsets * OFFSET / np.sqrt(3) * np.random.default_rng([seed, 1]).normal(
        size=BENCH.keypoints.shape
    ) + np.array(common)
    measured = clean + scatter + constant
    likelihood = random.uniform(0.8, 1.0, clean.shape[:2])
    observations = [
        Observation(stamp=10.0 + PERIOD * (i + 1), points=measured[i], likelihood=likelihood[i])
        for i in range(len(depths))
    ]
    return Recording(
        observations=observations, contact=Contact.fixed(BENCH, 1e-3 * height), depths=depths, forces=forces
    )


def make_estimator(jaw=BENCH, *, calibration=CALIBRATION, **options):
    return ForceEstimator(jaw, settings=EstimatorSettings(**{**SMOOTH, **options}), calibration=calibration)


@lru_cache(maxsize=8)
def kept_estimator(**options):
    """An estimator for many tests: building one takes as long as a recording, and `reset` forgets everything."""
    return make_estimator(**options)


def run(recording, estimator=None, contact=None, **options):
    """The solutions of a recording, from an estimator that starts anew."""
    if estimator is None:
        estimator = kept_estimator(**options)
        estimator.reset()
    contact = recording.contact if contact is None else contact
    return [estimator.update(observation, contact) for observation in recording.observations]


def magnitudes(solutions):
    """Magnitudes of the forces [N], NaN where they are not trusted."""
    return np.array([np.linalg.norm(s.force) if s.trusted else np.nan for s in solutions])


def errors(recording, solutions):
    """Errors of the magnitudes [N]; NaN where they are not trusted."""
    return magnitudes(solutions) - np.linalg.norm(recording.forces, axis=1)


MODELS = ["solid", "frame"]
STEPS = ramp(2, 5, 3, 0)
# Frames of STEPS: rest to 60, 2 mm from 90, 5 mm from 165, 3 mm from 225, rest from 300 to 330.
REST, HELD_5 = 60, 190


@cache
def pressed(height=40, *, seed=0, diameter=25):
    """Two seconds of rest, then 2, 5, 3 and 0 mm at 2 mm/s, each held for a second."""
    return record(STEPS, diameter=diameter, height=height, seed=seed)


@cache
def solved(height=40, solver="frame", *, seed=0, diameter=25):
    return run(pressed(height, seed=seed, diameter=diameter), solver=solver)


def loaded_frames(recording):
    return np.linalg.norm(recording.forces, axis=1) > 0.1


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


def statuses(solutions):
    return {solution.status for solution in solutions}


def assert_identical(first, second):
    for left, right in zip(first, second, strict=True):
        for name in Solution._fields:
            np.testing.assert_array_equal(getattr(left, name), getattr(right, name), err_msg=name)


STDDEV = np.array([1e-4, 1e-4, 3e-3])


def circle(radius, corners=180):
    angles = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    return (radius * np.stack([np.cos(angles), np.sin(angles)], axis=1),)


def box(half_x, half_z):
    return (np.array([[-half_x, -half_z], [half_x, -half_z], [half_x, half_z], [-half_x, half_z]]),)


WEDGE = (np.array([[-0.012, -0.004], [0.02, -0.02], [0.02, 0.02], [-0.006, 0.016]]),)
SHAPES = {"circle": circle(0.0125), "box": box(0.010, 0.0125), "wedge": WEDGE}


def outline(polygons, height, tilt=0.0, x=0.03):
    return ObjectOutline(polygons=polygons, origin=np.array([x, height]), tilt=tilt, stddev=STDDEV)


def contact_with(polygons, height, tilt=0.0):
    point = np.array([[BENCH.inner_face_x, 0.0, height]])
    return Contact(points=point, weights=np.ones(1), outline=outline(polygons, height, tilt))


@cache
def press_shape(name, height, tilt=0.0, depths=(0.002, 0.004, 0.006)):
    """Equilibria of the bench finger's default mesh."""
    mechanics = bench_mechanics("default", "solid")
    return press_jaw(
        mechanics.model,
        mechanics.contact.surface,
        BENCH.inner_face_x,
        RigidOutline(SHAPES[name], 0.08, tilt),
        height,
        depths,
    )


def observe(results, *, rest=60, ramp=15, hold=30, seed=0):
    """Noisy observations of an unloaded jaw that is then pressed to each equilibrium; yields (observation, force)."""
    mechanics = bench_mechanics("default", "solid")
    probe, random = mechanics.model.attach(BENCH.keypoints, KEYPOINT_DISTANCE), np.random.default_rng(seed)
    offsets = 0.2e-3 * random.normal(size=BENCH.keypoints.shape)
    shapes = [(BENCH.keypoints, None)] * rest
    last = BENCH.keypoints
    for result in results:
        points = mechanics.model.positions(probe, result.q)
        shapes += [(last + share * (points - last), None) for share in np.linspace(0, 1, ramp + 1)[1:]]
        shapes += [(points, float(np.linalg.norm(result.force)))] * hold
        last = points
    for i, (points, force) in enumerate(shapes):
        scatter = ACROSS * random.normal(size=points.shape) + ALONG * random.normal(size=(len(points), 1)) * SIGHT
        likelihood = np.full(len(points), 0.9)
        yield Observation(stamp=PERIOD * (i + 1), points=points + scatter + offsets, likelihood=likelihood), force
