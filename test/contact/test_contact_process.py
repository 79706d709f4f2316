"""Claims about the contact estimator as a process: it starts, says what is wrong, and ends cleanly."""

import signal
import subprocess
import sys

import pytest
from contact_node_fakes import MESH
from node_fakes import START_PATIENCE, command_of, run_here, stop_when_ready


def test_a_signal_ends_the_node_cleanly():
    status, text = stop_when_ready(
        command_of("contact_estimator", f"object_mesh:={MESH}", "object_mash:=x"), signal.SIGTERM
    )
    assert status == 0, text
    assert "Traceback" not in text
    assert "there is no parameter 'object_mash'" in text


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ("jaws:=middle", "jaws: got 'middle'"),
        ("jaw_file:=no_such_jaw", "no_such_jaw"),
        ("calibration_file:=no_such_file", "no_such_file"),
        ("contact.mode:=guess", "contact.mode: got 'guess'"),
        ("tracker.least_fitness:=2.0", "tracker.least_fitness"),
        ("pose_source:=detections", "ros-jazzy-vision-msgs"),
    ],
)
def test_what_cannot_be_set_up_ends_with_two_and_one_reason(given, reason, capfd):
    assert run_here("contact_estimator", given) == 2
    text = capfd.readouterr().err
    assert reason in text.strip().splitlines()[-1] and "Traceback" not in text


@pytest.mark.parametrize("name", ["ifea_solver", "contact_estimator"])
def test_heavy_libraries_wait_until_they_are_needed(name):
    heavy = "{'open3d', 'trimesh', 'manifold3d', 'small_gicp', 'scipy.linalg', 'scipy.sparse', 'scipy.spatial'}"
    load = f"from finforce.ros import start; __import__(start.NODES['{name}'])"
    check = f"import sys; {load}; print({heavy} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, timeout=START_PATIENCE, check=True
    )
    assert done.stdout.strip() == "set()"
