"""Objects that are hard to hold: grazing, flat, sharp, tiny, huge, thin, open."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce_contact.mesh.triangles import ObjectMesh

AROUND = 96
LENGTH = 0.06


@dataclass(frozen=True, kw_only=True, eq=False)
class HardScene:
    """An object and where it presses.

    Attributes:
        name: of the scene.
        mesh: of the object.
        height: of its origin along the jaw [m].
        tilt: its turn from x to z [rad].
        depth: of the press below the undeformed surface [m]; negative: it stays away.
        across: of its origin along the width [m].
        is_impossible: whether no press is like this: the jaw stays at rest, whatever the poses say.
    """

    name: str
    mesh: ObjectMesh
    height: float = 0.04
    tilt: float = 0.0
    depth: float = 3e-3
    across: float = 0.0
    is_impossible: bool = False


def build_prism(section: NDArray, length: float = LENGTH) -> ObjectMesh:
    """Returns the closed prism along y over a convex section (n, 2) of x and z [m], counterclockwise from x to z."""
    count = len(section)
    ring = np.stack([section[:, 0], np.full(count, -0.5 * length), section[:, 1]], axis=1)
    a, b = np.arange(count), (np.arange(count) + 1) % count
    sides = np.stack([a, a + count, b, b, a + count, b + count], axis=1).reshape(-1, 3)
    low = np.stack([a, b, np.full(count, 2 * count)], axis=1)
    high = np.stack([b, a, np.full(count, 2 * count + 1)], axis=1) + [count, count, 0]
    middle = section.mean(axis=0)
    ends = [[middle[0], y, middle[1]] for y in (-0.5 * length, 0.5 * length)]
    vertices = np.vstack([ring, ring + [0.0, length, 0.0], ends])
    triangles = np.concatenate([sides, low, high]).astype(np.int32)
    return ObjectMesh(vertices=vertices, triangles=triangles, watertight=True, name="prism")


def circle(radius: float) -> NDArray:
    """Returns a round section (n, 2) [m]."""
    angles = 2.0 * np.pi * np.arange(AROUND) / AROUND
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def rectangle(size_x: float, size_z: float) -> NDArray:
    """Returns a rectangular section (4, 2) [m]."""
    return 0.5 * np.array([[-size_x, -size_z], [size_x, -size_z], [size_x, size_z], [-size_x, size_z]])


def leave_open(mesh: ObjectMesh) -> ObjectMesh:
    """Returns a mesh without some triangles of its ends."""
    kept = mesh.triangles[: int(0.9 * len(mesh.triangles))]
    return ObjectMesh(vertices=mesh.vertices, triangles=kept, watertight=False, name="open prism")


def in_single_precision(mesh: ObjectMesh) -> ObjectMesh:
    """Returns a mesh with vertices in single precision."""
    return replace(mesh, vertices=mesh.vertices.astype(np.float32))


def build_scenes() -> tuple[HardScene, ...]:
    """Returns the scenes."""
    rod, bar = build_prism(circle(0.0125)), build_prism(rectangle(0.03, 0.03))
    return (
        HardScene(name="rod", mesh=rod),
        HardScene(name="rod, single precision", mesh=in_single_precision(rod)),
        HardScene(name="rod near the base", mesh=rod, height=0.018),
        HardScene(name="rod near the tip", mesh=rod, height=0.066),
        HardScene(name="rod grazing by 0.05 mm", mesh=rod, depth=5e-5),
        HardScene(name="rod grazing by 0.2 mm", mesh=rod, depth=2e-4),
        HardScene(name="rod 0.3 mm away", mesh=rod, depth=-3e-4),
        HardScene(name="rod far away", mesh=rod, depth=-3e-2),
        HardScene(name="coplanar face", mesh=bar, depth=2e-4),
        HardScene(name="coplanar face, deeper", mesh=bar, depth=3e-3),
        HardScene(name="wall along the jaw", mesh=build_prism(rectangle(0.03, 0.2)), depth=1e-4),
        HardScene(name="edge", mesh=bar, tilt=np.pi / 4),
        HardScene(name="edge of a leaning bar", mesh=bar, tilt=0.12),
        HardScene(name="bar over the tip", mesh=bar, height=0.085, depth=1e-3),
        HardScene(name="wire of 0.5 mm", mesh=build_prism(circle(0.25e-3)), depth=1e-3, is_impossible=True),
        HardScene(name="wire of 2 mm", mesh=build_prism(circle(1e-3)), depth=2e-3),
        HardScene(name="drum of 1 m", mesh=build_prism(circle(0.5)), depth=5e-4),
        HardScene(name="block of 1 m", mesh=build_prism(rectangle(1.0, 1.0)), depth=5e-5),
        HardScene(name="plate of 1 mm, edge on", mesh=build_prism(rectangle(0.03, 1e-3)), depth=2e-3),
        HardScene(
            name="plate of 0.3 mm, edge on", mesh=build_prism(rectangle(0.03, 3e-4)), depth=2e-3, is_impossible=True
        ),
        HardScene(name="plate of 1 mm, face on", mesh=build_prism(rectangle(1e-3, 0.03)), depth=2e-3),
        HardScene(
            name="plate of 0.3 mm, face on", mesh=build_prism(rectangle(3e-4, 0.03)), depth=2e-3, is_impossible=True
        ),
        HardScene(name="open rod", mesh=leave_open(rod)),
        HardScene(name="open bar", mesh=leave_open(bar), depth=2e-4),
        HardScene(name="engulfing", mesh=build_prism(rectangle(0.2, 0.2), 0.2), depth=0.11, is_impossible=True),
        HardScene(name="beyond the tip", mesh=rod, height=0.2, is_impossible=True),
    )
