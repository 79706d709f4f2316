"""First grasps of rough objects: 27 without friction, and with it, with and without a short way back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from finforce_eval.errors import OptionError
from finforce_eval.evaluation.batch import evaluate_all
from lab.experiments.experiment import Case, Experiment, RunOptions, average, build_setup, tabulate
from lab.experiments.grasp import join_jaws, list_grasps, score_grasp, with_displacement
from lab.harness import Figures

ROUGH = 0.5  # [-], coefficient of friction
WAYS = {"frictionless": (0.0, False), "friction 0.5": (ROUGH, False), "friction 0.5, probed": (ROUGH, True)}
BACK = 0.3  # [-], way back of the probe by the displacement: it keeps 40 % of the force at half of it, as the driver's
FARTHEST = 1e-3  # [m] of each jaw, that of the driver at a `grasp.probe` of 2 mm


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the grasps, each of a new object."""
    if options.bags:
        raise OptionError("--on BAG: this experiment changes the object's friction; expected twin")
    cases = []
    for way, (roughness, is_probed) in WAYS.items():
        for case in list_grasps(options, roughness=roughness):
            words = case.settings["words"] | {"contact": way, "is_probed": is_probed}
            cases.append(replace(case, name=f"{case.name} {way}", settings={**case.settings, "words": words}))
    return cases


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the figures of a grasp."""
    case = with_displacement(case)
    if case.settings["words"]["is_probed"]:
        changes = case.settings["changes"]
        probe = min(BACK * changes["displacement"], FARTHEST)
        case = replace(case, settings={**case.settings, "changes": {**changes, "probe": probe}})
    with options.open_case(case, folder) as recording:
        return score_grasp(join_jaws(evaluate_all([recording], build_setup(case.settings)), recording.name))


COLUMNS = {
    "peak_N": "peak/N",
    "rmse_N all": "RMSE/N",
    "rmse_N load": "load: RMSE/N",
    "rmse_N hold": "hold: RMSE/N",
    "bias_N": "bias/N",
    "max_error_N": "largest/N",
    "answered_pct": "answered/%",
    "within_3_sigma_pct": "within 3σ/%",
}


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return errors by contact."""
    grasps = tabulate(figures)
    each = grasps[["case", *COLUMNS]].rename(columns={"case": "grasp", **COLUMNS})
    note = (
        "Mean and standard deviation over the grasps of each one's RMSE of min(|F_left|, |F_right|) while the true "
        "force is above 0.02 N. Every estimator is new: it has seen no other grasp."
    )
    return Figures(tables={"contacts": average(grasps, ("contact",), COLUMNS), "Each grasp": each}, notes=[note])


FRICTION = Experiment(
    name="friction",
    title="First grasps of rough objects",
    about=(
        "The objects, heights and forces of `grasp`, with Coulomb friction between fingers and object as they close "
        "and open. Something else keeps the object's height, as a table does. The probe is the driver's: at half of "
        "the way each jaw goes back by up to 1 mm and keeps at least about 40 % of its force, then closes on. The "
        "estimator is not told that there is friction, nor how much."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
