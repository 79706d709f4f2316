"""Axes and poses of SAM-3D Objects in those of the camera.

The generator's canonical frame has z upwards, its GLB files have y upwards, its camera is PyTorch3D's (x left, y up, z
forward) with row vectors, and its quaternions are w, x, y, z.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from finforce.errors import PoseError

# p_canonical = C p_glb, (x, y, z) of the GLB being (x, z, -y) of the canonical frame
CANONICAL_FROM_GLB = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
CAMERA_FROM_PYTORCH3D = np.diag([-1.0, -1.0, 1.0])
MESH_AXES = ("glb", "canonical")
NORM_TOLERANCE = 1e-2  # of a quaternion that a network gave


def canonical_from_glb(points: NDArray) -> NDArray:
    """Return points (n, 3) of a GLB file in canonical axes: (x, -z, y)."""
    return np.asarray(points) @ CANONICAL_FROM_GLB.T


def glb_from_canonical(points: NDArray) -> NDArray:
    """Return canonical points (n, 3) in the axes of a GLB file: (x, z, -y)."""
    return np.asarray(points) @ CANONICAL_FROM_GLB


def camera_from_pytorch3d(points: NDArray) -> NDArray:
    """Return points (n, 3) or images of points (h, w, 3) of PyTorch3D's camera in the optical frame, and the reverse.

    The map is its own inverse: (-x, -y, z).
    """
    return np.asarray(points) @ CAMERA_FROM_PYTORCH3D


def affine_from_generator(
    rotation: ArrayLike, translation: ArrayLike, scale: ArrayLike, mesh_axes: str = "glb"
) -> NDArray:
    """Return the map (4, 4) of a generated mesh into the camera frame.

    p_cv = D (s R(q)^T C p_glb + t) with D = diag(-1, -1, 1); C falls away for canonical points.

    Args:
        rotation: quaternion w, x, y, z, of shape (4,) or (1, 4).
        translation: (3,) or (1, 3) [m].
        scale: one number, or (3,) or (1, 3) along the canonical axes.
        mesh_axes: "glb" for the vertices of a GLB file, "canonical" for those of a PLY.

    Raises:
        PoseError: a shape is wrong, a number is not finite, the quaternion is not of unit length, or a scale is not
            positive.
    """
    quaternion, t, s = (np.asarray(value, dtype=float).ravel() for value in (rotation, translation, scale))
    if mesh_axes not in MESH_AXES:
        raise PoseError(f"axes of the generated mesh '{mesh_axes}': expected one of {', '.join(MESH_AXES)}")
    if quaternion.shape != (4,) or t.shape != (3,) or s.shape not in ((1,), (3,)):
        raise PoseError(
            f"pose of the generated mesh: {quaternion.size}, {t.size} and {s.size} numbers for rotation, translation "
            "and scale; expected 4 (w x y z), 3, and 1 or 3"
        )
    if not (np.isfinite(quaternion).all() and np.isfinite(t).all() and np.isfinite(s).all()):
        raise PoseError("pose of the generated mesh: NaN or infinite numbers")
    if abs(np.linalg.norm(quaternion) - 1.0) > NORM_TOLERANCE or s.min() <= 0.0:
        raise PoseError(
            f"pose of the generated mesh: quaternion of length {np.linalg.norm(quaternion):.4g}, scale {s.tolist()}; "
            "expected length 1 (w x y z) and positive scales"
        )
    A = np.eye(4)
    # rows times R in PyTorch3D are columns times its transpose here
    R = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix().T
    A[:3, :3] = CAMERA_FROM_PYTORCH3D @ R * s
    if mesh_axes == "glb":
        A[:3, :3] = A[:3, :3] @ CANONICAL_FROM_GLB
    A[:3, 3] = CAMERA_FROM_PYTORCH3D @ t
    return A
