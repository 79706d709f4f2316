"""Claims about `finforce live`: the images of a webcam or a file to forces, without ROS."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from finforce.camera import ImageError
from finforce.gripper_frames import ROBOT_CAMERA
from finforce.optional import import_cv2
from finforce.rig import WIDER, Rig, RigCamera, RigJaw, write_rig
from finforce.transforms import pose_numbers
from finforce_eval import sensor as sensors
from finforce_eval.cli import live
from finforce_eval.cli.main import main
from finforce_eval.sensor import ForceSensor, combine_solutions
from finforce_ifea.observation import blank_solution

CAMERA = RigCamera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0, model="plumb_bob")
RIG = Rig(
    jaw="bench",
    camera=CAMERA,
    T_gripper_camera=tuple(pose_numbers(ROBOT_CAMERA)),
    left=RigJaw(turn=(0.0, 0.05, 0.0), covered=("inner_1",)),
)
STALLED = None


class FakeCapture:
    """A camera that gives some images, then stalls; an exception among them is raised."""

    images, asked = (), {}

    def __init__(self, source):
        self.source, self.left = source, list(self.images)

    def isOpened(self):  # noqa: N802
        return self.source not in (7, "rtsp://10.0.0.1/a")

    def set(self, name, value):
        self.asked[name] = value
        return True

    def get(self, name):
        return 0.0

    def read(self):
        image = self.left.pop(0) if self.left else STALLED
        if isinstance(image, BaseException):
            raise image
        return image is not STALLED, image

    def release(self):
        self.left = []


class FakeSensor:
    """Presses harder from image to image; refuses black ones."""

    camera = RIG.intrinsics

    def __init__(self, **given):
        self.given, self.count = given, 0

    def update(self, rgb, depth, stamp):
        self.count += 1
        if not rgb.any():
            raise ImageError("black image")
        force = np.array([-float(self.count), 0.0, 0.0])
        solution = blank_solution(stamp, "ok", "", np.ones(3, bool))
        stddev = np.full(3, 0.1)
        solution = solution._replace(
            force=force, torque=0.0 * force, force_stddev=stddev, torque_stddev=stddev, magnitude_stddev=0.1
        )
        return combine_solutions(stamp, {"left": solution, "right": solution})


def make_image(blue, size=(48, 64)):
    return np.full((*size, 3), (blue, 0, 0), np.uint8)


@pytest.fixture
def watch(monkeypatch, tmp_path, capsys):
    """Run the command with a camera that gives some images; its status, what it printed, and the table."""

    def run(*images, camera="0", table="live.parquet"):
        cv2 = import_cv2()
        names = (
            "CAP_PROP_FRAME_WIDTH",
            "CAP_PROP_FRAME_HEIGHT",
            "CAP_PROP_BUFFERSIZE",
            "CAP_PROP_FPS",
            "CAP_PROP_FRAME_COUNT",
        )
        fake = SimpleNamespace(VideoCapture=FakeCapture, **{name: getattr(cv2, name) for name in names})
        monkeypatch.setattr(FakeCapture, "images", images)
        monkeypatch.setattr(live, "import_cv2", lambda: fake)
        monkeypatch.setattr(live, "ForceSensor", FakeSensor)
        table = tmp_path / table
        words = ["--camera", camera, "--rig", "rig.yaml", "--contact-height", "40", "-o", str(table)]
        status = main(["live", *words])
        said = capsys.readouterr()
        return status, said, pd.read_parquet(table) if table.exists() else None

    return run


def test_ctrl_c_ends_it_and_the_forces_are_written(watch):
    status, said, table = watch(make_image(9), make_image(0), make_image(9), KeyboardInterrupt())
    assert status == 0 and "a force in 2 of 3 images" in said.out and "grasp 1.00 N" in said.out
    left = table[table.side == "left"]
    np.testing.assert_array_equal(left.force_x, [-1.0, np.nan, -3.0])
    assert left.message[1] == "black image" and (np.diff(left.stamp) > 0).all()


@pytest.mark.parametrize(
    ("images", "camera", "words"),
    [
        ((), "7", "camera 7: cannot be opened; expected a number of /dev/video"),
        ((), "rtsp://10.0.0.1/a", " a file, or the address of a stream that can be reached"),
        ((), "rtsp://admin:secret@10.0.0.1/a", "camera rtsp://10.0.0.1/a: no image for 0.0 s"),
        ((), "0", "camera 0: no image for 0.0 s, after 0: unplugged, stalled"),
        ((make_image(9), STALLED), "0", "camera 0: no image for 0.0 s, after 1"),
        ((make_image(9), STALLED), "/dev/video2", "camera /dev/video2: no image for 0.0 s, after 1"),
        ((make_image(9), STALLED), "http://10.0.0.2/mjpg", "camera http://10.0.0.2/mjpg: no image for 0.0 s, after 1"),
        ((make_image(9), make_image(9, (72, 96))), "0", "camera 0: image 1 is 96 x 72; expected 64 x 48"),
    ],
)
def test_a_camera_that_is_missing_stalls_or_changes_is_named(images, camera, words, watch):
    status, said, table = watch(*images, camera=camera)
    assert status == 2 and words in said.err
    assert (table is not None) == bool(images)  # what was seen before is kept


@pytest.mark.parametrize(("camera", "is_asked"), [("/dev/video2", True), ("http://10.0.0.2/mjpg", False)])
def test_a_device_by_name_and_a_stream_are_cameras_not_files(camera, is_asked, watch, monkeypatch):
    monkeypatch.setattr(FakeCapture, "asked", {})
    received = iter(range(100, 200))
    monkeypatch.setattr(live.time, "monotonic", lambda: float(next(received)))
    _, _, table = watch(make_image(9), make_image(9), camera=camera)
    assert (table.stamp[table.side == "left"] > 100.0).all()  # when they came, not their places in a file
    assert (FakeCapture.asked.get(import_cv2().CAP_PROP_FRAME_WIDTH) == 64) == is_asked


def test_a_table_of_another_kind_than_asked_for_is_refused_before_the_first_image(watch, capsys):
    with pytest.raises(SystemExit):
        watch(make_image(9), table="forces.csv")
    assert "forces.csv: expected a name that ends in .parquet" in capsys.readouterr().err


def test_the_images_of_a_file_come_with_their_colours_and_times(tmp_path):
    cv2, path = import_cv2(), tmp_path / "demo.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48))
    for blue in (50, 100, 200):
        writer.write(make_image(blue))
    writer.release()
    images = list(live.Webcam(str(path), RIG.intrinsics))
    np.testing.assert_allclose([stamp for stamp, _ in images], [0.0, 0.05, 0.1])
    np.testing.assert_allclose(
        [rgb.mean(axis=(0, 1)) for _, rgb in images], [[0, 0, b] for b in (50, 100, 200)], atol=9
    )


def test_a_rig_stands_for_jaw_camera_and_extrinsics(tmp_path, monkeypatch):
    write_rig(RIG, tmp_path / "rig.yaml")
    seen = []
    monkeypatch.setattr(sensors, "ForceEstimator", lambda jaw, **given: SimpleNamespace(jaw=jaw))
    monkeypatch.setattr(sensors, "ForceLoop", lambda contact, force: None)
    monkeypatch.setattr(sensors, "build_detector", lambda *given, **_: seen.append(given))
    sensor = ForceSensor(rig=tmp_path / "rig.yaml", contact_height=0.04, sides=("left",))
    ((jaws, parameters, settings, _),) = seen
    assert jaws["left"].name == "bench" and sensor.camera.width == 64
    assert parameters.left_turn == (0.0, 0.05, 0.0) and parameters.covered == ("left/inner_1",)
    assert parameters.T_gripper_camera == pytest.approx(RIG.T_gripper_camera)
    assert settings.opening_max == pytest.approx(RIG.half_opening + WIDER)
