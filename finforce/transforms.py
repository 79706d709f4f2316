"""Rigid poses as (4, 4) matrices: checked, from and to quaternions, inverted, compared."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from finforce.errors import PoseError

# What single precision, or six printed digits, leave of an orthogonal matrix or of a unit quaternion.
_TOLERANCE = 1e-3


def check_pose(T: ArrayLike, what: str = "pose") -> NDArray:
    """Returns a pose as a (4, 4) array of floats after having refused what is no rigid motion.

    Args:
        T: matrix [[R, t], [0, 1]] (4, 4), t in [m].
        what: what the pose is called in the message.

    Returns:
        A copy of the pose, its R the nearest rotation.

    Raises:
        PoseError: The matrix has another shape, is not finite, or its R is no rotation.
    """
    try:
        T = np.array(T, float)
    except (TypeError, ValueError):
        raise PoseError(f"{what}: got {T!r}, expected numbers in a (4, 4) matrix") from None
    if T.shape != (4, 4):
        raise PoseError(f"{what}: got an array of shape {T.shape}, expected (4, 4)")
    if not np.isfinite(T).all():
        raise PoseError(
            f"{what}: got NaN or infinite entries, expected a rigid pose; drop such samples at their source"
        )
    R = T[:3, :3]
    error = np.abs(R.T @ R - np.eye(3)).max()
    if error > _TOLERANCE or np.linalg.det(R) < 0.0 or np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-9:
        raise PoseError(
            f"{what}: got a matrix that is no rigid motion (R^T R off by {error:.2g}, det R {np.linalg.det(R):.4g}, "
            f"last row {T[3].tolist()}), expected [[R, t], [0, 1]] without scale or mirroring"
        )
    T[:3, :3] = _nearest_rotation(R)
    T[3] = 0.0, 0.0, 0.0, 1.0
    return T


def pose_from_quaternion(position: ArrayLike, quaternion: ArrayLike) -> NDArray:
    """Returns the pose of a position and a unit quaternion.

    Args:
        position: translation (3,) [m].
        quaternion: x, y, z, w (4,) of norm 1.

    Returns:
        Pose (4, 4).

    Raises:
        PoseError: An entry is missing or not finite, or the norm is off 1 by more than 0.001.
    """
    position, quaternion = np.asarray(position, float), np.asarray(quaternion, float)
    if position.shape != (3,) or quaternion.shape != (4,):
        raise PoseError(
            f"pose: got a position of shape {position.shape} and a quaternion of shape {quaternion.shape}, "
            "expected (3,) and (4,) as x, y, z, w"
        )
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        raise PoseError(f"pose: got position {position} and quaternion {quaternion}, expected finite numbers")
    norm = np.linalg.norm(quaternion)
    if abs(norm - 1.0) > _TOLERANCE:
        raise PoseError(f"pose: got a quaternion of norm {norm:.4g}, expected 1; (0, 0, 0, 0) is an unset message")
    x, y, z, w = (quaternion / norm).tolist()
    T = np.eye(4)
    T[0, :3] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)
    T[1, :3] = 2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)
    T[2, :3] = 2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)
    T[:3, 3] = position
    return T


def quaternion_from_pose(T: ArrayLike) -> NDArray:
    """Returns the quaternion x, y, z, w (4,) of a pose (4, 4), with w >= 0; raises PoseError as `check_pose` does."""
    R = check_pose(T)[:3, :3]
    # of the four ways the one without cancellation: K. Shoemake, Animating rotation with quaternion curves, 1985
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    ways = (
        (1.0 + a - e - i, b + d, g + c, h - f),
        (b + d, 1.0 - a + e - i, f + h, c - g),
        (g + c, f + h, 1.0 - a - e + i, d - b),
        (h - f, c - g, d - b, 1.0 + a + e + i),
    )
    quaternion = np.array(max(enumerate(ways), key=lambda way: way[1][way[0]])[1])
    quaternion /= np.copysign(np.linalg.norm(quaternion), quaternion[3])
    return quaternion


def pose_numbers(T: ArrayLike) -> tuple[float, ...]:
    """Returns x, y, z [m], qx, qy, qz, qw of a pose (4, 4); raises PoseError as `check_pose` does."""
    return tuple(float(number) for number in (*np.asarray(T)[:3, 3], *quaternion_from_pose(T)))


def invert_pose(T_a_b: NDArray) -> NDArray:
    """Returns T_b_a (4, 4), [[R^T, -R^T t], [0, 1]], of a rigid pose T_a_b (4, 4)."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = T_a_b[:3, :3].T
    T_b_a[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T_b_a


def rotation_between(T_a: NDArray, T_b: NDArray) -> float:
    """Returns the angle [rad], 0 to pi, by which two poses (4, 4) differ in orientation.

    With D = R_a^T R_b: angle = 2 asin(|D - 1|_F / sqrt 8), which is exact near zero, where acos is not.
    """
    difference = T_a[:3, :3].T @ T_b[:3, :3] - np.eye(3)
    return float(2.0 * np.arcsin(min(np.linalg.norm(difference) / np.sqrt(8.0), 1.0)))


def move_pose(T: NDArray, step: NDArray) -> NDArray:
    """Returns a pose (4, 4) moved by a small twist, turned about its own origin in the outer frame's axes.

    t' = t + step[:3], R' = exp(step[3:]) R: the step (6,) is x, y, z [m] and rotation vector [rad], which is also
    the order and the meaning of the (6, 6) covariances of poses here and in ROS.
    """
    moved = T.copy()
    moved[:3, 3] += step[:3]
    moved[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ T[:3, :3]
    return moved


def step_between(T_from: NDArray, T_to: NDArray) -> NDArray:
    """Returns the step (6,) [m, rad] with `move_pose(T_from, step)` = T_to, both (4, 4)."""
    turn = Rotation.from_matrix(T_to[:3, :3] @ T_from[:3, :3].T).as_rotvec()
    return np.concatenate([T_to[:3, 3] - T_from[:3, 3], turn])


def _nearest_rotation(R: NDArray) -> NDArray:
    left, _, right = np.linalg.svd(R)
    return left @ right
