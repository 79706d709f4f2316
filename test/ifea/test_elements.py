"""Claims about the stiffness of single elements and of small assemblies of them."""

import numpy as np
import pytest
from mechanics_fakes import block, rotation

from finforce_ifea.fem.elements import centre_gradient, elasticity_matrix, hex_stiffness, tet_stiffness

STEEL = (210e9, 0.3)
RUBBER = (30e6, 0.45)
KINDS = ("hex", "tet4", "tet10")


def stiffness_of(mesh, material=RUBBER):
    corners = mesh.nodes[mesh.elements]
    build = hex_stiffness if corners.shape[1] == 8 else tet_stiffness
    return build(corners, elasticity_matrix(*material))


def assemble(mesh, material=RUBBER):
    K = np.zeros((mesh.nodes.size, mesh.nodes.size))
    for nodes, Ke in zip(mesh.elements, stiffness_of(mesh, material), strict=True):
        dof = (3 * nodes[:, None] + np.arange(3)).ravel()
        K[np.ix_(dof, dof)] += Ke
    return K


@pytest.fixture(params=KINDS)
def distorted(request):
    return block((2, 2, 2), (0.004, 0.006, 0.008), kind=request.param, distort=0.35)


def test_elasticity_matrix_gives_the_textbook_moduli():
    young, poisson = RUBBER
    flexibility = np.linalg.inv(elasticity_matrix(young, poisson))
    expected = np.diag([1 / young] * 3 + [2 * (1 + poisson) / young] * 3)
    expected[:3, :3] -= poisson / young * (1 - np.eye(3))
    np.testing.assert_allclose(flexibility, expected, atol=1e-12 / young)


def test_stiffness_is_symmetric_and_vanishes_for_the_six_rigid_motions_only(distorted):
    for Ke in stiffness_of(distorted):
        values = np.linalg.eigvalsh(Ke) / np.abs(Ke).max()
        np.testing.assert_allclose(Ke, Ke.T, atol=1e-12 * np.abs(Ke).max())
        # rounding leaves 1e-15 of the largest; the softest true mode of these shapes has 3e-4 of it
        assert (np.abs(values[:6]) < 1e-12).all()
        assert values[6] > 1e-4


def test_rigid_motion_gives_zero_force(distorted):
    random = np.random.default_rng(1)
    shift, spin = random.normal(size=3), random.normal(size=3)
    u = shift * 1e-3 + np.cross(spin, distorted.nodes)
    forces = assemble(distorted) @ u.ravel()
    stretched = assemble(distorted) @ (1e-3 * distorted.nodes).ravel()
    assert np.abs(forces).max() < 1e-9 * np.abs(stretched).max()


def test_constant_strain_patch_is_exact(distorted):
    gradient = 1e-3 * np.random.default_rng(2).normal(size=(3, 3))
    exact = distorted.nodes @ gradient.T
    outer = np.unique(distorted.surface)
    free = np.ones(distorted.nodes.shape, bool)
    free[outer] = False
    if distorted.elements.shape[1] == 10:
        # of curved boundaries the mesh's surface lists corners only: hold the middles of its edges too
        low, high = distorted.nodes.min(0), distorted.nodes.max(0)
        free[((distorted.nodes < low + 1e-9) | (distorted.nodes > high - 1e-9)).any(1)] = False
    free, K = free.ravel(), assemble(distorted)
    assert free.any()
    u = exact.ravel().copy()
    u[free] = np.linalg.solve(K[np.ix_(free, free)], -K[np.ix_(free, ~free)] @ u[~free])
    np.testing.assert_allclose(u, exact.ravel(), atol=1e-11 * np.abs(exact).max() / 1e-3)
    strain = 0.5 * (gradient + gradient.T)
    stored = np.r_[np.diag(strain), 2 * strain[[0, 1, 2], [1, 2, 0]]]
    energy = 0.5 * stored @ elasticity_matrix(*RUBBER) @ stored * np.ptp(distorted.nodes, axis=0).prod()
    assert 0.5 * u @ K @ u == pytest.approx(energy, rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_stiffness_turns_with_the_element(kind):
    mesh = block((1, 1, 1), (0.001, 0.002, 0.003), kind=kind)
    R = rotation([1.0, 2.0, -0.5], 0.8)
    corners, D = mesh.nodes[mesh.elements], elasticity_matrix(*RUBBER)
    build = hex_stiffness if kind == "hex" else tet_stiffness
    turn = np.kron(np.eye(corners.shape[1]), R)
    expected = turn @ build(corners, D) @ turn.T
    np.testing.assert_allclose(build(corners @ R.T, D), expected, atol=1e-10 * np.abs(expected).max())


def test_centre_gradient_differentiates_linear_fields(distorted):
    gradient = np.random.default_rng(3).normal(size=(3, 3))
    corners = distorted.nodes[distorted.elements]
    values = corners @ gradient.T
    np.testing.assert_allclose(
        np.einsum("mna,mnb->mab", values, centre_gradient(corners)),
        np.broadcast_to(gradient, (len(corners), 3, 3)),
        atol=1e-9,
    )


def cantilever_stiffness_ratio(kind, elements, *, material=STEEL):
    """Stiffness of a slender cantilever of one row of elements over that of beam theory with shear."""
    length, side = 0.040, 0.002
    mesh = block((1, 1, elements), (side, side, length), kind=kind)
    K = assemble(mesh, material)
    free = np.ones(mesh.nodes.shape, bool)
    free[mesh.clamped] = False
    load = np.zeros(mesh.nodes.shape)
    tip = np.flatnonzero((mesh.nodes[:, 2] > length - 1e-9) & np.isin(np.arange(len(mesh.nodes)), mesh.elements[:, :8]))
    load[tip, 0] = 1.0 / len(tip)
    free, u = free.ravel(), np.zeros(mesh.nodes.size)
    u[free] = np.linalg.solve(K[np.ix_(free, free)], load.ravel()[free])
    young, poisson = material
    inertia, shear = side**4 / 12, young / (2 * (1 + poisson)) * side**2 * 5 / 6
    return (length**3 / (3 * young * inertia) + length / shear) / u.reshape(-1, 3)[tip, 0].mean()


@pytest.mark.parametrize("elements", [10, 20])
def test_one_row_of_incompatible_hexes_bends_like_beam_theory(elements):
    # each 4 or 2 times as long as thick; 3 %: the clamp hinders the strain across, which beam theory does not know
    assert cantilever_stiffness_ratio("hex", elements) == pytest.approx(1.0, abs=0.03)


def test_quadratic_tetrahedra_bend_like_beam_theory():
    assert cantilever_stiffness_ratio("tet10", 10) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(("elements", "factor"), [(5, 21.1), (10, 8.05), (20, 4.63)])
def test_linear_tetrahedra_lock_in_bending_by_a_factor_that_grows_with_their_length(elements, factor):
    # as measured; the opposite of the claim for hexahedra
    assert cantilever_stiffness_ratio("tet4", elements) == pytest.approx(factor, rel=0.02)


def test_linear_tetrahedra_lock_more_when_nearly_incompressible():
    assert cantilever_stiffness_ratio("tet4", 10, material=RUBBER) > 1.5 * cantilever_stiffness_ratio("tet4", 10)
    assert cantilever_stiffness_ratio("hex", 10, material=RUBBER) < 1.05
