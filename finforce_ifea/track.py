"""What a tracker says of one frame, and whether offsets look like a load; knows no mechanics."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.tare import Tare

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


def compute_magnitude_stddev(force: NDArray, modes: NDArray, covariance: NDArray) -> float:
    """Returns the standard deviation [N] of a force (3,) along itself, along -x when it is none.

    Args:
        force: (3,) [N].
        modes: derivative of the force by what was estimated (3, m).
        covariance: of what was estimated (m, m).
    """
    magnitude = float(np.linalg.norm(force))
    direction = force / magnitude if magnitude > 0 else np.array([-1.0, 0.0, 0.0])
    mode = direction @ modes
    return float(np.sqrt(mode @ covariance @ mode))


def explain_offsets(modes: NDArray, tare: Tare, offset_stddev: float) -> float:
    """Returns by how many standard deviations one mode (K, 2) explains the offsets of a tare.

    The rest is chance: of every key point [m], and of all together, as a wrong depth scale moves them alike.
    """
    seen = tare.counts > 0
    deviation = np.sqrt(offset_stddev**2 + tare.offset_variance(0.0)[seen, None])
    common = np.broadcast_to(np.eye(2), (int(seen.sum()), 2, 2))
    design = np.concatenate([modes[seen][:, :, None], common], axis=2) / deviation[:, :, None]
    design = np.concatenate([design.reshape(-1, 3), np.diag([0.0, 1.0, 1.0]) / _COMMON_OFFSET])
    target = np.append((tare.offsets[seen][:, [0, 2]] / deviation).ravel(), np.zeros(3))
    covariance = np.linalg.pinv(design.T @ design)
    return float((covariance @ design.T @ target)[0] / np.sqrt(max(covariance[0, 0], 1e-300)))
