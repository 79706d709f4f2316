"""Identification of a finger from recordings with true forces: stiffness, effective thicknesses, clamp, relaxation.

Shape tells the geometry, force the modulus, and the force history at steady shape the relaxation. All are found
together by least squares over the steady loads; the depth of each load and of each recording the object's radius, or
the tilt of its known outline, are found along the way. Modulus and relaxation are then refined by the whole force
history of the recordings, ramps included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from finforce_ifea.contact_mechanics.friction import Coefficient
from finforce_ifea.contact_mechanics.indenter import DEPTH, ExpectedObject, expect_object
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics, limit_step
from finforce_ifea.errors import CalibrationError, JawFileError, MeshError
from finforce_ifea.estimator import ForceEstimator, KeypointGate
from finforce_ifea.jaw.calibration import Calibration, make_calibration
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw
from finforce_ifea.mechanics import build_mechanics, choose_full
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.relaxation import RelaxationTerm, apply_relaxation, invert_relaxation
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tare import OFFSET_STDDEV, compute_tare

BRANCH_PRIOR = np.array([0.1, np.log(1.0), 0.1, np.log(10.0)])
BRANCH_STDDEV = np.array([0.3, 1.5, 0.3, 1.5])
BRANCH_LOW = np.array([0.0, np.log(0.02), 0.0, np.log(0.1)])
BRANCH_HIGH = np.array([2.0, np.log(1e3), 2.0, np.log(1e4)])

_NAMES = (
    "young_modulus",
    "inner_thickness_factor",
    "outer_thickness_factor",
    "rib_thickness_factor",
    "clamped_z",
    "share_1",
    "time_constant_1",
    "share_2",
    "time_constant_2",
)
# Prior means and standard deviations: log modulus about the jaw file's, factors, clamp [mm], shares, log times [s].
_PRIOR = np.r_[0.0, 1.0, 1.0, 1.0, 0.2, BRANCH_PRIOR]
_PRIOR_STDDEV = np.r_[1.0, 0.1, 0.1, 0.1, 0.4, BRANCH_STDDEV]
_LOW = np.r_[-3.0, 0.6, 0.6, 0.6, 0.0, BRANCH_LOW]
_HIGH = np.r_[3.0, 1.5, 1.5, 1.5, 2.0, BRANCH_HIGH]
_DIFFERENCE = np.array([1e-3, 2e-3, 2e-3, 4e-3, 2e-2, 1e-3, 1e-2, 1e-3, 1e-2])
_GEOMETRY, _BRANCHES, _SHARES = slice(1, 5), slice(5, 9), (5, 7)
# Presses at one place say little of others: the least relative error that is stated, over the number of recordings.
_PLACES_DIFFER = 0.05
_FORCE_ERROR, _FORCE_FLOOR = 0.015, 0.01
_SHAPE_ERROR = 0.05e-3
_ITERATIONS = 12
_PER_CASE = 14
# Iterations that find the shape of a steady load, half a millimetre deeper at most in each: strips bend by centimetres.
# Depth and equilibrium are sought together at first, later one after the other.
_STEPS, _TOGETHER, _NEAR = 300, 60, 1e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationFit:
    """The outcome of an identification.

    Attributes:
        calibration: the identified finger.
        uncertainty: standard deviation of each number, in its unit.
        radii: radius of curvature of each recording's object [m], None where its outline was known.
        force_rms: root mean square force residual over the steady loads [N].
        shape_rms: root mean square key point residual [m].
        plateaus: number of steady loads used.
    """

    calibration: Calibration
    uncertainty: dict[str, float]
    radii: tuple[float | None, ...]
    force_rms: float
    shape_rms: float
    plateaus: int


def fit_calibration(
    jaw: Jaw,
    cases: Sequence[CalibrationCase],
    settings: EstimatorSettings | None = None,
    progress: Callable[[float], None] = lambda cost: None,
) -> CalibrationFit:
    """Identify a finger.

    Args:
        jaw: as drawn.
        cases: recordings with true forces that start unloaded and hold loads steady.
        settings: solver and mesh for which the calibration is made.
        progress: called with the cost after every evaluation of the mechanics.

    Raises:
        CalibrationError: No cases, or recordings that say nothing about the finger.
    """
    if not cases:
        raise CalibrationError("calibration: no recordings, expected at least one")
    settings = settings or EstimatorSettings()
    fit = _Fit(jaw, cases, settings, progress)
    fit.check_unit()
    result = least_squares(
        fit.residuals,
        fit.start,
        jac=fit.jacobian,
        bounds=(fit.low, fit.high),
        x_scale=fit.stddev,
        max_nfev=_ITERATIONS,
        ftol=1e-4,
        xtol=1e-4,
    )
    covariance = np.linalg.inv(result.jac.T @ result.jac)
    rough = fit.report(result.x, np.sqrt(np.diag(covariance)))
    if fit.stills:  # without a course of time there is nothing to relax
        error = float(np.clip(max(rough.calibration.force_error, _PLACES_DIFFER / len(cases)), 0.005, 0.5))
        known = {name: value for name, value in rough.uncertainty.items() if name not in _NAMES[5:]}
        return replace(
            rough, calibration=rough.calibration.changed(relaxation=(), force_error=error), uncertainty=known
        )
    known = [
        settings if radius is None else replace(settings, radius=radius, radius_stddev=max(stddev, _LEAST_STDDEV))
        for radius, stddev in zip(rough.radii, np.sqrt(np.diag(covariance))[len(_NAMES) :].tolist(), strict=True)
    ]
    history = fit_force_history(jaw, cases, known, rough.calibration, progress)
    return replace(
        rough,
        calibration=rough.calibration.changed(
            young_modulus=rough.calibration.young_modulus * history.scale,
            relaxation=history.terms,
            force_error=float(np.clip(max(history.relative, _PLACES_DIFFER / len(cases)), 0.005, 0.5)),
        ),
        uncertainty={**rough.uncertainty, **dict(zip(_NAMES[5:], history.stddev.tolist(), strict=True))},
        force_rms=history.force_rms,
    )


class _Fit:
    """Residuals of all parameters: the finger's, then radius [m] or tilt [rad] of each recording's object."""

    def __init__(
        self,
        jaw: Jaw,
        cases: Sequence[CalibrationCase],
        settings: EstimatorSettings,
        progress: Callable[[float], None],
    ) -> None:
        self.jaw, self.cases, self.settings, self.progress = jaw, cases, settings, progress
        self.plateaus = find_plateaus(cases, jaw, settings, per_case=_PER_CASE)
        self._starts: list[_PlateauShape | None] = [None] * len(self.plateaus)
        self.forces = [np.linalg.norm(case.forces_true, axis=1) for case in cases]
        self.objects = [expect_object(case.contact, settings) for case in cases]
        indenters = [item.indenter for item in self.objects]
        self.mean = np.r_[_PRIOR, [item.mean[0] for item in self.objects]]
        self.stddev = np.r_[_PRIOR_STDDEV, [np.sqrt(item.variance[0]) for item in self.objects]]
        self.low = np.r_[_LOW, [indenter.lowest for indenter in indenters]]
        self.high = np.r_[_HIGH, [indenter.highest for indenter in indenters]]
        self.difference = np.r_[_DIFFERENCE, [indenter.largest_change / 15 for indenter in indenters]]
        # stills begin with a load
        self.stills = all(len(force) and force[0] > _UNLOADED for force in self.forces)
        # only a drawing can be thickened, and only what has a course of time relaxes
        self.frozen = set() if jaw.drawing is not None else set(range(*_GEOMETRY.indices(len(_NAMES))))
        if self.stills:
            self.frozen |= set(range(*_BRANCHES.indices(len(_NAMES))))
            self.mean[list(_SHARES)], self.high[list(_SHARES)] = 0.0, 1e-9
        self.start = self.mean.copy()
        self._shapes: dict[bytes, tuple[NDArray, NDArray]] = {}

    def calibration(self, x: NDArray) -> Calibration:
        """Return the parameters as a calibration."""
        return make_calibration(
            young_modulus=float(self.jaw.material.young_modulus * np.exp(x[0])),
            inner_thickness_factor=float(x[1]),
            outer_thickness_factor=float(x[2]),
            rib_thickness_factor=float(x[3]),
            clamped_z=float(1e-3 * x[4]),
            relaxation=branches_from_parameters(x[5:9]),
            jaw=self.jaw.name,
            finger=self.jaw.digest,
        )

    def residuals(self, x: NDArray) -> NDArray:
        """Return shape, force and prior residuals, each over its standard deviation."""
        shapes, forces = self._solve_shapes(x)
        elastic = self._elastic_forces(x)
        model = np.exp(x[0]) * forces
        stddev = np.sqrt(INSTANTS) * (_FORCE_ERROR * model + _FORCE_FLOOR)
        rows = [(target - value) / error for target, value, error in zip(elastic, model, stddev, strict=True)]
        total = np.concatenate([shapes, *rows, (x - self.mean) / self.stddev])
        self.progress(float(total @ total))
        return total

    def _elastic_forces(self, x: NDArray) -> list[NDArray]:
        """Return the elastic forces [N] behind the true ones at the instants of each plateau."""
        terms = self.calibration(x).relaxation
        elastic = [
            invert_relaxation(force, case.stamps_true, terms)
            for force, case in zip(self.forces, self.cases, strict=True)
        ]
        return [elastic[plateau.case][plateau.instants] for plateau in self.plateaus]

    def check_unit(self) -> None:
        """Refuse true forces that are those of no modulus within the bounds; raises CalibrationError."""
        true, (_, forces) = self._elastic_forces(self.start), self._solve_shapes(self.start)
        factor = float(np.median([each.mean() for each in true] / forces))
        if not self.low[0] < np.log(factor) < self.high[0]:
            raise CalibrationError(
                f"calibration: the true forces are {factor:.3g} times those of the jaw file's modulus, "
                f"{1e-6 * self.jaw.material.young_modulus:g} MPa: expected newtons"
            )

    def _solve_shapes(self, x: NDArray) -> tuple[NDArray, NDArray]:
        """Return the shape residuals and the magnitudes [N] at the drawn modulus; remembers them per geometry."""
        key = np.r_[x[_GEOMETRY], x[len(_NAMES) :]].tobytes()
        if key not in self._shapes:
            mechanics = self._build_finger(x)
            rest = mechanics.model.attach(self.jaw.keypoints, KEYPOINT_DISTANCE)
            solver = _PlateauSolver(mechanics, rest)
            solved = []
            for plateau, start in zip(self.plateaus, self._starts, strict=True):
                shape = float(x[len(_NAMES) + plateau.case])
                solved.append(solver.solve(plateau, self.objects[plateau.case], shape, start))
            self._starts = solved
            residuals = np.concatenate([shape.residual for shape in solved])
            self._shapes = {key: (residuals, np.array([shape.force for shape in solved]))}
        return self._shapes[key]

    def _build_finger(self, x: NDArray) -> Mechanics:
        """Return the mechanics of the finger with parameters x, at the drawn modulus.

        Raises:
            CalibrationError: No finger can look like that; the recordings are of another one.
        """
        calibration = self.calibration(x).changed(young_modulus=self.jaw.material.young_modulus)
        try:
            return build_mechanics(calibration.apply(self.jaw), choose_full(self.settings))
        except (JawFileError, MeshError) as error:
            raise CalibrationError(
                f"calibration: no shape of the jaw {self.jaw.name!r} comes near the key points ({error}); "
                "is it the right jaw file?"
            ) from error

    def jacobian(self, x: NDArray) -> NDArray:
        """Return forward differences, each in the direction that stays within the bounds."""
        centre = self.residuals(x)
        columns = []
        for i, step in enumerate(self.difference):
            if i in self.frozen:
                columns.append(np.zeros(len(centre)))
                columns[-1][len(centre) - len(x) + i] = 1.0 / self.stddev[i]
                continue
            step = -step if x[i] + step > self.high[i] else step
            moved = x.copy()
            moved[i] += step
            columns.append((self.residuals(moved) - centre) / step)
        return np.stack(columns, axis=1)

    def report(self, x: NDArray, stddev: NDArray) -> CalibrationFit:
        """Return the fit with its residuals in units."""
        shapes, forces = self._solve_shapes(x)
        elastic, model = self._elastic_forces(x), np.exp(x[0]) * forces
        errors = np.concatenate([target - value for target, value in zip(elastic, model, strict=True)])
        relative = np.concatenate([target / value - 1.0 for target, value in zip(elastic, model, strict=True)])
        error = float(np.clip(np.sqrt(np.mean(relative**2)), 0.005, 0.5))
        calibration = self.calibration(x).changed(force_error=error)
        scale = np.ones(len(_NAMES))
        scale[[0, 4, 6, 8]] = calibration.young_modulus, 1e-3, np.exp(x[6]), np.exp(x[8])
        return CalibrationFit(
            calibration=calibration,
            uncertainty=dict(zip(_NAMES, (scale * stddev[: len(_NAMES)]).tolist(), strict=True)),
            radii=tuple(
                float(shape) if case.contact.outline is None else None
                for case, shape in zip(self.cases, x[len(_NAMES) :], strict=True)
            ),
            force_rms=float(np.sqrt(np.mean(errors**2))),
            shape_rms=float(_SHAPE_ERROR * np.sqrt(np.mean(shapes**2))),
            plateaus=len(self.plateaus),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _PlateauShape:
    """A solved steady load: unknowns, depth [m], weighted shape residuals, force [N]."""

    q: NDArray
    depth: float
    residual: NDArray
    force: float


class _PlateauSolver:
    """Finds the depth at which the jaw's shape comes closest to the key points of a steady load."""

    def __init__(self, mechanics: Mechanics, probe: Any) -> None:
        self._contact, self._model, self._probe = mechanics.contact, mechanics.model, probe
        self._rest = self._model.positions(probe, np.zeros(self._model.size))

    def solve(self, plateau: Plateau, item: ExpectedObject, shape: float, start: _PlateauShape | None) -> _PlateauShape:
        """Return the closest shape, found by Gauss-Newton from `start` or from the unloaded jaw.

        Raises:
            CalibrationError: No shape of the jaw comes close.
        """
        self._contact.set_indenter(item.indenter)
        place = np.array([0.0, shape, item.mean[1]])
        touch = self._contact.find_touch(place)
        q = np.zeros(self._model.size) if start is None else start.q
        place[DEPTH] = touch + 0.5e-3 if start is None else start.depth
        seen = np.isfinite(plateau.keypoints[:, 0])
        stddev = np.sqrt(plateau.variance[seen, None] + _SHAPE_ERROR**2)
        for step in range(_STEPS):
            state = self._contact.linearize(q, place)
            if not state.touches:
                q = q + self._contact.approach(q, state.correction, place)
                continue
            q = q + limit_step(self._model, state.correction)
            moved = self._model.positions(self._probe, q) - self._rest
            mode = self._model.project(self._probe, q, state.modes)[seen][:, [0, 2], DEPTH] / stddev
            residual = (plateau.keypoints[seen] - moved[seen][:, [0, 2]]) / stddev
            change = float(np.clip((mode * residual).sum() / (mode**2).sum(), -0.5e-3, 0.5e-3))
            change = max(change, touch + 3e-5 - place[DEPTH])
            if step > _TOGETHER:  # they chase each other: the depth waits for the equilibrium
                change *= 0.5 if np.abs(state.correction).max() < _NEAR else 0.0
            place[DEPTH] += change
            q = q + limit_step(self._model, state.modes[:, DEPTH] * change)
            if abs(change) < 1e-6 and np.abs(state.correction).max() < 1e-6:
                force = state.force + state.force_modes[:, DEPTH] * change
                left = (residual - mode * change).ravel()
                return _PlateauShape(q=q, depth=float(place[DEPTH]), residual=left, force=float(np.linalg.norm(force)))
        if start is not None:
            return self.solve(plateau, item, shape, None)
        raise CalibrationError("calibration: no shape of the jaw comes near the key points; is it the right jaw file?")


_UNLOADED = 0.01
# Of key points in stills [m].
_STILL_NOISE = 0.3e-3
_LEAST_FORCE = 0.15
_STEADY_SPAN = 10
_STEADY_CHANGE = 0.02
_LEAST_FRAMES = 20
_FARTHEST = 1.8e-3
INSTANTS = 5


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationCase:
    """One recording with ground truth.

    Attributes:
        name: of the recording.
        observations: its key points, in order.
        contact: height of first touch.
        stamps_true: (n,) [s].
        forces_true: (n, 3) [N], jaw frame.
        friction: of the object; None where it is unknown.
    """

    name: str
    observations: Sequence[Observation]
    contact: Contact
    stamps_true: NDArray
    forces_true: NDArray
    friction: Coefficient | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Plateau:
    """A steady load.

    Attributes:
        case: number of the recording.
        keypoints: mean displacements (K, 2) along x and z [m], NaN where too seldom seen.
        variance: of each mean (K,) [m^2].
        instants: indices into the case's true forces, spread over the plateau.
        force: mean true magnitude [N].
    """

    case: int
    keypoints: NDArray
    variance: NDArray
    instants: NDArray
    force: float


def find_plateaus(
    cases: Sequence[CalibrationCase], jaw: Jaw, settings: EstimatorSettings, *, per_case: int
) -> list[Plateau]:
    """Return at most `per_case` steady loads of each recording.

    Raises:
        CalibrationError: A recording has no unloaded start or no steady load.
    """
    plateaus = []
    for number, case in enumerate(cases):
        found = _plateaus_of_case(number, case, jaw, settings)
        chosen = np.unique(np.linspace(0, len(found) - 1, per_case).round().astype(int))
        plateaus += [found[i] for i in chosen]
    return plateaus


def _plateaus_of_case(number: int, case: CalibrationCase, jaw: Jaw, settings: EstimatorSettings) -> list[Plateau]:
    gate = KeypointGate(jaw, settings)
    stamps = np.array([observation.stamp for observation in case.observations])
    points = np.stack([gate.accept(observation) for observation in case.observations])
    magnitude = np.linalg.norm(case.forces_true, axis=1)
    at = np.searchsorted(case.stamps_true, stamps).clip(0, len(magnitude) - 1)
    force = magnitude[at]
    loaded = np.flatnonzero(force > _UNLOADED)
    start = loaded[0] if len(loaded) else len(force)
    tare = compute_tare(list(points[:start]), jaw.keypoints) if start >= settings.tare_frames // 2 else None
    if tare is None and start > 0:
        raise CalibrationError(
            f"{case.name}: {start} frames without load at the start; expected {settings.tare_frames // 2}, for the "
            "tare, or none, as of stills"
        )
    if tare is None:  # stills: key points are where the jaw file has them, within the offset of untared ones
        rest, noise, rest_variance = jaw.keypoints, _STILL_NOISE**2, OFFSET_STDDEV**2
    else:
        rest = np.where(tare.counts[:, None] > 0, jaw.keypoints + tare.offsets, np.nan)
        noise = np.trace(tare.noise) / 3.0
        rest_variance = noise / np.maximum(tare.counts, 1)
    found = []
    for first, last in _steady_runs(force):
        mean, count = _robust_mean(points[first:last] - rest)
        mean[count < 0.5 * (last - first)] = np.nan
        variance = noise / np.maximum(count, 1) + rest_variance
        instants = at[np.linspace(first, last - 1, INSTANTS).round().astype(int)]
        found.append(
            Plateau(
                case=number,
                keypoints=mean[:, [0, 2]],
                variance=variance,
                instants=instants,
                force=float(force[first:last].mean()),
            )
        )
    if not found:
        raise CalibrationError(f"{case.name}: no load is held steady for {_LEAST_FRAMES} frames; hold each for seconds")
    return found


def _steady_runs(force: NDArray) -> list[tuple[int, int]]:
    """Return the ranges of frames over which the force hardly changes."""
    later = np.r_[force[_STEADY_SPAN:], np.full(_STEADY_SPAN, force[-1])]
    steady = (np.abs(later - force) < _STEADY_CHANGE * np.maximum(force, 0.3) + 0.01) & (force > _LEAST_FORCE)
    edges = np.flatnonzero(np.diff(np.r_[0, steady.astype(int), 0]))
    return [(a, b) for a, b in edges.reshape(-1, 2) if b - a >= _LEAST_FRAMES]


def _robust_mean(samples: NDArray) -> tuple[NDArray, NDArray]:
    """Return the mean (K, 3) of samples (n, K, 3) without gross errors, and the counts behind it (K,)."""
    samples = samples.copy()
    seen = np.isfinite(samples[..., 0]).any(0)
    middle = np.zeros(samples.shape[1:])
    middle[seen] = np.nanmedian(samples[:, seen], axis=0)
    samples[np.linalg.norm(samples - middle, axis=2) > _FARTHEST] = np.nan
    count = np.isfinite(samples[..., 0]).sum(0)
    mean = np.nansum(samples, axis=0) / np.maximum(count, 1)[:, None]
    return mean, count


# Two branches, each a share [-] and a log time constant [s]: prior means, standard deviations and bounds.
_LARGEST_SCALE = 3.0
_LOADED_FORCE = 0.3
# Least standard deviation of the radius of an object [m].
_LEAST_STDDEV = 0.1e-3
_RELATIVE_ERROR, _ABSOLUTE_ERROR = 0.02, 0.03
# Errors of neighbouring frames are alike; this many count as one.
_CORRELATED_FRAMES = 30
# Times [s] by which the true forces may lead the images: tried, tolerated; and the share of the cost that one has to
# leave: forces that are held tell nothing of it.
_LEADS, _ONE_CLOCK, _CLEARLY = np.arange(-6, 7) / 20.0, 0.05, 0.8
# Elastic force [N] below which nothing presses, least number of such frames, and the rise of the true force over them
# from which on the sensor drifts [N], where its noise is not larger.
_IDLE_FORCE, _IDLE_FRAMES, _DRIFT = 0.05, 60, 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class HistoryFit:
    """The outcome.

    Attributes:
        scale: factor on the modulus.
        terms: branches of the relaxation.
        stddev: standard deviations of share, time constant [s], share, time constant (4,).
        force_rms: root mean square force residual of loaded frames [N].
        relative: robust relative standard deviation of forces that is left.
    """

    scale: float
    terms: tuple[RelaxationTerm, ...]
    stddev: NDArray
    force_rms: float
    relative: float


@dataclass(frozen=True, kw_only=True, eq=False)
class _ForceHistory:
    """Stamps [s], elastic force estimates and true forces (n,) [N] of one recording."""

    stamps: NDArray
    elastic: NDArray
    true: NDArray


def branches_from_parameters(x: NDArray) -> tuple[RelaxationTerm, ...]:
    """Return the branches of parameters (4,), the faster one first."""
    terms = [RelaxationTerm(share=float(x[k]), time_constant=float(np.exp(x[k + 1]))) for k in (0, 2)]
    return tuple(sorted(terms, key=lambda term: term.time_constant))


def fit_force_history(
    jaw: Jaw,
    cases: Sequence[CalibrationCase],
    settings: Sequence[EstimatorSettings],
    calibration: Calibration,
    progress: Callable[[float], None],
) -> HistoryFit:
    """Fit modulus and relaxation at a given geometry.

    Args:
        jaw: as drawn.
        cases: recordings with true forces.
        settings: of the estimator for each recording, which know its object.
        calibration: of that geometry.
        progress: called after each recording.

    Raises:
        CalibrationError: The estimator trusts hardly a loaded frame of the recordings, the force sensor drifts, or
            there are two clocks.
    """
    histories = []
    for case, own in zip(cases, settings, strict=True):
        histories.append(_track_force(jaw, case, own, calibration))
        if drift := find_drift(histories[-1].true[histories[-1].elastic < _IDLE_FORCE]):
            raise CalibrationError(
                f"{case.name}: where nothing presses, the true force changes by {drift:+.2f} N from first to last: "
                "does the sensor drift? Let it warm up, and tare it before each recording"
            )
        progress(float("nan"))
    fits = {lead: _fit_branches(histories, lead) for lead in _LEADS}  # early forces look like relaxed ones
    lead, fit = min(fits, key=lambda lead: fits[lead].cost), fits[0.0]
    if abs(lead) > _ONE_CLOCK and fits[lead].cost < _CLEARLY * fit.cost:
        raise CalibrationError(
            f"calibration: the forces fit those {abs(lead):.2f} s {'later' if lead > 0.0 else 'earlier'} than the "
            "images: expected the stamps of one clock, those of the exposure for the images"
        )
    errors = np.concatenate([_model(fit.x, history) - history.true for history in histories])
    true = np.concatenate([history.true for history in histories])
    loaded = true > _LOADED_FORCE
    if not loaded.any():
        raise CalibrationError(
            f"calibration: true forces of {true.max():.2g} N at most; expected more than {_LOADED_FORCE:g} N: "
            "are they in newtons?"
        )
    stddev = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac + 1e-12 * np.eye(5))))[1:]
    return HistoryFit(
        scale=float(np.exp(fit.x[0])),
        terms=branches_from_parameters(fit.x[1:]),
        stddev=stddev * [1.0, np.exp(fit.x[2]), 1.0, np.exp(fit.x[4])],
        force_rms=float(np.sqrt(np.mean(errors[loaded] ** 2))),
        relative=float(1.48 * np.median(np.abs(errors[loaded] / true[loaded]))),
    )


def find_drift(idle: NDArray) -> float:
    """Return by how much the force of a sensor drifts while nothing presses.

    Args:
        idle: (n,) [N] true forces of all frames in which nothing presses, in the order of time.

    Returns:
        [N] from the median of the first quarter to that of the last; 0 where noise, or too few frames, explain it.
    """
    if len(idle) < _IDLE_FRAMES:
        return 0.0
    first, *_, last = np.array_split(idle, 4)
    drift = float(np.median(last) - np.median(first))
    noise = 1.48 * np.median(np.abs(first - np.median(first)))
    return drift if abs(drift) > max(_DRIFT, 3.0 * noise) else 0.0


def _fit_branches(histories: Sequence[_ForceHistory], lead: float = 0.0) -> OptimizeResult:
    """Fit the log of the scale of the modulus, and the branches of the relaxation, to true forces of a later time."""
    # whole images, for interpolated forces are less noisy than any
    rows = [np.interp(each.stamps + lead, each.stamps, np.arange(len(each.stamps))) for each in histories]
    later = [replace(each, true=each.true[np.rint(row).astype(int)]) for each, row in zip(histories, rows, strict=True)]
    return least_squares(
        _residuals,
        np.r_[0.0, BRANCH_PRIOR],
        bounds=(np.r_[-_LARGEST_SCALE, BRANCH_LOW], np.r_[_LARGEST_SCALE, BRANCH_HIGH]),
        x_scale=np.r_[1.0, BRANCH_STDDEV],
        args=(later,),
    )


def _track_force(
    jaw: Jaw, case: CalibrationCase, settings: EstimatorSettings, calibration: Calibration
) -> _ForceHistory:
    """Estimate the elastic force of every frame."""
    estimator = ForceEstimator(jaw, settings=settings, calibration=calibration.changed(relaxation=()))
    estimator.expect_friction(case.friction)
    solutions = [estimator.update(observation, case.contact) for observation in case.observations]
    trusted = [solution for solution in solutions if solution.trusted]
    if sum(solution.status == "ok" for solution in trusted) < _CORRELATED_FRAMES:
        raise CalibrationError(f"{case.name}: hardly a loaded frame can be trusted; {solutions[-1].message}")
    stamps = np.array([solution.stamp for solution in trusted])
    true = np.interp(stamps, case.stamps_true, np.linalg.norm(case.forces_true, axis=1))
    return _ForceHistory(stamps=stamps, elastic=np.array([np.linalg.norm(s.force) for s in trusted]), true=true)


def _model(x: NDArray, history: _ForceHistory) -> NDArray:
    return np.exp(x[0]) * apply_relaxation(history.elastic, history.stamps, branches_from_parameters(x[1:]))


def _residuals(x: NDArray, histories: Sequence[_ForceHistory]) -> NDArray:
    """Return the force residuals of all frames over their standard deviations, and those of the prior."""
    rows = [(_model(x, c) - c.true) / (_RELATIVE_ERROR * c.true + _ABSOLUTE_ERROR) for c in histories]
    return np.concatenate([np.concatenate(rows) / np.sqrt(_CORRELATED_FRAMES), (x[1:] - BRANCH_PRIOR) / BRANCH_STDDEV])
