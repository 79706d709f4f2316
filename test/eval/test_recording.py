"""Claims about reading and writing recordings; every file is a real bag in a temporary folder."""

import json
from dataclasses import replace

import numpy as np
import pytest
from eval_fakes import PERIOD, START, make_recording
from mcap.writer import Writer

from finforce.messages import SharedStddev
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.frames import FrameImages
from finforce_eval.recordings.images import ImageTrack
from finforce_eval.recordings.objects import ObjectTrack, iter_frames
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import DetectionTrack, DetectionTruth, Timed, check_stamps, parse_phases
from finforce_eval.recordings.writer import (
    Entry,
    cloud_message,
    make_message,
    recording_entries,
    typestore,
    write_entries,
    write_recording,
)
from finforce_eval.table import ForceSeries

CLOUD = "sensor_msgs/msg/PointCloud2"


@pytest.fixture
def entries():
    """The messages of a good recording, to be spoilt."""
    return sorted(recording_entries(make_recording()), key=lambda entry: entry.stamp)


def spoil(entries, topic, number, change):
    """Change the message `number` of a topic in place."""
    change([entry for entry in entries if entry.topic == topic][number].message)
    return entries


def assert_same(read, written):
    assert read.jaws.keys() == written.jaws.keys()
    for side, track in written.jaws.items():
        for part in ("keypoints", "truth", "pose"):
            for name, value in vars(getattr(track, part)).items():
                np.testing.assert_array_equal(getattr(getattr(read.jaws[side], part), name), value, err_msg=name)
    for name, value in vars(written.phases).items():
        np.testing.assert_array_equal(getattr(read.phases, name), value, err_msg=name)
    np.testing.assert_array_equal(read.object_pose.position, written.object_pose.position)
    assert read.case == written.case


@pytest.mark.parametrize("single_file", [False, True])
@pytest.mark.parametrize(("storage", "compressed"), [("mcap", False), ("mcap", True), ("sqlite3", False)])
def test_reading_inverts_writing(tmp_path, storage, compressed, single_file):
    written = make_recording("pressed")
    folder = write_recording(written, tmp_path / "pressed", storage=storage, compressed=compressed)
    path = next(folder.glob("pressed.*")) if single_file else folder
    read = read_recording(path)
    assert read.name == "pressed"
    assert read.notes == ()
    assert_same(read, written)


def test_what_the_points_of_an_image_share_is_read_as_it_was_written(tmp_path):
    written = make_recording("held")
    jaws = dict(written.jaws)
    for side, jaw in jaws.items():
        shared = np.linspace((1e-3, 0.0, 0.01, 0.0), (3e-3, 2e-3, 0.02, 1e-3), len(jaw.keypoints.stamps_ns)).astype(
            np.float32
        )
        jaws[side] = replace(jaw, keypoints=replace(jaw.keypoints, shared=shared.astype(np.float64)))
    written = replace(written, jaws=jaws)
    read = read_recording(write_recording(written, tmp_path / "held"))
    assert_same(read, written)
    track = next(iter(read.jaws.values())).keypoints
    assert track.observation(2).shared == SharedStddev(*track.shared[2]) > SharedStddev(*track.shared[0])


def test_times_in_python_are_seconds_as_an_estimator_takes_them():
    recording = make_recording()
    track = recording.jaws["left"]
    for part in (track.keypoints, track.truth, track.pose, recording.phases, recording.object_pose):
        np.testing.assert_allclose(part.stamps, 1e-9 * part.stamps_ns, rtol=1e-15)
    images = list(iter_frames(recording))
    assert track.keypoints.stamps.tolist() == [image.observation.stamp for image in images]
    assert all(type(image.observation.stamp) is float for image in images)
    series = ForceSeries.build("one", "left", track.keypoints.stamps_ns)
    assert series.stamps.tolist() == track.keypoints.stamps.tolist()
    assert all(
        issubclass(each, Timed) for each in (DetectionTrack, DetectionTruth, FrameImages, ImageTrack, ObjectTrack)
    )


def test_recording_of_the_right_jaw_is_read(tmp_path):
    read = read_recording(write_recording(make_recording(side="right"), tmp_path / "bag"))
    assert list(read.jaws) == ["right"]
    with pytest.raises(RecordingError, match="no key points of the left jaw; the recording has right"):
        read.jaw("left")


def test_folder_without_metadata_is_read_when_it_holds_one_file(tmp_path):
    written = make_recording()
    folder = write_recording(written, tmp_path / "bag")
    (folder / "metadata.yaml").unlink()
    assert_same(read_recording(folder), written)


def test_recording_without_truth_phases_and_case_is_read(tmp_path):
    written = replace(make_recording(phases=False, truth=False), case={})
    read = read_recording(write_recording(written, tmp_path / "bag"))
    assert read.phases is None
    assert read.case == {}
    with pytest.raises(RecordingError, match="bag: no ground truth: /left/ground_truth_wrench"):
        read.truth("left")


def test_unknown_types_are_skipped_with_a_note(tmp_path, entries):
    from rosbags.rosbag2 import StoragePlugin, Writer

    types = typestore()
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        odd = writer.add_connection("/odd", "own_msgs/msg/Odd", msgdef="own_msgs/Lost part", rihs01="RIHS01_0")
        cloud = writer.add_connection("/left/keypoints", CLOUD, typestore=types)
        writer.write(odd, START, b"\x00\x01\x00\x00")
        for entry in entries:
            if entry.topic == "/left/keypoints":
                writer.write(cloud, entry.stamp, types.serialize_cdr(entry.message, CLOUD))
    read = read_recording(tmp_path / "bag")
    assert read.notes == ("/odd skipped: unknown type own_msgs/msg/Odd",)
    assert len(read.jaws["left"].keypoints.stamps_ns) == 60


def test_garbage_is_refused(tmp_path):
    (tmp_path / "bag.mcap").write_bytes(b"what is this" * 100)
    with pytest.raises(RecordingError, match="truncated or damaged"):
        read_recording(tmp_path / "bag.mcap")
    (tmp_path / "metadata.yaml").write_text("a: [1")
    with pytest.raises(RecordingError, match="truncated or damaged"):
        read_recording(tmp_path)


def test_absent_and_empty_places_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="no such recording"):
        read_recording(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match="no metadata.yaml, .mcap, .db3 or pictures in it"):
        read_recording(tmp_path)
    (tmp_path / "a.TIFF").write_bytes(b"II")
    with pytest.raises(RecordingError, match=r"pictures in it, but \.TIFF; expected pictures as \.png, \.jpg, \.jpeg"):
        read_recording(tmp_path)
    (tmp_path / "bag_0.mcap.zstd").write_bytes(b"\x28\xb5\x2f\xfd")
    with pytest.raises(RecordingError, match=r"bag_0\.mcap\.zstd: compressed as a whole: unpack it with zstd -d FILE"):
        read_recording(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(RecordingError, match="not a recording"):
        read_recording(tmp_path / "notes.txt")


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_empty_recording_is_refused(tmp_path, storage):
    write_entries([], tmp_path / "bag", storage=storage)
    with pytest.raises(RecordingError, match="empty"):
        read_recording(tmp_path / "bag")


def test_recording_without_key_points_is_refused(tmp_path, entries):
    rest = [entry for entry in entries if entry.topic != "/left/keypoints"]
    write_entries(rest, tmp_path / "bag")
    with pytest.raises(RecordingError, match="no key points"):
        read_recording(tmp_path / "bag")


def test_our_topic_with_another_type_is_refused(tmp_path):
    entry = Entry(START, "/left/keypoints", make_message("std_msgs/msg/String", data="hello"))
    write_entries([entry], tmp_path / "bag")
    with pytest.raises(RecordingError, match="is std_msgs/msg/String; expected sensor_msgs/msg/PointCloud2"):
        read_recording(tmp_path / "bag")


def drop_points(message):
    message.width, message.row_step, message.data = 3, 48, message.data[:48]


def empty(message):
    message.width, message.row_step, message.data = 0, 0, message.data[:0]


def cut_buffer(message):
    message.data = message.data[:10]


def rename_x(message):
    message.fields[0].name = "u"


def wrong_frame(message):
    message.header.frame_id = "map"


def go_back(message):
    message.header.stamp.sec -= 5


def stand_still(message):
    seconds, nanoseconds = divmod(START + 6 * PERIOD, 1_000_000_000)
    message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds


def make_infinite(message):
    data = np.array(message.data)
    data[:4] = np.frombuffer(np.float32(np.inf).tobytes(), dtype=np.uint8)
    message.data = data


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (drop_points, "message 7 has 3 key points, the first 4"),
        (empty, "message 7 has 0 key points"),
        (cut_buffer, "message 7: the cloud's buffer holds 10 bytes; 64 were announced"),
        (rename_x, "message 7: the cloud has no field x"),
        (wrong_frame, "frame 'map'; expected 'left_jaw'"),
        (go_back, "go back at message 7"),
        (stand_still, "stand still at message 7"),
        (make_infinite, "message 7 has infinite coordinates"),
    ],
)
def test_spoilt_key_points_are_refused(tmp_path, entries, change, reason):
    write_entries(spoil(entries, "/left/keypoints", 7, change), tmp_path / "bag")
    with pytest.raises(RecordingError, match=reason):
        read_recording(tmp_path / "bag")


def test_stamps_of_0_are_named_as_none():
    with pytest.raises(RecordingError, match="stand still at message 1, 0.000 s: 0 is no time"):
        check_stamps([0, 0, START], "/camera", "bag")


@pytest.mark.parametrize(
    ("peak", "first", "count", "left_out", "step"),
    [
        (50.0, 20, 2, 2, PERIOD),
        (50.0, 20, 3, 0, PERIOD),  # lasts
        (4.0, 20, 1, 0, PERIOD),
        (50.0, 0, 2, 2, PERIOD),
        (50.0, 58, 2, 0, PERIOD),  # a load may begin at the end
        (50.0, 20, 1, 0, 10 * PERIOD),  # a reading per photograph
    ],
)
def test_forces_that_a_sensor_never_measured_are_left_out_with_a_note(
    tmp_path, entries, peak, first, count, left_out, step
):
    readings = [entry.message for entry in entries if entry.topic == "/left/ground_truth_wrench"]
    for number, message in enumerate(readings):
        stamp = START + number * step
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        if first <= number < first + count:
            message.wrench.force.y = peak
    write_entries(entries, tmp_path / "bag")
    read = read_recording(tmp_path / "bag")
    assert len(read.jaw("left").truth.stamps_ns) == len(readings) - left_out
    said = f"{left_out} of {len(readings)} forces left out, up to 50 N where three of five in a row show "
    assert any(said in note for note in read.notes) == bool(left_out)


def test_truth_in_another_frame_is_refused(tmp_path, entries):
    write_entries(spoil(entries, "/left/ground_truth_wrench", 0, wrong_frame), tmp_path / "bag")
    with pytest.raises(RecordingError, match="frame 'map'; expected 'left_jaw'"):
        read_recording(tmp_path / "bag")


@pytest.mark.parametrize(
    "text",
    ["", "0:load:2", "a:load:2:ramp", "0:push:2:ramp", "0:load:two:ramp", "0:load:nan:ramp", "0:load:2:wait"],
)
def test_malformed_phase_is_refused(text):
    with pytest.raises(RecordingError, match="case: /bench/phase says '.*'; expected cycle:load"):
        parse_phases([START], [text], "case")


def test_phases_that_go_back_are_refused():
    with pytest.raises(RecordingError, match="go back"):
        parse_phases([START, START - 1], ["0:load:0:ramp", "0:load:2:ramp"], "case")


def test_phase_holds_from_its_stamp_to_the_next():
    phases = parse_phases([10, 20], ["0:load:0:ramp", "0:load:2:record"], "case")
    assert phases.index_at(np.array([9, 10, 19, 20, 99])).tolist() == [-1, 0, 0, 1, 1]


@pytest.mark.parametrize("text", ["{", "[1]"])
def test_malformed_case_is_refused(tmp_path, text):
    folder = write_recording(make_recording(), tmp_path / "bag")
    (folder / "case.json").write_text(text)
    with pytest.raises(RecordingError, match="bag/case.json"):
        read_recording(folder)


def test_case_beside_a_single_file_is_read(tmp_path):
    folder = write_recording(make_recording(), tmp_path / "bag")
    (folder / "case.json").write_text(json.dumps({"object": {"z": 61.5}}))
    assert read_recording(folder / "bag.mcap").case["object"]["z"] == 61.5


def test_existing_folder_is_never_overwritten(tmp_path):
    with pytest.raises(RecordingError, match="exists already"):
        write_recording(make_recording(), tmp_path)


@pytest.mark.parametrize("topic", ["/object_pose", "/left/jaw_pose"])
def test_poses_of_one_topic_in_two_frames_are_refused(tmp_path, entries, topic):
    def rename(message):
        message.header.frame_id = "other"

    bag = write_entries(spoil(entries, topic, 2, rename), tmp_path / "bag")
    with pytest.raises(RecordingError, match=f"bag: {topic} message 2 is in the frame 'other', the first in 'camera_"):
        read_recording(bag)


def stated(number, *, axes="xyz"):
    """An entry with four key points that state their standard deviations, the second not valid."""
    columns = {axis: np.float32([0, 1, 2, 3]) for axis in "xyz"}
    columns |= {f"stddev_{axis}": np.float32([1e-3, np.nan, 2e-3, 3e-3]) for axis in axes}
    columns["valid"] = np.array([1, 0, 1, 1], dtype="u1")
    stamp = START + number * PERIOD
    return Entry(stamp, "/left/keypoints", cloud_message(stamp, "left_jaw", columns))


def test_stated_deviations_go_with_the_key_points(tmp_path):
    write_entries([stated(0), stated(1)], tmp_path / "bag")
    track = read_recording(tmp_path / "bag").jaw("left").keypoints
    np.testing.assert_array_equal(track.stddev[:, 2:, 1], np.float32([[2e-3, 3e-3]] * 2))
    observation = track.observation(1)
    np.testing.assert_array_equal(observation.stddev, track.stddev[1])
    assert np.isnan(observation.points[1]).all() and observation.stamp == track.stamps_ns[1] * 1e-9


def test_recording_without_deviations_has_none(tmp_path, entries):
    write_entries(entries, tmp_path / "bag")
    track = read_recording(tmp_path / "bag").jaw("left").keypoints
    assert track.stddev is None and track.observation(0).stddev is None


@pytest.mark.parametrize(("axes", "reason"), [("", "message 1 differs from the first"), ("xy", "expected all of")])
def test_deviations_in_some_messages_or_along_some_axes_are_refused(tmp_path, axes, reason):
    write_entries([stated(0), stated(1, axes=axes)], tmp_path / "bag")
    with pytest.raises(RecordingError, match=reason):
        read_recording(tmp_path / "bag")


@pytest.mark.parametrize("profile", ["", "ros2"])
@pytest.mark.parametrize("schema", ["protobuf", "jsonschema"])
def test_messages_of_other_systems_are_no_damage(schema, profile, tmp_path):
    path = tmp_path / "arm.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile, "test")
        channel = writer.register_channel("/wrist", "protobuf", writer.register_schema("foxglove.Video", schema, b"x"))
        writer.add_message(channel, 1, b"x", 1)
        writer.finish()
    with pytest.raises(RecordingError, match=r"^arm: not of ROS 2: .*; not one message is whole and in CDR"):
        read_recording(path)
