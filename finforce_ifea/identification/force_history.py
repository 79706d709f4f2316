"""Modulus and relaxation from the whole course of force in recordings, ramps included."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from finforce_ifea.errors import CalibrationError
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.identification.plateaus import CalibrationCase
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.relaxation import RelaxationTerm, apply_relaxation
from finforce_ifea.settings import EstimatorSettings

# Two branches, each a share [-] and a log time constant [s]: prior means, standard deviations and bounds.
BRANCH_PRIOR = np.array([0.1, np.log(1.0), 0.1, np.log(10.0)])
BRANCH_STDDEV = np.array([0.3, 1.5, 0.3, 1.5])
BRANCH_LOW = np.array([0.0, np.log(0.02), 0.0, np.log(0.1)])
BRANCH_HIGH = np.array([2.0, np.log(1e3), 2.0, np.log(1e4)])
_LARGEST_SCALE = 3.0
_LOADED_FORCE = 0.3
_RELATIVE_ERROR, _ABSOLUTE_ERROR = 0.02, 0.03
# Errors of neighbouring frames are alike; this many count as one.
_CORRELATED_FRAMES = 30


@dataclass(frozen=True, kw_only=True, eq=False)
class CourseFit:
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
    """Returns the branches of parameters (4,), the faster one first."""
    terms = [RelaxationTerm(share=float(x[k]), time_constant=float(np.exp(x[k + 1]))) for k in (0, 2)]
    return tuple(sorted(terms, key=lambda term: term.time_constant))


def fit_course(
    jaw: Jaw,
    cases: Sequence[CalibrationCase],
    settings: EstimatorSettings,
    calibration: Calibration,
    progress: Callable[[float], None],
) -> CourseFit:
    """Fits modulus and relaxation at a given geometry.

    Raises:
        CalibrationError: The estimator trusts hardly a loaded frame of the recordings.
    """
    courses = []
    for case in cases:
        courses.append(_track_course(jaw, case, settings, calibration))
        progress(float("nan"))
    fit = least_squares(
        _residuals,
        np.r_[0.0, BRANCH_PRIOR],
        bounds=(np.r_[-_LARGEST_SCALE, BRANCH_LOW], np.r_[_LARGEST_SCALE, BRANCH_HIGH]),
        x_scale=np.r_[1.0, BRANCH_STDDEV],
        args=(courses,),
    )
    errors = np.concatenate([_model(fit.x, course) - course.true for course in courses])
    true = np.concatenate([course.true for course in courses])
    loaded = true > _LOADED_FORCE
    stddev = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac + 1e-12 * np.eye(5))))[1:]
    return CourseFit(
        scale=float(np.exp(fit.x[0])),
        terms=branches_from_parameters(fit.x[1:]),
        stddev=stddev * [1.0, np.exp(fit.x[2]), 1.0, np.exp(fit.x[4])],
        force_rms=float(np.sqrt(np.mean(errors[loaded] ** 2))),
        relative=float(1.48 * np.median(np.abs(errors[loaded] / true[loaded]))),
    )


def _track_course(
    jaw: Jaw, case: CalibrationCase, settings: EstimatorSettings, calibration: Calibration
) -> _ForceHistory:
    """Estimates the elastic force of every frame."""
    estimator = JawEstimator(jaw, settings=settings, calibration=replace(calibration, relaxation=()))
    solutions = [estimator.update(observation, case.contact) for observation in case.observations]
    trusted = [solution for solution in solutions if solution.trusted]
    if sum(solution.status == "ok" for solution in trusted) < _CORRELATED_FRAMES:
        raise CalibrationError(f"{case.name}: hardly a loaded frame can be trusted; {solutions[-1].message}")
    stamps = np.array([solution.stamp for solution in trusted])
    true = np.interp(stamps, case.stamps_true, np.linalg.norm(case.forces_true, axis=1))
    return _ForceHistory(stamps=stamps, elastic=np.array([np.linalg.norm(s.force) for s in trusted]), true=true)


def _model(x: NDArray, course: _ForceHistory) -> NDArray:
    return np.exp(x[0]) * apply_relaxation(course.elastic, course.stamps, branches_from_parameters(x[1:]))


def _residuals(x: NDArray, courses: Sequence[_ForceHistory]) -> NDArray:
    """Returns the force residuals of all frames over their standard deviations, and those of the prior."""
    rows = [(_model(x, c) - c.true) / (_RELATIVE_ERROR * c.true + _ABSOLUTE_ERROR) for c in courses]
    return np.concatenate([np.concatenate(rows) / np.sqrt(_CORRELATED_FRAMES), (x[1:] - BRANCH_PRIOR) / BRANCH_STDDEV])
