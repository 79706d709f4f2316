"""Jumps of part of the state since the last image: a second process noise, chosen by its likelihood.

With Q the covariance of the jump in some entries of x, H_j their columns of the measurement matrix, the innovation nu
and its covariance S,

    I = H_j^T S^-1 H_j,  y = H_j^T S^-1 nu,
    log odds = log p / (1 - p) + y^T (Q^-1 + I)^-1 y / 2 - log det(1 + Q I) / 2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce_ifea.filter.filter import (
    divide_noise,
    expect_innovations,
    innovate,
    project_columns,
    solve_lower,
    update,
    widen,
)
from finforce_ifea.filter.measurement import find_depth_jump, measure_distances, weigh
from finforce_ifea.filter.state import CAMERA_TURN, CAMERA_X, CAMERA_Z, DEPTH, HEIGHT

_OPTIONS = {"cache": True, "error_model": "numpy"}


class Jump(NamedTuple):
    """A jump of some entries of the state.

    Attributes:
        entries: of x (j,).
        stddev: 1 sigma of the jump (j,).
        probability: of a jump in one image [-].
    """

    entries: NDArray
    stddev: NDArray
    probability: float


_SHIFT = np.array([CAMERA_X, CAMERA_Z, CAMERA_TURN])
# Bump of the camera: 1 mm and 10 mrad (1 sigma).
BUMPED = Jump(_SHIFT, np.array([1e-3, 1e-3, 10e-3]), 1e-5)
# Contact elsewhere than stated: 30 mm (1 sigma).
MISPLACED = Jump(np.array([HEIGHT]), np.array([30e-3]), 1e-4)
# Smaller bump, which only several images show: 0.4 mm and 4 mrad (1 sigma).
NUDGED = Jump(_SHIFT, np.array([0.4e-3, 0.4e-3, 4e-3]), 1e-4)
# Contact elsewhere than stated, which only several images show: 15 mm (1 sigma).
OFFSET = Jump(np.array([HEIGHT]), np.array([15e-3]), 1e-4)
# Jumps that one image can show.
JUMPS = (BUMPED, MISPLACED)
# Log likelihood ratio of a jump below which the test starts anew.
_UNLIKELY = -3.0
# Results other than the index of a jump: none, or undecided, too far from the linearisation.
NO_JUMP, UNDECIDED = -1, -2
# Largest step of the depth [m]: the range of a linearisation.
LARGEST_MOVE = 0.7e-3
# Correlation between a detector's errors at two key points of one shape [-]: that of the shipped network in random
# scenes.
ALIKE = 0.2
# Error of the linearisation about the last state, relative to the object's motion since [-].
_NONLINEAR = 0.2


@njit(**_OPTIONS)
def select_entries(entries, information, score):
    """Return those entries (j,) of information (SHARED, SHARED) and score (SHARED,) as (j, j) and (j,)."""
    k = len(entries)
    own, part = np.empty((k, k)), np.empty(k)
    for i in range(k):
        part[i] = score[entries[i]]
        for j in range(k):
            own[i, j] = information[entries[i], entries[j]]
    return own, part


@njit(**_OPTIONS)
def weigh_jump(jump, information, score):
    """Return the log odds of a jump for I (j, j) and y (j,) of its entries."""
    k = len(score)
    known, y = np.eye(k), jump.stddev * score
    for i in range(k):
        for j in range(k):
            known[i, j] += jump.stddev[i] * information[i, j] * jump.stddev[j]
    L = np.linalg.cholesky(known)
    white = solve_lower(L, y.reshape(-1, 1))
    gain, cost = 0.5 * (white**2).sum(), np.log(np.diag(L)).sum()
    return np.log(jump.probability / (1.0 - jump.probability)) + gain - cost


@njit(**_OPTIONS)
def correct(measured, weight, ratios, x, log_weights, P, possible, depth):
    """Return the posterior of one image, and the index of a jump, `NO_JUMP` or `UNDECIDED`.

    A bend that the linearisation does not reach looks like a jump: none is looked for until it is near.

    Args:
        measured: see `update`.
        weight: of the key points (m,); none at first (0,), when they are found and jumps are looked for.
        ratios: see `update`.
        x: see `update`.
        log_weights: see `update`.
        P: predicted covariance (n, n); widened where part of the state has jumped.
        possible: mask of those of `JUMPS` that are possible now (J,).
        depth: of the linearisation [m].
    """
    HP, S = innovate(measured, P)
    found = NO_JUMP
    if len(weight) == 0:
        before = np.exp(log_weights)
        nu = np.dot(before, expect_innovations(measured, ratios, x))
        asked = find_depth_jump(measured.H, measured.R, nu)
        weight = _weigh_innovations(measured, nu, S, P[DEPTH, DEPTH], asked)
        if abs((before * x[:, DEPTH]).sum() + asked[0] - depth) > LARGEST_MOVE:
            return update(measured, weight, ratios, x, log_weights, HP, S), UNDECIDED
        found = detect_jump(measured, weight, nu, S, possible)
        if found != NO_JUMP:
            for index, jump in enumerate(JUMPS):
                if index == found:
                    for i in range(len(jump.entries)):
                        P[jump.entries[i], jump.entries[i]] += jump.stddev[i] ** 2
            HP, S = innovate(measured, P)
    return update(measured, weight, ratios, x, log_weights, HP, S), found


@njit(**_OPTIONS)
def detect_jump(measured, weight, nu, S, possible):
    """Return the index of a jump, or `NO_JUMP`.

    Args:
        measured: see `update`.
        weight: of the key points (m,).
        nu: mean innovation (2 m,) [m].
        S: its covariance for key points without weights (2 m, 2 m).
        possible: see `correct`.
    """
    L = np.linalg.cholesky(widen(S, divide_noise(measured.R, weight), measured.R))
    white_H, white = solve_lower(L, measured.H), solve_lower(L, nu.reshape(-1, 1))
    rows_H = np.ascontiguousarray(white_H.T)
    information, score = np.dot(rows_H, white_H), np.dot(rows_H, white)[:, 0].copy()
    found, most = NO_JUMP, 0.0
    for index, jump in enumerate(JUMPS):
        if possible[index]:
            own, part = select_entries(jump.entries, information, score)
            odds = weigh_jump(jump, own, part)
            if odds > most:
                found, most = index, odds
    return found


@njit(**_OPTIONS)
def _weigh_innovations(measured, nu, S, depth_variance, asked):
    """Return weights of the key points (m,) by their innovations (2 m,) without the object's motion.

    The object's motion is no jump. S has an unknown depth; here it is the median of the key points, `asked`, see
    `find_depth_jump`.
    """
    H, R, (deeper, variance) = measured.H, measured.R, asked
    moved, spread = nu - H[:, DEPTH] * deeper, variance + (_NONLINEAR * deeper) ** 2 - depth_variance
    blocks = np.empty_like(R)
    for i in range(len(R)):
        h = H[2 * i : 2 * i + 2, DEPTH]
        for a in range(2):
            for b in range(2):
                blocks[i, a, b] = S[2 * i + a, 2 * i + b] + spread * h[a] * h[b]
    return weigh(measure_distances(moved.reshape(-1, 2), blocks, measured.square))


class JumpWatch(NamedTuple):
    """Detects small jumps by a generalised likelihood ratio over the innovations of several images.

    With F the response of the state's mean so far to a unit jump at the first image, the innovations have the mean
    G b, G = H (E - F), where E selects the entries that jump (Willsky and Jones, 1976).

    Attributes:
        jump: that is watched for.
        F: see above (n, j); changes with the state, see `advance`.
        information: I of the module (j, j).
        score: y of the module (j,).
    """

    jump: Jump
    F: NDArray
    information: NDArray
    score: NDArray


def watch_for(jump: Jump, size: int) -> JumpWatch:
    """Return a detector of a jump for a state of n = size entries."""
    count = len(jump.entries)
    return JumpWatch(jump, np.zeros((size, count)), np.zeros((count, count)), np.zeros(count))


@njit(**_OPTIONS)
def forget(watched):
    """Restart the test with the next image."""
    watched.F[:] = 0.0
    watched.information[:] = 0.0
    watched.score[:] = 0.0


@njit(**_OPTIONS)
def watch(watched, measured, posterior, detector_share, common):
    """Update a `JumpWatch` with an image; return True if the state has jumped.

    Args:
        watched: see above.
        measured: see `correct`.
        posterior: see `correct`.
        detector_share: share of the offsets' variance by which a detector errs in the view of one shape. Its errors
            are alike and tell less than independent ones of the same size.
        common: variances (j,) of what all key points err by alike, which looks like a jump.
    """
    jump, F, information, score = watched
    independence = 1.0 / (1.0 + ALIKE * detector_share * (len(measured.R) - 1))
    H, A, white, count = measured.H, posterior.A, posterior.white, F.shape[1]
    G = -project_columns(H, measured.rows, measured.u, np.ascontiguousarray(F.T)).T.copy()
    for j in range(count):
        G[:, j] += H[:, jump.entries[j]]
    G = solve_lower(posterior.L, G)
    for i in range(len(G)):
        for j in range(count):
            score[j] += independence * G[i, j] * white[i]
            for k in range(count):
                information[j, k] += independence * G[i, j] * G[i, k]
            for k in range(len(F)):
                F[k, j] += A[i, k] * G[i, j]
    kept = np.linalg.inv(np.eye(count) + information * common)
    odds = weigh_jump(jump, np.dot(kept, information), np.dot(kept, score))
    if odds < _UNLIKELY + np.log(jump.probability):
        forget(watched)
    return odds > 0.0


@njit(**_OPTIONS)
def jump_back(watched, x, P):
    """Correct means (N, n) and covariance (n, n) for the jump of a `JumpWatch`, in place."""
    jump, F, information, score = watched
    V = np.linalg.inv(np.diag(jump.stddev**-2.0) + information)
    D = -F
    for j in range(len(jump.entries)):
        D[jump.entries[j], j] += 1.0
    D[DEPTH] = 0.0
    gain = np.dot(D, V)
    x += np.dot(gain, score)
    P += np.dot(gain, np.ascontiguousarray(D.T))
