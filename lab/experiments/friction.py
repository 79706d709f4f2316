"""The paper's grasps of rough objects, each the first one of its object, with and without a probe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from finforce_eval.errors import OptionError
from finforce_ifea.settings import EstimatorSettings
from lab.experiments.experiment import Case, Experiment, RunOptions, tabulate
from lab.experiments.grasp import ERRORS, LEVELS, average_by_force, list_grasps, score_recording, with_displacement
from lab.harness import Figures

ROUGHNESS = 0.5  # [-], coefficient of friction
CONDITIONS = {"unprobed": (0.0, tuple(LEVELS)), "probed": (1e-3, ("medium",))}  # probe [m], levels of force
BACK = 0.3  # [-], way back of the probe by the displacement, at most: it keeps 40 % of the force, as the driver's


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the grasps of rough objects in each condition."""
    if options.bags:
        raise OptionError("--on BAG: this experiment changes the friction of the twin; expected twin")
    cases = []
    for condition, (probe, levels) in CONDITIONS.items():
        chosen = tuple(LEVELS) if options.quick else levels
        for case in list_grasps(options, chosen, roughness=ROUGHNESS, probe=probe):
            words = case.settings["words"] | {"condition": condition}
            cases.append(replace(case, name=f"{case.name}_{condition}", settings={**case.settings, "words": words}))
    return cases


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the figures of a first grasp."""
    settings = with_displacement(case).settings
    changes = settings["changes"]
    changes = {**changes, "probe": min(changes["probe"], BACK * changes["displacement"])}
    with options.open_case(replace(case, settings={**settings, "changes": changes}), folder) as recording:
        supported = score_recording(recording, case, estimator=EstimatorSettings(held="no"))
        return score_recording(recording, case) | {"supported": supported}


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return errors by condition and force."""
    supported = {f"supported {figure}": f"supported: {heading}" for figure, heading in ERRORS.items()}
    table = average_by_force(tabulate(figures), ("condition",), ERRORS | supported)
    note = (
        "Mean and standard deviation over the grasps of each one's RMSE while the true force is above 0.02 N. "
        "Supported: the estimator knows that not only the jaws hold the object."
    )
    return Figures(tables={"conditions": table}, notes=[note])


FRICTION = Experiment(
    name="friction",
    title="First grasps of rough objects",
    about=(
        "The grasps of `grasp`, which has none, with Coulomb friction of 0.5 between fingers and object, whose height "
        "a table keeps. Probed, of medium force: at half of the way each jaw goes back by up to 1 mm, keeps at least "
        "about 40 % of its force, and closes on. Each estimator is new, and is not told that there is friction, nor, "
        "except for *supported*, of the table."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
