"""The jaws of a recording: `ros2 launch finforce replay.launch.py bag:=FOLDER contact_height:=0.040`.

Without `bag` nothing is played here; `ros2 bag play --clock 100 FOLDER` does it then. `images:=true` finds the key
points in the images of the recording.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction

from finforce.systems.launch import launch_action, options_from_texts, solver_arguments
from finforce.systems.processes import ReplayOptions, replay_processes

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return the solvers, what feeds them, and the player if a recording is named, with `config/replay.yaml`."""
    return LaunchDescription(
        [
            *solver_arguments(parameter_file=str(SHARE / "config" / "replay.yaml"), use_sim_time="true"),
            DeclareLaunchArgument(
                "jaws", default_value="left", choices=["left", "right", "both"], description="the jaws of the recording"
            ),
            DeclareLaunchArgument(
                "bag",
                default_value="none",
                description="recording to be played; none: somebody else plays it, with /clock",
            ),
            DeclareLaunchArgument("rate", default_value="1.0", description="speed of playing"),
            OpaqueFunction(function=start),
        ]
    )


def start(context):
    """Return an action for every process that the arguments ask for."""
    options = options_from_texts(ReplayOptions, context.launch_configurations)
    return [launch_action(part) for part in replay_processes(options, SHARE)]
