"""Turns that map an object onto itself: trackers take them for each other, and a pose flips from image to image."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from finforce.transforms import rotation_between
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import sample_surface
from finforce_ifea.errors import ContactError

AUTO, NONE, FULL = "auto", "none", "full"
AXES = {"x": 0, "y": 1, "z": 2}
# A pose that is turned by less than this from the last one has not flipped [rad].
_FLIPPED = 0.6
# Turns that no polygon of a mesh shares, by which a round thing is known, and folds that are looked for [-].
_ODD_TURNS = np.radians([37.0, 71.0, 113.0])
_FOLDS = (6, 5, 4, 3, 2)
_TURNED = 400  # surface points that are turned
_SAMPLES = 8000  # surface points that they are compared with
_SHARE = 0.95  # [-], fraction that must agree; edges of a mesh do not
_OFF = 0.01  # [-], largest distance of points that agree, over the object's size
_MOST = 60  # turns of an icosahedron: no object has more but for round ones


@dataclass(frozen=True, kw_only=True, eq=False)
class Symmetry:
    """The turns of an object about axes of its mesh's frame, through the middle of its bounding box.

    Attributes:
        turns: (n, 3, 3), the first of which is none.
        axis: unit vector (3,) about which every turn is one of them; None without.
        middle: of the bounding box (3,) [m].
    """

    turns: NDArray
    axis: NDArray | None
    middle: NDArray

    def choose(self, T: NDArray, T_last: NDArray) -> NDArray:
        """Return the pose (4, 4) for T after the last one: what looks like it, where it seems to have flipped."""
        has_none = len(self.turns) == 1 and self.axis is None
        return T if has_none or rotation_between(T, T_last) < _FLIPPED else self.nearest(T, T_last)

    def nearest(self, T: NDArray, T_last: NDArray) -> NDArray:
        """Return the pose (4, 4) that looks as T does and is turned least from another one."""
        alike = [self._turn(T, turn) for turn in self.turns]
        if self.axis is not None:
            alike = [self._turn(one, self._unwind(one, T_last)) for one in alike]
        return min(alike, key=lambda one: rotation_between(one, T_last))

    def _turn(self, T: NDArray, turn: NDArray) -> NDArray:
        """Return the pose of an object that is turned (3, 3) about its middle before it is placed."""
        turned = T.copy()
        turned[:3, :3] = T[:3, :3] @ turn
        turned[:3, 3] += T[:3, :3] @ (self.middle - turn @ self.middle)
        return turned

    def _unwind(self, T: NDArray, T_last: NDArray) -> NDArray:
        """Return the turn (3, 3) about the axis that brings a pose nearest to the last one."""
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.from_matrix(T[:3, :3].T @ T_last[:3, :3]).as_quat()
        twist = 2.0 * np.arctan2(np.array([x, y, z]) @ self.axis, w)
        return Rotation.from_rotvec(twist * self.axis).as_matrix()


def read_symmetry(text: str, mesh: ObjectMesh) -> Symmetry:
    """Return the symmetry that a text says of an object.

    Args:
        text: `auto`, `none`, or words as `x_180`, `y_90` and `z_full`, as isaac_ros_foundationpose has them.
        mesh: the object.

    Raises:
        ContactError: the text is none of these.
    """
    words = parse_symmetry(text)
    names = find_symmetries(mesh) if words is None else words
    axes = [name[0] for name in names if name.endswith(FULL)]
    if len(axes) > 1:  # a ball: any turn; about one axis and to any other is enough to keep it from flipping
        names = (f"{axes[0]}_{FULL}", *(f"{letter}_90" for letter in AXES if letter != axes[0]))
    axis = np.eye(3)[AXES[axes[0]]] if axes else None
    steps = [_step(name) for name in names if not name.endswith(FULL)]
    return Symmetry(turns=_close(steps), axis=axis, middle=mesh.middle)


def parse_symmetry(text: str) -> tuple[str, ...] | None:
    """Return the words of a symmetry, none of them for `none`, None for `auto`; raises ContactError for others."""
    words = text.replace(",", " ").split()
    if words in ([AUTO], [NONE]):
        return None if words == [AUTO] else ()
    expected = f"symmetry {text!r}: expected {AUTO}, {NONE}, or words as x_180 and z_{FULL}"
    for word in words:
        found = re.fullmatch(rf"[xyz]_({FULL}|\d{{1,3}})", word)
        angle = found and found.group(1)
        if not found or (angle != FULL and (int(angle) < 15 or int(angle) > 180 or 360 % int(angle))):
            raise ContactError(expected)
    if not words:
        raise ContactError(expected)
    return tuple(words)


@lru_cache(maxsize=1)  # both jaws hold the same object
def find_symmetries(mesh: ObjectMesh) -> tuple[str, ...]:
    """Return the turns about the axes of a mesh's frame, through its middle, that map it onto itself."""
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    samples = sample_surface(mesh, _SAMPLES, np.random.default_rng(0))
    points, normals = samples.points - mesh.middle, samples.normals
    tree, size = cKDTree(points), float(np.linalg.norm(np.ptp(points, axis=0)))

    def fits(axis: NDArray, angle: float) -> bool:
        turned = points[:_TURNED] @ Rotation.from_rotvec(angle * axis).as_matrix().T
        _, near = tree.query(turned)
        off = np.abs(((turned - points[near]) * normals[near]).sum(axis=1))
        # what lies beside a face is off it along the face: farther than samples are from each other
        aside = np.linalg.norm(turned - points[near], axis=1)
        return bool(np.quantile(np.maximum(off, 0.2 * aside), _SHARE) < _OFF * size)

    found = []
    for letter, column in AXES.items():
        axis = np.eye(3)[column]
        if all(fits(axis, angle) for angle in _ODD_TURNS):
            found.append(f"{letter}_{FULL}")
        else:
            fold = next((fold for fold in _FOLDS if fits(axis, 2.0 * np.pi / fold)), 0)
            found += [f"{letter}_{360 // fold}"] if fold else []
    return tuple(found)


def _step(name: str) -> NDArray:
    """Return the turn (3, 3) of a word as `x_180`."""
    from scipy.spatial.transform import Rotation

    letter, angle = name.split("_")
    return Rotation.from_rotvec(np.radians(float(angle)) * np.eye(3)[AXES[letter]]).as_matrix()


def _close(steps: list[NDArray]) -> NDArray:
    """Return all turns (n, 3, 3) that some of them make one after the other."""
    turns = [np.eye(3)]
    for turn in turns:  # grows
        for step in steps:
            new = turn @ step
            if len(turns) < _MOST and not any(np.allclose(new, known, atol=1e-6) for known in turns):
                turns.append(new)
    return np.stack(turns)
