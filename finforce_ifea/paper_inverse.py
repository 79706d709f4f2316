"""The inverse problem (Eq. 1): which forces at given places bring the key points to their targets.

Each Newton iteration linearises the geometrically nonlinear equilibrium f_int(q) = G lambda about the current state and
solves the quadratic program of Zuo, Yang and Chua (RA-L 2026), Eq. 1, for the forces lambda >= 0:

    J = 1/2 lambda^T (W_ea^T W_ea + E) lambda + lambda^T W_ea^T delta_free

The energy term E is written in two ways that must not be mixed up: "paper" E = eps W_aa, as printed; "sofa"
E = eps (|Q| / |W_aa|) W_aa with Q = W_ea^T W_ea and the maximum norm over rows, as SOFA's solver scales it.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from finforce_ifea.contact_mechanics.pressed_jaw import limit_step, measure_step
from finforce_ifea.errors import ContactError, NotEnoughDataError, UnobservableError
from finforce_ifea.fem.model import JawModel

EnergyForm = Literal["paper", "sofa"]
UNBOUNDED = 1e30
KKT_LIMIT = 1e-8  # [-], largest KKT residual of a returned solution
_LEAST_PULL = 1e-12  # [-], least pull of a bound that is let go
_SINGULAR = 1e-12
_REFINEMENTS = 2


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
        covariance: of the multipliers (m, m) if each active key point has variance 1 / precision along every axis.
        bias: of the multipliers (m,), what the energy term takes from them: Q^-1 E lambda.
        directions: total force per unit multiplier (3, m).
        residual: root mean square distance of active key points from their targets [m].
        kkt: largest violation of the program's optimality conditions, scaled by its largest term.
        iterations: Newton iterations.
        converged: True if the last iteration changed nothing that matters.
        smallest_det: smallest det F of all elements [-]; at or below zero the mesh has turned inside out.
    """

    q: NDArray
    forces: NDArray
    covariance: NDArray
    bias: NDArray
    directions: NDArray
    residual: float
    kkt: float
    iterations: int
    converged: bool
    smallest_det: float


def solve_inverse(
    model: JawModel, problem: Problem, q: NDArray, *, iterations: int = 20, tolerance: float = 2e-7
) -> InverseResult:
    """Solve an inverse problem, starting from the state q (size,).

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
        multipliers, kkt = solve_program(step.hessian, step.gradient, step.lower)
        change = limit_step(model, step.free + step.modes @ multipliers)
        q = q + change
        settled = measure_step(model, change) < tolerance
    forces = np.einsum("ncj,j->nc", step.directions, multipliers)
    miss = (model.positions(problem.effectors, q) - problem.targets)[active]
    covariance = np.linalg.pinv(step.compliance.T @ step.compliance)
    return InverseResult(
        q=q,
        forces=forces,
        covariance=covariance,
        bias=covariance @ (step.energy @ multipliers),
        directions=step.directions.sum(0),
        residual=float(np.sqrt((miss**2).sum(1).mean())),
        kkt=kkt,
        iterations=iteration,
        converged=settled,
        smallest_det=step.smallest_det,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _LinearStep:
    """The program of one state.

    Attributes:
        free: motion towards equilibrium without forces (size,).
        modes: motions by multipliers (size, m).
        hessian: (m, m), its energy term included.
        energy: that term (m, m).
        gradient: (m,).
        lower: bounds (m,).
        directions: forces per multiplier (n, 3, m).
        compliance: W_ea (3 K, m), weighted.
        smallest_det: of all elements.
    """

    free: NDArray
    modes: NDArray
    hessian: NDArray
    energy: NDArray
    gradient: NDArray
    lower: NDArray
    directions: NDArray
    compliance: NDArray
    smallest_det: float


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
    energy = problem.energy_weight * scale_energy(Q, 0.5 * (W_aa + W_aa.T), problem.energy_form)
    return _LinearStep(
        free=free,
        modes=modes,
        hessian=Q + energy,
        energy=energy,
        gradient=W_ea.T @ delta_free,
        lower=lower,
        directions=directions,
        compliance=W_ea,
        smallest_det=state.smallest_det,
    )


def scale_energy(Q: NDArray, W_aa: NDArray, form: EnergyForm) -> NDArray:
    """Return the matrix that eps multiplies: W_aa as printed, or scaled to the size of Q as SOFA does."""
    if form == "paper":
        return W_aa
    norm = lambda matrix: np.abs(matrix).sum(1).max()  # noqa: E731
    return W_aa * (norm(Q) / max(norm(W_aa), 1e-300))


def _force_directions(model: JawModel, problem: Problem, q: NDArray) -> tuple[NDArray, NDArray]:
    """Return the forces (n, 3, m) per unit multiplier and the multipliers' lower bounds (m,)."""
    normals = -surface_normals(model, problem.neighbours, q)
    count = len(normals)
    if problem.axes == "normal":
        basis, lower = normals[:, :, None], np.zeros(1)
    else:
        tangent = np.stack([-normals[:, 2], np.zeros(count), normals[:, 0]], axis=1)
        across = np.broadcast_to([0.0, 1.0, 0.0], (count, 3))
        basis, lower = np.stack([normals, tangent, across], axis=2), np.array([0.0, -UNBOUNDED, -UNBOUNDED])
    if problem.weights is not None:
        share = problem.weights / problem.weights.sum()
        return basis * share[:, None, None], lower
    directions = np.zeros((count, 3, count * basis.shape[2]))
    for n in range(count):
        directions[n, :, n * basis.shape[2] : (n + 1) * basis.shape[2]] = basis[n]
    return directions, np.tile(lower, count)


def surface_normals(model: JawModel, neighbours: Any, q: NDArray) -> NDArray:
    """Return the outward normals (n, 3) of the deformed inner surface, from points below and above each contact."""
    points = model.positions(neighbours, q)
    along = points[1::2] - points[::2]
    normal = np.stack([along[:, 2], np.zeros(len(along)), -along[:, 0]], axis=1)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def solve_program(hessian: NDArray, gradient: NDArray, lower: NDArray) -> tuple[NDArray, float]:
    """Minimise x^T H x / 2 + g^T x over x >= lower; return x (m,) and its KKT residual, which is below `KKT_LIMIT`.

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
            "the active key points do not distinguish the forces; give an energy weight or fewer contacts"
        )
    size = np.abs(g).max()
    if size == 0.0:
        return np.zeros(len(g)), 0.0
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
    return np.maximum(x * (size / scale), lower), kkt


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
