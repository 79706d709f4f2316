"""The paper's manipulation force: a held weight is turned, and its pull comes out of the difference of both jaws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from finforce.gripper_frames import SIDES
from finforce_eval.evaluation.batch import evaluate_all
from finforce_eval.evaluation.scoring import join_net, measure_sharpness, rms
from finforce_eval.recordings.tracks import GravityTrack, Recording
from finforce_eval.table import AXES, ForceSeries
from finforce_sim.scenarios import build_scenario, write_script
from finforce_sim.simulated_recording import START
from lab.experiments.experiment import SHARP, Case, Experiment, RunOptions, average, build_setup, tabulate
from lab.harness import Figures

MASS = 0.1  # [kg], the paper's weight
SPEED = 1.2  # [rad/s], of the turn
# The axis of the turn, and how the gripper looks at first: level for a turn about where it points, else down.
TURNS = {
    "roll": {"turn_tilt": 0.5 * np.pi, "pitch": 0.5 * np.pi},
    "y": {"turn_heading": 0.5 * np.pi},
    "x": {"turn_heading": 0.0},
}
LIGHTS = {"bright": "weight_turn", "dim": "weight_turn_dim"}
JAWS = {"as they are": 0.0, "swapped": np.pi}  # the weight goes over to the other jaw first
# A quarter of a turn and back, with less rest; what is held must be still for 0.8 s before it is lifted.
QUICK = {"turn_angle": 0.5 * np.pi, "record": 0.4, "clearance": 0.002}
LEAST = 0.5  # [N] of true net force, from which on it has a direction
PAPER = {("roll", "bright"): "0.12 ± 0.00", ("roll", "dim"): "0.28 ± 0.02"}


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the turns."""
    if options.bags:
        return options.bag_cases()
    cases, times = [], QUICK if options.quick else {"turn_angle": 2.0 * np.pi}
    for axis, posture in TURNS.items():
        for light, scene in LIGHTS.items():
            for jaws, turned in JAWS.items():
                words = {"axis": axis, "light": light, "jaws": jaws}
                name = f"{axis}_{light}_{'swapped' if turned else 'plain'}"
                angle = (-1.0 if turned else 1.0) * times["turn_angle"]
                changes = {"mass": MASS, "turn_rate": SPEED, **posture, **times, "turn_angle": angle}
                cases.append(options.scene_case(name, scene, changes, len(cases), words=words))
    return [cases[0], cases[6]] if options.quick else cases


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the figures of a turn."""
    with options.open_case(case, folder) as recording:
        figures = score_turn(recording, case)
        if options.bags:
            return figures
        told = score_turn(replace(recording, gravity=find_gravity(case.settings)), case)
    return figures | {f"told_{name}": told[name] for name in ("along_rmse_N", "within_3_sigma_pct")}


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return errors along gravity by light."""
    errors = {
        "along_rmse_N": "along gravity/N",
        "within_3_sigma_pct": "within 3σ/%",
        "told_along_rmse_N": "with gravity/N",
        "told_within_3_sigma_pct": "with gravity: within 3σ/%",
    }
    turns = tabulate(figures).reindex(columns=["axis", "light", *errors, *SHARP])
    turns[["axis", "light"]] = turns[["axis", "light"]].fillna("")
    lights = average(turns, ("axis", "light"), errors | SHARP)
    lights["paper/N"] = [PAPER.get(key, "") for key in zip(lights.axis, lights.light, strict=True)]
    note = (
        "RMSE of the net force of both jaws (Eq. 3) along the true one, while that is above 0.5 N: mean and "
        "standard deviation over the turns; with gravity: its direction in the gripper is known."
    )
    return Figures(tables={"By axis and light": lights}, notes=[note])


def score_turn(recording: Recording, case: Case) -> dict[str, Any]:
    """Return the figures of a recording of both jaws."""
    results = evaluate_all([recording], build_setup(case.settings)).results
    return score_weight(join_net({side: results[f"{recording.name}/{side}"] for side in SIDES}))


def find_gravity(settings: Mapping[str, Any]) -> GravityTrack:
    """Return the direction of gravity in a scene of the twin; the elevation is not known."""
    script = write_script(build_scenario(settings["scene"], **settings["changes"]))
    stamps = START + np.round(1e9 * script.stamps).astype(np.int64)
    return GravityTrack(stamps_ns=stamps, direction=script.gravity, elevation=np.full(len(stamps), np.nan))


def score_weight(net: ForceSeries) -> dict[str, Any]:
    """Return errors of a net force along the true one and across it."""
    answered, net = 100.0 * float(net.solved.mean()) if len(net) else None, net.at(net.solved)
    size = net.true_magnitude
    held = size > LEAST
    down = net.true_force[held] / size[held, None]
    error = (net.force - net.true_force)[held]
    along = np.einsum("ij,ij->i", error, down)
    stated = net.column("force_stddev")[held]
    known = bool(np.isfinite(stated).any())
    sigma = np.sqrt(np.einsum("ij,ij->i", stated**2, down**2)) if known else None
    return {
        "along_rmse_N": rms(along),
        "along_bias_N": float(along.mean()) if held.any() else float("nan"),
        "across_rmse_N": rms(np.linalg.norm(error - along[:, None] * down, axis=1)),
        **{f"{axis}_rmse_N": rms(error[:, row]) for row, axis in enumerate(AXES)},
        "within_3_sigma_pct": 100.0 * float((np.abs(along) <= 3.0 * sigma).mean()) if known else float("nan"),
        "sharpness": dict(zip(AXES, measure_sharpness(stated, error).tolist(), strict=True)),
        "answered_pct": answered,
    }


MANIPULATION = Experiment(
    name="manipulation",
    title="A held weight that is turned",
    about=(
        "The paper grasps a calibration weight of 100 g (0.98 N), turns the gripper once round and back, with a lamp "
        "and without, five times each, and compares the manipulation force of Eq. 3 with the weight along gravity. "
        "Here the turn is rendered: about where a level gripper points (roll: gravity presses on one jaw and then on "
        "the other, and acts across the fingers between), about the axis along which the jaws close (x: it never "
        "presses on a jaw) and about the camera's (y: it never acts across), in bright and in dim light, and "
        "*swapped*: begun the other way round, as if left and right had changed places. The object's poses come at "
        "10 Hz with noise; its mass is not known to the estimator."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
