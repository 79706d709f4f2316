"""The executables of the nodes: quiet while they load, clear when ROS 2 is missing."""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module

NODES = {
    "ifea_solver": "finforce_ifea.node",
    "contact_estimator": "finforce_contact.node",
    "keypoint_detector": "finforce_keypoints.node",
    "pipeline": "finforce.ros.composition",
    "gripper_driver": "finforce_driver.node",
    "emulated_gripper": "finforce_sim.emulator.pty_port",
    "recording_player": "finforce_eval.replay.node",
    "twin_camera": "finforce_sim.node",
}
STOPS = (signal.SIGINT, signal.SIGTERM)


def ifea_solver() -> int:
    """Run the solver of one jaw."""
    return start("ifea_solver")


def contact_estimator() -> int:
    """Run the contact estimator of one jaw or both."""
    return start("contact_estimator")


def keypoint_detector() -> int:
    """Run the key point detector of one jaw or both."""
    return start("keypoint_detector")


def pipeline() -> int:
    """Run detector, contact estimator and solvers in one process."""
    return start("pipeline")


def gripper_driver() -> int:
    """Run the driver of the gripper."""
    return start("gripper_driver")


def emulated_gripper() -> int:
    """Run the emulated gripper, which is no node; what `ros2 launch` adds for nodes is left out."""
    if "--ros-args" in sys.argv:
        del sys.argv[sys.argv.index("--ros-args") :]
    return start("emulated_gripper")


def recording_player() -> int:
    """Run the player of recordings."""
    return start("recording_player")


def twin_camera() -> int:
    """Run the camera of the synthetic twin."""
    return start("twin_camera")


def start(name: str) -> int:
    """Load a node and run it; return its exit status, 2 without ROS 2.

    Loading takes a second, in which nothing has to be cleaned up: a signal ends it at once.
    """
    before = [signal.signal(number, lambda *_: os._exit(0)) for number in STOPS]
    try:
        module = import_module(NODES[name])
    except ImportError as error:
        print(f"{name}: needs ROS 2: source it, or pip install 'finforce[ros]' ({error})", file=sys.stderr)
        return 2
    for number, handler in zip(STOPS, before, strict=True):
        signal.signal(number, handler)
    return module.main()


if __name__ == "__main__":
    sys.exit(start(sys.argv.pop(1)))
