"""What forces for recordings cost: annotation by each engine, in times real time, with the same recordings.

    python -m benchmarks.annotation BAG... --engines sequential processes ray -- --calibration bench

What stands behind `--` are options of `finforce annotate`. Each engine runs in a process of its own; its start counts.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from finforce_eval.engine.engines import ENGINES
from finforce_eval.machine import write_figures


def measure(bags: Sequence[str], engine: str, options: Sequence[str]) -> dict[str, Any]:
    """Annotate recordings by an engine and return seconds, times real time, and a digest of all that was written."""
    with TemporaryDirectory(prefix="finforce_") as folder:
        command = [sys.executable, "-m", "finforce_eval.cli.main", "annotate", *bags, "--out", folder]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        began = perf_counter()
        done = subprocess.run(
            [*command, "--engine", engine, *options], env=environment, capture_output=True, text=True, check=False
        )
        seconds = perf_counter() - began
        if done.returncode:
            raise SystemExit(f"{engine}: {done.stderr.strip()[-500:]}")
        lines = [json.loads(line) for line in (Path(folder) / "manifest.jsonl").read_text().splitlines()]
        own = sorted(line["seconds"] for line in lines)
        span = sum(line["figures"]["span_s"] for line in lines)
        content = sha256()
        for path in sorted(Path(folder).glob("*/*.mcap")):
            content.update(path.name.encode() + path.read_bytes())
    return {
        "recordings": len(lines),
        "seconds": seconds,
        "span_s": span,
        "times_real_time": span / seconds,
        "times_real_time_of_a_task": span / len(lines) / own[len(own) // 2],
        "content": content.hexdigest()[:16],
    }


def main() -> None:
    """Measure the engines and print a table."""
    words = sys.argv[1:]
    middle = words.index("--") if "--" in words else len(words)
    own, rest = words[:middle], words[middle + 1 :]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.annotation", description=__doc__.splitlines()[0])
    parser.add_argument("bags", nargs="+", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    parser.add_argument("--engines", nargs="+", default=["sequential", "processes"], choices=ENGINES, help="to be run")
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    options = parser.parse_args(own)
    figures = {engine: measure(options.bags, engine, rest) for engine in options.engines}
    print(f"{'engine':<12}{'seconds':>9}{'x real time':>13}{'x, of a task':>14}  content")
    for engine, row in figures.items():
        rates = f"{row['times_real_time']:>13.1f}{row['times_real_time_of_a_task']:>14.1f}"
        print(f"{engine:<12}{row['seconds']:>9.1f}{rates}  {row['content']}")
    if options.json:
        write_figures(options.json, {"engines": figures, "options": rest})


if __name__ == "__main__":
    main()
