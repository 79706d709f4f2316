"""The subcommand `status`: the diagnostics of a running system as a table, without the `ros2` command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from dataclasses import asdict
from shutil import get_terminal_size
from typing import TYPE_CHECKING

from finforce.health import Level
from finforce.optional import import_ros
from finforce_eval.cli.parser import CommandResult

if TYPE_CHECKING:
    from finforce.ros.monitor import NodeStatus

PERIOD = 1.0  # [s] between two tables on a terminal
COLLECTED = 3.0  # [s] in which every node has published its diagnostics once
SILENT = 5.0  # [s] after which diagnostics count as stale
_CLEAR = "\033[H\033[J"  # of a terminal
_HEAD = ("part", "state", "Hz", "ms p95", "")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "print one table and exit, with 1 if a part is in error or silent; always so without a terminal"
    parser.add_argument("--once", action="store_true", help=text)


def run(options: argparse.Namespace) -> CommandResult:
    """Show the state of every part of a running system, once or until Ctrl-C."""
    iter_statuses = import_ros("finforce.ros.monitor", "status").iter_statuses
    if options.once or options.json or not sys.stdout.isatty():
        statuses = next(iter_statuses(COLLECTED))
        print(format_statuses(statuses))
        failed = not statuses or any(level_of(status) >= Level.ERROR for status in statuses.values())
        return CommandResult({name: asdict(status) for name, status in statuses.items()}, status=int(failed))
    for statuses in iter_statuses(PERIOD):
        print(f"{_CLEAR}{format_statuses(statuses, get_terminal_size().columns)}", flush=True)
    return CommandResult()


def level_of(status: NodeStatus) -> Level:
    """Return the level of a part, which is stale after some silence."""
    return Level.STALE if status.age > SILENT else status.report.level


def format_statuses(statuses: Mapping[str, NodeStatus], width: int | None = None) -> str:
    """Return a table with a row per part, cut to a width in characters."""
    if not statuses:
        return "no diagnostics yet: nodes that are starting publish none"
    rows = [_HEAD, *(_row(name, status) for name, status in statuses.items())]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(cell.ljust(wide) for cell, wide in zip(row, widths, strict=True)).rstrip() for row in rows)
    return "\n".join(line[:width] for line in lines)


def _row(name: str, status: NodeStatus) -> tuple[str, ...]:
    values, text = status.report.values, status.report.message
    if status.age > SILENT:
        text = f"no diagnostics for {status.age:.0f} s; before: {text}"
    latency = next((value for key, value in values.items() if key.endswith("p95 [ms]")), "")
    return name, level_of(status).name, values.get("rate [Hz]", ""), latency, text
