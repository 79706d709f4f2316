"""Claims about the solver as a process: it starts, says what is wrong, and ends cleanly."""

import signal
import subprocess
import sys

import pytest
from node_fakes import START_PATIENCE, command_of, run_here, stop_when_ready


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_cleanly(number):
    status, text = stop_when_ready(command_of("ifea_solver", "contact_height:=0.04", "contact_heigth:=0.05"), number)
    assert status == 0, text
    assert "Traceback" not in text
    # a misspelt parameter is named
    assert "there is no parameter 'contact_heigth'" in text


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ("jaw_name:=middle", "jaw_name: got 'middle'"),
        ("jaw_file:=no_such_jaw", "no_such_jaw"),
        ("max_age:=-1.0", "max_age"),
        ("max_age:=soon", "max_age"),
        ("calibration_file:=no_such_file", "no_such_file"),
        ("contact_height:=0.5", "500 mm"),
        ("estimator.likelihood_threshold:=2.0", "likelihood_threshold"),
    ],
)
def test_what_cannot_be_set_up_ends_with_two_and_one_line(given, reason, capfd):
    assert run_here("ifea_solver", given) == 2
    text = capfd.readouterr().err
    assert reason in text and len(text.strip().splitlines()) == 1


def test_a_signal_while_the_node_loads_ends_it_without_a_word():
    slow = "import finforce.ros.start, os, signal; finforce.ros.start.import_module = lambda _: os.kill(os.getpid(), 2)"
    done = subprocess.run(
        [sys.executable, "-c", f"{slow}; finforce.ros.start.start('ifea_solver')"],
        capture_output=True,
        text=True,
        timeout=START_PATIENCE,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_without_ros_a_node_says_how_to_get_it():
    missing = "import sys; sys.modules['rclpy'] = None; import finforce.ros.start"
    done = subprocess.run(
        [sys.executable, "-c", f"{missing}; sys.exit(finforce.ros.start.start('ifea_solver'))"],
        capture_output=True,
        text=True,
        timeout=START_PATIENCE,
    )
    assert done.returncode == 2
    assert "pip install 'finforce[ros]'" in done.stderr and len(done.stderr.splitlines()) == 1


LATE_WATCH = """
import rclpy, sys, threading, time
from finforce.ros.node import run_nodes

ok, shut_down = rclpy.ok, rclpy.try_shutdown


def answer_late():
    while threading.current_thread().name == "context" and ok():
        time.sleep(0.01)
    return ok()


def build():
    time.sleep(0.5)
    raise RuntimeError("cannot be started")


rclpy.ok, rclpy.try_shutdown = answer_late, lambda: (shut_down(), time.sleep(0.5))
sys.exit(run_nodes("node", build, []))
"""


def test_a_failed_start_is_told_though_its_context_ends_while_somebody_looks_at_it():
    done = subprocess.run([sys.executable, "-c", LATE_WATCH], capture_output=True, text=True, timeout=START_PATIENCE)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1] == "RuntimeError: cannot be started"
