"""Claims about mechanics under stress: right, or refused in words."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from mechanics_fakes import BENCH, MODULUS, bench_mechanics, block, build_jaw

from finforce_ifea.errors import ContactError, MeshError
from finforce_ifea.fem.model import SparseFactor, factorise_banded
from finforce_ifea.jaw.mesh import build_volume_mesh, check_connection, to_tet4, to_tet10
from finforce_ifea.mechanics import LockingWarning, build_mechanics, measure_locking, warn_of_locking
from finforce_ifea.settings import EstimatorSettings
from lab.presses import RigidCylinder, press_jaw
from lab.stress.session import Bench, open_session, update
from lab.stress.stress import Plan

COARSE, FRAME = EstimatorSettings(solver="solid", mesh="coarse"), EstimatorSettings(solver="frame")


def press(jaw, settings, height, depth):
    mechanics, rigid = build_mechanics(jaw, settings), RigidCylinder(radius=0.0125)
    return press_jaw(mechanics.model, mechanics.contact.surface, jaw.inner_face_x, rigid, height, [depth])[0]


# --- stiffness


@pytest.mark.parametrize("settings", [COARSE, FRAME], ids=["solid", "frame"])
@pytest.mark.parametrize("modulus", [1e3, 1e8, 1e12])
def test_forces_go_with_the_modulus(settings, modulus):
    """From 1 kPa to 1 TPa; 1e-9: rounding of a condition of some 1e8 in a force that the object's depth fixes."""
    forces = [press(build_jaw(value), settings, 0.02, 3e-3).force / value for value in (MODULUS, modulus)]
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-9, atol=1e-9 * np.linalg.norm(forces[0]))


def test_a_constant_penalty_would_not_go_with_the_modulus():
    """The opposite: with the surface's own penalty a jaw of 1 TPa gives way by a twentieth of the depth only."""
    jaw = build_jaw(1e12)
    mechanics = build_mechanics(jaw, COARSE)
    surface = mechanics.contact.surface
    soft = replace(surface, stiffness=surface.stiffness * (MODULUS / 1e12))
    rigid = RigidCylinder(radius=0.0125)
    right, wrong = (
        press_jaw(mechanics.model, s, jaw.inner_face_x, rigid, 0.04, [2e-3])[0].force for s in (surface, soft)
    )
    assert np.linalg.norm(wrong) < 0.1 * np.linalg.norm(right)


def estimate_press(modulus):
    """What an estimator of a jaw of some modulus says at the end of a press with noise."""
    bench = Bench(Plan(solver="frame"), jaw=build_jaw(modulus))
    history = bench.history(height=0.04, radius=0.0125, depth=3e-3)
    session = open_session(bench, bench.plan.random("modulus", 0), history=history)
    return [update(bench, step) for step in session.press()][-1]


def test_estimates_go_with_the_modulus():
    first, other = (estimate_press(modulus) for modulus in (MODULUS, 1e9))
    assert first.status == other.status == "ok"
    # key points that differ by rounding go through the estimator's iterations
    np.testing.assert_allclose(other.force / 1e9, first.force / MODULUS, rtol=1e-6, atol=1e-15)


# --- loads into buckling


@pytest.mark.parametrize(("mesh", "solver"), [("coarse", "solid"), ("default", "frame")])
def test_a_jaw_that_snaps_is_no_equilibrium(mesh, solver):
    """Near the tip the outer band gives way at 13 to 17 mm; what Newton's method finds beyond is another shape."""
    mechanics = bench_mechanics(mesh, solver)
    pressed = lambda depth: press_jaw(  # noqa: E731
        mechanics.model, mechanics.contact.surface, BENCH.inner_face_x, RigidCylinder(radius=0.0125), 0.075, [depth]
    )
    with pytest.raises(ContactError, match="beyond a depth of 1[37]"):
        pressed(18e-3)


def test_tiny_presses_are_in_equilibrium_with_their_force():
    """Newton's method stops by the depth, not by an absolute length: at 1 um the residual is still rounding."""
    mechanics, depth = bench_mechanics("coarse", "solid"), 1e-6
    model, surface, rigid = mechanics.model, mechanics.contact.surface, RigidCylinder(radius=0.0125)
    (found,) = press_jaw(model, surface, BENCH.inner_face_x, rigid, 0.04, [depth])
    points = model.positions(surface.probe, found.q)
    forces = rigid.press(points, surface.stiffness, BENCH.inner_face_x, depth, 0.04).forces
    left = model.load(surface.probe, found.q, forces) - model.linearize(found.q).force
    assert np.abs(left).max() < 1e-6 * np.linalg.norm(found.force)


def test_stability_is_seen_by_both_factors():
    """Of diag(2, 2, -1) with couplings, banded Cholesky sees it by failing, LU by its pivots."""
    storage = np.array([[2.0, 2.0, 2.0], [0.5, 0.5, 0.0]], order="F")
    assert factorise_banded(storage).positive
    matrix = lambda last: np.array([[2.0, 0.5, 0.0], [0.5, 2.0, 0.5], [0.0, 0.5, last]])  # noqa: E731
    from scipy.sparse import csc_matrix

    assert SparseFactor(csc_matrix(matrix(2.0))).positive
    assert not SparseFactor(csc_matrix(matrix(-1.0))).positive


# --- meshes


def test_a_face_of_three_elements_is_refused():
    mesh = block((1, 1, 2), (0.004, 0.006, 0.008))
    lower = mesh.elements[0]
    shared = np.intersect1d(mesh.elements[0], mesh.elements[1])
    # a third element on the face between the two, through the upper one
    tall = np.where(np.isin(lower, shared), lower, -1)
    moved = {int(node): len(mesh.nodes) + i for i, node in enumerate(np.setdiff1d(lower, shared))}
    third = np.array([node if node >= 0 else moved[int(lower[i])] for i, node in enumerate(tall)])
    extra = mesh.nodes[np.setdiff1d(lower, shared)] - [0.0, 0.0, 0.001]
    with pytest.raises(MeshError, match="more than two elements"):
        build_volume_mesh(
            nodes=np.vstack([mesh.nodes, extra]), elements=np.vstack([mesh.elements, third]), clamped=mesh.clamped
        )


def test_good_meshes_are_one_piece():
    for mesh in (
        BENCH.build_mesh("default"),
        to_tet10(BENCH.build_mesh("coarse")),
        block((2, 2, 4), (0.01, 0.01, 0.02)),
    ):
        check_connection(mesh)


# --- locking


def warned(ratio, mesh):
    jaw = replace(build_jaw(ratio=ratio), drawing=None)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_locking(jaw, mesh)
    return [str(w.message) for w in said if issubclass(w.category, LockingWarning)]


def test_hexahedra_do_not_lock_near_incompressibility():
    """Within 5 % of plane strain from nu = 0.3 to 0.499, where 4-node tetrahedra are 12 times too stiff."""
    mesh = build_jaw().build_mesh("coarse")
    assert measure_locking(build_jaw(ratio=0.499), mesh) == pytest.approx(1.0, abs=0.05)
    assert measure_locking(build_jaw(ratio=0.499), to_tet4(mesh)) > 8.0
    assert not warned(0.499, mesh)


def test_tetrahedra_that_lock_are_warned_of():
    mesh = build_jaw().build_mesh("coarse")
    (words,) = warned(0.499, to_tet10(mesh))
    assert "10-node tetrahedra lock, they are 1.4 times" in words and "0.499" in words
    assert not warned(0.3, to_tet10(mesh))
    assert warned(0.3, to_tet4(mesh))
