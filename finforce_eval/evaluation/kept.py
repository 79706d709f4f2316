"""Recordings and their results in a file: names and numbers as JSON, arrays beside them, nothing that is executed."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.errors import one_line
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.results import CaseResult, ContactSeries, DetectionErrors, Snapshot
from finforce_eval.recordings.images import ImageTrack
from finforce_eval.recordings.tracks import (
    DetectionTrack,
    DetectionTruth,
    JawTrack,
    KeypointTrack,
    PhaseTrack,
    PoseTrack,
    Recording,
    WrenchTrack,
)


@dataclass(frozen=True, kw_only=True)
class Kept:
    """What an evaluation made of one recording.

    Attributes:
        recording: with the key points that were evaluated; its images stay in the bag.
        results: of each jaw with ground truth.
        about: what was run: solver, jaw, contact, ...
        keypoint_names: K names of the key points of the jaw.
    """

    recording: Recording
    results: tuple[CaseResult, ...]
    about: Mapping[str, str]
    keypoint_names: tuple[str, ...]


_RECORDS = {
    record.__name__: record
    for record in (
        Kept, Recording, JawTrack, KeypointTrack, WrenchTrack, PoseTrack, PhaseTrack, DetectionTruth, DetectionTrack,
        ImageTrack, CameraIntrinsics, CaseResult, ContactSeries, DetectionErrors, Snapshot,
    )
}  # fmt: skip
_ENDING, _TREE = ".npz", "tree"


def save_kept(path: Path, kept: Kept) -> None:
    """Write a file that is whole or not there.

    Raises:
        OSError: it cannot be written.
    """
    if kept.recording.copy is not None:  # which goes with this process, and its images with it
        kept = replace(kept, recording=replace(kept.recording, copy=None, images=None))
    arrays: dict[str, NDArray] = {}
    tree = json.dumps(_pack(kept, arrays))
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            np.savez(file, **{_TREE: np.array(tree)}, **arrays)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def load_kept(path: Path) -> Kept:
    """Return what `save_kept` wrote.

    Raises:
        RecordingError: the file is damaged, or another program's.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            kept = _unpack(json.loads(str(stored[_TREE])), stored)
    except Exception as error:  # numpy, zip and their decompressors each have their own classes
        raise RecordingError(f"{path}: {one_line(error)}; expected what finforce evaluate keeps") from error
    if not isinstance(kept, Kept):
        raise RecordingError(f"{path}: expected what finforce evaluate keeps")
    return kept


def _pack(value: Any, arrays: dict[str, NDArray]) -> Any:
    """Return a value as JSON has it; arrays go into `arrays`, under names that stand in their places."""
    if isinstance(value, np.ndarray):
        if value.dtype == object:
            raise TypeError(f"an array of objects cannot be kept: {value.ravel()[:3]}")
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if is_dataclass(value):
        content = {each.name: _pack(getattr(value, each.name), arrays) for each in fields(value)}
        return {"record": type(value).__name__, "fields": content}
    if isinstance(value, Mapping):
        return {"map": {name: _pack(each, arrays) for name, each in value.items()}}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_pack(each, arrays) for each in value]}
    if isinstance(value, Path):
        return {"path": str(value)}
    return value.item() if isinstance(value, np.generic) else value


def _unpack(value: Any, arrays: Mapping[str, NDArray]) -> Any:
    """Return what `_pack` was given."""
    if not isinstance(value, dict):
        return value
    if "record" in value:
        content = {name: _unpack(each, arrays) for name, each in value["fields"].items()}
        return _RECORDS[value["record"]](**content)
    ((kind, content),) = value.items()
    if kind == "array":
        return arrays[content]
    if kind == "map":
        return {name: _unpack(each, arrays) for name, each in content.items()}
    if kind == "path":
        return Path(content)
    return {"list": list, "tuple": tuple}[kind](_unpack(each, arrays) for each in content)
