"""Claims about frames of /tf, with a tf2_ros that remembers, and about one that is not there."""

import sys

import numpy as np
from std_msgs.msg import Header

from finforce.ros.frames import Frames
from finforce.transforms import pose_from_quaternion

POSE = pose_from_quaternion((0.1, -0.2, 0.3), (0.0, 0.6, 0.0, 0.8))


def test_a_transform_is_found_once_tf_connects_its_frames(tf):
    frames = Frames(None)
    assert frames.find("gripper_base", "camera") is None
    assert frames.listen()
    assert frames.find("gripper_base", "camera") is None
    tf["gripper_base", "camera"] = POSE
    np.testing.assert_allclose(frames.find("gripper_base", "camera"), POSE, atol=1e-12)


def test_a_pose_is_sent_as_that_of_the_child_in_the_headers_frame(tf):
    Frames(None).send(Header(frame_id="camera"), "left_jaw", POSE)
    (sent,) = tf["sent"]
    assert (sent.header.frame_id, sent.child_frame_id) == ("camera", "left_jaw")
    place, turn = sent.transform.translation, sent.transform.rotation
    np.testing.assert_allclose([place.x, place.y, place.z], [0.1, -0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], [0.0, 0.6, 0.0, 0.8], atol=1e-12)


def test_without_tf2_there_are_no_frames_and_nothing_breaks(monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    frames = Frames(None)
    assert not frames.listen() and frames.find("a", "b") is None
    frames.send(Header(), "left_jaw", POSE)
