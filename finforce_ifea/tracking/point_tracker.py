"""Force at a given contact from key points, frame after frame: the load sits where it is told to."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import ObservationError
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics
from finforce_ifea.errors import NotEnoughDataError, UnobservableError
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw
from finforce_ifea.observation import Contact
from finforce_ifea.paper_inverse import InverseResult, Problem, solve_inverse
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import Tare
from finforce_ifea.tracking.place_watch import PlaceWatch, blank_doubt
from finforce_ifea.tracking.rest_response import RestResponse
from finforce_ifea.tracking.track import Track, compute_magnitude_stddev, explain_offsets

_NEIGHBOUR = 1e-3
_KNOWN_LOADS = 32
_QUIET_SIGMA = 3.0
# Share of the model's reach in the last Newton step.
_SETTLED = 5e-3
_FARTHEST_MOVE = 0.2
# The median of |miss|^2 / variance is this for a normal distribution in three axes.
_MEDIAN_SQUARE = 2.4
# A load held at one height leaves more of the shape unexplained than a rolling one does.
_TOLERATED_MISFIT = 2.0


class PointTracker:
    """Solves the inverse problem of each frame from the last state.

    With solver "paper" the load is a point force on the nearest candidate, all accepted key points count alike, and
    each frame makes one linear step; otherwise the load spreads across the width at the contact's own height, key
    points are weighted by their agreement, and the state is brought to equilibrium.
    """

    def __init__(self, jaw: Jaw, mechanics: Mechanics, settings: EstimatorSettings, response: RestResponse) -> None:
        """Attaches the key points, `response` being that of the unloaded jaw; raises MeshError when one is off it."""
        self._watch = PlaceWatch(response, settings)
        self.jaw, self.mechanics, self.settings = jaw, mechanics, settings
        self.paper = settings.solver == "paper"
        self.probe = mechanics.model.attach(jaw.keypoints, KEYPOINT_DISTANCE)
        self._rest = mechanics.model.positions(self.probe, np.zeros(mechanics.model.size))
        self._energy_weights = parse_energy_weights(settings, len(jaw.candidates))
        self._known: dict[tuple[float, ...], tuple[Any, Any]] = {}
        self._load = lru_cache(maxsize=256)(self._build_load)
        self.reset()

    def reset(self) -> None:
        """Starts anew, unloaded, with the middle candidate."""
        self.q = np.zeros(self.mechanics.model.size)
        self._misfit = 1.0
        self._watch.reset()
        self._candidate = len(self.jaw.candidates) // 2
        self._heights = (float(self.jaw.candidates[self._candidate, 2]),)
        self._weights: NDArray | None = np.ones(1)

    def follow(self, contact: Contact) -> None:
        """Takes a contact over: its heights and weights."""
        heights = contact.points[:, 2]
        if self.paper:
            middle = np.average(heights, weights=contact.weights)
            self._candidate = int(np.argmin(np.abs(self.jaw.candidates[:, 2] - middle)))
            self._heights, self._weights = (float(self.jaw.candidates[self._candidate, 2]),), np.ones(1)
            return
        self._heights = tuple(np.round(heights, 5).tolist())
        self._watch.follow(heights, contact.weights)
        self._weights = np.asarray(contact.weights, float)

    def _build_load(self, height: float) -> tuple[NDArray, NDArray]:
        """Returns the points of a load at one height and their neighbours along the finger."""
        surface = self.mechanics.contact.surface
        if self.paper:
            points = np.array([[self.jaw.inner_face_x, 0.0, height]])
        else:
            row = int(np.argmin(np.abs(surface.heights - height)))
            points = surface.points[row * surface.across : (row + 1) * surface.across].copy()
            points[:, 2] = np.clip(height, surface.heights[0], surface.heights[-1])
        low, high = surface.heights[0], surface.heights[-1]
        shifted = np.repeat(points, 2, axis=0)
        shifted[::2, 2] = np.clip(points[:, 2] - _NEIGHBOUR, low, high)
        shifted[1::2, 2] = np.clip(points[:, 2] + _NEIGHBOUR, low, high)
        return points, shifted

    def _problem(self, targets: NDArray, precision: NDArray | None) -> Problem:
        parts = [self._load(height) for height in self._heights]
        points = np.concatenate([part[0] for part in parts])
        shares = np.repeat(self._weights, [len(part[0]) for part in parts])
        key = tuple(self._heights)
        contacts, neighbours = self._probes(key, points, np.concatenate([part[1] for part in parts]))
        return Problem(
            effectors=self.probe,
            targets=targets,
            contacts=contacts,
            neighbours=neighbours,
            weights=shares,
            axes="three" if self.settings.force_axes == "three" else "normal",
            precision=precision,
            energy_weight=self._energy_weights[self._candidate] if self.paper else 0.0,
            energy_form=self.settings.energy_form,
        )

    def _probes(self, key: tuple[float, ...], points: NDArray, neighbours: NDArray) -> tuple[Any, Any]:
        """Returns the probes of a load's points and neighbours; those of the last loads are kept."""
        if key not in self._known:
            if len(self._known) >= _KNOWN_LOADS:
                del self._known[next(iter(self._known))]
            model = self.mechanics.model
            self._known[key] = (model.attach(points, 1e-3), model.attach(neighbours, 1e-3))
        self._probe_pair = self._known[key]
        return self._probe_pair

    def update(self, points: NDArray, tare: Tare, dt: float, stddev: NDArray | None = None) -> Track | None:
        """Takes the key points (K, 3) [m], NaN where unused; returns None when too few are left.

        `stddev` (K, 3) [m] are their stated standard deviations.

        Raises:
            UnobservableError: They do not tell the force.
        """
        targets = points - tare.offsets
        known = np.isfinite(targets[:, 0])
        noise = tare.point_noise(stddev)
        scatter = np.trace(noise.plane, axis1=1, axis2=2) / 2.0 / noise.trust
        variance = scatter + noise.standing + tare.offset_variance(self.settings.offset_stddev)
        try:
            if self.paper:
                result, weights = self._solve(targets, None), known.astype(float)
            else:
                before = self._reweigh(targets, self.q, variance, known)
                result = self._solve(targets, before / variance)
                weights = self._reweigh(targets, result.q, variance, known)
        except UnobservableError:
            raise
        except NotEnoughDataError:
            return None
        self.q = result.q
        return self._report(result, targets, weights, variance)

    def _solve(self, targets: NDArray, precision: NDArray | None) -> InverseResult:
        steps = 1 if self.paper else self.settings.iterations
        problem = self._problem(targets, precision)
        return solve_inverse(self.mechanics.model, problem, self.q, iterations=steps, tolerance=_SETTLED)

    def _reweigh(self, targets: NDArray, q: NDArray, variance: NDArray, known: NDArray) -> NDArray:
        """Returns weights (K,) that fall with the distance from the shape found; the median sets their scale."""
        miss = np.where(known[:, None], self.mechanics.model.positions(self.probe, q) - targets, 0.0)
        distance = (miss**2).sum(1) / variance
        scale = max(1.0, float(np.median(distance[known])) / _MEDIAN_SQUARE)
        self._misfit = np.sqrt(scale) / _TOLERATED_MISFIT
        return np.where(known, 1.0 / (1.0 + distance / scale / self.settings.gate**2) ** 2, 0.0)

    def _report(self, result: InverseResult, targets: NDArray, weights: NDArray, variance: NDArray) -> Track:
        force = result.forces.sum(0)
        size = np.linalg.norm(result.forces, axis=1)
        share = size / size.sum() if size.any() else np.full(len(size), 1.0 / len(size))
        undeformed = np.concatenate([self._load(height)[0] for height in self._heights])
        deformed = self.mechanics.model.positions(self._probe_pair[0], result.q)
        covariance = result.covariance
        if self.paper:
            covariance = covariance * float(np.mean(variance[np.isfinite(targets[:, 0])]))
            covariance += np.outer(result.bias, result.bias)
        magnitude = float(np.linalg.norm(force))
        stddev = compute_magnitude_stddev(force, result.directions, covariance)
        moves = self.mechanics.model.positions(self.probe, result.q) - self._rest
        doubt = blank_doubt()
        if result.converged and not self.paper:
            miss = targets - self.mechanics.model.positions(self.probe, result.q)
            doubt = self._watch.doubt(miss[:, ::2], weights / variance, magnitude)
        return Track(
            covariance=covariance,
            force=force,
            force_modes=result.directions,
            pressure_point=share @ deformed,
            pressure_place=share @ undeformed,
            weights=weights,
            stiffening=1.0,
            residual=result.residual,
            misfit=self._misfit,
            away=doubt.away,
            mistaken=doubt.mistaken,
            place_error=doubt.share,
            place_stddev=doubt.stddev,
            condition=result.condition,
            kkt=result.kkt,
            iterations=result.iterations,
            converged=result.converged,
            sound=bool(
                np.isfinite(result.q).all()
                and np.isfinite(force).all()
                and result.smallest_det > 0
                and np.abs(moves).max() < _FARTHEST_MOVE
            ),
            quiet=magnitude < _QUIET_SIGMA * stddev,
            loaded=magnitude > 2.0 * _QUIET_SIGMA * stddev,
        )

    def significance(self, tare: Tare, stddev: float) -> float:
        """Returns by how many standard deviations a force explains the offsets of a tare; see `explain_offsets`."""
        model, q = self.mechanics.model, np.zeros(self.mechanics.model.size)
        problem = self._problem(np.array(self._rest), None)
        load = model.load(problem.contacts, q, np.tile([-1.0, 0.0, 0.0], (len(problem.weights), 1)))
        mode = model.factorise(model.linearize(q).tangent).solve(load)
        modes = model.project(self.probe, q, mode[:, None])[:, [0, 2], 0]
        return explain_offsets(modes, tare, stddev)


def parse_energy_weights(settings: EstimatorSettings, count: int) -> NDArray:
    """Returns the energy weight of each of `count` candidates (count,).

    Raises:
        ObservationError: `energy_weights` is not empty and does not hold one number, zero or above, per candidate.
    """
    if not settings.energy_weights.strip():
        return np.full(count, settings.energy_weight)
    try:
        weights = np.array([float(part) for part in settings.energy_weights.split(",")])
    except ValueError as error:
        raise ObservationError(f"energy_weights: {error}, expected {count} numbers") from error
    if len(weights) != count or not (np.isfinite(weights).all() and (weights >= 0).all()):
        raise ObservationError(f"energy_weights: got {len(weights)} numbers, expected {count} of zero or above")
    return weights
