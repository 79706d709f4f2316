"""Objects made from a few numbers, watertight, in metres, and how they lie between the jaws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce.optional import import_manifold3d
from finforce_contact.errors import ObjectMeshError
from finforce_contact.mesh.object_mesh import FORMATS, ObjectMesh, load_object_mesh
from finforce_sim.scenarios import Scenario

SEGMENTS = 96  # around a full turn: the chords stay within 0.02 mm of a circle of 40 mm radius
MILLIMETRE = 1e-3


def build_object(name: str) -> ObjectMesh:
    """Return an object by its name, one of `OBJECT_NAMES` or a smaller one.

    Raises:
        ObjectMeshError: there is none of this name.
        MissingDependencyError: manifold3d is not installed.
    """
    builders = BUILDERS | SMALL_BUILDERS
    if name not in builders:
        raise ObjectMeshError(f"object '{name}': expected one of {', '.join(builders)}")
    shape = builders[name](import_manifold3d()).to_mesh()
    vertices = np.array(shape.vert_properties[:, :3], dtype=float) * MILLIMETRE
    triangles = np.array(shape.tri_verts, dtype=np.int32)
    return ObjectMesh(vertices=vertices, triangles=triangles, watertight=True, name=name)


def _build_asymmetric(kernel):
    """A leaning block with a shoulder on one side and a round boss on top; no turn maps it onto itself."""
    corners = np.array([[-30, -20], [25, -20], [25, 8], [5, 22], [-30, 22]], dtype=float)
    block = kernel.Manifold.extrude(_section(kernel, corners), 62.0, scale_top=(0.72, 0.85))
    boss = kernel.Manifold.cylinder(30.0, 15.0, 12.0, circular_segments=SEGMENTS).translate((-6.0, 2.0, 60.0))
    shoulder = kernel.Manifold.cube((22.0, 26.0, 24.0)).translate((16.0, -18.0, 0.0))
    return (block + boss + shoulder).translate((0.0, 0.0, -45.0))


def _build_bottle(kernel):
    """A bottle of 60 mm diameter, 120 mm high, with a round shoulder and a neck with a cap; solid."""
    angles = np.linspace(0.0, 0.5 * np.pi, 16)
    foot = np.column_stack((26.0 + 4.0 * np.sin(angles), 4.0 - 4.0 * np.cos(angles)))
    shoulder = np.column_stack((14.0 + 16.0 * np.cos(angles), 70.0 + 24.0 * np.sin(angles)))
    neck = np.array([[12.0, 95.0], [12.0, 104.0], [14.0, 104.0], [14.0, 119.0], [13.0, 120.0], [0.0, 120.0]])
    profile = np.vstack(([[0.0, 0.0]], foot, shoulder, neck))
    return _revolve(kernel, profile).translate((0.0, 0.0, -60.0))


def _build_mug(kernel):
    """A mug of 76 mm diameter, 85 mm high, with walls of 4 mm and a handle at +x."""
    angles = np.linspace(0.0, 0.5 * np.pi, 12)
    foot = np.column_stack((33.0 + 5.0 * np.sin(angles), 5.0 - 5.0 * np.cos(angles)))
    inside = np.column_stack((29.0 + 5.0 * np.sin(angles), 11.0 - 5.0 * np.cos(angles)))[::-1]
    rim = np.array([[38.0, 84.0], [37.0, 85.0], [35.0, 85.0], [34.0, 84.0]])
    outer = np.vstack(([[0.0, 0.0]], foot, rim, inside, [[0.0, 6.0]]))
    solid = np.vstack(([[0.0, 0.0]], foot, rim[:2], [[0.0, 85.0]]))
    handle = _build_ring(kernel, radius=21.0, thickness=5.0).translate((38.0, 0.0, 44.0))
    body = _revolve(kernel, outer) + (handle - _revolve(kernel, solid))
    return body.translate((0.0, 0.0, -42.5))


def _build_rod(kernel, diameter: float):
    """A cylinder 60 mm long, as those of the bench."""
    rod = kernel.Manifold.cylinder(60.0, 0.5 * diameter, circular_segments=SEGMENTS, center=True)
    return rod.rotate((90.0, 0.0, 0.0))


def _build_block(kernel):
    """A block 24 mm wide, 60 mm long and 30 mm high, its edges rounded by 2 mm."""
    core = kernel.CrossSection.square((20.0, 26.0), center=True)
    section = core.offset(2.0, kernel.JoinType.Round, 2.0, SEGMENTS)
    return kernel.Manifold.extrude(section, 60.0).translate((0.0, 0.0, -30.0)).rotate((90.0, 0.0, 0.0))


def _build_wedge(kernel):
    """A leaning block up to 28 mm wide with a shoulder at +x and a boss at one end; no turn maps it onto itself."""
    corners = np.array([[-13, -16], [9, -16], [15, -6], [11, 12], [4, 17], [-11, 17]], dtype=float)
    block = kernel.Manifold.extrude(_section(kernel, corners), 44.0, scale_top=(0.9, 0.85))
    boss = kernel.Manifold.cylinder(14.0, 8.0, 6.0, circular_segments=SEGMENTS).translate((-2.0, 3.0, 43.0))
    return (block + boss).translate((0.0, 0.0, -26.0)).rotate((90.0, 0.0, 0.0))


def _build_ring(kernel, *, radius: float, thickness: float):
    """A torus in the x-z plane, one and a half times as broad as thick."""
    angles = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    section = np.column_stack((radius + thickness * np.cos(angles), 1.5 * thickness * np.sin(angles)))
    return _revolve(kernel, section).rotate((90.0, 0.0, 0.0))


def _section(kernel, outline: NDArray):
    """Return the area inside a closed outline (n, 2), whichever way round it runs."""
    return kernel.CrossSection([outline], kernel.FillRule.EvenOdd)


def _revolve(kernel, profile: NDArray):
    """Turn a closed profile (n, 2), radius and height, about the z axis."""
    return kernel.Manifold.revolve(_section(kernel, profile), SEGMENTS)


BUILDERS: dict[str, Callable] = {
    "cylinder": lambda kernel: kernel.Manifold.cylinder(100.0, 25.0, circular_segments=SEGMENTS, center=True),
    "cube": lambda kernel: kernel.Manifold.cube((60.0, 60.0, 60.0), center=True),
    "asymmetric": _build_asymmetric,
    "mug": _build_mug,
    "bottle": _build_bottle,
}
SMALL_BUILDERS: dict[str, Callable] = {
    "rod15": partial(_build_rod, diameter=15.0),
    "rod25": partial(_build_rod, diameter=25.0),
    "rod35": partial(_build_rod, diameter=35.0),
    "block": _build_block,
    "wedge": _build_wedge,
}
OBJECT_NAMES = tuple(BUILDERS)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedObject:
    """An object that is turned about the middle of its bounding box.

    Attributes:
        mesh: in its own frame.
        centred: turned to the axes of `gripper_base`, the middle of its bounding box at the origin.
        R_gripper_object: (3, 3) by which it is turned.
        middle: of the bounding box, in the object's own frame (3,) [m].
    """

    mesh: ObjectMesh
    centred: ObjectMesh
    R_gripper_object: NDArray
    middle: NDArray

    def pose_at(self, position: NDArray, tilt: float) -> NDArray:
        """Return T_gripper_object (4, 4) with the middle at a position (3,) [m], tilted from x to z [rad]."""
        T = np.eye(4)
        # the right-hand rule about y turns z to x
        T[:3, :3] = Rotation.from_rotvec([0.0, -tilt, 0.0]).as_matrix() @ self.R_gripper_object
        T[:3, 3] = position - T[:3, :3] @ self.middle
        return T


def place_object(scenario: Scenario) -> PlacedObject:
    """Return a scenario's object, scaled and turned.

    Raises:
        ObjectMeshError: There is no such object, or the file holds none.
        MissingDependencyError: A library that builds or reads it is not installed.
    """
    if scenario.object.lower().endswith(FORMATS):
        mesh = load_object_mesh(scenario.object, unit=scenario.unit)
    else:
        mesh = build_object(scenario.object)
    mesh = replace(mesh, vertices=scenario.scale * mesh.vertices)
    R = Rotation.from_euler("xyz", [scenario.turn_x, scenario.turn_y, scenario.turn_z]).as_matrix()
    turned = mesh.vertices @ R.T
    middle = 0.5 * (turned.min(0) + turned.max(0))
    centred = replace(mesh, vertices=turned - middle)
    return PlacedObject(mesh=mesh, centred=centred, R_gripper_object=R, middle=R.T @ middle)
