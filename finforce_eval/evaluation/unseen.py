"""Reasons why the jaws of a rig are not seen where it has them, in the images of a recording."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from finforce.gripper_frames import OpeningRange
from finforce.messages import NANOSECONDS
from finforce_eval.evaluation.forces import NOT_FOUND
from finforce_eval.evaluation.keypoint_source import KeypointSource, build_records, choose_images, spread
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import ForceSeries
from finforce_keypoints.build import ANY_FINGER
from finforce_keypoints.detectors.side_plane import AnyFinger
from finforce_keypoints.networks.side_network import SideNetwork
from finforce_keypoints.parameters import NO_DEPTH, find_mounts, load_jaws
from finforce_keypoints.picture_change import PictureChanges

PICTURES = 8  # that are looked at
LONG = 1.0  # [s] of images without a force in a row, in which something may be wrong with them
# Statuses of too few key points, and of those that may be no jaw's.
UNSEEN = ("not_enough_points", NOT_FOUND)
USELESS = (*UNSEEN, "unobservable", "diverged")


def explain_unseen(
    recording: Recording, source: KeypointSource, stamps: NDArray[np.int64] | None = None, pictures: int = PICTURES
) -> list[str]:
    """Return what was done to the images of a recording, or some of them [ns], as a sentence, if anything is known.

    Args:
        recording: with images.
        source: the detector's parameters.
        stamps: of the images [ns]; None: all.
        pictures: that are looked at; of jaws and cameras at rest STEADY say as much as more.

    Raises:
        FinforceError: an image is damaged.
    """
    parameters, settings, _ = build_records(source.node_parameters(recording))
    images, jaws = choose_images(recording, NO_DEPTH), load_jaws(parameters)
    stamps = images.stamps_ns if stamps is None else stamps
    mounts = find_mounts(parameters, jaws)
    changes = PictureChanges(
        images.camera,
        parameters.camera_pose,
        jaws,
        mounts,
        OpeningRange(nearest=settings.opening_min, farthest=settings.opening_max),
        AnyFinger(SideNetwork(ANY_FINGER, threads=parameters.threads), jaws, mounts),
    )
    said = changes.explain([image.color for _, image in images.at(spread(stamps, pictures))])
    return [said] if said else []


def describe_unseen(recording: Recording, source: KeypointSource, jaws: Mapping[str, ForceSeries]) -> list[str]:
    """Return why key points found in images were of no use for longest, and when, in a sentence; empty if nobody knows.

    Args:
        recording: with the key points that a detector found; there is nothing to say of others.
        source: of these.
        jaws: forces by side.
    """
    if any(track.detection is None for track in recording.jaws.values()):
        return []
    for statuses in (UNSEEN, USELESS):
        runs = {
            side: _longest_run(forces.stamps_ns, np.isin(forces.column("status"), statuses))
            for side, forces in jaws.items()
        }
        side = max(runs, key=lambda side: np.ptp(runs[side]))
        if np.ptp(runs[side]) < LONG * NANOSECONDS:
            continue
        stamps = recording.images.stamps_ns
        why = explain_unseen(recording, source, stamps[(stamps >= runs[side][0]) & (stamps <= runs[side][1])])
        if why:
            begin, end = 1e-9 * (runs[side] - stamps[0])
            return [f"{side} jaw, {begin:.1f} to {end:.1f} s: {why[0]}"]
    return []


def _longest_run(stamps: NDArray[np.int64], chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the first and the last stamp (2,) of the longest time in which all images (n,) are chosen; 0 without."""
    edges = np.diff(np.r_[False, chosen, False].astype(int))
    runs = stamps[np.column_stack((np.flatnonzero(edges > 0), np.flatnonzero(edges < 0) - 1))]
    return max(runs, key=np.ptp, default=np.zeros(2, dtype=np.int64))
