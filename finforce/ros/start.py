"""The executables of the nodes: quiet while they load, clear when ROS 2 is missing."""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from finforce.processors import bind_caller

NODES = {
    "ifea_solver": "finforce_ifea.node",
    "contact_estimator": "finforce_contact.node",
    "keypoint_detector": "finforce_keypoints.node",
    "finforce_pipeline": "finforce.ros.composition",
    "gripper_driver": "finforce_driver.node",
    "emulated_gripper": "finforce_sim.emulator.__main__",
    "finforce_recording_player": "finforce_eval.replay.node",
    "twin_camera": "finforce_sim.node",
}
CLASSES = {  # of the nodes that may share a process
    "keypoint_detector": "KeypointDetectorNode",
    "contact_estimator": "ContactEstimatorNode",
    "ifea_solver": "IfeaSolverNode",
    "gripper_driver": "GripperDriverNode",
}
STOPS = (signal.SIGINT, signal.SIGTERM)


def start(name: str) -> int:
    """Load a node and run it; return its exit status, 2 without ROS 2.

    Loading takes a second, in which nothing has to be cleaned up: a signal ends it at once.
    """
    if name == "emulated_gripper" and "--ros-args" in sys.argv:  # no node: what `ros2 launch` adds is left out
        del sys.argv[sys.argv.index("--ros-args") :]
    before = [signal.signal(number, lambda *_: os._exit(0)) for number in STOPS]
    try:
        module = import_module(NODES[name])
    except ImportError as error:
        print(f"{name}: needs ROS 2: source it, or pip install 'finforce[ros]' ({error})", file=sys.stderr)
        return 2
    for number, handler in zip(STOPS, before, strict=True):
        signal.signal(number, handler)
    if name not in CLASSES:
        return module.main()
    from finforce.ros.node import run_node

    def build() -> Any:
        node = getattr(module, CLASSES[name])()
        bind_caller(getattr(node.parameters, "threads", 1))
        return node

    return run_node(name, build)


def main() -> int:
    """Run the node that this executable is called after, else the one that the first word names."""
    own = Path(sys.argv[0]).stem
    return start(own if own in NODES else sys.argv.pop(1))


if __name__ == "__main__":
    sys.exit(main())
