"""The forces on every jaw in every image of a recording, without any truth, and what the gripper feels of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce_eval.evaluation.evaluate import Estimator, check_keypoint_count, find_forces
from finforce_eval.evaluation.manipulation import with_distances
from finforce_eval.evaluation.setup import EvaluationSetup
from finforce_eval.recordings.tracks import JAWS, Recording
from finforce_eval.table import ForceSeries


class Shape(NamedTuple):
    """How a jaw stands in one image: deformed vertices (n, 3) [m], jaw frame, and their triangles (m, 3)."""

    side: str
    stamp: int
    vertices: NDArray[np.float64]
    triangles: NDArray[np.integer]


def estimate_forces(
    recording: Recording,
    setup: EvaluationSetup,
    progress: Callable[[int], Any] = lambda images: None,
    watch: Callable[[Shape], Any] | None = None,
    build: Callable[[str, bool], Estimator] | None = None,
) -> dict[str, ForceSeries]:
    """Return the forces on every jaw of a recording that has key points; an image that is refused has none.

    Args:
        recording: with key points, recorded or found.
        setup: jaw, settings, calibration and contact.
        progress: called with the number of images done since its last call.
        watch: called with the shape of the jaw after every image.
        build: gives an estimator of a side that knows nothing yet, and whether both jaws hold; new ones without.

    Raises:
        FinforceError: the key points are another jaw's, or the contact cannot be known.
    """
    for side in recording.jaws:
        check_keypoint_count(recording, side, setup.jaw)
    both = len(recording.jaws) == len(JAWS)
    found = {}
    for side in recording.jaws:
        own = setup.side(side)
        found[side] = find_forces(
            recording,
            side,
            own.jaw,
            build(side, both) if build else own.estimator(both),
            own.source(recording),
            strict=False,
            progress=progress,
            watch=None if watch is None else partial(_show, watch, side),
        )
    return with_distances(found, recording) if both else found


def _show(watch: Callable[[Shape], Any], side: str, stamp: int, estimator: Estimator) -> None:
    """Call with the shape of a jaw as it is now."""
    watch(Shape(side, stamp, np.array(estimator.surface()), np.asarray(estimator.surface_triangles)))


def reasons(forces: ForceSeries) -> list[str]:
    """Return for each image why it has no force, "" where it has one."""
    columns = zip(forces.solved, forces.column("message"), forces.column("status"), strict=True)
    return ["" if solved else str(message or status) for solved, message, status in columns]
