"""Resident memory of processes, from /proc; Linux only."""

from __future__ import annotations

import os
from pathlib import Path


def resident_bytes(process: str | int = "self") -> int:
    """Return the resident memory of a process [bytes]; 0 when it has gone."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    except (FileNotFoundError, ProcessLookupError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def child_processes(parent: int) -> list[int]:
    """Return the processes that a process has started itself."""
    found: set[int] = set()
    for path in Path(f"/proc/{parent}/task").glob("*/children"):
        found.update(int(word) for word in path.read_text(encoding="ascii").split())
    return sorted(found)
