"""Pictures of textured jaws that move by rule, for tests of what tells that they stand still."""

from functools import lru_cache

import cv2
import numpy as np
from keypoint_scene_fakes import CAMERA, scene_of

from finforce.camera import project
from finforce_keypoints.geometry.jaw_localizer import JawKeypoints
from finforce_keypoints.geometry.side_picture import find_side, intersect_plane

NOISE = 4.0  # grey levels of each colour
SIDES = ("left", "right")


@lru_cache(maxsize=1)
def ground():
    """A texture with the contrast of a real finger, and how each pixel moves when its jaw moves along x by a metre."""
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.standard_normal((CAMERA.height, CAMERA.width)), (0, 0), 2.0)
    texture = (120.0 + 40.0 * texture / texture.std()).astype(np.float32)
    scene, _ = scene_of("robot")
    columns, rows = np.meshgrid(np.arange(0, CAMERA.width, 4), np.arange(0, CAMERA.height, 4))
    pixels = np.column_stack((columns.ravel(), rows.ravel())).astype(float)
    fields = {}
    for side, T in scene.poses().items():
        y = find_side(scene.jaws[side])
        x, z = intersect_plane(pixels, y, T, CAMERA).T
        ends = [np.column_stack((x + step, np.full(len(x), y), z)) @ T[:3, :3].T + T[:3, 3] for step in (0.0, 1e-4)]
        way = (project(ends[1], CAMERA) - project(ends[0], CAMERA)) / 1e-4
        field = np.column_stack((way, np.clip(z, 0.0, 0.085))).reshape(*columns.shape, 3)
        fields[side] = cv2.resize(np.nan_to_num(field).astype(np.float32), (CAMERA.width, CAMERA.height))
    return texture, fields


@lru_cache(maxsize=1)
def noise_pool():
    """Noise of a sensor; any two ways of rolling it are independent."""
    return np.random.default_rng(0).normal(0.0, NOISE, (2 * CAMERA.height * CAMERA.width * 3,)).astype(np.float32)


def noise_of(seed):
    """The noise of one picture."""
    start = int(np.random.default_rng(seed).integers(CAMERA.height * CAMERA.width * 3))
    return noise_pool()[start:][: CAMERA.height * CAMERA.width * 3].reshape(CAMERA.height, CAMERA.width, 3)


def move_none(z):
    return 0.0 * z


def move_all(way):
    """The whole jaw by a way [m] along x."""
    return lambda z: way + 0.0 * z


def bend(way):
    """The tip by a way [m] along x, and what is below by the square of its height."""
    return lambda z: way * (z / 0.085) ** 2


def picture(seed, move=move_none, *, side="left", gain=1.0, offset=0.0):
    """A noisy picture of the jaws, one of which has moved."""
    texture, fields = ground()
    columns, rows = np.meshgrid(np.arange(CAMERA.width, dtype=np.float32), np.arange(CAMERA.height, dtype=np.float32))
    field = fields[side]
    mine = columns < CAMERA.width / 2 if side == "left" else columns >= CAMERA.width / 2
    way = np.where(mine, move(field[..., 2]), 0.0).astype(np.float32)
    moved = cv2.remap(texture, columns - way * field[..., 0], rows - way * field[..., 1], cv2.INTER_CUBIC)
    return np.clip(np.rint(gain * moved[..., None] + offset + noise_of(seed)), 0, 255).astype(np.uint8)


def found_at(stamp, rng=None, spread=1e-4, hidden=0):
    """Key points of both jaws at rest with an error that is another one in every image; some are hidden."""
    scene, _ = scene_of("robot")
    found = {}
    for side, T in scene.poses().items():
        points = scene.keypoints(side)[:-1]
        valid = np.arange(len(points)) >= hidden
        error = 0.0 if rng is None else rng.normal(0.0, spread, points.shape)
        found[side] = JawKeypoints(
            stamp=stamp,
            points=points + error,
            likelihood=np.where(valid, 0.9, 0.0),
            pixels=project(points @ T[:3, :3].T + T[:3, 3], CAMERA),
            valid=valid,
            stddev=np.full(points.shape, 2e-4),
            T_camera_jaw=T.copy(),
            reasons=np.where(valid, "", "likelihood"),
        )
    return found
