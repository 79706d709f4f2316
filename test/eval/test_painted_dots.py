"""Painted dots lie where the key points are, and only on those that are seen."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from rgbd_fakes import CAMERA

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce.transforms import pose_from_quaternion, quaternion_from_pose
from finforce_eval.recordings.tracks import DetectionTruth, JawTrack, KeypointTrack, PoseTrack
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_keypoints.detectors.dots import DotSettings, find_dots
from finforce_keypoints.images import RgbdImage

DIAMETER = 0.003  # [m]
COLOUR = np.array([40.0, 200.0, 60.0])  # of 255, where the image is of medium brightness
_MEDIUM = 120.0
_REACH = 20  # [px] around a dot that are painted at most
_STEP = 1e-4  # [m], of the differences that give a dot's shape in the image


@dataclass(frozen=True, kw_only=True, eq=False)
class _Disc:
    """A dot in the image: its centre [px], and what maps pixels from it onto the jaw's side (2, 2) [m/px]."""

    centre: NDArray
    onto_side: NDArray


def paint_dots(image: RgbdImage, stamp: int, jaws: Mapping[str, Jaw], tracks: Mapping[str, JawTrack]) -> RgbdImage:
    """Return an image with a dot on every visible key point and on the reference points.

    A dot is as bright as what it is printed on, with the image's own noise.

    Args:
        image: rendered.
        stamp: of it [ns].
        jaws: by side.
        tracks: the truth by side.
    """
    color = image.color.astype(np.float32)
    for side, track in tracks.items():
        row = int(np.searchsorted(track.sight.stamps_ns, stamp))
        pose = pose_from_quaternion(track.true_pose.position[row], track.true_pose.quaternion[row])
        points = track.sight.points[row][track.sight.visible[row]]
        for point in (*points, jaws[side].reference_point):
            _paint(color, _place(point, pose, image))
    return replace(image, color=np.round(np.clip(color, 0.0, 255.0)).astype(np.uint8))


def _place(point: NDArray, pose: NDArray, image: RgbdImage) -> _Disc:
    """Return the disc about a point (3,) [m] of the jaw's side, y = const."""
    places = point + np.array([[0.0, 0.0, 0.0], [_STEP, 0.0, 0.0], [0.0, 0.0, _STEP]])
    pixels = project(places @ pose[:3, :3].T + pose[:3, 3], image.camera)
    return _Disc(centre=pixels[0], onto_side=np.linalg.inv((pixels[1:] - pixels[0]).T / _STEP))


def _paint(color: NDArray, disc: _Disc) -> None:
    """Paint a disc into an image (h, w, 3), its rim's pixels by the part that is covered."""
    column, row = (int(value) for value in np.round(disc.centre))
    rows = slice(max(row - _REACH, 0), max(row + _REACH + 1, 0))
    columns = slice(max(column - _REACH, 0), max(column + _REACH + 1, 0))
    part = color[rows, columns]
    if not part.size:
        return
    grid = np.stack(np.meshgrid(np.arange(part.shape[1]), np.arange(part.shape[0])), axis=-1)
    away = (grid + (columns.start, rows.start) - disc.centre) @ disc.onto_side.T
    pitch = np.sqrt(abs(np.linalg.det(disc.onto_side)))
    cover = np.clip(0.5 + (0.5 * DIAMETER - np.linalg.norm(away, axis=-1)) / pitch, 0.0, 1.0)[..., None]
    brightness = part.mean(axis=2, keepdims=True) / _MEDIUM
    part += cover * (COLOUR * brightness - part)


LENS = CameraIntrinsics(width=640, height=480, fx=430.0, fy=430.0, cx=319.5, cy=239.5, distortion=CAMERA.distortion)
JAW = load_jaw("bench")
POSE = jaw_in_camera(ROBOT_CAMERA, "left", -0.03)
HIDDEN = 3


@pytest.fixture
def scene():
    """A grey image, the truth about one jaw in it, and the true pixels."""
    points = JAW.keypoints
    pixels = project(points @ POSE[:3, :3].T + POSE[:3, 3], LENS)
    visible = np.arange(len(points)) != HIDDEN
    stamps = np.array([7], dtype=np.int64)
    sight = DetectionTruth(stamps_ns=stamps, points=points[None], pixels=pixels[None], visible=visible[None])
    poses = PoseTrack(
        stamps_ns=stamps, position=POSE[None, :3, 3], quaternion=quaternion_from_pose(POSE)[None], frame_id="camera"
    )
    track = JawTrack(keypoints=KeypointTrack.empty(), sight=sight, true_pose=poses)
    noise = np.random.default_rng(0).normal(110.0, 3.0, (480, 640, 3))
    depth = np.full((480, 640), 0.15, dtype=np.float32)
    return RgbdImage(stamp=7e-9, color=noise.astype(np.uint8), depth=depth, camera=LENS), track, pixels


def test_dots_are_found_on_the_visible_points_and_on_no_hidden_one(scene):
    image, track, pixels = scene
    painted = paint_dots(image, 7, {"left": JAW}, {"left": track})
    found = find_dots(painted.color, DotSettings(), 8.0).pixels
    nearest = np.linalg.norm(found[:, None] - pixels, axis=2).min(axis=0)
    seen = np.delete(nearest, HIDDEN)
    assert seen.max() < 0.5  # px: noise, rounding to 8 bits, perspective of a disc of 8 px
    assert nearest[HIDDEN] > 4.0
    assert len(found) == len(pixels) - 1 + 1  # and the reference point


def test_image_that_was_given_stays_as_it_was(scene):
    image, track, _ = scene
    before = image.color.copy()
    paint_dots(image, 7, {"left": JAW}, {"left": track})
    np.testing.assert_array_equal(image.color, before)
