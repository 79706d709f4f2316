"""A set of cases that are run one after the other, kept one by one, and put on a page together."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import pandas as pd

from finforce.errors import FinforceError
from finforce_eval.engine.engines import EngineOptions, run_tasks
from finforce_eval.engine.tasks import OK, Manifest, Task, choose_shard
from finforce_eval.machine import commit, version, write_figures
from lab.harness import format_table

PAGE = "README.md"
EDITION = 1  # of what is kept of a case; another one does not go on where an older one ended


@dataclass(frozen=True, kw_only=True)
class Case:
    """One run of an experiment.

    Attributes:
        name: unlike the others', and a part of file names.
        settings: that decide its figures, as JSON has them; what stands under `words` becomes part of them.
    """

    name: str
    settings: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class ResultTable:
    """Figures in rows, whose columns name their units.

    Attributes:
        title: what it shows.
        rows: the figures; columns of text come first when they are shown.
        note: what there is to say of them.
    """

    title: str
    rows: pd.DataFrame
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What an experiment found.

    Attributes:
        tables: for the terminal, the page and the JSON.
        pictures: file names in the experiment's folder, by what they show.
    """

    tables: Sequence[ResultTable]
    pictures: Mapping[str, str] = field(default_factory=dict)


class Experiment(Protocol):
    """An experiment; its cases are run in their order.

    Attributes:
        name: of the command line.
        title: of the page.
        about: what is done, and how it differs from the paper's own.
    """

    name: str
    title: str
    about: str

    def list_cases(self) -> Sequence[Case]:
        """Return what is to be run.

        Raises:
            FinforceError: recordings lack what the experiment needs.
        """
        ...

    def run(self, case: Case, folder: Path) -> dict[str, Any]:
        """Return the figures of a case as JSON has them, those that are only drawn under `drawn`.

        Files go into a folder of the experiment's own.
        """
        ...

    def find(self, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Findings:
        """Return what the figures of the cases, by name, say together, and draw it into a folder."""
        ...


def hash_case(case: Case) -> str:
    """Return what tells a case from one of the same name with other settings, or of another version."""
    content = json.dumps([EDITION, version(), commit(), dict(case.settings)], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def run_case(experiment: Experiment, case: Case, folder: str) -> dict[str, Any]:
    """Return the figures of a case; files go into the experiment's folder.

    Raises:
        FinforceError: it has none.
    """
    return {**case.settings.get("words", {}), **experiment.run(case, Path(folder))}


def run_experiment(
    experiment: Experiment, report: Path, engine: EngineOptions | None = None, shard: str = ""
) -> Findings | None:
    """Run what is not done yet of an experiment, and write `NAME.json`, pictures and a page into `report/NAME`.

    A case that fails is told of, costs itself only, and is tried again by the next run.

    Args:
        experiment: what is run.
        report: folder of all experiments.
        engine: where the cases are run; here, one after the other, without.
        shard: "i/n" to run a part of the cases only, without a page.

    Returns:
        What the cases say together; None of a part of them.

    Raises:
        FinforceError: the cases cannot be listed, or none of them gave figures.
    """
    folder = report / experiment.name
    cases = experiment.list_cases()
    manifest = Manifest(folder, shard)
    given = [{"experiment": experiment, "case": case, "folder": str(folder)} for case in cases]
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
    findings = experiment.find(figures, folder)
    about = {"experiment": experiment.name, "version": version(), "cases": len(cases), "failed": failed}
    about["tables"] = {table.title: table.rows.to_dict("records") for table in findings.tables}
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


def format_tables(findings: Findings) -> str:
    """Return the tables for a terminal, each with its title above and its note below."""
    blocks = []
    for table in findings.tables:
        note = ("", table.note) if table.note else ()
        blocks.append("\n".join((f"**{table.title}**", "", format_table(table.rows), *note)))
    return "\n\n".join(blocks)


def _write_page(experiment: Experiment, findings: Findings, cases: int, failed: Mapping[str, str]) -> str:
    """Return the page of an experiment."""
    done = f"{cases - len(failed)} of {cases} cases, finforce {version()}."
    lines = [f"# {experiment.title}", "", experiment.about, "", done]
    lines += [f"- **failed:** {name}: {text}" for name, text in failed.items()]
    lines += ["", format_tables(findings), ""]
    lines += [f"![{caption}]({name})" for caption, name in findings.pictures.items()]
    return "\n".join(lines) + "\n"
