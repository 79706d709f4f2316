"""A network's first run, in a process of its own that ends: a file from elsewhere costs seconds and a gigabyte at most.

What has passed is known by its content in the user's cache folder, and not tried again; what is shipped is not tried.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from finforce.caches import cache_folder
from finforce.errors import one_line
from finforce.files import BUDGET, raise_budget
from finforce_keypoints.errors import ModelError
from finforce_keypoints.networks.graph_check import check_network

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHIPPED = (Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "finforce_eval" / "data")
SECONDS, MEMORY = 20, 1536 << 20  # of a first run, onnxruntime's own memory included [bytes]
COLOURS, FREE_SIDE, LARGEST_SIDE = 3, 256, 4096  # [px] of an axis that takes any size, and of one that is frozen
_EDITION = 1
_DTYPES = {"tensor(float)": "float32", "tensor(float16)": "float16", "tensor(uint8)": "uint8"}


def try_network(path: Path, runtime_version: str) -> None:
    """Refuse a network that cannot be loaded and run within bounds.

    Args:
        path: of the .onnx file.
        runtime_version: of onnxruntime; what another one took is tried again.

    Raises:
        ModelError: it is out of bounds, or its first run does not end, takes too much memory, or fails.
    """
    check_network(path)
    if any(path.resolve().is_relative_to(folder) for folder in SHIPPED):
        return
    mark = _mark_of(path, runtime_version)
    if mark is not None and mark.exists():
        return
    _run_apart(path)
    if mark is not None:
        _set(mark)


def _mark_of(path: Path, runtime_version: str) -> Path | None:
    """Return the file that tells that this content has passed; None where there is no such folder."""
    digest = sha256(f"{_EDITION} {runtime_version} {os.environ.get(BUDGET, '')}".encode())
    try:
        for part in sorted({path, *_beside(path)}):
            with part.open("rb") as file:
                while piece := file.read(1 << 20):
                    digest.update(piece)
        return cache_folder() / "networks" / f"{digest.hexdigest()[:32]}.ok"
    except OSError:
        return None


def _beside(path: Path) -> Sequence[Path]:
    """Return files that hold a network's data beside it."""
    return [part for part in path.parent.glob(f"{path.stem}*.data") if part.is_file()]


def _set(mark: Path) -> None:
    try:
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()
    except OSError:  # a cache that cannot be written costs the next start a second
        return


def _run_apart(path: Path) -> None:
    """Run a network once in another process."""
    seconds = raise_budget(SECONDS)
    command = [sys.executable, "-m", __name__, str(path)]
    root = str(Path(__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH", ""))))}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=seconds, check=False, env=environment, errors="replace"
        )
    except subprocess.TimeoutExpired as error:
        raise ModelError(f"{path}: its first run took more than {seconds} s; {BUDGET}=10 would allow more") from error
    if done.returncode:
        said = " ".join(done.stderr.split())[-300:]
        why = said or f"the process ended with {done.returncode}"
        raise ModelError(f"{path}: onnxruntime cannot load and run it: {why}; expected an ONNX network")


def main(arguments: Sequence[str]) -> int:
    """Load a network and run it on a grey picture, with bounded memory; say what was wrong."""
    import resource

    import onnxruntime

    limit, hard = raise_budget(MEMORY), resource.getrlimit(resource.RLIMIT_DATA)[1]
    if hard != resource.RLIM_INFINITY:
        limit = min(limit, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.log_severity_level = 1, 4
        session = onnxruntime.InferenceSession(arguments[0], options, providers=["CPUExecutionProvider"])
        given = {item.name: _make_input(item.shape, item.type) for item in session.get_inputs()}
    except (Exception, MemoryError) as error:  # onnxruntime has no base class of its errors
        print(one_line(error, 300) or "out of memory", file=sys.stderr)
        return 1
    try:
        session.run(None, given)
    except (Exception, MemoryError) as error:
        # a network of several inputs may want other sizes of them: what it says then costs nothing
        if isinstance(error, MemoryError) or any(word in str(error).lower() for word in ("alloc", "memory")):
            print(f"more than {limit >> 20} MB of memory", file=sys.stderr)
            return 1
    return 0


def _make_input(shape: Sequence[object], kind: str) -> NDArray:
    """Return a grey picture, or an array of any other input."""
    import numpy as np

    if kind not in _DTYPES:
        raise ValueError(f"an input is {kind}; expected one of {', '.join(_DTYPES)}")
    free = [1, FREE_SIDE, FREE_SIDE, FREE_SIDE]
    if len(shape) == len(free) and shape[-1] != COLOURS:
        free[1] = COLOURS
    sides = [_choose_side(size, free[min(axis, len(free) - 1)]) for axis, size in enumerate(shape)]
    if np.prod(sides, dtype=float) > LARGEST_SIDE**2:
        raise ValueError(f"an input of {sides}; expected a picture")
    return np.full(sides, 0.5, np.dtype(_DTYPES[kind]))


def _choose_side(size: object, free: int) -> int:
    """Return the size of an axis of an input, `free` of one that takes any."""
    if not isinstance(size, int) or size <= 0:
        return free
    if size > LARGEST_SIDE:
        raise ValueError(f"an input with an axis of {size}; expected {LARGEST_SIDE} at most")
    return size


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
