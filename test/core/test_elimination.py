"""Small systems of linear equations in compiled code."""

import numpy as np
import pytest

from finforce.elimination import eliminate


@pytest.mark.parametrize("size", [1, 2, 5, 24])
def test_solves_as_lapack_does(size):
    random = np.random.default_rng(size)
    A, B = random.normal(size=(size, size)), random.normal(size=(size, 3))
    expected, X = np.linalg.solve(A, B), B.copy()
    eliminate(A.copy(), X)
    np.testing.assert_allclose(X, expected, rtol=1e-9)


def test_takes_another_row_where_the_diagonal_is_zero():
    X = np.array([[2.0], [3.0]])
    eliminate(np.array([[0.0, 1.0], [1.0, 0.0]]), X)
    np.testing.assert_array_equal(X, [[3.0], [2.0]])


def test_a_singular_system_is_not_answered_with_numbers():
    X = np.array([[1.0], [2.0]])
    eliminate(np.array([[1.0, 2.0], [2.0, 4.0]]), X)
    assert not np.isfinite(X).all()
