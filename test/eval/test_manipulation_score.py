"""The net force on the gripper is scored against the truth of both jaws."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_scoring import make_result

from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce.transforms import quaternion_from_pose
from finforce_eval.evaluation.gripper import with_gripper
from finforce_eval.evaluation.score_tables import format_manipulation
from finforce_eval.evaluation.scoring import join_net, score_manipulation, score_net
from finforce_eval.recordings.tracks import GravityTrack, PoseTrack


def jaws(count=10):
    """Results of both jaws that hold something of 0.5 N along y of the gripper, without an error."""
    force = np.tile([-3.0, 0.25, 0.0], (count, 1))
    other = np.tile([-3.0, -0.25, 0.0], (count, 1))
    stated = np.full((count, 3), 0.1)
    blank = make_result(truth=np.ones(count), force=np.ones(count), force_stddev=stated)
    left = blank.with_columns(case="turn/left", force=force, true_force=force)
    return left, blank.with_columns(case="turn/right", side="right", force=other, true_force=other)


def score_pair(left, right, recording=None):
    both = {"left": left, "right": right}
    return score_net(join_net(both if recording is None else with_gripper(both, recording)))


def test_jaws_that_are_right_make_a_net_force_that_is():
    score = score_pair(*jaws())
    assert score.vector_rmse_N == pytest.approx(0.0)
    assert score.within_3_sigma_pct == (100.0, 100.0, 100.0)
    assert score.answered_pct == 100.0


def test_errors_of_both_jaws_add_in_the_frame_of_the_gripper():
    left, right = jaws()
    left = left.with_columns(force=left.force + [0.3, 0.0, 0.0])  # x of the gripper; of the right jaw against it
    right = right.with_columns(force=right.force + [0.1, 0.0, 0.0])
    score = score_pair(left, right)
    assert score.axis_rmse_N == pytest.approx((0.2, 0.0, 0.0))
    assert score.vector_rmse_N == pytest.approx(0.2)


def test_images_without_one_of_the_jaws_count_as_unanswered():
    left, right = jaws()
    right = right.with_columns(force=np.where(np.arange(10)[:, None] < 4, np.nan, right.force))
    score = score_pair(left, right)
    assert (score.n, score.answered_pct) == (6, 60.0)
    right = right.with_columns(force=np.full((10, 3), np.nan))
    assert score_pair(left, right).vector_rmse_N is None


def test_recordings_of_one_jaw_have_no_score():
    left, right = jaws()
    assert score_manipulation([left.renamed("a")]) == {}
    both = score_manipulation([left, right])
    assert list(both) == ["turn"]
    assert "0.000 N" in format_manipulation(both)[0]


def test_the_torque_is_scored_where_the_jaws_places_are_known():
    left, right = jaws()
    torque = np.tile([0.0, -0.12, 0.01], (len(left.stamps_ns), 1))
    left, right = (jaw.with_columns(torque=torque, true_torque=torque) for jaw in (left, right))
    assert score_pair(left, right).torque_rmse_Nm is None
    recording = SimpleNamespace(gravity=None, jaw=lambda side: SimpleNamespace(pose=poses[side], true_pose=None))
    poses = {side: track(left.stamps_ns, x) for side, x in (("left", -0.03), ("right", 0.03))}
    assert score_pair(left, right, recording).torque_rmse_Nm == pytest.approx(0.0, abs=1e-12)
    left = left.with_columns(torque=torque + [0.0, 0.006, 0.0])
    assert score_pair(left, right, recording).torque_rmse_Nm == pytest.approx(0.006)
    # another force of the right jaw along z turns about y by its lever
    right = right.with_columns(force=right.force + [0.0, 0.0, 0.1])
    assert score_pair(left, right, recording).torque_rmse_Nm == pytest.approx(abs(0.006 - 0.003))


def track(stamps, x):
    """Poses of a jaw that does not move before the robot's camera."""
    pose = jaw_in_camera(ROBOT_CAMERA, "left" if x < 0 else "right", x)
    rows = len(stamps)
    position, quaternion = (np.tile(part, (rows, 1)) for part in (pose[:3, 3], quaternion_from_pose(pose)))
    return PoseTrack(stamps_ns=stamps, position=position, quaternion=quaternion, frame_id="camera")


def test_gravity_tells_the_weight_along_the_fingers_of_what_is_turned():
    count = 240
    angles = np.clip(np.linspace(-0.5, 2.0 * np.pi, count), 0.0, None)
    down = np.stack([np.zeros(count), np.sin(angles), np.cos(angles)], axis=1)
    left, right = jaws(count)
    true = 0.5 * down
    shown = true * [1.0, 1.0, 0.0]  # key points show nothing along the fingers
    mirrored = [-1.0, -1.0, 1.0]
    closed = np.array([3.0, 0.0, 0.0])
    left = left.with_columns(force=shown - closed, true_force=true - closed)
    right = right.with_columns(force=shown * mirrored - closed, true_force=true * mirrored - closed)
    both = {"left": left, "right": right}
    gravity = GravityTrack(stamps_ns=left.stamps_ns, direction=down, elevation=np.full(count, np.nan))
    recording = SimpleNamespace(gravity=gravity, jaw=lambda side: SimpleNamespace(pose=None, true_pose=None))
    blind, told = score_net(join_net(both)), score_net(join_net(with_gripper(both, recording)))
    assert told.axis_rmse_N[2] < 0.5 * blind.axis_rmse_N[2]
    assert min(told.within_3_sigma_pct) > 98.0
