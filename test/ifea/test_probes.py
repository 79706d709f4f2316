"""Claims about points of a solid and about the factorisations of its tangent."""

import numpy as np
import pytest
from mechanics_fakes import BENCH, EDGE, TPU, bench_mechanics, block, unknowns_from_displacements, wobble
from scipy import sparse

from finforce_ifea.fem.model import SparseFactor, SparsePlan, order_unknowns
from finforce_ifea.fem.solid import SolidModel


@pytest.fixture(scope="module")
def wide():
    return SolidModel(block((8, 8, 8), EDGE), TPU, symmetric=False)


def test_factors_of_both_kinds_agree(pressed):
    model, q = pressed
    tangent = model.linearize(q).tangent
    b = np.random.default_rng(0).normal(size=(model.size, 3))
    planned = model.factorise(tangent).solve(b)
    other = SparseFactor(model.sparse_tangent(tangent)).solve(b)
    np.testing.assert_allclose(planned, other, atol=1e-8 * np.abs(other).max())
    np.testing.assert_allclose(
        model.factorise(tangent).solve(b[:, 1]), planned[:, 1], atol=1e-12 * np.abs(planned).max()
    )


def test_factor_solves_with_the_tangent(pressed, wide):
    for model, q in (pressed, (wide, unknowns_from_displacements(wide, wobble(wide, 2e-5)))):
        tangent = model.linearize(q).tangent
        b = np.random.default_rng(1).normal(size=model.size)
        left = model.sparse_tangent(tangent) @ model.factorise(tangent).solve(b) - b
        assert np.abs(left).max() < 1e-7


def count_fill(matrix):
    """Entries of L below its diagonal when a matrix is factorised in the order of its unknowns."""
    upper = sparse.triu(matrix).tocsc()
    upper.sort_indices()
    return len(SparsePlan(upper.indptr, upper.indices).rows[1])


def test_unknowns_are_numbered_for_little_fill_once_and_for_all(wide):
    tangent = wide.sparse_tangent(wide.linearize(np.zeros(wide.size)).tangent)
    fill = len(wide._plan.rows[1])
    # as little as an order found for this very matrix; by rows and columns of the block it is more
    assert fill <= 1.02 * SparseFactor(tangent)._lu.L.nnz
    points = np.lexsort(wide.mesh.nodes.T)
    dof = wide.dof[points].ravel()
    rows = np.unique(dof[dof < wide.size], return_index=True)[1]
    by_rows = dof[dof < wide.size][np.sort(rows)]
    assert count_fill(tangent[by_rows][:, by_rows]) > 1.3 * fill
    place = order_unknowns(*tangent.nonzero(), wide.size)
    assert sorted(place) == list(range(wide.size))


@pytest.mark.parametrize(("last", "positive"), [(2.0, True), (-1.0, False), (1e-12, None)])
def test_sparse_elimination_tells_stable_states_and_leaves_those_without_pivots(last, positive):
    """Of [[last, 1], [1, 0]] elimination along the diagonal divides by `last`; of positive definite ones it may."""
    matrix = np.array([[last, 0.5], [0.5, 2.0 if positive else 0.0]])
    pointer, index = np.array([0, 1, 3]), np.array([0, 0, 1])
    factor = SparsePlan(pointer, index).factorise(matrix[[0, 0, 1], [0, 1, 1]])
    if positive is None:
        assert factor is None
        return
    assert factor.positive == positive == bool(np.linalg.eigvalsh(matrix)[0] > 0.0)
    np.testing.assert_allclose(matrix @ factor.solve(np.eye(2)), np.eye(2), atol=1e-12)
    np.testing.assert_allclose(factor.solve(np.array([1.0, 2.0])), np.linalg.solve(matrix, [1.0, 2.0]), atol=1e-12)


def test_tangent_beyond_a_buckling_point_is_still_factorised(pressed):
    model, q = pressed
    tangent = model.linearize(q).tangent
    softest = np.linalg.eigvalsh(model.sparse_tangent(tangent).toarray())[0]
    tangent[model._pointer[1:] - 1] -= 3.0 * softest  # the diagonal
    b = np.random.default_rng(1).normal(size=model.size)
    left = model.sparse_tangent(tangent) @ model.factorise(tangent).solve(b) - b
    assert np.linalg.eigvalsh(model.sparse_tangent(tangent).toarray())[0] < 0
    assert np.abs(left).max() < 1e-7


def probe_points():
    """Points in the block: inside, on its surface, and on its clamped base."""
    return np.array([[0.0013, 0.0011, 0.0035], [0.0039, -0.0029, 0.0078], [0.002, 0.0, 0.0], [0.001, -0.002, 0.0002]])


@pytest.mark.parametrize("which", ["half", "whole", "wide"])
def test_load_is_the_transpose_of_project_and_springs_are_their_product(which, wide):
    model = wide if which == "wide" else SolidModel(block((3, 2, 4), EDGE), TPU, symmetric=which == "half")
    probe, q = model.attach(probe_points(), 1e-4), np.zeros(model.size)
    J = model.project(probe, q, np.eye(model.size)).reshape(-1, model.size)
    forces = np.random.default_rng(0).normal(size=(4, 3))
    np.testing.assert_allclose(model.load(probe, q, forces), J.T @ forces.ravel(), atol=1e-14)
    moved = model.positions(probe, 1e-4 * np.arange(model.size)) - model.positions(probe, q)
    np.testing.assert_allclose(moved.ravel(), J @ (1e-4 * np.arange(model.size)), atol=1e-12)
    blocks = np.random.default_rng(1).normal(size=(4, 3, 3))
    blocks = 1e3 * blocks @ blocks.transpose(0, 2, 1)
    tangent = model.linearize(q).tangent
    before = model.sparse_tangent(tangent.copy()).toarray()
    model.stiffen(tangent, probe, q, blocks)
    D = np.zeros((12, 12))
    for p in range(4):
        D[3 * p : 3 * p + 3, 3 * p : 3 * p + 3] = blocks[p]
    added = model.sparse_tangent(tangent).toarray() - before
    np.testing.assert_allclose(added, J.T @ D @ J, atol=1e-9 * np.abs(before).max())


def test_points_of_a_probe_lie_where_they_are_attached():
    model = bench_mechanics("coarse").model
    probe = model.attach(BENCH.keypoints, 1e-3)
    np.testing.assert_allclose(model.positions(probe, np.zeros(model.size)), BENCH.keypoints, atol=1e-12)
