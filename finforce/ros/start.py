"""The executables of the nodes: quiet while they load, clear when ROS 2 is missing."""

from __future__ import annotations

import os
import signal
import sys
from functools import partial
from importlib import import_module

NODES = {
    "ifea_solver": "finforce_ifea.node",
    "contact_estimator": "finforce_contact.node",
    "keypoint_detector": "finforce_keypoints.node",
    "pipeline": "finforce.ros.composition",
    "gripper_driver": "finforce_driver.node",
    "emulated_gripper": "finforce_sim.emulator.__main__",
    "recording_player": "finforce_eval.replay.node",
    "twin_camera": "finforce_sim.node",
}
STOPS = (signal.SIGINT, signal.SIGTERM)


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


def emulated_gripper() -> int:
    """Run the emulated gripper, which is no node; what `ros2 launch` adds for nodes is left out."""
    if "--ros-args" in sys.argv:
        del sys.argv[sys.argv.index("--ros-args") :]
    return start("emulated_gripper")


# the entry points of the others, see setup.py
ifea_solver = partial(start, "ifea_solver")
contact_estimator = partial(start, "contact_estimator")
keypoint_detector = partial(start, "keypoint_detector")
pipeline = partial(start, "pipeline")
gripper_driver = partial(start, "gripper_driver")
recording_player = partial(start, "recording_player")
twin_camera = partial(start, "twin_camera")


if __name__ == "__main__":
    sys.exit(start(sys.argv.pop(1)))
