"""The inverse problem with a given contact: which forces at given places bring the key points to their targets.

Each Newton iteration linearises the geometrically nonlinear equilibrium f_int(q) = G lambda about the current state and
solves the quadratic program of Zuo, Yang and Chua (RA-L 2026), Eq. 1, for the forces lambda >= 0:

    J = 1/2 lambda^T (W_ea^T W_ea + E) lambda + lambda^T W_ea^T delta_free

The energy term E is written in two ways that must not be mixed up: "paper" E = eps W_aa, as printed; "sofa"
E = eps (|Q| / |W_aa|) W_aa with Q = W_ea^T W_ea and the maximum norm over rows, as SOFA's solver scales it.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

import daqp
import numpy as np
from numpy.typing import NDArray

from finforce_ifea.errors import ContactError, NotEnoughDataError, UnobservableError
from finforce_ifea.model import JawModel
from finforce_ifea.rolling import limit_step

EnergyForm = Literal["paper", "sofa"]
_UNBOUNDED = 1e30
_SINGULAR = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """One inverse problem.

    Attributes:
        effectors: probe of the key points.
        targets: (K, 3) [m]; NaN where a key point is switched off.
        contacts: probe of the contact points.
        weights: (n,), shares of one common force; None for a force of its own at each contact.
        neighbours: probe of points shortly below and above each contact along the finger, (2 n,), for the normals.
        axes: "normal" to the deformed surface, or "three" axes of the jaw frame.
        precision: (K,) weights of the key points; None for equal ones.
        energy_weight: the paper's eps.
        energy_form: "paper" or "sofa".
    """

    effectors: Any
    targets: NDArray
    contacts: Any
    neighbours: Any
    weights: NDArray | None = None
    axes: Literal["normal", "three"] = "normal"
    precision: NDArray | None = None
    energy_weight: float = 0.0
    energy_form: EnergyForm = "paper"


@dataclass(frozen=True, kw_only=True, eq=False)
class InverseResult:
    """The outcome of an inverse problem.

    Attributes:
        q: unknowns of the model, in equilibrium with the forces.
        forces: (n, 3) [N] on the jaw at each contact.
        compliance: W_ea (3 K, m) [m/N] of the active key points, weighted, at the last state.
        covariance: of the multipliers (m, m) if each active key point has variance 1 / precision along every axis.
        directions: total force per unit multiplier (3, m).
        residual: root mean square distance of active key points from their targets [m].
        kkt: largest violation of the program's optimality conditions, scaled by its largest term.
        condition: condition number of the program's matrix.
        iterations: Newton iterations.
        converged: whether the last one changed nothing that matters.
    """

    q: NDArray
    forces: NDArray
    compliance: NDArray
    covariance: NDArray
    directions: NDArray
    residual: float
    kkt: float
    condition: float
    iterations: int
    converged: bool
    multipliers: NDArray = field(repr=False)


def solve_inverse(
    model: JawModel, problem: Problem, q: NDArray, *, iterations: int = 20, tolerance: float = 1e-8
) -> InverseResult:
    """Solves an inverse problem, starting from the state q (size,).

    Raises:
        NotEnoughDataError: No key point is active.
        UnobservableError: The active ones do not tell the forces apart.
        ContactError: The problem has no contact.
    """
    active = np.isfinite(problem.targets).all(axis=1)
    if not active.any():
        raise NotEnoughDataError("no key point is active, expected at least one")
    if len(problem.targets) == 0 or problem.contacts is None:
        raise ContactError("the inverse problem has no contact")
    settled, iteration = False, 0
    while not settled and iteration < iterations:
        iteration += 1
        step = _linear_step(model, problem, q, active)
        solution = solve_program(step.hessian, step.gradient, step.lower)
        change = limit_step(model, step.free + step.modes @ solution.multipliers)
        q = q + change
        settled = bool(np.abs(change).max() < tolerance)
    multipliers = solution.multipliers
    forces = np.einsum("ncj,j->nc", step.directions, multipliers)
    miss = (model.positions(problem.effectors, q) - problem.targets)[active]
    return InverseResult(
        q=q,
        forces=forces,
        compliance=step.compliance,
        covariance=np.linalg.pinv(step.compliance.T @ step.compliance),
        directions=step.directions.sum(0),
        residual=float(np.sqrt((miss**2).sum(1).mean())),
        kkt=solution.kkt,
        condition=float(np.linalg.cond(step.hessian)),
        iterations=iteration,
        converged=settled,
        multipliers=multipliers,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _LinearStep:
    """The program of one state: free motion (size,), modes (size, m), matrix, gradient, bounds, force directions."""

    free: NDArray
    modes: NDArray
    hessian: NDArray
    gradient: NDArray
    lower: NDArray
    directions: NDArray
    compliance: NDArray


def _linear_step(model: JawModel, problem: Problem, q: NDArray, active: NDArray) -> _LinearStep:
    state = model.linearize(q)
    directions, lower = _force_directions(model, problem, q)
    columns = [model.load(problem.contacts, q, np.ascontiguousarray(directions[:, :, j])) for j in range(len(lower))]
    G = np.stack(columns, axis=1)
    steps = model.factorise(state.tangent).solve(np.column_stack([G, -state.force]))
    modes, free = steps[:, :-1], steps[:, -1]
    moved = model.project(problem.effectors, q, steps)[active]
    scale = np.ones(active.sum()) if problem.precision is None else np.sqrt(problem.precision[active])
    moved = moved * scale[:, None, None]
    miss = (model.positions(problem.effectors, q) - problem.targets)[active] * scale[:, None]
    W_ea = moved[:, :, :-1].reshape(-1, len(lower))
    delta_free = miss.ravel() + moved[:, :, -1].ravel()
    Q, W_aa = W_ea.T @ W_ea, G.T @ modes
    hessian = Q + problem.energy_weight * scale_energy(Q, 0.5 * (W_aa + W_aa.T), problem.energy_form)
    return _LinearStep(
        free=free,
        modes=modes,
        hessian=hessian,
        gradient=W_ea.T @ delta_free,
        lower=lower,
        directions=directions,
        compliance=W_ea,
    )


def scale_energy(Q: NDArray, W_aa: NDArray, form: EnergyForm) -> NDArray:
    """Returns the matrix that eps multiplies: W_aa as printed, or scaled to the size of Q as SOFA does."""
    if form == "paper":
        return W_aa
    norm = lambda matrix: np.abs(matrix).sum(1).max()  # noqa: E731
    return W_aa * (norm(Q) / max(norm(W_aa), 1e-300))


def _force_directions(model: JawModel, problem: Problem, q: NDArray) -> tuple[NDArray, NDArray]:
    """Returns the forces (n, 3, m) per unit multiplier and the multipliers' lower bounds (m,)."""
    normals = -surface_normals(model, problem.neighbours, q)
    count = len(normals)
    if problem.axes == "normal":
        basis, lower = normals[:, :, None], np.zeros(1)
    else:
        tangent = np.stack([-normals[:, 2], np.zeros(count), normals[:, 0]], axis=1)
        across = np.broadcast_to([0.0, 1.0, 0.0], (count, 3))
        basis, lower = np.stack([normals, tangent, across], axis=2), np.array([0.0, -_UNBOUNDED, -_UNBOUNDED])
    if problem.weights is not None:
        share = problem.weights / problem.weights.sum()
        return basis * share[:, None, None], lower
    directions = np.zeros((count, 3, count * basis.shape[2]))
    for n in range(count):
        directions[n, :, n * basis.shape[2] : (n + 1) * basis.shape[2]] = basis[n]
    return directions, np.tile(lower, count)


def surface_normals(model: JawModel, neighbours: Any, q: NDArray) -> NDArray:
    """Returns the outward normals (n, 3) of the deformed inner surface, from points below and above each contact."""
    points = model.positions(neighbours, q)
    along = points[1::2] - points[::2]
    normal = np.stack([along[:, 2], np.zeros(len(along)), -along[:, 0]], axis=1)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


@dataclass(frozen=True, kw_only=True, eq=False)
class ProgramSolution:
    """The solution of a quadratic program and its scaled KKT residual."""

    multipliers: NDArray
    kkt: float


def solve_program(hessian: NDArray, gradient: NDArray, lower: NDArray) -> ProgramSolution:
    """Minimises x^T H x / 2 + g^T x over x >= lower.

    Args:
        hessian: H (m, m), symmetric.
        gradient: g (m,).
        lower: (m,); -1e30 where there is no bound.

    Raises:
        UnobservableError: H is singular: the key points do not tell the forces apart.
    """
    scale = np.sqrt(np.diag(hessian))
    if not (np.isfinite(hessian).all() and (scale > 0).all()):
        raise UnobservableError(
            "a force moves no active key point; more of them must be seen, or an energy weight given"
        )
    H, g = hessian / np.outer(scale, scale), gradient / scale
    if np.linalg.eigvalsh(H)[0] < _SINGULAR:
        raise UnobservableError(
            "the active key points do not tell the forces apart; give an energy weight or fewer contacts"
        )
    bound = np.where(lower <= -_UNBOUNDED, -_UNBOUNDED, lower * scale)
    m = len(g)
    size = max(np.abs(g).max(), 1e-300)
    x, _, flag, _ = daqp.solve(
        np.ascontiguousarray(H),
        np.ascontiguousarray(g / size),
        np.zeros((0, m)),
        np.full(m, _UNBOUNDED),
        bound / size,
        np.zeros(m, np.int32),
    )
    if flag < 1:
        raise UnobservableError(f"the quadratic program has no solution (daqp exit flag {flag})")
    x = np.asarray(x) * size
    return ProgramSolution(multipliers=x / scale, kkt=compute_kkt_residual(H, g, bound, x))


def compute_kkt_residual(H: NDArray, g: NDArray, lower: NDArray, x: NDArray) -> float:
    """Returns the largest violation, over |g|, of the optimality conditions of min x^T H x / 2 + g^T x, x >= lower."""
    slope = H @ x + g
    bounded = lower > -_UNBOUNDED
    violation = np.where(bounded, np.minimum(x - lower, slope), slope)
    return float(np.abs(violation).max() / max(np.abs(g).max(), 1e-300))
