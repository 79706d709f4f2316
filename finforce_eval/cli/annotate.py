"""The subcommand `annotate`: forces into recordings that exist."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from shutil import rmtree
from typing import Any

from finforce.errors import FinforceError, one_line
from finforce_eval.annotation.bag import FEW, bag_task
from finforce_eval.annotation.buffer_copy import write_buffer
from finforce_eval.annotation.dataset_copy import write_copy
from finforce_eval.annotation.dataset_forces import episode_tasks, plain_columns, write_dataset
from finforce_eval.cli.parser import BAG_HELP, CommandResult, add_engine_options, add_run_options, read_engine
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.keypoint_source import IMAGES
from finforce_eval.evaluation.setup import describe_options, print_notes
from finforce_eval.policy import COLUMNS, FEATURE, FORCE, INTO, NONE, PREFIX
from finforce_eval.recordings.bags import is_buffer, name_recordings
from finforce_eval.recordings.dataset import is_dataset, open_dataset
from finforce_eval.recordings.umi import count_episodes, is_replay_buffer
from finforce_eval.recordings.writer import new_folder
from finforce_eval.tasks import OK, Line, Manifest, Task, run_tasks


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help=BAG_HELP)
    text = "output folder, with one folder per recording and _manifest.jsonl (annotated)"
    parser.add_argument("--out", default="annotated", metavar="DIR", help=text)
    text = "bags only: write the new messages without a copy of the recording"
    parser.add_argument("--side-file", action="store_true", help=text)
    text = "draw key points and forces into the images, too: forces.mp4; not for LeRobot datasets"
    parser.add_argument("--video", action="store_true", help=text)
    parser.add_argument("--images", dest="color", help=argparse.SUPPRESS)
    text = "take the key points' offsets from the first images of another episode, or from another time on, as 12.5s, "
    text += "of the same session: the first 1.5 s get forces, too (the first images)"
    parser.add_argument("--tare-from", metavar="EPISODE|SECONDS", help=text)
    _add_policy_options(parser)
    add_run_options(parser)
    add_engine_options(parser)


def _add_policy_options(command: argparse.ArgumentParser) -> None:
    """Add what policies get of the forces."""
    parser = command.add_argument_group("datasets for policies")
    text = (
        "where policies find the forces: appended to observation.state, in a feature observation.force of their own, "
    )
    text += "which many policies do not read, or nowhere (feature)"
    parser.add_argument("--into", default=FEATURE, choices=INTO, help=text)
    text = f"numbers that go there, of {', '.join(COLUMNS)}, each group with a flag valid ({FORCE})"
    parser.add_argument("--columns", nargs="+", default=[FORCE], choices=COLUMNS, metavar="NAME", help=text)
    text = f"prefix of the new names ({PREFIX})"
    parser.add_argument("--prefix", default=PREFIX, metavar="NAME", help=text)
    text = "copy LeRobot datasets without what annotate has added to them, and look at no image"
    parser.add_argument("--remove", action="store_true", help=text)


def run(options: argparse.Namespace) -> CommandResult:
    """Annotate recordings and print a line for each; status 2 where one of them failed."""
    out, manifest = Path(options.out), Manifest(Path(options.out))
    named = name_recordings(options.bags, "_")
    if options.remove:
        return _remove_forces(named, out)
    if options.source in (None, IMAGES) and not any(given.startswith("threads=") for given in options.detector):
        options.detector = [*options.detector, "threads=1"]  # a core for each recording, whatever the engine
    datasets = {name: path for name, path in named if is_dataset(path)}
    if datasets:
        if options.video:
            raise OptionError("--video: not for LeRobot datasets; expected recordings, videos or folders of pictures")
        options.jaws = options.jaws or "both"
    bags = [(name, path) for name, path in named if name not in datasets]
    settings = describe_options(options)
    with manifest.alone():
        tasks = [task for name, path in bags for task in _tasks_of(name, path, options, settings)]
        lines = run_tasks(tasks, read_engine(options), manifest)
        for line in lines:
            _print_outcome(line)
        _write_buffers(named, out, options)
        for name, path in datasets.items():
            try:
                lines += _run_dataset(name, path, options, manifest)
            except FinforceError as error:
                lines.append(Task(name=name, key="", work=_run_dataset).line(one_line(error)))
                _print_outcome(lines[-1])
    annotated = sum(map(_has_force, lines))
    print(f"{annotated} of {len(lines)} annotated in {out}; {manifest.path.name} lists them")
    failed = not annotated or any(line["status"] != OK for line in lines)
    return CommandResult({"recordings": lines}, status=2 if failed else 0)


def _tasks_of(name: str, path: Path, options: argparse.Namespace, settings: Mapping[str, Any]) -> list[Task]:
    """Return the task of a recording, or those of the episodes of a buffer; one that is damaged says so at its work."""
    count = 0
    with suppress(FinforceError):
        count = count_episodes(path) if is_buffer(path) else 0
    episodes = {f"{name}_{number:06d}": number for number in range(count)} or {name: options.episode}
    return [
        bag_task(each, path, Path(options.out) / each, argparse.Namespace(**vars(options) | {"episode": n}), settings)
        for each, n in episodes.items()
    ]


def _write_buffers(named: Sequence[tuple[str, Path]], out: Path, options: argparse.Namespace) -> None:
    """Copy replay buffers some of whose episodes have forces, with these; a copy that is there stays."""
    for name, path in named:
        count, target = 0, out / path.name
        with suppress(FinforceError):
            count = count_episodes(path) if is_replay_buffer(path) else 0
        parts = [out / f"{name}_{number:06d}" for number in range(count)]
        if options.into == NONE or target.exists() or not any(part.exists() for part in parts):
            continue
        with new_folder(target) as copy:
            written = write_buffer(path, copy, parts, options.columns, options.prefix)
        print(f"{target}: forces in {written} of {count} episodes")


def _has_force(line: Line) -> bool:
    """Say whether a task found forces."""
    return line["status"] == OK and not line["figures"].get("without_force")


def _run_dataset(name: str, path: Path, options: argparse.Namespace, manifest: Manifest) -> list[Line]:
    """Annotate the episodes of a dataset, and write it anew once all of them are; say what became of each."""
    out = Path(options.out)
    parts, target = out / f".{name}.parts", out / name
    if target.exists():
        raise OptionError(f"{target}: exists already; a dataset is written to a new folder")
    parts.mkdir(exist_ok=True)
    lines = run_tasks(episode_tasks(path, parts, options), read_engine(options), manifest)
    for line in lines:
        _print_outcome(line)
    if any(line["status"] != OK for line in lines):
        print(f"{name}: not written: some of its episodes failed", file=sys.stderr)
        return lines
    if not any(map(_has_force, lines)):
        print(f"{name}: not written: no force in any of its {len(lines)} episodes", file=sys.stderr)
        return lines
    with new_folder(target) as folder:
        folder.mkdir()
        write_dataset(path, parts, folder, options)
    rmtree(parts)
    if options.into == FEATURE:
        text = (
            f"ACT, diffusion and others do not read observation.{options.prefix}; --into state lets every policy see it"
        )
        print_notes(name, [text])
    return lines


def _remove_forces(named: Sequence[tuple[str, Path]], out: Path) -> CommandResult:
    """Copy datasets without what annotate has added to them, and print what that was."""
    removed: dict[str, list[str]] = {}
    for name, path in named:
        if not is_dataset(path):
            raise OptionError(f"--remove: {path} is no LeRobot dataset; the original of a recording is unchanged")
        dataset = open_dataset(path, None)
        columns = plain_columns(dataset)
        with new_folder(out / name) as folder:
            folder.mkdir()
            write_copy(dataset, folder, columns)
        removed[name] = list(columns)
        print(f"{name}: without {', '.join(columns) or 'anything: it has no forces'}, in {out / name}")
    return CommandResult({"removed": removed})


def _print_outcome(line: dict[str, Any]) -> None:
    """Print what became of a recording."""
    name, error = line["name"], line["error"]
    if line["status"] != OK:
        print(error if error.startswith(f"{name}: ") else f"{name}: {error}", file=sys.stderr)
        return
    print_notes(name, line["figures"].get("notes", ()))
    for side, jaw in line["figures"].get("jaws", {}).items():
        words = [f"{name}: {side} {jaw['answered']} of {jaw['images']} images, {jaw['largest_N'] or 0.0:.2f} N at most"]
        if jaw.get("residual_mm") is not None and jaw.get("within_reach") is not None:
            words.append(
                f"key points {jaw['residual_mm']:.2f} mm off, {100 * jaw['within_reach']:.0f} % within the jaw's reach"
            )
        if jaw["answered"] < FEW * jaw["images"] and jaw.get("unanswered"):
            counts = ", ".join(f"{count} {word}" for word, count in jaw["unanswered"].items())
            words.append(f"without: {counts}{': ' if jaw.get('why') else ''}{jaw.get('why', '')}")
        print("; ".join(words))
