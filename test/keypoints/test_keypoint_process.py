"""Claims about the key point detector as a process: it starts, says what is wrong, and ends cleanly."""

import signal
import subprocess
import sys

import pytest
from node_fakes import START_PATIENCE, command_of, run_here, stop_when_ready


def test_a_signal_ends_the_node_cleanly():
    status, text = stop_when_ready(
        command_of("keypoint_detector", "detection_method:=dots", "modell:=x"), signal.SIGINT
    )
    assert status == 0, text
    assert "Traceback" not in text
    assert "there is no parameter 'modell'" in text


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ("jaws:=middle", "jaws: got 'middle'"),
        ("jaw_file:=no_such_jaw", "no_such_jaw"),
        ("detection_method:=guess", "detection_method: got 'guess'"),
        ("model:=no_such_folder", "no_such_folder"),
        ("T_gripper_camera:=[0.0, 0.0, 0.1]", "quaternion of shape"),
        ("T_gripper_camera:=[0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0]", "norm"),
        ("detector.likelihood:=2.0", "detector.likelihood"),
        ("skip_off:=[nonsense]", "there is no rule 'nonsense'"),
        ("color_topics:=[]", "color_topics: got (), expected at least one topic"),
        ("T_gripper_camera:=[]", "quaternion of shape"),
        ("threads:=[]", "parameter threads is empty; expected a value such as 2"),
        ("depth_topic:=''", "parameter depth_topic is ''; expected the name of a topic: topic name must not be empty"),
        ("info_topic:=a b", "parameter info_topic is 'a b'; expected the name of a topic: topic name must not contain"),
        ("color_topics:=[/x, /a//b]", "parameter color_topics is '/a//b'; expected the name of a topic"),
        ("depth_topic:=/{camera}/depth", "parameter depth_topic is '/{camera}/depth'; expected the name of a topic"),
    ],
)
def test_what_cannot_be_set_up_ends_with_two_and_one_reason(given, reason, capfd):
    assert run_here("keypoint_detector", given) == 2
    text = capfd.readouterr().err
    said = text.strip().splitlines()
    assert reason in said[-1] and "Traceback" not in text
    assert sum(line.startswith("keypoint_detector: ") for line in said) == 1


def test_heavy_libraries_wait_until_they_are_needed():
    heavy = "{'cv2', 'onnxruntime', 'torch', 'open3d', 'trimesh', 'scipy.linalg', 'scipy.spatial'}"
    check = f"import finforce.ros.start, sys, finforce_keypoints.node; print({heavy} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, timeout=START_PATIENCE, check=True
    )
    assert done.stdout.strip() == "set()"
