"""The subcommand `compare`: two evaluations, recording by recording."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from finforce_eval.cli.parser import CommandResult
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.batch import read_evaluations
from finforce_eval.evaluation.comparison import (
    BETTER,
    LOST,
    SAME,
    WORSE,
    Change,
    compare_evaluations,
    differing_settings,
    read_evaluation,
    total_change,
)
from finforce_eval.evaluation.score_tables import evaluation_json
from finforce_eval.machine import without_nan

WORSE_FOUND = 1


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("before", metavar="A", help="output of finforce evaluate --json, or its --out folder")
    parser.add_argument("after", metavar="B", help="the same with other settings, fingers or versions")
    parser.add_argument("--strict", action="store_true", help="exit with 1 if a recording got worse or is missing")


def run(options: argparse.Namespace) -> CommandResult:
    """Compare two evaluations and print the table."""
    before, after = (_read(Path(path)) for path in (options.before, options.after))
    changes = compare_evaluations(before, after)
    for name, (old, new) in differing_settings(before, after).items():
        print(f"{name}: {old} -> {new}")
    print(format_changes(changes))
    found = {"changes": [asdict(change) for change in changes], "mean": asdict(total_change(changes))}
    worse = options.strict and any(change.outcome in (WORSE, LOST) for change in changes)
    return CommandResult(found, status=WORSE_FOUND if worse else 0)


def _read(path: Path) -> Mapping[str, Any]:
    """Return what `evaluate --json` writes, from such a file or from a folder of tables.

    Raises:
        FinforceError: it is neither.
    """
    tables = sorted(path.glob("*.parquet"))
    if not tables and path.is_dir():
        raise OptionError(f"{path}: no scores in it; expected a folder of finforce evaluate --out, or a file of --json")
    if not tables:
        return read_evaluation(path)
    evaluation, about = read_evaluations(tables)
    return without_nan(evaluation_json(evaluation, **about))


def format_changes(changes: Sequence[Change]) -> str:
    """Return the table of the changes and a sentence about them."""
    rows = [
        {
            "": row.name,
            "before/N": row.before,
            "after/N": row.after,
            "difference/N": row.difference,
            "chance/N": row.stddev if np.isfinite(row.stddev) else np.nan,
            "answered/%": "{:.1f} {:.1f}".format(*row.answered),
            "outcome": row.outcome,
        }
        for row in (*changes, total_change(changes))
    ]
    lines = [pd.DataFrame(rows).set_index("").to_string(float_format="{:.4f}".format, na_rep="-")]
    counts = {outcome: sum(change.outcome == outcome for change in changes) for outcome in (BETTER, WORSE, SAME)}
    rest = len(changes) - sum(counts.values())
    lines.append(
        f"{counts[BETTER]} better, {counts[WORSE]} worse, {counts[SAME]} the same, {rest} unsure or in one file only. "
        "chance: one standard deviation of the difference, by how it varies within the recording; better and worse are "
        "beyond three of them, worse also where 5 % fewer frames are answered."
    )
    if not any(np.isfinite(change.difference) for change in changes):
        lines.append("No recording is in both: recordings are paired by name, that of their file or folder.")
    return "\n".join(lines)
