"""Claims about recorded messages that are published again."""

from threading import Event, get_ident

import pytest
from eval_fakes import START, make_recording
from node_fakes import ros_domain
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from finforce.camera_topics import COLOR_TOPIC
from finforce.messages import NANOSECONDS
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.writer import write_recording
from finforce_eval.replay import playback
from finforce_eval.replay.node import PlayerNode, PlayerParameters, find_awaited
from finforce_eval.replay.playback import Playback, RawMessage, ReadAhead


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def folder(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "case"
    return write_recording(make_recording(frames=10), path, storage=request.param)


def test_messages_come_in_the_order_of_their_receipt_with_their_stamps(folder):
    messages = Playback(folder)
    times = [message.time for message in messages]
    assert times == sorted(times) and times[0] == START
    clouds = [message for message in messages if message.topic == "/left/keypoints"]
    assert len(clouds) == 10
    assert [message.stamp for message in clouds] == [message.time for message in clouds]


def test_topics_can_be_left_out(folder):
    topics = {message.topic for message in Playback(folder, without={"/left/keypoints"})}
    assert "/left/ground_truth_wrench" in topics and "/left/keypoints" not in topics


def test_a_new_stamp_changes_nothing_but_the_stamp(folder):
    message = next(m for m in Playback(folder) if m.topic == "/left/keypoints")
    before = deserialize_message(message.data, PointCloud2)
    after = deserialize_message(message.restamped(1_700_000_000_123_456_789), PointCloud2)
    assert (after.header.stamp.sec, after.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    after.header.stamp = before.header.stamp
    assert after == before


def test_a_message_without_a_header_keeps_its_bytes(folder):
    message = next(m for m in Playback(folder) if m.topic == "/bench/phase")
    assert message.stamp == message.time
    assert message.restamped(1) == message.data
    assert deserialize_message(message.data, String).data.startswith("0:load")


def test_big_endian_stamps_are_read_and_written():
    data = bytes([0, 0, 0, 0]) + (7).to_bytes(4, "big") + (5).to_bytes(4, "big") + b"rest"
    message = RawMessage(0, "/t", "p/msg/N", data, True)
    assert message.stamp == 7_000_000_005
    assert message.restamped(8_000_000_006) == data[:4] + b"\0\0\0\x08\0\0\0\x06rest"


@pytest.mark.parametrize(("seconds", "lag"), [(0, 0), (2, 0), (997, 997), (-4247, -4247)])
def test_receipts_by_another_clock_than_the_stamps_are_brought_to_theirs(seconds, lag, folder, monkeypatch):
    own = playback.read_stamp
    monkeypatch.setattr(playback, "read_stamp", lambda data: own(data) - seconds * NANOSECONDS)
    messages = Playback(folder)
    assert messages.begin == next(iter(messages)).time == START - lag * NANOSECONDS


def test_a_bag_without_anything_to_play_is_refused(folder):
    every = {message.topic for message in Playback(folder)}
    with pytest.raises(RecordingError, match="nothing to be played"):
        Playback(folder, without=every)


def test_messages_are_read_before_they_are_asked_for_up_to_the_depth():
    read, threads = {2: Event(), 3: Event(), 4: Event()}, set()

    def items():
        for number in (1, 2, 3, 4):
            threads.add(get_ident())
            if number in read:
                read[number].set()
            yield number

    ahead = ReadAhead(items(), depth=2)
    # 10 s: nobody asks, and they come all the same
    assert read[2].wait(10.0)
    assert not read[3].wait(0.3)
    assert list(ahead) == [1, 2, 3, 4]
    assert len(threads) == 1 and get_ident() not in threads


def test_what_fails_in_reading_ahead_is_said_in_its_place():
    def items():
        yield 1
        raise RecordingError("damaged")

    ahead = iter(ReadAhead(items()))
    assert next(ahead) == 1
    with pytest.raises(RecordingError, match="damaged"):
        next(ahead)


def test_a_reader_that_is_left_is_closed():
    closed = Event()
    ahead = ReadAhead(endless(closed), depth=3)
    ahead.close()
    assert closed.wait(10.0)


def endless(closed):
    try:
        while True:
            yield 1
    finally:
        closed.set()


TOPICS = ("/left/ground_truth_wrench", "/right/ground_truth_wrench", COLOR_TOPIC, "/object_pose", "/left/keypoints")


@pytest.mark.parametrize(
    ("asked", "awaited"),
    [
        ({}, {"/left/keypoints"}),
        ({"awaits_images": True}, {COLOR_TOPIC, "/left/keypoints", "/right/keypoints"}),
        (
            {"awaits_images": True, "awaits_poses": True},
            {COLOR_TOPIC, *(f"/{side}/{kind}" for side in ("left", "right") for kind in ("keypoints", "jaw_pose"))},
        ),
    ],
)
def test_a_recording_waits_for_those_who_need_it_from_its_first_image(asked, awaited):
    assert find_awaited(TOPICS, PlayerParameters(**asked)) == awaited


def test_a_recording_is_played_in_the_namespace_of_its_player(folder):
    with ros_domain() as probe:
        player = PlayerNode(context=probe.context, namespace="r2")
        player.offer(Playback(folder))
        names = {out.topic_name for out in player._outputs.values()}
        assert "/r2/left/keypoints" in names and all(name.startswith("/r2/") for name in names)
        probe.hear("/r2/left/keypoints", PointCloud2)
        probe.wait_for(lambda: player.has_listeners({"/left/keypoints"}))
        player.destroy_node()
