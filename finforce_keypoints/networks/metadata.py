"""The `pytorch_config.yaml` beside a DeepLabCut network, and which heatmap is which key point of which jaw."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AliasPath, BeforeValidator, ConfigDict, Field, StrictBool, field_validator, model_validator

from finforce.files import FileError, read_yaml
from finforce.typed_yaml import FileModel, Number, describe, parse_model
from finforce_ifea.jaw.jaw import Jaw
from finforce_keypoints.errors import ModelError, NamingError
from finforce_keypoints.networks.runtime import LARGEST_SIDE
from finforce_keypoints.parameters import REFERENCE

METADATA_FILE = "pytorch_config.yaml"
LOCREF_STD = 7.2801  # DeepLabCut's default scale of its offset channels [px]
_PREDICTOR = "HeatmapPredictor"
Side = Annotated[int, Field(strict=True, ge=1, le=LARGEST_SIDE)]


class TrainingSize(FileModel):
    """The size of the training images."""

    height: Side = Field(description="[px]")
    width: Side = Field(description="[px]")


class OwnSection(FileModel):
    """The section of this package in a configuration; no other keys."""

    training_size: TrainingSize | None = Field(None, description="Size of the training images")
    pooled: StrictBool = Field(False, description="Whether the offsets around a peak are averaged")
    likelihood_stddev: tuple[tuple[Number, Number], ...] | None = Field(
        None, min_length=1, description="Rows of likelihood [-] and its standard deviation [px]"
    )
    plane: dict[str, Any] | None = Field(None, description="Grid of a network of side planes, see PlaneGrid")
    network: dict[str, Any] | None = Field(None, description="Shape of the network, for people")

    @field_validator("likelihood_stddev")
    @classmethod
    def _check_rows(cls, rows: tuple | None) -> tuple | None:
        likelihood, stddev = np.array(rows or [(0.0, 1.0)]).T
        if (np.diff(likelihood) <= 0.0).any() or likelihood[0] < 0.0 or likelihood[-1] > 1.0 or (stddev <= 0.0).any():
            raise ValueError(
                f"got {describe(rows)}, expected likelihoods that rise from 0 to 1 and positive standard deviations "
                "[px]"
            )
        return rows


def _key(path: str, default: Any, description: str, **bounds: Any) -> Any:
    """Return the field of a value that stands at a path of keys in DeepLabCut's file."""
    return Field(default, validation_alias=AliasPath(*path.split(".")), description=description, **bounds)


_HEAD, _PADDING = "model.heads.bodypart", "data.inference.auto_padding"
Colours = Annotated[Literal["RGB", "BGR"], BeforeValidator(lambda word: str(word).upper())]
Strides = tuple[Annotated[Number, Field(gt=1e-3, lt=1e3)], ...]


class ModelMetadata(FileModel):
    """The keys read of a DeepLabCut configuration; an empty value stands for its default."""

    model_config = ConfigDict(extra="ignore")

    bodyparts: tuple[str, ...] = _key("metadata.bodyparts", ..., "Names in the order of the heatmaps", min_length=1)
    method: str = _key("method", "bu", "Whether the network sees whole images, bu, or what a detector cuts out, td")
    resize: dict | bool | None = _key("data.inference.resize", None, "Size that images are scaled to, not followed")
    longest_max_size: int | None = _key("data.inference.longest_max_size", None, "Likewise, of the longer side [px]")
    scale_to_unit_range: StrictBool | None = _key(
        "data.inference.scale_to_unit_range", None, "Whether colours go to 1, as here without normalize_images"
    )
    individuals: tuple[str, ...] = _key("metadata.individuals", (), "Names of the animals")
    colormode: Colours = _key("data.colormode", "RGB", "Order of the colours that the network was trained on")
    normalize_images: StrictBool = _key("data.inference.normalize_images", True, "Whether ImageNet's mean is removed")
    pad_height_divisor: Side = _key(f"{_PADDING}.pad_height_divisor", 1, "Heights are padded to its multiples [px]")
    pad_width_divisor: Side = _key(f"{_PADDING}.pad_width_divisor", 1, "Widths are padded to its multiples [px]")
    type: str = _key(f"{_HEAD}.predictor.type", _PREDICTOR, "Kind of decoding")
    apply_sigmoid: StrictBool = _key(f"{_HEAD}.predictor.apply_sigmoid", False, "Whether scores are logits")
    location_refinement: StrictBool = _key(f"{_HEAD}.predictor.location_refinement", True, "Whether offsets are used")
    locref_std: Number = _key(f"{_HEAD}.predictor.locref_std", LOCREF_STD, "Scale of the offsets [px]", gt=0.0, lt=1e30)
    locref_config: dict | None = _key(f"{_HEAD}.locref_config", None, "Layers of the offsets, where there are any")
    strides: Strides = _key(f"{_HEAD}.heatmap_config.strides", (), "Of the layers of the heatmaps [-]")
    output_stride: Number | None = _key(
        "model.backbone.output_stride", None, "Input pixels per cell of the backbone's maps", gt=0.0, lt=1e30
    )
    finforce: OwnSection = Field(OwnSection(), description="What this package keeps")

    @model_validator(mode="before")
    @classmethod
    def _check_tables(cls, values: Any) -> Any:
        """Leave out what is empty, and refuse what should be a table and is none."""
        if not isinstance(values, Mapping):
            raise ValueError(f"got {describe(values)}, expected a mapping of data, metadata, model and finforce")
        values = _drop_empty(values)
        for entry in cls.model_fields.values():
            part, path = values, entry.validation_alias.path if entry.validation_alias else []
            for number, key in enumerate(path):
                if not isinstance(part, Mapping):
                    raise ValueError(f"{'.'.join(path[:number])}: got {describe(part)}, expected a mapping")
                part = part.get(key, {})
        return values

    @field_validator("type")
    @classmethod
    def _check_type(cls, kind: str) -> str:
        if kind != _PREDICTOR:
            raise ValueError(
                f"got {kind}, expected {_PREDICTOR}; train a single-animal network with heatmaps (resnet_50, "
                "hrnet_w18, hrnet_w32), RTMPose's SimCC and multi-animal heads are not decoded"
            )
        return kind

    @field_validator("bodyparts")
    @classmethod
    def _check_names(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if not all(name.strip() and name.isprintable() for name in names):
            raise ValueError(f"got {describe(names)}, expected the list of the body parts' names")
        doubled = sorted(name for name, count in Counter(names).items() if count > 1)
        if doubled:
            raise ValueError(f"{', '.join(doubled)} more than once, expected each name once")
        return names

    @field_validator("individuals")
    @classmethod
    def _check_one(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(names) > 1:
            raise ValueError(f"got {len(names)}, expected one; name the points of the two jaws left_... and right_...")
        return names

    @model_validator(mode="after")
    def _check_inference(self) -> ModelMetadata:
        """Refuse what a network is given in DeepLabCut and would not be given here."""
        if self.method.lower() == "td":
            raise ValueError("method: got td, whose network sees what a detector cuts out; expected bu, whole images")
        if self.resize or self.longest_max_size:
            raise ValueError(
                "data.inference: images are not scaled as by resize or longest_max_size; train on the camera's size "
                "without them, or set finforce.training_size and allow_resize"
            )
        if self.scale_to_unit_range is not None and self.scale_to_unit_range == self.normalize_images:
            raise ValueError(
                f"data.inference: got scale_to_unit_range and normalize_images both {self.normalize_images}; expected "
                "one of them"
            )
        return self

    @property
    def stride(self) -> float | None:
        """Input pixels per heatmap cell, None where the file does not tell."""
        return None if self.output_stride is None else self.output_stride / prod(self.strides)

    @property
    def divisors(self) -> tuple[int, int]:
        """Height and width are padded to multiples of these [px]; (1, 1) for none."""
        return self.pad_height_divisor, self.pad_width_divisor

    @property
    def training_size(self) -> tuple[int, int] | None:
        """Height and width of the training images [px], None if not kept."""
        size = self.finforce.training_size
        return None if size is None else (size.height, size.width)


def _drop_empty(values: Any) -> Any:
    """Return nested mappings without the keys that have no value."""
    if not isinstance(values, Mapping):
        return values
    return {key: _drop_empty(value) for key, value in values.items() if value is not None}


def read_metadata(path: str | Path) -> ModelMetadata:
    """Return what a `pytorch_config.yaml` says.

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
        return parse_model(content, ModelMetadata, ModelError)
    except ModelError as error:
        raise ModelError(f"{path.name}: {error}") from error


IGNORED = "-"  # what a body part is mapped to that belongs to no jaw


@dataclass(frozen=True, kw_only=True, eq=False)
class NameMap:
    """Indices of each jaw's points among the body parts of a network.

    Attributes:
        rows: side -> (K + 1,) numbers of the body parts: the key points in the order of the jaw file, the reference
            point last.
        is_of_one_jaw: True if the network knows one jaw and is used on each of them in turn.
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
