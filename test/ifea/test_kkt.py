"""Claims about quadratic programs: none is returned that is not optimal, beside two other solvers."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from finforce_ifea import paper_inverse as program_module
from finforce_ifea.errors import UnobservableError
from finforce_ifea.paper_inverse import UNBOUNDED, solve_by_active_set, solve_program

KINDS = ("plain", "badly scaled", "nearly singular", "two forces nearly at one place", "tiny or huge", "on its bounds")
MOST, COUNT = 42, 1200
# Objectives agree to this share of their size; forming H = A^T A adds its rounding times its condition.
AGREED, EPSILON = 1e-9, 1e-15


@dataclass(frozen=True, kw_only=True, eq=False)
class Program:
    """min |A x + b|^2 / 2 over x >= lower: A (k, m), b (k,), lower (m,)."""

    A: NDArray
    b: NDArray
    lower: NDArray

    def measure(self, x: NDArray) -> float:
        """Return the objective less its constant part, |A x|^2 / 2 + b A x."""
        moved = self.A @ x
        return float(0.5 * moved @ moved + self.b @ moved)


def draw_program(random: np.random.Generator, kind: str) -> Program:
    """Draw a program with 1 to 42 unknowns of which none, some or all are bounded."""
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
    """Return what SciPy's bounded-variable least squares finds (m,)."""
    scale = np.linalg.norm(program.A, axis=0)
    bounds = (np.where(program.lower <= -UNBOUNDED, -np.inf, 0.0), np.inf)
    return lsq_linear(program.A / scale, -program.b, bounds, tol=1e-14, method="bvls").x / scale


def measure_error(program, x):
    """By how much an answer's objective is above the second solver's, over what rounding of its condition allows."""
    condition = np.linalg.cond(program.A / np.linalg.norm(program.A, axis=0)) ** 2
    worse = max(0.0, program.measure(x) - program.measure(solve_second(program)))
    worse /= max(0.5 * float(program.b @ program.b), 1e-300)
    return worse / (AGREED + EPSILON * condition)


def enumerate_active_sets(H, g, bounded):
    """The least objective over every choice of bounds that hold, each solved directly (m small)."""
    best, least = None, np.inf
    for choice in product(*[(False, True) if b else (False,) for b in bounded]):
        free = ~np.array(choice)
        x = np.zeros(len(g))
        if free.any():
            x[free] = np.linalg.solve(H[np.ix_(free, free)], -g[free])
        value = 0.5 * x @ H @ x + g @ x
        if (x[bounded] >= -1e-12).all() and value < least:
            best, least = x, value
    return best


def test_thousands_of_hard_programs_meet_their_conditions_and_agree_with_a_second_solver():
    """Badly scaled, nearly singular, bounded and free, 1 to 42 forces: the residual of each answer below 1e-8."""
    refused = 0
    for seed in range(COUNT):
        program = draw_program(np.random.default_rng([1, seed]), KINDS[seed % len(KINDS)])
        try:
            found, kkt = solve_program(program.A.T @ program.A, program.A.T @ program.b, program.lower)
        except UnobservableError:
            refused += 1
            continue
        assert (found >= program.lower).all() and kkt <= 1e-8
        assert measure_error(program, found) <= 1.0
    assert refused < 0.05 * COUNT


@settings(max_examples=150)
@given(st.integers(0, 2**32 - 1), st.integers(1, 7))
def test_small_programs_agree_with_every_choice_of_bounds(seed, size):
    random = np.random.default_rng(seed)
    A = random.normal(size=(size + 3, size)) * 10.0 ** random.uniform(-2, 2, size)
    g, bounded = A.T @ random.normal(size=size + 3), random.random(size) < 0.7
    expected = enumerate_active_sets(A.T @ A, g, bounded)
    found, _ = solve_program(A.T @ A, g, np.where(bounded, 0.0, -UNBOUNDED))
    scale = np.linalg.norm(A, axis=0)
    # conditions reach some 1e6 here: 1e-8 of the pull is far above rounding
    np.testing.assert_allclose(scale * found, scale * expected, atol=1e-8 * np.abs(g / scale).max())


@pytest.mark.parametrize("kind", KINDS)
def test_a_second_solver_sees_an_answer_that_is_off(kind):
    """The opposite: an answer moved by a thousandth of the least curved direction is not taken for optimal."""
    program = draw_program(np.random.default_rng(3), kind)
    H, g = program.A.T @ program.A, program.A.T @ program.b
    good, _ = solve_program(H, g, program.lower)
    assert measure_error(program, good) <= 1.0
    largest = np.argmax(np.abs(good) * np.linalg.norm(program.A, axis=0))
    moved = good.copy()
    moved[largest] *= 1.03
    assert measure_error(program, moved) > 1.0


def test_an_answer_that_is_not_optimal_is_refused(monkeypatch):
    monkeypatch.setattr(program_module, "solve_by_active_set", lambda H, g, bound, x: x)
    with pytest.raises(UnobservableError, match="optimality is missed by 1"):
        solve_program(np.eye(2), np.array([-1.0, -1.0]), np.zeros(2))


def test_active_set_holds_and_lets_go():
    H, bound = np.array([[1.0, 0.9], [0.9, 1.0]]), np.zeros(2)
    # from the wrong bounds: the first is held although it should be free, the second free although it should be held
    found = solve_by_active_set(H, np.array([-1.0, -0.5]), bound, np.array([0.0, 1.0]))
    np.testing.assert_allclose(found, [1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("gradient", [np.zeros(3), np.full(3, 1e-300)])
def test_a_program_without_pull_has_no_force(gradient):
    found, kkt = solve_program(np.eye(3), gradient, np.array([0.0, 0.0, -UNBOUNDED]))
    assert np.abs(found).max() <= 1e-300
    assert kkt <= 1e-12


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_gradient_that_is_not_finite_is_refused(bad):
    with pytest.raises(UnobservableError, match="not finite"):
        solve_program(np.eye(2), np.array([bad, 1.0]), np.zeros(2))


def test_no_answer_is_below_its_bound():
    """Not by rounding either: a contact cannot pull at all."""
    for seed in range(60):
        program = draw_program(np.random.default_rng(seed), "nearly singular")
        try:
            found, _ = solve_program(program.A.T @ program.A, program.A.T @ program.b, program.lower)
        except UnobservableError:
            continue
        assert (found >= program.lower).all()
