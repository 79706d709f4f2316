"""Whether all key points have moved together since the tare, as when the camera was bumped.

A load bends the jaw, and hardly moves what is next to the clamp; a camera that has moved relative to the jaw shifts and
turns all key points as one. The residuals r_k of an image, with their derivatives J_k by depth, shape and height, and
the shift and turn b in the plane that moves them by B_k b,

    r_k = J_k y + B_k b + noise,

are fitted robustly (Geman and McClure). What they tell of b is summed over the last 1, 2, 4, ... images: a new bump
shows in few of them, and a small one only in many. With b and its covariance P from each sum, the camera has stood
still or was bumped by Bayes' rule from

    N(b; 0, P + s^2),    s as errors of the mechanics feign a motion, or as large as a bump.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce.elimination import eliminate
from finforce_ifea.tare import Tare
from finforce_ifea.tracking.contact_filter import invert_symmetric
from finforce_ifea.tracking.contact_state import ContactState, measure_along

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Probability that a camera was bumped since the tare, of which nothing is known.
_SELDOM = 0.05
# Motion by a bump, one standard deviation [m]; that which errors of the mechanics feign, and its share of the bending.
_BUMP, _FEIGNED, _FEIGNED_SHARE = 1e-3, 0.04e-3, 0.02
_SIZES = (0.25e-3, 0.5e-3, 1e-3, 2e-3)
# Numbers of images over which the motion is averaged.
_WINDOWS = (1, 2, 4, 8, 16, 32, 64)
# Fewer key points do not tell. Standard deviations of the depth, which is free, and of a height that may be wrong [m].
_FEWEST, _FREE, _ELSEWHERE = 6, 10e-3, 30e-3
# Squared distance that keeps a quarter of its weight, median of one in two axes; iterations for the noise, and after.
_GATE, _MEDIAN_SQUARE, _FIRST, _ROUNDS = 9.0, 1.386, 3, 6
_STATE, _MOTION = 3, 3
_SIZE = _STATE + _MOTION

# Of the last images: information on the motion, this times the motion, how it changes the state, and the share of the
# variance that is the same in all of them.
_TRACK = np.dtype(
    [
        ("A", float, (_WINDOWS[-1], _MOTION, _MOTION)),
        ("told", float, (_WINDOWS[-1], _MOTION)),
        ("lever", float, (_STATE, _MOTION)),
        ("lasting", float, _WINDOWS[-1]),
        ("count", int),
    ],
    align=True,
)


class CommonMotion:
    """Follows the motion of one camera."""

    def __init__(self) -> None:
        """Start with a camera that has not moved."""
        self._tare: Tare | None = None
        self._track = np.zeros((), _TRACK)

    def update(
        self, points: NDArray, positions: NDArray, state: ContactState, expected: tuple[NDArray, NDArray], tare: Tare
    ) -> None:
        """Take one image; its state gets what was found, and its covariance what that would change.

        Args:
            points: (K,), see `KEYPOINT`.
            positions: of the deformed model (K, 3) [m].
            state: of the contact.
            expected: shape and height (2,), and the variance of both (2,).
            tare: offsets of the key points.
        """
        if tare is not self._tare:
            self._tare = tare
            self._track = np.zeros((), _TRACK)
        if not tare.is_taken:
            return
        follow_motion(points, positions, state, *expected, self._track)


@njit(**_OPTIONS)
def follow_motion(points, positions, state, mean, variance, track):
    """Take an image into the track of the motion, and what that tells into the state of the contact.

    Args:
        points: (K,), see `KEYPOINT`.
        positions: of the deformed model (K, 3) [m].
        state: of the contact.
        mean: expected shape and height (2,).
        variance: of both (2,).
        track: the motion so far.
    """
    state, track = state[()], track[()]
    rows, left, bend = _collect_residuals(points, positions)
    if np.isfinite(left[:, 0]).sum() >= _FEWEST:
        H, found, level = _fit_motion(points, rows, left, (mean - state.x[1:], variance))
        _add_image(track, H, found, _measure_lasting(points, left, level))
    odds, motions = _weigh_windows(track, _FEIGNED**2 + _FEIGNED_SHARE**2 * bend)
    total = odds.sum()
    state.bumped = total / (1.0 + total)
    state.motion = np.sqrt((motions[odds.argmax()] ** 2).sum())
    for k in range(len(odds)):
        change = _multiply(track.lever, motions[k])
        for i in range(_STATE):
            for j in range(_STATE):
                state.covariance[i, j] += odds[k] / (1.0 + total) * change[i] * change[j]
    state.stddev = measure_along(state.force, state.force_modes, state.covariance)


@njit(**_OPTIONS)
def _add_image(track, H, found, lasting):
    """Add what an image tells, by Hessian (6, 6) and maximum (6,) of the log posterior, and its lasting share."""
    A, lever = _take_state_out(H)
    newest = track.count % len(track.A)
    track.told[newest] = _multiply(A, found[_STATE:])
    for i in range(_MOTION):
        A[i, i] -= 1.0 / _BUMP**2
    track.A[newest], track.lasting[newest], track.lever[:] = A, lasting, lever
    track.count += 1


@njit(**_OPTIONS)
def _weigh_windows(track, feigned):
    """Return the odds (W,) of a bump that lasts for as many images, and the motion (W, 3) that they show.

    Errors of the mechanics feign motions of the variance `feigned` [m^2].
    """
    odds, motions = np.zeros(len(_WINDOWS)), np.zeros((len(_WINDOWS), _MOTION))
    A, told, lasting, added = 1e-3 / _BUMP**2 * np.eye(_MOTION), np.zeros(_MOTION), 0.0, 0
    for k in range(len(_WINDOWS)):
        while added < min(_WINDOWS[k], track.count):
            added += 1
            i = (track.count - added) % len(track.A)
            A += track.A[i]
            told += track.told[i]
            lasting += track.lasting[i]
        P = invert_symmetric(A)
        motions[k] = _multiply(P, told)
        P *= 1.0 + max(lasting, 0.0) * (1.0 - 1.0 / max(added, 1))
        still = _measure_surprise(motions[k], P, feigned)
        for size in _SIZES:
            odds[k] += np.exp(0.5 * min(still - _measure_surprise(motions[k], P, size**2), 60.0))
    return odds * (_SELDOM / (1.0 - _SELDOM) / len(_SIZES) / len(_WINDOWS)), motions


@njit(**_OPTIONS)
def _collect_residuals(points, positions):
    """Return the derivatives (K, 2, 6) of the residuals, these (K, 2) [m], NaN where unused, and the bending [m^2]."""
    count = len(points)
    rows, left = np.zeros((count, 2, _SIZE)), np.full((count, 2), np.nan)
    centre, reach, bend, known = np.zeros(2), 0.0, 0.0, 0
    for k in range(count):
        point = points[k]
        if np.isfinite(point.measured[0] + point.measured[1] + point.measured[2]):
            lateral = point.measured[1] - positions[k, 1]
            for a in range(2):
                left[k, a] = point.measured[2 * a] - positions[k, 2 * a] - point.gain[a] * lateral
                centre[a] += point.rest[2 * a]
                bend += (positions[k, 2 * a] - point.rest[2 * a]) ** 2
            known += 1
    centre /= max(known, 1)
    for k in range(count):
        if np.isfinite(left[k, 0]):
            reach += (points[k].rest[0] - centre[0]) ** 2 + (points[k].rest[2] - centre[1]) ** 2
    reach = np.sqrt(reach / max(known, 1)) + 1e-12
    for k in range(count):
        for a in range(2):
            rows[k, a, :_STATE] = points[k].modes[a, :_STATE]
            rows[k, a, _STATE + a] = 1.0
        rows[k, 0, 5] = (positions[k, 2] - centre[1]) / reach
        rows[k, 1, 5] = -(positions[k, 0] - centre[0]) / reach
    return rows, left, bend / max(known, 1)


@njit(**_OPTIONS)
def _fit_motion(points, rows, left, prior):
    """Return Hessian (6, 6) and maximum (6,) of the log posterior of state and motion, and the noise level [-].

    The prior is mean and variance of shape and height, each (2,); the noise is counted in that of the tare.
    """
    offset, variance = prior
    known = np.isfinite(left[:, 0])
    H, found, seen = np.zeros((_SIZE, _SIZE)), np.zeros(_SIZE), 1.0
    for a in range(2):
        found[_STATE + a] = np.median(left[known, a])
    squares = np.empty(len(points))
    for turn in range(_ROUNDS):
        if turn == _FIRST:
            seen = np.median(squares[known]) / _MEDIAN_SQUARE
        H[:] = 0.0
        g = np.zeros((_SIZE, 1))
        _add_prior(H, g, 0, -found[0], _FREE**2)
        _add_prior(H, g, 1, offset[0] - found[1], variance[0])
        _add_prior(H, g, 2, offset[1] - found[2], variance[1] + _ELSEWHERE**2)
        for i in range(_STATE, _SIZE):
            _add_prior(H, g, i, -found[i], _BUMP**2)
        for k in range(len(points)):
            if known[k]:
                squares[k] = _add_point(points[k], rows[k], left[k], max(1.0, seen), found, H, g)
        for i in range(_SIZE):
            for j in range(i):
                H[j, i] = H[i, j]
        eliminate(H.copy(), g)
        found += g[:, 0]
    return H, found, seen


@njit(**_OPTIONS)
def _measure_lasting(points, left, level):
    """Return the share of the variance that averages do not lessen: offsets, biases, and noise beyond the tare's."""
    lasting, total = 0.0, 0.0
    for k in range(len(points)):
        if np.isfinite(left[k, 0]):
            scatter = 0.5 * (points[k].tare_noise[0, 0] + points[k].tare_noise[1, 1]) / max(points[k].trust, 1e-6)
            lasting += points[k].offset_variance + (level - 1.0) * scatter
            total += points[k].offset_variance + max(level, 1.0) * scatter
    return lasting / total


@njit(**_OPTIONS)
def _add_prior(H, g, i, missing, variance):
    """Add the prior of unknown i, which is off its mean by `missing`, to Hessian and gradient."""
    H[i, i] += 1.0 / variance
    g[i, 0] += missing / variance


@njit(**_OPTIONS)
def _add_point(point, rows, left, level, found, H, g):
    """Add a key point to the lower half of the Hessian and to the gradient; return its squared distance."""
    scale = level / max(point.trust, 1e-6)
    s00, s11 = point.tare_noise[0, 0] * scale + point.bias, point.tare_noise[1, 1] * scale + point.bias
    s01 = point.tare_noise[0, 1] * scale
    det = s00 * s11 - s01 * s01
    r0, r1 = left
    for i in range(_SIZE):
        r0 -= rows[0, i] * found[i]
        r1 -= rows[1, i] * found[i]
    square = (s11 * r0 * r0 - 2.0 * s01 * r0 * r1 + s00 * r1 * r1) / det
    weight = 1.0 / (1.0 + square / _GATE) ** 2 / det
    for i in range(_SIZE):
        a = weight * (s11 * rows[0, i] - s01 * rows[1, i])
        b = weight * (s00 * rows[1, i] - s01 * rows[0, i])
        g[i, 0] += a * r0 + b * r1
        for j in range(i + 1):
            H[i, j] += a * rows[0, j] + b * rows[1, j]
    return square


@njit(**_OPTIONS)
def _take_state_out(H):
    """Return the information (3, 3) of a Hessian (6, 6) on the motion, and what that changes of the state (3, 3)."""
    A, change = H[_STATE:, _STATE:].copy(), H[:_STATE, _STATE:].copy()
    eliminate(H[:_STATE, :_STATE].copy(), change)
    for i in range(_MOTION):
        for j in range(_MOTION):
            for k in range(_STATE):
                A[i, j] -= H[_STATE + i, k] * change[k, j]
    return A, -change


@njit(**_OPTIONS)
def _multiply(A, b):
    """Return A b."""
    out = np.zeros(len(A))
    for i in range(len(A)):
        for j in range(len(b)):
            out[i] += A[i, j] * b[j]
    return out


@njit(**_OPTIONS)
def _measure_surprise(b, P, variance):
    """Return minus twice the log of N(b; 0, P + variance), but for a constant."""
    S = P.copy()
    for i in range(_MOTION):
        S[i, i] += variance
    minors = (
        S[1, 1] * S[2, 2] - S[1, 2] ** 2,
        S[0, 1] * S[2, 2] - S[1, 2] * S[0, 2],
        S[0, 1] * S[1, 2] - S[1, 1] * S[0, 2],
    )
    size = S[0, 0] * minors[0] - S[0, 1] * minors[1] + S[0, 2] * minors[2]
    return np.log(size) + _measure_square(b, S)


@njit(**_OPTIONS)
def _measure_square(b, S):
    """Return b^T S^-1 b."""
    return (b * _multiply(invert_symmetric(S), b)).sum()
