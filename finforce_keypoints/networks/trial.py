"""A network's first run, in a sandbox: a file from elsewhere costs seconds and a gigabyte at most.

What has passed is known by its content in the user's cache folder, and not tried again; what is shipped is not tried.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from finforce.caches import cache_folder
from finforce.files import BUDGET, raise_budget
from finforce.optional import import_onnxruntime
from finforce.sandbox import SandboxError, run_limited
from finforce_keypoints.errors import ModelError

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHIPPED = (Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "finforce_eval" / "data")
LARGEST = 512 << 20  # bytes of a file
SECONDS, MEMORY = 20, 1536 << 20  # of a first run, onnxruntime's own memory included [bytes]
COLOURS, FREE_SIDE, LARGEST_SIDE = 3, 256, 4096  # [px] of an axis that takes any size, and of one that is frozen
_EDITION = 2
_DTYPES = {"tensor(float)": "float32", "tensor(float16)": "float16", "tensor(uint8)": "uint8"}


def try_network(path: Path, runtime_version: str) -> None:
    """Refuse a network that cannot be loaded and run within bounds.

    Args:
        path: of the .onnx file.
        runtime_version: of onnxruntime; what another one took is tried again.

    Raises:
        ModelError: It is no file of a network's size, or its first run crashes, does not end, takes too much memory, or
            fails.
    """
    if any(path.resolve().is_relative_to(folder) for folder in SHIPPED):
        return
    size, largest = path.stat().st_size if path.is_file() else 0, raise_budget(LARGEST)
    if not 0 < size <= largest:
        raise ModelError(f"{path}: {size} bytes; expected 1 to {largest} of an ONNX network")
    mark = _mark_of(path, runtime_version)
    if mark is not None and mark.exists():
        return
    try:
        run_limited(run_once, path, memory=MEMORY, seconds=SECONDS)
    except SandboxError as error:
        raise ModelError(f"{path}: {error}; expected an ONNX network") from error
    if mark is not None:
        _set(mark)


def _mark_of(path: Path, runtime_version: str) -> Path | None:
    """Return the file that tells that this content has passed; None where there is no such folder."""
    digest = sha256(f"{_EDITION} {runtime_version} {os.environ.get(BUDGET, '')}".encode())
    try:
        for part in sorted({path, *(data for data in path.parent.glob(f"{path.stem}*.data") if data.is_file())}):
            with part.open("rb") as file:
                while piece := file.read(1 << 20):
                    digest.update(piece)
        return cache_folder() / "networks" / f"{digest.hexdigest()[:32]}.ok"
    except OSError:
        return None


def _set(mark: Path) -> None:
    try:
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.touch()
    except OSError:  # a cache that cannot be written costs the next start a second
        return


def run_once(path: Path) -> None:
    """Load a network and run it on a grey picture.

    Raises:
        MemoryError: It takes more than there is.
        Exception: Anything else is wrong with it; onnxruntime has no base class of its errors.
    """
    runtime = import_onnxruntime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    given = {item.name: _make_input(item.shape, item.type) for item in session.get_inputs()}
    try:
        session.run(None, given)
    except Exception as error:
        # a network of several inputs may want other sizes of them: what it says then costs nothing
        if any(word in str(error).lower() for word in ("alloc", "memory")):
            raise MemoryError from error


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
