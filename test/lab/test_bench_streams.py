"""Films: the messages of one rate and no others, and what follows when they are played again."""

import struct

import pytest
from rgbd_fakes import FakeGripper, FakePhotographer

from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from finforce_eval.cli.twin import write_footage
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.images import IMAGE
from finforce_eval.replay.playback import RawMessage
from finforce_sim.footage import Footage
from lab.bench.chain import (
    FINE_RATE,
    OBJECT_TOPIC,
    START,
    slot_of,
    stream_images,
    stream_keypoints,
    thin_messages,
)
from lab.scenes import EVERY_RATE, SmoothGripper


def message(slot, topic="/left/keypoints"):
    stamp = START + round(slot * 1e9 / FINE_RATE)
    data = b"\0\1\0\0" + struct.pack("<iI", *divmod(stamp, 10**9)) + b"rest"
    return RawMessage(stamp, topic, "sensor_msgs/msg/PointCloud2", data, True)


SLOTS = [6 * cycle + slot for cycle in range(10) for slot in EVERY_RATE]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A recording of seven states of the script, in images of 30, 60 and 90 Hz."""
    gripper = SmoothGripper(FakeGripper(count=7), EVERY_RATE)
    footage = Footage(gripper, FakePhotographer(), 0)
    return write_footage(footage, tmp_path_factory.mktemp("bags") / "twin")


@pytest.mark.parametrize("rate", [30, 60, 90])
def test_film_holds_every_image_of_its_rate_and_no_other(rate):
    stream = thin_messages([message(slot) for slot in SLOTS], {"/left/keypoints"}, rate)
    step = FINE_RATE // rate
    assert [slot_of(kept.stamp) for kept in stream] == list(range(0, 60, step))


def test_object_is_tracked_at_ten_hertz_whatever_the_camera_does():
    messages = [message(slot, topic) for slot in SLOTS for topic in ("/left/keypoints", OBJECT_TOPIC)]
    stream = thin_messages(messages, {"/left/keypoints", OBJECT_TOPIC}, 90)
    assert [slot_of(kept.stamp) for kept in stream if kept.topic == OBJECT_TOPIC] == [0, 18, 36, 54]


def test_topics_that_nobody_asked_for_are_left_out():
    messages = [message(slot, topic) for slot in SLOTS for topic in ("/left/keypoints", "/left/ground_truth_wrench")]
    assert set(thin_messages(messages, {"/left/keypoints"}, 30).types) == {"/left/keypoints"}


@pytest.mark.parametrize(("slots", "rate"), [([0, 6, 18], 30), (range(0, 60, 6), 90), ([], 30), (SLOTS, 50)])
def test_a_scene_without_all_images_of_the_rate_is_refused(slots, rate):
    with pytest.raises(RecordingError, match=f"{rate} Hz"):
        thin_messages([message(slot) for slot in slots], {"/left/keypoints"}, rate)


def test_images_of_a_recording_come_decoded_with_their_camera(bag):
    stream = stream_images(bag, 60)
    topics = [kept.topic for kept in stream]
    assert topics.count(COLOR_TOPIC) == topics.count(DEPTH_TOPIC) == topics.count(INFO_TOPIC) == 13
    assert {kept.msgtype for kept in stream if kept.topic in (COLOR_TOPIC, DEPTH_TOPIC)} == {IMAGE}
    assert OBJECT_TOPIC in stream.types


def test_true_key_points_of_a_recording_come_at_every_image(bag):
    topics = [kept.topic for kept in stream_keypoints(bag, 90)]
    assert topics.count("/left/keypoints") == topics.count("/left/jaw_pose") == 19
    assert COLOR_TOPIC not in topics
