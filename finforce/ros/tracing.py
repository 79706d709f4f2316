"""Times of the callbacks of a process, image by image, written to a file on request."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from time import monotonic_ns
from typing import Any

from finforce.messages import stamp_of

FOLDER = "FINFORCE_TRACE"  # environment variable: where every process of ours writes what it has noted
MOST = 200_000  # spans; half an hour of 90 Hz, after which nothing more is noted

_spans: list[tuple[str, str, int, int, int]] = []


def note(node: str, topic: str, callback: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return a callback for messages that notes when it was at work, if somebody asks for that."""
    if not os.environ.get(FOLDER):
        return callback

    def call(message: Any) -> None:
        began = monotonic_ns()
        try:
            callback(message)
        finally:
            if len(_spans) < MOST:
                _spans.append((node, topic, _stamp(message), began, monotonic_ns()))

    return call


def write_trace() -> None:
    """Write what was noted, if somebody asks for it: node, topic, stamp, begin and end [ns, monotonic] of each."""
    folder = os.environ.get(FOLDER)
    if folder and _spans:
        (Path(folder) / f"{os.getpid()}.json").write_text(json.dumps(_spans), encoding="utf-8")


def _stamp(message: Any) -> int:
    """Return the stamp [ns] of a message, 0 of one without."""
    return stamp_of(message) if hasattr(message, "header") else 0
