"""Whether part of the state has jumped since the last image: a second process noise, chosen by its likelihood.

With Q the covariance of the jump in some entries of x, H_j their columns of the measurement matrix, the innovation nu
and its covariance S,

    I = H_j^T S^-1 H_j,  y = H_j^T S^-1 nu,
    log odds = log p / (1 - p) + y^T (Q^-1 + I)^-1 y / 2 - log det(1 + Q I) / 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.filter.filter import project_columns, solve_lower
from finforce_ifea.filter.state import CAMERA, DEPTH, HEIGHT


@dataclass(frozen=True, kw_only=True, eq=False)
class Jump:
    """Entries of the state that may jump together.

    Attributes:
        entries: of x (j,).
        columns: of H in `measurement.linearize` (j,).
        stddev: 1 sigma of the jump (j,).
        probability: of a jump in one image [-].
    """

    entries: NDArray
    columns: NDArray
    stddev: NDArray
    probability: float

    def log_odds(self, information: NDArray, score: NDArray) -> float:
        """Return the log odds of the jump for H^T S^-1 H (8, 8) and H^T S^-1 nu (8,)."""
        known, y, Q = information[self.columns[:, None], self.columns], score[self.columns], self.stddev**2
        gain = 0.5 * float(y @ np.linalg.solve(np.diag(1.0 / Q) + known, y))
        cost = 0.5 * float(np.linalg.slogdet(np.eye(len(Q)) + Q[:, None] * known)[1])
        return float(np.log(self.probability / (1.0 - self.probability))) + gain - cost


# The camera was bumped, by a millimetre and half a degree.
BUMPED = Jump(entries=CAMERA, columns=np.array([4, 5, 6]), stddev=np.array([1e-3, 1e-3, 10e-3]), probability=1e-5)
# The object touches elsewhere than stated, anywhere within 30 mm.
MISPLACED = Jump(entries=np.array([HEIGHT]), columns=np.array([2]), stddev=np.array([30e-3]), probability=1e-4)
# The same as it shows over some images only, by less.
_NUDGED = Jump(entries=CAMERA, columns=np.arange(3), stddev=np.array([0.4e-3, 0.4e-3, 4e-3]), probability=1e-4)
# Log odds against a jump since the first image, its prior left out, after which the test begins anew.
_UNLIKELY = -3.0


class CameraWatch:
    """Tells small bumps of the camera from the innovations of several images: generalised likelihood ratio.

    With F the response of the state's mean so far to a unit jump at the first image, the innovations have the mean
    G b, G = H (E - F), where E selects the camera's entries (Willsky and Jones, 1976).
    """

    def __init__(self, size: int) -> None:
        """Watch the camera of a filter whose state has n = size entries."""
        self._size = size
        self.reset()

    def reset(self) -> None:
        """Begin with the next image."""
        self._F = np.zeros((self._size, len(CAMERA)))
        self._information, self._score = np.zeros((3, 3)), np.zeros(3)

    def predict(self, f: NDArray) -> None:
        """Take the transition of the state, a factor for each entry (n,)."""
        self._F *= f[:, None]

    def update(
        self, H: NDArray, rows: NDArray, u: NDArray, A: NDArray, L: NDArray, nu: NDArray
    ) -> tuple[NDArray, NDArray] | None:
        """Take an image; once the camera was bumped, return the change of the mean (n,) and of P (n, n).

        Args:
            H: see `multiply_rows`.
            rows: see `multiply_rows`.
            u: see `multiply_rows`.
            A: L^-1 H P (m, n).
            L: Cholesky factor of S (m, m).
            nu: innovation (m,) [m].
        """
        G = solve_lower(L, H[:, BUMPED.columns] - project_columns(H, rows, u, np.ascontiguousarray(self._F.T)).T)
        self._information += G.T @ G
        self._score += G.T @ solve_lower(L, nu.reshape(-1, 1))[:, 0]
        self._F += A.T @ G
        odds, prior = _NUDGED.log_odds(self._information, self._score), np.log(_NUDGED.probability)
        if odds <= 0.0:
            if odds - prior < _UNLIKELY:
                self.reset()
            return None
        V = np.linalg.inv(np.diag(_NUDGED.stddev**-2.0) + self._information)
        D = -self._F
        D[CAMERA, np.arange(3)] += 1.0
        D[DEPTH] = 0.0
        jump = D @ (V @ self._score), D @ V @ D.T
        self.reset()
        return jump
