"""Rigid poses as (4, 4) matrices: checked, from and to quaternions, inverted, compared."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce.errors import PoseError

# What single precision, or six printed digits, leave of an orthogonal matrix or of a unit quaternion.
_TOLERANCE = 1e-3
# What a product of rotations in double precision may be off by, and how often an error of the tolerance is squared
# until it is less: Newton's way to the nearest rotation, N. Higham, Computing the polar decomposition, 1986.
_ROUNDING, _STEPS = 1e-14, 3
_UNIT, _LAST = np.eye(3), np.array([0.0, 0.0, 0.0, 1.0])


def check_pose(T: ArrayLike, what: str = "pose") -> NDArray:
    """Return a pose as a (4, 4) array of floats after refusing what is no rigid motion.

    Args:
        T: matrix [[R, t], [0, 1]] (4, 4), t in [m].
        what: name of the pose in the message.

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
    scaling, turned = R.T @ R, float(np.linalg.det(R))
    error = float(np.abs(scaling - _UNIT).max())
    if not error <= _TOLERANCE or turned < 0.0 or np.abs(T[3] - _LAST).max() > 1e-9:
        raise PoseError(
            f"{what}: got a matrix that is not a rigid motion (R^T R off by {error:.2g}, det R {turned:.4g}, "
            f"last row {T[3].tolist()}), expected [[R, t], [0, 1]] without scale or mirroring"
        )
    for _ in range(_STEPS if error > _ROUNDING else 0):
        R[:] = R @ (1.5 * _UNIT - 0.5 * R.T @ R)
    T[3] = _LAST
    return T


def pose_from_quaternion(position: ArrayLike, quaternion: ArrayLike) -> NDArray:
    """Return the pose of a position and a unit quaternion.

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
    T = np.eye(4)
    T[:3, :3] = _rotation(*(quaternion / norm).tolist())
    T[:3, 3] = position
    return T


def quaternion_from_pose(T: ArrayLike) -> NDArray:
    """Return the quaternion x, y, z, w (4,) of a pose (4, 4), with w >= 0; raises PoseError as `check_pose` does."""
    return np.array(_quaternion(check_pose(T)[:3, :3]))


def pose_numbers(T: ArrayLike) -> tuple[float, ...]:
    """Return x, y, z [m], qx, qy, qz, qw of a pose (4, 4); raises PoseError as `check_pose` does."""
    return tuple(float(number) for number in (*np.asarray(T)[:3, 3], *quaternion_from_pose(T)))


def invert_pose(T_a_b: NDArray) -> NDArray:
    """Return T_b_a (4, 4), [[R^T, -R^T t], [0, 1]], of a rigid pose T_a_b (4, 4)."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = T_a_b[:3, :3].T
    T_b_a[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T_b_a


def rotation_between(T_a: NDArray, T_b: NDArray) -> float:
    """Return the angle [rad], 0 to pi, by which two poses (4, 4) differ in orientation.

    With D = R_a^T R_b: angle = 2 asin(|D - 1|_F / sqrt 8), which is exact near zero, where acos is not.
    """
    difference = T_a[:3, :3].T @ T_b[:3, :3] - np.eye(3)
    return float(2.0 * np.arcsin(min(np.linalg.norm(difference) / np.sqrt(8.0), 1.0)))


def move_pose(T: NDArray, step: NDArray) -> NDArray:
    """Return a pose (4, 4) moved by a small twist, turned about its own origin in the outer frame's axes.

    t' = t + step[:3], R' = exp(step[3:]) R: the finite step (6,) is x, y, z [m] and rotation vector [rad], also
    the order and the meaning of the (6, 6) covariances of poses here and in ROS.
    """
    moved = T.copy()
    moved[:3, 3] += step[:3]
    x, y, z = step[3:].tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    factor = math.sin(0.5 * angle) / angle if angle else 0.5
    moved[:3, :3] = np.array(_rotation(factor * x, factor * y, factor * z, math.cos(0.5 * angle))) @ T[:3, :3]
    return moved


def step_between(T_from: NDArray, T_to: NDArray) -> NDArray:
    """Return the step (6,) [m, rad] with `move_pose(T_from, step)` = T_to, both (4, 4)."""
    x, y, z, w = _quaternion(T_to[:3, :3] @ T_from[:3, :3].T)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 * math.atan2(sine, w) / sine if sine else 2.0
    (a, b, c), (d, e, f) = T_from[:3, 3].tolist(), T_to[:3, 3].tolist()
    return np.array([d - a, e - b, f - c, factor * x, factor * y, factor * z])


def _rotation(x: float, y: float, z: float, w: float) -> list[list[float]]:
    """Return the matrix (3, 3) of a unit quaternion."""
    return [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]


def _quaternion(R: NDArray) -> tuple[float, ...]:
    """Return x, y, z, w with w >= 0 of a rotation (3, 3).

    Of the four ways the one without cancellation: K. Shoemake, Animating rotation with quaternion curves, 1985.
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    x, y, z, w = 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i
    largest = max(x, y, z, w)
    if w == largest:
        x, y, z = h - f, c - g, d - b
    elif x == largest:
        y, z, w = b + d, g + c, h - f
    elif y == largest:
        x, z, w = b + d, f + h, c - g
    else:
        x, y, w = g + c, f + h, d - b
    norm = math.copysign(math.sqrt(x * x + y * y + z * z + w * w), w)
    return x / norm, y / norm, z / norm, w / norm
