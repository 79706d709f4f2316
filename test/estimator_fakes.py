"""Recordings of a pressed bench finger, made from a finer mesh than the estimators', with seeded camera noise."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from mechanics_fakes import BENCH, MODULUS, bench_mechanics, bench_press

from finforce_ifea.calibration import Calibration
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.settings import EstimatorSettings

PERIOD = 1 / 30
CALIBRATION = Calibration(young_modulus=MODULUS, force_error=0.01)
# Standard deviations [m] of a key point across and along the line of sight, and of its constant offset.
ACROSS, ALONG, OFFSET = 0.2e-3, 0.45e-3, 0.35e-3
SIGHT = np.array([0.25, -0.95, 0.18]) / np.linalg.norm([0.25, -0.95, 0.18])
_DEPTHS = tuple(np.arange(0.5, 8.01, 0.5))


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


@cache
def true_curve(diameter, height):
    """Depths (d,) [m], key points (d, K, 3) [m] and forces (d, 3) [N] of a cylinder [mm] at a height [mm]."""
    model = bench_mechanics("fine").model
    probe = model.attach(BENCH.keypoints, 1e-3)
    results = bench_press("fine", "solid", diameter, height, _DEPTHS)
    points = [BENCH.keypoints] + [model.positions(probe, result.q) for result in results]
    forces = [np.zeros(3)] + [result.force for result in results]
    return 1e-3 * np.r_[0.0, _DEPTHS], np.array(points), np.array(forces)


def ramp(*stops, speed=2e-3, hold=1.0, rest=2.0):
    """Depths (n,) [m] frame by frame: at rest, then to each stop [mm] and held there."""
    depths = [np.zeros(round(rest / PERIOD))]
    for stop in stops:
        start, end = depths[-1][-1], 1e-3 * stop
        steps = max(1, round(abs(end - start) / speed / PERIOD))
        depths += [np.linspace(start, end, steps + 1)[1:], np.full(round(hold / PERIOD), end)]
    return np.concatenate(depths)


def record(depths, *, diameter=25, height=40, seed=0, noise=1.0, offsets=1.0, common=np.zeros(3)):
    """Key points of a press with noise and offsets, as shares of the bench's, and an offset common to all [m]."""
    random = np.random.default_rng(seed)
    grid, points, forces = true_curve(diameter, height)
    take = lambda table: np.stack(  # noqa: E731
        [np.interp(depths, grid, column) for column in table.reshape(len(grid), -1).T], axis=1
    ).reshape(len(depths), *table.shape[1:])
    clean = take(points)
    scatter = noise * ACROSS * random.normal(size=clean.shape)
    scatter += noise * ALONG * random.normal(size=(*clean.shape[:2], 1)) * SIGHT
    constant = offsets * OFFSET * random.normal(size=BENCH.keypoints.shape) / np.sqrt(3) + common
    measured = clean + scatter + constant
    likelihood = random.uniform(0.8, 1.0, clean.shape[:2])
    observations = [
        Observation(stamp=10.0 + PERIOD * (i + 1), points=measured[i], likelihood=likelihood[i]) for i in range(len(depths))
    ]
    return Recording(
        observations=observations, contact=Contact.fixed(BENCH, 1e-3 * height), depths=depths, forces=take(forces)
    )


def make_estimator(jaw=BENCH, *, calibration=CALIBRATION, **options):
    return JawEstimator(jaw, settings=EstimatorSettings(**options), calibration=calibration)


def run(recording, estimator=None, contact=None, **options):
    """The solutions of a recording, from an estimator that starts anew."""
    estimator = estimator or make_estimator(**options)
    contact = recording.contact if contact is None else contact
    return [estimator.update(observation, contact) for observation in recording.observations]


def magnitudes(solutions):
    """Magnitudes of the forces [N], NaN where they are not trusted."""
    return np.array([np.linalg.norm(s.force) if s.trusted else np.nan for s in solutions])


def errors(recording, solutions):
    """Errors of the magnitudes [N]; NaN where they are not trusted."""
    return magnitudes(solutions) - np.linalg.norm(recording.forces, axis=1)
