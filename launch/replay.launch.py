"""The jaws of a recording: `ros2 launch finforce replay.launch.py bag:=FOLDER contact_height:=0.040`.

Without `bag` nothing is played here; `ros2 bag play --clock 100 FOLDER` does it then.
"""

from pathlib import Path

from finforce_graph import ReplayOptions, describe_launch, replay_processes

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return the solvers, and the player if a recording is named, with `config/replay.yaml`."""
    parameter_file = str(SHARE / "config" / "replay.yaml")
    return describe_launch(ReplayOptions, replay_processes, SHARE, parameter_file=parameter_file)
