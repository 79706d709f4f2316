"""One jaw on a bench, live: `ros2 launch finforce bench.launch.py contact_height:=0.040 images:=true`.

Without `images` the key points come by topic. `gripper_port:=/dev/ttyACM0` drives a gripper; `sim:=true` needs no
hardware.
"""

from pathlib import Path

from finforce.systems.launch import describe_system
from finforce.systems.processes import BenchOptions
from finforce.systems.setups import bench_processes

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return the solver, what feeds it, the gripper if it has a port; with `config/bench.yaml` or `bench_sim.yaml`."""
    return describe_system(BenchOptions, bench_processes, SHARE)
