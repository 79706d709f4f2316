"""Golden outputs: what the product answers, kept before a change and compared after it.

    python -m tools.golden freeze FOLDER --recordings BAG... [--images BAG...] [--parts forces,stress,driver,interface]
    python -m tools.golden compare BEFORE AFTER

Forces are kept image by image; stress, driver faults and the interface as figures and lists. Times are left out, but
for the latency of the chain, which `compare` shows and does not judge.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from finforce_eval.machine import write_figures

ROOT = Path(__file__).parents[1]
TOLERANCE = 1e-6  # [N, m] below which two series are equal: another order of a sum
TIMES = ("_ms", "time", "seconds", "clock", "machine", "commit", "version", "processor", "memory")
SERIES = {  # name of the file's column -> of the table's
    "force": "force",
    "torque": "torque",
    "stddev": "magnitude_stddev",
    "axis_stddev": "force_stddev",
    "place": "contact_location",
    "status": "status",
    "used": "used",
    "stamps": "stamp",
    "truth": "true_force",
    "scored": "scored",
    "contact": "contact_height",
}


def run_tool(*words: str) -> str:
    """Run Python on this checkout and return what it printed; its complaints go to the terminal."""
    done = subprocess.run([sys.executable, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    return done.stdout


def freeze_forces(folder: Path, bags: list[str], source: str) -> None:
    """Keep the series of every jaw of some recordings."""
    from finforce_eval.cli.main import parse
    from finforce_eval.evaluation.forces import evaluate_jaws
    from finforce_eval.evaluation.setup import make_setup, read_keypoints

    for bag in bags:
        calibration = "twin" if source == "images" else "bench"
        options = parse(["evaluate", bag, "--from", source, "--calibration", calibration])
        setup = make_setup(options)
        for recording in read_keypoints(options):
            for result in evaluate_jaws(recording, setup):
                columns = {name: result.column(column) for name, column in SERIES.items()}
                np.savez_compressed(folder / f"force_{source}_{result.name.replace('/', '_')}.npz", **columns)


def freeze_stress(folder: Path) -> None:
    """Keep the figures of every stress family at seed 0."""
    run_tool(
        "-m", "finforce_eval.cli.main", "stress", "--seed", "0", "--count", "60", "--json", str(folder / "stress.json")
    )


def freeze_driver(folder: Path) -> None:
    """Keep the tallies of faults between driver and gripper, alone and in grasps by force."""
    sys.path.insert(0, str(ROOT / "test" / "driver"))
    from fault_trials import run_all
    from faulty_grasp_trials import play_all

    for name, tally in (("driver_faults", run_all(2000)), ("grasp_faults", play_all(400))):
        write_figures(folder / f"{name}.json", {"seed": 1, **tally.plain()})


def freeze_chain(folder: Path, bags: list[str]) -> None:
    """Keep the latency of every stage on the first recording with images."""
    words = ("--from", "images", "--calibration", "twin", "--json", str(folder / "chain.json"))
    run_tool("-m", "finforce_eval.cli.main", "trace", bags[0], *words)


def freeze_interface(folder: Path) -> None:
    """Keep the commands with their options, and the topics, services and parameters of every node."""
    from finforce_eval.cli.main import COMMANDS

    helps = {name: run_tool("-m", "finforce_eval.cli.main", name, "--help") for name in COMMANDS}
    options = {name: sorted(set(_options(text))) for name, text in helps.items()}
    (folder / "interface.json").write_text(json.dumps({"commands": options, "nodes": _nodes()}, indent=1))


def _options(text: str) -> list[str]:
    """Return the options that a help text names."""
    words = (word.strip(",[]().;:") for word in text.split())
    return [word for word in words if word.startswith("--")]


def _nodes() -> dict[str, Any]:
    """Return topics, services and parameters of the nodes as they start."""
    import rclpy

    from finforce.ros.composition import Part, build_nodes

    parts = [Part("keypoint_detector", ()), Part("contact_estimator", ("-p", "jaws:=both"))]
    parts += [Part("ifea_solver", ("-r", "__node:=left_ifea_solver", "-p", "peer:=right"))]
    parts += [Part("gripper_driver", ("-p", "port:=/dev/null"))]
    rclpy.init()
    found = {}
    for part in parts:
        try:
            (node,) = build_nodes([part])
        except Exception as error:  # a node that needs a device says so, and its parameters stay unknown
            found[part.executable] = str(error)
            continue
        name, space = node.get_name(), node.get_namespace()
        found[part.executable] = {
            "parameters": sorted(node.list_parameters([], 0).names),
            "publishes": sorted(topic for topic, _ in node.get_publisher_names_and_types_by_node(name, space)),
            "subscribes": sorted(topic for topic, _ in node.get_subscriber_names_and_types_by_node(name, space)),
            "services": sorted(topic for topic, _ in node.get_service_names_and_types_by_node(name, space)),
        }
        node.destroy_node()
    rclpy.try_shutdown()
    return found


def compare(before: Path, after: Path) -> int:
    """Print what differs between two folders; return how many files do."""
    different = 0
    for path in sorted(before.iterdir()):
        other = after / path.name
        if not other.exists():
            print(f"{path.name}: not made again")
            continue
        lines = compare_series(path, other) if path.suffix == ".npz" else compare_figures(path, other)
        different += bool(lines) and path.name != "chain.json"
        print(f"{path.name}: {'equal' if not lines else ''}", *lines, sep="\n    " if lines else "")
    return different


def compare_series(before: Path, after: Path) -> list[str]:
    """Return a line for each column of two series that differs."""
    lines = []
    with np.load(before) as old, np.load(after) as new:
        for name in old.files:
            one, two = old[name], new[name]
            if one.shape != two.shape:
                lines.append(f"{name}: {one.shape} became {two.shape}")
            elif one.dtype.kind in "fiu":
                gaps = int((np.isnan(one.astype(float)) != np.isnan(two.astype(float))).sum())
                largest = float(np.nanmax(np.abs(one.astype(float) - two), initial=0.0))
                if gaps or largest > TOLERANCE:
                    lines.append(f"{name}: by up to {largest:.3g}, {gaps} known in one alone")
            elif (one != two).any():
                lines.append(f"{name}: {(one != two).sum()} of {one.size}")
    return lines


def compare_figures(before: Path, after: Path) -> list[str]:
    """Return a line for each figure of two JSON files that differs; times are left out, but for the chain's."""
    keep: Callable[[str], bool] = lambda key: before.name == "chain.json" or not any(word in key for word in TIMES)  # noqa: E731
    old, new = (dict(_flat(json.loads(path.read_text()))) for path in (before, after))
    lines = []
    for key in sorted(filter(keep, old.keys() | new.keys())):
        one, two = old.get(key, "nothing"), new.get(key, "nothing")
        numbers = isinstance(one, int | float) and isinstance(two, int | float)
        if one != two and not (numbers and np.isclose(one, two, rtol=1e-6, equal_nan=True)):
            lines.append(f"{key}: {one} became {two}")
    return lines


def _flat(value: Any, name: str = "") -> Any:
    """Yield the leaves of nested JSON with their dotted names; a list of words is one set of them."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _flat(item, f"{name}.{key}" if name else key)
    elif isinstance(value, list) and value and all(isinstance(item, str) for item in value):
        yield from ((f"{name}: {item}", True) for item in value)
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from _flat(item, f"{name}.{number}")
    else:
        yield name, value


def main() -> int:
    """Freeze or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    freeze = actions.add_parser("freeze")
    freeze.add_argument("folder", type=Path)
    freeze.add_argument("--recordings", nargs="*", default=[], help="with key points")
    freeze.add_argument("--images", nargs="*", default=[], help="with images, of the twin")
    freeze.add_argument("--parts", default="forces,stress,driver,interface,chain")
    other = actions.add_parser("compare")
    other.add_argument("before", type=Path)
    other.add_argument("after", type=Path)
    options = parser.parse_args()
    if options.action == "compare":
        return min(compare(options.before, options.after), 1)
    options.folder.mkdir(parents=True, exist_ok=True)
    parts: dict[str, Callable[[], None]] = {
        "forces": lambda: [
            freeze_forces(options.folder, options.recordings, "keypoints"),
            freeze_forces(options.folder, options.images, "images"),
        ],
        "stress": lambda: freeze_stress(options.folder),
        "driver": lambda: freeze_driver(options.folder),
        "interface": lambda: freeze_interface(options.folder),
        "chain": lambda: freeze_chain(options.folder, options.images),
    }
    for part in options.parts.split(","):
        parts[part]()
    return 0


if __name__ == "__main__":
    sys.exit(main())
