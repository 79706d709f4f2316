"""Where along the width a jaw is pressed, and how much across it, by the key points' motion along y.

A normal force N beside the middle twists the finger, a force across bends it sideways,

    y_k = a_k y_c N + b_k (F_r + f N),    F_r = -F_x r,

with the place y_c of the pressure, the lean f of the force along y, and what the normal force has along y because the
face rolls by the slope r. a and b are those of the linear jaw. y_c is expected where the object's mesh stands nearest.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.torsion import Torsion
from finforce_ifea.tracking.place_update import Residuals
from finforce_ifea.tracking.track import AcrossFinger

# Standard deviation of a place of which nobody knows [m].
MIDDLE_STDDEV = 3e-3
# Pressure is spread evenly: its centre strays from the middle by this share of what touches, and by less where that is
# the whole width of the finger: by what is left of a square, at least the share below. Standard deviations of the lean,
# and of what the linear jaw makes of it [-].
_WIDE = 0.15
_EVEN, _LEAN, _NONLINEAR = 0.4, 0.1, 0.04
# A lean of so many standard deviations is believed by half; less is next to nothing.
_CLEAR = 3.0
# Frames averaged, and the force below which nothing is learnt [N].
_MEMORY, _LEAST_FORCE = 45.0, 0.3
_FLOOR = 0.02e-3
_OPTIONS = {"cache": True, "error_model": "numpy"}
Variances = tuple[NDArray, NDArray]


class _Means(NamedTuple):
    """Averages over the last frames: residuals along y (K,) [m], their derivatives (K, 2), frames that count (K,)."""

    residuals: NDArray
    modes: NDArray
    counts: NDArray


class WidthTracker:
    """Averages what the key points show across one finger.

    Attributes:
        motions: of the key points by what acts across (K, 3) [m]; zero where nothing does.
        sideways: of the key points by a force across (K, 3) [m/N], where the last one pressed; zero before.
        across: what acts.
    """

    def __init__(self, torsion: Torsion | None, count: int, lean: float) -> None:
        """Keeps the answers of the jaw, whose key points are `count`; None where nothing is known of them.

        `lean` is the standard deviation of what acts across as a share of the force, until something is seen.
        """
        self._torsion, self._count, self._lean = torsion, count, lean
        self._expected = (0.0, MIDDLE_STDDEV)
        self.reset()

    @property
    def half_width(self) -> float:
        """Of the inner face [m]; 0 where nobody knows."""
        return self._torsion.half_width if self._torsion else 0.0

    def reset(self) -> None:
        """Forgets what was seen; where the object is expected stays."""
        count = self._count
        self._means = _Means(np.zeros(count), np.zeros((count, 2)), np.zeros(count))
        self.motions, self.sideways, self.twisting = (np.zeros((count, 3)) for _ in range(3))
        self.across = AcrossFinger(*self._expected, 0.0, self._lean)

    def expect(self, place: float, stddev: float) -> None:
        """Takes where along y the object stands nearest [m], and how wide it does so."""
        half = self._torsion.half_width if self._torsion else abs(place)
        narrow = max(_WIDE, 1.0 - 3.0 * (stddev / half) ** 2) if half > 0.0 else 1.0
        self._expected = min(max(float(place), -half), half), _EVEN * narrow * float(stddev)

    def update(self, points: NDArray, data: Residuals, variances: Variances, force: NDArray, height: float) -> None:
        """Takes one frame.

        Args:
            points: key points' motion along y (K,) [m], NaN where unused.
            data: with the weights of the key points.
            variances: of each along y in one frame, and of its offset, (K,) each [m^2].
            force: of the jaw's plane (3,) [N].
            height: of the pressure [m].
        """
        torsion = self._torsion
        if torsion is None or not np.hypot(force[0], force[2]) > _LEAST_FORCE or not np.isfinite(height):
            self.reset()
            return
        frame = (points, data.weights, variances[0], variances[1], force)
        answers = torsion.at(height)
        self.twisting, self.sideways = answers[:2]
        self.across, self.motions = _update(
            self._means, frame, answers, self.across, self._expected, torsion.half_width
        )


@njit(**_OPTIONS)
def _update(means, frame, answers, across, expected, half_width):
    """Adds a frame to the means; returns what acts across the finger and the motions (K, 3) that come of it."""
    points, weights, noise, offsets, force = frame
    moment, sideways, roll = answers
    residuals, modes, counts = means
    normal = np.hypot(force[0], force[2])
    rolled = force[0] ** 2 * roll * across.place  # -F_x r, with r = roll (-y F_x)
    A = np.array([[1.0 / expected[1] ** 2, 0.0], [0.0, 1.0 / _LEAN**2]])
    g = np.array([expected[0] / expected[1] ** 2, 0.0])
    row = np.empty(2)
    for k in range(len(points)):
        share = weights[k] if np.isfinite(points[k]) else 0.0
        gain = share / (min(counts[k], _MEMORY) + 1.0)
        counts[k] = min(counts[k] * (1.0 - 1.0 / _MEMORY) + share, _MEMORY)
        if share > 0.0:
            residuals[k] += gain * (points[k] - sideways[k, 1] * rolled - residuals[k])
            modes[k, 0] += gain * (normal * moment[k, 1] - modes[k, 0])
            modes[k, 1] += gain * (normal * sideways[k, 1] - modes[k, 1])
        if counts[k] <= 0.5:
            continue
        weight = 1.0 / (noise[k] / max(counts[k], 1.0) + offsets[k] + _FLOOR**2)
        row[0], row[1] = modes[k]
        for i in range(2):
            g[i] += weight * row[i] * residuals[k]
            for j in range(2):
                A[i, j] += weight * row[i] * row[j]
    det = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    place, lean = (A[1, 1] * g[0] - A[0, 1] * g[1]) / det, (A[0, 0] * g[1] - A[1, 0] * g[0]) / det
    place = min(max(place, -half_width), half_width)
    # chance and what the linear jaw errs by are no force
    stddev = np.sqrt(A[0, 0] / det + _NONLINEAR**2)
    clear = (lean / (_CLEAR * stddev)) ** 4
    total = rolled + lean * clear / (1.0 + clear) * normal
    found = AcrossFinger(place, np.sqrt(A[1, 1] / det), total, stddev)
    return found, moment * (-place * force[0]) + sideways * total
