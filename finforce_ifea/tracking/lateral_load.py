"""Where along the width a jaw is pressed, and the lateral force on it, by the key points' motion along y.

A normal force N off the middle twists the finger, a lateral force bends it sideways,

    y_k = a_k y_c N + b_k (F_r + t N),    F_r = -F_x r,

with the location y_c of the pressure, the lateral traction ratio t, and what the normal force has along y because the
face rolls by the slope r. a and b are those of the linear jaw. y_c is expected where the object's mesh is nearest.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.torsion import Torsion
from finforce_ifea.tracking.contact_state import MIDDLE_STDDEV, ContactState

# Pressure is spread evenly: its centre strays from the middle by this share of what touches, and by less where that is
# the whole width of the finger: by what is left of a square, at least the share below. Standard deviations of the
# traction ratio, and of what the linear jaw makes of it [-].
_WIDE = 0.15
_EVEN, _TRACTION, _NONLINEAR = 0.4, 0.1, 0.04
# A ratio of so many standard deviations is believed by half; less is next to nothing.
_CLEAR = 3.0
# Images averaged, and the force below which nothing is learnt [N].
_MEMORY, _LEAST_FORCE = 45.0, 0.3
_FLOOR = 0.02e-3
_OPTIONS = {"cache": True, "error_model": "numpy"}
# Of a key point over the last images: residual along y [m], its derivatives by y_c and t, and images that count.
_MEANS = np.dtype([("residual", float), ("modes", float, 2), ("count", float)])


class LateralLoad:
    """Averages what the key points show across one finger.

    Attributes:
        motions: of the key points by what acts laterally (K, 3) [m]; zero where nothing does.
        by_force: of the key points by a lateral force (K, 3) [m/N], where the last one pressed; zero before.
        by_moment: the same by a moment about the finger (K, 3) [m/(N m)].
        load: location along y [m], its standard deviation [m], lateral force [N], and the standard deviation of that
            as a share of all force (4,).
    """

    def __init__(self, torsion: Torsion | None, count: int, traction: float) -> None:
        """Keep the response of the jaw with `count` key points, None where nothing is known of it.

        `traction` is the standard deviation of the lateral traction ratio until something is seen.
        """
        self._torsion, self._count, self._traction = torsion, count, traction
        self._expected = (0.0, MIDDLE_STDDEV)
        self.reset()

    @property
    def half_width(self) -> float:
        """Of the inner face [m]; 0 where unknown."""
        return self._torsion.half_width if self._torsion else 0.0

    def reset(self) -> None:
        """Forget what was seen; where the object is expected stays."""
        self._means = np.zeros(self._count, _MEANS)
        self.motions, self.by_force, self.by_moment = (np.zeros((self._count, 3)) for _ in range(3))
        self.load = np.array([*self._expected, 0.0, self._traction])

    def expect(self, location: float, stddev: float) -> None:
        """Take where along y the object is nearest [m], and how wide it is there."""
        half = self._torsion.half_width if self._torsion else abs(location)
        narrow = max(_WIDE, 1.0 - 3.0 * (stddev / half) ** 2) if half > 0.0 else 1.0
        self._expected = min(max(float(location), -half), half), _EVEN * narrow * float(stddev)

    def update(self, motions: NDArray, points: NDArray, state: ContactState) -> None:
        """Take the key points' motions along y (K,) [m], NaN where unused, with their weights and the contact."""
        torsion, force, height = self._torsion, state["force"], float(state["pressure_location"][2])
        if torsion is None or not np.hypot(force[0], force[2]) > _LEAST_FORCE or not np.isfinite(height):
            self.reset()
            return
        self.by_moment, self.by_force, roll = torsion.at(height)
        response = self.by_moment, self.by_force, roll, torsion.half_width
        self.motions = _update(self._means, motions, points, force, response, self._expected, self.load)


@njit(**_OPTIONS)
def _update(means, motions, points, force, response, expected, load):
    """Add an image to the means; update the load (4,) and return the motions (K, 3) that it causes."""
    by_moment, by_force, roll, half_width = response
    normal = np.hypot(force[0], force[2])
    rolled = force[0] ** 2 * roll * load[0]  # -F_x r, with r = roll (-y F_x)
    A = np.array([[1.0 / expected[1] ** 2, 0.0], [0.0, 1.0 / _TRACTION**2]])
    g = np.array([expected[0] / expected[1] ** 2, 0.0])
    row = np.empty(2)
    for k in range(len(motions)):
        point, mean = points[k], means[k]
        share = point.weight if np.isfinite(motions[k]) else 0.0
        gain = share / (min(mean.count, _MEMORY) + 1.0)
        mean.count = min(mean.count * (1.0 - 1.0 / _MEMORY) + share, _MEMORY)
        if share > 0.0:
            mean.residual += gain * (motions[k] - by_force[k, 1] * rolled - mean.residual)
            mean.modes[0] += gain * (normal * by_moment[k, 1] - mean.modes[0])
            mean.modes[1] += gain * (normal * by_force[k, 1] - mean.modes[1])
        if mean.count <= 0.5:
            continue
        weight = 1.0 / (point.width_variance / max(mean.count, 1.0) + point.offset_variance + _FLOOR**2)
        row[0], row[1] = mean.modes[0], mean.modes[1]
        for i in range(2):
            g[i] += weight * row[i] * mean.residual
            for j in range(2):
                A[i, j] += weight * row[i] * row[j]
    det = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    location, ratio = (A[1, 1] * g[0] - A[0, 1] * g[1]) / det, (A[0, 0] * g[1] - A[1, 0] * g[0]) / det
    location = min(max(location, -half_width), half_width)
    # chance and what the linear jaw errs by are no force
    stddev = np.sqrt(A[0, 0] / det + _NONLINEAR**2)
    clear = (ratio / (_CLEAR * stddev)) ** 4
    total = rolled + ratio * clear / (1.0 + clear) * normal
    load[0], load[1], load[2], load[3] = location, np.sqrt(A[1, 1] / det), total, stddev
    return by_moment * (-location * force[0]) + by_force * total
