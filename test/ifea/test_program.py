"""Claims about the quadratic program behind the inverse problem."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from finforce_ifea.errors import UnobservableError
from finforce_ifea.paper_inverse import compute_kkt_residual, solve_program

UNBOUNDED = -1e30


def random_program(seed, size, rows):
    random = np.random.default_rng(seed)
    A = random.normal(size=(rows, size)) * 10.0 ** random.uniform(-3, 3, size)
    return A, random.normal(size=rows) * 10.0 ** random.uniform(-3, 3)


@settings(max_examples=200)
@given(st.integers(0, 2**32 - 1), st.integers(1, 14), st.booleans())
def test_program_meets_its_optimality_conditions_and_agrees_with_a_second_solver(seed, size, some_free):
    """min |A x - b|^2 over x >= 0, against SciPy's bounded-variable least squares, in wildly different units."""
    A, b = random_program(seed, size, size + 15)
    lower = np.zeros(size)
    if some_free:
        lower[::2] = UNBOUNDED
    found, kkt = solve_program(A.T @ A, -A.T @ b, lower)
    scale = np.linalg.norm(A, axis=0)
    other = lsq_linear(A / scale, b, (np.where(lower == 0.0, 0.0, -np.inf), np.inf), method="bvls", tol=1e-14).x
    assert kkt < 1e-8
    assert (scale * np.where(lower == 0.0, found, 0.0) > -1e-12 * np.linalg.norm(b)).all()
    np.testing.assert_allclose(scale * found, other, atol=1e-7 * max(np.abs(other).max(), np.linalg.norm(b)))


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_solution_does_not_depend_on_the_units(seed, size):
    A, b = random_program(seed, size, size + 15)
    first, _ = solve_program(A.T @ A, -A.T @ b, np.zeros(size))
    second, _ = solve_program(1e-12 * A.T @ A, -1e-12 * 1e3 * A.T @ b, np.zeros(size))
    scale = np.linalg.norm(A, axis=0)
    np.testing.assert_allclose(scale * second, 1e3 * scale * first, atol=1e-6 * 1e3 * np.linalg.norm(b))


def test_inactive_program_is_a_linear_system():
    H = np.array([[4.0, 1.0], [1.0, 3.0]])
    found, _ = solve_program(H, -H @ [1.0, 2.0], np.zeros(2))
    np.testing.assert_allclose(found, [1.0, 2.0], rtol=1e-9)


def test_kkt_residual_sees_every_violation():
    H, g, lower = np.eye(2), np.array([-1.0, 1.0]), np.array([0.0, 0.0])
    optimum = np.array([1.0, 0.0])
    assert compute_kkt_residual(H, g, lower, optimum) < 1e-15
    for wrong in ([1.1, 0.0], [1.0, 0.1], [1.0, -0.1], [0.0, 0.0]):
        assert compute_kkt_residual(H, g, lower, np.array(wrong)) >= 0.09
    free = np.full(2, UNBOUNDED)
    assert compute_kkt_residual(H, g, free, np.array([1.0, -1.0])) < 1e-15
    assert compute_kkt_residual(H, g, free, optimum) == pytest.approx(1.0)


@pytest.mark.parametrize("hessian", [np.zeros((2, 2)), np.diag([1.0, 0.0]), np.ones((2, 2)), np.diag([1.0, np.nan])])
def test_singular_program_is_not_solved(hessian):
    with pytest.raises(UnobservableError):
        solve_program(hessian, np.array([-1.0, -1.0]), np.zeros(2))
