"""The solver tiers over recordings from a bench, as `finforce evaluate` scores them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from finforce.errors import FinforceError
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.contact_source import parse_contacts
from finforce_eval.evaluation.evaluate import evaluate_recording, score_results
from finforce_eval.evaluation.results import CaseResult
from finforce_eval.evaluation.setup import EvaluationSetup
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.jaw.jaw import load_jaw
from lab.bench.tiers import Tier

CALIBRATION = "bench"
_CONTACTS = {"height": "fixed:case", "outline": "estimate"}


@dataclass(frozen=True, kw_only=True)
class RecordedFigures:
    """One tier over all recordings of a folder.

    Attributes:
        tier: its name.
        rmse: over the record phases [N].
        bias: mean error there [N].
        lost: share of the frames there without a trusted estimate.
        p50: of the time per step [ms].
        p99: the same.
        by_recording: name -> RMSE [N].
        unsolved: recordings of which it solved no frame; they are in no figure.
    """

    tier: str
    rmse: float
    bias: float
    lost: float
    p50: float
    p99: float
    by_recording: dict[str, float]
    unsolved: tuple[str, ...]


def find_recordings(folder: Path | str) -> list[Path]:
    """Returns the recordings in a folder: its folders with a bag in them.

    Raises:
        OptionError: There are none.
    """
    folder = Path(folder)
    found = sorted(path.parent for path in folder.glob("*/metadata.yaml"))
    if not found:
        raise OptionError(f"{folder}: no recordings, expected folders with a rosbag2 each")
    return found


def measure_recordings(
    folder: Path | str, tiers: Sequence[Tier], progress: Callable[[str], object]
) -> list[RecordedFigures]:
    """Returns each tier's figures over a folder, with the calibration that is shipped for the bench finger.

    Args:
        folder: holds the recordings.
        tiers: ways to solve; those that cannot be built are left out.
        progress: called with what was done.

    Raises:
        FinforceError: A recording cannot be used.
    """
    recordings = [read_recording(path) for path in find_recordings(folder)]
    figures = []
    for tier in tiers:
        try:
            setup = _build_setup(tier)
            setup.estimator()
        except FinforceError:
            continue
        results, unsolved = [], []
        for recording in recordings:
            result = _evaluate(recording, setup)
            (unsolved if result is None else results).append(recording.name if result is None else result)
            progress(f"{tier.name}, {recording.name}")
        if results:
            figures.append(replace(_score(tier, results, recordings), unsolved=tuple(unsolved)))
    return figures


def _build_setup(tier: Tier) -> EvaluationSetup:
    return EvaluationSetup(
        jaw=load_jaw("bench"),
        settings=tier.settings(),
        calibration=load_calibration(CALIBRATION),
        contacts=parse_contacts([_CONTACTS[tier.contact]]),
        about={},
    )


def _evaluate(recording: Recording, setup: EvaluationSetup) -> CaseResult | None:
    """Returns what an estimator said of a recording; None when it solved nothing."""
    try:
        return evaluate_recording(recording, setup.jaw, setup.source(recording), factory=setup.estimator)
    except RecordingError:
        return None


def _score(tier: Tier, results: Sequence[CaseResult], recordings: Sequence[Recording]) -> RecordedFigures:
    evaluation = score_results(results, recordings)
    total = evaluation.total
    times = np.concatenate([result.step_ms[result.status == "ok"] for result in results])
    return RecordedFigures(
        tier=tier.name,
        rmse=total.all.rmse_N,
        bias=total.all.bias_N,
        lost=total.record_skipped / total.record_frames,
        p50=float(np.percentile(times, 50)),
        p99=float(np.percentile(times, 99)),
        by_recording={name: score.all.rmse_N for name, score in evaluation.scores.items()},
        unsolved=(),
    )
