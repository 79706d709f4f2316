"""What a tracker says of one frame, and whether offsets look like a load."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.tare import Tare
from finforce_ifea.tracking.uncertainty import measure_along

# Standard deviation of an offset that all key points share [m]: a depth scale wrong by 1 % at 0.15 m.
_COMMON_OFFSET = 1.5e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """The outcome of one frame.

    Attributes:
        covariance: of what was estimated (m, m): depth [m], log radius and height [m], or a given contact's force [N].
        force: elastic contact force on the jaw (3,) [N].
        force_modes: derivative of the force by what was estimated (3, m).
        pressure_point: pressure centre on the deformed surface (3,) [m].
        pressure_place: the same on the undeformed surface (3,) [m].
        weights: of the key points (K,), 0 for what was not used.
        residual: weighted root mean square residual [m].
        stiffening: force over depth beside that of first touch [-]; large where the place has run to the base.
        misfit: averaged residuals over their standard deviations, about 1 where the model fits.
        extrapolation: distance of the shape from the stored ones, as a share of what the mechanics is good for.
        away: how far the key points alone would have the contact from where it was said to be [m].
        mistaken: probability that it is not there.
        agreement: share of the measured key points that agree with the shape.
        place_error: relative standard deviation of the force that its place leaves, beside the covariance.
        place_stddev: of the height of the pressure centre [m].
        condition: of what was solved, its unknowns scaled.
        kkt: gradient of the objective that is left, relative to its parts.
        iterations: Newton iterations.
        converged: whether the last one changed nothing that matters.
        sound: whether the mesh is in order and the numbers are finite.
        quiet: whether nothing seems to press.
        loaded: whether something surely presses.
    """

    covariance: NDArray
    force: NDArray
    force_modes: NDArray
    pressure_point: NDArray
    pressure_place: NDArray
    weights: NDArray
    stiffening: float
    residual: float
    misfit: float
    kkt: float
    iterations: int
    converged: bool
    sound: bool
    quiet: bool
    loaded: bool
    away: float = 0.0
    extrapolation: float = 0.0
    mistaken: float = 0.0
    agreement: float = 1.0
    place_error: float = 0.0
    place_stddev: float = 0.0
    condition: float = 1.0


def compute_magnitude_stddev(force: NDArray, modes: NDArray, covariance: NDArray) -> float:
    """Returns the standard deviation [N] of a force (3,) along itself, along -x when it is none.

    Args:
        force: (3,) [N].
        modes: derivative of the force by what was estimated (3, m).
        covariance: of what was estimated (m, m).
    """
    modes, covariance = np.ascontiguousarray(modes), np.ascontiguousarray(covariance)
    return float(measure_along(np.ascontiguousarray(force), modes, covariance))


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadFit:
    """Least squares of one mode: its gain (2 n,) on the offsets, and the standard deviation of what it finds."""

    gain: NDArray
    stddev: float


def fit_load(modes: NDArray, deviation: NDArray) -> LoadFit:
    """Returns the fit of one mode (n, 2) to offsets of n key points, each off by chance by its deviation (n,) [m].

    All together are off by chance, too, as a wrong depth scale moves them alike.
    """
    common = np.broadcast_to(np.eye(2), (len(modes), 2, 2))
    design = np.concatenate([modes[:, :, None], common], axis=2) / deviation[:, None, None]
    design = np.concatenate([design.reshape(-1, 3), np.diag([0.0, 1.0, 1.0]) / _COMMON_OFFSET])
    covariance = np.linalg.pinv(design.T @ design)
    gain = (covariance @ design.T)[0, :-3] / np.repeat(deviation, 2)
    return LoadFit(gain=gain, stddev=float(np.sqrt(max(covariance[0, 0], 1e-300))))


def explain_offsets(modes: NDArray, tare: Tare, offset_stddev: float) -> float:
    """Returns by how many standard deviations one mode (K, 2) explains the offsets of a tare; see `fit_load`."""
    seen = tare.counts > 0
    fit = fit_load(modes[seen], np.sqrt(offset_stddev**2 + tare.offset_variance(0.0)[seen]))
    return float(fit.gain @ tare.offsets[seen][:, [0, 2]].ravel() / fit.stddev)
