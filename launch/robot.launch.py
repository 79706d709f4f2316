"""Two jaws on a robot's wrist: `ros2 launch finforce robot.launch.py object_mesh:=FILE arm:=true robot_ip:=ADDRESS`.

`sim:=true` needs no hardware: `ros2 launch finforce robot.launch.py sim:=true`.
"""

from pathlib import Path

from finforce.systems.launch import describe_system
from finforce.systems.processes import RobotOptions
from finforce.systems.setups import robot_processes

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return camera, detector, contacts, solvers, gripper, arm; with `config/robot.yaml` or `robot_sim.yaml`."""
    return describe_system(RobotOptions, robot_processes, SHARE)
