"""Figures as JSON, with the machine, the versions and the commit that they are of."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

import numpy as np


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, versions of what is installed, and commit."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    versions = {}
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):
            versions[name] = installed(name)
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        **versions,
        "commit": commit(),
    }


def version() -> str:
    """Return the version of the installed package."""
    try:
        return installed("finforce")
    except PackageNotFoundError:
        return "not installed"


def write_figures(path: Path | str, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON with the machine, versions and commit that they are of; what is not finite becomes null."""
    text = json.dumps({"machine": describe_machine(), **without_nan(figures)}, indent=2, allow_nan=False)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text + "\n", encoding="utf-8")


@cache
def commit() -> str:
    """Return the commit of the sources, and a hash of what was changed since; "unknown" of what is installed."""
    return describe_sources(Path(__file__))


def describe_sources(file: Path) -> str:
    """Return the commit that a file is of with `-dirty-` and a hash of all changes since, if there are any."""
    commands = (
        ["git", "ls-files", "--error-unmatch", file.name],  # a package in somebody's repository is not of it
        ["git", "describe", "--always", "--dirty", "--abbrev=12"],
        ["git", "diff", "HEAD", "--binary"],
    )
    try:
        _, described, changes = (
            subprocess.run(command, cwd=file.parent, capture_output=True, check=True).stdout for command in commands
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    mark = f"-{hashlib.sha256(changes).hexdigest()[:8]}" if changes else ""
    return described.decode().strip() + mark


def without_nan(content: Any) -> Any:
    """Return nested mappings, sequences and arrays as plain values, with None for numbers that are not finite."""
    if isinstance(content, np.ndarray | np.generic):
        content = content.tolist()
    if isinstance(content, Mapping):
        return {name: without_nan(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [without_nan(value) for value in content]
    return None if isinstance(content, float) and not np.isfinite(content) else content


LIBRARIES = ("numpy", "scipy", "numba", "open3d", "manifold3d", "trimesh")
