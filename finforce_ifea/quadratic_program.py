"""Quadratic programs with lower bounds, solved to rounding or refused."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from finforce_ifea.errors import UnobservableError

UNBOUNDED = 1e30
# Largest KKT residual of a returned solution, and the pull of a bound that is let go.
KKT_LIMIT, _LEAST_PULL = 1e-8, 1e-12
_SINGULAR = 1e-12
_REFINEMENTS = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class ProgramSolution:
    """The solution of a quadratic program and its scaled KKT residual."""

    multipliers: NDArray
    kkt: float


def solve_program(hessian: NDArray, gradient: NDArray, lower: NDArray) -> ProgramSolution:
    """Minimise x^T H x / 2 + g^T x over x >= lower; the KKT residual of what is returned is below `KKT_LIMIT`.

    Args:
        hessian: H (m, m), symmetric.
        gradient: g (m,).
        lower: (m,), zero or below; -1e30 where there is no bound.

    Raises:
        UnobservableError: H is singular: the key points do not tell the forces apart. Or a number is not finite, or so
            nearly singular a program that rounding leaves more than `KKT_LIMIT` of its conditions.
    """
    _check_program(hessian, gradient)
    scale = np.sqrt(np.diag(hessian))
    H, g = hessian / np.outer(scale, scale), gradient / scale
    if np.linalg.eigvalsh(H)[0] < _SINGULAR:
        raise UnobservableError(
            "the active key points do not tell the forces apart; give an energy weight or fewer contacts"
        )
    size = np.abs(g).max()
    if size == 0.0:
        return ProgramSolution(multipliers=np.zeros(len(g)), kkt=0.0)
    H, g = np.ascontiguousarray(0.5 * (H + H.T)), np.ascontiguousarray(g / size)
    bounded = lower > -UNBOUNDED
    bound = np.full(len(g), -UNBOUNDED)
    bound[bounded] = np.maximum(lower[bounded] * scale[bounded] / size, -UNBOUNDED)
    x = solve_by_active_set(H, g, bound, np.zeros(len(g)))
    kkt = compute_kkt_residual(H, g, bound, x)
    if not kkt <= KKT_LIMIT:
        raise UnobservableError(
            f"the quadratic program is too badly conditioned: its optimality is missed by {kkt:.1g}, expected at most "
            f"{KKT_LIMIT:g}; give an energy weight or fewer contacts"
        )
    return ProgramSolution(multipliers=np.maximum(x * (size / scale), lower), kkt=kkt)


def _check_program(hessian: NDArray, gradient: NDArray) -> None:
    """Refuse a program that is not finite, or with a force that moves nothing."""
    if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
        raise UnobservableError("the quadratic program holds numbers that are not finite")
    if not (np.diag(hessian) > 0.0).all():
        raise UnobservableError(
            "a force moves no active key point; more of them must be seen, or an energy weight given"
        )


def solve_by_active_set(H: NDArray, g: NDArray, bound: NDArray, x: NDArray) -> NDArray:
    """Minimise x^T H x / 2 + g^T x over x >= bound from a feasible x by adding and dropping one bound at a time.

    Bounds that x sits on are held at first. The free variables solve H_ff x_f = -g_f - H_fh x_h; where that leaves the
    bounds, the step is cut at the first one, which is then held; otherwise the bound that pulls most is let go.

    Args:
        H: (m, m), positive definite with a unit diagonal.
        g: (m,), of size 1.
        bound: (m,).
        x: (m,), the start.

    Source: Lawson, Hanson, Solving Least Squares Problems (1974), chapter 23.
    """
    free, x = x > bound, x.copy()
    for _ in range(10 * len(g) + 20):
        aim = _minimise_free(H, g, x, free)
        beyond = np.flatnonzero(aim < bound)
        if len(beyond):
            # a variable that was just let go, at its bound, moves off it but for rounding
            shares = (x[beyond] - bound[beyond]) / (x[beyond] - aim[beyond])
            share = float(np.clip(shares.min(), 0.0, 1.0))
            x = x + share * (aim - x)
            stopped = beyond[shares <= share]
            x[stopped], free[stopped] = bound[stopped], False
            continue
        x = aim
        pull = np.where(free, 0.0, H @ x + g)
        worst = int(pull.argmin())
        if pull[worst] >= -_LEAST_PULL:
            break
        free[worst] = True
    return x


def _minimise_free(H: NDArray, g: NDArray, x: NDArray, free: NDArray) -> NDArray:
    """Return x (m,) with its free variables at their minimum, refined against rounding."""
    x = x.copy()
    rows = np.flatnonzero(free)
    block = np.asfortranarray(H[np.ix_(rows, rows)])
    for _ in range(1 + _REFINEMENTS if len(rows) else 0):
        left = -(H[rows] @ x + g[rows])
        x[rows] += dposv(block, left)[1]
    return x


def compute_kkt_residual(H: NDArray, g: NDArray, lower: NDArray, x: NDArray) -> float:
    """Return the largest violation, over |g|, of the optimality conditions of min x^T H x / 2 + g^T x, x >= lower."""
    slope = H @ x + g
    bounded = lower > -UNBOUNDED
    violation = np.where(bounded, np.minimum(x - lower, slope), slope)
    return float(np.abs(violation).max() / max(np.abs(g).max(), 1e-300))
