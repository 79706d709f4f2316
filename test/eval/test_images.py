"""Claims about RGB-D recordings: what is written comes back, image by image, and what is wrong is named."""

import copy
import struct
import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest
from packet_fakes import KEY_EVERY, draw_pictures, encode_packets
from rclpy.serialization import deserialize_message
from rgbd_fakes import CAMERA, FakeGripper, make_fake_recording
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image

from finforce.camera import ImageError
from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from finforce.messages import DEPTH_HEADER, depth_encoding, depth_from_message, depth_steps
from finforce_eval.cli.twin import simulated_entries, write_simulated_recording
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.bags import PACKETS
from finforce_eval.recordings.images import CAMERA_INFO, ImageChoice, compress_depth
from finforce_eval.recordings.objects import find_mesh
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import Entry, header, make_message, typestore, write_entries
from finforce_eval.replay.playback import Playback
from finforce_sim.simulated_recording import encode_depth

FORMS = {"jpeg": True, "raw": False}


class Message:
    def __init__(self, **fields):
        vars(self).update(fields)


@pytest.fixture(scope="module", params=FORMS)
def written(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags") / "twin"
    return request.param, write_simulated_recording(
        make_fake_recording(), folder, compressed=FORMS[request.param], case={"scene": "fake"}
    )


def write_without(folder, *topics, simulated=None, edit=lambda entry: entry):
    """Write a plain recording without some topics, each message after an edit."""
    entries = simulated_entries(simulated or make_fake_recording(), FORMS["raw"])
    kept = [edit(entry) for entry in entries if entry.topic not in topics]
    return write_entries([entry for entry in kept if entry is not None], folder)


def test_images_come_back_as_they_were_taken(written):
    form, folder = written
    frames = list(make_fake_recording())
    images = read_recording(folder).images
    assert len(images) == len(frames) and len(images.unpaired) == 0
    for frame, (stamp, image) in zip(frames, images, strict=True):
        assert stamp == frame.stamp and image.stamp == pytest.approx(1e-9 * stamp, abs=1e-9)
        # a depth of 16 bits is in millimetres: half a step
        np.testing.assert_allclose(image.depth, frame.depth, atol=0.51e-3)
        assert np.isnan(image.depth[:4]).all()
        if form != "jpeg":
            np.testing.assert_array_equal(image.color, frame.color)
        else:  # saturated patches: a jpeg halves the resolution of their colours, not of their brightness
            assert np.abs(image.color.mean(axis=2) - frame.color.mean(axis=2)).mean() < 6.0
    for entry in fields(CAMERA):
        np.testing.assert_array_equal(getattr(images.camera, entry.name), getattr(CAMERA, entry.name))


def test_truth_comes_back_exactly(written):
    _, folder = written
    recording = read_recording(folder)
    track, frames = recording.jaws["left"], list(make_fake_recording())
    assert track.is_awaited and track.pose is None and track.keypoints.stamps_ns.size == 0
    np.testing.assert_array_equal(track.sight.stamps_ns, [frame.stamp for frame in frames])
    truths = [frame.jaws["left"] for frame in frames]
    np.testing.assert_allclose(track.sight.points, [truth.points for truth in truths], atol=1e-8)  # single precision
    np.testing.assert_allclose(track.sight.pixels, [truth.pixels for truth in truths], atol=1e-4)
    np.testing.assert_array_equal(track.sight.visible, [truth.visible for truth in truths])
    np.testing.assert_array_equal(track.truth.force, [truth.force for truth in truths])
    np.testing.assert_allclose(track.true_pose.position, [truth.T_camera_jaw[:3, 3] for truth in truths])
    assert recording.phases.displacement_mm.tolist() == [0.0, 1.0, 2.0]


def test_the_object_is_tracked_at_a_third_of_the_images_with_the_noise_of_the_bench():
    frames = list(make_fake_recording(FakeGripper(count=3000)))
    tracked = [frame for frame in frames if frame.T_camera_object is not None]
    assert [frame.stamp for frame in tracked] == [frame.stamp for frame in frames[::3]]
    positions = np.array([frame.T_camera_object[:3, 3] for frame in tracked])
    np.testing.assert_allclose(positions.std(axis=0), 0.3e-3, rtol=0.12)  # four sigma of 1000 samples
    turns = Rotation.from_matrix([frame.T_camera_object[:3, :3] for frame in tracked])
    angles = np.degrees((turns * turns.mean().inv()).as_rotvec())
    np.testing.assert_allclose(angles.std(axis=0), 0.3, rtol=0.12)
    assert list(make_fake_recording(FakeGripper(has_object=False)))[0].T_camera_object is None


def test_a_recording_is_the_same_twice_and_another_with_another_seed():
    first, second, other = make_fake_recording(), make_fake_recording(), make_fake_recording(seed=1)
    for one, two in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.color, two.color)
        np.testing.assert_array_equal(one.T_camera_object is None, two.T_camera_object is None)
    np.testing.assert_array_equal(next(iter(first)).T_camera_object, next(iter(second)).T_camera_object)
    assert not np.array_equal(next(iter(first)).T_camera_object, next(iter(other)).T_camera_object)


def test_the_mesh_is_found_and_found_again_when_the_folder_was_renamed(tmp_path):
    folder = write_simulated_recording(make_fake_recording(), tmp_path / "twin")
    assert find_mesh(read_recording(folder)) == folder / "object.stl"
    moved = folder.rename(tmp_path / "another")
    assert find_mesh(read_recording(moved)) == moved / "object.stl"


def test_reading_holds_few_images_at_a_time(tmp_path):
    folder = write_simulated_recording(
        make_fake_recording(FakeGripper(count=900)), tmp_path / "long", compressed=FORMS["raw"]
    )
    whole = 900 * (64 * 48 * 5)
    images = read_recording(folder).images
    tracemalloc.start()
    for _ in images:
        pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.5 * whole  # a chunk of the file, 1 MB, is read at once, and its index is kept


def test_images_without_camera_info_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="camera_info"):
        read_recording(write_without(tmp_path / "bag", INFO_TOPIC))


def test_images_without_depth_are_read_as_colours_alone(tmp_path):
    images = read_recording(write_without(tmp_path / "bag", DEPTH_TOPIC)).images
    frames = list(make_fake_recording())
    assert not images.has_depth and images.stamps_ns.tolist() == [frame.stamp for frame in frames]
    for frame, (_, image) in zip(frames, images, strict=True):
        assert image.depth is None
        np.testing.assert_array_equal(image.color, frame.color)


def test_depth_is_the_nearest_and_some_lost_depth_leaves_its_images_out(tmp_path):
    def late(entry):
        if entry.topic == DEPTH_TOPIC:
            entry.message.header.stamp.nanosec += 9_000_000
        return entry

    def lost(entry):
        is_fifth = entry.topic == DEPTH_TOPIC and entry.stamp == list(make_fake_recording())[5].stamp
        return None if is_fifth else entry

    folder = write_without(tmp_path / "late", edit=separate_headers(late))
    assert {round(1e3 * image.depth_delay) for _, image in read_recording(folder).images} == {9}
    with pytest.raises(RecordingError, match="no depth image .* within 8 ms"):
        read_recording(folder, ImageChoice(pairing=8_000_000))
    images = read_recording(write_without(tmp_path / "lost", edit=lost)).images
    assert len(images.unpaired) == 1 and len(list(images)) == 11
    everything = [image.depth is not None for _, image in images.all_colors()]
    assert everything == [number != 5 for number in range(12)]
    alone = images.colors_alone()
    assert [stamp for stamp, image in alone if image.depth is None] == [frame.stamp for frame in make_fake_recording()]


def test_both_jaws_are_looked_for_in_images_of_which_no_topic_tells_the_jaws(tmp_path):
    own = [f"/left/{name}" for name in ("ground_truth_wrench", "ground_truth_keypoints", "ground_truth_jaw_pose")]
    folder = write_without(tmp_path / "bag", *own)
    recording = read_recording(folder)
    assert set(recording.jaws) == {"left", "right"} and "--jaws left or right" in recording.notes[-1]
    assert set(read_recording(folder, sides=("right",)).jaws) == {"right"}
    assert set(read_recording(write_without(tmp_path / "measured", *own[1:])).jaws) == {"left"}


def separate_headers(edit):
    """Give the depth image a header of its own before an edit."""

    def edited(entry):
        if entry.topic == DEPTH_TOPIC:
            entry.message.header = copy.deepcopy(entry.message.header)
        return edit(entry)

    return edited


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [("encoding", "nv24", "encoding"), ("height", 40, "bytes"), ("step", 10, "bytes")],
)
def test_a_colour_image_that_cannot_be_read_is_named_with_its_time(tmp_path, field, value, reason):
    def edit(entry):
        if entry.topic == COLOR_TOPIC:
            setattr(entry.message, field, value)
        return entry

    images = read_recording(write_without(tmp_path / "bag", edit=edit)).images
    with pytest.raises(RecordingError, match=rf"1000\.000 s.*{reason}"):
        list(images)


def test_a_camera_that_changes_is_refused(tmp_path):
    seen = []

    def edit(entry):
        if entry.topic == INFO_TOPIC:
            seen.append(entry)
            entry.message.k[0] += 1.0 if len(seen) > 5 else 0.0
        return entry

    with pytest.raises(RecordingError, match="changes"):
        read_recording(write_without(tmp_path / "bag", edit=edit))


def test_depth_images_survive_packing_and_others_are_refused():
    depth = np.array([[0.0704, 0.5, np.nan], [65.535, 70.0, -1.0]])
    steps = encode_depth(depth)
    assert steps.tolist() == [[70, 500, 0], [65535, 0, 0]]
    packed = Message(format="16UC1; compressedDepth png", data=compress_depth(steps))
    np.testing.assert_array_equal(depth_steps(packed), steps)
    bare = Message(format="png", data=compress_depth(steps)[12:])
    np.testing.assert_allclose(depth_from_message(bare), [[0.07, 0.5, np.nan], [65.535, np.nan, np.nan]])
    grey = Message(format="png", data=compress_depth(np.zeros((2, 2, 3), np.uint8))[DEPTH_HEADER:])
    with pytest.raises(ImageError, match="16 bits"):
        depth_from_message(grey)
    with pytest.raises(ImageError, match="no png"):
        depth_from_message(Message(format="16UC1; compressedDepth rvl", data=b"\0" * 64))


def test_inverse_depths_of_a_packed_float_image_are_metres():
    depth = np.array([[0.16, 0.5, np.nan], [2.0, 9.0, 0.1]], np.float32)
    scale = 50.0 * 51.0  # as compressed_depth_image_transport packs it, with depth_quantization 50 and depth_max 10
    shift = 1.0 - scale / 10.0
    steps = np.nan_to_num(scale / depth + shift).astype(np.uint16)
    header = struct.pack("<iff", 0, scale, shift)
    packed = Message(format="32FC1; compressedDepth png", data=header + compress_depth(steps)[DEPTH_HEADER:])
    np.testing.assert_allclose(depth_from_message(packed), depth, rtol=4e-3)
    assert depth_encoding(depth_steps(packed)) == "32FC1"
    bare = Message(format="32FC1; compressedDepth png", data=compress_depth(steps))
    with pytest.raises(ImageError, match="its header has no scale of the inverse depths"):
        depth_from_message(bare)


def test_compressed_images_are_played_as_plain_ones_under_the_names_the_nodes_listen_to(tmp_path):
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import Image

    folder = write_simulated_recording(make_fake_recording(), tmp_path / "twin")
    played = list(Playback(folder))
    color = [deserialize_message(message.data, Image) for message in played if message.topic == COLOR_TOPIC]
    depth = [deserialize_message(message.data, Image) for message in played if message.topic == DEPTH_TOPIC]
    frames = list(make_fake_recording())
    assert len(color) == len(depth) == len(frames)
    assert {(image.encoding, image.width, image.height, image.step) for image in depth} == {("16UC1", 64, 48, 128)}
    assert {(image.encoding, image.step) for image in color} == {("rgb8", 192)}
    np.testing.assert_array_equal(np.frombuffer(depth[3].data, "<u2").reshape(48, 64), encode_depth(frames[3].depth))
    assert {message.msgtype for message in played if message.topic in (COLOR_TOPIC, DEPTH_TOPIC)} == {
        "sensor_msgs/msg/Image"
    }


def test_a_recording_that_breaks_off_leaves_no_recording(tmp_path):
    class Breaking(FakeGripper):
        def states(self):
            yield from list(super().states())[:3]
            raise RuntimeError("buckled")

    with pytest.raises(RuntimeError, match="buckled"):
        write_simulated_recording(make_fake_recording(Breaking()), tmp_path / "half")
    assert not (tmp_path / "half").exists()
    folder = write_simulated_recording(make_fake_recording(), tmp_path / "whole")
    with pytest.raises(RecordingError, match="exists already"):
        write_simulated_recording(make_fake_recording(), folder)
    assert folder.exists()


def test_key_points_that_were_recorded_do_not_need_whole_images(tmp_path):
    from eval_fakes import make_recording

    from finforce_eval.recordings.writer import recording_entries

    recording = replace(make_recording(frames=6), case={})
    entries = sorted(recording_entries(recording), key=lambda entry: entry.stamp)
    simulated = simulated_entries(make_fake_recording(), FORMS["raw"])
    colors = [entry for entry in simulated if entry.topic == COLOR_TOPIC]
    read = read_recording(write_entries([*entries, *colors], tmp_path / "bag"))
    assert read.images is None and any("camera_info" in note for note in read.notes)


COMPRESSED_IMAGE, VIDEO, PACKET = "sensor_msgs/msg/CompressedImage", *PACKETS
PICTURES = draw_pictures(3 * KEY_EVERY)


def write_packets(folder, kind, packets, *, with_info=True):
    """A bag with packets of a video, none where one is None, and camera_info."""
    types, entries = typestore(), []
    for name, fields_of_type in PACKETS.items():
        if name not in types.fielddefs:
            types.register(get_types_from_msg(fields_of_type, name))
    for number, data in enumerate(packets):
        stamp = 10**9 + 33_333_333 * number
        about, data = header(stamp, "camera_color_optical_frame"), np.frombuffer(data or b"", dtype=np.uint8)
        numbers = {"width": 128, "height": 96, "pts": number, "flags": 0, "is_bigendian": False}
        message = {
            COMPRESSED_IMAGE: {"header": about, "format": "h264", "data": data},
            VIDEO: {"timestamp": about["stamp"], "frame_id": about["frame_id"], "format": "h264", "data": data},
            PACKET: {"header": about, "encoding": "h264", "data": data, **numbers},
        }[kind]
        if len(data):
            entries.append(Entry(stamp, "/camera/video", make_message(kind, **message)))
        if with_info:
            k = np.array([100.0, 0.0, 64.0, 0.0, 100.0, 48.0, 0.0, 0.0, 1.0])
            info = {"header": about, "width": 128, "height": 96, "distortion_model": "plumb_bob", "d": np.zeros(5)}
            entries.append(Entry(stamp, "/camera/camera_info", make_message(CAMERA_INFO, **info, k=k)))
    return write_entries(entries, folder)


def numbers_of(pairs):
    """Numbers of the pictures of pairs of stamp [ns] and colours, each of which has to be right."""
    found = []
    for stamp, color in pairs:
        found.append(round((stamp - 10**9) / 33_333_333))
        assert np.abs(color.astype(int) - PICTURES[found[-1]]).mean() < 5.0  # of 255, by compression
    return found


@pytest.mark.parametrize("kind", [COMPRESSED_IMAGE, VIDEO, PACKET])
def test_packets_of_a_video_are_read_and_played_up_to_a_lost_one_and_from_the_next_key_frame_on(kind, tmp_path):
    packets = encode_packets(PICTURES)
    packets[:3] = [None] * 3  # recorded from the middle of a group of pictures on
    packets[KEY_EVERY + 5] = packets[KEY_EVERY + 5][:40]
    recording = read_recording(write_packets(tmp_path / "bag", kind, packets))
    images = recording.images
    assert images.is_video and len(images) == len(packets) - 3
    right = [*range(KEY_EVERY, KEY_EVERY + 5), *range(2 * KEY_EVERY, 3 * KEY_EVERY)]
    assert numbers_of((stamp, image.color) for stamp, image in images) == right
    some = images.at(images.stamps_ns[-4::2])  # needs those before, too
    assert numbers_of((stamp, image.color) for stamp, image in some) == [26, 28]
    played = [each for each in Playback(recording.source, images=images) if each.topic == COLOR_TOPIC]
    messages = [deserialize_message(each.data, Image) for each in played]
    colors = [np.frombuffer(each.data, dtype=np.uint8).reshape(96, 128, 3) for each in messages]
    assert numbers_of(zip((each.stamp for each in played), colors, strict=True)) == right


def test_packets_without_camera_info_are_of_the_size_of_their_pictures(tmp_path):
    bag = write_packets(tmp_path / "bag", VIDEO, [None, *encode_packets(PICTURES)[1:]], with_info=False)
    images = read_recording(bag, ImageChoice(intrinsics=("100", "100", "64", "48"))).images
    assert (images.camera.width, images.camera.height) == (128, 96)
    bag = write_packets(tmp_path / "none", VIDEO, encode_packets(PICTURES)[1:4], with_info=False)
    with pytest.raises(RecordingError, match="no image on /camera/video can be decoded: .* expected a key frame"):
        read_recording(bag, ImageChoice(intrinsics=("100", "100", "64", "48")))


def test_depth_of_another_clock_is_named_with_its_distance(tmp_path):
    def delay(entry):
        if entry.topic != DEPTH_TOPIC:
            return entry
        about = entry.message.header
        late = replace(about, stamp=replace(about.stamp, sec=about.stamp.sec + 100))
        return entry._replace(message=replace(entry.message, header=late))

    bag = write_without(tmp_path / "bag", edit=delay)
    with pytest.raises(RecordingError, match=r"no depth image .* nearest two are 9\d\.\d{3} s apart: stamps of two"):
        read_recording(bag)


def test_a_camera_that_was_never_calibrated_is_named_with_what_replaces_it(tmp_path):
    def empty(entry):
        zeros = {"k": np.zeros(9), "d": np.zeros(0), "distortion_model": ""}
        return entry._replace(message=replace(entry.message, **zeros)) if entry.topic == INFO_TOPIC else entry

    bag = write_without(tmp_path / "bag", edit=empty)
    with pytest.raises(RecordingError, match="expected a positive size.*; --intrinsics replaces it"):
        read_recording(bag)
    assert read_recording(bag, ImageChoice(intrinsics=("43", "44", "32", "24"))).images.camera.fx == 43.0
