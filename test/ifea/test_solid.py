"""Claims about the co-rotational solid, its probes and its factorisations."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from mechanics_fakes import (
    BENCH,
    EDGE,
    HEIGHTS,
    KINDS,
    TPU,
    bench_mechanics,
    bench_press,
    block,
    rotation,
    solve_linear,
    tangent_matrix,
    unknowns_from_displacements,
    wobble,
    write_mesh_jaw,
)

from finforce_ifea.fem.solid import SolidModel, find_mirror_nodes
from finforce_ifea.jaw.drawing import MeshDensity
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings
from lab.presses import RigidCylinder, press_jaw


def on_edge(nodes):
    return (nodes[:, 0] < 1e-9) & (nodes[:, 2] < 1e-9)


@pytest.fixture(params=[("hex", False), ("hex", True), ("tet4", False), ("tet10", False)], ids=str)
def hinged(request):
    """A distorted block clamped along one edge, the y axis: it can turn about it freely."""
    kind, symmetric = request.param
    mesh = block((2, 2, 2), EDGE, kind=kind, distort=0.0 if symmetric else 0.3, clamp=on_edge)
    model = SolidModel(mesh, TPU, symmetric=symmetric)
    assert model.symmetric == symmetric
    return model


def test_finite_rigid_rotation_gives_zero_force(hinged):
    R = rotation([0, 1, 0], 2.0)
    q = unknowns_from_displacements(hinged, hinged.mesh.nodes @ R.T - hinged.mesh.nodes)
    state = hinged.linearize(q)
    moved = np.abs(q).max()
    stiffness = np.abs(tangent_matrix(hinged, np.zeros(hinged.size))).max()
    assert moved > 0.005
    assert np.abs(state.force).max() < 1e-12 * stiffness * moved
    assert state.energy < 1e-20 * stiffness * moved**2
    assert state.smallest_det == pytest.approx(1.0, abs=1e-9)


def test_force_turns_with_a_strained_body(hinged):
    R = rotation([0, 1, 0], 1.1)
    u = wobble(hinged, 2e-4)
    turned = (hinged.mesh.nodes + u) @ R.T - hinged.mesh.nodes
    before = hinged.linearize(unknowns_from_displacements(hinged, u))
    after = hinged.linearize(unknowns_from_displacements(hinged, turned))
    expected = unknowns_from_displacements(hinged, hinged.expand(before.force) @ R.T)
    np.testing.assert_allclose(after.force, expected, atol=1e-10 * np.abs(expected).max())
    assert after.energy == pytest.approx(before.energy, rel=1e-10)


def test_force_is_the_gradient_of_the_energy(hinged):
    q, h = unknowns_from_displacements(hinged, wobble(hinged, 3e-4)), 1e-8
    force = hinged.linearize(q).force
    for seed in range(5):
        way = np.random.default_rng(seed).normal(size=hinged.size)
        up, down = (hinged.linearize(q + s * h * way).energy for s in (1, -1))
        # 1e-6: central differences of a smooth energy
        assert (up - down) / (2 * h) == pytest.approx(force @ way, rel=1e-6)


def tangent_error(model, q):
    """How far the tangent is from the force's central differences, relative."""
    K, h, errors = tangent_matrix(model, q), 1e-8, []
    np.testing.assert_array_equal(K, K.T)
    for seed in range(3):
        way = np.random.default_rng(seed).normal(size=model.size)
        up, down = (model.linearize(q + s * h * way).force for s in (1, -1))
        change = (up - down) / (2 * h)
        errors.append(np.linalg.norm(K @ way - change) / np.linalg.norm(change))
    return max(errors)


def turned_and_strained(model, size):
    u = wobble(model, size)
    return unknowns_from_displacements(model, (model.mesh.nodes + u) @ rotation([0, 1, 0], 0.7).T - model.mesh.nodes)


def test_tangent_is_the_derivative_of_the_force_up_to_second_order_in_the_strain(hinged):
    """Of linear tetrahedra it is exact; elsewhere terms of second order in the strain are left out."""
    errors = [tangent_error(hinged, turned_and_strained(hinged, size)) for size in (1e-5, 1e-4)]
    exact = hinged.mesh.elements.shape[1] == 4
    # strains of some 0.5 % and 5 %, up to 40 % in the tetrahedra; 1e-9 is what central differences leave
    assert errors[0] < (1e-9 if exact else 2e-5)
    assert errors[1] < (1e-9 if exact else 150 * errors[0])


@pytest.mark.parametrize(("mesh", "diameter", "height"), [("coarse", 25, 40), ("default", 25, 40), ("default", 35, 20)])
def test_tangent_of_the_pressed_finger_is_the_derivative_of_its_force(mesh, diameter, height):
    q = bench_press(mesh, "solid", diameter, height, (2, 8))[-1].q
    assert tangent_error(bench_mechanics(mesh).model, q) < 1e-5


def test_force_of_the_pressed_finger_is_the_gradient_of_its_energy(pressed):
    model, q = pressed
    force, h = model.linearize(q).force, 1e-9
    way = np.random.default_rng(0).normal(size=model.size)
    up, down = (model.linearize(q + s * h * way).energy for s in (1, -1))
    assert (up - down) / (2 * h) == pytest.approx(force @ way, rel=1e-6)


def test_energy_of_a_mirrored_half_is_that_of_the_whole():
    mesh = block((3, 2, 4), EDGE)
    half, whole = SolidModel(mesh, TPU), SolidModel(mesh, TPU, symmetric=False)
    u = wobble(half, 2e-4)
    states = [model.linearize(unknowns_from_displacements(model, u)) for model in (half, whole)]
    assert half.size < 0.6 * whole.size
    assert states[0].energy == pytest.approx(states[1].energy, rel=1e-12)


def test_halved_and_whole_finger_agree():
    half, whole = bench_mechanics("coarse"), bench_mechanics("coarse", axes="three")
    assert half.model.symmetric and not whole.model.symmetric
    results = [
        press_jaw(
            part.model, part.contact.surface, BENCH.inner_face_x, RigidCylinder(radius=0.0125), 0.040, [0.002, 0.005]
        )[-1]
        for part in (half, whole)
    ]
    # twice as many contact points over the same width: only rounding and the surface's own corners differ
    np.testing.assert_allclose(results[0].force, results[1].force, rtol=1e-8, atol=1e-8)
    shapes = [part.model.vertices(result.q) for part, result in zip((half, whole), results, strict=True)]
    np.testing.assert_allclose(shapes[0], shapes[1], atol=1e-9)
    mirror = find_mirror_nodes(whole.mesh)
    np.testing.assert_allclose(shapes[1][mirror] * [1, -1, 1], shapes[1], atol=1e-9)


def test_mesh_without_mirror_image_is_not_halved():
    assert find_mirror_nodes(block((2, 2, 2), EDGE, distort=0.3)) is None
    assert find_mirror_nodes(block((2, 1, 2), EDGE)) is None
    assert find_mirror_nodes(block((2, 2, 2), EDGE)) is not None


def line_stiffness(model, height):
    """N/mm of the unloaded finger under a line load along -x across its inner face at a height [m]."""
    points = np.stack(
        [np.full(21, BENCH.inner_face_x), np.linspace(-0.00999, 0.00999, 21), np.full(21, height)], axis=1
    )
    probe, q = model.attach(points, 1e-4), np.zeros(model.size)
    mode = solve_linear(model, model.load(probe, q, np.tile([-1.0 / 21, 0.0, 0.0], (21, 1))))
    return -1e-3 / model.project(probe, q, mode[:, None])[:, 0, 0].mean()


# N/mm at z = 20, 40, 60 mm for E = 30 MPa, as measured; the coarse mesh is the paper's 522 vertices.
STIFFNESS = {
    ("coarse", "hex"): (0.762, 0.359, 0.413),
    ("default", "hex"): (0.722, 0.339, 0.391),
    ("fine", "hex"): (0.725, 0.341, 0.397),
    ("coarse", "tet10"): (0.862, 0.399, 0.455),
    ("coarse", "tet4"): (7.54, 2.78, 1.60),
}


@pytest.mark.parametrize(("mesh", "kind"), STIFFNESS)
def test_stiffness_of_the_finger_against_a_line_load_is_as_measured(mesh, kind):
    model = SolidModel(KINDS[kind](BENCH.build_mesh(mesh)), TPU)
    found = [line_stiffness(model, height) for height in HEIGHTS.values()]
    assert found == pytest.approx(STIFFNESS[mesh, kind], rel=0.01)


def test_linear_tetrahedra_make_the_finger_four_to_ten_times_too_stiff():
    models = [SolidModel(KINDS[kind](BENCH.build_mesh("coarse")), TPU) for kind in ("tet4", "hex")]
    too_stiff = [line_stiffness(models[0], z) / line_stiffness(models[1], z) for z in HEIGHTS.values()]
    assert too_stiff == pytest.approx([9.9, 7.75, 3.87], rel=0.01)


def keypoint_motion(model):
    """Size of all key points' motion along x [mm/N] under a line load at the middle."""
    line = np.stack([np.full(21, BENCH.inner_face_x), np.linspace(-0.00999, 0.00999, 21), np.full(21, 0.040)], axis=1)
    probe, q = model.attach(line, 1e-4), np.zeros(model.size)
    mode = solve_linear(model, model.load(probe, q, np.tile([-1.0 / 21, 0.0, 0.0], (21, 1))))
    return 1e3 * np.linalg.norm(model.project(model.attach(BENCH.keypoints, 1e-3), q, mode[:, None])[:, 0])


def test_refinement_converges():
    densities = [
        MeshDensity(between_ribs=n, through_band=n // 2, along_rib=n, through_rib=n // 2, tip=n // 2, across_width=2)
        for n in (2, 4, 8, 16)
    ]
    steps = np.diff([keypoint_motion(SolidModel(BENCH.build_mesh(density), TPU)) for density in densities])
    # the ribs' corners are re-entrant, so the order is near one: each halving changes less than half of the one before
    assert (np.abs(steps[1:]) < 0.5 * np.abs(steps[:-1])).all()


def test_refinement_converges_at_large_deflection():
    """At 8 mm depth the coarse mesh is some 11 % too stiff, as its elements stiffen when the band turns."""
    forces = [-bench_press(mesh, "solid", 25, 40, (2, 8))[-1].force[0] for mesh in ("coarse", "default", "fine")]
    assert abs(forces[1] - forces[2]) < 0.1 * abs(forces[0] - forces[2])
    assert forces[1] == pytest.approx(forces[2], rel=0.01)


def test_mesh_file_gives_the_same_jaw_as_the_drawing(tmp_path):
    jaw = replace(load_jaw(write_mesh_jaw(tmp_path)), material=TPU)
    mechanics = build_mechanics(jaw, EstimatorSettings())
    results = press_jaw(
        mechanics.model,
        mechanics.contact.surface,
        jaw.inner_face_x,
        RigidCylinder(radius=0.0125),
        0.040,
        [0.002, 0.008],
    )
    expected = bench_press("coarse", "solid", 25, 40, (2, 8))
    for result, drawn in zip(results, expected, strict=True):
        np.testing.assert_allclose(result.force, drawn.force, rtol=1e-6, atol=1e-6)


def test_linear_tetrahedra_of_a_file_are_accepted_with_a_warning_that_says_by_how_much_they_lock(tmp_path):
    mesh = KINDS["tet4"](BENCH.build_mesh("coarse"))
    with pytest.warns(UserWarning, match=r"lock.*\d"):
        build_mechanics(load_jaw(write_mesh_jaw(tmp_path, mesh)), EstimatorSettings())


@pytest.mark.parametrize("kind", ["hex", "tet10"])
def test_elements_that_do_not_lock_bring_no_warning(tmp_path, kind):
    mesh = KINDS[kind](BENCH.build_mesh("coarse"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        build_mechanics(load_jaw(write_mesh_jaw(tmp_path, mesh)), EstimatorSettings())
