"""Whether the jaws alone hold an object, or something else holds it, too.

The two hypotheses expect different traction on a jaw's face. What only the jaws hold does not move along the finger:
friction balances the inclination of the bent faces, but for the object's weight. What a bench, a table or a hand holds
as well is pushed along the finger by the inclined face, and friction follows from its motion on it. The key points
tell the traction ratio r themselves, the better the deeper the jaw is pressed: with the averaged residuals m_k, their
derivatives J_k by depth, shape, height and r, and the covariances S_k,

    minimise  sum_k (m_k - J_k y)^T S_k^-1 (m_k - J_k y) + prior of shape and height

for y. The ratio that this asks for, and its variance, is the evidence. Each hypothesis has a mean and a variance of r;
its share follows by Bayes' rule. Errors of the averages are those of successive images, too, so evidence is not added
up: the clearest of a grasp counts, and fades slowly.
"""

from math import exp, inf, log, sqrt

import numpy as np
from numba import njit

from finforce.elimination import eliminate
from finforce_ifea.tracking.contact_filter import sum_averages
from finforce_ifea.tracking.contact_state import ContactState
from finforce_ifea.tracking.friction import Coefficient

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Probability that only the jaws hold an object of which nothing is known.
_HELD = 0.5
# Errors of the mechanics that look like traction, as a standard deviation of the ratio.
_RATIO_ERROR = 0.08
# Time after which a hold that was recognised is asked about again [s], and log odds that are certainty.
_FADES, _CERTAIN = 20.0, 12.0


class HoldHypotheses:
    """Weighs both hypotheses for one object.

    Attributes:
        held: probability that only the jaws hold the object.
        ratio: expected traction ratio and its standard deviation.
        learnt: what the last image changed of the ratio beyond what the hypotheses expected to change [-]. The averaged
            residuals have asked for it, and show it no longer.
    """

    def __init__(self) -> None:
        """Start with an object of which nothing is known."""
        self.reset()

    def reset(self) -> None:
        """Forget the grasp."""
        self._clearest = 0.0
        self.held = _HELD
        self.ratio, self.learnt = Coefficient(0.0, inf), 0.0
        self._expected: tuple[float, float] | None = None

    def update(
        self,
        evidence: tuple[float, float],
        state: ContactState,
        expected: tuple[Coefficient, Coefficient],
        dt: float,
    ) -> float:
        """Take one image; return the expected traction ratio.

        Args:
            evidence: change of the ratio that the key points ask for, and its variance, see `measure_traction`.
            state: of the contact.
            expected: traction ratio of what the jaws alone hold, and of what something else holds, too.
            dt: time since the last image [s].
        """
        asked, spread = evidence
        spread = spread * max(1.0, float(state["scatter"]) ** 2) + _RATIO_ERROR**2
        seen = float(state["traction_ratio"]) + asked
        odds, fitted = 0.0, []
        for sign, each in zip((1.0, -1.0), expected, strict=True):
            own = each.stddev**2
            both = own + spread
            odds += sign * -0.5 * ((seen - each.mean) ** 2 / both + log(both))
            fitted.append(((each.mean * spread + seen * own) / both, own * spread / both))
        odds = min(max(odds, -_CERTAIN), _CERTAIN)
        before = self.held
        self._clearest *= exp(-dt / _FADES)
        if abs(odds) > abs(self._clearest):
            self._clearest = odds
        self.held = 1.0 / (1.0 + exp(-self._clearest) * (1.0 - _HELD) / _HELD)
        (one, first), (two, second) = fitted
        mean = self.held * one + (1.0 - self.held) * two
        means = (expected[0].mean, expected[1].mean)
        self.learnt = 0.0
        if self._expected is not None:
            grasped, fixed = (now - then for now, then in zip(means, self._expected, strict=True))
            self.learnt = mean - self.ratio.mean - before * grasped - (1.0 - before) * fixed
        self._expected = means
        between = self.held * (1.0 - self.held) * (one - two) ** 2
        self.ratio = Coefficient(mean, sqrt(self.held * first + (1.0 - self.held) * second + between))
        return mean


@njit(**_OPTIONS)
def measure_traction(points, average, variance):
    """Return the change of the traction ratio that averaged residuals ask for, its variance, and what absorbs it (3,).

    What the ratio does to the key points looks in part like a change of depth, shape and height.

    Args:
        points: (K,), see `KEYPOINT`.
        average: of their residuals (K,), see `AVERAGE`.
        variance: prior of shape and height (2,).
    """
    A, b = sum_averages(points, average)
    for i in range(2):
        A[i + 1, i + 1] += 1.0 / variance[i]
    known, others = np.empty((3, 2)), A[:3, :3].copy()
    if not A[0, 0] > 0.0:
        return 0.0, 1e9, np.zeros(3)
    for i in range(3):
        known[i, 0], known[i, 1] = b[i], A[i, 3]
    eliminate(others, known)
    information, asked = A[3, 3], b[3]
    for i in range(3):
        information -= A[3, i] * known[i, 1]
        asked -= A[3, i] * known[i, 0]
    if not information > 1e-9:
        return 0.0, 1e9, known[:, 1].copy()
    return asked / information, 1.0 / information, known[:, 1].copy()
