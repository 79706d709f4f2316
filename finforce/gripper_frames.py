"""Frames of the gripper: the wrist camera, and the jaws that slide in front of it.

The gripper base has x along the closing axis, from the left to the right jaw, and z along the approach direction.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce.camera_file import parse_numbers
from finforce.errors import FinforceError, PoseError
from finforce.files import read_text
from finforce.transforms import check_pose, invert_pose, move_pose, pose_from_quaternion

SIDES = ("left", "right")
FARTHEST_CAMERA = 3.0  # [m] from the gripper, where f = 430 px shows a finger of 80 mm in 11 px
_JAWS = (0.0, 0.010, 0.042)  # middle of both jaws' sides [m]
_LOOKS_AT, LOOKS_AWAY = np.radians((35.0, 70.0))  # off them: surely in view, surely not
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # about z: left and right change places


def jaw_in_gripper(side: str, origin_x: float, turn: ArrayLike | None = None) -> NDArray:
    """Return T_gripper_jaw (4, 4) of a jaw whose origin is at `origin_x` [m] on the closing axis.

    The left jaw has the orientation of the gripper base, the right jaw is that turned by 180 degrees about z. A jaw
    that is mounted askew is turned by the rotation vector `turn` (3,) [rad] in its own frame.

    Raises:
        PoseError: the side is neither "left" nor "right".
    """
    if side not in SIDES:
        raise PoseError(f"side: got {side!r}, expected 'left' or 'right'")
    T = np.eye(4) if side == "left" else HALF_TURN.copy()
    T[0, 3] = origin_x
    return T if turn is None else T @ move_pose(np.eye(4), np.r_[np.zeros(3), turn])


def jaw_in_camera(T_gripper_camera: NDArray, side: str, origin_x: float, turn: ArrayLike | None = None) -> NDArray:
    """Return T_camera_jaw (4, 4) = T_gripper_camera^-1 T_gripper_jaw(origin_x [m], turn [rad])."""
    return invert_pose(T_gripper_camera) @ jaw_in_gripper(side, origin_x, turn)


@dataclass(frozen=True, kw_only=True)
class OpeningRange:
    """The range of a jaw's origin along the closing axis, from the middle of the gripper [m]."""

    nearest: float = 0.010
    farthest: float = 0.070

    def place_jaw(
        self, T_gripper_camera: NDArray, side: str, step: float, turn: ArrayLike | None = None
    ) -> list[NDArray]:
        """Return T_camera_jaw (4, 4) at places from one end of the range to the other, at most `step` [m] apart."""
        count = max(2, int(np.ceil((self.farthest - self.nearest) / step)) + 1)
        sign = -1.0 if side == "left" else 1.0
        places = np.linspace(self.nearest, self.farthest, count)
        return [jaw_in_camera(T_gripper_camera, side, sign * place, turn) for place in places]


def look_at(position: ArrayLike, target: ArrayLike, right: ArrayLike) -> NDArray:
    """Return the pose (4, 4) of a camera at a place that looks at a target.

    z = (target - position) normed, x = the part of `right` normal to z, y = z x x; all in the frame of the result.

    Args:
        position: (3,) of the camera [m].
        target: (3,) on the optical axis [m].
        right: (3,) direction of the image's rows.
    """
    position = np.asarray(position, dtype=float)
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z)
    x = np.asarray(right, dtype=float)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack((x, np.cross(z, x), z))
    T[:3, 3] = position
    return T


# On the wrist, above the fingers' side faces, both jaws in view from base to tip.
ROBOT_CAMERA = look_at((0.0, 0.095, -0.045), _JAWS, (1.0, 0.0, 0.0))
# Beyond the tips, looking back at the same sides, 30 degrees from square to them.
FRONT_CAMERA = look_at((0.0, 0.114, 0.102), _JAWS, (1.0, 0.0, 0.0))

# The bench has one jaw, held here on the closing axis [m]; its pose before the camera is that of the bench recordings.
BENCH_ORIGIN_X = -0.055
_BENCH_JAW = pose_from_quaternion(
    (0.0293674, 0.02565352, 0.11204665), (-0.21179348, -0.35564507, 0.90650751, 0.08309176)
)
BENCH_CAMERA = jaw_in_gripper("left", BENCH_ORIGIN_X) @ invert_pose(_BENCH_JAW)
CAMERAS = {"robot": ROBOT_CAMERA, "bench": BENCH_CAMERA, "turned": ROBOT_CAMERA @ HALF_TURN, "front": FRONT_CAMERA}


# Of a camera's optical frame (z forward, y down) in that of its body (x forward, z up), as in REP 103.
_BODY_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def angle_off_jaws(T_gripper_camera: NDArray) -> float:
    """Return the angle [rad] between a camera's axis and its line of sight to the middle of the jaws."""
    x, y, z = (invert_pose(T_gripper_camera) @ (*_JAWS, 1.0))[:3]
    return float(np.arctan2(np.hypot(x, y), z))


def suggest_camera(T_gripper_camera: NDArray) -> dict[str, NDArray]:
    """Return what the pose (4, 4) of a camera that does not look at the jaws may be instead, T_gripper_camera by it."""
    inverse = invert_pose(T_gripper_camera)
    readings = {
        "the pose of the gripper in the camera frame": inverse,
        "the pose of the camera's body, x forward (camera_link), not of its optical frame": T_gripper_camera
        @ _BODY_OPTICAL,
        "that of a camera on the other side of the gripper, with left and right exchanged": HALF_TURN
        @ T_gripper_camera,
    }
    return {what: T for what, T in readings.items() if T[1, 3] > _JAWS[1] and angle_off_jaws(T) < _LOOKS_AT}


def check_camera(T_gripper_camera: NDArray) -> NDArray:
    """Return a camera's pose (4, 4); raises PoseError of one so far away that its unit is another."""
    distance = float(np.linalg.norm(T_gripper_camera[:3, 3]))
    if distance > FARTHEST_CAMERA:
        raise PoseError(
            f"extrinsics: T_gripper_camera is {distance:.3g} m from the gripper; expected {FARTHEST_CAMERA:g} m at "
            "most: is it in millimetres?"
        )
    return T_gripper_camera


def _read_hand_eye(path: Path) -> NDArray:
    """Return the pose (4, 4) of a camera on the gripper from a file of easy_handeye, easy_handeye2 or matrices.

    Raises:
        PoseError: it cannot be read, or the camera stands beside the robot.
    """
    try:
        content = parse_numbers(read_text(path))
        if (matrix := _find_matrix(content)) is not None:
            return check_pose(matrix, f"extrinsics: {path.name}")
        found = content.get("transformation") or content["transform"]
        turn = {f"q{axis}": value for axis, value in found.get("rotation", {}).items()}
        named = {**found, **found.get("translation", {}), **turn}
        numbers = [float(named[name]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
        about = content.get("parameters") or {}
        beside = about.get("eye_on_hand") is False or about.get("calibration_type") == "eye_on_base"
    except PoseError:
        raise
    except (FinforceError, AttributeError, KeyError, TypeError, ValueError) as error:
        what = "easy_handeye, of a (4, 4) matrix, or of OpenCV's rotation and translation"
        raise PoseError(f"extrinsics: {path.name} is no file of {what}: {error}") from error
    if beside:
        raise PoseError(f"extrinsics: {path.name} is of a camera beside the robot; expected one on the gripper")
    return pose_from_quaternion(numbers[:3], numbers[3:])


def _find_matrix(content: Any) -> NDArray | None:
    """Return the only matrix (4, 4) of a file, or that of its only rotation (9) and translation (3); None without."""
    entries = content.values() if isinstance(content, Mapping) else [content]
    lists = [each.get("data") if isinstance(each, Mapping) else each for each in entries]
    found = sorted((np.ravel(np.array(each, dtype=float)) for each in lists if isinstance(each, list)), key=len)
    if [len(each) for each in found] == [3, 9]:
        return np.vstack((np.column_stack((found[1].reshape(3, 3), found[0])), (0.0, 0.0, 0.0, 1.0)))
    return found[0].reshape(4, 4) if [len(each) for each in found] == [16] else None


def read_extrinsics(camera: str | ArrayLike) -> NDArray:
    """Return T_gripper_camera (4, 4) of a camera by its name, its matrix (4, 4), x, y, z [m], qx, qy, qz, qw, or file.

    Raises:
        PoseError: it is none of these.
    """
    forms = f"{', '.join(CAMERAS)}, x y z qx qy qz qw, a (4, 4) matrix, or a file of easy_handeye or such a matrix"
    if isinstance(camera, str):
        if camera in CAMERAS:
            return CAMERAS[camera]
        if Path(camera).suffix in (".yaml", ".yml", ".calib", ".json", ".xml", ".txt"):
            return check_camera(_read_hand_eye(Path(camera)))
        camera = camera.replace(",", " ").split()
    try:
        numbers = np.asarray(camera, dtype=float)
    except (TypeError, ValueError):
        raise PoseError(f"extrinsics {camera!r}: expected {forms}") from None
    if numbers.shape == (7,):
        return check_camera(pose_from_quaternion(numbers[:3], numbers[3:]))
    if numbers.shape != (4, 4):
        raise PoseError(f"extrinsics: {numbers.size} numbers; expected {forms}")
    return check_camera(check_pose(numbers, "extrinsics"))
