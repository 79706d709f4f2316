"""The bodies of a gripper before its camera: jaws, their holders, palm and object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce_contact.mesh.triangles import ObjectMesh
from finforce_ifea.jaw.jaw import Jaw
from finforce_sim.rendering.lighting import Paint, draw_color, draw_jaw_paint, draw_paint
from finforce_sim.rendering.render import Body, Decal

# Boxes (low, high) [m]: the holder in the jaw frame, flush with the jaw's sides, and the palm in the gripper frame.
HOLDER = np.array([[-0.017, -0.010, -0.022], [0.017, 0.010, 0.0]])
PALM = np.array([[-0.080, -0.030, -0.070], [0.080, 0.022, -0.022]])
DOT_RADII = (1.5e-3, 2.3e-3)
OCCLUDER_CHANCE = 0.15
_BOX = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]], dtype=float)
_BOX_TRIANGLES = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6]]
    + [[1, 3, 5], [3, 7, 5]]
)


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnJaw:
    """A jaw as it is drawn: the jaw itself, its vertices (n, 3) [m] at rest and its triangles (m, 3)."""

    jaw: Jaw
    rest: NDArray
    triangles: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Wardrobe:
    """The materials of a gripper and its object, the same in all its images."""

    jaw: Paint
    holder: Paint
    palm: Paint
    thing: Paint
    occluder: Paint
    dot_color: NDArray
    dot_radius: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Wardrobe:
        """Return materials by chance; the dot stands out from its holder."""
        holder = draw_paint(rng, ("plain", "noise"))
        holder = replace(holder, color=draw_color(rng, 0.02, 0.7), gloss=0.3)
        # a dot of the holder's brightness would be no mark
        bright = float(np.maximum(holder.color, holder.second).mean()) < 0.2
        dot = draw_color(rng, 0.7, 0.95) ** 0.3 if bright else draw_color(rng, 0.01, 0.02)
        return cls(
            jaw=draw_jaw_paint(rng),
            holder=holder,
            palm=draw_paint(rng, ("plain", "noise")),
            thing=draw_paint(rng),
            occluder=draw_paint(rng),
            dot_color=dot,
            dot_radius=float(rng.uniform(*DOT_RADII)),
        )


def dress_jaw(shape: DrawnJaw, vertices: NDArray, T_camera_jaw: NDArray, wardrobe: Wardrobe) -> list[Body]:
    """Return a jaw with deformed vertices (n, 3) [m], jaw frame, and its holder with the reference dot."""
    dot = Decal(place=shape.jaw.reference_point, radius=wardrobe.dot_radius, color=wardrobe.dot_color)
    # a finger whose clamped part is in view carries the dot itself
    own = (dot,) if shape.jaw.reference_point[2] > 0.0 else ()
    moved = _move(vertices, T_camera_jaw)
    jaw = Body(vertices=moved, triangles=shape.triangles, rest=shape.rest, paint=wardrobe.jaw, decals=own)
    holder = HOLDER.copy()
    if own:
        # the holder is as wide as the finger that stands in it
        low, high = shape.rest.min(axis=0), shape.rest.max(axis=0)
        holder[:, :2] = np.stack((low[:2], high[:2]))
    return [jaw, build_box(holder, T_camera_jaw, wardrobe.holder, () if own else (dot,))]


def dress_palm(T_camera_gripper: NDArray, wardrobe: Wardrobe) -> Body:
    """Return the palm, behind the holders."""
    return build_box(PALM, T_camera_gripper, wardrobe.palm)


def dress_object(mesh: ObjectMesh, T_camera_object: NDArray, wardrobe: Wardrobe) -> Body:
    """Return the object."""
    return Body(
        vertices=_move(mesh.vertices, T_camera_object),
        triangles=mesh.triangles,
        rest=mesh.vertices,
        paint=wardrobe.thing,
    )


def draw_occluders(T_camera_gripper: NDArray, wardrobe: Wardrobe, rng: np.random.Generator) -> list[Body]:
    """Return, now and then, a bar somewhere between camera and jaws."""
    if rng.random() > OCCLUDER_CHANCE:
        return []
    size = rng.uniform((0.004, 0.004, 0.004), (0.05, 0.01, 0.05))
    low = rng.uniform((-0.06, 0.02, 0.0), (0.06, 0.04, 0.08))
    return [build_box(np.stack((low, low + size)), T_camera_gripper, wardrobe.occluder)]


def build_box(bounds: NDArray, T: NDArray, paint: Paint, decals: tuple[Decal, ...] = ()) -> Body:
    """Return a box of bounds (2, 3) [m] in a frame at T (4, 4)."""
    rest = bounds[0] + _BOX * (bounds[1] - bounds[0])
    return Body(vertices=_move(rest, T), triangles=_BOX_TRIANGLES, rest=rest, paint=paint, decals=decals)


def _move(points: NDArray, T: NDArray) -> NDArray:
    return points @ T[:3, :3].T + T[:3, 3]


def draw_jaws(jaws: Mapping[str, Jaw], density: str) -> dict[str, DrawnJaw]:
    """Return the shapes of jaws by side, of meshes with a density."""
    shapes = {}
    for side, jaw in jaws.items():
        mesh = jaw.build_mesh(density)
        shapes[side] = DrawnJaw(jaw=jaw, rest=mesh.nodes, triangles=mesh.surface)
    return shapes
