"""Objects, jaws and rendered scenes for tests of contact."""

from dataclasses import dataclass
from functools import lru_cache

import manifold3d
import numpy as np
from chamfer_fakes import compute_chamfer
from guess_fakes import GuessError, draw_guess, place_mesh
from scipy.spatial.transform import Rotation
from table_fakes import build_d405, draw_scene

from finforce_contact.mesh.object_mesh import ObjectMesh, prepare_object_mesh
from finforce_contact.reconstruction.evidence import collect_evidence
from finforce_ifea.jaw.jaw import load_jaw
from finforce_sim.objects import build_object

JAW = load_jaw("bench")
FACE = JAW.inner_face_x


def cylinder(radius=0.0125, length=0.06, around=96):
    """A closed cylinder about y."""
    angle = 2.0 * np.pi * np.arange(around) / around
    ring = np.stack([radius * np.cos(angle), np.full(around, -0.5 * length), radius * np.sin(angle)], axis=1)
    a, b = np.arange(around), (np.arange(around) + 1) % around
    sides = np.stack([a, a + around, b, b, a + around, b + around], axis=1).reshape(-1, 3)
    low = np.stack([a, b, np.full(around, 2 * around)], axis=1)
    high = np.stack([b, a, np.full(around, 2 * around + 1)], axis=1) + [around, around, 0]
    vertices = np.vstack([ring, ring + [0, length, 0], [[0, -0.5 * length, 0], [0, 0.5 * length, 0]]])
    return ObjectMesh(
        vertices=vertices,
        triangles=np.concatenate([sides, low, high]).astype(np.int32),
        watertight=True,
        name="cylinder",
    )


def box(size=(0.03, 0.03, 0.03), centre=(0.0, 0.0, 0.0)):
    """A closed box."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [(q[0], q[1], q[2]) for q in quads] + [(q[0], q[2], q[3]) for q in quads]
    return ObjectMesh(
        vertices=corners * size + centre, triangles=np.array(triangles, np.int32), watertight=True, name="box"
    )


def joined(*meshes):
    """Several meshes as one object."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    triangles = np.concatenate([mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    return ObjectMesh(vertices=vertices, triangles=triangles.astype(np.int32), watertight=True, name="joined")


def opened(mesh):
    """The mesh without some triangles at its ends, where it is far from the jaw."""
    return ObjectMesh(
        vertices=mesh.vertices,
        triangles=mesh.triangles[: int(0.9 * len(mesh.triangles))],
        watertight=False,
        name="open",
    )


def pose(x, z, y=0.0, tilt=0.0):
    """T_jaw_object, turned by tilt [rad] from x to z."""
    T = np.eye(4)
    c, s = np.cos(tilt), np.sin(tilt)
    T[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    T[:3, 3] = x, y, z
    return T


def bent(nodes, depth, height, reach=0.01):
    """Vertices of a jaw that has given way by `depth` at `height`."""
    surface = nodes.copy()
    surface[:, 0] -= depth * np.exp(-(((nodes[:, 2] - height) / reach) ** 2))
    return surface


def wrapped(nodes, radius, x, z):
    """Vertices of a jaw whose inner face lies on a cylinder where it would be in it."""
    surface = nodes.copy()
    room = radius**2 - (nodes[:, 2] - z) ** 2
    front = np.where(room > 0.0, x - np.sqrt(np.maximum(room, 0.0)), np.inf)
    surface[:, 0] -= np.maximum(FACE - front, 0.0)
    return surface


@dataclass(frozen=True)
class Case:
    """An image of an object, what it says, and a generated mesh that is 14 mm off."""

    scene: object
    evidence: object
    guess: object


@lru_cache(maxsize=16)
def make_case(name, seed=0, hidden=0.0, stretch=0.0):
    """Return the case of an object at a quarter of the camera's pixels."""
    rng = np.random.default_rng(seed)
    scene = draw_scene(build_object(name), build_d405(step=2), rng, hidden=hidden)
    guess = draw_guess(scene, rng, 14e-3, GuessError(stretch=stretch))
    return Case(scene, collect_evidence(scene.depth, scene.mask, scene.camera), guess)


def distance_mm(case, mesh, affine):
    """Return the mean Chamfer distance of a placed mesh from the truth [mm]."""
    truth = place_mesh(case.scene.mesh, case.scene.T_camera_object)
    return 1e3 * compute_chamfer(place_mesh(mesh, affine), truth, count=4000).mean


def bare_mesh(vertices, triangles):
    """Return a mesh as it is."""
    return ObjectMesh(vertices=vertices, triangles=triangles, watertight=False, name="bare")


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
