"""The gripper as a system of ros2_control: `ros2 launch finforce ros2_control.launch.py gripper_port:=/dev/ttyACM0`."""

from pathlib import Path

from finforce.systems.launch import describe_system
from finforce.systems.processes import StackOptions
from finforce.systems.stacks import control_processes

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return driver, controller manager and controllers."""
    return describe_system(StackOptions, control_processes, SHARE)
