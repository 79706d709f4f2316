"""Forces that a recording holds already, as `annotate` or the nodes put them there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.scoring import match_samples, match_truth
from finforce_eval.recordings.bags import bag_source, check_types, open_bag
from finforce_eval.recordings.recording import WRENCH
from finforce_eval.recordings.tracks import JAWS, WrenchTrack
from finforce_eval.table import ForceSeries

STATUS = "diagnostic_msgs/msg/DiagnosticArray"
_FORCE, _STDDEV, _STATUS, _TRUTH = KINDS = ("wrench", "wrench_stddev", "wrench_status", "ground_truth_wrench")


def read_forces(path: Path) -> list[ForceSeries]:
    """Return the forces on the jaws of a recording.

    Args:
        path: rosbag2 folder, .mcap or .db3 file.

    Raises:
        RecordingError: it cannot be read, or holds no forces.
    """
    source = bag_source(path)
    types = {f"/{side}/{kind}": (STATUS if kind == _STATUS else WRENCH,) for side in JAWS for kind in KINDS}
    samples: dict[str, list[Any]] = {}
    with open_bag(source, path.stem) as bag:
        check_types(bag.connections, types, path.stem)
        for sample in bag.raw(types):
            samples.setdefault(sample.topic, []).append(bag.decode(sample))
    sides = [side for side in JAWS if f"/{side}/{_FORCE}" in samples]
    if not sides:
        raise RecordingError(f"{path.stem}: no forces: /left/wrench and /right/wrench have no messages; see annotate")
    return [_make_series(f"{path.stem}/{side}" if len(sides) > 1 else path.stem, side, samples) for side in sides]


def _make_series(name: str, side: str, samples: Mapping[str, list[Any]]) -> ForceSeries:
    """Return the series of one jaw."""
    found, stated, true = (_stack(samples.get(f"/{side}/{kind}", [])) for kind in (_FORCE, _STDDEV, _TRUTH))
    stddev = match_samples(stated.stamps, stated.force, found.stamps) if len(stated.stamps) else np.nan
    magnitude = np.linalg.norm(found.force, axis=1)
    with np.errstate(invalid="ignore"):
        direction = found.force / np.maximum(magnitude, 1e-9)[:, None]
    along = np.sqrt(np.sum((direction * stddev) ** 2, axis=1))
    words = {_stamp(each): each.status[0].values[0].value for each in samples.get(f"/{side}/{_STATUS}", [])}
    status = [words.get(stamp, "") for stamp in found.stamps.tolist()]
    return ForceSeries.build(
        name,
        side,
        found.stamps,
        force=found.force,
        torque=found.torque,
        magnitude_stddev=along,
        true_force=match_truth(true, found.stamps) if len(true.stamps) else None,
        status=np.array(status, dtype="U32"),
    )


def _stack(messages: list[Any]) -> WrenchTrack:
    """Return wrenches as arrays, in the order of their stamps."""
    rows = sorted((_stamp(each), *_vector(each.wrench.force), *_vector(each.wrench.torque)) for each in messages)
    values: NDArray[np.float64] = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 6)
    stamps = np.array([row[0] for row in rows], dtype=np.int64)
    return WrenchTrack(stamps=stamps, force=values[:, :3], torque=values[:, 3:])


def _stamp(message: Any) -> int:
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def _vector(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z
