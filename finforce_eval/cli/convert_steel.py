"""`finforce convert-steel`: the pictures of the measured steel finger as a recording; nothing else knows them."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.files import FileError, read_json
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.tracks import JawTrack, KeypointTrack, PhaseTrack, Recording, WrenchTrack, parse_phases
from finforce_eval.recordings.writer import write_recording

SHIPPED = Path(__file__).parents[1] / "data" / "steel" / "finray_steel_r20.json"
HALF_BASE = 36.62  # mm, half the distance of the two strips at the base
SETTLE_FRAMES, RECORD_FRAMES = 60, 30  # per level; the estimator may wait for an unloaded jaw before it starts
FRAMES_PER_LEVEL = SETTLE_FRAMES + RECORD_FRAMES
PERIOD = 33_333_333  # ns
START = 1_000_000_000_000  # ns

# The height at which the finger's shapes come closest to the pictures. No force enters it.
CONTACT_HEIGHT = 66.0  # mm

GROUND_TRUTH = "only the magnitude compares, the sensor's axes are its own: it is given along -x, without torque"


def points_from_picture(nodes: Any) -> NDArray[np.float64]:
    """Return the hinge points of one picture in the jaw frame, (8, 3) [m].

    The picture's x runs from the loaded strip to the other, its y from the base to the tip.

    Args:
        nodes: (8, 2) [mm], the loaded strip first, each from base to tip.
    """
    picture = np.asarray(nodes, dtype=np.float64)
    return 1e-3 * np.stack([HALF_BASE - picture[:, 0], np.zeros(len(picture)), picture[:, 1]], axis=1)


def recording_from_measurement(measurement: Mapping[str, Any], name: str = "steel_r20") -> Recording:
    """Return a recording in which every displacement level is held for three seconds of its picture.

    No unloaded picture exists, and none is made up.

    Args:
        measurement: `displacement_mm` (n,), `nodes` (n, 8, 2) [mm], `force` (n, 2) [N], `object`.
        name: name of the recording.

    Raises:
        RecordingError: a part is missing or has another shape.
    """
    try:
        levels = np.asarray(measurement["displacement_mm"], dtype=np.float64)
        points = np.stack([points_from_picture(nodes) for nodes in measurement["nodes"]])
        magnitude = np.linalg.norm(np.asarray(measurement["force"], dtype=np.float64), axis=1)
        diameter = 2.0 * float(measurement["object"]["radius_mm"])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise RecordingError(f"{name}: no measurement of the steel finger: {error!r}") from error
    if not len(levels) == len(points) == len(magnitude):
        counts = f"{len(levels)} displacements, {len(points)} pictures, {len(magnitude)} forces"
        raise RecordingError(f"{name}: {counts}; expected as many of each")
    stamps = START + PERIOD * np.arange(len(levels) * FRAMES_PER_LEVEL, dtype=np.int64)
    force = np.repeat(magnitude, FRAMES_PER_LEVEL)[:, None] * np.array([-1.0, 0.0, 0.0])
    keypoints = KeypointTrack(
        stamps=stamps,
        points=np.repeat(points, FRAMES_PER_LEVEL, axis=0),
        likelihood=np.ones((len(stamps), points.shape[1])),
    )
    truth = WrenchTrack(stamps=stamps, force=force, torque=np.zeros_like(force))
    case = {
        "object": {"kind": "cylinder", "diameter": diameter, "z": CONTACT_HEIGHT},
        "ground_truth": GROUND_TRUTH,
    }
    return Recording(
        name=name,
        path=Path(name),
        jaws={"left": JawTrack(keypoints=keypoints, truth=truth)},
        phases=_phases(stamps, levels, name),
        case=case,
    )


def _phases(stamps: NDArray[np.int64], levels: NDArray[np.float64], name: str) -> PhaseTrack:
    """Let every level settle, then record it."""
    begins = np.stack([stamps[::FRAMES_PER_LEVEL], stamps[SETTLE_FRAMES::FRAMES_PER_LEVEL]], axis=1)
    texts = [f"0:load:{level:g}:{stage}" for level in levels for stage in ("settle", "record")]
    return parse_phases(begins.ravel().tolist(), texts, name)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("output", metavar="FOLDER", help="recording to write, a new folder")
    parser.add_argument("--source", metavar="FILE", help="measurement (the included one)")
    parser.add_argument("--storage", default="mcap", choices=("mcap", "sqlite3"), help="format of the recording (mcap)")


def run(options: argparse.Namespace) -> None:
    """Convert the measurement and write the recording."""
    source = Path(options.source) if options.source else SHIPPED
    try:
        measurement = read_json(source)
    except FileError as error:
        raise RecordingError(f"{source}: {error}") from error
    output = Path(options.output)
    folder = write_recording(recording_from_measurement(measurement), output, storage=options.storage)
    print(f"Recording: {folder}")
    print(f"Score it with: finforce evaluate {folder} --jaw steel")
