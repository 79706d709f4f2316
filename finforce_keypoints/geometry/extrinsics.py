"""The pose of a camera in the gripper, from the jaws at rest.

The jaws stand still, open and unloaded: their key points lie where the jaw file says, on either side of the middle of
the gripper by the same half opening. That is a target of known shape but for one number.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import SIDES, jaw_in_camera
from finforce.transforms import check_pose, move_pose
from finforce_keypoints.errors import GeometryError

LEAST_POINTS = 8
_OUTLIER = 2.0  # [px] beyond which a point loses its weight
_TYPICAL = np.r_[np.full(3, 5e-3), np.full(3, 0.05), 5e-3]  # [m], [rad], [m]: how wrong a guess may be


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenJaw:
    """One jaw at rest.

    Attributes:
        points: key points of the jaw file (n, 3) [m], jaw frame.
        pixels: (n, 2) column and row in the raw image, mean of many images [px]; NaN where one was not seen.
        turn: rotation vector (3,) of a jaw that is mounted askew, jaw frame [rad]; None for a straight one.
    """

    points: NDArray
    pixels: NDArray
    turn: NDArray | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Extrinsics:
    """A camera's place.

    Attributes:
        T_gripper_camera: (4, 4).
        stddev: one standard deviation of it: three of the position [m], three of the rotation [rad].
        origins: side -> place of the jaw's origin on the closing axis [m].
        residual: root mean square distance of the pixels from where they should be [px].
    """

    T_gripper_camera: NDArray
    stddev: NDArray
    origins: Mapping[str, float]
    residual: float


def find_extrinsics(
    jaws: Mapping[str, SeenJaw], camera: CameraIntrinsics, T_gripper_camera: NDArray, origin: float
) -> Extrinsics:
    """Return the camera's place by least squares over the pixels, with less weight for those far off.

    Two jaws stand at -o and o on the closing axis, o unknown. With one jaw o is taken as given: nothing else says
    where along its own motion it stands.

    Args:
        jaws: side -> what is seen of it.
        camera: intrinsics.
        T_gripper_camera: (4, 4), a guess within some 10 mm and 10 degrees.
        origin: guess of o [m], above zero.

    Raises:
        GeometryError: too few points are seen, or the guess is too far away.
    """
    guess = check_pose(T_gripper_camera, "T_gripper_camera")
    seen = {side: np.isfinite(jaw.pixels).all(axis=1) for side, jaw in jaws.items()}
    for side, which in seen.items():
        if which.sum() < LEAST_POINTS:
            raise GeometryError(
                f"{side} jaw: {which.sum()} of {which.size} key points seen at rest, expected at least {LEAST_POINTS}; "
                "better light, nothing before the jaws, or another guess of the camera's place"
            )
    is_pair = set(jaws) == set(SIDES)

    def misses(x: NDArray) -> NDArray:
        T, half = move_pose(guess, x[:6]), origin + (x[6] if is_pair else 0.0)
        return np.concatenate([measure_misses(side, jaw, camera, T, half) for side, jaw in jaws.items()])

    fit = least_squares(
        misses, np.zeros(7 if is_pair else 6), x_scale=_TYPICAL[: 7 if is_pair else 6], loss="soft_l1", f_scale=_OUTLIER
    )
    residual = float(np.sqrt(2.0 * np.mean(fit.fun**2)))
    T, half = move_pose(guess, fit.x[:6]), origin + (float(fit.x[6]) if is_pair else 0.0)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * np.mean(fit.fun**2)
    return Extrinsics(
        T_gripper_camera=T,
        stddev=np.sqrt(np.diag(covariance))[:6],
        origins={side: -half if side == "left" else half for side in jaws},
        residual=residual,
    )


def measure_misses(side: str, jaw: SeenJaw, camera: CameraIntrinsics, T: NDArray, half: float) -> NDArray:
    """Return by how many columns and rows the seen points are off their places (2 n,) [px].

    The camera is at T (4, 4) in the gripper base, the jaws' origins at -half and half on the closing axis [m].
    """
    seen = np.isfinite(jaw.pixels).all(axis=1)
    T_camera_jaw = jaw_in_camera(T, side, -half if side == "left" else half, jaw.turn)
    places = project(jaw.points[seen] @ T_camera_jaw[:3, :3].T + T_camera_jaw[:3, 3], camera)
    return (places - jaw.pixels[seen]).ravel()
