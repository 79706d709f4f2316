"""The paper's comparison: grasp forces of finforce and of its baseline network on the same images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from finforce_eval.errors import OptionError
from finforce_eval.evaluation.batch import evaluate_all
from lab.experiments.experiment import Case, Experiment, RunOptions, build_setup, tabulate
from lab.experiments.grasp import find_phases, join_jaws, list_grasps, with_displacement
from lab.harness import Figures

LIGHTS = ("bright", "dim")
SHORT = {"record": 1.0, "closing_speed": 0.004}  # [s, m/s]; a network of ten images remembers no longer hold
UNSEEN = "asymmetric"  # object that the network was not trained on; nor was it on dim light


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the grasps of medium force in both lights."""
    if not options.network or options.bags:
        raise OptionError("network: expected twin and --network RUN/checkpoint.pt, which lab.training.baseline writes")
    cases = []
    for light in LIGHTS:
        for case in list_grasps(options, ("medium",), light=light, **({} if options.quick else SHORT)):
            words = case.settings["words"] | {"light": light}
            cases.append(replace(case, name=f"{case.name}_{light}", settings={**case.settings, "words": words}))
    return cases


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the squared errors [N^2] of both on the images of a grasp for which both have a force."""
    from lab.training.baseline import follow_images, load_baseline

    with options.open_case(with_displacement(case), folder) as recording:
        forces = follow_images(load_baseline(options.network), recording.images.colors_alone())
        grasp = join_jaws(evaluate_all([recording], build_setup(case.settings)), recording.name)
    held = grasp.assign(network=grasp.stamp.map(forces))[find_phases(grasp)["all"]]
    both = held.dropna()
    squares = {name: float(((both[name] - both.truth) ** 2).sum()) for name in ("found", "network")}
    return {"images": len(held), "compared": len(both), **squares}


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return both methods' errors by what the network had seen."""
    grasps = tabulate(figures)
    grasps["seen"] = [name_condition(row) for row in figures.values()]
    sums = grasps.groupby("seen", sort=False)[["images", "compared", "found", "network"]].sum()
    sums.insert(0, "grasps", grasps.groupby("seen", sort=False).size())
    for name, heading in (("found", "finforce: RMSE/N"), ("network", "network: RMSE/N")):
        sums[heading] = np.sqrt(sums.pop(name) / sums.compared)
    sums["network : finforce"] = sums["network: RMSE/N"] / sums["finforce: RMSE/N"]
    note = (
        "RMSE of min(|F_left|, |F_right|) over all images with a true force above 0.02 N for which both methods have "
        "one."
    )
    return Figures(tables={"conditions": sums.reset_index()}, notes=[note])


def name_condition(words: Mapping[str, Any]) -> str:
    """Return what of a grasp the network has seen in its training."""
    seen = {True: "trained", False: "unseen"}
    return f"{seen[words['object'] != UNSEEN]} object, {seen[words['light'] == LIGHTS[0]]} light"


NETWORK = Experiment(
    name="network",
    title="Against the paper's baseline network",
    about=(
        "The paper trains a network on images and forces alone, a ResNet-50 and a transformer over ten images, and "
        "finds it much worse on an unseen object. Here a network of the same kind with a smaller encoder was trained "
        "on rendered grasps of cylinder and cube in bright light (`lab.training.baseline`). Each grasp has colours and "
        "a background of its own."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
