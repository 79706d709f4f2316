"""Weight of what two jaws hold, and the net force that it leaves, where its posture is known.

Key points show the net force s along the closing axis and across the fingers, but hardly along them. What hangs from
the jaws alone has one weight W along gravity g, whichever way the gripper turns,

    s = W g + e + b + white noise,

with the force e of a support, and an error b of the estimated forces. What is turned or lifted by more than a little
has left its support behind: e is forgotten with the motion, and may come back with time. So a turn tells W, and W the
force along the fingers; a lift tells it if gravity points along the other axes. Neither does with a handle or against
an obstacle, where e stays: that is the other hypothesis, and the likelihoods of both decide.
"""

from __future__ import annotations

from dataclasses import replace
from math import erfc, log, sqrt

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.grasp_force import Grasp
from finforce_ifea.posture import PostureTrack, WristPosture

# 1 sigma of the weight, and of a support's force, as a share of the grasp force [-].
_WEIGHT = 0.3
# Time after which there may be a support again, and another weight [s].
_SUPPORT_TIME, _WEIGHT_TIME = 10.0, 30.0
# Time over which an error of the estimated forces stays the same [s], and the share of their variance that is white.
_ERROR_TIME = 10.0
_WHITE = 0.5
# 1 sigma of the relative error of forces that change with the weight [-].
_SCALE = 0.1
# Grasp force below which nothing is held, and the least standard deviation of a force [N].
_LEAST_FORCE, _LEAST_STDDEV = 0.3, 1e-3
# Log prior odds that what is turned has left its support behind, time over which what was seen counts [s], and the
# probability below which that is assumed anew.
_FREE, _COUNTED, _DISCARDED = log(0.9 / 0.1), 2.0, 1e-3
# Of the net force: along the closing axis and across the fingers.
_SEEN = slice(0, 2)


class Payload:
    """Estimates the weight that the jaws carry, by a Gaussian-sum filter of W, e and b.

    Attributes:
        weight: of what is held [N].
        stddev: its standard deviation [N]; infinite while nothing is held.
    """

    def __init__(self) -> None:
        self._postures = PostureTrack()
        self.reset()

    def reset(self) -> None:
        """Forget what was held."""
        self._stamp = -np.inf
        self._postures.reset()
        # of the hypotheses that a turn leaves the support behind, and that it does not: W, e (3,), b (2,)
        self._x, self._P, self._log_odds = np.zeros((2, 6)), np.zeros((2, 6, 6)), _FREE
        self._expected, self._variance = 0.0, np.zeros(2)
        self.weight, self.stddev = 0.0, np.inf

    def update(self, grasp: Grasp, stamp: float, posture: WristPosture | None) -> Grasp:
        """Return a grasp with the net force of what hangs from the jaws.

        Args:
            grasp: of both jaws, with the standard deviation of its net force.
            stamp: of the image [s]; one that is not later than the last is left as it is.
            posture: of `gripper_base`; None if unknown.
        """
        held = float(grasp.grasp[0])
        if held < _LEAST_FORCE:
            self.reset()
            return grasp
        if posture is None or grasp.stddev is None or not np.isfinite(grasp.stddev).all() or stamp <= self._stamp:
            return grasp
        gravity = posture.gravity
        self._predict(stamp, posture, (_WEIGHT * held) ** 2, np.maximum(grasp.stddev[_SEEN], _LEAST_STDDEV) ** 2)
        self._correct(grasp.manipulation[_SEEN], gravity)
        self._stamp = stamp
        weights = self._weigh()
        told = np.hstack([gravity[:, None], np.eye(3)])
        means, P = self._x[:, :4] @ told.T, told @ self._P[:, :4, :4] @ told.T
        mean, weight = weights @ means, weights @ self._x[:, 0]
        variance = weights @ (np.diagonal(P, axis1=1, axis2=2) + (means - mean) ** 2) + (_SCALE * weight * gravity) ** 2
        spread = weights @ (self._P[:, 0, 0] + (self._x[:, 0] - weight) ** 2)
        self.weight, self.stddev = float(weight), sqrt(spread + (_SCALE * weight) ** 2)
        return replace(grasp, manipulation=mean, stddev=np.sqrt(np.maximum(variance, _LEAST_STDDEV**2)))

    def _predict(self, stamp: float, posture: WristPosture, expected: float, variance: NDArray) -> None:
        """Predict an image in which weight and support are expected with a variance, and forces with theirs (2,)."""
        dt, kept, parting = 0.0, 0.0, self._postures.update(posture).parting
        if np.isfinite(self._stamp):
            dt = stamp - self._stamp
            kept = np.exp(-dt / _ERROR_TIME)
            a = np.ones((2, 6))
            a[0, 1:4], a[:, 4:] = np.exp(-parting), kept * np.sqrt(variance / self._variance)
            self._x, self._P = a * self._x, a[:, :, None] * self._P * a[:, None, :]
            self._log_odds = _FREE + np.exp(-dt / _COUNTED) * (self._log_odds - _FREE)
        more = max(expected - self._expected, 0.0)
        self._expected, self._variance = self._expected + more, variance
        weight, support = (more + expected * dt / time for time in (_WEIGHT_TIME, _SUPPORT_TIME))
        error = (1.0 - kept**2) * (1.0 - _WHITE) * variance
        self._P += np.diag(np.concatenate([[weight], np.full(3, support), error]))

    def _correct(self, seen: NDArray, gravity: NDArray) -> None:
        """Take the net force (2,) in an image."""
        H = np.hstack([gravity[_SEEN, None], np.eye(2, 3), np.eye(2)])
        S = H @ self._P @ H.T + _WHITE * np.diag(self._variance)
        nu = seen - self._x @ H.T
        K = np.linalg.solve(S, H @ self._P).transpose(0, 2, 1)
        nis = np.einsum("hi,hi->h", nu, np.linalg.solve(S, nu[:, :, None])[:, :, 0])
        likely = -0.5 * (nis + np.log(np.linalg.det(S)))
        self._log_odds += likely[0] - likely[1]
        self._x = self._x + np.einsum("hij,hj->hi", K, nu)
        self._P = self._P - K @ S @ K.transpose(0, 2, 1)
        if self._weigh()[0] < _DISCARDED:
            self._x[0], self._P[0], self._log_odds = self._x[1], self._P[1], _FREE

    def _weigh(self) -> NDArray:
        """Return the probabilities of the hypotheses (2,): a weight that is free is not negative."""
        stddev = np.sqrt(np.maximum(self._P[:, 0, 0], 0.0))
        positive = [
            max(erfc(-x / max(sqrt(2.0) * s, 1e-12)), 1e-300) for x, s in zip(self._x[:, 0], stddev, strict=True)
        ]
        odds = self._log_odds + np.log(positive[0] / positive[1])
        free = 1.0 / (1.0 + np.exp(-np.clip(odds, -500.0, 500.0)))
        return np.array([free, 1.0 - free])
