"""The friction of one object: how rough it is, and how far it makes use of that.

The coefficient shows in the way that the key points differ between loading and unloading. What is left of their
residuals in the expected state is explained by

    shape and height of the object, as far as they may differ from what was expected,
    mu m,  m the traction ratio of the forces that the history of the contact predicts for a coefficient of one,
    b,     a traction ratio that the mechanics or the calibration err by, whatever the motion,
    c,     a tangential force that errors of the tare look like,

with the depth of each image free. m changes its sign when the motion does, b and c do not: loops tell mu from them.
What goes with m in the residuals without being traction is no chance that images average out: where it is larger than
chance would leave it, those images say less by as much. Either the object is as smooth as those that the finger was
calibrated on, or mu is anything about the expected one.

How far friction is mobilised shows in the path of the object. A second contact of the same jaw is pressed by the object
alone, wherever it was found, with friction and its history. Noise is no motion: the object moves there once it has left
its last state by more than chance.
"""

from math import ceil, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce.elimination import eliminate
from finforce_ifea.contact_mechanics.friction import Friction
from finforce_ifea.contact_mechanics.indenter import DEPTH, HEIGHT
from finforce_ifea.contact_mechanics.pressed_jaw import RigidContact, limit_step
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.contact_state import ContactState

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Standard deviations of b [-] and c [N].
_RATIO_ERROR, _FORCE_ERROR = 0.07, 0.1
# The errors of successive images are not independent: so many count for one. Beyond this many images old ones fade.
_ALIKE, _MEMORY = 3.0, 3000.0
_LARGEST = 1.5


class Coefficient(NamedTuple):
    """A coefficient of friction and its standard deviation."""

    mean: float
    stddev: float


# Of objects that show no friction, where no calibration says more.
SMOOTH = Coefficient(0.0, 0.02)


# What goes with m in the images, of each key point, as regressions on it: residuals [m], their derivatives by depth,
# shape, height, mu, b and c, sum of m^2, and the noise in an image [m^2].
_MEANS = np.dtype([("left", float, 2), ("rows", float, (6, 2)), ("count", float), ("noise", float, (2, 2))])


class FrictionEstimate:
    """Learns the coefficient of friction of one object.

    Attributes:
        coefficient: of friction, as far as it is known.
    """

    def __init__(self, settings: EstimatorSettings, smooth: Coefficient = SMOOTH) -> None:
        """Keep what is expected of objects, that of those of the calibration included."""
        self._unknown = Coefficient(settings.friction, settings.friction_stddev), settings.smooth_share
        self._smooth = smooth
        self.expect(None)

    def expect(self, friction: Coefficient | None) -> None:
        """Expect an object of a stated coefficient, or one of which nothing is known."""
        self._rough, self._share = self._unknown if friction is None else (friction, 0.0)
        self.reset()

    def reset(self) -> None:
        """Start with an object of which nothing is known."""
        self._information, self._vector = np.zeros((5, 5)), np.zeros(5)
        self._means = np.zeros(0, _MEANS)
        self._prior = np.ones(2)
        self.coefficient = self._judge(np.inf, 0.0)

    def update(self, points: NDArray, state: ContactState, mean: NDArray, prior: NDArray, mobilised: float) -> None:
        """Take one image.

        Args:
            points: residuals of the key points, see `KEYPOINT`.
            state: of the contact.
            mean: expected shape and height (2,).
            prior: variance of both (2,).
            mobilised: how far friction was made use of, from -1 to 1.
        """
        self._prior = prior.copy()
        if len(self._means) != len(points):
            self._means = np.zeros(len(points), _MEANS)
        _accumulate((points, state, mean, mobilised), self._information, self._vector, self._means)
        self.coefficient = self._judge(*self._see())

    def _see(self) -> tuple[float, float]:
        """Return variance and mean of the coefficient by the key points alone."""
        variance, mean, found = _solve(self._information, self._vector, self._prior)
        return (variance * _find_excess(self._means, found) if np.isfinite(variance) else variance), mean

    @property
    def seen(self) -> Coefficient:
        """What the key points alone say of the coefficient; its deviation is infinite where they say nothing."""
        variance, mean = self._see()
        return Coefficient(mean, float(np.sqrt(variance)))

    def _judge(self, variance: float, mean: float) -> Coefficient:
        """Return the coefficient for what the key points alone say of it."""
        smooth, rough = (*self._smooth, self._share), (*self._rough, 1.0 - self._share)
        return Coefficient(*_judge(variance, mean, smooth, rough))


@njit(**_OPTIONS)
def _judge(variance, mean, smooth, rough):
    """Return mean and standard deviation for two hypotheses (mean, standard deviation, probability)."""
    total, first, second = 0.0, 0.0, 0.0
    for expected, deviation, share in (smooth, rough):
        own = max(deviation, 1e-6) ** 2
        weight, middle, spread = share, expected, own
        if np.isfinite(variance):
            both = own + variance
            weight = share * np.exp(-0.5 * min((mean - expected) ** 2 / both, 1e3)) / np.sqrt(both) + 1e-300
            middle, spread = (expected * variance + mean * own) / both, own * variance / both
        middle = min(max(middle, 0.0), _LARGEST)
        total += weight
        first += weight * middle
        second += weight * (spread + middle * middle)
    first /= total
    return first, np.sqrt(max(second / total - first * first, 0.0))


@njit(**_OPTIONS)
def _explain(image, k, row, left):
    """Fill in the derivatives (6, 2) of key point k by depth, shape, height, mu, b and c, and what is left to them."""
    points, state, mean, mobilised = image
    state = state[()]
    point, normal = points[k], np.hypot(state.pressing[0], state.pressing[2])
    for a in range(2):
        by_traction = point.modes[a, 3]
        row[0, a], row[1, a], row[2, a] = point.modes[a, 0], point.modes[a, 1], point.modes[a, 2]
        row[3, a], row[4, a], row[5, a] = mobilised * by_traction, by_traction, by_traction / normal
        left[a] = point.r[a] + by_traction * state.traction_ratio - row[0, a] * state.moved[0]
        for i in range(1, 3):
            left[a] += row[i, a] * (state.x_asked[i] - mean[i - 1] - state.moved[i])


@njit(**_OPTIONS)
def _accumulate(image, information, vector, means):
    """Add one image, its depth eliminated, to information (5, 5) and vector (5,) on shape, height, mu, b and c."""
    points, _, _, mobilised = image
    A, g = np.zeros((6, 6)), np.zeros(6)
    row, left = np.zeros((6, 2)), np.zeros(2)
    for k in range(len(points)):
        w, noise = points[k].weight, points[k].noise
        if w <= 0.0:
            continue
        det = noise[0, 0] * noise[1, 1] - noise[0, 1] * noise[0, 1]
        p00, p11, p01 = w * noise[1, 1] / det, w * noise[0, 0] / det, -w * noise[0, 1] / det
        _explain(image, k, row, left)
        _remember(means[k], w, mobilised, left, row, noise)
        for i in range(6):
            q0, q1 = p00 * row[i, 0] + p01 * row[i, 1], p01 * row[i, 0] + p11 * row[i, 1]
            g[i] += q0 * left[0] + q1 * left[1]
            for j in range(6):
                A[i, j] += q0 * row[j, 0] + q1 * row[j, 1]
    if not A[0, 0] > 0.0:
        return
    for i in range(5):
        vector[i] = (1.0 - 1.0 / _MEMORY) * vector[i] + (g[i + 1] - A[i + 1, 0] * g[0] / A[0, 0]) / _ALIKE
        for j in range(5):
            added = (A[i + 1, j + 1] - A[i + 1, 0] * A[0, j + 1] / A[0, 0]) / _ALIKE
            information[i, j] = (1.0 - 1.0 / _MEMORY) * information[i, j] + added


@njit(**_OPTIONS)
def _remember(mean, weight, m, left, row, noise):
    """Take what is left (2,) to a key point and its derivatives (6, 2) into the means, as far as they go with m."""
    mean.count = (1.0 - 1.0 / _MEMORY) * mean.count + weight * m * m
    if not mean.count > 0.0:
        return
    share = weight * m / mean.count
    for a in range(2):
        mean.left[a] += share * (left[a] - m * mean.left[a])
        for i in range(6):
            mean.rows[i, a] += share * (row[i, a] - m * mean.rows[i, a])
        for b in range(2):
            mean.noise[a, b] += m * share * (noise[a, b] - mean.noise[a, b])


@njit(**_OPTIONS)
def _solve(information, vector, prior):
    """Return variance and mean of mu by the key points alone, infinite where they say nothing, and all unknowns."""
    A = information.copy()
    A[0, 0] += 1.0 / prior[0]
    A[1, 1] += 1.0 / prior[1]
    A[3, 3] += 1.0 / _RATIO_ERROR**2
    A[4, 4] += 1.0 / _FORCE_ERROR**2
    others = (0, 1, 3, 4)
    B, known = np.empty((4, 4)), np.empty((4, 2))
    for i in range(4):
        known[i, 0], known[i, 1] = vector[others[i]], A[2, others[i]]
        for j in range(4):
            B[i, j] = A[others[i], others[j]]
    eliminate(B, known)
    left, rest, found = A[2, 2], vector[2], np.zeros(5)
    for i in range(4):
        left -= A[2, others[i]] * known[i, 1]
        rest -= A[2, others[i]] * known[i, 0]
    if not left > 1e-9:
        return np.inf, 0.0, found
    found[2] = rest / left
    for i in range(4):
        found[others[i]] = known[i, 0] - known[i, 1] * found[2]
    return 1.0 / left, found[2], found


@njit(**_OPTIONS)
def _find_excess(means, found):
    """Return how much larger what goes with m is than chance would leave it, squared, at least 1.

    They are those that the unknowns (5,) and one common depth leave, over their standard deviations.
    """
    count, unknown, rest = 0, 6, np.zeros(2)
    top, low = 0.0, 0.0
    for turn in range(2):
        depth = top / low if turn else 0.0
        square = 0.0
        for k in range(len(means)):
            mean = means[k]
            if mean.count < 1.0:
                continue
            for a in range(2):
                rest[a] = mean.left[a] - mean.rows[0, a] * depth
                for i in range(5):
                    rest[a] -= mean.rows[i + 1, a] * found[i]
            noise, number = mean.noise, mean.count / _ALIKE
            det = (noise[0, 0] * noise[1, 1] - noise[0, 1] ** 2) / number
            h0, h1 = mean.rows[0, 0], mean.rows[0, 1]
            p0, p1 = noise[1, 1] * rest[0] - noise[0, 1] * rest[1], noise[0, 0] * rest[1] - noise[0, 1] * rest[0]
            if turn:
                square += (rest[0] * p0 + rest[1] * p1) / det
                count += 2
            else:
                top += (h0 * p0 + h1 * p1) / det
                low += (h0 * h0 * noise[1, 1] - 2.0 * h0 * h1 * noise[0, 1] + h1 * h1 * noise[0, 0]) / det
        if not low > 0.0:
            return 1.0
    return max(1.0, square / max(count - unknown, 1))


# Below this coefficient there is next to nothing to follow; the path is that of an object as rough as this.
_LEAST_COEFFICIENT = 0.15
# Chance, in standard deviations of the depth, at least [m]; and of a height [m].
_SIGMAS, _LEAST_PLAY, _PLAY_HEIGHT = 2.4, 0.03e-3, 1e-3
_ITERATIONS, _SETTLED = 12, 2e-3
# A displacement longer than this is another contact; a shorter one than the second is left for later; on the path,
# steps of at most the third [m].
_LEAP, _SHORTEST, _LONGEST = 1.5e-3, 0.08e-3, 0.12e-3
# Corrections that turn round by this much of their length are halved: points of the contact stick and slide by turns.
_TURNED, _CALMER, _LEAST_CORRECTION = -0.3, 1.5, 0.1


class SlipHistory:
    """Follows how far one object makes use of its friction.

    Attributes:
        mobilised: what friction bears over what it could, from -1 to 1.
    """

    def __init__(self, contact: RigidContact) -> None:
        """Follow the object that is pressed into a jaw."""
        self._contact, self._friction = contact, Friction(len(contact.surface.points))
        self.reset()

    def reset(self) -> None:
        """Forget the path."""
        self.mobilised = 0.0
        self._x: NDArray | None = None
        self._friction.reset()

    def shift(self, change: float) -> None:
        """Count the depth `change` [m] more, as of an object that was cut anew."""
        if self._x is not None:
            self._x[DEPTH] += change
            self._friction.shift(-change)

    def follow(self, q: NDArray, x: NDArray, stddev: float, coefficient: float) -> float:
        """Return how far friction is mobilised in a state of the contact.

        Args:
            q: shape of the jaw there, for a beginning (size,).
            x: state of the contact (3,).
            stddev: of the depth [m].
            coefficient: of friction.
        """
        self._friction.coefficient = max(coefficient, _LEAST_COEFFICIENT)
        if self._x is None or abs(x[DEPTH] - self._x[DEPTH]) > _LEAP:
            self.reset()
            self._q, self._x = q.copy(), x.copy()
            return self.mobilised
        play = max(_SIGMAS * stddev, _LEAST_PLAY)
        deeper = leave_play(x[DEPTH] - self._x[DEPTH], play)
        higher = leave_play(x[HEIGHT] - self._x[HEIGHT], _PLAY_HEIGHT)
        length = sqrt(deeper * deeper + higher * higher)
        if length < _SHORTEST:
            return self.mobilised
        aim, start, steps = x.copy(), self._x, ceil(length / _LONGEST)
        aim[DEPTH], aim[HEIGHT] = start[DEPTH] + deeper, start[HEIGHT] + higher
        for step in range(1, steps + 1):
            there = start + (aim - start) * (step / steps)
            if not (self._press(self._q, there) or self._press(q, there)):
                break
        return self.mobilised

    def _press(self, q: NDArray, x: NDArray) -> bool:
        """Press the jaw of unknowns q (size,) in the next state; return False, all as it was, where that fails."""
        contact, origin, calm = self._contact, np.array([-x[DEPTH], x[HEIGHT]]), 1.0
        corrected = np.zeros(contact.model.size)
        for _ in range(_ITERATIONS):
            state = contact.linearize(q, x, self._friction.describe(origin))
            if not state.touches:
                q = q + contact.approach(q, state.correction, x)
                continue
            correction = limit_step(contact.model, state.correction)
            calm = calm_down(correction, corrected, calm)
            q, corrected = q + calm * correction, correction
            if state.size < _SETTLED:
                self._q, self._x = q, x
                points = contact.place_points(q)
                pressed = contact.press(points, x, self._friction.describe(origin))
                self._friction.settle(pressed.shear, points, origin)
                self.mobilised = pressed.mobilised
                return True
        return False


def leave_play(change: float, play: float) -> float:
    """Return the part of a change that something makes which follows with play."""
    return change - min(max(change, -play), play)


def calm_down(correction: NDArray, before: NDArray, calm: float) -> float:
    """Return the share of a correction (size,) to be made after another one of which a share `calm` was made."""
    size = np.sqrt((correction @ correction) * (before @ before))
    if size > 0.0 and correction @ before < _TURNED * size:
        return max(_LEAST_CORRECTION, 0.5 * calm)
    return min(1.0, _CALMER * calm)
