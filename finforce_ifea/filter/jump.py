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

from finforce_ifea.filter.state import CAMERA, HEIGHT


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
