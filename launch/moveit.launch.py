"""The gripper under MoveIt: `ros2 launch finforce moveit.launch.py gripper_port:=/dev/ttyACM0`."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import OpaqueFunction

from finforce.systems.launch import launch_action, options_from_texts, stack_arguments
from finforce.systems.stacks import StackOptions, moveit_processes

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return driver and move_group."""
    return LaunchDescription([*stack_arguments(), OpaqueFunction(function=start)])


def start(context):
    """Return an action for every process that the arguments ask for."""
    options = options_from_texts(StackOptions, context.launch_configurations)
    return [launch_action(part) for part in moveit_processes(options, SHARE)]
