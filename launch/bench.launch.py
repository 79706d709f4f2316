"""One jaw on a bench, live: `ros2 launch finforce bench.launch.py contact_height:=0.040 images:=true`.

Without `images` the key points come by topic.
"""

from pathlib import Path

from finforce_graph import BenchOptions, bench_processes
from finforce_launch import describe_launch

SHARE = Path(__file__).resolve().parents[1]


def generate_launch_description():
    """Return the solver of the jaw, and what feeds it, with `config/bench.yaml`."""
    parameter_file = str(SHARE / "config" / "bench.yaml")
    return describe_launch(BenchOptions, bench_processes, SHARE, parameter_file=parameter_file)
