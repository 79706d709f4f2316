"""Offsets of key points from another part of a session than the images whose forces are wanted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from finforce.errors import FinforceError
from finforce.messages import NANOSECONDS
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.tare import Tare

if TYPE_CHECKING:
    from finforce_eval.evaluation.keypoint_source import KeypointSource
    from finforce_eval.evaluation.setup import EvaluationSetup
    from finforce_ifea.estimator import ForceEstimator

SAME_MOUNT = 0.2e-3  # m; offsets of one mount differ by hundredths of a millimetre, after a camera has moved by tenths
_UNLIKE = 0.25  # share of a bend by which other loads than the average one bend a jaw in another shape
_SPARE = 15  # images beyond those of a tare, some of which may show too little


@dataclass(frozen=True, kw_only=True)
class TareSource:
    """The images of unloaded jaws: the first of an episode, or those from a time [s] of each recording on."""

    episode: int | None = None
    seconds: float = 0.0

    def __str__(self) -> str:
        return f"{self.seconds:g} s" if self.episode is None else f"episode {self.episode}"


def parse_tare_source(text: str | None) -> TareSource | None:
    """Return what `--tare-from` names: `7`, an episode, or `12.5s`; None without the option.

    Raises:
        OptionError: it is neither.
    """
    if text is None:
        return None
    try:
        source = TareSource(seconds=float(text[:-1])) if text.endswith("s") else TareSource(episode=int(text))
    except ValueError:
        source = TareSource(seconds=np.nan)
    if not (source.episode or 0) >= 0 or not 0.0 <= source.seconds < 1e6:
        raise OptionError(f"--tare-from {text}: expected the number of an episode, or seconds as 12.5s")
    return source


def borrow_tares(
    source: TareSource | None,
    recording: Recording,
    other: Recording | None,
    keypoints: KeypointSource,
    setup: EvaluationSetup,
) -> tuple[dict[str, Tare], list[str]]:
    """Return the offsets of a source by side, and how they agree with the first images of a recording.

    Args:
        source: where the jaws are unloaded; None: nothing is borrowed.
        recording: with key points, whose forces are wanted.
        other: the episode of the source, whose key points are still to be found; None where it is the recording.
        keypoints: finds them.
        setup: jaw and settings.

    Raises:
        FinforceError: the jaws are not seen unloaded there, or stand in another way in the recording.
    """
    if source is None:
        return {}, []
    if other is None:
        found = _take_tares(recording, setup, source.seconds)
    elif other.name in setup.tares:
        found = setup.tares[other.name]
    else:
        first = other.images.stamps_ns[: setup.settings.tare_frames + _SPARE]
        seen = keypoints.apply(replace(other, images=other.images.at(first)))
        found = setup.tares[other.name] = _take_tares(seen, setup, 0.0)
    notes = []
    for side, tare in found.items():
        largest = 1e3 * float(np.linalg.norm(tare.offsets, axis=1).max())
        check = _check_mount(side, tare, recording, setup, source)
        notes.append(f"{side} jaw: tare of {source}, offsets up to {largest:.2f} mm; {check}")
    return found, notes


def _take_tares(recording: Recording, setup: EvaluationSetup, start: float) -> dict[str, Tare]:
    """Return the offsets by side in the images from a time [s] on.

    Raises:
        RecordingError: they are too few, or do not show a jaw, or not unloaded.
    """
    return {side: _tared_estimator(recording, side, setup, start).offsets for side in recording.jaws}


def _tared_estimator(recording: Recording, side: str, setup: EvaluationSetup, start: float) -> ForceEstimator:
    """Return the estimator of a jaw once it has seen the images from a time [s] on; see `_take_tares`."""
    track, count = recording.jaw(side).keypoints, setup.settings.tare_frames
    rows = np.flatnonzero(track.stamps_ns >= track.stamps_ns[0] + start * NANOSECONDS)[: count + _SPARE]
    estimator = setup.side(side).estimator(len(recording.jaws) == 2)
    try:
        for row in rows.tolist():
            found = estimator.update(track.observation(row), None)
            if estimator.tared:
                return estimator
            if found.status == "waiting" and row == rows[-1]:
                raise RecordingError(f"{recording.name}: {len(rows)} images from {start:g} s on, {found.message}")
        estimator.tare()
    except FinforceError as error:
        raise RecordingError(f"{recording.name}: {side} jaw, from {start:g} s on: {error}") from error
    return estimator


def _check_mount(side: str, tare: Tare, recording: Recording, setup: EvaluationSetup, source: TareSource) -> str:
    """Return how offsets agree with those of a recording's own first images.

    Raises:
        RecordingError: the jaw, or the camera, is mounted in another way.
    """
    try:
        change = _tared_estimator(recording, side, setup, 0.0).compare_offsets(tare)
    except FinforceError as error:
        return f"not compared with the first images: {error}"
    if change.shift > max(SAME_MOUNT, _UNLIKE * change.bend):
        raise RecordingError(
            f"{recording.name}: the {side} jaw's key points are {1e3 * change.shift:.2f} mm from where {source} has "
            f"them, beyond what a load explains; expected {1e3 * SAME_MOUNT:g} mm at most, as with one mount"
        )
    if change.bend > SAME_MOUNT:
        return f"loaded from the start, bent by {1e3 * change.bend:.2f} mm"
    return f"{1e3 * np.hypot(*change):.3f} mm from those of the first images"
