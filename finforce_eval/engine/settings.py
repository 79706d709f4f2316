"""What the options of `annotate` say of the forces."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

from finforce_eval.machine import commit, version
from finforce_eval.recordings.tracks import JAWS

# Options that change nothing in the forces of a recording.
_OUTSIDE = ("bags", "out", "engine", "workers", "memory", "address", "shard", "run", "prefix", "json", "report")


def describe_options(options: argparse.Namespace) -> dict[str, Any]:
    """Return all options that forces depend on, hashes of the files that they name, version and commit."""
    chosen = {name: value for name, value in vars(options).items() if name not in _OUTSIDE}
    words = [str(word) for value in chosen.values() for word in (value if isinstance(value, list) else [value])]
    return chosen | {"files": hash_files(words), "version": version(), "commit": commit()}


def hash_files(words: Iterable[str]) -> dict[str, str]:
    """Return hashes of the files that are among some options' words."""
    return {word: sha256(Path(word).read_bytes()).hexdigest() for word in words if _is_file(word)}


def _is_file(word: str) -> bool:
    """Say whether an option's word names a file."""
    try:
        return bool(word) and Path(word).is_file()
    except (OSError, ValueError):
        return False


def sides_of(options: argparse.Namespace) -> tuple[str, ...]:
    """Return the jaws that images show, none where the option does not say."""
    return {None: (), "both": JAWS}.get(options.jaws, (options.jaws,))
