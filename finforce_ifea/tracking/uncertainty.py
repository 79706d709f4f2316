"""Compiled numbers of a solution: standard deviations and moments of a force that was tracked."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

_OPTIONS = {"cache": True, "error_model": "numpy"}


class SolutionNumbers(NamedTuple):
    """What belongs to one force.

    Attributes:
        magnitude: of the force [N].
        magnitude_stddev: [N].
        torque: about the jaw frame's origin (3,) [N m].
        force_stddev: (3,) [N].
        torque_stddev: (3,) [N m].
        contact_point: in the jaw's plane (3,) [m], NaN without a force.
        contact_place: the same on the undeformed surface (3,) [m], NaN without a force.
        normal: direction of the force (3,), NaN without a force.
    """

    magnitude: float
    magnitude_stddev: float
    torque: NDArray
    force_stddev: NDArray
    torque_stddev: NDArray
    contact_point: NDArray
    contact_place: NDArray
    normal: NDArray


@njit(**_OPTIONS)
def measure_along(force, modes, covariance):
    """Returns the standard deviation [N] of a force (3,) along itself, along -x when it is none.

    Args:
        force: (3,) [N].
        modes: derivative of the force by what was estimated (3, m).
        covariance: of what was estimated (m, m).
    """
    magnitude = np.sqrt((force * force).sum())
    direction = force / magnitude if magnitude > 0.0 else np.array([-1.0, 0.0, 0.0])
    m, total = modes.shape[1], 0.0
    mode = np.zeros(m)
    for i in range(m):
        for a in range(3):
            mode[i] += direction[a] * modes[a, i]
    for i in range(m):
        for j in range(m):
            total += mode[i] * covariance[i, j] * mode[j]
    return np.sqrt(total)


@njit(**_OPTIONS)
def find_numbers(force, elastic, modes, covariance, pressure, place, place_stddev, share, lean):
    """Returns what belongs to a force; see `SolutionNumbers`.

    Args:
        force: that the material gives now (3,) [N].
        elastic: that the shape asks for (3,) [N].
        modes: derivative of the elastic force by what was estimated (3, m).
        covariance: of what was estimated (m, m).
        pressure: pressure centre on the deformed surface (3,) [m].
        place: the same on the undeformed surface (3,) [m].
        place_stddev: of its height [m].
        share: relative standard deviation of the mechanics; it errs in the direction as in the magnitude.
        lean: share of a force that nobody has seen along z.
    """
    fit, magnitude = measure_along(elastic, modes, covariance), np.sqrt((force * force).sum())
    stddev = np.zeros(3)
    for a in range(3):
        for i in range(modes.shape[1]):
            for j in range(modes.shape[1]):
                stddev[a] += modes[a, i] * covariance[i, j] * modes[a, j]
    stddev[0] += (share * magnitude) ** 2
    stddev[2] += (share * magnitude) ** 2
    # a larger force leans more: where it is hardly known, its direction is not known either
    stddev[2] += (lean * fit**2 / max(magnitude + fit, 1e-300)) ** 2
    stddev = np.sqrt(stddev)
    arm, undeformed = pressure.copy(), place.copy()
    arm[1] = undeformed[1] = 0.0
    moment = np.hypot(arm[0] * stddev[2], arm[2] * stddev[0])
    torque = np.array([-arm[2] * force[1], arm[2] * force[0] - arm[0] * force[2], arm[0] * force[1]])
    torque_stddev = np.array([0.0, np.hypot(moment, elastic[0] * place_stddev), 0.0])
    if magnitude > 0.0:
        normal = force / magnitude
    else:
        arm, undeformed, normal = np.full(3, np.nan), np.full(3, np.nan), np.full(3, np.nan)
    spread = np.hypot(fit, share * magnitude)
    return SolutionNumbers(magnitude, spread, torque, stddev, torque_stddev, arm, undeformed, normal)
