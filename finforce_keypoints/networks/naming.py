"""Which heatmap is which key point of which jaw."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.jaw.jaw import Jaw
from finforce_keypoints.errors import NamingError
from finforce_keypoints.pixel_finder import REFERENCE

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
