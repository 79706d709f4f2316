"""Where a camera is: in the gripper, from the jaws at rest, or above a table with holes in a square grid.

The jaws stand still, open and unloaded: their key points lie where the jaw file says, on either side of the middle of
the gripper by the same half opening. That is a target of known shape but for one number.

Of a table, lens, focal length and place come from one plane: the lens shows in lines that are not straight, the focal
length in lines that should be parallel and are not. A camera that looks square at the table hardly shows the second;
then the focal length stays near what webcams have, and so does the camera's distance, while places on the table are
right all the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import SIDES, jaw_in_camera
from finforce.optional import import_cv2
from finforce.transforms import check_pose, move_pose
from finforce_keypoints.errors import GeometryError

LEAST_POINTS = 8
_OUTLIER = 2.0  # [px] beyond which a point loses its weight
_TYPICAL = np.r_[np.full(3, 5e-3), np.full(3, 0.05), 5e-3]  # [m], [rad], [m]: how wrong a guess may be
LEAST_HOLES = 20
USUAL_FOCAL, FOCAL_SPREAD = 0.8, 0.15  # of the image's width: what most webcams have, and how much they differ (log)
_SMALLEST, _LARGEST = 0.002, 0.03  # of the image's width: diameters of holes
_ROUNDNESS = 0.55
_NEAR = 0.22  # of the local pitch, by which a hole may lie beside its forecast
_HOLE_OUTLIER = 1.5  # [px] beyond which a hole loses its weight


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


@dataclass(frozen=True, kw_only=True, eq=False)
class GridCamera:
    """A camera above a table.

    Attributes:
        camera: intrinsics.
        T_camera_table: (4, 4); x and y of the table along its rows and columns of holes, z away from the camera.
        holes: (n, 2) column and row of the holes used [px].
        residual: root mean square distance of the holes from where they should be [px].
    """

    camera: CameraIntrinsics
    T_camera_table: NDArray
    holes: NDArray
    residual: float


def find_grid_camera(image: NDArray, pitch: float) -> GridCamera:
    """Return the camera that took a picture of a table.

    Args:
        image: (h, w, 3) uint8.
        pitch: distance between neighbouring holes [m].

    Raises:
        GeometryError: fewer than 20 holes of one grid are found.
    """
    return fit_grid_camera(find_holes(image), image.shape[:2], pitch)


def find_holes(image: NDArray) -> NDArray:
    """Return column and row (n, 2) [px] of dark round spots in a picture (h, w, 3) uint8."""
    cv2 = import_cv2()
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    width = grey.shape[1]
    around = cv2.GaussianBlur(grey, (0, 0), 0.012 * width)
    dark = ((grey < 0.72 * around) & (grey < 130)).astype(np.uint8)
    _, _, stats, centres = cv2.connectedComponentsWithStats(dark, connectivity=8)
    sizes, areas = stats[:, 2:4].astype(float), stats[:, 4].astype(float)
    good = (sizes.min(axis=1) > _SMALLEST * width) & (sizes.max(axis=1) < _LARGEST * width)
    good &= sizes.min(axis=1) > _ROUNDNESS * sizes.max(axis=1)
    good &= areas > _ROUNDNESS * 0.785 * sizes.prod(axis=1)
    good[0] = False
    return centres[good]


def order_grid(holes: NDArray) -> tuple[NDArray, NDArray]:
    """Return which of the places (n, 2) belong to one grid, and their cells (m, 2), from 0 on along x and y.

    From a place in the middle on, each neighbour is looked for where the steps so far say that it is; each place found
    gives its own steps to go on with, so that the grid may be bent by a lens.

    Raises:
        GeometryError: there is no grid of at least 20.
    """
    if len(holes) < LEAST_HOLES:
        raise GeometryError(f"{len(holes)} dark round spots, expected at least {LEAST_HOLES} holes of a table")
    tree = cKDTree(holes)
    best: dict[int, tuple[int, int]] = {}
    for seed in tree.query(holes.mean(axis=0), k=min(40, len(holes)))[1]:
        cells = _grow(holes, tree, int(seed))
        if len(cells) > len(best):
            best = cells
        if len(best) > 0.6 * len(holes):
            break
    if len(best) < LEAST_HOLES:
        raise GeometryError(f"a grid of {len(best)} among {len(holes)} spots, expected at least {LEAST_HOLES} holes")
    used = np.array(list(best))
    cells = np.array(list(best.values()))
    return used, cells - cells.min(axis=0)


def _grow(holes: NDArray, tree: cKDTree, seed: int) -> dict[int, tuple[int, int]]:
    """Return the cells of the places that can be reached from one of them."""
    distance, near = tree.query(holes[seed], k=5)
    pitch = float(np.median(distance[1:]))
    steps = holes[near[1:]] - holes[seed]
    right = steps[np.abs(steps[:, 1]) < 0.4 * pitch]
    down = steps[np.abs(steps[:, 0]) < 0.4 * pitch]
    if len(right) == 0 or len(down) == 0:
        return {}
    first = (right[0] * np.sign(right[0, 0]), down[0] * np.sign(down[0, 1]))
    cells, taken, waiting = {seed: (0, 0)}, {(0, 0): seed}, [(seed, *first)]
    while waiting:
        number, along, across = waiting.pop(0)
        column, row = cells[number]
        for axis, (step, sign) in enumerate(((along, 1), (along, -1), (across, 1), (across, -1))):
            cell = (column + sign, row) if axis < 2 else (column, row + sign)
            away, found = tree.query(holes[number] + sign * step)
            if cell in taken or int(found) in cells or away > _NEAR * np.linalg.norm(step):
                continue
            own = sign * (holes[found] - holes[number])
            cells[int(found)], taken[cell] = cell, int(found)
            waiting.append((int(found), own, across) if axis < 2 else (int(found), along, own))
    return cells


def fit_grid_camera(holes: NDArray, size: tuple[int, int], pitch: float) -> GridCamera:
    """Return the camera of an image (h, w) that shows holes (n, 2) [px] of a grid with some pitch [m]."""
    if not 1e-4 < pitch < 1.0:
        raise GeometryError(f"pitch: got {pitch:g} m, expected the distance between neighbouring holes in metres")
    used, cells = order_grid(holes)
    seen = holes[used]
    table = np.column_stack((pitch * (cells - cells.mean(axis=0)), np.zeros(len(cells))))
    spacing = np.median(np.linalg.norm(seen - seen.mean(axis=0), axis=1)) / np.median(np.linalg.norm(table, axis=1))
    focal = USUAL_FOCAL * size[1]

    def build(x: NDArray) -> tuple[CameraIntrinsics, NDArray]:
        f = focal * np.exp(x[6])
        middle = (0.5 * (size[1] - 1), 0.5 * (size[0] - 1))
        lens = np.array([x[7], x[8], 0.0, 0.0, 0.0])
        camera = CameraIntrinsics(
            width=size[1], height=size[0], fx=f, fy=f, cx=middle[0], cy=middle[1], distortion=lens
        )
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(x[:3]).as_matrix()
        T[2, 3] = np.exp(x[5]) * f / spacing
        T[:2, 3] = x[3:5] * T[2, 3]
        return camera, T

    def misses(x: NDArray) -> NDArray:
        camera, T = build(x)
        away = project(table @ T[:3, :3].T + T[:3, 3], camera) - seen
        return np.append(np.nan_to_num(away, nan=1e3).ravel(), x[6] / FOCAL_SPREAD)

    start = np.zeros(9)
    start[3:5] = (seen.mean(axis=0) - 0.5 * np.array([size[1], size[0]])) / focal
    fit = least_squares(misses, start, loss="soft_l1", f_scale=_HOLE_OUTLIER)
    camera, T = build(fit.x)
    away = np.linalg.norm(project(table @ T[:3, :3].T + T[:3, 3], camera) - seen, axis=1)
    return GridCamera(
        camera=camera,
        T_camera_table=T,
        holes=seen,
        residual=float(np.sqrt((away[away < 3.0 * _HOLE_OUTLIER] ** 2).mean())),
    )
