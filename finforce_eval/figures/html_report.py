"""Forces over time on one HTML page that needs nothing beside itself: its plots zoom, and it loads nothing."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce_eval.recordings.tracks import DIRECTIONS
from finforce_eval.table import ForceSeries

TEMPLATE = Path(__file__).parents[1] / "data" / "page" / "report.html"
_PLACE = "@DATA@"
_MOST_WORDS = 255


def write_html(
    courses: Sequence[ForceSeries],
    path: Path,
    *,
    title: str,
    about: Mapping[str, str],
    columns: Sequence[str] = (),
    rows: Sequence[Sequence[str]] = (),
) -> Path:
    """Write the page.

    Args:
        courses: one plot each.
        path: of the page.
        title: its heading.
        about: what was run, name by name.
        columns: of a table above the plots; the first holds names.
        rows: of the table: one for each course, in their order, and any after them; without one, images and answers.

    Returns:
        The page.

    Raises:
        OSError: it cannot be written.
    """
    if not rows:
        columns, rows = _count_answers(courses)
    content = {
        "title": title,
        "about": dict(about),
        "columns": list(columns),
        "rows": [list(row) for row in rows],
        "items": [_describe(course) for course in courses],
    }
    # no text in it can end the script that holds it
    data = json.dumps(content).replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(TEMPLATE.read_text(encoding="utf-8").replace(_PLACE, data), encoding="utf-8")
    return path


def _count_answers(courses: Sequence[ForceSeries]) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows that tell of images, answers and the largest force."""
    rows = []
    for course in courses:
        known = course.magnitude[course.solved]
        answered = f"{100.0 * len(known) / max(len(course), 1):.1f}"
        largest = f"{known.max():.2f}" if len(known) else "-"
        rows.append([course.name, str(len(course)), answered, largest])
    return ["recording", "images", "answered/%", "largest force/N"], rows


def _describe(course: ForceSeries) -> dict[str, Any]:
    """Return what the page's script reads of a series."""
    words, status = np.unique(course.column("status"), return_inverse=True)
    columns = {
        "time": course.seconds if len(course) else np.zeros(0),
        "found": course.magnitude,
        "stddev": np.where(course.solved, course.column("magnitude_stddev"), np.nan),
        **dict(zip("xyz", course.force.T, strict=True)),
    }
    if course.has("true_force"):
        columns["truth"] = course.true_magnitude
    return {
        "name": course.name,
        "images": len(course),
        "lost": int((~course.solved).sum()),
        "words": words[:_MOST_WORDS].tolist(),
        "status": _encode(np.minimum(status, _MOST_WORDS - 1), np.uint8),
        "phase": _encode(_phase(course), np.uint8),
        **{name: _encode(values, np.float32) for name, values in columns.items()},
    }


def _phase(course: ForceSeries) -> NDArray[np.uint8]:
    """Return 0, in a record phase of loading (or without direction) 1, of unloading 2, of each image (n,)."""
    if not course.has("direction"):
        return np.zeros(len(course), np.uint8)
    load, unload = (course.column("direction") == direction for direction in DIRECTIONS)
    return np.where(course.scored, np.where(unload, 2, np.where(load, 1, 0)), 0).astype(np.uint8)


def _encode(values: ArrayLike, kind: type) -> str:
    """Return numbers as the page has them: little-endian bytes in base 64."""
    return b64encode(np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<")).tobytes()).decode()
