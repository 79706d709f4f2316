"""What an estimator said about a recording, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_eval.evaluation.delay_scoring import Delay, onset_delays
from finforce_eval.evaluation.sight_scoring import SightSeries


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """The jaw at one instant; all points in the jaw frame [m].

    Attributes:
        stamp: image time [ns].
        surface0: (n, 3) undeformed vertices.
        surface: (n, 3) deformed vertices.
        triangles: (t, 3) vertex indices.
        keypoints0: (K, 3) undeformed key points.
        keypoints: (K, 3) key points as seen, NaN = none.
        used: (K,) key points that the estimator used.
        contact_point: (3,) on the deformed surface.
        force: (3,) [N] on the jaw.
        outline: of the object, polygons (n, 2) of x and z; none where it is not known.
    """

    stamp: int
    surface0: NDArray[np.float64]
    surface: NDArray[np.float64]
    triangles: NDArray[np.integer]
    keypoints0: NDArray[np.float64]
    keypoints: NDArray[np.float64]
    used: NDArray[np.bool_]
    contact_point: NDArray[np.float64]
    force: NDArray[np.float64]
    outline: tuple[NDArray[np.float64], ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactSeries:
    """Where the object was said to touch one jaw, image by image; n frames, heights on the undeformed surface.

    Attributes:
        source: what said it.
        given: (n,) weighted mean height of the contact that the image was solved with, live of the one that was
            published for it [m], NaN = none.
        truth: (n,) height of the pressure centre of the measured force [m], NaN where it is not known.
        touching: (n,) whether object and jaw were said to touch once the image was solved; None when nobody says.
        status: (n,) the contact estimator's own word, "" for a contact that was given.
        step_ms: (n,) wall time of the contact estimator [ms]; NaN for a contact that was given.
    """

    source: str
    given: NDArray[np.float64]
    truth: NDArray[np.float64]
    touching: NDArray[np.bool_] | None
    status: NDArray[np.str_]
    step_ms: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class CaseResult:
    """The time series of one jaw of one recording; n frames, K key points.

    Attributes:
        name: name of the case.
        side: "left" or "right".
        stamps: (n,) image time [ns].
        truth: (n, 3) true force on the jaw [N], NaN where it was not measured.
        force: (n, 3) estimate [N], NaN where the estimator did not trust it.
        stddev: (n,) standard deviation of the magnitude [N].
        place: (n, 3) contact place on the undeformed surface [m].
        residual: (n,) weighted rms of the key points used [m].
        used: (n, K) key points used.
        status: (n,) the estimator's own word.
        step_ms: (n,) wall time of the step [ms]; NaN where nothing came back.
        cycle: (n,) loading cycle, 0 without phases.
        direction: (n,) "load", "unload", or "" without phases.
        scored: (n,) in a `record` phase; every frame without phases.
        snapshot: the jaw at the largest trusted force of a scored frame; None when there was none.
        message: the estimator's last words on a frame that it did not solve.
        contact: where the object was said to touch; None when it does not travel.
        sight: the key points that were found against the true ones; None where nothing says where they truly were.
        detector_ms: (n,) wall time from image to key points [ms], NaN where it was not timed; None without a detector.
        latency_ms: (n,) from what the call began with, images or key points, to the force [ms]; None for `step_ms`.
    """

    name: str
    side: str
    stamps: NDArray[np.int64]
    truth: NDArray[np.float64]
    force: NDArray[np.float64]
    stddev: NDArray[np.float64]
    place: NDArray[np.float64]
    residual: NDArray[np.float64]
    used: NDArray[np.bool_]
    status: NDArray[np.str_]
    step_ms: NDArray[np.float64]
    cycle: NDArray[np.int64]
    direction: NDArray[np.str_]
    scored: NDArray[np.bool_]
    snapshot: Snapshot | None = None
    message: str = ""
    contact: ContactSeries | None = None
    sight: SightSeries | None = None
    detector_ms: NDArray[np.float64] | None = None
    latency_ms: NDArray[np.float64] | None = None

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time since the first frame (n,) [s]."""
        return (self.stamps - self.stamps[0]) * 1e-9

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Frames with a trusted estimate (n,)."""
        return np.isfinite(self.force).all(axis=1)

    @property
    def magnitude(self) -> NDArray[np.float64]:
        """Norm of the estimate (n,) [N]."""
        return np.linalg.norm(self.force, axis=1)

    @property
    def true_magnitude(self) -> NDArray[np.float64]:
        """Norm of the true force (n,) [N]."""
        return np.linalg.norm(self.truth, axis=1)

    @property
    def error(self) -> NDArray[np.float64]:
        """Norm of the estimate minus norm of the truth (n,) [N]; NaN where either is missing."""
        return self.magnitude - self.true_magnitude

    @property
    def delays(self) -> list[Delay]:
        """What the estimate took to show after each onset of the true force."""
        lag = 1e-3 * (self.step_ms if self.latency_ms is None else self.latency_ms)
        return onset_delays(self.stamps * 1e-9, self.true_magnitude, self.magnitude, lag)

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Frames that enter the score (n,): scored, solved, and with a truth."""
        return self.scored & np.isfinite(self.error)
