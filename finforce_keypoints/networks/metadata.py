"""The `pytorch_config.yaml` beside a DeepLabCut network, and which heatmap is which key point of which jaw."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from numbers import Real
from pathlib import Path
from reprlib import Repr
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.files import FileError, read_yaml
from finforce_ifea.jaw.jaw import Jaw
from finforce_keypoints.errors import ModelError, NamingError
from finforce_keypoints.images import REFERENCE

METADATA_FILE = "pytorch_config.yaml"
LOCREF_STD = 7.2801  # DeepLabCut's default scale of its offset channels [px]
_PREDICTOR = "HeatmapPredictor"
_BEYOND = 1e30  # no number of a configuration is so large; NaN is not below it
_HEAD = "model.heads.bodypart"
LARGEST_SIDE = 4096  # px of a picture: more is a mistake, and takes gigabytes


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelMetadata:
    """What a DeepLabCut configuration says of its network.

    Attributes:
        bodyparts: (K,) names, in the order of the heatmaps.
        colormode: "RGB" or "BGR", the order that the network was trained on.
        normalize: whether ImageNet's mean and standard deviation are taken off.
        divisors: height and width are padded to multiples of these [px]; (1, 1) for none.
        stride: input pixels per heatmap cell, None where the file does not tell.
        locref_std: scale of the offset channels [px].
        apply_sigmoid: whether scores are logits.
        location_refinement: whether offsets are used.
        has_locref: whether the head has offset channels.
        extra: this package's own section, `finforce`.
    """

    bodyparts: tuple[str, ...]
    colormode: str = "RGB"
    normalize: bool = True
    divisors: tuple[int, int] = (1, 1)
    stride: float | None = None
    locref_std: float = LOCREF_STD
    apply_sigmoid: bool = False
    location_refinement: bool = True
    has_locref: bool = False
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def training_size(self) -> tuple[int, int] | None:
        """Height and width of the training images [px] (`finforce: training_size: {height, width}`), None if not kept.

        Raises:
            ModelError: they are not two positive whole numbers.
        """
        size = self.extra.get("training_size")
        if size is None:
            return None
        numbers = [size.get("height"), size.get("width")] if isinstance(size, Mapping) else []
        if len(numbers) != 2 or not all(type(n) is int and 0 < n <= LARGEST_SIDE for n in numbers):
            raise ModelError(
                f"finforce.training_size: got {shorten(size)}, expected {{height: px, width: px}} up to {LARGEST_SIDE}"
            )
        return numbers[0], numbers[1]

    @property
    def pooled(self) -> bool:
        """Whether the offsets around a peak are averaged (`finforce: pooled`).

        Raises:
            ModelError: it is neither true nor false.
        """
        return _look_up(self.extra, "pooled", bool, False)

    @property
    def likelihood_stddev(self) -> NDArray | None:
        """The calibrated map (n, 2) of likelihood to standard deviation [px], None where it was not calibrated.

        Raises:
            ModelError: it is no table of rising likelihoods and positive standard deviations.
        """
        rows = self.extra.get("likelihood_stddev")
        return None if rows is None else check_stddev_table(rows)


def check_stddev_table(rows: Any) -> NDArray:
    """Return a map of likelihood to standard deviation [px] as an array (n, 2).

    Raises:
        ModelError: it is no table of rising likelihoods from 0 to 1 and positive standard deviations.
    """
    try:
        table = np.array(rows, dtype=float)
    except (TypeError, ValueError, OverflowError):
        table = np.empty(0)
    if table.ndim != 2 or table.shape[1] != 2 or len(table) < 1 or not np.isfinite(table).all():
        raise ModelError(f"finforce.likelihood_stddev: got {shorten(rows)}, expected rows of [likelihood, stddev px]")
    likelihood, stddev = table.T
    if (np.diff(likelihood) <= 0.0).any() or likelihood[0] < 0.0 or likelihood[-1] > 1.0 or (stddev <= 0.0).any():
        raise ModelError(
            f"finforce.likelihood_stddev: got {shorten(table.tolist())}, expected likelihoods that rise from 0 to "
            "1 and positive standard deviations [px]"
        )
    return table


def read_metadata(path: str | Path) -> ModelMetadata:
    """Return what a `pytorch_config.yaml` says.

    Args:
        path: the file.

    Raises:
        ModelError: it is missing, is no YAML, lacks the body parts, or asks for a decoding that is not offered.
    """
    path = Path(path)
    try:
        content = read_yaml(path, text_keys=False)
    except FileError as error:
        raise ModelError(
            f"{path}: cannot be read ({error}); expected DeepLabCut's {METADATA_FILE} beside the network, which alone "
            "knows the body parts"
        ) from error
    try:
        return parse_metadata(content)
    except ModelError as error:
        raise ModelError(f"{path.name}: {error}") from error


def parse_metadata(content: Any) -> ModelMetadata:
    """Return what the content of a `pytorch_config.yaml` says; see `read_metadata`.

    Raises:
        ModelError: a value is missing, of another type, or asks for what is not offered.
    """
    if not isinstance(content, Mapping):
        raise ModelError(f"got {type(content).__name__}, expected the tables of a DeepLabCut configuration")
    _check_method(content)
    predictor, inference = f"{_HEAD}.predictor", "data.inference"
    extra = _look_up(content, "finforce", Mapping, {})
    metadata = ModelMetadata(
        bodyparts=_parse_bodyparts(content),
        colormode=_parse_colormode(content),
        normalize=_look_up(content, f"{inference}.normalize_images", bool, True),
        divisors=_parse_divisors(content),
        stride=_parse_stride(content),
        locref_std=float(_look_up(content, f"{predictor}.locref_std", Real, LOCREF_STD)),
        apply_sigmoid=_look_up(content, f"{predictor}.apply_sigmoid", bool, False),
        location_refinement=_look_up(content, f"{predictor}.location_refinement", bool, True),
        has_locref=_look_up(content, f"{_HEAD}.locref_config", Mapping, None) is not None,
        extra=extra,
    )
    if metadata.locref_std <= 0.0:
        raise ModelError(f"{predictor}.locref_std: got {metadata.locref_std:g}, expected a positive number of pixels")
    return metadata


def _check_method(content: Mapping) -> None:
    """Refuse networks whose outputs are no heatmaps of one animal."""
    kind = _look_up(content, f"{_HEAD}.predictor.type", str, _PREDICTOR)
    if kind != _PREDICTOR:
        raise ModelError(
            f"{_HEAD}.predictor.type: got {kind}, expected {_PREDICTOR}; train a single-animal network with heatmaps "
            "(resnet_50, hrnet_w18, hrnet_w32), RTMPose's SimCC and multi-animal heads are not decoded"
        )
    individuals = _look_up(content, "metadata.individuals", list, [])
    if len(individuals) > 1:
        raise ModelError(
            f"metadata.individuals: got {len(individuals)}, expected one; name the points of the two jaws "
            "left_... and right_..."
        )


def _parse_bodyparts(content: Mapping) -> tuple[str, ...]:
    """Return the names of the body parts, all different."""
    names = _look_up(content, "metadata.bodyparts", list, [])
    if not names or not all(isinstance(name, str) and name.strip() and name.isprintable() for name in names):
        raise ModelError(f"metadata.bodyparts: got {shorten(names)}, expected the list of the body parts' names")
    doubled = sorted(name for name, count in Counter(names).items() if count > 1)
    if doubled:
        raise ModelError(f"metadata.bodyparts: {', '.join(doubled)} more than once, expected each name once")
    return tuple(names)


def _parse_colormode(content: Mapping) -> str:
    mode = _look_up(content, "data.colormode", str, "RGB").upper()
    if mode not in ("RGB", "BGR"):
        raise ModelError(f"data.colormode: got {mode}, expected RGB or BGR")
    return mode


def _parse_divisors(content: Mapping) -> tuple[int, int]:
    """Return the divisors of height and width; DeepLabCut pads HRNet's images to multiples of 32."""
    padding = "data.inference.auto_padding"
    if _look_up(content, padding, Mapping, None) is None:
        return 1, 1
    height = _look_up(content, f"{padding}.pad_height_divisor", int, 1)
    width = _look_up(content, f"{padding}.pad_width_divisor", int, 1)
    if not 1 <= min(height, width) <= max(height, width) <= LARGEST_SIDE:
        raise ModelError(
            f"{padding}: got divisors {shorten(height)} and {shorten(width)}, expected whole numbers from 1 to "
            f"{LARGEST_SIDE}"
        )
    return height, width


def _parse_stride(content: Mapping) -> float | None:
    """Return backbone stride / upsampling of the head, None where the backbone's is not written."""
    stride = _look_up(content, "model.backbone.output_stride", Real, None)
    if stride is None:
        return None
    steps = _look_up(content, f"{_HEAD}.heatmap_config.strides", list, [])
    if stride <= 0 or not all(is_number(step) and 1e-3 < step < 1e3 for step in steps):
        raise ModelError(
            f"model.backbone.output_stride {shorten(stride)}, heatmap_config.strides {shorten(steps)}: expected "
            "positive numbers"
        )
    return float(stride) / prod(steps)


def _look_up(content: Mapping, place: str, kind: type, default: Any) -> Any:
    """Return the value at a dotted place, the default where it or one of its tables is absent or empty."""
    value: Any = content
    for key in place.split("."):
        if not isinstance(value, Mapping):
            raise ModelError(f"{place}: got {shorten(value)} on the way there, expected a table")
        value = value.get(key)
        if value is None:
            return default
    if not isinstance(value, kind) or (kind in (int, Real) and not is_number(value)):
        raise ModelError(f"{place}: got {shorten(value)}, expected {'a number' if kind is Real else kind.__name__}")
    return value


def is_number(value: Any) -> bool:
    """Say whether a value is a finite number, neither a flag nor a whole number beyond all floats."""
    return isinstance(value, Real) and not isinstance(value, bool) and abs(value) < _BEYOND


def shorten(value: Any) -> str:
    """Return a value as Python writes it, long and deep ones in part: aliases let a small file stand for gigabytes."""
    short = Repr()
    short.maxlevel, short.maxstring = 2, 60
    return " ".join(short.repr(value).split())


IGNORED = "-"  # what a body part is mapped to that belongs to no jaw


@dataclass(frozen=True, kw_only=True, eq=False)
class NameMap:
    """Where each jaw's points are among the body parts of a network.

    Attributes:
        rows: side -> (K + 1,) numbers of the body parts: the key points in the order of the jaw file, the reference
            point last.
        is_of_one_jaw: whether the network knows one jaw and is used on each of them in turn.
    """

    rows: Mapping[str, NDArray]
    is_of_one_jaw: bool


def build_name_map(
    bodyparts: Sequence[str], jaws: Mapping[str, Jaw], mapping: Mapping[str, str] | None = None
) -> NameMap:
    """Return the body part of every key point.

    By default a body part is called SIDE_NAME after a key point of the jaw file or "reference" (`left_inner_1`,
    `right_tip`, `left_reference`), or just NAME in a network of one jaw (`inner_1`), which serves every jaw.

    Args:
        bodyparts: (N,) names of the network, in the order of its heatmaps.
        jaws: side -> jaw, those to be found.
        mapping: body part -> such a name, or "-" for a body part of no jaw; body parts that it leaves out keep the
            default.

    Raises:
        NamingError: a name is unknown, missing or there twice.
    """
    mapping = mapping or {}
    strangers = [name for name in mapping if name not in bodyparts]
    if strangers:
        raise NamingError(f"mapping: the network has no body part {_join(strangers)}; it has {_join(bodyparts)}")
    targets = {name: number for number, name in _translate(bodyparts, mapping)}
    own = {side: [*jaw.keypoint_names, REFERENCE] for side, jaw in jaws.items()}
    is_of_one_jaw = not any(_split(name)[0] for name in targets)
    wanted = {side: [name if is_of_one_jaw else f"{side}_{name}" for name in names] for side, names in own.items()}
    _check_names(targets, wanted, is_of_one_jaw)
    rows = {side: np.array([targets[name] for name in names]) for side, names in wanted.items()}
    return NameMap(rows=rows, is_of_one_jaw=is_of_one_jaw)


def parse_mapping(entries: Iterable[str]) -> dict[str, str]:
    """Return the mapping that entries "BODYPART=NAME" stand for; NAME as in `build_name_map`.

    Raises:
        NamingError: an entry has another form, or names a body part again.
    """
    mapping: dict[str, str] = {}
    for entry in entries:
        bodypart, sign, name = (part.strip() for part in entry.partition("="))
        if not (bodypart and sign and name):
            raise NamingError(f"mapping: got {entry!r}, expected BODYPART=NAME, such as 'finger one=left_inner_1'")
        if bodypart in mapping:
            raise NamingError(f"mapping: {bodypart} stands there twice, expected each body part once")
        mapping[bodypart] = name
    return mapping


def _translate(bodyparts: Sequence[str], mapping: Mapping[str, str]) -> list[tuple[int, str]]:
    """Return the number and the name of every body part that is not ignored, each name once."""
    pairs = [(number, mapping.get(name, name)) for number, name in enumerate(bodyparts)]
    pairs = [(number, name) for number, name in pairs if name != IGNORED]
    names = [name for _, name in pairs]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise NamingError(f"mapping: several body parts are {_join(doubled)}, expected one each")
    return pairs


def _split(name: str) -> tuple[str, str]:
    """Return the side that a name begins with, "" without one, and the rest."""
    side, sign, rest = name.partition("_")
    return (side, rest) if sign and side in ("left", "right") else ("", name)


def _check_names(targets: Mapping[str, int], wanted: Mapping[str, Sequence[str]], is_of_one_jaw: bool) -> None:
    """Refuse names that are missing, and names that belong to no jaw; those of a jaw that is not wanted are left."""
    names = [name for side in wanted.values() for name in side]
    missing = list(dict.fromkeys(name for name in names if name not in targets))
    strange = [
        name
        for name in targets
        if name not in names and (is_of_one_jaw or _split(name)[0] in wanted or not _split(name)[0])
    ]
    if missing or strange:
        raise NamingError(
            f"the network's body parts do not fit the jaws {_join(wanted)}: missing {_join(missing) or 'none'}, "
            f"unknown {_join(strange) or 'none'}; map them by BODYPART=NAME, '{IGNORED}' for what is on no jaw"
        )


def _join(names: Iterable[str]) -> str:
    return ", ".join(names)
