"""Claims about the penalty contact of surface points with rigid objects."""

import numpy as np
import pytest
from box_fakes import RigidBox, press_box

from finforce_ifea.contact_mechanics.indenter import RoundIndenter
from lab.presses import RigidCylinder

STIFFNESS = 1e4
CENTRE, RADIUS = (0.020, 0.040), 0.010
HALF, EDGE = (0.006, 0.010), 0.002
SMOOTH = 2e-5


def cylinder(points, radius=RADIUS):
    """A cylinder whose nearest point to the jaw stays as its radius grows."""
    place = np.array([0.0, radius, CENTRE[1]])
    return RoundIndenter().press(points, np.full(len(points), STIFFNESS), CENTRE[0] - RADIUS, place)


def box(points):
    return press_box(points, np.full(len(points), STIFFNESS), CENTRE, HALF, EDGE)


def around(seed=0, count=60):
    """Points in and about the objects, off the edges of their regions."""
    random = np.random.default_rng(seed)
    return np.array([CENTRE[0], 0.0, CENTRE[1]]) + random.uniform(-1, 1, (count, 3)) * [0.011, 0.01, 0.011]


def on_cylinder(depth, angle):
    """A point `depth` below the surface of the cylinder."""
    away = np.array([np.cos(angle), 0.0, np.sin(angle)])
    return np.array([CENTRE[0], 0.003, CENTRE[1]]) + (RADIUS - depth) * away, away


@pytest.mark.parametrize("angle", np.linspace(0.1, 6.2, 7))
def test_cylinder_pushes_from_its_axis_in_proportion_to_the_depth(angle):
    point, away = on_cylinder(5e-4, angle)
    force = cylinder(point[None]).forces[0]
    # the smooth start costs half its length
    np.testing.assert_allclose(force, STIFFNESS * (5e-4 - 0.5 * SMOOTH) * away, atol=1e-9)


def test_nothing_outside_is_pushed():
    point, _ = on_cylinder(-1e-9, 0.7)
    contact = cylinder(point[None])
    for part in (contact.forces, contact.springs, contact.changes):
        assert not part.any()
    outside = np.array([CENTRE[0] + HALF[0] + 1e-9, 0.0, CENTRE[1]])
    assert not box(outside[None]).forces.any()


@pytest.mark.parametrize("depth", [0.0, SMOOTH])
def test_force_and_spring_are_continuous_where_contact_begins_and_where_it_turns_linear(depth):
    points = np.array([on_cylinder(depth + shift, 0.7)[0] for shift in (-1e-11, 1e-11)])
    contact = cylinder(points)
    assert np.abs(np.diff(contact.forces, axis=0)).max() < 1e-6
    assert np.abs(np.diff(contact.springs, axis=0)).max() < 1e-5 * STIFFNESS


@pytest.mark.parametrize("press", [cylinder, box])
def test_springs_are_the_negative_derivatives_of_the_forces(press):
    points, h = around(), 1e-9
    contact = press(points)
    assert (np.abs(contact.forces).max(1) > 0).sum() > 10
    for axis in range(3):
        step = h * np.eye(3)[axis]
        change = (press(points + step).forces - press(points - step).forces) / (2 * h)
        np.testing.assert_allclose(-contact.springs[:, :, axis], change, atol=1e-5 * STIFFNESS)


def test_force_derivative_by_the_radius():
    points, h = around(), 1e-9
    change = (cylinder(points, RADIUS + h).forces - cylinder(points, RADIUS - h).forces) / (2 * h)
    np.testing.assert_allclose(cylinder(points).changes[:, :, 1], change, atol=1e-5 * STIFFNESS)


@pytest.mark.parametrize(
    ("place", "direction"),
    [
        ((-HALF[0] + 1e-4, 0.0), (-1, 0)),
        ((HALF[0] - 1e-4, 0.003), (1, 0)),
        ((0.001, HALF[1] - 1e-4), (0, 1)),
        ((0.001, -HALF[1] + 1e-4), (0, -1)),
        ((-HALF[0] + EDGE * (1 - np.sqrt(0.5)) + 1e-5, HALF[1] - EDGE * (1 - np.sqrt(0.5)) - 1e-5), (-1, 1)),
    ],
)
def test_box_pushes_out_of_its_nearest_face_and_of_its_rounded_edges(place, direction):
    force = box(np.array([[CENTRE[0] + place[0], 0.0, CENTRE[1] + place[1]]])).forces[0]
    np.testing.assert_allclose(
        force[[0, 2]] / np.linalg.norm(force), np.array(direction) / np.linalg.norm(direction), atol=1e-9
    )


def test_corner_of_a_box_is_rounded():
    """The corner of the box without rounding lies outside of it."""
    corner = np.array([[CENTRE[0] - HALF[0] + 1e-4, 0.0, CENTRE[1] - HALF[1] + 1e-4]])
    assert not box(corner).forces.any()


def test_objects_reach_their_depth_below_the_face():
    face, depth, height = 0.014, 1e-3, 0.040
    ahead = np.array([[face - depth + shift, 0.0, height] for shift in (-1e-6, 1e-6)])
    for rigid in (RigidCylinder(radius=0.0125), RigidBox(size_x=0.02, size_z=0.03, edge_radius=0.002)):
        forces = rigid.press(ahead, np.full(2, STIFFNESS), face, depth, height).forces
        assert not forces[0].any()
        assert forces[1, 0] < 0
