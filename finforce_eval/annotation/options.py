"""What the options of `annotate` say of the forces."""

from __future__ import annotations

import argparse
from typing import Any

from finforce_eval.evaluation.setup import version
from finforce_eval.recordings.tracks import JAWS

# Options that change nothing in the forces of a recording.
_OUTSIDE = ("bags", "out", "engine", "workers", "memory", "address", "shard", "run", "prefix")


def describe_options(options: argparse.Namespace) -> dict[str, Any]:
    """Return all options that forces depend on, and the version."""
    return {name: value for name, value in vars(options).items() if name not in _OUTSIDE} | {"version": version()}


def sides_of(options: argparse.Namespace) -> tuple[str, ...]:
    """Return the jaws that images show, none where the option does not say."""
    return {None: (), "both": JAWS}.get(options.jaws, (options.jaws,))
