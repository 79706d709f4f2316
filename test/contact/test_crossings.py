"""Claims about surfaces that cross themselves."""

import numpy as np
import pytest

from finforce_contact.mesh.repair import crosses_itself

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def two(shift, turn=1.0):
    """Two tetrahedra of 1 m, the second turned and shifted [m], as one surface scaled to centimetres."""
    vertices = np.concatenate([TETRAHEDRON, TETRAHEDRON * turn + shift])
    return 0.01 * vertices, np.concatenate([FACES, FACES + 4])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("shift", "crosses"), [(0.3, True), (0.9, True), (1.1, False), (-2.0, False)])
def test_what_runs_through_each_other_crosses(axis, shift, crosses):
    way = np.full(3, 0.03)
    way[axis] = shift
    # whichever of the axes the surface is longest along
    assert crosses_itself(*two(way)) is crosses


def test_neighbours_in_a_closed_surface_do_not_cross():
    assert not crosses_itself(TETRAHEDRON, FACES)


def test_what_only_touches_does_not_cross():
    mirrored = np.array([-1.0, 1.0, 1.0])
    assert not crosses_itself(*two(np.zeros(3), mirrored))
    assert not crosses_itself(*two(np.array([1.0, 0.0, 0.0])))


def test_crumpled_surfaces_are_told_from_whole_ones_as_open3d_does():
    open3d = pytest.importorskip("open3d")
    sphere = open3d.geometry.TriangleMesh.create_sphere(0.03, 8)
    vertices, triangles = np.asarray(sphere.vertices), np.asarray(sphere.triangles)
    random, seen = np.random.default_rng(0), set()
    for size in np.repeat([1e-5, 1e-3, 3e-3, 6e-3], 5):
        moved = vertices + size * random.standard_normal(vertices.shape)
        sphere.vertices = open3d.utility.Vector3dVector(moved)
        expected = sphere.is_self_intersecting()
        assert crosses_itself(moved, triangles) is expected
        seen.add(expected)
    assert seen == {True, False}
