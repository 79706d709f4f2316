"""A folder of pictures with a Markdown page that shows them, and a page whose plots zoom."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from finforce_eval.evaluation.evaluate import Evaluation
from finforce_eval.evaluation.results import CaseResult
from finforce_eval.evaluation.tables import (
    markdown_contact_table,
    markdown_sight,
    markdown_table,
    summary_lines,
    table_head,
    table_rows,
)
from finforce_eval.figures.html_report import ForceCourse, write_html
from finforce_eval.recordings.tracks import Recording


def write_report(
    evaluation: Evaluation,
    folder: str | Path,
    *,
    keypoint_names: Sequence[str],
    about: Mapping[str, str],
    recordings: Sequence[Recording] = (),
    title: str = "Force from key points",
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
    from finforce_eval.figures.figures import draw_unity, draw_violins

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    results = list(evaluation.results.values())
    draw_unity(results).savefig(folder / "unity.png")
    draw_violins(results).savefig(folder / "violins.png")
    sections = [_write_images(recording, results, folder, keypoint_names) for recording in recordings]
    sections += [_write_case(result, folder, keypoint_names) for result in results]
    page = folder / "README.md"
    zooming = ["The same over time, to zoom: [report.html](report.html)", ""]
    head = [f"# {title}", "", *(f"- {key}: {value}" for key, value in about.items()), "", *zooming]
    lines = [*head, *_overview(evaluation), *(line for section in sections for line in section)]
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")
    write_page(evaluation, folder / "report.html", about=about, title=title)
    return page


def write_page(evaluation: Evaluation, path: Path, *, about: Mapping[str, str], title: str) -> Path:
    """Write one HTML page with the scores and plots that zoom; it needs nothing beside itself.

    Args:
        evaluation: scores and time series.
        path: of the page.
        about: what was run: solver, jaw, contact, ...
        title: heading of the page.

    Raises:
        OSError: it cannot be written.
    """
    courses = [ForceCourse.of_result(result) for result in evaluation.results.values()]
    return write_html(courses, path, title=title, about=about, columns=table_head(), rows=table_rows(evaluation))


def _overview(evaluation: Evaluation) -> list[str]:
    """Return the table and the pictures of all cases together."""
    return [
        markdown_table(evaluation),
        "",
        *summary_lines(evaluation),
        *markdown_contact_table(evaluation),
        *markdown_sight(evaluation),
        "",
        "Errors are norm of the estimate minus norm of the measured force, over the record phases.",
        "",
        "![Estimated against measured force](unity.png)",
        "![Distribution of the error per case](violins.png)",
    ]


def _stem(name: str) -> str:
    """Return the name of a case or a recording as the beginning of file names."""
    return re.sub(r"[^\w.-]+", "_", name)


def _write_images(
    recording: Recording, results: Sequence[CaseResult], folder: Path, keypoint_names: Sequence[str]
) -> list[str]:
    """Write the pictures of what the detector made of a recording's images and return their section of the page."""
    if recording.images is None or all(track.detection is None for track in recording.jaws.values()):
        return []
    from finforce_eval.figures.images import draw_detection, draw_images
    from finforce_keypoints.diagnostics import build_skeleton

    name, stem = recording.name, _stem(recording.name)
    own = [result for result in results if result.name in (name, f"{name}/{result.side}")]
    draw_images(recording, own, build_skeleton(keypoint_names)).savefig(folder / f"{stem}_images.png")
    draw_detection(recording).savefig(folder / f"{stem}_detection.png")
    return [
        "",
        f"## Images of {name}",
        "",
        f"![Key points in the images]({stem}_images.png)",
        f"![Key points found, over time]({stem}_detection.png)",
    ]


def _write_case(result: CaseResult, folder: Path, keypoint_names: Sequence[str]) -> list[str]:
    """Write the pictures of one case and return its section of the page."""
    from finforce_eval.figures.contact import draw_contact
    from finforce_eval.figures.figures import draw_force, draw_keypoints
    from finforce_eval.figures.jaw import draw_jaw

    stem = _stem(result.name)
    draw_force(result).savefig(folder / f"{stem}_force.png")
    draw_keypoints(result, keypoint_names).savefig(folder / f"{stem}_keypoints.png")
    lines = ["", f"## {result.name}", "", f"![Force over time]({stem}_force.png)"]
    if result.snapshot is not None:
        seconds = (result.snapshot.stamp - int(result.stamps[0])) * 1e-9
        title = f"{result.name}, largest force, t = {seconds:.1f} s"
        draw_jaw(result.snapshot, title).savefig(folder / f"{stem}_jaw.png")
        lines.append(f"![The jaw at the largest force]({stem}_jaw.png)")
    if result.contact is not None:
        draw_contact(result).savefig(folder / f"{stem}_contact.png")
        lines.append(f"![Place of the contact over time]({stem}_contact.png)")
    return [*lines, f"![Key points used]({stem}_keypoints.png)"]
