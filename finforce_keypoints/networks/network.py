"""A network file behind onnxruntime, its input and outputs found by looking."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import one_line
from finforce.optional import import_onnxruntime
from finforce.processors import bind_helper, places_of_helpers
from finforce_keypoints.errors import DetectionError, ModelError
from finforce_keypoints.networks.trial import try_network

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

COLOURS = 3
INPUT_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
_HEATMAP_WORDS = ("heat", "score", "pred")
_LOCREF_WORDS = ("locref", "offset")


@dataclass(frozen=True, kw_only=True)
class InputLayout:
    """What a network takes.

    Attributes:
        name: of the input.
        channel_axis: 1 of NCHW, 3 of NHWC.
        dtype: of the input; uint8 takes the image as it is.
        batch: pictures that it takes at a time; where that is not frozen, it is given one.
        height: frozen height [px], None where any will do.
        width: frozen width [px], None where any will do.
    """

    name: str
    channel_axis: int
    dtype: type
    batch: int
    height: int | None
    width: int | None


@dataclass(frozen=True, kw_only=True)
class OutputLayout:
    """Where a network's maps are.

    Attributes:
        heatmap: number of the output that holds the heatmaps.
        locref: number of the output that holds the offsets; that of the heatmaps when one output holds both (first K
            channels heatmaps, then 2K offsets); None without offsets.
        channel_axis: of the maps, 1 or 3.
        count: K heatmaps.
    """

    heatmap: int
    locref: int | None
    channel_axis: int
    count: int

    def split(self, outputs: Sequence[NDArray]) -> tuple[NDArray, NDArray | None]:
        """Return the heatmaps (B, K, h, w) and the offsets (B, 2K, h, w) or None, float32, of the outputs.

        Raises:
            DetectionError: they are not of these shapes; a network may make others of other pictures.
        """
        heatmap, locref = self._move_channels(outputs[self.heatmap]), None
        if self.locref == self.heatmap:
            heatmap, locref = heatmap[:, : self.count], heatmap[:, self.count :]
        elif self.locref is not None:
            locref = self._move_channels(outputs[self.locref])
        batch, count, *cells = heatmap.shape
        is_odd = locref is not None and locref.shape != (batch, 2 * self.count, *cells)
        if count != self.count or 0 in heatmap.shape or is_odd:
            offsets = None if locref is None else locref.shape
            raise DetectionError(
                f"heatmaps {heatmap.shape} and offsets {offsets}; expected {self.count} and {2 * self.count} maps of "
                "the same number of cells"
            )
        return heatmap, locref

    def _move_channels(self, maps: NDArray) -> NDArray:
        if maps.ndim != 4:
            raise DetectionError(f"output of shape {maps.shape}; expected maps (batch, parts, h, w)")
        return np.moveaxis(maps, self.channel_axis, 1).astype(np.float32, copy=False)


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


def find_network(path: str | Path) -> Path:
    """Return the only .onnx file of a folder, or the file itself.

    Raises:
        ModelError: there is none, or there are several.
    """
    path = Path(path)
    try:
        if path.is_file():
            return path
        found = sorted(path.glob("*.onnx"))
    except OSError as error:
        raise ModelError(
            f"model: cannot be looked for ({error.strerror}); expected a folder with one .onnx file"
        ) from error
    if len(found) != 1:
        names = ", ".join(file.name for file in found) or "none"
        raise ModelError(f"{path}: expected a folder with one .onnx file and its metadata, found {names}")
    return found[0]


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
    """An ONNX network of one image input; not for several threads at once."""

    def __init__(self, path: Path, threads: int = 2) -> None:
        """Load a network.

        Args:
            path: the .onnx file.
            threads: that one picture is computed with, or that several are shared among.

        Raises:
            ModelError: the file cannot be loaded, or its input is no colour image.
            MissingDependencyError: onnxruntime is not installed.
        """
        self._path, self._threads = path, threads
        self._session = open_session(path, threads)
        self.input = find_input([(item.name, item.shape, item.type) for item in self._session.get_inputs()])
        self.output_names = tuple(item.name for item in self._session.get_outputs())

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
        try:
            outputs = session.run(None, {self.input.name: tensor.repeat(self.input.batch, axis=0)})
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
        return [output[: max(len(output) // self.input.batch, 1)] for output in outputs]


def find_input(inputs: Sequence[tuple]) -> InputLayout:
    """Return the layout of the only input.

    Args:
        inputs: name, shape (numbers, or names of free axes) and type of each.

    Raises:
        ModelError: there are several, or it is no batch of colour images.
    """
    if len(inputs) != 1:
        raise ModelError(f"the network has the inputs {[item[0] for item in inputs]}, expected exactly one image")
    name, shape, kind = inputs[0]
    axes = [axis for axis in (1, 3) if len(shape) == 4 and shape[axis] == COLOURS]
    if not axes:
        raise ModelError(
            f"input '{name}' has shape {shape}, expected (batch, 3, height, width) or (batch, height, width, 3)"
        )
    if kind not in INPUT_TYPES:
        raise ModelError(f"input '{name}' is {kind}, expected one of {', '.join(INPUT_TYPES)}")
    height, width = (2, 3) if axes[0] == 1 else (1, 2)
    return InputLayout(
        name=name,
        channel_axis=axes[0],
        dtype=INPUT_TYPES[kind],
        batch=_frozen(shape[0]) or 1,
        height=_frozen(shape[height]),
        width=_frozen(shape[width]),
    )


def find_outputs(shapes: Sequence[tuple[str, tuple[int, ...]]], count: int, channel_axis: int) -> OutputLayout:
    """Return where heatmaps and offsets are: by the outputs' names, else the heatmaps first.

    Args:
        shapes: name and shape of every output, for some image.
        count: K body parts.
        channel_axis: of the input, tried first.

    Raises:
        ModelError: the outputs are not those of a heatmap head of K body parts.
    """
    heatmap, locref = _sort_outputs(shapes)
    _refuse_other_ranks([shapes[n] for n in (heatmap, locref) if n is not None])
    name, shape = shapes[heatmap]
    axes = sorted((1, 3), key=lambda axis: axis != channel_axis)
    for axis in axes:
        if locref is None and shape[axis] == COLOURS * count:
            return OutputLayout(heatmap=heatmap, locref=heatmap, channel_axis=axis, count=count)
        if shape[axis] == count and (locref is None or shapes[locref][1][axis] == 2 * count):
            return OutputLayout(heatmap=heatmap, locref=locref, channel_axis=axis, count=count)
    if locref is not None:
        wanted = f"{count} heatmaps and {2 * count} offsets"
        raise ModelError(f"outputs {list(shapes)}: expected {wanted} for the {count} body parts of the metadata")
    raise ModelError(
        f"output '{name}' has shape {shape}: expected {count} channels, or {3 * count} with offsets, for the {count} "
        "body parts of the metadata; are network and metadata of the same training?"
    )


def _sort_outputs(shapes: Sequence[tuple[str, tuple[int, ...]]]) -> tuple[int, int | None]:
    """Return the numbers of the outputs with the heatmaps and the offsets (None: there is no such output)."""
    names = [name.lower() for name, _ in shapes]
    locrefs = [n for n, name in enumerate(names) if any(word in name for word in _LOCREF_WORDS)]
    heatmaps = [n for n, name in enumerate(names) if n not in locrefs and any(word in name for word in _HEATMAP_WORDS)]
    if len(heatmaps) == 1 and len(locrefs) <= 1 and (locrefs or len(names) == 1):
        return heatmaps[0], locrefs[0] if locrefs else None
    if len(names) in (1, 2):
        return 0, 1 if len(names) == 2 else None
    raise ModelError(
        f"the network has the outputs {[name for name, _ in shapes]}, expected 'heatmap', or 'heatmap' and 'locref', "
        "or both in one"
    )


def _refuse_other_ranks(shapes: Sequence[tuple[str, tuple[int, ...]]]) -> None:
    """Refuse outputs that are no maps."""
    if all(len(shape) == 4 for _, shape in shapes):
        return
    hint = "its SimCC head (RTMPose) has one vector per axis; " if all(len(s) == 3 for _, s in shapes) else ""
    raise ModelError(
        f"outputs {list(shapes)}: {hint}expected heatmaps (batch, parts, h, w); export a network with a heatmap head"
    )


def _frozen(size: int | str | None) -> int | None:
    """Return a size that is frozen into the network, None of a free axis."""
    return size if isinstance(size, int) and size > 0 else None
