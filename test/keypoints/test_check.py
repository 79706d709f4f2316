"""Claims about the check before any force: what fits passes, and what does not is named as what it is."""

import json
import re
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from threading import Event, Thread

import cv2
import numpy as np
import pytest
from node_fakes import ros_domain
from sensor_msgs.msg import CameraInfo, CompressedImage

from finforce.camera_topics import COLOR_TOPIC, INFO_TOPIC
from finforce.gripper_frames import ROBOT_CAMERA, SIDES
from finforce.rig import Rig, RigCamera, RigJaw
from finforce.ros import node as ros
from finforce.transforms import invert_pose, pose_numbers
from finforce_eval.cli.camera import try_rig
from finforce_eval.cli.check import record_camera
from finforce_eval.cli.main import main
from finforce_eval.cli.twin import write_simulated_recording
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.check import FAULT, OK, WARNING, Finding, explain_camera, judge_picture
from finforce_eval.evaluation.keypoint_source import KeypointSource
from finforce_eval.recordings.bags import open_bag
from finforce_eval.recordings.images import CAMERA_INFO, COMPRESSED
from finforce_sim.scenarios import build_scenario
from finforce_sim.simulated_recording import build_simulated_recording

IMAGES = 6


@dataclass(frozen=True)
class StillFrames:
    """The first images of a scene, each changed, and no word of a jaw but what they show."""

    simulated: object
    frames: tuple
    change: object

    def __len__(self):
        return IMAGES

    def __iter__(self):
        return (replace(frame, color=np.ascontiguousarray(self.change(frame.color))) for frame in self.frames)

    def __getattr__(self, name):
        return getattr(self.simulated, name)


@pytest.fixture(scope="module")
def simulated():
    found = build_simulated_recording(build_scenario("grasp_cylinder"), 3)
    return found, tuple(replace(frame, jaws={}) for frame in islice(found, IMAGES))


@pytest.fixture(scope="module")
def record(simulated, tmp_path_factory):
    def write(name, change=lambda color: color):
        return write_simulated_recording(StillFrames(*simulated, change), tmp_path_factory.mktemp("check") / name)

    return write


@pytest.fixture(scope="module")
def still(record):
    return record("still")


@pytest.fixture
def two_fingers(monkeypatch):
    """Of the included fingers, two are tried."""
    monkeypatch.setattr("finforce_eval.evaluation.check.list_shipped_jaws", lambda: ["bench", "umi"])


def check(folder, capsys, tmp_path, *options):
    words = ["--images", str(IMAGES), "--report", str(tmp_path), "--json", str(tmp_path / "check.json")]
    status = main(["check", str(folder), *words, *options])
    assert (json.loads((tmp_path / "check.json").read_text())["faults"] > 0) == bool(status)
    assert cv2.imread(str(tmp_path / "check.png")).shape == (480, 640, 3)
    return status, capsys.readouterr().out


def as_option(T):
    return "--extrinsics=" + ",".join(f"{number:.6f}" for number in pose_numbers(T))


def test_what_fits_passes_with_depth_and_without(still, capsys, tmp_path):
    for options in ((), ("--detector", "depth=none")):
        status, said = check(still, capsys, tmp_path, *options)
        assert status == 0 and "nothing contradicts" in said and "extrinsics within" in said  # a mesh, but two poses
        assert ("colour alone" in said) == bool(options)


def test_depth_of_another_unit_is_named(still, capsys, tmp_path):
    status, said = check(still, capsys, tmp_path, "--detector", "depth_scale=0.01")
    assert status == 1 and "the depth at the jaw is 10 times that of its place" in said and "depth_scale" in said
    assert "not compared with a depth that is wrong" in said and "contradicts" not in said


@pytest.mark.parametrize("off", [0.0, 0.01])
def test_a_lens_that_the_images_do_not_have_is_named(still, off, capsys, tmp_path):
    fisheye = {"image_width": 640, "image_height": 480, "camera_name": "gopro", "distortion_model": "equidistant"}
    matrix = {"rows": 3, "cols": 3, "data": [431.2, 0.0, 319.6, 0.0, 430.0, 241.3, 0.0, 0.0, 1.0]}
    fisheye |= {"camera_matrix": matrix, "distortion_coefficients": {"data": [0.0348, 0.0571, -0.0541, 0.0133]}}
    (tmp_path / "fisheye.yaml").write_text(json.dumps(fisheye))
    T = ROBOT_CAMERA.copy()
    T[1, 3] += off
    words = ("--intrinsics", str(tmp_path / "fisheye.yaml"), as_option(T))
    status, said = check(still, capsys, tmp_path, *words)
    assert status == 1 and "give fx fy cx cy alone" in said and "set T_gripper_camera" not in said
    assert main(["extrinsics", str(still), "--images", str(IMAGES), *words]) == 0
    assert "give fx fy cx cy alone" in capsys.readouterr().err


def test_intrinsics_of_another_size_are_doubted_where_no_jaw_is_found(still, capsys):
    words = ["extrinsics", str(still), "--images", str(IMAGES), "--intrinsics", "862.4", "860", "639.2", "362"]
    assert main(words) == 2
    assert "as in images of 1279 x 725: was the image cropped or scaled" in capsys.readouterr().err


@pytest.mark.parametrize(("off", "words"), [(0.0, []), (0.05, ["finds no jaw"])])
def test_a_rig_is_tried_on_the_pictures_that_it_was_made_from(still, off, words):
    source = KeypointSource(source="images", jaw_file="bench", sides=SIDES)
    recording = source.read(still)
    camera, pose = recording.images.camera, ROBOT_CAMERA.copy()
    pose[1, 3] += off
    intrinsics = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "model")}
    rig = Rig(
        jaw="bench",
        camera=RigCamera(**intrinsics, distortion=tuple(camera.distortion)),
        T_gripper_camera=tuple(pose_numbers(pose)),
        left=RigJaw(),
        right=RigJaw(),
    )
    doubts = try_rig(rig, recording, source, IMAGES)
    assert len(doubts) == len(words)
    assert all(word in doubt for word, doubt in zip(words, doubts, strict=True))


@pytest.mark.parametrize(
    ("off", "words"),
    [
        (0.0, []),
        (0.008, [r"the camera is (7\.[5-9]|8\.[0-4]) mm and 0\.\d\d degrees from .*; set T_gripper_camera: \["]),
    ],
)
def test_a_camera_elsewhere_is_named_by_what_the_first_images_show(still, off, words):
    pose = ROBOT_CAMERA.copy()
    pose[2, 3] += off
    given = {"T_gripper_camera": list(pose_numbers(pose))}
    source = KeypointSource(source="images", jaw_file="bench", parameters=given, sides=SIDES)
    said = explain_camera(source.read(still), source)
    assert len(said) == len(words)
    assert all(re.match(word, text) for word, text in zip(words, said, strict=True))


def test_a_mesh_that_is_not_what_the_camera_sees_is_named(simulated, capsys, tmp_path):
    import trimesh

    found, count = simulated[0], 9  # of which every third has a pose of the object
    frames = tuple(replace(frame, jaws={}) for frame in islice(found, count))
    still = write_simulated_recording(StillFrames(found, frames, lambda color: color), tmp_path / "still")
    mesh = trimesh.load(next(still.glob("*.stl")))
    mesh.apply_scale(1.5)
    mesh.export(tmp_path / "large.stl")
    more = ("--images", str(count))
    status, said = check(still, capsys, tmp_path, *more, "--object", str(tmp_path / "large.stl"))
    assert status == 1 and "the camera contradicts the mesh large.stl" in said and "scaled by 0.6" in said
    status, said = check(still, capsys, tmp_path, *more)
    assert status == 0 and "object.stl is where the camera sees it" in said


def test_a_mesh_is_compared_in_images_of_the_whole_recording_and_a_warning_is_no_fit(
    still, capsys, tmp_path, monkeypatch
):
    compared = []

    def compare(recording, *more):
        compared.append(len(recording.images))
        return [Finding(WARNING, "compared with edges")]

    monkeypatch.setattr(
        "finforce_eval.cli.check.check_recording", lambda recording, *more: ([], np.zeros((480, 640, 3), np.uint8))
    )
    monkeypatch.setattr("finforce_eval.cli.check.check_object", compare)
    status, said = check(still, capsys, tmp_path, "--images", "5")
    assert compared == [IMAGES] and status == 0 and "everything fits" not in said and "the warnings above" in said


def test_a_camera_that_is_elsewhere_is_told_where_it_is(still, capsys, tmp_path):
    T = ROBOT_CAMERA.copy()
    T[1, 3] += 0.008
    status, said = check(still, capsys, tmp_path, as_option(T))
    assert status == 1
    numbers = said.split("set T_gripper_camera: [")[1].split("]")[0].split(",")
    np.testing.assert_allclose([float(number) for number in numbers[:3]], ROBOT_CAMERA[:3, 3], atol=1.5e-3)


def test_a_picture_that_is_wrong_is_named(two_fingers, record, capsys, tmp_path):
    status, said = check(record("changed", lambda color: color[::-1, ::-1] // 4), capsys, tmp_path)
    assert status == 1 and "upside down" in said and "mean brightness" in said


def test_pictures_turned_without_their_intrinsics_are_named(simulated, two_fingers, capsys, tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number, frame in enumerate(simulated[1]):
        cv2.imwrite(str(folder / f"{number}.png"), np.rot90(frame.color)[..., ::-1])
    camera = simulated[0].camera
    numbers = [f"{each:.2f}" for each in (camera.fx, camera.fy, camera.cx, camera.cy)]
    assert main(["check", str(folder), "--images", "6", "--report", str(tmp_path), "--intrinsics", *numbers]) == 1
    assert "was the image turned by 90 degrees, but not the intrinsics?" in capsys.readouterr().out


def test_extrinsics_of_another_convention_are_named(two_fingers, still, capsys, tmp_path):
    x, y, z, qx, qy, qz, qw = pose_numbers(ROBOT_CAMERA)
    first = "--extrinsics=" + ",".join(f"{number:.6f}" for number in (x, y, z, qw, qx, qy, qz))
    for option, words in ((as_option(invert_pose(ROBOT_CAMERA)), "inverted"), (first, "begins with w")):
        status, said = check(still, capsys, tmp_path, option)
        assert status == 1 and words in said


def test_another_finger_than_in_the_jaw_file_is_named(two_fingers, still, capsys, tmp_path):
    status, said = check(still, capsys, tmp_path, "--jaw", "umi")
    assert status == 1 and "the finger is bench" in said


def test_jaws_that_are_nowhere_are_said_to_be_so(two_fingers, record, capsys, tmp_path):
    rng = np.random.default_rng(0)
    folder = record("noise", lambda color: cv2.GaussianBlur(rng.integers(0, 255, color.shape, np.uint8), (0, 0), 1.0))
    status, said = check(folder, capsys, tmp_path)
    assert status == 1 and "no jaw to rely on" in said


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        (lambda color: color, OK, "fine detail"),
        (lambda color: color // 12, WARNING, "brightness"),
        (lambda color: cv2.GaussianBlur(color, (0, 0), 5.0), FAULT, "out of focus"),
        (lambda color: np.where(np.arange(640)[None, :, None] < 320, 90, color).astype(np.uint8), WARNING, "covered"),
    ],
)
def test_a_picture_is_judged_by_light_focus_and_what_it_shows(simulated, change, level, words):
    mean = np.mean([frame.color for frame in simulated[1]], axis=0).astype(np.uint8)
    said = judge_picture(change(mean))
    assert any(line.severity == level and words in line.text for line in said)


def test_too_few_images_are_refused(still, capsys):
    assert main(["check", str(still), "--images", "3"]) == 2
    assert "expected at least 5" in capsys.readouterr().err


COLOR_ALONE = (f"{COLOR_TOPIC}/compressed", INFO_TOPIC)


@contextmanager
def camera_of(folder, left_out=()):
    """A camera that shows the images of a recording again and again; yields its domain."""
    kinds = {COMPRESSED: CompressedImage, CAMERA_INFO: CameraInfo}
    with ros_domain() as probe, open_bag(folder, "camera") as bag:
        kept = [c for c in bag.connections if c.msgtype in kinds and not c.topic.endswith(left_out)]
        out = {c.topic: probe.create_publisher(kinds[c.msgtype], c.topic, ros.RESULT) for c in kept}
        messages = [(raw.topic, raw.data) for raw in bag.raw(tuple(out))]
        done = Event()

        def publish():
            while not done.is_set():
                for topic, data in messages:
                    out[topic].publish(bytes(data))
                    done.wait(0.01)

        thread = Thread(target=publish)
        thread.start()
        try:
            yield probe.context.get_domain_id()
        finally:
            done.set()
            thread.join()


def test_a_running_camera_is_checked_as_its_recording_is(still, capsys, tmp_path):
    with camera_of(still) as domain:
        folder = record_camera(COLOR_ALONE, IMAGES - 3, tmp_path / "heard", domain)
    status, said = check(folder, capsys, tmp_path, "--images", "5")
    assert status == 0 and "everything fits" in said


def test_topics_without_a_camera_are_said_to_be_so(still, tmp_path, monkeypatch):
    monkeypatch.setattr("finforce_eval.cli.check.TIMEOUT", 3.0)
    words = pytest.raises(RecordingError, match=r"0 camera_info on .*published on .*color/image_raw/compressed")
    with camera_of(still, left_out=("camera_info",)) as domain, words:
        record_camera(COLOR_ALONE, 3, tmp_path / "heard", domain)


@pytest.mark.parametrize("given", [(), ("a", "b"), ("--topics", "/one"), ("bag", "--topics")])
def test_one_source_is_to_be_named(given, capsys):
    assert main(["check", *given]) == 2
    assert "expected" in capsys.readouterr().err


@pytest.mark.parametrize(("bars", "words"), [((60, 60, 0, 0), "60 and 60 rows"), ((0, 0, 40, 0), "40 and 0 columns")])
def test_black_bars_of_a_padded_picture_are_named_with_what_they_shift(bars, words):
    picture = np.random.default_rng(0).integers(60, 200, (360, 640, 3), dtype=np.uint8)
    top, bottom, left, right = bars
    padded = np.pad(picture, ((top, bottom), (left, right), (0, 0)))
    assert not any("bars" in finding.text for finding in judge_picture(picture))
    (said,) = (finding for finding in judge_picture(padded) if "bars" in finding.text)
    assert said.severity == WARNING and words in said.text and f"{top or left} px more" in said.text
