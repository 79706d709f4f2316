"""A set of cases that are run one after the other, kept one by one, and put on a page together."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from finforce.errors import FinforceError
from finforce_eval.figures.figures import new_figure, style_axes
from finforce_eval.machine import commit, version, write_figures
from finforce_eval.tasks import OK, EngineOptions, Manifest, Task, choose_shard, run_tasks
from lab.experiments.runs import Case, RunOptions
from lab.harness import Figures, format_figures

PAGE = "README.md"
EDITION = 1  # of what is kept of a case; another one does not go on where an older one ended


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """An experiment; its cases are run in their order.

    Attributes:
        name: of the command line.
        title: of the page.
        about: what is done, and how it differs from the paper's own.
        list_cases: returns what is to be run; raises FinforceError where recordings lack what the experiment needs.
        run: returns the figures of a case as JSON has them, those that are only drawn under `drawn`; files go into a
            folder of the experiment's own.
        find: returns what the figures of the cases, by name, say together; pictures of it go into the folder.
    """

    name: str
    title: str
    about: str
    list_cases: Callable[[RunOptions], Sequence[Case]]
    run: Callable[[RunOptions, Case, Path], dict[str, Any]]
    find: Callable[[RunOptions, Mapping[str, Mapping[str, Any]], Path], Figures]


def hash_case(case: Case) -> str:
    """Return what tells a case from one of the same name with other settings, or of another version."""
    content = json.dumps([EDITION, version(), commit(), dict(case.settings)], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def run_case(experiment: Experiment, options: RunOptions, case: Case, folder: str) -> dict[str, Any]:
    """Return the figures of a case; files go into the experiment's folder.

    Raises:
        FinforceError: it has none.
    """
    return {**case.settings.get("words", {}), **experiment.run(options, case, Path(folder))}


def run_experiment(
    experiment: Experiment, options: RunOptions, report: Path, engine: EngineOptions | None = None, shard: str = ""
) -> Figures | None:
    """Run what is not done yet of an experiment, and write `NAME.json`, pictures and a page into `report/NAME`.

    A case that fails is told of, costs itself only, and is tried again by the next run.

    Args:
        experiment: what is run.
        options: how.
        report: folder of all experiments.
        engine: where the cases are run; here, one after the other, without.
        shard: "i/n" to run a part of the cases only, without a page.

    Returns:
        What the cases say together; None of a part of them.

    Raises:
        FinforceError: the cases cannot be listed, or none of them gave figures.
    """
    folder = report / experiment.name
    cases = experiment.list_cases(options)
    manifest = Manifest(folder, shard)
    given = [{"experiment": experiment, "options": options, "case": case, "folder": str(folder)} for case in cases]
    tasks = [
        Task(name=case.name, key=hash_case(case), work=run_case, given=each)
        for case, each in zip(cases, given, strict=True)
    ]
    with manifest.alone():
        lines = run_tasks(choose_shard(tasks, shard), engine or EngineOptions(), manifest, unit="case")
    failed = {line["name"]: line["error"] for line in lines if line["status"] != OK}
    for name, error in failed.items():
        print(f"failed: {name}: {error}", file=sys.stderr)
    if shard:
        return None
    figures = {line["name"]: line["figures"] for line in lines if line["status"] == OK}
    if not figures:
        raise FinforceError(f"{experiment.name}: not one of {len(cases)} cases gave figures; the first: "
                            f"{next(iter(failed.values()), 'there are none')}")  # fmt: skip
    findings = experiment.find(options, figures, folder)
    about = {"experiment": experiment.name, "version": version(), "cases": len(cases), "failed": failed}
    about["tables"] = {title: rows.to_dict("records") for title, rows in findings.tables.items()}
    about["figures"] = {name: _without_drawn(row) for name, row in figures.items()}
    write_figures(folder / f"{experiment.name}.json", about)
    (folder / PAGE).write_text(_write_page(experiment, findings, len(cases), failed), encoding="utf-8")
    return findings


def tabulate(figures: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Return a row for each case, nested figures in columns of their own ("rmse_N load"), without what is drawn."""
    table = pd.json_normalize([_without_drawn(row) for row in figures.values()], sep=" ")
    table.insert(0, "case", list(figures))
    return table


def average(table: pd.DataFrame, by: Sequence[str], columns: Mapping[str, str]) -> pd.DataFrame:
    """Return the number of rows, and mean and standard deviation of some columns, by groups in their order.

    Args:
        table: of `tabulate`.
        by: columns that tell the groups apart.
        columns: headings of the averages by column.
    """
    groups = table.groupby(list(by), sort=False)
    means = groups.size().rename("n").to_frame()
    for column, heading in columns.items():
        values = groups[column]
        means[heading], means[f"±{heading}"] = values.mean(), values.std(ddof=0)
    return means.reset_index()


def _without_drawn(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name != "drawn"}


def _write_page(experiment: Experiment, findings: Figures, cases: int, failed: Mapping[str, str]) -> str:
    """Return the page of an experiment."""
    done = f"{cases - len(failed)} of {cases} cases, finforce {version()}."
    lines = [f"# {experiment.title}", "", experiment.about, "", done]
    lines += [f"- **failed:** {name}: {text}" for name, text in failed.items()]
    lines += ["", format_figures(findings), ""]
    lines += [f"![{caption}]({name})" for caption, name in findings.drawn.items()]
    return "\n".join(lines) + "\n"


def draw_panels(titles: Sequence[str], columns: int, across: str, up: str, draw: Callable[[Any, str], None]) -> Any:
    """Return a figure with a panel for each title, `columns` side by side.

    Args:
        titles: of the panels.
        columns: panels in a row.
        across: label of the lowest panels' axes.
        up: label of the first panels' axes.
        draw: draws into the axes of a title.
    """
    rows = -(-len(titles) // columns)
    figure = new_figure(3.6 * columns, 2.5 * rows + 0.4)
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes in grid.flat[len(titles) :]:
        axes.set_visible(False)
    for axes, title in zip(grid.flat, titles, strict=False):
        style_axes(axes)
        axes.set_title(title, loc="left", fontsize=9)
        draw(axes, title)
    for axes in grid[:, 0]:
        axes.set_ylabel(up)
    for axes in grid[-1]:
        axes.set_xlabel(across)
    return figure
