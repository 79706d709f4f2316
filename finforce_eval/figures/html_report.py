"""Forces over time on one HTML page that needs nothing beside itself: its plots zoom, and it loads nothing."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce_eval.evaluation.results import CaseResult
from finforce_eval.recordings.tracks import DIRECTIONS

TEMPLATE = Path(__file__).parents[1] / "data" / "page" / "report.html"
_PLACE = "@DATA@"
_MOST_WORDS = 255


@dataclass(frozen=True, kw_only=True, eq=False)
class ForceCourse:
    """The force on one jaw over time.

    Attributes:
        name: of the recording, and of the jaw where there are two.
        stamps: of the images (n,) [ns].
        force: (n, 3) [N], NaN where there was no answer.
        stddev: of its magnitude (n,) [N].
        truth: (n, 3) measured [N]; None where nothing was.
        status: (n,) a word for each image.
        phase: (n,) 0, in a record phase of loading (or without direction) 1, of unloading 2.
    """

    name: str
    stamps: NDArray[np.int64]
    force: NDArray[np.float64]
    stddev: NDArray[np.float64]
    status: NDArray[np.str_]
    phase: NDArray[np.uint8]
    truth: NDArray[np.float64] | None = None

    @classmethod
    def of_result(cls, result: CaseResult) -> ForceCourse:
        """Return what an evaluation found."""
        phase = np.where(result.direction == DIRECTIONS[1], 2, np.where(result.direction == DIRECTIONS[0], 1, 0))
        return cls(
            name=result.name,
            stamps=result.stamps,
            force=result.force,
            stddev=result.stddev,
            truth=result.truth,
            status=result.status,
            phase=np.where(result.scored, phase, 0).astype(np.uint8),
        )


def write_html(
    courses: Sequence[ForceCourse],
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


def _count_answers(courses: Sequence[ForceCourse]) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows that tell of images, answers and the largest force."""
    rows = []
    for course in courses:
        magnitude = np.linalg.norm(course.force, axis=1)
        known = magnitude[np.isfinite(magnitude)]
        answered = f"{100.0 * len(known) / max(len(magnitude), 1):.1f}"
        largest = f"{known.max():.2f}" if len(known) else "-"
        rows.append([course.name, str(len(magnitude)), answered, largest])
    return ["recording", "images", "answered/%", "largest force/N"], rows


def _describe(course: ForceCourse) -> dict[str, Any]:
    """Return what the page's script reads of a course."""
    words, status = np.unique(course.status, return_inverse=True)
    magnitude = np.linalg.norm(course.force, axis=1)
    columns = {
        "time": 1e-9 * (course.stamps - course.stamps[0]) if len(course.stamps) else np.zeros(0),
        "found": magnitude,
        "stddev": np.where(np.isfinite(magnitude), course.stddev, np.nan),
        **dict(zip("xyz", course.force.T, strict=True)),
    }
    if course.truth is not None:
        columns["truth"] = np.linalg.norm(course.truth, axis=1)
    return {
        "name": course.name,
        "images": len(course.stamps),
        "lost": int((~np.isfinite(magnitude)).sum()),
        "words": words[:_MOST_WORDS].tolist(),
        "status": _encode(np.minimum(status, _MOST_WORDS - 1), np.uint8),
        "phase": _encode(course.phase, np.uint8),
        **{name: _encode(values, np.float32) for name, values in columns.items()},
    }


def _encode(values: ArrayLike, kind: type) -> str:
    """Return numbers as the page has them: little-endian bytes in base 64."""
    return b64encode(np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<")).tobytes()).decode()
