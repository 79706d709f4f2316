"""The gripper under MoveIt: `ros2 launch finforce moveit.launch.py gripper_port:=/dev/ttyACM0`."""

from pathlib import Path

from finforce.systems.launch import describe_system
from finforce.systems.processes import StackOptions
from finforce.systems.stacks import moveit_processes

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return driver and move_group."""
    return describe_system(StackOptions, moveit_processes, SHARE)
