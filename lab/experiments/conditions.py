"""The paper's grasps under other conditions: of rough objects, and of objects whose poses come slowly or late."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
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
from lab.experiments.grasp import join_jaws, list_grasps, score_grasp, with_displacement
from lab.harness import Figures

CONTACTS = {"frictionless": (0.0, 0.0), "friction 0.5": (0.5, 0.0), "friction 0.5, probed": (0.5, 1e-3)}  # [-, m]
BACK = 0.3  # [-], way back of the probe by the displacement, at most: it keeps 40 % of the force, as the driver's
TRACKED = 30.0  # [Hz] at which the twin measures poses; lower rates leave some out
RATES, DELAYS = (30.0, 10.0, 3.0), (0.0, 0.100, 0.250)  # [Hz], [s]
COLUMNS = {
    "rmse_N all": "RMSE/N",
    "rmse_N load": "load: RMSE/N",
    "rmse_N hold": "hold: RMSE/N",
    "bias_N": "bias/N",
    "max_error_N": "largest/N",
    "answered_pct": "answered/%",
    "within_3_sigma_pct": "within 3σ/%",
}


def list_first_grasps(options: RunOptions) -> Sequence[Case]:
    """Return every grasp of a new object, with each contact."""
    _refuse_bags(options)
    return [
        replace(case, name=f"{case.name} {contact}", settings={**case.settings, "contact": contact})
        for contact, (roughness, _) in CONTACTS.items()
        for case in list_grasps(options, roughness=roughness)
    ]


def list_tracked_grasps(options: RunOptions) -> Sequence[Case]:
    """Return the grasps of medium force."""
    _refuse_bags(options)
    return list_grasps(options, ("medium",), tracking=TRACKED)


def _refuse_bags(options: RunOptions) -> None:
    if options.bags:
        raise OptionError("--on BAG: this experiment changes friction or poses of the twin; expected twin")


def run_first_grasp(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the figures of a first grasp."""
    settings = with_displacement(case).settings
    probe = min(CONTACTS[settings["contact"]][1], BACK * settings["changes"]["displacement"])
    probed = replace(case, settings={**settings, "changes": {**settings["changes"], "probe": probe}})
    with options.open_case(probed, folder) as recording:
        return {"conditions": {settings["contact"]: _score(recording, case)}}


def run_tracked_grasp(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the figures of a grasp at each rate and delay of the poses."""
    with options.open_case(with_displacement(case), folder) as recording:
        return {
            "conditions": {
                f"{rate:g} Hz, {1e3 * delay:g} ms late": _score(thin_poses(recording, rate), case, delay)
                for rate, delay in product(RATES, DELAYS)
            }
        }


def thin_poses(recording: Recording, rate: float) -> Recording:
    """Return a recording with poses of the object at a rate [Hz]."""
    stamps = recording.object_pose.stamps_ns
    period = np.floor(1e-9 * (stamps - stamps[0]) * rate + 1e-3).astype(int)
    return keep_poses(recording, np.diff(period, prepend=-1) > 0)


def _score(recording: Recording, case: Case, delay: float = 0.0) -> dict[str, Any]:
    setup = build_setup(case.settings, ContactChoice(mode="estimate", pose_delay=round(1e9 * delay)))
    return score_grasp(join_jaws(evaluate_all([recording], setup), recording.name))


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return errors by condition."""
    rows = [{"condition": name, **score} for row in figures.values() for name, score in row["conditions"].items()]
    table = average(pd.json_normalize(rows, sep=" "), ("condition",), COLUMNS)
    note = "Mean and standard deviation over the grasps of each one's RMSE while the true force is above 0.02 N."
    return Figures(tables={"conditions": table}, notes=[note])


FRICTION = Experiment(
    name="friction",
    title="First grasps of rough objects",
    about=(
        "The grasps of `grasp`, with Coulomb friction between fingers and object, whose height a table keeps. Probed: "
        "at half of the way each jaw goes back by up to 1 mm, keeps at least about 40 % of its force, and closes on. "
        "Each estimator is new, and is not told that there is friction."
    ),
    list_cases=list_first_grasps,
    run=run_first_grasp,
    find=find,
)
POSE = Experiment(
    name="pose",
    title="Slow and late poses of the object",
    about=(
        "The paper tracks the object at 10 Hz. Here the grasps of medium force of `grasp` get poses at 30, 10 and 3 "
        "Hz, 0, 100 and 250 ms after their images, with the same key points."
    ),
    list_cases=list_tracked_grasps,
    run=run_tracked_grasp,
    find=find,
)
