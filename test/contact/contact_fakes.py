"""Objects made for tests, their sizes known; truths come from these sizes, not from the code under test."""

from functools import lru_cache

import manifold3d
import numpy as np
from scipy.spatial.transform import Rotation

from finforce_contact.mesh.object_mesh import prepare_object_mesh
from finforce_contact.mesh.triangles import ObjectMesh


def revolve(profile, facets=256):
    """Triangles of a profile (k, 2) of radius and height, turned about z; outward where it runs upward outside."""
    angles = 2.0 * np.pi * np.arange(facets) / facets
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    radius, height = np.asarray(profile, dtype=float).T
    plane = radius[:, None, None] * around
    vertices = np.concatenate([plane, np.broadcast_to(height[:, None, None], (len(height), facets, 1))], axis=2)
    low, step = np.meshgrid(np.arange(len(height) - 1) * facets, np.arange(facets), indexing="ij")
    here, there = low + step, low + (step + 1) % facets
    quads = np.stack([here, there, there + facets, here, there + facets, here + facets], axis=-1)
    return vertices.reshape(-1, 3), quads.reshape(-1, 3)


def cylinder_triangles(radius=0.03, height=0.08, facets=256):
    """A closed cylinder about z with its middle in the origin."""
    half = 0.5 * height
    return revolve([(0.0, -half), (radius, -half), (radius, half), (0.0, half)], facets)


def tube_triangles(radius=0.03, height=0.08, facets=256):
    """The wall of that cylinder, without lids."""
    return revolve([(radius, -0.5 * height), (radius, 0.5 * height)], facets)


def sphere_triangles(radius=0.03, rings=64, facets=128):
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, rings + 1)
    return revolve(radius * np.stack([np.cos(angles), np.sin(angles)], axis=1), facets)


def box_triangles(size, centre=(0.0, 0.0, 0.0)):
    mesh = manifold3d.Manifold.cube(list(size), True).translate(list(centre)).to_mesh64()
    return np.array(mesh.vert_properties), np.array(mesh.tri_verts, dtype=int)


def mug_triangles():
    """A cup about z of radius 35 mm and height 90 mm with a ring (12 and 20 mm) in the x-z plane about x = 45 mm."""
    make = manifold3d.Manifold
    cup = make.cylinder(0.09, 0.035, circular_segments=128).translate([0.0, 0.0, -0.045])
    inside = make.cylinder(0.09, 0.032, circular_segments=128).translate([0.0, 0.0, -0.041])
    ring = make.cylinder(0.008, 0.02, circular_segments=128, center=True)
    ring -= make.cylinder(0.01, 0.012, circular_segments=128, center=True)
    mesh = (cup + ring.rotate([90.0, 0.0, 0.0]).translate([0.045, 0.0, 0.0]) - inside).to_mesh64()
    return np.array(mesh.vert_properties), np.array(mesh.tri_verts, dtype=int)


def join(*parts):
    """Several meshes as one."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    triangles = [triangles + start for (_, triangles), start in zip(parts, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(triangles)


def pierce(vertices, triangles, place, radius):
    """The mesh without its triangles around a place (3,)."""
    middle = vertices[triangles].mean(axis=1)
    return vertices, triangles[np.linalg.norm(middle - place, axis=1) > radius]


def flip(vertices, triangles):
    return vertices, triangles[:, ::-1]


@lru_cache
def build_cylinder(**sizes) -> ObjectMesh:
    return prepare_object_mesh(*cylinder_triangles(**sizes), name="cylinder")


@lru_cache
def build_sphere(radius=0.03) -> ObjectMesh:
    return prepare_object_mesh(*sphere_triangles(radius), name="sphere")


@lru_cache
def build_box(size=(0.04, 0.08, 0.06)) -> ObjectMesh:
    return prepare_object_mesh(*box_triangles(size), name="box")


@lru_cache
def build_mug() -> ObjectMesh:
    return prepare_object_mesh(*mug_triangles(), name="mug")


def turn_about(axis, angle):
    """The rotation (3, 3) by an angle [deg] about "x", "y" or "z"."""
    return Rotation.from_euler(axis, angle, degrees=True).as_matrix()


def signed_area(polygon):
    """[m^2], positive where the polygon (n, 2) runs from its first axis to its second."""
    x, z = np.asarray(polygon).T
    return 0.5 * (np.dot(x, np.roll(z, -1)) - np.dot(z, np.roll(x, -1)))


def outline_distance(polygons, others):
    """The largest distance [m] between two outlines, from points every 0.2 mm of each to the lines of the other."""
    return max(_one_way(polygons, others), _one_way(others, polygons))


def _one_way(polygons, others):
    starts = np.concatenate(others)
    sides = np.concatenate([np.roll(polygon, -1, axis=0) for polygon in others]) - starts
    away = np.concatenate([_sample(polygon) for polygon in polygons])[:, None] - starts
    share = np.clip((away * sides).sum(axis=2) / np.maximum((sides**2).sum(axis=1), 1e-30), 0.0, 1.0)
    return np.linalg.norm(away - share[..., None] * sides, axis=2).min(axis=1).max()


def _sample(polygon, step=2e-4):
    ends = np.roll(polygon, -1, axis=0)
    counts = np.ceil(np.linalg.norm(ends - polygon, axis=1) / step).astype(int) + 1
    return np.concatenate([np.linspace(*pair) for pair in zip(polygon, ends, counts, strict=True)])
