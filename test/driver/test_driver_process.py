"""Claims about the driver node as a process: it starts, says what is wrong, and ends cleanly."""

import signal
import subprocess
import sys
from time import monotonic, sleep

import pytest
from node_fakes import START_PATIENCE, command_of, run_here, stop_when_ready

from finforce_sim.emulator.adapter import EmulatedAdapter
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.emulator.pty_port import PtyPort


def wait_for(condition):
    until = monotonic() + 10.0
    while not condition():
        assert monotonic() < until
        sleep(0.01)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_cleanly_and_closes_the_adapter(number):
    adapter = EmulatedAdapter(EmulatedGripper())
    with PtyPort(adapter) as port:
        status, text = stop_when_ready(command_of("gripper_driver", f"port:={port.path}", "prot:=x"), number)
        assert status == 0, text
        assert "Traceback" not in text
        assert "there is no parameter 'prot'" in text
        wait_for(lambda: not adapter.joined)  # the last bytes may still be on their way


def test_a_signal_ends_a_node_that_has_no_port():
    status, text = stop_when_ready(command_of("gripper_driver", "port:=/dev/no_such_port"), signal.SIGTERM)
    assert status == 0, text
    assert "Traceback" not in text


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ("baud_rate:=100", "baud_rate"),
        ("gripper.node_id:=16", "gripper.node_id"),
        ("grasp_force:=9.0", "set force: got 9 N"),
        ("joint_names:=[a]", "joint_names: got"),
        ("port", "parse parameter override rule: '-p port'"),
    ],
)
def test_what_cannot_be_set_up_ends_with_two_and_one_line(given, reason, capfd):
    assert run_here("gripper_driver", given) == 2
    text = capfd.readouterr().err
    said = text.strip().splitlines()
    assert reason in said[-1] and "Traceback" not in text
    assert sum(line.startswith("gripper_driver: ") for line in said) == 1


def test_heavy_libraries_wait_until_they_are_needed():
    heavy = "{'serial', 'can', 'cv2', 'onnxruntime', 'torch', 'open3d', 'trimesh', 'numba'}"
    check = f"import finforce.ros.start, sys, finforce_driver.node; print({heavy} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, timeout=START_PATIENCE, check=True
    )
    assert done.stdout.strip() == "set()"
