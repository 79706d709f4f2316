"""The paper's comparison: grasp forces of finforce and of its baseline network on the same images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from finforce_eval.errors import OptionError
from finforce_eval.evaluation.batch import evaluate_all
from finforce_eval.evaluation.scoring import rms
from finforce_eval.figures.figures import BLACK, BLUE, ORANGE
from lab.experiments.experiment import Case, Experiment, RunOptions, build_setup, draw_panels, tabulate
from lab.experiments.grasp import DRAWN_EVERY, find_phases, join_jaws, list_grasps, with_displacement
from lab.harness import Figures

LIGHTS = ("bright", "dim")
SHORT = {"record": 1.0, "closing_speed": 0.004}  # [s, m/s]; a network of ten images remembers no longer hold
UNSEEN = "asymmetric"  # object that the network was not trained on; nor on dim light


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the grasps of medium force in both lights."""
    if not options.network:
        raise OptionError("network: expected --network RUN/checkpoint.pt, which lab.training.baseline writes")
    if options.bags:
        return options.bag_cases()
    cases = []
    for light in LIGHTS:
        for case in list_grasps(options, ("medium",), light=light, **({} if options.quick else SHORT)):
            words = case.settings["words"] | {"light": light}
            cases.append(replace(case, name=f"{case.name}_{light}", settings={**case.settings, "words": words}))
    return cases


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the errors of both on the images of a grasp for which both have a force."""
    from lab.training.baseline import follow_images, load_baseline

    with options.open_case(with_displacement(case), folder) as recording:
        forces = follow_images(load_baseline(options.network), recording.images.colors_alone())
        grasp = join_jaws(evaluate_all([recording], build_setup(case.settings)), recording.name)
    grasp["network"] = grasp.stamp.map(forces)
    held = grasp[find_phases(grasp)["all"]]
    both = held.dropna()
    return {
        "images": len(held),
        "compared": len(both),
        "peak_N": float(np.nanmax(grasp.truth, initial=0.0)),
        "square_N2": float(((both.found - both.truth) ** 2).sum()),
        "network_square_N2": float(((both.network - both.truth) ** 2).sum()),
        "rmse_N": rms((both.found - both.truth).to_numpy()),
        "network_rmse_N": rms((both.network - both.truth).to_numpy()),
        "drawn": grasp[["seconds", "truth", "found", "network"]].iloc[::DRAWN_EVERY].round(4).to_dict("list"),
    }


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return both methods' errors by what the network had seen."""
    draw_networks(figures).savefig(folder / "network.png")
    grasps = tabulate(figures)
    grasps["seen"] = [name_condition(row) for row in figures.values()]
    groups = grasps.groupby("seen", sort=False).agg(
        grasps=("case", "size"),
        images=("images", "sum"),
        compared=("compared", "sum"),
        peak=("peak_N", "mean"),
        ours=("square_N2", "sum"),
        theirs=("network_square_N2", "sum"),
    )
    groups["finforce: RMSE/N"], groups["network: RMSE/N"] = (
        np.sqrt(groups.pop(name) / groups.compared) for name in ("ours", "theirs")
    )
    groups["network : finforce"] = groups["network: RMSE/N"] / groups["finforce: RMSE/N"]
    table = groups.rename(columns={"peak": "mean peak/N"}).reset_index()
    each = grasps[["case", "compared", "peak_N", "rmse_N", "network_rmse_N"]]
    note = (
        "RMSE of min(|F_left|, |F_right|) over all images with a true force above 0.02 N for which both methods have "
        "one. The network needs images and forces of grasps with this finger to learn from; finforce needs the "
        "finger's model and calibration, the object's mesh and its poses."
    )
    drawn = {"True grasp force (dashed), finforce (blue), network (orange)": "network.png"}
    return Figures(tables={"conditions": table, "Each grasp": each}, notes=[note], drawn=drawn)


def name_condition(row: Mapping[str, Any]) -> str:
    """Return what of a grasp the network has seen in its training."""
    if "light" not in row:
        return "recordings"
    shape, light = row["object"] == UNSEEN, row["light"] != LIGHTS[0]
    return f"{'unseen' if shape else 'trained'} object, {'unseen' if light else 'trained'} light"


def draw_networks(figures: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return a figure of the grasp force by both methods over time, a panel for each grasp."""

    def draw(axes: Any, title: str) -> None:
        grasp = pd.DataFrame(figures[title]["drawn"])
        axes.plot(grasp.seconds, grasp.network, color=ORANGE, linewidth=1.0)
        axes.plot(grasp.seconds, grasp.found, color=BLUE, linewidth=1.2)
        axes.plot(grasp.seconds, grasp.truth, color=BLACK, linewidth=0.9, dashes=(4, 2))

    return draw_panels(list(figures), min(len(figures), 3), "time [s]", "grasp force [N]", draw)


NETWORK = Experiment(
    name="network",
    title="Against the paper's baseline network",
    about=(
        "The paper trains a network on images and forces alone, a ResNet-50 and a transformer over ten images, and "
        "finds it two to three times worse on an object that it has not seen. Here a network of the same kind with a "
        "smaller encoder was trained on rendered grasps of the cylinder and the cube in bright light "
        "(`lab.training.baseline`); colours, textures and background differ from grasp to grasp in both sets. Tested "
        "are grasps of medium force with the three objects at three heights in bright and in dim light."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
