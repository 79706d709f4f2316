"""Objects and bent jaws made for tests of the contact place."""

import numpy as np

from finforce_contact.mesh.triangles import ObjectMesh
from finforce_ifea.jaw.jaw import load_jaw

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
