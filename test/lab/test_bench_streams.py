"""What the benchmark of the chain plays: all that a camera sees, or true key points, and nothing else."""

import pytest
from rgbd_fakes import FakeCamera, FakeGripper

from finforce_eval.cli.twin import write_simulated_recording
from finforce_eval.recordings.images import IMAGE
from finforce_sim.simulated_recording import SimulatedRecording
from lab.bench.chain import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC, OBJECT_TOPIC, stream_images, stream_keypoints


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A recording of seven images."""
    return write_simulated_recording(
        SimulatedRecording(FakeGripper(count=7), FakeCamera(), 0), tmp_path_factory.mktemp("bags") / "twin"
    )


def test_images_of_a_recording_come_decoded_with_their_camera(bag):
    stream = stream_images(bag)
    topics = [kept.topic for kept in stream]
    assert topics.count(COLOR_TOPIC) == topics.count(DEPTH_TOPIC) == topics.count(INFO_TOPIC) == 7
    assert {kept.msgtype for kept in stream if kept.topic in (COLOR_TOPIC, DEPTH_TOPIC)} == {IMAGE}
    assert set(stream.types) == {COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC, OBJECT_TOPIC}


def test_true_key_points_of_a_recording_come_at_every_image(bag):
    topics = [kept.topic for kept in stream_keypoints(bag)]
    assert topics.count("/left/keypoints") == topics.count("/left/jaw_pose") == 7
    assert set(topics) == {"/left/keypoints", "/left/jaw_pose", OBJECT_TOPIC}
