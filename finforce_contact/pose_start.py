"""First poses of an object from a masked depth image: turns over the whole sphere, coarse to fine; knows no time."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce_camera import project
from finforce_contact.pose_alignment import Alignment, Effort, MeshAligner
from finforce_contact.pose_image import DepthImage

# Depths farther apart than this [m] disagree altogether.
_WORST = 0.01
_COARSE = Effort(gates=(0.03, 0.015), steps=3, points=150, outline=False)
_MIDDLE = Effort(gates=(0.012, 0.006), steps=4, points=400)
_KEPT = 24  # coarse poses that are looked at again
_TURNS = 6  # about the line of sight, for each direction


def search_pose(aligner: MeshAligner, image: DepthImage, kept: int = 4) -> list[NDArray]:
    """Returns the poses (4, 4) that agree best with a masked image, best first.

    Args:
        aligner: the object.
        image: with a mask.
        kept: how many.
    """
    starts = [_place(aligner, image, rotation) for rotation in spread_rotations()]
    coarse = _best(aligner, image, [aligner.align(start, image, _COARSE) for start in starts], _KEPT)
    return _best(aligner, image, [aligner.align(start, image, _MIDDLE) for start in coarse], kept)


def spread_rotations() -> NDArray:
    """Returns 252 rotations (n, 3, 3) over the sphere: 42 directions of an icosphere, 6 turns about each.

    Among them is one within 34 degrees of any rotation.
    """
    rotations = []
    for direction in _icosphere():
        towards, _ = Rotation.align_vectors(direction[None], [[0.0, 0.0, 1.0]])
        for turn in range(_TURNS):
            about = Rotation.from_rotvec([0.0, 0.0, 2.0 * np.pi * turn / _TURNS])
            rotations.append((about * towards.inv()).as_matrix())
    return np.array(rotations)


def compute_agreement(aligner: MeshAligner, T_camera_object: NDArray, image: DepthImage) -> float:
    """Returns how well a pose explains a masked image, 0 to 1.

    One minus the mean of min(|z_mesh - z|, 10 mm) / 10 mm over the pixels of mesh and mask; a pixel of one of them
    alone disagrees altogether, unless something stands in front of the mesh there.
    """
    glance = aligner.glance(T_camera_object, _MIDDLE.points)
    depth, mask = image.depth[:: glance.step, :: glance.step], image.mask[:: glance.step, :: glance.step]
    on_mesh, on_mask = np.isfinite(glance.depth), mask & np.isfinite(depth)
    hidden = ~mask & on_mesh & (depth < glance.depth)
    unknown = mask & ~np.isfinite(depth)
    counted = (on_mesh | on_mask) & ~hidden & ~unknown
    if not counted.any():
        return 0.0
    cost = np.where(on_mesh & on_mask, np.minimum(np.abs(glance.depth - depth) / _WORST, 1.0), 1.0)
    return 1.0 - float(cost[counted].mean())


def _place(aligner: MeshAligner, image: DepthImage, rotation: NDArray) -> NDArray:
    """Returns a pose (4, 4) of a given rotation that covers the mask: its box and its depth."""
    rows, columns = np.nonzero(image.mask)
    box = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2.0
    depth = float(np.nanmedian(image.depth[image.mask]))
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = image.ray(box) * (depth + 0.5 * aligner.radius) - rotation @ aligner.middle
    for _ in range(2):
        seen = aligner.glance(T, _COARSE.points).surface.points
        if not len(seen):
            break
        pixels = project(seen, image.camera)
        middle = aligner.middle_of(T)
        shift = box - 0.5 * (pixels.min(axis=0) + pixels.max(axis=0))
        target = project(middle[None], image.camera)[0] + shift
        T[:3, 3] += image.ray(target) * (middle[2] + depth - np.median(seen[:, 2])) - middle
    return T


def _best(aligner: MeshAligner, image: DepthImage, alignments: list[Alignment], kept: int) -> list[NDArray]:
    poses = [alignment.T_camera_object for alignment in alignments]
    agreement = [compute_agreement(aligner, pose, image) for pose in poses]
    return [poses[i] for i in np.argsort(agreement)[::-1][:kept]]


def _icosphere() -> NDArray:
    """Returns the vertices and edge midpoints (42, 3) of an icosahedron, on the unit sphere."""
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    corners = np.array([np.roll([0.0, a, b * golden], k) for k in range(3) for a in (-1, 1) for b in (-1, 1)])
    middles = [a + b for i, a in enumerate(corners) for b in corners[:i] if np.linalg.norm(a - b) < 2.1]
    points = np.concatenate([corners, middles])
    return points / np.linalg.norm(points, axis=1, keepdims=True)
