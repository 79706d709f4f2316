"""The subcommand `annotate`: forces into recordings that exist."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from finforce_eval.annotation.run import bag_task, ended_before
from finforce_eval.cli.parser import add_engine_options, add_jaw_options, add_set, add_source_options
from finforce_eval.engine.engines import EngineOptions, run_tasks
from finforce_eval.engine.tasks import OK, Manifest, Task, choose_shard
from finforce_eval.errors import OptionError
from finforce_eval.recordings.tracks import JAWS


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    text = "folder of what is written: one folder per recording, and manifest.jsonl (annotated)"
    parser.add_argument("--out", default="annotated", metavar="DIR", help=text)
    text = "write the new messages alone, beside the recording instead of a copy of it"
    parser.add_argument("--side-file", action="store_true", help=text)
    text = "jaws that are in the images, where no topic tells"
    parser.add_argument("--jaws", choices=(*JAWS, "both"), help=text)
    add_jaw_options(parser)
    add_source_options(parser)
    calibration = "calibration file, or a shipped name; without it the jaw file's own material"
    parser.add_argument("--calibration", metavar="FILE", help=calibration)
    add_set(parser)
    add_engine_options(parser)


def run(options: argparse.Namespace) -> int:
    """Annotate recordings and print a line for each; 2 where one of them failed."""
    out = Path(options.out)
    tasks = [bag_task(name, path, out / name, options) for name, path in _name_recordings(options.bags)]
    chosen = choose_shard(tasks, options.shard)
    manifest = Manifest(out, options.shard)
    engine = EngineOptions(
        engine=options.engine, workers=options.workers, memory=options.memory, address=options.address
    )
    with manifest.alone():
        lines = run_tasks(chosen, engine, manifest, ended_before)
    for task, line in zip(chosen, lines, strict=True):
        _say(task, line)
    failed = sum(line["status"] != OK for line in lines)
    print(f"{len(lines) - failed} of {len(lines)} annotated in {out}; {manifest.path.name} tells of each")
    return 2 if failed else 0


def _name_recordings(texts: Sequence[str]) -> list[tuple[str, Path]]:
    """Return recordings with names of their own, by as much of their paths as that takes.

    Raises:
        OptionError: one was given twice.
    """
    paths = [Path(text).resolve() for text in texts]
    if len(set(paths)) < len(paths):
        raise OptionError("a recording was given twice")
    names = [path.stem if path.is_file() else path.name for path in paths]
    depth = 1
    while len(set(names)) < len(names):
        depth += 1
        names = ["_".join(path.with_suffix("").parts[-depth:]).strip("/") for path in paths]
    return list(zip(names, paths, strict=True))


def _say(task: Task, line: dict[str, Any]) -> None:
    """Print what became of a recording."""
    if line["status"] != OK:
        said = line["error"]
        print(said if said.startswith(f"{task.name}: ") else f"{task.name}: {said}", file=sys.stderr)
        return
    for note in line["figures"].get("notes", ()):
        print(f"note: {task.name}: {note}", file=sys.stderr)
    words = [
        f"{side} {jaw['answered']} of {jaw['images']} images, {jaw['largest_N'] or 0.0:.2f} N at most"
        for side, jaw in line["figures"].get("jaws", {}).items()
    ]
    print(f"{task.name}: {'; '.join(words)}")
