"""Network files in onnxruntime: tried once in a sandbox, loaded, and run by threads that share pictures.

A file from elsewhere costs seconds and a gigabyte at most. What has passed is known by its content in the user's cache
folder, and not tried again; what is shipped is not tried.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finforce.caches import cache_folder
from finforce.errors import one_line
from finforce.files import BUDGET, raise_budget
from finforce.optional import import_onnxruntime
from finforce.processors import bind_helper, places_of_helpers
from finforce.sandbox import SandboxError, run_limited
from finforce_keypoints.errors import DetectionError, ModelError

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

SHIPPED = (Path(__file__).parents[1] / "models", Path(__file__).parents[2] / "finforce_eval" / "data")
LARGEST = 512 << 20  # bytes of a file
SECONDS, MEMORY = 20, 1536 << 20  # of a first run, onnxruntime's own memory included [bytes]
COLOURS, FREE_SIDE, LARGEST_SIDE = 3, 256, 4096  # [px] of an axis that takes any size, and of one that is frozen
_EDITION = 2
# Operators that gather statistics over a whole picture; group normalisation is exported as the first or the second.
_GLOBAL = (b"InstanceNormalization", b"GroupNormalization", b"LayerNormalization", b"GlobalAveragePool")
INPUT_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


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
        raise ModelError(
            f"{path}: {error}; expected an ONNX network that onnxruntime {runtime_version} runs"
        ) from error
    if mark is not None:
        with suppress(OSError):  # a cache that cannot be written costs the next start a second
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.touch()


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
    if kind not in INPUT_TYPES:
        raise ValueError(f"an input is {kind}; expected one of {', '.join(INPUT_TYPES)}")
    free = [1, FREE_SIDE, FREE_SIDE, FREE_SIDE]
    if len(shape) == len(free) and shape[-1] != COLOURS:
        free[1] = COLOURS
    sides = [size_frozen(size) or free[min(axis, len(free) - 1)] for axis, size in enumerate(shape)]
    if max(sides, default=1) > LARGEST_SIDE or np.prod(sides, dtype=float) > LARGEST_SIDE**2:
        raise ValueError(f"an input of {sides}; expected a picture of {LARGEST_SIDE} px each way at most")
    return np.full(sides, 0.5, INPUT_TYPES[kind])


def size_frozen(size: object) -> int | None:
    """Return the size of an axis that is frozen into a network, None of a free one."""
    return size if isinstance(size, int) and size > 0 else None


def open_session(path: Path, threads: int) -> InferenceSession:
    """Return an onnxruntime session of a network file.

    Raises:
        ModelError: the file cannot be loaded and run within bounds.
        MissingDependencyError: onnxruntime is not installed.
    """
    runtime = import_onnxruntime()
    try_network(path, runtime.__version__)
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 3  # errors, which are raised anyway
    # Threads that spin while they wait double the time where the solver's process needs the cores, too.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if places := places_of_helpers(threads):
        options.add_session_config_entry("session.intra_op_thread_affinities", places)
    try:
        return runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has no base class of its errors
        raise ModelError(f"{path}: onnxruntime cannot load it ({one_line(error)}); expected an ONNX network") from error


class Helpers:
    """Threads in addition to the caller's own that share the pictures of a batch, a picture at a time.

    Two threads that compute one picture wait for each other at every layer of a small network; two pictures do not.

    Args:
        threads: all of them, the caller's included.
    """

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._pool = ThreadPoolExecutor(max(threads - 1, 1), "pictures", bind_helper, (threads,))

    def share(self, work: Callable[[int], Any], count: int) -> list[Any]:
        """Return what the work gives for the numbers from 0 to a count; the first error in one of them is raised."""
        found: list[Any] = [None] * count
        waiting = iter(range(count))

        def run() -> None:
            for number in waiting:
                found[number] = work(number)

        others = [self._pool.submit(run) for _ in range(min(self._threads, count) - 1)]
        run()
        for other in others:
            other.result()
        return found


class Network:
    """An ONNX network of one image input; not for several threads at once.

    Attributes:
        inputs: name, shape (numbers, or names of free axes) and type of each.
        output_names: of its outputs.
        sees_whole: True if every output depends on the whole picture, so that a cut-out of it changes all of them.

    Args:
        path: the .onnx file.
        threads: that one picture is computed with, or that several are shared among.

    Raises:
        ModelError: the file cannot be loaded.
        MissingDependencyError: onnxruntime is not installed.
    """

    def __init__(self, path: Path, threads: int = 2) -> None:
        self._path, self._threads = path, threads
        self._session = open_session(path, threads)
        self.inputs = [(item.name, item.shape, item.type) for item in self._session.get_inputs()]
        self.output_names = tuple(item.name for item in self._session.get_outputs())
        content = path.read_bytes()
        self.sees_whole = any(name in content for name in _GLOBAL)

    def run(self, tensor: NDArray) -> list[NDArray]:
        """Return all outputs for an input tensor of the network's own layout, any number of images.

        Raises:
            DetectionError: the network cannot be computed for this input.
        """
        if len(tensor) == 1:
            return self._run_once(tensor, self._session)
        single, helpers = self._shared
        each = helpers.share(lambda number: self._run_once(tensor[number : number + 1], single), len(tensor))
        return [np.concatenate(outputs) for outputs in zip(*each, strict=True)]

    @cached_property
    def _shared(self) -> tuple[InferenceSession, Helpers]:
        """A session of one thread, and the threads that run it, each with a picture of its own."""
        return open_session(self._path, 1), Helpers(self._threads)

    def _run_once(self, tensor: NDArray, session: InferenceSession) -> list[NDArray]:
        (name, shape, _), *_ = self.inputs
        batch = size_frozen(shape[0]) or 1
        try:
            outputs = session.run(None, {name: tensor if batch == 1 else tensor.repeat(batch, axis=0)})
        except Exception as error:  # as above
            raise DetectionError(
                f"the network cannot be computed for an input of {tensor.shape}: {one_line(error)}"
            ) from error
        strange = [
            name
            for name, output in zip(self.output_names, outputs, strict=True)
            if not isinstance(output, np.ndarray) or output.dtype.kind not in "fiu"
        ]
        if strange:
            raise DetectionError(f"the network's outputs {strange} are no arrays of numbers, expected heatmaps")
        return [output[: max(len(output) // batch, 1)] for output in outputs]
