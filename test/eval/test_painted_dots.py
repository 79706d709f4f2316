"""Painted dots lie where the key points are, and only on those that are seen."""

import numpy as np
import pytest
from rgbd_fakes import CAMERA

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce.transforms import quaternion_from_pose
from finforce_eval.recordings.tracks import DetectionTruth, JawTrack, KeypointTrack, PoseTrack
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.detectors.dots import DotSettings, find_dots
from finforce_keypoints.images import RgbdImage
from lab.bench.detection import paint_dots

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
    sight = DetectionTruth(stamps=stamps, points=points[None], pixels=pixels[None], visible=visible[None])
    poses = PoseTrack(
        stamps=stamps, position=POSE[None, :3, 3], quaternion=quaternion_from_pose(POSE)[None], frame_id="camera"
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
