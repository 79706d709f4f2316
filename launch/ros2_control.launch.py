"""The gripper as a system of ros2_control: `ros2 launch finforce ros2_control.launch.py gripper_port:=/dev/ttyACM0`."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import OpaqueFunction

from finforce.systems.launch import launch_action, options_from_texts, stack_arguments
from finforce.systems.stacks import StackOptions, control_processes

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return driver, controller manager and controllers."""
    return LaunchDescription([*stack_arguments(), OpaqueFunction(function=start)])


def start(context):
    """Return an action for every process that the arguments ask for."""
    options = options_from_texts(StackOptions, context.launch_configurations)
    return [launch_action(part) for part in control_processes(options, SHARE)]
