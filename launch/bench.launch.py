"""One jaw on a bench, live: `ros2 launch finforce bench.launch.py contact_height:=0.040 images:=true`.

Without `images` the key points come by topic. `gripper_port:=/dev/ttyACM0` drives a gripper; `sim:=true` needs no
hardware.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction

from finforce.systems.launch import gripper_arguments, launch_action, options_from_texts, solver_arguments
from finforce.systems.live import bench_processes
from finforce.systems.processes import BenchOptions

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return the solver, what feeds it, the gripper if it has a port; with `config/bench.yaml` or `bench_sim.yaml`."""
    return LaunchDescription(
        [
            *solver_arguments(),
            *gripper_arguments(),
            DeclareLaunchArgument(
                "jaw", default_value="left", choices=["left", "right"], description="the jaw that is on the bench"
            ),
            OpaqueFunction(function=start),
        ]
    )


def start(context):
    """Return an action for every process that the arguments ask for."""
    options = options_from_texts(BenchOptions, context.launch_configurations)
    return [launch_action(part) for part in bench_processes(options, SHARE)]
