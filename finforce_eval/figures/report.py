"""A report of an evaluation: one page with its scores, a picture, and plots that zoom."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce_eval.evaluation.score_tables import mean_rmse, score_table
from finforce_eval.evaluation.scoring import Evaluation, rms
from finforce_eval.recordings.tracks import DIRECTIONS
from finforce_eval.table import WAITING, ForceSeries

TITLE, PAGE = "Force from key points", "report.html"


class PageHead(NamedTuple):
    """What stands above the plots of a page: its title, settings of the run by name, first sentence, PNG files."""

    title: str
    about: Mapping[str, str]
    headline: str = ""
    pictures: Sequence[Path] = ()


def write_overview(
    evaluation: Evaluation, folder: str | Path, *, about: Mapping[str, str], headline: str = "", picture: str = ""
) -> Path:
    """Write the page of a report with a picture of all errors, and return it; see `write_page`.

    Args:
        evaluation: scores and time series.
        folder: folder of the report, made if missing.
        about: settings of the run, by name.
        headline: first sentence; by default, the mean RMSE of the cases.
        picture: PNG file in the folder that stands on top; empty for none.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    from finforce_eval.figures.figures import draw_errors

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    draw_errors(list(evaluation.results.values())).savefig(folder / "errors.png")
    pictures = [folder / name for name in (picture, "errors.png") if name]
    return write_page(evaluation, folder / PAGE, PageHead(TITLE, about, headline, pictures))


def write_page(evaluation: Evaluation, path: Path, head: PageHead) -> Path:
    """Write the scores of an evaluation, and its series, as one page; see `write_html`."""
    table, results = score_table(evaluation), list(evaluation.results.values())
    columns = ["case", *(" ".join(filter(None, names)) for names in table.columns)]
    rows = [[name, *row] for name, row in zip(table.index, table.to_numpy().tolist(), strict=True)]
    headline = head.headline or f"{mean_rmse(evaluation)} {describe_answers(results)}"
    return write_html(results, path, head._replace(headline=headline), columns, rows)


TEMPLATE = Path(__file__).parents[1] / "data" / "page" / "report.html"
_PLACE = "@DATA@"
_MOST_WORDS = 255


def write_html(
    series: Sequence[ForceSeries],
    path: Path,
    head: PageHead,
    columns: Sequence[str] = (),
    rows: Sequence[Sequence[str]] = (),
) -> Path:
    """Write the page and return its path.

    Args:
        series: one plot each.
        path: of the page.
        head: above the plots; without a headline, errors, forces and answers of the series.
        columns: of a table above the plots; the first holds names.
        rows: of the table: one for each series, in their order, and any after them; without one, images and answers.

    Raises:
        OSError: it cannot be written.
    """
    if not rows:
        columns, rows = _count_answers(series)
    content = {
        "title": head.title,
        "headline": head.headline or describe_series(series),
        "pictures": ["data:image/png;base64," + b64encode(picture.read_bytes()).decode() for picture in head.pictures],
        "about": dict(head.about),
        "columns": list(columns),
        "rows": [list(row) for row in rows],
        "items": [_describe(each) for each in series],
    }
    # no text in it can end the script that holds it
    data = json.dumps(content).replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(TEMPLATE.read_text(encoding="utf-8").replace(_PLACE, data), encoding="utf-8")
    return path


def describe_series(series: Sequence[ForceSeries]) -> str:
    """Return in one sentence how far forces are off, where that is known, and what `describe_answers` says."""
    errors = np.concatenate([np.zeros(0), *(each.error[each.counted] for each in series if each.has("true_force"))])
    known = f"{rms(errors):.3f} N RMSE of the force over {errors.size} images, " if errors.size else ""
    return known + describe_answers(series)


def describe_answers(series: Sequence[ForceSeries]) -> str:
    """Return in one sentence how large forces are, and how many images have one."""
    waited = sum(int((each.column("status") == WAITING).sum()) for each in series)
    solved = np.concatenate([np.zeros(0), *(each.magnitude[each.solved] for each in series)])
    after = sum(map(len, series)) - waited
    largest = f"{solved.max(initial=0.0):.2f} N at most"
    return f"{largest}; {after - solved.size} of {after} images after the tare without an answer"


def _count_answers(series: Sequence[ForceSeries]) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows that tell of images, answers and the largest force."""
    rows = []
    for each in series:
        known = each.magnitude[each.solved]
        answered = f"{100.0 * len(known) / max(len(each), 1):.1f}"
        largest = f"{known.max():.2f}" if len(known) else "-"
        rows.append([each.name, str(len(each)), answered, largest])
    return ["recording", "images", "answered/%", "largest force/N"], rows


def _describe(series: ForceSeries) -> dict[str, Any]:
    """Return what the page's script reads of a series."""
    words, status = np.unique(series.column("status"), return_inverse=True)
    columns = {
        "time": series.seconds if len(series) else np.zeros(0),
        "found": series.magnitude,
        "stddev": np.where(series.solved, series.column("magnitude_stddev"), np.nan),
        **dict(zip("xyz", series.force.T, strict=True)),
    }
    if series.has("true_force"):
        columns["truth"] = series.true_magnitude
    return {
        "name": series.name,
        "images": len(series),
        "lost": int((~series.solved).sum()),
        "tare": int((series.column("status") == WAITING).sum()),
        "words": words[:_MOST_WORDS].tolist(),
        "status": _encode(np.minimum(status, _MOST_WORDS - 1), np.uint8),
        "phase": _encode(_phase(series), np.uint8),
        **{name: _encode(values, np.float32) for name, values in columns.items()},
    }


def _phase(series: ForceSeries) -> NDArray[np.uint8]:
    """Return 0, in a record phase of loading (or without direction) 1, of unloading 2, of each image (n,)."""
    if not series.has("direction"):
        return np.zeros(len(series), np.uint8)
    load, unload = (series.column("direction") == direction for direction in DIRECTIONS)
    return np.where(series.scored, np.where(unload, 2, np.where(load, 1, 0)), 0).astype(np.uint8)


def _encode(values: ArrayLike, kind: type) -> str:
    """Return numbers as the page has them: little-endian bytes in base 64."""
    return b64encode(np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<")).tobytes()).decode()
