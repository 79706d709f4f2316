"""Grasps whose object is tracked slowly, late, or not at all: the paper's tracker gives ten poses a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from finforce_eval.errors import OptionError
from finforce_eval.evaluation.batch import evaluate_all
from finforce_eval.evaluation.contact_source import ContactChoice
from finforce_eval.recordings.tracks import Recording
from lab.experiments.experiment import Case, Experiment, RunOptions, average, build_setup, keep_poses
from lab.experiments.grasp import find_phases, join_jaws, list_grasps, score_grasp, with_displacement
from lab.harness import Figures

TRACKED = 30.0  # [Hz] at which the twin measures poses; lower rates leave some out
RATES = (30.0, 10.0, 3.0)  # [Hz]
DELAYS = (0.0, 0.100, 0.250)  # [s]
HIDDEN = "10 Hz, hidden while held"


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the grasps of medium force."""
    if options.bags:
        raise OptionError("--on BAG: this experiment changes the rate of the object's poses; expected twin")
    return list_grasps(options, ("medium",), tracking=TRACKED)


def thin_poses(recording: Recording, rate: float) -> Recording:
    """Return a recording with poses of the object at a rate [Hz]."""
    stamps = recording.object_pose.stamps_ns
    period = np.floor(1e-9 * (stamps - stamps[0]) * rate + 1e-3).astype(int)
    return keep_poses(recording, np.diff(period, prepend=-1) > 0)


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the figures of a grasp under each condition."""
    found = {}
    with options.open_case(with_displacement(case), folder) as recording:
        seen = {(f"{rate:g} Hz", delay): thin_poses(recording, rate) for rate, delay in product(RATES, DELAYS)}
        usual = seen["10 Hz", 0.0]
        for (poses, delay), one in seen.items():
            found[f"{poses}, {1e3 * delay:.0f} ms"] = _score(one, case, delay)
        grasp = join_jaws(evaluate_all([usual], build_setup(case.settings)), recording.name)
        loading = np.flatnonzero(find_phases(grasp)["load"])
        full = int(grasp.stamp.iloc[loading[-1] if loading.size else -1])
        found[HIDDEN] = _score(keep_poses(usual, usual.object_pose.stamps_ns < full), case, 0.0)
    return {"poses": found}


def _score(recording: Recording, case: Case, delay: float) -> dict[str, Any]:
    setup = build_setup(case.settings, ContactChoice(mode="estimate", pose_delay=round(1e9 * delay)))
    return score_grasp(join_jaws(evaluate_all([recording], setup), recording.name))


COLUMNS = {
    "rmse_N all": "RMSE/N",
    "rmse_N load": "load: RMSE/N",
    "rmse_N hold": "hold: RMSE/N",
    "answered_pct": "answered/%",
    "within_3_sigma_pct": "within 3σ/%",
}


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return errors by condition."""
    rows = [{"poses": poses, **score} for row in figures.values() for poses, score in row["poses"].items()]
    table = average(pd.json_normalize(rows, sep=" "), ("poses",), COLUMNS)
    note = "Mean and standard deviation over the grasps of each one's RMSE while the true force is above 0.02 N."
    return Figures(tables={"poses": table}, notes=[note])


POSE = Experiment(
    name="pose",
    title="Poses of the object: slow, late, hidden",
    about=(
        "The paper takes the object's pose from FoundationPose at 10 Hz, and hides the object from it once it is held. "
        "Here the grasps of medium force of `grasp` get poses with 0.3 mm and 0.3° of noise at 30, 10 and 3 Hz, each "
        "0, 100 and 250 ms after its image, and none from full force on. The key points are the same in all of them."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
