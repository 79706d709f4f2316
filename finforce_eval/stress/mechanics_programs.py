"""Stress of the quadratic program: badly scaled, nearly singular and bounded ones, beside a second solver."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from finforce_eval.stress.stress import Family, Plan, Trial, attempt
from finforce_ifea.quadratic_program import UNBOUNDED, ProgramSolution, solve_program

KINDS = ("plain", "badly scaled", "nearly singular", "two forces nearly at one place", "tiny or huge", "on its bounds")
MOST = 42
# Objectives agree to this share of their size; forming H = A^T A adds its rounding times its condition.
AGREED, ROUNDING = 1e-9, 1e-15


@dataclass(frozen=True, kw_only=True, eq=False)
class Program:
    """min |A x + b|^2 / 2 over x >= lower: A (k, m), b (k,), lower (m,)."""

    A: NDArray
    b: NDArray
    lower: NDArray

    def measure(self, x: NDArray) -> float:
        """Returns the objective less its constant part, |A x|^2 / 2 + b A x."""
        moved = self.A @ x
        return float(0.5 * moved @ moved + self.b @ moved)


def draw_program(random: np.random.Generator, kind: str) -> Program:
    """Draws a program with 1 to 42 unknowns of which none, some or all are bounded."""
    m = int(random.integers(1, MOST + 1))
    rows = int(random.integers(m, 3 * m + 3))
    A, b = random.normal(size=(rows, m)), random.normal(size=rows)
    if kind == "badly scaled":
        A = A * 10.0 ** random.uniform(-6, 6, m)
    elif kind == "nearly singular":
        U, _, V = np.linalg.svd(A, full_matrices=False)
        A = U @ np.diag(np.logspace(0, -random.uniform(0, 6), m)) @ V
    elif kind == "two forces nearly at one place":
        A[:, -1] = A[:, 0] + 10.0 ** random.uniform(-6, -1) * A[:, -1]
    elif kind == "tiny or huge":
        A, b = A * 10.0 ** random.uniform(-9, 9), b * 10.0 ** random.uniform(-8, 8)
    elif kind == "on its bounds":
        b = -A @ np.where(random.random(m) < 0.5, 0.0, np.abs(random.normal(size=m)))
    lower = np.where(random.random(m) < random.choice([0.0, 0.3, 1.0]), -UNBOUNDED, 0.0)
    return Program(A=A, b=b, lower=lower)


def solve_second(program: Program) -> NDArray:
    """Returns what SciPy's bounded-variable least squares finds (m,)."""
    scale = np.linalg.norm(program.A, axis=0)
    bounds = (np.where(program.lower <= -UNBOUNDED, -np.inf, 0.0), np.inf)
    return lsq_linear(program.A / scale, -program.b, bounds, tol=1e-14, method="bvls").x / scale


def judge_program(solution: ProgramSolution, program: Program) -> Trial:
    """Returns a trial whose error is that of the objective, relative to its size, beside the second solver's."""
    x, other = solution.multipliers, solve_second(program)
    scale = np.linalg.norm(program.A, axis=0)
    condition = float(np.linalg.cond(program.A / scale)) ** 2
    ours, theirs = program.measure(x), program.measure(other)
    worse = max(0.0, ours - theirs) / max(0.5 * float(program.b @ program.b), 1e-300)
    feasible = bool((x >= program.lower).all())
    return Trial(
        converged=True,
        sure=True,
        kkt=solution.kkt,
        force_error=worse if feasible and solution.kkt <= 1e-8 else np.inf,
        stddev=(AGREED + ROUNDING * condition) / 3.0,
        condition=condition,
        nan=not np.isfinite(x).all(),
    )


def run_programs(plan: Plan) -> Iterator[Trial]:
    """Yields programs of every kind; the KKT residual of each answer is below 1e-8 and its objective is the least."""
    for seed in range(plan.share(3000)):
        kind = KINDS[seed % len(KINDS)]
        program = draw_program(plan.random("programs", seed), kind)
        hessian, gradient = program.A.T @ program.A, program.A.T @ program.b
        trial = attempt(
            seed,
            lambda H=hessian, g=gradient, p=program: solve_program(H, g, p.lower),
            lambda got, p=program: judge_program(got, p),
            level=kind,
        )
        yield replace(trial, level=kind)


FAMILIES = (
    Family(name="programs", what="quadratic programs of 1 to 42 forces", run=run_programs, least_sure=0.9, timed=False),
)
