"""Force at a given contact from key points, and a test of its location."""

from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics
from finforce_ifea.errors import NotEnoughDataError, UnobservableError
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.paper_inverse import InverseResult, Problem, solve_inverse
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import Tare
from finforce_ifea.tracking.contact_state import (
    MIDDLE_STDDEV,
    UNSEEN_TRACTION,
    ContactState,
    blank_contact_state,
    measure_along,
)
from finforce_ifea.tracking.influence import InfluenceCoefficients, explain_offsets

_NEIGHBOUR = 1e-3
_KNOWN_LOADS = 32
_QUIET_SIGMA = 3.0
# Tolerance of the Newton steps, relative to the model's reach [-].
_SETTLED = 5e-3
_FARTHEST_MOVE = 0.2
# Weight of an image in the fraction of the last images in which a key point was seen [-].
_PRESENCE_GAIN = 0.1
# Fraction below which a key point is not used [-]: hidden points are detected now and then, on what hides them.
_LEAST_PRESENCE = 0.5
# Median of the squared distance over its variance for a normal distribution in three axes [-].
_MEDIAN_SQUARE = 2.4


class _Load(NamedTuple):
    """Points of a load (p, 3) [m], undeformed; the model's probes of them and of those shortly below and above each."""

    points: NDArray
    contacts: Any
    neighbours: Any


class GivenContactTracker:
    """Solves the inverse problem of each frame from the last state.

    With solver "paper" the load is a point force on the nearest candidate, all accepted key points count alike, and
    each frame makes one linear step; otherwise the load spreads across the width at the contact's own height, key
    points are weighted by their agreement, and the state is brought to equilibrium.
    """

    def __init__(
        self, jaw: Jaw, mechanics: Mechanics, settings: EstimatorSettings, response: InfluenceCoefficients
    ) -> None:
        """Keep the jaw, whose key points lie on it; `response` is that of the unloaded one."""
        self._watch = _LocationWatch(response, settings)
        self.jaw, self.mechanics, self.settings = jaw, mechanics, settings
        self.paper = settings.solver == "paper"
        self._attach = lru_cache(maxsize=_KNOWN_LOADS)(self._attach_load)
        self.reset()

    @cached_property
    def probe(self) -> Any:
        """The model's probe of the key points, which few need: most contacts are tracked, not given."""
        return self.mechanics.model.attach(self.jaw.keypoints, KEYPOINT_DISTANCE)

    @cached_property
    def _rest(self) -> NDArray:
        return self.mechanics.model.positions(self.probe, np.zeros(self.mechanics.model.size))

    def reset(self) -> None:
        """Restart unloaded, with the middle candidate."""
        self.q = np.zeros(self.mechanics.model.size)
        self._watch.reset()
        self._presence: NDArray | None = None
        self._candidate = len(self.jaw.candidates) // 2
        self._heights = (float(self.jaw.candidates[self._candidate, 2]),)
        self._weights: NDArray | None = np.ones(1)

    def resume(self, q: NDArray) -> None:
        """Restart from the shape (size,) of another tracker."""
        self.reset()
        self.q = q.copy()

    def vertices(self) -> NDArray:
        """Return the deformed mesh vertices (n, 3) [m], in mesh order."""
        return self.mechanics.model.vertices(self.q)

    def give_shape(self) -> NDArray:
        """Return the shape (size,) with which another tracker starts."""
        return self.q

    def follow(self, contact: Contact) -> None:
        """Set the contact's heights and weights."""
        heights = contact.points[:, 2]
        if self.paper:
            middle = np.average(heights, weights=contact.weights)
            self._candidate = int(np.argmin(np.abs(self.jaw.candidates[:, 2] - middle)))
            self._heights, self._weights = (float(self.jaw.candidates[self._candidate, 2]),), np.ones(1)
            return
        self._heights = tuple(np.round(heights, 5).tolist())
        self._watch.follow(heights, contact.weights)
        self._weights = np.asarray(contact.weights, float)

    def _attach_load(self, heights: tuple[float, ...]) -> _Load:
        """Return the points of a load at some heights, those of one height together, attached to the model."""
        surface, model, parts = self.mechanics.contact.surface, self.mechanics.model, []
        low, high = surface.heights[[0, -1]]
        for height in heights:
            if self.paper:
                parts.append(np.array([[self.jaw.face.read(height), 0.0, height]]))
                continue
            row = int(np.argmin(np.abs(surface.heights - height)))
            parts.append(surface.points[row * surface.across : (row + 1) * surface.across].copy())
            parts[-1][:, 2] = np.clip(height, low, high)
        points = np.concatenate(parts)
        beside = np.repeat(points, 2, axis=0)
        beside[:, 2] = np.clip(beside[:, 2] + np.tile([-_NEIGHBOUR, _NEIGHBOUR], len(points)), low, high)
        return _Load(points, model.attach(points, 1e-3), model.attach(beside, 1e-3))

    def _problem(self, targets: NDArray, precision: NDArray | None) -> Problem:
        load = self._attach(self._heights)
        return Problem(
            effectors=self.probe,
            targets=targets,
            contacts=load.contacts,
            neighbours=load.neighbours,
            weights=np.repeat(self._weights, len(load.points) // len(self._heights)),
            axes="three" if self.settings.force_axes == "three" else "normal",
            precision=precision,
            energy_weight=self.settings.energy_weight if self.paper else 0.0,
            energy_form=self.settings.energy_form,
        )

    def update(self, points: NDArray, tare: Tare, dt: float, observation: Observation) -> ContactState | None:
        """Take the key points of an image; return None when too few are left.

        Args:
            points: (K, 3) [m], NaN where unused.
            tare: offsets and noise.
            dt: time since the last image [s], of no use here.
            observation: that the points are of.

        Raises:
            UnobservableError: They do not tell the force.
        """
        targets = points - tare.offsets
        targets[self._follow_presence(np.isfinite(points[:, 0])) < _LEAST_PRESENCE] = np.nan
        known = np.isfinite(targets[:, 0])
        noise = tare.point_noise(observation.stddev)
        scatter = np.trace(noise.plane, axis1=1, axis2=2) / 2.0 / noise.noise_ratio
        # the points are taken to err independently, and would average away what they share
        scatter += np.count_nonzero(known) * (observation.shared.shift**2 + observation.shared.closing**2)
        variance = scatter + noise.bias + tare.offset_variance()
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

    def _follow_presence(self, seen: NDArray) -> NDArray:
        """Return the fraction of the last images in which each key point was seen (K,)."""
        before = seen.astype(float) if self._presence is None else self._presence
        self._presence = before + _PRESENCE_GAIN * (seen - before)
        return self._presence

    def _solve(self, targets: NDArray, precision: NDArray | None) -> InverseResult:
        steps = 1 if self.paper else self.settings.iterations
        problem = self._problem(targets, precision)
        return solve_inverse(self.mechanics.model, problem, self.q, iterations=steps, tolerance=_SETTLED)

    def _reweigh(self, targets: NDArray, q: NDArray, variance: NDArray, known: NDArray) -> NDArray:
        """Return weights (K,) that fall with the distance from the shape found; the median sets their scale."""
        miss = np.where(known[:, None], self.mechanics.model.positions(self.probe, q) - targets, 0.0)
        distance = (miss**2).sum(1) / variance
        scale = max(1.0, float(np.median(distance[known])) / _MEDIAN_SQUARE)
        return np.where(known, 1.0 / (1.0 + distance / scale / self.settings.gate**2) ** 2, 0.0)

    def _report(self, result: InverseResult, targets: NDArray, weights: NDArray, variance: NDArray) -> ContactState:
        """Return the contact state of a solved image."""
        force, model = result.forces.sum(0), self.mechanics.model
        size = np.linalg.norm(result.forces, axis=1)
        share = size / size.sum() if size.any() else np.full(len(size), 1.0 / len(size))
        load = self._attach(self._heights)
        covariance = result.covariance
        if self.paper:
            covariance = covariance * float(np.mean(variance[np.isfinite(targets[:, 0])]))
            covariance += np.outer(result.bias, result.bias)
        positions, m = model.positions(self.probe, result.q), len(covariance)
        state, magnitude = blank_contact_state(), float(np.linalg.norm(force))
        state["force"], state["magnitude"] = force, magnitude
        state["covariance"][:m, :m], state["force_modes"][:, :m] = covariance, result.directions
        state["stddev"] = measure_along(force, state["force_modes"].copy(), state["covariance"].copy())
        state["pressure_point"] = share @ model.positions(load.contacts, result.q)
        state["pressure_location"] = share @ load.points
        for name in ("residual", "kkt", "iterations", "converged"):
            state[name] = getattr(result, name)
        if not (result.converged or self.paper):
            state["stddev"] = np.inf  # the next image goes on from here
        if result.converged and not self.paper:
            self._watch.judge((targets - positions)[:, ::2], weights / variance, state)
        traction = UNSEEN_TRACTION * self.settings.friction
        state["y_stddev"], state["lateral_force"] = MIDDLE_STDDEV, np.nan
        state["lateral_stddev"] = state["traction_stddev"] = traction
        state["traction_leak"] = force[2], 0.0, -force[0]  # the force turns
        is_finite = np.isfinite(result.q).all() and np.isfinite(force).all()
        is_near = np.abs(positions - self._rest).max() < _FARTHEST_MOVE
        state["sound"] = is_finite and is_near and result.smallest_det > 0
        state["quiet"] = magnitude < _QUIET_SIGMA * state["stddev"]
        state["loaded"] = magnitude > 2.0 * _QUIET_SIGMA * state["stddev"]
        self.used = weights > 0
        return state

    def significance(self, tare: Tare, stddev: float) -> float:
        """Return by how many standard deviations a force explains the offsets of a tare; see `explain_offsets`."""
        model, q = self.mechanics.model, np.zeros(self.mechanics.model.size)
        problem = self._problem(np.array(self._rest), None)
        load = model.load(problem.contacts, q, np.tile([-1.0, 0.0, 0.0], (len(problem.weights), 1)))
        mode = model.factorise(model.linearize(q).tangent).solve(load)
        modes = model.project(self.probe, q, mode[:, None])[:, [0, 2], 0]
        return explain_offsets(modes, tare, stddev)


# Least standard deviation of an averaged location, relative to the length of the face [-]: the model is linear about
# the unloaded jaw.
_SUREST = 0.03
# Time constant of the average location [images].
_LONGEST_AVERAGE = 45.0
_ACROSS_CONTACT = np.linspace(-1.0, 1.0, 41)


class _LocationWatch:
    """Averages the location by the key points, and tests the given one.

    A load F at the height z moves the key points by F U(z). What is left of their residuals r once F has been fitted,
    and P takes U out,

        dz = (P U' . r) / (F P U' . P U'),      variance 1 / (F^2 P U' . P U'),

    is the way to the place that they ask for. A place off by dz changes the force by the factor U . V / (V . V),
    V = U(z + dz). A round object that presses by d rolls along the face, which turns, by its radius times that angle,
    and leans on where the jaw is stiffer than beside: its pressure is taken for the stiffness times the indentation.
    """

    def __init__(self, response: InfluenceCoefficients, settings: EstimatorSettings) -> None:
        """Keep the answers of the unloaded jaw and how well heights are known."""
        self._response = response
        self._prior_variance = settings.height_stddev**2
        self._radius = settings.radius + settings.radius_stddev  # root mean square
        self._surest = _SUREST * float(response.heights[-1] - response.heights[0])
        self._memory = _LONGEST_AVERAGE
        self._height, self._spread = float(np.median(response.heights)), 0.0
        self.reset()

    def reset(self) -> None:
        """Reset the average."""
        self._offset, self._information = 0.0, 0.0

    def follow(self, heights: NDArray, weights: NDArray) -> None:
        """Take a load's heights (n,) [m] and their weights (n,) over; another mean height is another load.

        Shares of a spread load are hardly better known than that it is somewhere there.
        """
        height = float(np.average(heights, weights=weights))
        if abs(height - self._height) > self._surest:
            self.reset()
        self._height = height
        self._spread = float(np.average((heights - height) ** 2, weights=weights))

    def judge(self, residuals: NDArray, precision: NDArray, state: ContactState) -> None:
        """Fill in the location by this image and those before.

        Args:
            residuals: of the key points in the plane (K, 2) [m], measured minus modelled.
            precision: (K,) [1/m^2], 0 for what is not used.
            state: with the magnitude of the force.
        """
        used, force = precision > 0.0, float(state["magnitude"])
        motion, slope = self._response.at(self._height)[used], self._response.slope_at(self._height)[used]
        weights, left = precision[used, None], residuals[used]
        own = max(float((weights * motion**2).sum()), 1e-300)
        sensitivity = float((weights * motion * slope).sum()) / own
        beyond_force = slope - sensitivity * motion
        information = force**2 * float((weights * beyond_force**2).sum())
        asked = force * float((weights * beyond_force * left).sum()) / max(information, 1e-300)
        self._average(asked, information)
        depth = force / self._response.stiffness_at(self._height)
        travel = self._radius * self._response.turn_at(self._height) * depth
        given = self._prior_variance + self._spread + travel**2 + self._shift_pressure(depth) ** 2
        spread = 1.0 / max(self._information, 1e-9) + self._surest**2
        mistaken, beyond = _question_location(self._offset, spread, given)
        share = given / (given + spread)
        stddev = float(np.sqrt((share * self._offset) ** 2 + share * spread + beyond))
        state["offset"], state["mistaken"] = self._offset, mistaken
        state["height_stddev"], state["location_error"] = stddev, self._find_error(motion, used, weights, stddev)

    def _shift_pressure(self, depth: float) -> float:
        """Return how far from the height of first touch the pressure of a round object is centred, `depth` deep [m]."""
        reach = np.sqrt(2.0 * self._radius * max(depth, 1e-9))
        away = _ACROSS_CONTACT * reach
        pressure = self._response.stiffness_at(self._height + away) * (1.0 - _ACROSS_CONTACT**2)
        return float(pressure @ away / pressure.sum())

    def _find_error(self, motion: NDArray, used: NDArray, weights: NDArray, stddev: float) -> float:
        """Return the relative error of a force by a place that is off by a standard deviation [m], either way."""
        error = 0.0
        for place in (self._height - stddev, self._height + stddev):
            there = self._response.at(place)[used]
            factor = float((weights * motion * there).sum()) / max(float((weights * there**2).sum()), 1e-300)
            error = max(error, abs(factor - 1.0))
        return error

    def _average(self, asked: float, information: float) -> None:
        """Take what a frame asks for [m] with its information [1/m^2] into the average."""
        kept = self._information * (1.0 - 1.0 / self._memory)
        if information > 0.0:
            self._offset = (kept * self._offset + information * asked) / (kept + information)
        self._information = kept + information


# Prior probability that the stated height is wrong [-].
_MISTAKEN = 0.01
# Standard deviation of the true height then [m].
_ANYWHERE = 0.03


def _question_location(offset: float, spread: float, prior_variance: float) -> tuple[float, float]:
    """Return the probability that a stated contact location is wrong, and what that adds to its variance [m^2].

    The key points alone have the contact D = offset from there, with the variance s^2 = spread. It is another one,
    N(0, R^2), with the probability p:

        p / (1 - p) = p0 N(D; 0, v + s^2 + R^2) / N(D; 0, v + s^2) / (1 - p0).

    What exceeds p0 of it adds the distance of that contact from the stated location.

    Args:
        offset: D [m].
        spread: s^2 [m^2].
        prior_variance: v, of the stated location [m^2].
    """
    near, far = prior_variance + spread, prior_variance + spread + _ANYWHERE**2
    odds = 0.5 * offset**2 * (1.0 / near - 1.0 / far) + 0.5 * np.log(near / far) + np.log(_MISTAKEN / (1.0 - _MISTAKEN))
    mistaken = 1.0 / (1.0 + np.exp(-min(max(odds, -50.0), 50.0)))
    shrunk = _ANYWHERE**2 / (_ANYWHERE**2 + spread)
    variance = max(0.0, mistaken - _MISTAKEN) * ((shrunk * offset) ** 2 + shrunk * spread)
    return mistaken, variance
