"""A DeepLabCut network with its metadata: pictures to heatmaps to pixels, likelihoods and standard deviations."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce_keypoints.errors import DetectionError, ModelError
from finforce_keypoints.networks.metadata import METADATA_FILE, ModelMetadata, read_metadata
from finforce_keypoints.networks.runtime import COLOURS, INPUT_TYPES, LARGEST_SIDE, Network, size_frozen

# Likelihood and standard deviation [px of the network's input] of a network that was never calibrated: DeepLabCut's
# networks err by 2 to 3 px above its cut-off of 0.6, and by tens of pixels where they see nothing.
DEFAULT_STDDEV = np.array([[0.05, 20.0], [0.2, 10.0], [0.4, 5.0], [0.6, 3.0], [0.8, 2.0], [0.95, 1.5]])
# DeepLabCut trains offsets within 17 px of a label; a longer one at a peak comes of a wrong scale or a wrong network.
LARGEST_OFFSET = 20.0
_LOG_FLOOR = 1e-2  # of the peak: a neighbour below it says nothing of the place between the cells
_STEP_ROWS, _STEP_COLUMNS = (steps.ravel() - 1 for steps in np.indices((3, 3)))
_FEW_CELLS = 36
# share of a map's cells that may reach half of its highest score: a map without a peak is not a map
_LARGEST_PEAK = 0.5
_CENTRE = 4  # of the 3 x 3 cells in row order; 3 and 5 are its neighbours in the row, 1 and 7 in the column


@dataclass(frozen=True, kw_only=True, eq=False)
class DecodingRule:
    """The conversion of the maps of one network into pixels.

    Attributes:
        stride: input pixels per cell.
        locref_std: scale of the offset channels [px].
        apply_sigmoid: True if the maps are logits.
        pooled: True if the places that the 3 x 3 cells around a peak vote for are averaged, weighted by their scores;
            DeepLabCut takes the peak's own.
        likelihood_stddev: (n, 2) likelihood, standard deviation [px of the network's input].
    """

    stride: float
    locref_std: float = 7.2801
    apply_sigmoid: bool = False
    pooled: bool = False
    likelihood_stddev: NDArray = field(default_factory=lambda: DEFAULT_STDDEV)


@dataclass(frozen=True, kw_only=True, eq=False)
class Peaks:
    """The best place of every body part in every image of a batch.

    Attributes:
        pixels: (B, K, 2) column and row in the network's input [px]; NaN where there is none.
        likelihood: (B, K) from 0 to 1; 0 where there is none.
        spread: (B, K) standard deviation of the places that the cells around the peak vote for [px], large where the
            offsets contradict each other; NaN without offsets.
        stddev: (B, K) [px], by the calibrated map, at least the spread; inf where there is none.
        astray: (B, K) the score of a peak that was dropped because its offset is longer than training allows, else 0.
    """

    pixels: NDArray
    likelihood: NDArray
    spread: NDArray
    stddev: NDArray
    astray: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cells:
    """The 3 x 3 cells around n peaks: rows, columns and scores (n, 9), NaN outside the map; is it a peak (n,)."""

    rows: NDArray
    columns: NDArray
    scores: NDArray
    is_peak: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Places:
    """Places of n peaks: pixels (n, 2), length of the offset from the cell's centre (n,), spread (n,) [px]."""

    pixels: NDArray
    offset: NDArray
    spread: NDArray


def decode(heatmap: NDArray, locref: NDArray | None, rule: DecodingRule, size: tuple[int, int]) -> Peaks:
    """Return the highest peak of every heatmap, as DeepLabCut's HeatmapPredictor places it.

    x = (c + 0.5) stride + locref[2k, r, c] locref_std,  y = (r + 0.5) stride + locref[2k + 1, r, c] locref_std,
    score = heatmap[k, r, c], or its sigmoid, clipped to 0..1.

    Maps reach beyond the image, by the network's border and by padding: cells that begin outside it are not searched,
    a place up to half a cell outside is moved to the border, one farther out is dropped. So is what is not finite, and
    the highest cell of a map that is about as high everywhere.

    Args:
        heatmap: (B, K, h, w) scores.
        locref: (B, 2K, h, w) offsets, x and y interleaved; None without.
        rule: of the network.
        size: height and width of the image within the network's input [px].

    Returns:
        The peaks.
    """
    batch, count = heatmap.shape[:2]
    cells = _find_cells(heatmap, rule, size)
    places = _place_by_scores(cells, rule) if locref is None else _place_by_offsets(cells, locref, rule)
    scores = cells.scores[:, _CENTRE]
    is_astray = places.offset > max(LARGEST_OFFSET, 1.5 * rule.stride)
    is_good = np.isfinite(scores) & cells.is_peak & ~is_astray & _is_near(places.pixels, 0.5 * rule.stride, size)
    likelihood = np.where(is_good, np.clip(scores, 0.0, 1.0), 0.0)
    stddev = np.fmax(stddev_from_likelihood(likelihood, rule.likelihood_stddev), places.spread)
    pixels = np.clip(places.pixels, 0.0, (size[1] - 1.0, size[0] - 1.0))
    shape = (batch, count)
    return Peaks(
        pixels=np.where(is_good[:, None], pixels, np.nan).reshape(*shape, 2),
        likelihood=likelihood.reshape(shape),
        spread=places.spread.reshape(shape),
        stddev=np.where(is_good, stddev, np.inf).reshape(shape),
        astray=np.where(is_astray, np.clip(scores, 0.0, 1.0), 0.0).reshape(shape),
    )


def stddev_from_likelihood(likelihood: NDArray, table: NDArray) -> NDArray:
    """Return the standard deviations (...) [px] of likelihoods (...), on a calibrated map.

    Between the rows the logarithm is interpolated; outside them the first or the last row holds.

    Args:
        likelihood: (...) from 0 to 1.
        table: (n, 2) rising likelihood, standard deviation [px].
    """
    return np.exp(np.interp(likelihood, table[:, 0], np.log(table[:, 1])))


def stride_from_shapes(cells: int, pixels: int) -> float:
    """Return the power of two that is nearest to input pixels per cell, 2^round(log2(H / h)).

    A network has a border cell more than H / stride, therefore H / h itself is none.
    """
    return float(2.0 ** np.round(np.log2(pixels / cells)))


def _find_cells(heatmap: NDArray, rule: DecodingRule, size: tuple[int, int]) -> _Cells:
    """Return the cells around the highest peak of every map (B, K, h, w), n = B K."""
    rows, columns = (
        min(cells, int(pixels // rule.stride) + 1) for cells, pixels in zip(heatmap.shape[2:], size, strict=True)
    )
    maps = heatmap[:, :, :rows, :columns].reshape(-1, rows * columns)
    best = maps.argmax(axis=1)[:, None]
    r, c = best // columns + _STEP_ROWS, best % columns + _STEP_COLUMNS
    is_inside = (r >= 0) & (r < rows) & (c >= 0) & (c < columns)
    r, c = np.clip(r, 0, rows - 1), np.clip(c, 0, columns - 1)
    scores = np.take_along_axis(maps, r * columns + c, axis=1).astype(float)
    half = 0.5 * scores[:, _CENTRE]
    if rule.apply_sigmoid:
        scores = 1.0 / (1.0 + np.exp(-np.clip(scores, -50.0, 50.0)))
        half = np.log(0.5 * scores[:, _CENTRE] / (1.0 - 0.5 * scores[:, _CENTRE]))
    is_peak = (maps >= half[:, None]).mean(axis=1) <= _LARGEST_PEAK
    # of a negative peak, half is higher than it; a map of a few cells is nearly all peak
    is_peak |= ~(scores[:, _CENTRE] > 0.0) | (maps.shape[1] < _FEW_CELLS)
    return _Cells(rows=r, columns=c, scores=np.where(is_inside, scores, np.nan), is_peak=is_peak)


def _place_by_scores(cells: _Cells, rule: DecodingRule) -> _Places:
    """Return the tops of parabolas through the logarithms of the scores.

    Half the offset is (a - b) / (a - 2 m + b) of the logarithms a, m, b before, at and after the peak, exact for a
    Gaussian.
    """
    peak = np.maximum(cells.scores[:, _CENTRE], np.finfo(float).tiny)[:, None]
    with np.errstate(invalid="ignore"):
        logs = np.log(np.maximum(cells.scores / peak, _LOG_FLOOR))
    before, after = logs[:, [3, 1]], logs[:, [5, 7]]
    bend = before + after
    between = 0.5 * (before - after) / np.where(bend < 0.0, bend, -np.inf)
    between = np.nan_to_num(np.clip(between, -0.5, 0.5))  # NaN: at the border of the map
    offsets = rule.stride * between
    centres = np.column_stack((cells.columns[:, _CENTRE], cells.rows[:, _CENTRE])) + 0.5
    return _Places(
        pixels=centres * rule.stride + offsets,
        offset=np.hypot(*offsets.T),
        spread=np.full(len(offsets), np.nan),
    )


def _place_by_offsets(cells: _Cells, locref: NDArray, rule: DecodingRule) -> _Places:
    """Return the peaks moved by their offsets, and how far the cells around them agree."""
    count = locref.shape[1] // 2
    image, part = (index[:, None] for index in np.divmod(np.arange(len(cells.scores)), count))
    dx, dy = (locref[image, 2 * part + axis, cells.rows, cells.columns] for axis in (0, 1))
    with np.errstate(invalid="ignore"):
        offsets = rule.locref_std * np.stack((dx, dy), axis=-1).astype(float)
    votes = (np.stack((cells.columns, cells.rows), axis=-1) + 0.5) * rule.stride + offsets
    weights = np.where(np.isfinite(votes).all(axis=-1), np.nan_to_num(np.clip(cells.scores, 0.0, 1.0)), 0.0)
    weights /= np.maximum(weights.sum(axis=1), np.finfo(float).tiny)[:, None]
    votes_known = np.nan_to_num(votes, posinf=0.0, neginf=0.0)
    mean = (weights[..., None] * votes_known).sum(axis=1)
    variance = 0.5 * (weights[..., None] * (votes_known - mean[:, None]) ** 2).sum(axis=(1, 2))
    is_empty = weights.sum(axis=1) == 0.0
    own = votes[:, _CENTRE]
    pixels = np.where((rule.pooled & ~is_empty & np.isfinite(own).all(axis=1))[:, None], mean, own)
    return _Places(
        pixels=pixels,
        offset=np.hypot(*offsets[:, _CENTRE].T),
        spread=np.where(is_empty, np.nan, np.sqrt(variance)),
    )


def _is_near(pixels: NDArray, margin: float, size: tuple[int, int]) -> NDArray:
    """Tell (n,) which pixels (n, 2) are finite and at most a margin outside an image of some height and width."""
    farthest = (size[1] + margin, size[0] + margin)
    return ((pixels >= -margin) & (pixels <= farthest)).all(axis=1)


_HEATMAP_WORDS = ("heat", "score", "pred")
_LOCREF_WORDS = ("locref", "offset")
# ImageNet's, which DeepLabCut takes off
_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_STD = np.array([0.229, 0.224, 0.225], np.float32)
# what else networks are kept in, by the endings of their files
OTHERS = {".pt": "PyTorch", ".pth": "PyTorch", ".pb": "TensorFlow", ".h5": "Keras", ".keras": "Keras"}
OTHERS |= {".tflite": "TensorFlow Lite", ".engine": "TensorRT"}
_PROBE = 256  # px, of the picture that a network of any size is tried with
# A border of up to one cell and a half is a network's habit; a stride off by a factor of two is an error.
_STRIDE_TOLERANCE = 0.6  # of log2(H / h / stride)


@dataclass(frozen=True, kw_only=True)
class InputLayout:
    """The input of a network.

    Attributes:
        channel_axis: 1 of NCHW, 3 of NHWC.
        dtype: of the input; uint8 takes the image as it is.
        height: frozen height [px], None where any will do.
        width: frozen width [px], None where any will do.
    """

    channel_axis: int
    dtype: type
    height: int | None
    width: int | None


@dataclass(frozen=True, kw_only=True)
class OutputLayout:
    """Layout of a network's maps.

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


class KeypointModel:
    """Any DeepLabCut network exported to ONNX, with its `pytorch_config.yaml`; not for several threads at once.

    Attributes:
        path: the .onnx file.
        metadata: the metadata beside it.
    """

    def __init__(self, path: str | Path, threads: int = 2) -> None:
        """Load a network and try it once.

        Args:
            path: the folder with one .onnx file and its metadata, or that .onnx file.
            threads: that one picture is computed with.

        Raises:
            ModelError: files are missing, or network and metadata do not agree.
            MissingDependencyError: onnxruntime is not installed.
        """
        self.path = find_network(path)
        self.metadata: ModelMetadata = read_metadata(self.path.parent / METADATA_FILE)
        self._network = Network(self.path, threads)
        self._input = find_input(self._network.inputs)
        axes = (COLOURS, 1, 1) if self._input.channel_axis == 1 else (COLOURS,)
        scale, shift = np.full(COLOURS, 1.0 / 255.0, np.float32), np.zeros(COLOURS, np.float32)
        if self.metadata.normalize_images:
            scale, shift = scale / _STD, -_MEAN / _STD
        self._scale, self._shift = scale.reshape(axes), shift.reshape(axes)
        self._check_sizes()
        try:
            self._outputs = self._probe()
        except (ModelError, DetectionError) as error:
            raise ModelError(f"{self.path.name}: {error}") from error

    @property
    def names(self) -> tuple[str, ...]:
        """The names (K,) of the body parts, in the order of the peaks."""
        return self.metadata.bodyparts

    @property
    def frozen_size(self) -> tuple[int | None, int | None]:
        """Height and width that are frozen into the network [px]; None where any will do."""
        return self._input.height, self._input.width

    @property
    def sees_whole(self) -> bool:
        """True if a cut-out of a picture changes all of the network's answer, as group normalisation does."""
        return self._network.sees_whole

    @property
    def training_size(self) -> tuple[int, int] | None:
        """Height and width of the images to be given [px]: frozen, or kept in the metadata; else None."""
        frozen = self.frozen_size if None not in self.frozen_size else None
        return frozen or self.metadata.training_size

    def accepts(self, size: tuple[int, int]) -> bool:
        """Tell whether pictures of some height and width [px] are such as the network was trained on."""
        trained = self.metadata.training_size
        return tuple(size) == tuple(trained) if trained else self._fits(self._pad_size(size))

    @cached_property
    def sha256(self) -> str:
        """The network file's SHA-256, by which recordings tell what they were made with."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()

    def run(self, batch: NDArray) -> tuple[NDArray, NDArray | None]:
        """Return the maps of a batch of pictures.

        Args:
            batch: (B, H, W, 3) uint8 RGB.

        Returns:
            Heatmaps (B, K, h, w) and offsets (B, 2K, h, w), None without; float32, as the network gives them.

        Raises:
            DetectionError: it is no batch of colour pictures, or the network is frozen to another size.
        """
        heatmap, locref = self._outputs.split(self._network.run(self.preprocess(batch)))
        if len(heatmap) != len(batch):
            raise DetectionError(
                f"the network made maps {heatmap.shape} of {len(batch)} pictures; expected one set each"
            )
        return heatmap, locref if self.metadata.location_refinement else None

    def locate(self, batch: NDArray) -> Peaks:
        """Return the best place of every body part in a batch of pictures (B, H, W, 3) uint8 RGB.

        Raises:
            DetectionError: it is no batch of colour pictures, or the network is frozen to another size.
            ModelError: the stride is not that of the network.
        """
        heatmap, locref = self.run(batch)
        size = batch.shape[1:3]
        return decode(heatmap, locref, self.find_rule(self._pad_size(size), heatmap.shape[2:]), size)

    def preprocess(self, batch: NDArray) -> NDArray:
        """Return the network's input for a batch of pictures: (RGB / 255 - mean) / std, padded, in its axes' order.

        Args:
            batch: (B, H, W, 3) uint8 RGB.

        Returns:
            (B, 3, H', W') or (B, H', W', 3), of the network's type.

        Raises:
            DetectionError: it is no batch of colour pictures, or the network is frozen to another size.
        """
        if batch.ndim != 4 or batch.shape[3] != COLOURS or batch.dtype != np.uint8 or 0 in batch.shape:
            raise DetectionError(f"got {batch.dtype} {batch.shape}, expected uint8 RGB (batch, height, width, 3)")
        batch = self._pad(batch)
        layout = self._input
        if self.metadata.colormode == "BGR":
            batch = batch[..., ::-1]
        if layout.channel_axis == 1:
            batch = batch.transpose(0, 3, 1, 2)
        batch = np.ascontiguousarray(batch)  # colours as they lie in a picture make steps of three numbers
        if layout.dtype == np.uint8:
            return batch
        tensor = batch * self._scale
        tensor += self._shift
        return tensor.astype(layout.dtype, copy=False)

    def find_rule(self, pixels: tuple[int, int], cells: tuple[int, int]) -> DecodingRule:
        """Return how maps of some height and width are decoded, for an input of some height and width [px].

        Raises:
            ModelError: the stride of the metadata is not that of the network.
        """
        metadata, stddev = self.metadata, self.metadata.finforce.likelihood_stddev
        stride = metadata.stride or stride_from_shapes(cells[0], pixels[0])
        off = np.log2(np.divide(pixels, cells) / stride)
        if np.abs(off).max() > _STRIDE_TOLERANCE:
            raise ModelError(
                f"stride {stride:g}: the network makes {cells[0]}x{cells[1]} cells of {pixels[0]}x{pixels[1]} px; "
                f"expected about {stride_from_shapes(cells[0], pixels[0]):g}, as output_stride in the metadata"
            )
        return DecodingRule(
            stride=float(stride),
            locref_std=metadata.locref_std,
            apply_sigmoid=metadata.apply_sigmoid,
            pooled=metadata.finforce.pooled,
            likelihood_stddev=DEFAULT_STDDEV if stddev is None else np.array(stddev),
        )

    def _probe(self) -> OutputLayout:
        """Return the layout of the outputs after a try with a grey picture."""
        height, width = self.training_size or (_PROBE, _PROBE)
        size = self.frozen_size[0] or height, self.frozen_size[1] or width
        if max(self._pad_size(size)) > LARGEST_SIDE:
            raise ModelError(f"pictures of {size[0]}x{size[1]} px, expected at most {LARGEST_SIDE} px each way")
        batch = np.full((1, *size, COLOURS), 128, np.uint8)
        tensor = self.preprocess(batch)
        arrays = self._network.run(tensor)
        shapes = [(name, array.shape) for name, array in zip(self._network.output_names, arrays, strict=True)]
        layout = find_outputs(shapes, len(self.names), self._input.channel_axis)
        if layout.locref is None and self.metadata.locref_config is not None and self.metadata.location_refinement:
            raise ModelError(
                f"outputs {shapes}: the metadata have a locref_config; export the offsets too, or set "
                "predictor.location_refinement: false"
            )
        heatmap, _ = layout.split(arrays)
        if len(heatmap) != 1:
            raise ModelError(f"the network made maps {heatmap.shape} of one picture; expected one set for each picture")
        self.find_rule(self._pad_size(batch.shape[1:3]), heatmap.shape[2:])
        return layout

    def _check_sizes(self) -> None:
        """Refuse a training size that the network is not frozen to."""
        wanted = self.metadata.training_size
        if wanted is None:
            return
        if not self._fits(self._pad_size(wanted)):
            raise ModelError(
                f"{self.path.name}: the network is frozen to {self.frozen_size} (height, width); expected "
                f"that for its training_size of {tuple(wanted)}"
            )

    def _fits(self, padded: tuple[int, int]) -> bool:
        """Tell whether the network can be computed for a padded height and width [px]."""
        return all(frozen in (None, px) for frozen, px in zip(self.frozen_size, padded, strict=True))

    def _pad_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the height and width [px] that pictures of some size are padded to."""
        height, width = (-(-px // divisor) * divisor for px, divisor in zip(size, self.metadata.divisors, strict=True))
        return height, width

    def _pad(self, batch: NDArray) -> NDArray:
        """Return pictures padded at the right and at the bottom by reflection, as the metadata ask for."""
        size = batch.shape[1:3]
        padded = self._pad_size(size)
        if not self._fits(padded):
            raise DetectionError(
                f"picture of {size[0]}x{size[1]} px (height x width): the network is frozen to {self.frozen_size}; "
                "give it pictures of its training's size, or allow resizing"
            )
        if padded == tuple(size):
            return batch
        return np.pad(batch, ((0, 0), (0, padded[0] - size[0]), (0, padded[1] - size[1]), (0, 0)), mode="reflect")


def find_network(path: str | Path) -> Path:
    """Return the only .onnx file of a folder, or the file itself.

    Raises:
        ModelError: there is none, or there are several.
    """
    path = Path(path)
    try:
        if path.is_file() and path.suffix not in OTHERS:
            return path
        files = sorted(path.glob("*"))
        found = [file for file in files if file.suffix == ".onnx"]
    except OSError as error:
        raise ModelError(
            f"model: cannot be looked for ({error.strerror}); expected a folder with one .onnx file"
        ) from error
    others = [file for file in (path, *files) if file.suffix in OTHERS]
    if others and not found:
        kind = OTHERS[others[0].suffix]
        export = "export it with examples/export_deeplabcut.py"
        advice = export if kind == "PyTorch" else f"convert it, or train with DeepLabCut 3 (PyTorch) and {export}"
        raise ModelError(f"{others[0]}: a {kind} file; expected an ONNX network: {advice}")
    if len(found) != 1:
        names = ", ".join(file.name for file in found) or "none"
        raise ModelError(f"{path}: expected a folder with one .onnx file and its metadata, found {names}")
    return found[0]


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
        channel_axis=axes[0],
        dtype=INPUT_TYPES[kind],
        height=size_frozen(shape[height]),
        width=size_frozen(shape[width]),
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
    named = all("simcc" in name.lower() for name, _ in shapes)
    hint = "its SimCC head (RTMPose) has one vector per axis; " if named else ""
    raise ModelError(
        f"outputs {list(shapes)}: {hint}expected heatmaps (batch, parts, h, w); export a network with a heatmap head"
    )
