"""Outlines against analytic silhouettes, and of open meshes against closed ones."""

from dataclasses import replace

import contact_fakes as fakes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from finforce.errors import PoseError
from finforce.triangle_surface import chain_loops
from finforce_contact.mesh.object_mesh import prepare_object_mesh, to_manifold
from finforce_contact.section import cut_outline

# 0.02 mm of simplification and as much for the facets of round objects.
TOLERANCE = 4e-5
LYING = fakes.turn_about("x", 90.0)  # the object's z becomes -y of the jaw, its y becomes z
ANGLES = st.floats(-180.0, 180.0)


def radii(polygon):
    return np.linalg.norm(polygon, axis=1)


def test_cylinder_along_y_gives_its_circle():
    (outline,) = cut_outline(fakes.build_cylinder(radius=0.0175), LYING, 0.01)
    assert np.abs(radii(outline) - 0.0175).max() < TOLERANCE
    assert fakes.signed_area(outline) == pytest.approx(np.pi * 0.0175**2, rel=3e-3)


def test_upright_cylinder_gives_a_rectangle_as_wide_as_the_slab_shows():
    (outline,) = cut_outline(fakes.build_cylinder(), np.eye(3), 0.01)
    assert np.abs(outline).max(axis=0) == pytest.approx([0.03, 0.04], abs=TOLERANCE)
    assert fakes.signed_area(outline) == pytest.approx(0.06 * 0.08, rel=2e-3)


def test_upright_cylinder_beside_the_slab_shows_the_chord_that_reaches_into_it():
    (outline,) = cut_outline(fakes.build_cylinder(), np.eye(3), 0.005, centre_y=-0.025)
    assert np.abs(outline[:, 0]).max() == pytest.approx(np.sqrt(0.03**2 - 0.02**2), abs=TOLERANCE)


def test_box_turned_by_30_degrees_about_y_keeps_its_corners():
    R = fakes.turn_about("y", 30.0)
    (outline,) = cut_outline(fakes.build_box((0.04, 0.08, 0.06)), R, 0.01)
    corners = np.array([(x, 0.0, z) for x in (-0.02, 0.02) for z in (-0.03, 0.03)]) @ R.T
    assert len(outline) == 4
    distances = np.linalg.norm(outline[:, None] - corners[:, [0, 2]], axis=2)
    assert distances.min(axis=1).max() < 1e-9
    assert distances.min(axis=0).max() < 1e-9


def test_slab_beside_the_centre_of_a_sphere_shows_a_smaller_circle():
    (outline,) = cut_outline(fakes.build_sphere(0.03), LYING, 0.01, centre_y=0.025)
    assert np.abs(radii(outline) - np.sqrt(0.03**2 - 0.015**2)).max() < TOLERANCE


@pytest.mark.parametrize(("centre_y", "radius"), [(0.02, 0.02), (-0.02, 0.04)])
def test_centre_y_moves_the_object_and_not_the_slab(centre_y, radius):
    """Lying, the wide end of the cone is at y = +0.03: moved further up, the slab shows the half that narrows."""
    cone = prepare_object_mesh(*fakes.revolve([(0.0, -0.03), (0.04, -0.03), (0.01, 0.03), (0.0, 0.03)]))
    (outline,) = cut_outline(cone, LYING, 0.01, centre_y)
    assert radii(outline).max() == pytest.approx(radius, abs=TOLERANCE)


@pytest.mark.parametrize("centre_y", [0.05, -0.05])
def test_slab_that_misses_the_object_shows_nothing(centre_y):
    sphere = fakes.build_sphere(0.03)
    assert cut_outline(sphere, np.eye(3), 0.015, centre_y) == ()
    assert cut_outline(sphere, np.eye(3), 0.025, centre_y) != ()


@pytest.mark.parametrize("centre_y", [0.02, -0.02])
def test_object_that_only_touches_the_slab_shows_nothing(centre_y):
    box = fakes.build_box((0.04, 0.02, 0.06))
    assert cut_outline(box, np.eye(3), 0.01, centre_y) == ()
    assert cut_outline(box, np.eye(3), 0.01, 0.999 * centre_y) != ()


def test_mug_shows_the_hole_of_its_handle_as_a_clockwise_polygon():
    outline = cut_outline(fakes.build_mug(), np.eye(3), 0.01)
    outer, hole = sorted(outline, key=fakes.signed_area, reverse=True)
    assert len(outline) == 2
    assert fakes.signed_area(hole) < 0.0 < fakes.signed_area(outer)
    assert outer.min(axis=0) == pytest.approx([-0.035, -0.045], abs=TOLERANCE)
    assert outer.max(axis=0) == pytest.approx([0.065, 0.045], abs=TOLERANCE)
    assert hole[:, 0].max() == pytest.approx(0.057, abs=TOLERANCE)
    assert hole[:, 0].min() == pytest.approx(0.035, abs=TOLERANCE)


def test_mug_from_its_other_side_is_mirrored():
    outline = cut_outline(fakes.build_mug(), fakes.turn_about("z", 180.0), 0.01)
    assert np.concatenate(outline)[:, 0].min() == pytest.approx(-0.065, abs=TOLERANCE)


def test_handle_outside_the_slab_is_not_shown():
    (outline,) = cut_outline(fakes.build_mug(), np.eye(3), 0.01, centre_y=0.02)
    assert outline[:, 0].max() == pytest.approx(np.sqrt(0.035**2 - 0.01**2), abs=TOLERANCE)


def test_two_bodies_give_two_polygons_and_overlapping_ones_give_one():
    left, right = (fakes.box_triangles((0.02, 0.02, 0.02), (x, 0.0, 0.0)) for x in (-0.015, 0.015))
    near = fakes.box_triangles((0.02, 0.02, 0.02), (0.0, 0.003, 0.0))
    assert len(cut_outline(prepare_object_mesh(*fakes.join(left, right)), np.eye(3), 0.01)) == 2
    (outline,) = cut_outline(prepare_object_mesh(*fakes.join(left, near, right)), np.eye(3), 0.005)
    assert fakes.signed_area(outline) == pytest.approx(0.05 * 0.02, rel=1e-6)


def test_vertices_on_the_side_of_the_slab_make_no_difference():
    box = fakes.build_box((0.04, 0.02, 0.06))
    for half_width in (0.01, 0.01 + 1e-12, 0.01 - 1e-12):
        (outline,) = cut_outline(box, np.eye(3), half_width)
        assert fakes.signed_area(outline) == pytest.approx(0.04 * 0.06, rel=1e-6)


@settings(max_examples=25)
@given(angles=st.tuples(ANGLES, ANGLES, ANGLES), centre_y=st.floats(-0.03, 0.03))
def test_outline_is_the_projection_of_the_cut_solid(angles, centre_y):
    """The solid cut and projected by manifold3d, which knows nothing of loops."""
    mug, R = fakes.build_mug(), Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    solid = to_manifold(mug).transform(np.column_stack([R, [0.0, centre_y, 0.0]])).scale([1e3] * 3)
    cut = solid.trim_by_plane((0.0, 1.0, 0.0), -10.0).trim_by_plane((0.0, -1.0, 0.0), -10.0)
    expected = cut.rotate([90.0, 0.0, 0.0]).project().area() * 1e-6
    outline = cut_outline(mug, R, 0.01, centre_y)
    # the outline is 0.3 m long at most, and simplified by 0.02 mm
    assert sum(fakes.signed_area(polygon) for polygon in outline) == pytest.approx(expected, abs=6e-6)


@settings(max_examples=10)
@given(angle=ANGLES)
def test_turning_the_object_about_y_turns_its_outline(angle):
    mug, tilted = fakes.build_mug(), fakes.turn_about("x", 25.0)
    turn = fakes.turn_about("y", angle)
    before = [polygon @ turn[np.ix_([0, 2], [0, 2])].T for polygon in cut_outline(mug, tilted, 0.01)]
    assert fakes.outline_distance(cut_outline(mug, turn @ tilted, 0.01), before) < 2.5e-5


@pytest.mark.parametrize(
    "R", [np.eye(3), LYING, fakes.turn_about("xyz", [20.0, 40.0, 70.0])], ids=["up", "lying", "turned"]
)
def test_open_cylinder_has_the_outline_of_the_closed_one(R):
    closed = fakes.build_cylinder()
    tube = prepare_object_mesh(*fakes.tube_triangles())
    assert not tube.watertight
    assert fakes.outline_distance(cut_outline(tube, R, 0.01), cut_outline(closed, R, 0.01)) < 5e-5


@pytest.mark.parametrize("R", [LYING, fakes.turn_about("xyz", [20.0, 40.0, 70.0])], ids=["lying", "turned"])
def test_hole_in_the_surface_is_bridged_in_the_outline(R):
    """The hole lies across a side of the slab, where the section through it has a gap with a sagitta of 0.04 mm."""
    vertices, triangles = fakes.sphere_triangles(0.03)
    pierced = fakes.pierce(vertices, triangles, R.T @ (0.028, 0.01, 0.0), 0.0015)[1]
    closed = fakes.build_sphere(0.03)
    mesh = replace(closed.with_triangles(vertices, pierced), watertight=False)
    assert fakes.outline_distance(cut_outline(mesh, R, 0.01), cut_outline(closed, R, 0.01)) < 5e-5


def test_sense_of_an_open_mesh_does_not_matter():
    tube = prepare_object_mesh(*fakes.tube_triangles())
    inward = tube.with_triangles(tube.vertices, tube.triangles[:, ::-1])
    R = fakes.turn_about("xyz", [20.0, 40.0, 70.0])
    assert fakes.outline_distance(cut_outline(inward, R, 0.01), cut_outline(tube, R, 0.01)) < 5e-5


def test_outline_deviates_by_its_simplification_at_most():
    fine = prepare_object_mesh(*fakes.cylinder_triangles(facets=4096))
    (outline,) = cut_outline(fine, LYING, 0.01)
    middles = 0.5 * (outline + np.roll(outline, -1, axis=0))
    assert len(outline) < 300
    assert radii(middles).min() > 0.03 - 2.5e-5


@pytest.mark.parametrize(
    ("R", "half_width", "centre_y"),
    [
        (np.full((3, 3), np.nan), 0.01, 0.0),
        (2.0 * np.eye(3), 0.01, 0.0),
        (np.eye(4), 0.01, 0.0),
        (np.diag([1.0, 1.0, -1.0]), 0.01, 0.0),
        (np.eye(3), 0.0, 0.0),
        (np.eye(3), 0.01, np.inf),
    ],
)
def test_impossible_placement_is_refused(R, half_width, centre_y):
    with pytest.raises(PoseError, match="expected"):
        cut_outline(fakes.build_box(), R, half_width, centre_y)


def test_loops_run_along_each_edge_once():
    starts, stops = np.array([0, 1, 2, 2, 3]), np.array([1, 2, 0, 3, 2])
    loops = chain_loops(starts, stops)
    edges = sorted(pair for loop in loops for pair in zip(loop, np.roll(loop, -1), strict=True))
    assert edges == sorted(zip(starts, stops, strict=True))


def test_edges_that_do_not_close_make_no_loop():
    assert chain_loops(np.array([0, 1]), np.array([1, 2])) == []
