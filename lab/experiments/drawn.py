"""Grasps over all that the twin can vary, drawn from a seed that nobody has looked at: do stated deviations hold?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from finforce_eval.errors import OptionError
from finforce_eval.evaluation.batch import evaluate_all
from finforce_eval.table import AXES
from finforce_ifea.jaw.jaw import load_jaw
from finforce_sim.sensor import D405
from lab.experiments.experiment import SHARP, Case, Experiment, RunOptions, axis_sharpness, build_setup, tabulate
from lab.harness import Figures

COUNT = 24
QUICK_COUNT = 2
QUICK = {"rate": 15.0, "levels": 1, "cycles": 1}
SCENES = ("grasp_cylinder", "hold", "weight_turn", "shifting", "slipping", "rocking", "fast_close")
# turned about x by a right angle or not at all, and about y by any angle: the twin presses along the middle plane of
# its jaws, which a leaning object would not touch first
OBJECTS = ("rod15", "rod25", "rod35", "block", "wedge", "cylinder", "cube", "asymmetric", "mug", "bottle")
WIDTHS = (0.012, 0.045)  # [m] along the closing axis, to which objects are scaled
LEAST_WIDTHS = {"mug": 0.035}  # [m], below which a handle is thinner than the outlines of objects are resolved
SHARES = (0.1, 0.85)  # [-] of the height of the jaw's possible contacts
PRESSES = (0.002, 0.008)  # [m] of a jaw whose contacts span SPAN; shorter ones are pressed as much less
SPAN = 0.06  # [m]
SPEEDS = (0.003, 0.06)  # [m/s]
SIZES = ("424x240", "640x480", "848x480", "1280x720")
LENSES = (D405, D405, D405, "webcam", "fisheye")
CAMERAS = ("robot", "robot", "turned", "front")
ROUGH = (0.05, 0.8)  # [-], coefficient of friction
WEIGHTS = (0.03, 0.15)  # [kg]


def draw_scene(seed: int, jaw: str = "bench") -> dict[str, Any]:
    """Return the settings of a scene: its name, changes, size, lens, and how a detector has to read it.

    Args:
        seed: of the draw; the same scene for the same seed.
        jaw: jaw file, or name of an included jaw.
    """
    rng = np.random.default_rng((seed, 11))
    scene, shape, lens = (str(rng.choice(names)) for names in (SCENES, OBJECTS, LENSES))
    heights = load_jaw(jaw).candidates[:, 2]
    span = float(np.ptp(heights))
    changes = {
        "jaw": jaw,
        "object": shape,
        "turn_x": float(rng.choice((0.0, 0.5 * np.pi))),
        "turn_y": float(rng.uniform(-np.pi, np.pi)),
        "height": float(heights.min() + rng.uniform(*SHARES) * span),
        "offset": float(rng.normal(0.0, 0.002)),
        "displacement": float(rng.uniform(*PRESSES)) * min(span / SPAN, 1.0),
        "closing_speed": float(np.exp(rng.uniform(*np.log(SPEEDS)))),
        "camera": str(rng.choice(CAMERAS)),
        "light": str(rng.choice(("bright", "dim", "any"))),
        "rate": float(rng.choice((15.0, 30.0, 60.0))),
        "tracking": float(rng.choice((3.0, 10.0, 30.0))),
        "pitch": float(rng.uniform(-1.0, 1.0)),
        "levels": int(rng.integers(1, 3)),
        "cycles": int(rng.integers(1, 3)),
        "settle": 0.3,
        "record": 0.7,
    }
    width = max(rng.uniform(*WIDTHS), LEAST_WIDTHS.get(shape, 0.0))
    changes["scale"] = _scale_to(changes, width)
    if scene in ("weight_turn", "slipping"):
        changes["mass"] = float(rng.uniform(*WEIGHTS))
    elif rng.uniform() < 0.6:
        changes["roughness"] = float(rng.uniform(*ROUGH))
    detector = {} if lens == D405 else {"depth": "none"}
    return {"scene": scene, "changes": changes, "size": str(rng.choice(SIZES)), "lens": lens, "detector": detector}


def _scale_to(changes: Mapping[str, Any], width: float) -> float:
    """Return the scale at which a scene's object has a width [m] along the closing axis."""
    from finforce_sim.objects import place_object
    from finforce_sim.scenarios import build_scenario

    vertices = place_object(build_scenario("grasp_cylinder", **changes)).centred.vertices
    return float(width / np.ptp(vertices[:, 0]))


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the scenes of seeds from the given one on."""
    if options.bags:
        raise OptionError("--on BAG: this experiment draws scenes of the twin; expected twin")
    cases = []
    for number in range(QUICK_COUNT if options.quick else COUNT):
        drawn = draw_scene(options.seed + number, options.jaw)
        changes, size = drawn["changes"], options.size if options.quick else drawn["size"]
        changes |= QUICK if options.quick else {}
        words = {"scene": drawn["scene"], "object": changes["object"], "light": changes["light"]}
        words |= {"camera": f"{changes['camera']} {drawn['lens']} {size}", "rate/Hz": changes["rate"]}
        words |= {"friction": changes.get("roughness", 0.0), "press/mm": 1e3 * changes["displacement"]}
        more = {"words": words, "size": size, "lens": drawn["lens"], "detector": drawn["detector"]}
        cases.append(options.scene_case(str(options.seed + number), drawn["scene"], changes, number, **more))
    return cases


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the errors of both jaws over the record phases, and those beyond three stated deviations."""
    with options.open_case(case, folder) as recording:
        evaluation = evaluate_all([recording], build_setup(case.settings))
    score, unknown = evaluation.total, (np.nan,) * len(AXES)
    errors = score.all
    found = {axis: {"rmse_N": value} for axis, value in zip(AXES, errors.axis_rmse_N or unknown, strict=True)}
    within = float(np.min(errors.within_3_sigma_pct or unknown))
    found |= {"rmse_N": errors.rmse_N, "sharpness": axis_sharpness(evaluation), "within_3_sigma_pct": within}
    return {"images": score.record_frames, "answered": errors.n, **found}


# headings by figure of a scene
COLUMNS = {
    "rmse_N": "magnitude/N",
    **{f"{axis} rmse_N": f"{axis}/N" for axis in AXES},
    **SHARP,
    "within_3_sigma_pct": "within 3σ/%",
    "answered_pct": "answered/%",
}
BEST = (*SHARP, "within_3_sigma_pct", "answered_pct")  # of which less is worse
WORDS = ("scene", "object", "camera", "light", "rate/Hz", "friction", "press/mm")


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return the errors of the median and the worst scene, and of each one."""
    scenes = tabulate(figures)
    scenes["answered_pct"] = 100.0 * scenes.answered / scenes.images
    scenes = scenes[["case", *WORDS, "images", *COLUMNS]]
    worst = scenes[list(COLUMNS)].max()
    worst[list(BEST)] = scenes[list(BEST)].min()
    both = pd.DataFrame([scenes[list(COLUMNS)].median(), worst]).rename(columns=COLUMNS)
    both.insert(0, "scene", ["median", "worst"])
    return Figures(tables={"all": both, "scenes": scenes.rename(columns={"case": "seed", **COLUMNS})}, notes=[NOTE])


NOTE = (
    "Root mean square errors over both jaws' images of the record phases; worst: of each column. Within 3σ: along the "
    "axis that has the fewest. Sharp: see `grasp`. A scene that the twin cannot play, as where a jaw buckles, failed."
)
DRAWN = Experiment(
    name="drawn",
    title="Scenes drawn at random",
    about=(
        "Scene, object and its width, height, press, speed, friction or weight, light, lens, image size, rate, mount "
        "and rate of the poses are drawn from the seed: `--seed` names scenes that nobody has seen. Lenses without a "
        "depth camera have no depth. The estimator knows the finger's calibration and the object's mesh."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
