"""Claims about the solver as a process: it starts, says what is wrong, and ends cleanly."""

import os
import random
import signal
import subprocess
import sys
import threading

import pytest

COMMAND = [sys.executable, "-m", "finforce_start", "ifea_solver", "--ros-args"]
PATIENCE = 240.0  # s; a first start compiles


def environment():
    own = {"ROS_DOMAIN_ID": str(random.randint(1, 99)), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {**os.environ, **own}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_cleanly(number):
    words = [*COMMAND, "-p", "contact_height:=0.04", "-p", "contact_heigth:=0.05"]
    node = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, env=environment())
    guard = threading.Timer(PATIENCE, node.kill)
    guard.start()
    said = []
    for line in node.stderr:
        said.append(line)
        if " ready" in line:
            node.send_signal(number)
    guard.cancel()
    text = "".join(said)
    assert node.wait(10) == 0, text
    assert "Traceback" not in text
    # a misspelt parameter is named
    assert "there is no parameter 'contact_heigth'" in text


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ("jaw_name:=middle", "jaw_name is 'middle'"),
        ("jaw_file:=no_such_jaw", "no_such_jaw"),
        ("max_age:=-1.0", "max_age"),
        ("max_age:=soon", "max_age"),
        ("calibration_file:=no_such_file", "no_such_file"),
        ("contact_height:=0.5", "500 mm"),
        ("estimator.likelihood_threshold:=2.0", "likelihood_threshold"),
    ],
)
def test_what_cannot_be_set_up_ends_with_two_and_one_line(given, reason):
    done = subprocess.run([*COMMAND, "-p", given], capture_output=True, text=True, timeout=PATIENCE, env=environment())
    assert done.returncode == 2
    assert reason in done.stderr and len(done.stderr.strip().splitlines()) == 1


def test_a_signal_while_the_node_loads_ends_it_without_a_word():
    slow = "import finforce_start, os, signal; finforce_start.import_module = lambda _: os.kill(os.getpid(), 2)"
    done = subprocess.run(
        [sys.executable, "-c", f"{slow}; finforce_start.start('ifea_solver')"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_without_ros_a_node_says_how_to_get_it():
    missing = "import sys; sys.modules['rclpy'] = None; import finforce_start"
    done = subprocess.run(
        [sys.executable, "-c", f"{missing}; sys.exit(finforce_start.ifea_solver())"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 2
    assert "pip install 'finforce[ros]'" in done.stderr and len(done.stderr.splitlines()) == 1
