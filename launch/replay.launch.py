"""The jaws of a recording: `ros2 launch finforce replay.launch.py bag:=FOLDER contact_height:=0.040`.

Without `bag` nothing is played here; `ros2 bag play --clock 100 FOLDER` does it then. `images:=true` finds the key
points in the images of the recording.
"""

from pathlib import Path

from finforce.systems.launch import describe_system
from finforce.systems.processes import ReplayOptions, replay_processes

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return the solvers, what feeds them, and the player if a recording is named, with `config/replay.yaml`."""
    return describe_system(ReplayOptions, replay_processes, SHARE, parameter_file=str(SHARE / "config" / "replay.yaml"))
