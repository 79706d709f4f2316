"""What a held object weighs along the finger and across it, told by what changes once it is held.

A force along the finger moves the key points by tenths of a millimetre, as errors of the state, of the mechanics and
of the key points do; those stay as they are while an object is held, what is lifted does not. So does a force across
it: the finger bends sideways, and the side on which the key points are turns in its own plane. So every key point's
residual is remembered from when the hold began, and the change since then is explained by

    depth of the object, free,
    shape and height, by which a lifted object settles a little,
    a force T along the finger, a force S across it, and a moment M that twists it, for what is held by two flat faces
    does not roll with either,

where T and S rise or fall steadily over the images that are averaged, and have risen no farther than they can in the
time since the memory was complete: what shows at once, as jaws open right after it, is no weight. Where gravity's
direction is known, T and S are expected as it points: its share along the finger and across, plus what little acts from
outside. Whether the object is lifted at all is a hypothesis: the change counts by its probability p, where

    p / (1 - p) = p0 N(0; 0, P) / N(0; m, C) / (1 - p0)

for T and S with the expected covariance P and the estimate m with covariance C (Savage and Dickey). Once it is certain,
every change counts until the hold ends. Where the jaws move on far, or the object slides, the memory begins anew, and T
and S are what they were.
"""

from math import exp, hypot, log, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import DEPTH, HEIGHT
from finforce_ifea.tracking.contact_state import ContactState

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Images that make a memory, time over which changes since are averaged [s], and how fast forces change meanwhile [N/s].
_REMEMBERED, _AVERAGED, _RISES = 24, 0.25, 1.0
# A hold has ended once the object is so much deeper or higher [m]: a weight that goes over from one jaw to the other
# moves the object by a millimetre. Standard deviation of what the mechanics errs by on the way there, as a share of it.
_DEEPER, _HIGHER, _BEYOND = 2.5e-3, 1.5e-3, 0.05
# What is seen of a force across is off by this share of it: the finger's side turns before the camera.
_TURNED = 0.1
# Standard deviations of how a lifted object settles, as a share of what shape and height were expected to be off, and
# of the weight [N].
_SETTLES, _WEIGHT = 0.05, 0.7
# And of T and S in addition to what a weight makes of them in a known direction [N].
_OUTSIDE = 0.1
# And of how far it has slid or tilted, as a share of what its pose says. A tilt [rad] after which a hold begins anew,
# and how far from its axis a tilted object presses [m].
_SLIDES, _TILTED, _TILT_ARM = 0.3, 0.05, 0.01
# Standard deviation of the location along y at which a lifted object presses, as a share of half the finger's width.
_PRESSURE_ARM = 0.5
# What is held by the jaws alone does not slide out: of the force along the finger its weight is left, as far as
# friction can.
LARGEST_RATIO = 0.9
# [N m], keeps the moment's variance above zero where the finger's width is unknown.
_LEAST_MOMENT = 1e-6
# The errors of so many successive images count for one.
_ALIKE = 1.5
# Probability that a held object is lifted in an image, and that with which it is from then on.
_LIFTED, _CERTAIN = 0.02, 0.999
# Fewer points than these say nothing.
_FEWEST = 6
# What changes: shape, height, T, S, M, and the speeds of T and S.
_T, _S, _UNKNOWN = 2, 3, 7


class HeldWeight:
    """Follows one object.

    Attributes:
        force: along the finger [N].
        stddev: of it [N]; infinite before there is a memory.
        lateral: force across the finger [N].
        lateral_stddev: of it [N]; infinite before anything is lifted.
    """

    def __init__(self, half_width: float) -> None:
        """Start with an object that is not held yet; `half_width` is that of the inner face [m], 0 where unknown."""
        self._arm = _PRESSURE_ARM * half_width
        self.reset()

    def reset(self) -> None:
        """Forget the object."""
        self.force, self.stddev = 0.0, np.inf
        self.lateral, self.lateral_stddev = 0.0, np.inf
        self._begin()

    def _begin(self) -> None:
        """Start to remember."""
        self._images, self._x, self._elapsed = 0, np.zeros(3), 0.0
        self._forget_changes()
        self._before, self._lifted, self._led = np.array([self.force, self.lateral]), False, np.zeros(2)

    def _forget_changes(self) -> None:
        self._information, self._vector = np.zeros((_UNKNOWN, _UNKNOWN)), np.zeros(_UNKNOWN)

    def lead(self, change: NDArray) -> None:
        """Take the object for one whose shape and height (2,) have changed: what that moves is no force."""
        if self._images < _REMEMBERED:
            self._begin()
            return
        self._led += change
        self._forget_changes()

    def update(
        self,
        points: NDArray,
        state: ContactState,
        response: tuple[NDArray, NDArray],
        prior: NDArray,
        dt: float,
        gravity: NDArray | None = None,
    ) -> float:
        """Take one image of something that presses and return the traction ratio that the held object asks for.

        Args:
            points: residuals of the key points, see `KEYPOINT`.
            state: found with a lateral force of `lateral`.
            response: what the residuals show of a lateral force (K, 3) [m/N] and of a moment that twists the finger
                (K, 3) [m/(N m)], along x, y and z.
            prior: variance of shape and height (2,).
            dt: time since the last image [s].
            gravity: its direction (3,) in the jaw's frame; None where unknown.
        """
        offset = state["x_asked"] - self._x
        has_slid = abs(offset[HEIGHT]) > _HIGHER or abs(self._led[0]) > _TILTED
        upright = find_upright_ratio(state["pressing"], float(state["traction_ratio"]))
        image = points, state, response, (upright, self.lateral)
        if self._images and (abs(offset[DEPTH]) > _DEEPER or has_slid):
            if has_slid and self._images == _REMEMBERED:
                self._compare(image, offset, prior, dt, gravity)
            self._begin()
        if not self._images:
            self._x, offset = state["x_asked"].copy(), np.zeros(3)
            self._memory, self._counts = np.zeros((len(points), 3)), np.zeros(len(points))
        if self._images < _REMEMBERED:
            self._images += 1
            left, seen = _find_left(image, offset, self._before), points["weight"] > 0.0
            self._counts += seen
            self._memory += np.where(seen[:, None], left - self._memory, 0.0) / np.maximum(self._counts, 1.0)[:, None]
        else:
            self._compare(image, offset, prior, dt, gravity)
        return upright + self.force / hypot(state["pressing"][0], state["pressing"][2])

    def _compare(self, image: tuple, offset: NDArray, prior: NDArray, dt: float, gravity: NDArray | None) -> None:
        """Explain what has changed since the memory, in a state that is an offset (3,) from there."""
        points, state, _, _ = image
        known = np.where(self._counts > 0.5 * _REMEMBERED, points["weight"], 0.0)
        if np.count_nonzero(known) < _FEWEST:
            return
        left = _find_left(image, offset, self._before) - self._memory
        beyond = _BEYOND**2 * (offset[DEPTH] ** 2 + offset[HEIGHT] ** 2 + (_TILT_ARM * self._led[0]) ** 2)
        self._information, self._vector = _age(self._information, self._vector, dt)
        self._elapsed += dt
        _accumulate(image, left, known, beyond, self._information, self._vector)
        moment = self._arm * hypot(state["pressing"][0], state["pressing"][2]) + _LEAST_MOMENT
        risen = min(_WEIGHT, _RISES * self._elapsed)
        settles = np.array([0.0, 0.0, risen, risen, moment, _RISES, _RISES]) ** 2
        settles[:2] = _SETTLES**2 * prior + (_SLIDES * self._led) ** 2
        expected = np.diag(1.0 / settles)
        if gravity is not None:
            expected[_T : _S + 1, _T : _S + 1] = _expect_weight(gravity) * (_WEIGHT / risen) ** 2
        spread = np.linalg.inv(self._information / _ALIKE + expected)
        asked = self._vector / _ALIKE
        asked[:2] += self._led / settles[:2]
        changes, covariance = (spread @ asked)[_T : _S + 1], spread[_T : _S + 1, _T : _S + 1]
        prior_covariance = np.linalg.inv(expected[_T : _S + 1, _T : _S + 1])
        share = 1.0 if self._lifted else _find_share(changes, covariance, prior_covariance)
        self._lifted = share > _CERTAIN
        self.force, self.lateral = (float(value) for value in self._before + share * changes)
        variance = np.diag(covariance)
        between = share * (1.0 - share) * changes**2
        self.stddev = sqrt(float(variance[0] + between[0]))
        if share > _LIFTED:
            self.lateral_stddev = sqrt(float(share * variance[1] + between[1]))


def _find_share(changes: NDArray, covariance: NDArray, expected: NDArray) -> float:
    """Return the probability that T and S (2,) have changed, for their covariance and the one before it was seen."""
    squared = changes @ np.linalg.solve(covariance, changes)
    odds = 0.5 * squared + 0.5 * log(np.linalg.det(covariance) / np.linalg.det(expected))
    return 1.0 / (1.0 + (1.0 - _LIFTED) / _LIFTED * exp(-min(odds, 50.0)))


def find_upright_ratio(force: NDArray, ratio: float) -> float:
    """Return the traction ratio at which a force (3,) [N] that has a ratio now has nothing along the finger."""
    ahead, along = force[0] - ratio * force[2], force[2] + ratio * force[0]
    return min(max(along / ahead, -LARGEST_RATIO), LARGEST_RATIO) if ahead != 0.0 else 0.0


def project_response(motions: NDArray, gain: NDArray) -> NDArray:
    """Return what residuals show of lateral motions (K, 3): those in x and z are taken as if y were known.

    A residual in the plane is what is left once the residual along y has told of noise that they share, which is most
    of what is seen along an oblique line of sight.

    Args:
        motions: (K, 3).
        gain: regression of the noise along x and z on that along y (K, 2).
    """
    seen = motions.copy()
    seen[:, ::2] -= gain * motions[:, 1:2]
    return seen


def _expect_weight(gravity: NDArray) -> NDArray:
    """Return the inverse covariance (2, 2) [1/N^2] of T and S before anything is seen of them."""
    pulls = gravity[[2, 1]]
    return np.linalg.inv(_WEIGHT**2 * np.outer(pulls, pulls) + _OUTSIDE**2 * np.eye(2))


@njit(**_OPTIONS)
def _age(information, vector, dt):
    """Return information (7, 7) and vector (7,) a time later, when T and S have gone on at their speeds."""
    kept = np.exp(-dt / _AVERAGED)
    aged, later = kept * information, kept * vector
    for force in range(2):
        now, speed = _T + force, _UNKNOWN - 2 + force
        later[speed] -= dt * later[now]
        for i in range(len(vector)):
            aged[i, speed] -= dt * aged[i, now]
        for i in range(len(vector)):
            aged[speed, i] -= dt * aged[now, i]
    return aged, later


@njit(**_OPTIONS)
def _find_left(image, offset, before):
    """Return the residuals (K, 3) [m] in the state of the memory with the forces along and across that there were.

    Their depth is the one that was found.
    """
    points, state, response, (upright, lateral) = image
    state = state[()]
    left, normal = np.empty((len(points), 3)), np.hypot(state.pressing[0], state.pressing[2])
    for k in range(len(points)):
        point = points[k]
        left[k, 0], left[k, 1], left[k, 2] = point.r[0], point.lateral, point.r[1]
        for a in range(3):
            left[k, a] += response[0][k, a] * (lateral - before[1])
        for a in range(2):
            left[k, 2 * a] += point.modes[a, 3] * (state.traction_ratio - upright - before[0] / normal)
            left[k, 2 * a] -= point.modes[a, 0] * state.moved[0]
            for i in range(1, 3):
                left[k, 2 * a] += point.modes[a, i] * (offset[i] - state.moved[i])
    return left


@njit(**_OPTIONS)
def _accumulate(image, left, weights, beyond, information, vector):
    """Add one image, its depth eliminated, to information (7, 7) and vector (7,) on what changes.

    `beyond` is the variance of each coordinate of a key point that comes on top of its noise [m^2].
    """
    points, state, (by_force, by_moment), (_, lateral) = image
    state = state[()]
    A, g, normal = np.zeros((6, 6)), np.zeros(6), np.hypot(state.pressing[0], state.pressing[2])
    rows = np.zeros((6, 2))
    for k in range(len(weights)):
        if weights[k] <= 0.0:
            continue
        point, noise = points[k], points[k].noise
        turned = _TURNED**2 * lateral**2 * (by_force[k] ** 2).sum()
        n00, n11 = noise[0, 0] + beyond + turned, noise[1, 1] + beyond + turned
        det = n00 * n11 - noise[0, 1] ** 2
        w00, w11, w01 = weights[k] * n11 / det, weights[k] * n00 / det, -weights[k] * noise[0, 1] / det
        for a in range(2):
            rows[0, a], rows[1, a], rows[2, a] = point.modes[a, 0], point.modes[a, 1], point.modes[a, 2]
            rows[3, a], rows[4, a] = point.modes[a, 3] / normal, by_force[k, 2 * a]
            rows[5, a] = by_moment[k, 2 * a]
        for i in range(6):
            q0, q1 = w00 * rows[i, 0] + w01 * rows[i, 1], w01 * rows[i, 0] + w11 * rows[i, 1]
            g[i] += q0 * left[k, 0] + q1 * left[k, 2]
            for j in range(6):
                A[i, j] += q0 * rows[j, 0] + q1 * rows[j, 1]
        certain = weights[k] / (point.lateral_noise + beyond + turned)
        h0, h1 = by_force[k, 1], by_moment[k, 1]
        A[4, 4] += certain * h0 * h0
        A[4, 5] += certain * h0 * h1
        A[5, 4] += certain * h0 * h1
        A[5, 5] += certain * h1 * h1
        g[4] += certain * h0 * left[k, 1]
        g[5] += certain * h1 * left[k, 1]
    for i in range(5):
        vector[i] += g[i + 1] - A[i + 1, 0] * g[0] / A[0, 0]
        for j in range(5):
            information[i, j] += A[i + 1, j + 1] - A[i + 1, 0] * A[0, j + 1] / A[0, 0]
