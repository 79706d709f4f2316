"""Claims about other people's recordings: their topics and datasets are found, and nothing found is no success."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from eval_fakes import FakeEstimator, FakeJaw, change_info, evaluate_recording, make_recording
from rclpy.serialization import deserialize_message
from rgbd_fakes import CAMERA, FakeDetector, FakeGripper, make_fake_recording
from rosbags.rosbag2 import StoragePlugin, Writer
from sensor_msgs.msg import CameraInfo

from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from finforce.messages import CameraStream, camera_from_info, same_camera
from finforce_contact.loop import GivenContact
from finforce_eval.cli.main import main
from finforce_eval.cli.twin import simulated_entries, write_simulated_recording
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.comparison import compare_evaluations
from finforce_eval.evaluation.forces import ImageRun, check_solved, find_forces, why_unanswered
from finforce_eval.evaluation.keypoint_source import detect_keypoints
from finforce_eval.recordings.bags import open_bag
from finforce_eval.recordings.dataset import open_dataset, read_parquet
from finforce_eval.recordings.images import ImageChoice
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import typestore, write_entries
from finforce_eval.replay.playback import Playback

OWN = {f"/left/{name}" for name in ("ground_truth_wrench", "ground_truth_keypoints", "ground_truth_jaw_pose")}
USB = {COLOR_TOPIC: "/image_raw", INFO_TOPIC: "/camera_info"}
ZED = {
    COLOR_TOPIC: "/zed/left/image_rect_color",
    INFO_TOPIC: "/zed/left/camera_info",
    DEPTH_TOPIC: "/zed/depth/depth_registered",
}


class LeftOnly(FakeDetector):
    """Finds the left jaw alone."""

    def detect(self, image):
        return {side: found for side, found in super().detect(image).items() if side == "left"}


def test_a_jaw_that_is_never_seen_has_no_force_and_the_other_keeps_its_own(tmp_path):
    simulated = make_fake_recording(FakeGripper(sides=("left", "right")))
    recording = read_recording(write_simulated_recording(simulated, tmp_path / "bag"))
    blind = {side: replace(track, sight=None, truth=None) for side, track in recording.jaws.items()}
    found = detect_keypoints(replace(recording, jaws=blind), LeftOnly(recording))
    left, right = (found.jaws[side].keypoints for side in ("left", "right"))
    assert right.points.shape == left.points.shape and np.isnan(right.points).all() and not right.likelihood.any()
    assert "the right jaw is in none of the images" in found.notes
    series = find_forces(found, None, GivenContact(None), FakeEstimator([]), "right", ImageRun(strict=True))
    assert len(series) == 12 and not series.solved.any()
    assert set(series.column("status")) == {"not found"} and "none of the images" in series.column("message")[0]


def test_a_force_now_and_then_is_none(tmp_path):
    recording = make_recording(phases=False)
    count = len(recording.jaw("left").keypoints.stamps_ns)
    told = "a force in 5 of 60 images, on all jaws that were found, expected 6 at least"
    for answered, expected in ((5, told), (6, "")):
        forces = [[0.0, 0.0, 0.0]] * answered + [None] * (count - answered)
        series = evaluate_recording(recording, FakeJaw(), GivenContact(None), FakeEstimator(forces))
        assert why_unanswered([series]).startswith(expected) and bool(why_unanswered([series])) == bool(expected)


class TaringEstimator(FakeEstimator):
    def update(self, observation, contact):
        return replace(super().update(observation, contact), status="waiting", message="44 more unloaded frames")


@pytest.mark.parametrize(("estimator", "hinted"), [(TaringEstimator, True), (FakeEstimator, False)])
def test_pictures_too_few_for_a_tare_are_told_to_be_taken_as_stills(estimator, hinted):
    recording = make_recording(phases=False)
    forces = [None] * len(recording.jaw("left").keypoints.stamps_ns)
    series = find_forces(recording, FakeJaw(), GivenContact(None), estimator(forces), "left", ImageRun(strict=True))
    assert ("--stills" in why_unanswered([series])) == hinted


def write_renamed(folder, names, **options):
    """A recording whose camera topics have other names, and no topic of a jaw."""
    entries = simulated_entries(make_fake_recording(), False)
    kept = [each._replace(topic=names[each.topic]) for each in entries if each.topic in names]
    return write_entries(kept, folder, **options)


@pytest.mark.parametrize(("names", "has_depth"), [(USB, False), (ZED, True)])
def test_the_only_camera_of_a_bag_is_found_whatever_its_topics_are_called(names, has_depth, tmp_path):
    recording = read_recording(write_renamed(tmp_path / "bag", names))
    images = recording.images
    assert images.topics[0] == names[COLOR_TOPIC] and images.info == names[INFO_TOPIC]
    assert images.has_depth == has_depth and images.camera.fx == CAMERA.fx
    assert len(list(images)) == 12 and set(recording.jaws) == {"left", "right"}
    played = {message.topic for message in Playback(recording.source, images=images)}
    assert played == {COLOR_TOPIC, INFO_TOPIC} | ({DEPTH_TOPIC} if has_depth else set())


def two_cameras(folder):
    entries = simulated_entries(make_fake_recording(), False)
    kept = [each for each in entries if each.topic in ZED]
    right = {name: topic.replace("left", "right") for name, topic in ZED.items() if name != DEPTH_TOPIC}
    both = [each._replace(topic=names[each.topic]) for names in (ZED, right) for each in kept if each.topic in names]
    return write_entries(sorted(both, key=lambda each: each.stamp), folder)


@pytest.mark.parametrize(("names", "is_rectified"), [(USB, False), (ZED, True)])
def test_rectified_images_have_the_projection_matrix_and_no_lens(names, is_rectified, tmp_path):
    """image_pipeline 1035: image_proc's images come with the camera_info of the raw ones."""
    projection = np.array([40.0, 0.0, 30.0, 0.0, 0.0, 41.0, 22.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    entries = [
        each._replace(topic=names[each.topic], message=replace(each.message, p=projection) if is_info else each.message)
        for each in simulated_entries(make_fake_recording(), False)
        if each.topic in names
        for is_info in [each.topic == INFO_TOPIC]
    ]
    camera = read_recording(write_entries(entries, tmp_path / "bag")).images.camera
    assert (camera.fx, camera.cy) == ((40.0, 22.0) if is_rectified else (CAMERA.fx, CAMERA.cy))
    assert camera.distortion.any() != is_rectified
    info = next(each.message for each in entries if each.topic == names[INFO_TOPIC])
    stream = CameraStream(topic=names[COLOR_TOPIC])
    assert stream.take_info(info) and same_camera(stream.camera, camera)


def test_of_several_cameras_one_is_named(tmp_path, capsys):
    bag = two_cameras(tmp_path / "bag")
    with pytest.raises(RecordingError, match="expected --color with one of /zed/left/.*, /zed/right/"):
        read_recording(bag)
    images = read_recording(bag, ImageChoice(color="/zed/right/image_rect_color")).images
    assert images.info == "/zed/right/camera_info"
    with pytest.raises(RecordingError, match="nothing on /camera; the topics of its cameras are .*/zed/left/"):
        read_recording(bag, ImageChoice(color="/camera"))
    forces = ["--contact", "fixed:40"]
    commands = {"annotate": [*forces, "--out", str(tmp_path / "out")], "check": [], "extrinsics": []}
    commands["view"] = [*forces, "--save", str(tmp_path / "x.rrd")]
    for command, words in (commands | dict.fromkeys(("evaluate", "replay", "trace"), forces)).items():
        assert main([command, str(bag), *words, "--color", "/nowhere"]) == 2
        assert "nothing on /nowhere" in capsys.readouterr().err


def test_depth_in_another_frame_is_not_taken_for_aligned_depth(tmp_path):
    def elsewhere(entry):
        if entry.topic == DEPTH_TOPIC:
            header = replace(entry.message.header, frame_id="camera_depth_optical_frame")
            return entry._replace(message=replace(entry.message, header=header))
        return entry

    entries = [elsewhere(each) for each in simulated_entries(make_fake_recording(), False)]
    kept = [each._replace(topic=ZED[each.topic]) for each in entries if each.topic in ZED]
    bag = write_entries(kept, tmp_path / "bag")
    recording = read_recording(bag)
    assert not recording.images.has_depth
    (note,) = (note for note in recording.notes if "depth" in note)
    assert ZED[DEPTH_TOPIC] in note and "'camera_depth_optical_frame'" in note and "align_depth.enable:=true" in note
    chosen = read_recording(bag, ImageChoice(depth=ZED[DEPTH_TOPIC]))
    assert chosen.images.has_depth and not any("depth" in note for note in chosen.notes)


def test_a_depth_topic_without_images_is_named(tmp_path):
    bag = write_renamed(tmp_path / "bag", USB)
    with Writer(tmp_path / "empty", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection(DEPTH_TOPIC, "sensor_msgs/msg/Image", typestore=typestore())
        with open_bag(bag, "bag") as read:
            for connection, stamp, data in read.messages():
                copied = next((each for each in writer.connections if each.topic == connection.topic), None)
                copied = copied or writer.add_connection(connection.topic, connection.msgtype, typestore=typestore())
                writer.write(copied, stamp, data)
    notes = read_recording(tmp_path / "empty").notes
    assert f"depth is not used: {DEPTH_TOPIC} has no messages" in notes
    assert not any("depth" in note for note in read_recording(bag).notes)


def test_a_camera_without_camera_info_needs_its_intrinsics(tmp_path):
    bag = write_renamed(tmp_path / "bag", {COLOR_TOPIC: "/image_raw"})
    with pytest.raises(RecordingError, match="nothing on /camera_info; expected --camera-info .*, or --intrinsics"):
        read_recording(bag)
    camera = read_recording(bag, ImageChoice(intrinsics=("43", "44", "32", "24"))).images.camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (64, 48, 43.0, 44.0)


@pytest.mark.parametrize("names", [{COLOR_TOPIC: "/image_raw"}, USB])
def test_intrinsics_that_were_given_are_played_beside_every_image(names, tmp_path):
    given = ImageChoice(intrinsics=("43", "44", "32", "24", "0.1", "0", "0", "0"))
    recording = read_recording(write_renamed(tmp_path / "bag", names), given)
    messages = list(Playback(recording.source, images=recording.images))
    stamps = {topic: [m.stamp for m in messages if m.topic == topic] for topic in (COLOR_TOPIC, INFO_TOPIC)}
    assert stamps[COLOR_TOPIC] == stamps[INFO_TOPIC] and len(stamps[INFO_TOPIC]) == 12
    info = deserialize_message(next(m.data for m in messages if m.topic == INFO_TOPIC), CameraInfo)
    assert same_camera(camera_from_info(info, recording.images.frame_id), recording.images.camera)


def test_an_episode_after_the_end_of_its_video_is_named(tmp_path, capsys):
    from lerobot_fakes import CAMERA, FPS, write_dataset

    pictures = [frame.color for frame in make_fake_recording(FakeGripper(count=6))]
    write_dataset(tmp_path / "merged", [pictures[:3], pictures[:3]], "v3.0")
    path = next((tmp_path / "merged/meta/episodes").rglob("*.parquet"))
    table, name = parquet.read_table(path), f"videos/{CAMERA}/from_timestamp"
    parquet.write_table(table.set_column(table.schema.get_field_index(name), name, [[0.0, 3 / FPS + 460.4]]), path)
    assert annotate(tmp_path / "merged") == 2
    assert "file-000.mp4 ends before 460.500 s, its from_timestamp" in capsys.readouterr().err


def test_a_score_of_unloaded_frames_alone_is_none(tmp_path):
    recording = make_recording(phases=False)
    forces = [[-1.0, 0.0, 0.0]] * len(recording.jaw("left").keypoints.stamps_ns)
    series = evaluate_recording(recording, FakeJaw(), GivenContact(None), FakeEstimator(forces))
    loaded = np.linalg.norm(series.true_force, axis=1) > 0.02
    assert loaded.any() and not loaded.all()
    check_solved(series, recording)
    unloaded = series.with_columns(force=np.where(loaded[:, None], np.nan, series.force), message="no such object")
    with pytest.raises(RecordingError, match="none of the frames under load was solved.*no such object"):
        check_solved(unloaded, recording)


def test_a_file_beside_the_bag_that_leads_elsewhere_is_not_copied(tmp_path, capsys):
    from test_annotate import short_bag

    bag, secret = short_bag(tmp_path / "in" / "bag"), tmp_path / "secret"
    secret.write_text("mine")
    os.symlink(secret, bag / "notes.txt")
    assert main(["annotate", str(bag), "--out", str(tmp_path / "out")]) == 2
    assert "notes.txt leads out of the folder bag" in capsys.readouterr().err
    assert not any(path.name == "notes.txt" for path in (tmp_path / "out").rglob("*"))
    (bag / "notes.txt").unlink()
    os.symlink("case.json", bag / "notes.txt")
    assert main(["annotate", str(bag), "--out", str(tmp_path / "out")]) == 0


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("take.bag", "ROS 1 bag: rosbags-convert"),
        ("episode_0.hdf5", "HDF5.*LeRobotDataset.create"),
        ("photos/IMG_0001.HEIC", "a picture as phones write it: make .jpg"),
        ("replay_buffer.zip", r"called NAME\.zarr\.zip"),
        ("replay_buffer.zarr.zip", "git lfs pull"),
        ("pointer.mcap", "git lfs pull"),
    ],
)
def test_recordings_of_other_kinds_are_refused_with_what_makes_one_of_ours(name, words, tmp_path):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(RecordingError, match=words):
        read_recording(tmp_path / name.split("/")[0])


def test_a_name_that_cannot_be_printed_is_refused(tmp_path, capsys):
    folder = os.fsencode(tmp_path) + b"/take\xff"
    os.mkdir(folder)
    assert main(["evaluate", os.fsdecode(folder), "--contact", "fixed:40"]) == 2
    assert "expected a name in UTF-8" in capsys.readouterr().err


def test_bag_files_without_their_metadata_are_to_be_indexed(tmp_path):
    for number in (0, 1):
        (tmp_path / f"part_{number}.mcap").write_bytes(b"")
    with pytest.raises(RecordingError, match="ros2 bag reindex"):
        read_recording(tmp_path)


def test_fewer_answers_are_worse_whatever_the_error():
    case = {"all": {"rmse_N": 0.1}, "record_frames": 100, "record_skipped": 14}
    before, after = {"cases": {"a": case}}, {"cases": {"a": case | {"record_skipped": 50}}}
    assert [change.outcome for change in compare_evaluations(before, after)] == ["worse"]
    assert [change.outcome for change in compare_evaluations(before, before)] == ["same"]


av = pytest.importorskip("av")
parquet = pytest.importorskip("pyarrow.parquet")
DATASET = ["--intrinsics", "43,43,31,23", "--extrinsics", "robot", "--contact", "fixed:40"]


@pytest.fixture
def dataset(tmp_path):
    """Two episodes of noise in both layouts."""
    from lerobot_fakes import write_dataset

    pictures = [frame.color for frame in make_fake_recording(FakeGripper(count=8))]
    write_dataset(tmp_path / "noise", [pictures[:3], pictures], "v2.1")
    return tmp_path / "noise"


def annotate(dataset, *words):
    return main(["annotate", str(dataset), "--out", str(dataset.parent / "out"), *(words or DATASET)])


def test_a_dataset_in_which_no_jaw_is_seen_is_not_annotated(dataset, capsys):
    assert annotate(dataset) == 2
    told = capsys.readouterr()
    assert "0 of 2 annotated" in told.out and "no force in any of its 2 episodes" in told.err
    assert "a force in 0 of 8 images" in told.err
    assert "no key points in" in told.err and not (dataset.parent / "out" / "noise").exists()


def lengthen_video(folder):
    from lerobot_fakes import write_video

    pictures = [frame.color for frame in make_fake_recording(FakeGripper(count=8))]
    write_video(next((folder / "videos").rglob("episode_000000.mp4")), pictures)


def delay_row(folder, times=(0.0, 1.0 / 30.0, 2.0 / 30.0 + 0.4)):
    import pyarrow

    path = next((folder / "data").rglob("episode_000000.parquet"))
    table = parquet.read_table(path)
    times = pyarrow.array(np.array(times, np.float32))
    parquet.write_table(table.set_column(table.schema.get_field_index("timestamp"), "timestamp", times), path)


def slow_rows(folder):
    delay_row(folder, (0.0, 1.6 / 30.0, 3.2 / 30.0))


def slow_video(folder):
    from lerobot_fakes import write_video

    pictures = [frame.color for frame in make_fake_recording(FakeGripper(count=3))]
    write_video(next((folder / "videos").rglob("episode_000000.mp4")), pictures, rate=10)


def cut_table(folder):
    path = next((folder / "data").rglob("episode_000000.parquet"))
    path.write_bytes(path.read_bytes()[:-9])


def write_times_as_text(folder):
    import pyarrow

    path = next((folder / "data").rglob("episode_000000.parquet"))
    table = parquet.read_table(path)
    times = pyarrow.array(["soon"] * len(table))
    parquet.write_table(table.set_column(table.schema.get_field_index("timestamp"), "timestamp", times), path)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (cut_table, "episode_000000.parquet: Parquet"),
        (write_times_as_text, "column timestamp: could not convert"),
        (lengthen_video, "has 8 frames; expected 3, one for each row"),
        (delay_row, "its pictures, at 30 Hz, differ by 0.400 s from row 2 on"),
        (slow_rows, "its pictures, at 30 Hz, differ by 0.020 s from row 1 on"),
        (slow_video, "frame 1 of episode_000000.mp4 is shown at 0.100 s; expected 0.033 s"),
        (change_info(fps=1e-300), "fps: got 1e-300, expected"),
        (change_info(fps="fast"), "fps: got the text 'fast'"),
        (change_info(chunks_size=0.5), "chunks_size: got 0.5, expected"),
    ],
)
def test_rows_pictures_and_numbers_that_disagree_are_refused_in_one_line(damage, words, dataset, capsys):
    damage(dataset)
    assert annotate(dataset) == 2
    told = capsys.readouterr().err
    assert words in told and "Traceback" not in told


@pytest.mark.parametrize("share", [0.4, -0.4, 0.6])
def test_an_episode_that_begins_between_two_frames_of_its_video_is_refused(share, tmp_path, capsys):
    from lerobot_fakes import CAMERA, FPS, write_dataset

    pictures = [frame.color for frame in make_fake_recording(FakeGripper(count=6))]
    write_dataset(tmp_path / "noise", [pictures[:3], pictures[:3]], "v3.0")
    path = next((tmp_path / "noise/meta/episodes").rglob("*.parquet"))
    table, name = parquet.read_table(path), f"videos/{CAMERA}/from_timestamp"
    begins = [[0.0, (3 + share) / FPS]]
    parquet.write_table(table.set_column(table.schema.get_field_index(name), name, begins), path)
    assert annotate(tmp_path / "noise") == 2
    told = capsys.readouterr().err
    assert f"expected {begins[0][1]:.3f} s" in told and "from_timestamp" in told


def test_a_depth_map_is_no_camera_that_sees_the_jaws(dataset):
    path = dataset / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"]["observation.images.wrist_depth"] = {"dtype": "video", "shape": [48, 64, 1]}
    path.write_text(json.dumps(info))
    assert open_dataset(dataset).camera == "observation.images.wrist"
    with pytest.raises(OptionError, match="wrist_depth: expected --color with one of observation.images.wrist$"):
        open_dataset(dataset, "observation.images.wrist_depth")


@pytest.mark.parametrize("option", ["--depth", "--camera-info"])
def test_topics_of_a_dataset_are_refused(option, dataset, capsys):
    assert annotate(dataset, option, "observation.images.wrist_depth") == 2
    assert f"{option} observation.images.wrist_depth: only bags have such topics" in capsys.readouterr().err


def test_what_a_dataset_lacks_is_said_in_one_line_before_its_videos_are_read(dataset, capsys, monkeypatch):
    monkeypatch.setattr("finforce_eval.recordings.dataset.decode_video", lambda *given: 1 / 0)
    assert annotate(dataset, *DATASET[:4]) == 2
    assert "give --contact fixed:Z_MM" in capsys.readouterr().err
    info = json.loads((dataset / "meta/info.json").read_text())
    info["features"]["observation.force.left"] = {"dtype": "float32", "shape": [3]}
    (dataset / "meta/info.json").write_text(json.dumps(info))
    assert annotate(dataset) == 2
    assert "has observation.force.left already" in capsys.readouterr().err
    for video in (dataset / "videos").rglob("*.mp4"):
        video.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 7\n")
    assert annotate(dataset) == 2
    told = capsys.readouterr().err
    assert "2 of 4 files cannot be read" in told and "git lfs pull" in told and len(told.splitlines()) == 1


def test_what_plays_bags_alone_says_so_and_promises_no_datasets(dataset, capsys):
    for depth in ("auto", "aligned"):
        assert main(["trace", str(dataset), *DATASET, "--detector", f"depth={depth}"]) == 2
        assert "only bags are played" in capsys.readouterr().err
    for command in ("trace", "replay"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        assert "LeRobot dataset, UMI" not in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("command", ["extrinsics", "view", "evaluate"])
def test_every_command_that_reads_a_bag_reads_an_episode(command, dataset, capsys):
    words = {"evaluate": ["--contact", "fixed:40"], "view": ["--contact", "fixed:40", "--save", "x.rrd"]}
    more = words.get(command, ["--images", "5"])
    code = main([command, str(dataset), "--episode", "1", "--intrinsics", "43,43,31,23", *more])
    told = capsys.readouterr()
    expected = {"evaluate": "no ground truth", "view": "no key points in 8 images"}
    assert code == 2
    assert expected.get(command, "jaw was found in 0 of 5 images") in told.out + told.err
    assert main([command, str(dataset), "--episode", "7", "--intrinsics", "43,43,31,23", *more]) == 2
    assert "no episode 7; expected 0 to 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    "path",
    [
        "../../{episode_index}.parquet",
        "/tmp/{episode_index}.parquet",
        "data/{episode_index:0900000000d}.parquet",
        "data/{episode_index.__class__}.parquet",
        "data/{0}.parquet",
    ],
)
def test_a_path_that_leads_out_of_a_dataset_is_refused(path, dataset, capsys):
    info = json.loads((dataset / "meta/info.json").read_text())
    (dataset / "meta/info.json").write_text(json.dumps(info | {"data_path": path}))
    assert annotate(dataset) == 2
    assert "expected one within the dataset" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name", ["secret.txt", "data/chunk-000/episode_000000.parquet", "meta/episodes.jsonl", "folder"]
)
def test_a_link_out_of_a_dataset_is_refused_and_nothing_of_it_copied(name, dataset, capsys):
    outside = dataset.parent / "outside"
    if (dataset / name).exists():
        os.rename(dataset / name, outside)
    elif name == "folder":
        outside.mkdir()
    else:
        outside.write_text("mine")
    os.symlink(outside, dataset / name)
    assert annotate(dataset) == 2
    assert "leads out of the folder noise" in capsys.readouterr().err
    assert not (dataset.parent / "out" / "noise").exists()


def test_a_snapshot_of_links_to_its_blobs_is_one_folder(dataset):
    hub = dataset.parent / "datasets--somebody--noise"
    (hub / "blobs").mkdir(parents=True)
    snapshot = hub / "snapshots" / "0123"
    for number, path in enumerate(sorted(path for path in dataset.rglob("*") if path.is_file())):
        link = snapshot / path.relative_to(dataset)
        link.parent.mkdir(parents=True, exist_ok=True)
        os.rename(path, hub / "blobs" / str(number))
        os.symlink(os.path.relpath(hub / "blobs" / str(number), link.parent), link)
    choice = ImageChoice(intrinsics=("43", "43", "31", "23"), episode=1)
    assert len(list(read_recording(snapshot, choice).images)) == 8


def test_a_small_table_that_unpacks_to_far_more_than_its_size_is_refused(dataset, capsys):
    import pyarrow

    path, zeros = dataset / "data/chunk-000/episode_000000.parquet", pyarrow.array(np.zeros(4_000_000))
    with parquet.ParquetWriter(path, pyarrow.schema({"number": pyarrow.float64()})) as writer:
        for _ in range(10):
            writer.write_table(pyarrow.table({"number": zeros}))
    assert path.stat().st_size < 1 << 18
    with pytest.raises(RecordingError, match="takes more than 2.. MB of memory"):
        read_parquet(path)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(RecordingError, match="is not a plain file"):
        read_parquet(path)


def test_forces_of_a_dataset_are_shown_as_those_of_a_bag(dataset):
    from finforce_eval.cli.report import read_forces

    with pytest.raises(RecordingError, match="no forces: no features as force.left and force.left.valid"):
        read_forces(dataset)
    info = json.loads((dataset / "meta/info.json").read_text())
    info["features"] |= dict.fromkeys(("force.left", "force.left.stddev", "force.left.valid"), {"dtype": "float32"})
    (dataset / "meta/info.json").write_text(json.dumps(info))
    for path in (dataset / "data").rglob("*.parquet"):
        table = parquet.read_table(path)
        valid = np.arange(len(table)) > 0
        for name, force in (("force.left", -2.0), ("force.left.stddev", -0.1)):
            table = table.append_column(name, [[[force * known, 0.0, 0.0] for known in valid]])
        table = table.append_column("force.left.valid", [valid.tolist()])
        parquet.write_table(table, path)
    short, long = read_forces(dataset)
    assert (short.name, long.name) == ("noise/episode_000000/left", "noise/episode_000001/left")
    assert len(long) == 8 and not long.solved[0] and (long.magnitude[1:] == 2.0).all()
    np.testing.assert_allclose(long.column("magnitude_stddev")[1:], 0.1, atol=1e-6)
    (dataset.parent / "manifest.jsonl").write_text("{}\n")
    page = dataset.parent / "page.html"
    assert main(["report", str(dataset), str(dataset.parent / "manifest.jsonl"), "-o", str(page)]) == 0
    assert page.is_file()
