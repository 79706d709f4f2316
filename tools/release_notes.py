#!/usr/bin/env python3
"""Prints what CHANGELOG.md says of a version: `tools/release_notes.py 0.1.0`."""

import re
import sys
from pathlib import Path

CHANGELOG = Path(__file__).parents[1] / "CHANGELOG.md"


def notes_of(version: str, text: str) -> str:
    """Return the section of a version.

    Raises:
        SystemExit: there is none, or it has no date yet.
    """
    found = re.search(rf"^## \[{re.escape(version)}\] - (\S+)\n(.*?)(?=^## |\Z)", text, re.M | re.S)
    if found is None:
        raise SystemExit(f"CHANGELOG.md has no section [{version}]")
    date, notes = found.groups()
    if not re.fullmatch(r"\d{4}-\d{2}-\d{2}", date):
        raise SystemExit(f"CHANGELOG.md: [{version}] is dated {date}, expected YYYY-MM-DD")
    return notes.strip()


if __name__ == "__main__":
    print(notes_of(sys.argv[1], CHANGELOG.read_text(encoding="utf-8")))
