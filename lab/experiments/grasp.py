"""The paper's on-robot evaluation: an object grasped, held and let go, the grasp force against the measured one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce_eval.evaluation.batch import evaluate_all
from finforce_eval.evaluation.contact_source import ContactChoice
from finforce_eval.evaluation.scoring import ONSET_FORCE, Evaluation, force_delays, rms
from finforce_eval.figures.figures import BLACK, BLUE, GREEN, ORANGE
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.settings import EstimatorSettings
from lab.experiments.experiment import (
    SHARP,
    Case,
    Experiment,
    RunOptions,
    average,
    axis_sharpness,
    build_setup,
    draw_panels,
    keep_poses,
    tabulate,
)
from lab.harness import Figures

SCENES = {"cylinder": "grasp_cylinder", "cube": "grasp_cube", "asymmetric": "grasp_asymmetric"}
PLACES = {"lower": 0.024, "middle": 0.040, "upper": 0.058}  # [m] of the object's middle
# elastic force [N], in the ratio of the paper's currents of 300, 500 and 800 mA, and each jaw's speed [m/s]: the
# softest of the nine grasps, the cylinder at the middle, bears 4.8 N before the jaws meet
LEVELS = {"low": (1.5, 0.001), "medium": (2.5, 0.002), "high": (4.0, 0.004)}
HOLD = {"settle": 0.5, "record": 2.5, "clearance": 0.003}  # [s, s, m]
QUICK = {"settle": 0.2, "record": 0.6, "clearance": 0.001}
RATES, DELAYS = (30.0, 10.0, 3.0), (0.0, 0.100, 0.250)  # [Hz], [s] of poses; the twin measures them at the first rate
PAPER_RATE = 10.0  # [Hz] of the paper's object tracker
QUICK_CASES = (("cylinder", "middle", "high"), ("cube", "upper", "medium"), ("asymmetric", "lower", "high"))
RISEN = 0.97  # [-], of the largest true force: where loading ends
FALLEN = 0.75  # [-], of the largest true force: where letting go begins
COLOURS = {"low": BLUE, "medium": GREEN, "high": ORANGE}
PHASES = ("all", "load", "hold", "release")
DRAWN_EVERY = 2  # images


def join_jaws(evaluation: Evaluation, name: str) -> pd.DataFrame:
    """Return the grasp force of a recording of which both jaws were evaluated (Eq. 3).

    Returns:
        A row for each image: its `stamp` [ns], `seconds` since the first, min(|F_left|, |F_right|) [N] as measured
        (`truth`) and as estimated (`found`, NaN unless both are trusted), the `stddev` [N] of the jaw whose force is
        less certain, and the `delay` [s] from the image to its force.
    """
    left, right = (evaluation.results[f"{name}/{side}"] for side in ("left", "right"))
    stamps, mine, theirs = np.intersect1d(left.stamps_ns, right.stamps_ns, return_indices=True)
    columns = {
        "truth": np.minimum(left.true_magnitude[mine], right.true_magnitude[theirs]),
        "found": np.minimum(left.magnitude[mine], right.magnitude[theirs]),
        "stddev": np.maximum(left.column("magnitude_stddev")[mine], right.column("magnitude_stddev")[theirs]),
        "delay": np.maximum(left.lag[mine], right.lag[theirs]),
    }
    return pd.DataFrame({"stamp": stamps, "seconds": 1e-9 * (stamps - stamps[0]), **columns})


def find_phases(grasp: pd.DataFrame) -> dict[str, NDArray]:
    """Return which images (n,) belong to the whole grasp, to loading, holding and letting go, by the true force."""
    truth = grasp.truth.to_numpy()
    held, largest = np.nan_to_num(truth) > ONSET_FORCE, float(np.nanmax(truth, initial=0.0))
    places = np.arange(len(truth))
    high, kept = np.flatnonzero(truth >= RISEN * largest), np.flatnonzero(truth >= FALLEN * largest)
    first, last = (int(high[0]), int(kept[-1])) if high.size else (0, 0)
    load, release = held & (places <= first), held & (places > last)
    return {"all": held, "load": load, "hold": held & ~load & ~release, "release": release}


def score_grasp(grasp: pd.DataFrame) -> dict[str, Any]:
    """Return the figures of a grasp: errors by phase, answered share, honesty, delay."""
    truth, found, phases = grasp.truth.to_numpy(), grasp.found.to_numpy(), find_phases(grasp)
    error, held = found - truth, phases["all"]
    known = held & np.isfinite(found)
    within = np.abs(error[known]) <= 3.0 * grasp.stddev.to_numpy()[known]
    span = float(np.ptp(truth[held])) if held.any() else float("nan")
    delays = force_delays(grasp.seconds.to_numpy(), truth, np.nan_to_num(found), grasp.delay.to_numpy())
    errors = {name: rms(error[mask]) for name, mask in phases.items()}
    return {
        "peak_N": float(np.nanmax(truth, initial=0.0)),
        "rmse_N": errors,
        "nrmsd_pct": {name: 100.0 * value / span for name, value in errors.items()},
        "bias_N": float(error[known].mean()) if known.any() else float("nan"),
        "max_error_N": float(np.abs(error[known]).max(initial=0.0)),
        "answered_pct": 100.0 * float(known.sum() / max(held.sum(), 1)),
        "within_3_sigma_pct": 100.0 * float(within.mean()) if known.any() else float("nan"),
        "delay_ms": (1e3 * delays[:, 0]).tolist(),
    }


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the grasps."""
    if options.bags:
        return options.bag_cases()
    return list_grasps(options, tracking=RATES[0])


def list_grasps(options: RunOptions, levels: Sequence[str] = tuple(LEVELS), **more: Any) -> list[Case]:
    """Return the grasps of some levels of force on the twin, with more changes of the scene."""
    cases = []
    for number, (shape, place, level) in enumerate(product(SCENES, PLACES, LEVELS)):
        force, speed = LEVELS[level]
        words = {"object": shape, "place": place, "level": level, "force": force}
        changes = {"height": PLACES[place], "closing_speed": speed, **(QUICK if options.quick else HOLD), **more}
        if level in levels and (not options.quick or (shape, place, level) in QUICK_CASES):
            cases.append(options.scene_case(f"{shape}_{place}_{level}", SCENES[shape], changes, number, words=words))
    return cases


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the figures of a grasp; poses of the twin come at the paper's rate, and at medium force at others, too."""
    with options.open_case(with_displacement(case), folder) as recording:
        seen = recording if "bag" in case.settings else thin_poses(recording, PAPER_RATE)
        evaluation = evaluate_all([seen], build_setup(case.settings))
        grasp = join_jaws(evaluation, seen.name)
        loading = np.flatnonzero(find_phases(grasp)["load"])
        full = int(grasp.stamp.iloc[loading[-1] if loading.size else -1])
        hidden = score_recording(keep_poses(seen, seen.object_pose.stamps_ns < full), case)
        poses = {
            f"{rate:g} Hz, {1e3 * delay:g} ms late": score_recording(thin_poses(recording, rate), case, delay)
            for rate, delay in product(RATES, DELAYS)
            if case.settings.get("words", {}).get("level") == "medium"
        }
    drawn = grasp[["seconds", "truth", "found"]].iloc[::DRAWN_EVERY].round(4).to_dict("list")
    told = {"sharpness": axis_sharpness(evaluation), "hidden": hidden, "poses": poses, "drawn": drawn}
    return score_grasp(grasp) | told


def score_recording(
    recording: Recording, case: Case, delay: float = 0.0, estimator: EstimatorSettings | None = None
) -> dict[str, Any]:
    """Return the figures of a recorded grasp whose poses arrive with a delay [s]; see `build_setup`."""
    setup = build_setup(case.settings, ContactChoice(mode="estimate", pose_delay=round(1e9 * delay)), estimator)
    return score_grasp(join_jaws(evaluate_all([recording], setup), recording.name))


def thin_poses(recording: Recording, rate: float) -> Recording:
    """Return a recording with poses of the object at a rate [Hz]."""
    stamps = recording.object_pose.stamps_ns
    period = np.floor(1e-9 * (stamps - stamps[0]) * rate + 1e-3).astype(int)
    return keep_poses(recording, np.diff(period, prepend=-1) > 0)


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return errors by force, by object and place, and by rate and delay of the poses."""
    grasps, drawn = tabulate(figures), {}
    grasps["delay_ms"] = grasps.delay_ms.map(lambda delays: np.median([one for one in delays if one] or [np.nan]))
    grasps["level"] = grasps.get("level", "all")
    if not options.bags:
        draw_grasps(figures).savefig(folder / "grasps.png")
        drawn["Measured (dashed) and estimated grasp force"] = "grasps.png"
    each = grasps[["case", *COLUMNS]].rename(columns={"case": "grasp", **COLUMNS})
    tables = {"By force": average_by_force(grasps, (), COLUMNS), "Each grasp": each}
    slow = [{"poses": name, **score} for row in figures.values() for name, score in row.get("poses", {}).items()]
    if slow:
        tables["Poses"] = average(pd.json_normalize(slow, sep=" "), ("poses",), ERRORS)
    return Figures(tables=tables, notes=[NOTE], drawn=drawn)


def average_by_force(grasps: pd.DataFrame, by: Sequence[str], columns: Mapping[str, str]) -> pd.DataFrame:
    """Return averages by groups and, within each, by level of force, and of all levels; see `average`."""
    every = pd.concat([grasps, grasps.assign(level="all")]).drop_duplicates(["case", "level"])
    return average(every, (*by, "level"), columns).rename(columns={"level": "force"})


# headings of the averages by figure of a grasp
ERRORS = {
    **{f"rmse_N {phase}": f"{phase}: RMSE/N" for phase in PHASES},
    "max_error_N": "largest/N",
    "bias_N": "bias/N",
    "answered_pct": "answered/%",
    "within_3_sigma_pct": "within 3σ/%",
}
COLUMNS = {
    "peak_N": "peak/N",
    **ERRORS,
    "nrmsd_pct all": "NRMSD/%",
    "nrmsd_pct load": "load: NRMSD/%",
    "hidden rmse_N all": "hidden: RMSE/N",
    **SHARP,
    "delay_ms": "shows after/ms",
}
NOTE = (
    "Mean and standard deviation over the grasps of each grasp's error of min(|F_left|, |F_right|), while the true "
    "force is above 0.02 N; loading ends at 97 % of the largest force, letting go begins at 75 %. NRMSD: of each "
    "grasp's own range of force. Sharp: root mean square of the stated deviation over that of the error, of both "
    "jaws' forces along x, y and z; less than 1 is too little. Shows after: from 0.02 N of true force to an estimate "
    "above 0.1 N, computed. The paper, 135 grasps without its worst case (the highest force at the lower place): RMSE "
    "0.19 to 0.78 N, loading 0.08 to 0.56 N, NRMSD 1.8 to 7.0 %, loading 0.7 to 5.1 %, shows after 250 ms."
)


def with_displacement(case: Case) -> Case:
    """Return a scene with each jaw's way beyond first touch that makes the force of its level."""
    settings = case.settings
    if "bag" in settings:
        return case
    from finforce_sim.gripper import PressedGrasp
    from finforce_sim.scenarios import build_scenario

    smooth = {**settings["changes"], "roughness": 0.0}  # friction needs a finer step, and changes the way by little
    grasp = PressedGrasp(build_scenario(settings["scene"], **smooth), step=5e-4)
    way = round(grasp.find_closing(settings["words"]["force"]), 7)  # rendered once, whatever mechanics round to
    return replace(case, settings={**settings, "changes": {**settings["changes"], "displacement": way}})


def draw_grasps(figures: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return a figure with a panel for each object and place, measured and estimated force over time."""

    def draw(axes: Any, title: str) -> None:
        for row in figures.values():
            if title == f"{row['object']}, {row['place']}":
                grasp = pd.DataFrame(row["drawn"])
                seconds = grasp.seconds - grasp.seconds[grasp.truth > ONSET_FORCE].min()
                axes.plot(seconds, grasp.found, color=COLOURS[row["level"]], linewidth=1.2)
                axes.plot(seconds, grasp.truth, color=BLACK, linewidth=0.9, dashes=(4, 2))
        axes.set_xlim(left=-1.0)

    shapes, places = (list(dict.fromkeys(row[key] for row in figures.values())) for key in ("object", "place"))
    titles = [f"{shape}, {place}" for shape, place in product(shapes, places)]
    return draw_panels(titles, len(places), "grasp force [N]", draw)


GRASP = Experiment(
    name="grasp",
    title="Grasps: force against the measured one",
    about=(
        "The paper grasps a cylinder, a cube and an asymmetric object, each with a load cell inside, at three places "
        "with three motor currents, five times each. Here the objects, places and the ratio of the forces are the "
        "same; finger, camera and objects are rendered, the material relaxes, seeds differ from grasp to grasp, and "
        "force stands for current: the motor's nominal force would shut the jaws on each of them. The contact is not "
        "known before. *Hidden*: from full force on no pose of the object comes any more. The twin's poses come at the "
        "paper's 10 Hz; *Poses*: at medium force also at 30 and 3 Hz, 0, 100 and 250 ms after their images."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
