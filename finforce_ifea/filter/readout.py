"""Force and contact by the state of the filter."""

from __future__ import annotations

import numpy as np

from finforce.compiled import njit
from finforce_ifea.filter.filter import solve_lower
from finforce_ifea.filter.measurement import NO_WEIGHT
from finforce_ifea.filter.state import CAMERA_TURN, CAMERA_X, DEPTH, HEIGHT, TRACTION
from finforce_ifea.tracking.contact_state import LEAST_DEPTH, LOADED_DEPTH, TOUCH_DEPTH

_OPTIONS = {"cache": True, "error_model": "numpy"}
# Standard deviation of the traction ratio by errors of the force's direction [-]: considered, not estimated.
_MISDIRECTED = 0.03
# Share of the variance of a detector's lasting errors that all key points of a jaw have in common [-]: 0.02 in the
# median of scenes drawn at random, several times as much in a few of them.
COMMON = 0.05
# Largest factor by which the force may grow beyond the linearisation [-].
_LARGEST_GROWTH = 10.0
# Largest traction ratio of the mechanics [-].
LARGEST_RATIO = 0.9


@njit(**_OPTIONS)
def spread_common(H, A, L, variances):
    """Return the covariance of the first four entries due to errors common to all key points (4, 4).

    It is considered and never estimated: nothing tells it from a motion of the object.

    Args:
        H: see `Measurement`.
        A: see `Posterior`; with L the gain is K = A^T L^-1.
        L: see `Posterior`.
        variances: of a shift along x and z [m^2] and a turn that all key points share (3,).
    """
    answers, out = solve_lower(L, np.ascontiguousarray(H[:, CAMERA_X : CAMERA_TURN + 1])), np.zeros((4, 4))
    for j in range(3):
        moved = np.zeros(4)
        for i in range(len(A)):
            for c in range(4):
                moved[c] += A[i, c] * answers[i, j]
        for c in range(4):
            for d in range(4):
                out[c, d] += variances[j] * moved[c] * moved[d]
    return out


@njit(**_OPTIONS)
def read_out(state, force, modes, x, log_weights, P, shift, smoothing, at, ratios, ratio, spread):
    """Fill in force and covariance of the hypotheses.

    Args:
        state: see `CONTACT_STATE`.
        force: of the mechanics where it was linearised (3,) [N].
        modes: its derivatives by depth, shape, height and traction ratio (3, 4).
        x: means of the hypotheses (N, n).
        log_weights: of the hypotheses (N,).
        P: covariance (n, n).
        shift: from the depth in x to that of the mechanics [m].
        smoothing: covariance of the first four entries by the noise of this image alone (4, 4), the factor by which
            smoothing lessens the standard deviation of the depth, and what `spread_common` returns.
        at: depth, shape and height of the linearisation (3,).
        ratios: traction ratio of each hypothesis (N,).
        ratio: that of the linearisation.
        spread: variance of the traction ratio within the hypotheses.
    """
    state, w, count = state[()], np.exp(log_weights), len(x)
    forces, found = np.zeros((count, 3)), np.zeros(3)
    for i in range(count):
        offset = (x[i, 0] + shift - at[0], x[i, 1] - at[1], x[i, 2] - at[2], ratios[i] + x[i, TRACTION] - ratio)
        for a in range(3):
            forces[i, a] = force[a]
            for c in range(4):
                forces[i, a] += modes[a, c] * offset[c]
            found[a] += w[i] * forces[i, a]
    (own, lessened, common), inner = smoothing, P[:4, :4].copy()
    for c in range(4):
        inner[0, c] += (lessened - 1.0) * own[0, c]
        inner[c, 0] += (lessened - 1.0) * own[c, 0]
    inner[0, 0] += (lessened - 1.0) ** 2 * own[0, 0]
    inner += common
    covariance = np.dot(modes, np.dot(inner, np.ascontiguousarray(modes.T)))
    # where the linearisation has found less of a force, it turns less by the traction ratio, too
    grown = min(max((found**2).sum() / max((force**2).sum(), 1e-300), 1.0), _LARGEST_GROWTH**2)
    for a in range(3):
        for b in range(3):
            covariance[a, b] += (spread + _MISDIRECTED**2) * grown * modes[a, 3] * modes[b, 3]
            for i in range(count):
                covariance[a, b] += w[i] * (forces[i, a] - found[a]) * (forces[i, b] - found[b])
    continued, size, along = min(1.0, max(0.0, state.depth / LEAST_DEPTH)), 0.0, 0.0
    for a in range(3):
        state.force[a] = continued * found[a]
        size += state.force[a] ** 2
        for b in range(3):
            state.covariance[a, b] = covariance[a, b]
            state.force_modes[a, b] = 1.0 if a == b else 0.0
            along += state.force[a] * covariance[a, b] * state.force[b]
    state.magnitude = np.sqrt(size)
    state.stddev = np.sqrt(max(along / size if size > 0.0 else covariance[0, 0], 0.0))
    state.depth_variance, state.height_stddev = P[DEPTH, DEPTH], np.sqrt(P[HEIGHT, HEIGHT])
    state.sound = state.sound and np.isfinite(covariance.sum() + found.sum())
    state.quiet, state.loaded = state.depth < TOUCH_DEPTH, state.depth > LOADED_DEPTH


@njit(**_OPTIONS)
def find_held_ratio(force, ratio, pull):
    """Return the traction ratio at which a force (3,) [N] that has a ratio now is a pull [N] along the finger.

    The other number is the size of its derivative by the pull [1/N].
    """
    ahead, along = force[0] - ratio * force[2], force[2] + ratio * force[0]
    if ahead == 0.0:
        return 0.0, 0.0
    slope = (1.0 + ratio**2) / ahead
    return min(max(along / ahead - slope * pull, -LARGEST_RATIO), LARGEST_RATIO), abs(slope)


@njit(**_OPTIONS)
def judge_points(state, points, seen, left, weight, offset):
    """Fill in weights and residual of the key points.

    Args:
        state: see `CONTACT_STATE`.
        points: all key points of the image (K,), see `KEYPOINT`; get their weights.
        seen: those that were used (m,).
        left: residuals (m, 2) [m].
        weight: of the key points (m,).
        offset: of the contact from its expected height [m].
    """
    state, squares = state[()], 0.0
    for k in range(len(points)):
        points[k].weight = 0.0
    for i in range(len(seen)):
        points[seen[i]].weight = weight[i] if weight[i] > NO_WEIGHT else 0.0
        squares += weight[i] * (left[i, 0] ** 2 + left[i, 1] ** 2)
    state.residual = np.sqrt(squares / (2.0 * weight.sum()))
    state.used = (weight > NO_WEIGHT).sum()
    state.offset = offset
