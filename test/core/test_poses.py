"""Claims about poses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from finforce.errors import PoseError
from finforce.transforms import (
    check_pose,
    invert_pose,
    move_pose,
    pose_from_quaternion,
    quaternion_from_pose,
    rotation_between,
    step_between,
)

ROUNDING = 1e-12  # of products of a few numbers near one
coordinates = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3).map(np.array)
quaternions = (
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
poses = st.builds(pose_from_quaternion, coordinates, quaternions)


@given(poses)
def test_a_quaternion_gives_the_pose_back(T):
    assert np.allclose(pose_from_quaternion(T[:3, 3], quaternion_from_pose(T)), T, atol=ROUNDING)
    assert quaternion_from_pose(T)[3] >= 0.0


def test_quaternions_are_ordered_x_y_z_w():
    quarter = pose_from_quaternion([0.0, 0.0, 0.0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    assert np.allclose(quarter[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=ROUNDING)


@given(poses)
def test_inverse_undoes_a_pose(T):
    assert np.allclose(invert_pose(T) @ T, np.eye(4), atol=ROUNDING)


@given(poses, poses)
def test_step_leads_from_one_pose_to_the_other(T_from, T_to):
    assert np.allclose(move_pose(T_from, step_between(T_from, T_to)), T_to, atol=1e-9)  # a turn near pi loses digits


@given(poses, st.floats(0.0, 3.1), coordinates.filter(lambda v: np.linalg.norm(v) > 0.1))
def test_rotation_between_is_the_angle_of_the_turn(T, angle, axis):
    turned = T.copy()
    turned[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    # the arc sine is steep near pi: rounding of 1e-16 makes 1e-14 of an angle of 3.1
    assert rotation_between(T, turned) == pytest.approx(angle, abs=1e-12)


@given(poses)
def test_moving_turns_about_the_objects_origin_in_outer_axes(T):
    moved = move_pose(T, np.array([0.01, 0.0, 0.0, 0.0, 0.0, np.pi / 2]))
    assert np.allclose(moved[:3, 3], T[:3, 3] + [0.01, 0.0, 0.0], atol=ROUNDING)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.allclose(moved[:3, :3], quarter @ T[:3, :3], atol=ROUNDING)


@given(poses)
def test_single_precision_is_made_a_rotation_again(T):
    checked = check_pose(T.astype(np.float32))
    assert np.allclose(checked[:3, :3].T @ checked[:3, :3], np.eye(3), atol=ROUNDING)
    assert np.allclose(checked, T, atol=1e-6)


def _changed(row, column, value):
    T = np.eye(4)
    T[row, column] = value
    return T


@pytest.mark.parametrize(
    "matrix",
    [
        _changed(0, 3, np.nan),
        _changed(1, 1, np.inf),
        _changed(0, 0, 1.01),
        _changed(2, 2, -1.0),
        _changed(3, 0, 0.1),
        np.zeros((4, 4)),
        np.eye(3),
        "pose",
        [[1.0], [2.0, 3.0]],
    ],
)
def test_what_is_no_rigid_pose_is_refused(matrix):
    with pytest.raises(PoseError, match="T_camera_object: got"):
        check_pose(matrix, "T_camera_object")


@pytest.mark.parametrize(
    "quaternion", [[0.0] * 4, [0.0, 0.0, 0.0, 1.01], [np.nan, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.99]]
)
def test_what_is_no_unit_quaternion_is_refused(quaternion):
    with pytest.raises(PoseError):
        pose_from_quaternion([0.0, 0.0, 0.3], quaternion)


def test_a_position_that_is_not_finite_is_refused():
    with pytest.raises(PoseError):
        pose_from_quaternion([0.0, np.inf, 0.3], [0.0, 0.0, 0.0, 1.0])
