"""Claims about `ForceSensor`: forces of the gripper from the images of a program of one's own."""

import json

import numpy as np
import pytest

import finforce as ff
from finforce.errors import PoseError
from finforce.gripper_frames import BENCH_CAMERA, ROBOT_CAMERA, read_extrinsics
from finforce.transforms import pose_numbers
from finforce_eval.sensor import combine_solutions, read_intrinsics
from finforce_ifea.grasp_force import R_GRIPPER_JAW
from finforce_ifea.observation import blank_solution

INTRINSICS = (430.0, 430.0, 320.0, 240.0)


def pressed(force, status="ok"):
    solution = blank_solution(1.0, status, "why", np.ones(3, bool))
    return solution._replace(force=np.array(force), force_stddev=np.array([0.3, 0.1, 0.0]), magnitude_stddev=0.2)


def test_two_jaws_are_a_grasp_and_a_net_force_with_their_deviations():
    forces = combine_solutions(1.0, {"left": pressed([-3.0, 0.0, 0.0]), "right": pressed([-2.0, 0.0, 1.0])})
    assert (forces.status, forces.grasp, forces.grasp_stddev) == ("ok", pytest.approx(5.0**0.5), 0.2)
    np.testing.assert_allclose(forces.manipulation, [-1.0, 0.0, 1.0])  # the right jaw is turned about z
    np.testing.assert_allclose(forces.manipulation_stddev, np.sqrt(2.0) * np.array([0.3, 0.1, 0.0]))
    assert combine_solutions(1.0, {"right": pressed([-2.0, 0.0, 0.0])}).manipulation[0] == pytest.approx(2.0)


def test_a_jaw_that_is_not_trusted_leaves_no_grasp_and_is_named():
    forces = combine_solutions(1.0, {"left": pressed([-3.0, 0.0, 0.0]), "right": None})
    assert forces.status == "right jaw not seen" and np.isnan(forces.grasp) and set(forces.jaws) == {"left"}
    waiting = combine_solutions(1.0, {"left": pressed([0.0, 0.0, 0.0], "waiting")})
    assert waiting.status == "left jaw waiting: why" and np.isnan(waiting.manipulation).all()


def test_arrays_go_through_the_detector_to_both_jaws():
    sensor = ff.ForceSensor("bench", camera=INTRINSICS, extrinsics="robot", contact_height=0.04, calibration="bench")
    rgb = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    forces = sensor.update(rgb, np.full((480, 640), 150, np.uint16), stamp=1.0)
    assert set(forces.jaws) <= {"left", "right"} and np.isnan(forces.grasp)
    assert forces.status and sensor.camera.fx == 430.0
    with pytest.raises(ValueError, match="rising stamps"):
        sensor.update(rgb, None, stamp=0.5)
    for gravity in ([0.0, 0.0, 0.0], [0.0, np.nan, 1.0], [0.0, 1.0]):
        with pytest.raises(ValueError, match="expected a direction"):
            sensor.update(rgb, None, stamp=2.0, gravity=gravity)
    assert sensor.update(rgb[::-1], None, stamp=2.0, gravity=[0.0, 0.0, -9.81]).stamp == 2.0


@pytest.mark.parametrize(("held", "expected"), [("auto", True), ("no", False)])
def test_each_jaw_is_told_which_way_things_fall_if_it_may_hold_something(held, expected):
    about = {"camera": INTRINSICS, "extrinsics": "robot", "contact_height": 0.04, "settings": {"held": held}}
    sensor, told = ff.ForceSensor("bench", **about), {}
    for side, loop in sensor._loops.items():
        update = loop.update
        loop.update = lambda seen, *a, side=side, update=update: (told.update({side: seen.posture}), update(seen, *a))[
            1
        ]
    sensor.update(np.full((480, 640, 3), 90, np.uint8), None, stamp=1.0, gravity=[0.0, 3.0, -4.0])
    for side, posture in told.items():
        assert (posture is not None) == expected
        assert not expected or R_GRIPPER_JAW[side] @ posture.gravity == pytest.approx([0.0, 0.6, -0.8])
    assert len(told) == 2


@pytest.fixture(scope="module")
def sensor():
    return ff.ForceSensor("bench", camera=INTRINSICS, extrinsics="robot", contact_height=0.04, sides=["left"])


IMAGE = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("unit", "named"),
    [
        (lambda i: i, "divide frame numbers by the frame rate"),
        (lambda i: np.int64(i), "divide frame numbers by the frame rate"),
        (lambda i: float(i), "frame numbers, divide them by the frame rate"),
        (lambda i: i * 1e3 / 30, "look like milliseconds"),
        (lambda i: i * 1e6 / 30 + 0.5, "look like microseconds"),
        (lambda i: i * 1e9 / 30 + 0.5, "look like nanoseconds"),
        (lambda i: 1.7e12 + i * 1e3 / 30, "milliseconds by 1e3"),
        (lambda i: 1_700_000_000_000_000_000 + i * 33_333_333, "nanoseconds by 1e9"),
        (lambda i: i / 30 / 60, "0.001 to 5 s"),
    ],
)
def test_stamps_in_another_unit_than_seconds_are_refused_before_a_force_is_told(sensor, unit, named):
    sensor.reset()
    with pytest.raises(ValueError, match=named):
        for i in range(4):
            assert "ok" not in sensor.update(IMAGE + np.uint8(i), None, unit(i)).status


def test_a_pause_of_the_camera_is_no_other_unit(sensor):
    sensor.reset()
    for stamp in (1000.0, 1000.033, 1011.5, 1011.533, 1030.0):
        sensor.update(IMAGE + np.uint8(1e3 * stamp % 251), None, stamp)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({}, "expected contact_height .* or object_mesh"),
        ({"contact_height": 0.04, "object_mesh": "can.stl"}, "one of the two"),
        ({"contact_height": 40.0}, "contact height 40000 mm, expected"),
        ({"contact_height": 0.04, "rig": "rig.yaml"}, "expected rig, or camera and extrinsics"),
        ({"contact_height": 0.04, "camera": None}, "expected rig, or camera and extrinsics"),
        ({"contact_height": 0.04, "extrinsics": "wrist"}, "expected robot, bench"),
        ({"contact_height": 0.04, "extrinsics": [1.0, 2.0]}, "2 numbers; expected robot"),
    ],
)
def test_what_cannot_be_used_is_said(given, reason):
    with pytest.raises(ValueError, match=reason):
        ff.ForceSensor("bench", **{"camera": INTRINSICS, "extrinsics": "robot", **given})


def test_intrinsics_are_taken_as_a_matrix():
    matrix = np.array([[430.0, 0.0, 320.0], [0.0, 431.0, 240.0], [0.0, 0.0, 1.0]])
    for form in (matrix, matrix.tolist(), matrix.ravel(), [430, 431, 320, 240]):
        camera = read_intrinsics(form, (480, 640))
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (430.0, 431.0, 320.0, 240.0)


def test_a_camera_pose_is_read_in_every_form():
    numbers = pose_numbers(ROBOT_CAMERA)
    for form in ("robot", ROBOT_CAMERA, numbers, ",".join(map(str, numbers)), " ".join(map(str, numbers))):
        np.testing.assert_allclose(read_extrinsics(form), ROBOT_CAMERA, atol=1e-12)
    np.testing.assert_array_equal(read_extrinsics("bench"), BENCH_CAMERA)


HAND_EYE = "parameters: {{eye_on_hand: {}}}\ntransformation: {{x: {}, y: {}, z: {}, qx: {}, qy: {}, qz: {}, qw: {}}}\n"
HAND_EYE_2 = (
    "parameters: {{calibration_type: {}}}\n"
    "transform:\n  translation: {{x: {}, y: {}, z: {}}}\n  rotation: {{x: {}, y: {}, z: {}, w: {}}}\n"
)


@pytest.mark.parametrize(
    ("form", "name", "mount", "other"),
    [(HAND_EYE, "a.yaml", "true", "false"), (HAND_EYE_2, "a.calib", "eye_in_hand", "eye_on_base")],
)
def test_a_camera_pose_is_read_from_a_file_of_easy_handeye(form, name, mount, other, tmp_path):
    file, numbers = tmp_path / name, [float(number) for number in pose_numbers(ROBOT_CAMERA)]
    file.write_text(form.format(mount, *numbers))
    np.testing.assert_allclose(read_extrinsics(str(file)), ROBOT_CAMERA, atol=1e-9)
    file.write_text(form.format(other, *numbers))
    with pytest.raises(PoseError, match="beside the robot"):
        read_extrinsics(str(file))
    for damaged in ("", "[1, 2]", "transform: 3", "transformation: {x: one}", "parameters: 3\ntransformation: {x: 1}"):
        file.write_text(damaged)
        with pytest.raises(PoseError, match=f"{name} is no file of easy_handeye"):
            read_extrinsics(str(file))


def test_a_camera_pose_is_read_from_what_hand_eye_calibrations_of_opencv_are_saved_as(tmp_path):
    cv2 = pytest.importorskip("cv2")
    R, t = ROBOT_CAMERA[:3, :3], ROBOT_CAMERA[:3, 3:]
    forms = {
        "both.yaml": {"R": R, "t": t},
        "whole.yml": {"T_cam2gripper": ROBOT_CAMERA},
        "whole.xml": {"T": ROBOT_CAMERA},
    }
    for name, matrices in forms.items():
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
        for key, matrix in matrices.items():
            storage.write(key, matrix)
        storage.release()
    np.savetxt(tmp_path / "whole.txt", ROBOT_CAMERA)
    (tmp_path / "rows.json").write_text(json.dumps({"T_gripper_camera": ROBOT_CAMERA.tolist()}))
    for name in (*forms, "whole.txt", "rows.json"):
        np.testing.assert_allclose(read_extrinsics(str(tmp_path / name)), ROBOT_CAMERA, atol=1e-9, err_msg=name)
    for damaged in ("1 2 3", "[[1, 2], [3]]", "a: [one, two]", "1 " * 16, "1e9 " * 16):
        (tmp_path / "whole.txt").write_text(damaged)
        with pytest.raises(PoseError, match="extrinsics: "):
            read_extrinsics(str(tmp_path / "whole.txt"))
