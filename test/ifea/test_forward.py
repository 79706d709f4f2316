"""Claims about the finger pressed on rigid objects."""

from dataclasses import replace

import numpy as np
import pytest
from box_fakes import RigidBox
from mechanics_fakes import BENCH, bench_mechanics, bench_press

from finforce_ifea.contact_mechanics.pressed_jaw import build_contact_surface
from finforce_ifea.errors import ContactError, MeshError
from lab.presses import RigidCylinder, press_jaw

FACE = BENCH.inner_face_x
STEPS = tuple(np.arange(1, 41) * 0.2)
DEEP = (2, 4, 6, 8, 10)
MODELS = [("coarse", "solid"), ("default", "frame")]


def press(rigid, height, depths, mesh="coarse", solver="solid"):
    mechanics = bench_mechanics(mesh, solver)
    return press_jaw(mechanics.model, mechanics.contact.surface, FACE, rigid, height, depths)


def axis_of(result, diameter, height):
    return np.array([FACE + 0.5e-3 * diameter - result.depth, 0.0, 1e-3 * height])


@pytest.mark.parametrize(("mesh", "solver"), MODELS)
@pytest.mark.parametrize("height", [20, 40, 60])
def test_work_of_the_object_becomes_elastic_energy(mesh, solver, height):
    """The object moves along -x, frictionless: its work is the integral of -F_x over the depth."""
    results = bench_press(mesh, solver, 25, height, STEPS)
    depths = np.r_[0.0, [result.depth for result in results]]
    forces = np.r_[0.0, [-result.force[0] for result in results]]
    work = np.trapezoid(forces, depths) if hasattr(np, "trapezoid") else np.trapz(forces, depths)
    # 1.5 %: the penalty keeps up to 0.5 %, the trapezoids of 0.2 mm miss some 0.1 %
    assert work == pytest.approx(results[-1].energy, rel=0.015)


@pytest.mark.parametrize(("mesh", "solver"), MODELS)
@pytest.mark.parametrize(("diameter", "height"), [(15, 60), (25, 20), (35, 20), (35, 40)])
def test_force_passes_through_the_axis_of_a_frictionless_cylinder(mesh, solver, diameter, height):
    for result in bench_press(mesh, solver, diameter, height, DEEP):
        about_axis = result.torque - np.cross(axis_of(result, diameter, height), result.force)
        size = np.linalg.norm(result.force)
        # 1e-9 of force times radius: every point's force is along its own radius
        assert np.abs(about_axis).max() < 1e-9 * size * diameter
        arm = result.pressure_centre - axis_of(result, diameter, height)
        lever = np.abs(np.cross(arm, result.force)).max() / size
        # the mean point of a region spread over a circle lies a little off the force's line
        assert lever < 0.1e-3
        assert 0.8 * diameter / 2e3 < np.linalg.norm(arm) < 1.001 * diameter / 2e3
        assert arm @ result.force > 0


def test_elastic_forces_balance_the_contact_forces():
    mechanics = bench_mechanics("coarse")
    model, surface = mechanics.model, mechanics.contact.surface
    result = bench_press("coarse", "solid", 25, 40, DEEP)[-1]
    points = model.positions(surface.probe, result.q)
    forces = RigidCylinder(radius=0.0125).press(points, surface.stiffness, FACE, result.depth, 0.040).forces
    left = model.linearize(result.q).force - model.load(surface.probe, result.q, forces)
    assert np.abs(left).max() < 1e-6 * np.linalg.norm(result.force)
    np.testing.assert_allclose(forces.sum(0), result.force, atol=1e-12)


# Where an independent program (CalculiX, 20-node hexahedra) has the pressure centre at 10 mm, undeformed height [mm].
PLACES = {(15, 20): 20.0, (25, 20): 18.0, (35, 20): 13.8, (25, 40): 40.0, (25, 60): 62.7, (35, 60): 62.7}


@pytest.mark.parametrize(("mesh", "solver"), [("default", "solid"), ("default", "frame")])
@pytest.mark.parametrize(("diameter", "height"), PLACES)
def test_contact_moves_along_the_finger_to_where_an_independent_program_has_it(mesh, solver, diameter, height):
    place = 1e3 * bench_press(mesh, solver, diameter, height, DEEP)[-1].pressure_location[2]
    # 1.5 mm: its mesh has a node every 1.4 mm along the surface
    assert place == pytest.approx(PLACES[diameter, height], abs=1.5)


@pytest.mark.parametrize(("mesh", "solver"), MODELS)
def test_contact_of_a_big_cylinder_moves_down_the_finger_step_by_step(mesh, solver):
    places = [1e3 * result.pressure_location[2] for result in bench_press(mesh, solver, 35, 20, DEEP)]
    assert (np.diff(places) < -0.5).all()


def test_force_leans_down_where_the_contact_has_moved_down():
    """30 degrees from -x; below its axis the cylinder pushes down."""
    result = bench_press("default", "solid", 35, 20, DEEP)[-1]
    assert np.degrees(np.arctan2(result.force[2], -result.force[0])) == pytest.approx(-31, abs=3)
    assert result.force[0] < 0
    assert result.force[1] == pytest.approx(0.0, abs=1e-12)


def test_box_touches_at_its_two_edges_when_the_finger_bends():
    """A box of 20 mm pressed 5 mm in: the finger bends away from its face and rests on its rounded edges."""
    rigid = RigidBox(size_x=0.02, size_z=0.020, edge_radius=0.002)
    mechanics = bench_mechanics("default", "frame")
    result = press(rigid, 0.040, [1e-4, 5e-3], "default", "frame")[-1]
    points = mechanics.model.positions(mechanics.contact.surface.probe, result.q)
    forces = rigid.press(points, mechanics.contact.surface.stiffness, FACE, 5e-3, 0.040).forces
    size = np.linalg.norm(forces, axis=1)
    z = points[:, 2] - 0.040
    assert (np.abs(z[size > 0]) > 0.007).all()
    assert size[z > 0].sum() > 0.2 * size.sum()
    assert size[z < 0].sum() > 0.2 * size.sum()


def test_flat_box_touches_with_its_whole_face_first():
    """At a tenth of a millimetre the finger is still straight: the opposite of the claim about the edges."""
    rigid = RigidBox(size_x=0.02, size_z=0.006, edge_radius=0.0005)
    mechanics = bench_mechanics("default", "frame")
    result = press(rigid, 0.075, [5e-5], "default", "frame")[-1]
    points = mechanics.model.positions(mechanics.contact.surface.probe, result.q)
    size = np.linalg.norm(rigid.press(points, mechanics.contact.surface.stiffness, FACE, 5e-5, 0.075).forces, axis=1)
    assert (size[np.abs(points[:, 2] - 0.075) < 0.002] > 0).all()


@pytest.mark.parametrize("depths", [[0.002, 0.004], [0.004]])
def test_result_does_not_depend_on_the_steps(depths):
    expected = press(RigidCylinder(radius=0.0125), 0.040, [0.001, 0.0015, 0.004])[-1]
    result = press(RigidCylinder(radius=0.0125), 0.040, depths)[-1]
    np.testing.assert_allclose(result.force, expected.force, rtol=1e-6, atol=1e-6)
    assert result.depth == 0.004


def test_untouched_jaw_feels_nothing():
    result = press(RigidCylinder(radius=0.0125), 0.040, [0.0])[0]
    assert not result.force.any() and not result.q.any() and result.energy == 0.0
    assert np.isnan(result.pressure_centre[2])


def test_no_equilibrium_is_an_error_that_names_the_depth():
    with pytest.raises(ContactError, match=r"beyond a depth of 2\d\.\d+ mm"):
        press(RigidCylinder(radius=0.0075), 0.020, [0.050], "default", "frame")


def test_surface_of_half_and_whole_finger_are_equally_stiff():
    half, whole = (bench_mechanics("coarse", axes=axes).contact.surface for axes in ("normal", "three"))
    assert len(whole.points) == 2 * len(half.points)
    assert whole.stiffness.sum() == pytest.approx(half.stiffness.sum())
    assert (half.points[:, 1] > 0).all()
    np.testing.assert_allclose(whole.points[:, 1].reshape(len(whole.heights), -1).sum(1), 0.0, atol=1e-15)


def test_surface_covers_the_inner_face_from_base_to_tip():
    surface = bench_mechanics("coarse").contact.surface
    np.testing.assert_allclose(surface.points[:, 0], FACE)
    assert surface.heights[0] < 0.5e-3 and surface.heights[-1] > 0.0795
    assert (np.diff(surface.heights) <= 0.5e-3 + 1e-12).all()


def test_mesh_without_nodes_on_the_inner_face_is_refused():
    mechanics = bench_mechanics("coarse")
    with pytest.raises(MeshError, match="inner_face_x"):
        build_contact_surface(replace(BENCH, inner_face_x=0.02), mechanics.mesh, mechanics.model, across="half")
