"""A folder of pictures with a Markdown page that shows them, and a page whose plots zoom."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce_eval.evaluation.scoring import Evaluation, rms
from finforce_eval.evaluation.tables import markdown_tables, score_table
from finforce_eval.recordings.tracks import DIRECTIONS, Recording
from finforce_eval.table import ForceSeries

TITLE = "Force from key points"


def write_report(
    evaluation: Evaluation,
    folder: str | Path,
    *,
    keypoint_names: Sequence[str],
    about: Mapping[str, str],
    recordings: Sequence[Recording] = (),
    title: str = TITLE,
) -> Path:
    """Write pictures, README.md and report.html of an evaluation.

    Args:
        evaluation: scores and time series.
        folder: where to; made when missing, files of the same name are replaced.
        keypoint_names: K names of the key points of the jaw.
        about: what was run: solver, jaw, contact, ...
        recordings: of the evaluation; where key points were found in images, some of these are shown.
        title: heading of the page.

    Returns:
        The page.

    Raises:
        MissingDependencyError: matplotlib is not installed.
        RecordingError: an image is damaged.
    """
    results = list(evaluation.results.values())
    draw_results(results, Path(folder), keypoint_names=keypoint_names, recordings=recordings)
    return write_overview(evaluation, folder, about=about, title=title)


def draw_results(
    results: Sequence[ForceSeries],
    folder: Path,
    *,
    keypoint_names: Sequence[str],
    recordings: Sequence[Recording] = (),
) -> None:
    """Draw recordings and the series of their jaws, in the folder of a report; see `write_report`."""
    folder.mkdir(parents=True, exist_ok=True)
    for recording in recordings:
        own = [result for result in results if _recording_of(result) == recording.name]
        _draw_images(recording, own, folder, keypoint_names)
    for result in results:
        _draw_case(result, folder, keypoint_names)


def write_overview(evaluation: Evaluation, folder: str | Path, *, about: Mapping[str, str], title: str = TITLE) -> Path:
    """Write the pages of a report, and the pictures of all cases together; those of each are there already.

    Args:
        evaluation: scores and time series.
        folder: where `draw_results` has drawn.
        about: what was run: solver, jaw, contact, ...
        title: heading of the page.

    Returns:
        README.md, which shows the pictures.
    """
    from finforce_eval.figures.figures import draw_unity

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    results = list(evaluation.results.values())
    draw_unity(results).savefig(folder / "unity.png")
    page = folder / "README.md"
    zooming = ["The same over time, to zoom: [report.html](report.html)", ""]
    head = [f"# {title}", "", *(f"- {key}: {value}" for key, value in about.items()), "", *zooming]
    lines = [*head, *_overview(evaluation)]
    for name in dict.fromkeys(map(_recording_of, results)):
        lines += _show_pictures(folder, f"Images of {name}", _stem(name), IMAGES)
    for name in evaluation.results:
        lines += _show_pictures(folder, name, _stem(name), PICTURES)
    # names of recordings may hold HTML; none of it is ours
    page.write_text("\n".join(lines).replace("<", "&lt;") + "\n", encoding="utf-8")
    names = [f"{_stem(each.name)}_jaw.png" for each in results]
    names += [f"{_stem(_recording_of(each))}_images.png" for each in results]
    pictures = [folder / name for name in (*reversed(names), "unity.png") if (folder / name).exists()]
    write_page(evaluation, folder / "report.html", about=about, title=title, picture=pictures[0])
    return page


# Pictures of a recording and of a case by the ends of their names, with what they show.
IMAGES = {"images": "Key points in the images"}
PICTURES = {
    "force": "Force over time",
    "jaw": "The jaw at the largest force",
    "contact": "Contact over time",
    "keypoints": "Key points used",
}


def _show_pictures(folder: Path, name: str, stem: str, pictures: Mapping[str, str]) -> list[str]:
    """Return a section of the page with those pictures that are there; no line without any."""
    shown = {text: f"{stem}_{end}.png" for end, text in pictures.items() if (folder / f"{stem}_{end}.png").exists()}
    return ["", f"## {name}", "", *(f"![{text}]({file})" for text, file in shown.items())] if shown else []


def _recording_of(result: ForceSeries) -> str:
    """Return the name of the recording of a series."""
    return result.name.removesuffix(f"/{result.side}")


def write_page(
    evaluation: Evaluation, path: Path, *, about: Mapping[str, str], title: str, picture: Path | None = None
) -> Path:
    """Write one HTML page with the scores and plots that zoom; it needs no other file.

    Args:
        evaluation: scores and time series.
        path: of the page.
        about: what was run: solver, jaw, contact, ...
        title: heading of the page.
        picture: PNG file that is shown on top.

    Raises:
        OSError: it cannot be written.
    """
    table, results = score_table(evaluation), list(evaluation.results.values())
    return write_html(results, path, title=title, about=about, columns=table.names, rows=table.rows, picture=picture)


def _overview(evaluation: Evaluation) -> list[str]:
    """Return the table and the pictures of all cases together."""
    return [
        *markdown_tables(evaluation),
        "",
        "Errors are norm of the estimate minus norm of the measured force, over the record phases.",
        "",
        "![Estimated against measured force](unity.png)",
    ]


def _stem(name: str) -> str:
    """Return the name of a case or a recording as the beginning of file names."""
    return re.sub(r"[^\w.-]+", "_", name)


def _draw_images(
    recording: Recording, results: Sequence[ForceSeries], folder: Path, keypoint_names: Sequence[str]
) -> None:
    """Draw what the detector made of a recording's images, where it did."""
    stem = _forget_pictures(folder, recording.name, IMAGES)
    if recording.images is None or all(track.detection is None for track in recording.jaws.values()):
        return
    from finforce_eval.figures.images import draw_images
    from finforce_keypoints.diagnostics import build_skeleton

    draw_images(recording, results, build_skeleton(keypoint_names)).savefig(folder / f"{stem}_images.png")


def _draw_case(result: ForceSeries, folder: Path, keypoint_names: Sequence[str]) -> None:
    """Draw one case."""
    from finforce_eval.figures.figures import draw_contact, draw_force, draw_jaw, draw_keypoints

    stem = _forget_pictures(folder, result.name, PICTURES)
    draw_force(result).savefig(folder / f"{stem}_force.png")
    draw_keypoints(result, keypoint_names).savefig(folder / f"{stem}_keypoints.png")
    if result.snapshot is not None:
        seconds = (result.snapshot.stamp - int(result.stamps[0])) * 1e-9
        title = f"{result.name}, largest force, t = {seconds:.1f} s"
        draw_jaw(result.snapshot, title).savefig(folder / f"{stem}_jaw.png")
    if result.has("contact_height"):
        draw_contact(result).savefig(folder / f"{stem}_contact.png")


def _forget_pictures(folder: Path, name: str, pictures: Mapping[str, str]) -> str:
    """Remove the pictures of an earlier report, and return the beginning of their names."""
    stem = _stem(name)
    for end in pictures:
        (folder / f"{stem}_{end}.png").unlink(missing_ok=True)
    return stem


TEMPLATE = Path(__file__).parents[1] / "data" / "page" / "report.html"
_PLACE = "@DATA@"
_MOST_WORDS = 255
WAITING = "waiting"  # status of an image that the tare still needs


def write_html(
    series: Sequence[ForceSeries],
    path: Path,
    *,
    title: str,
    about: Mapping[str, str],
    columns: Sequence[str] = (),
    rows: Sequence[Sequence[str]] = (),
    picture: Path | None = None,
) -> Path:
    """Write the page.

    Args:
        series: one plot each.
        path: of the page.
        title: its heading.
        about: what was run, name by name.
        columns: of a table above the plots; the first holds names.
        rows: of the table: one for each series, in their order, and any after them; without one, images and answers.
        picture: PNG file that is shown on top.

    Returns:
        The page.

    Raises:
        OSError: it cannot be written.
    """
    if not rows:
        columns, rows = _count_answers(series)
    content = {
        "title": title,
        "headline": describe_series(series),
        "picture": picture and "data:image/png;base64," + b64encode(picture.read_bytes()).decode(),
        "about": dict(about),
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
    """Return in one sentence how far forces are off, or how large they are, and how many images have one."""
    waited = sum(int((each.column("status") == WAITING).sum()) for each in series)
    solved = np.concatenate([np.zeros(0), *(each.magnitude[each.solved] for each in series)])
    errors = np.concatenate([np.zeros(0), *(each.error[each.counted] for each in series if each.has("true_force"))])
    count = sum(map(len, series))
    head = f"{solved.max(initial=0.0):.2f} N at most"
    if errors.size:
        head = f"{rms(errors):.3f} N RMSE of the force over {errors.size} images, {head}"
    return f"{head}; {count - waited - solved.size} of {count - waited} images after the tare without an answer"


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
