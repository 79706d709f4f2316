"""The paper's potato chip: something that bears 5 N and breaks at 5.43 N, grasped by force, by place, by current."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from finforce_eval.errors import OptionError
from finforce_eval.figures.figures import BLACK, BLUE, GREEN, ORANGE
from finforce_sim.gripper import PressedGrasp
from finforce_sim.scenarios import build_scenario
from lab.experiments.experiment import Case, Experiment, RunOptions, draw_panels, tabulate
from lab.experiments.grasp_world import EstimatorSensor, GraspCase, ImageSensor, NoisySensor, Plant, World
from lab.harness import Figures

BEARS = 5.0  # [N]
BREAKS = 5.43  # [N]
SPEED = 0.004  # [m/s] of the opening
LATENCY = 0.06  # [s] of an image
GRASPS, QUICK_GRASPS = 20, 2
OBJECT, HEIGHT, WIDTH = "block", 0.040, 0.024  # height of its middle [m], width [m]
ANY_HEIGHT, ANY_WIDTH = 0.004, 0.5e-3  # [m] by which it lies elsewhere, evenly spread, and by which its width strays
CURRENT = 0.15  # [A], the least with which the gripper is stable
HOLDING = 4.0  # [s]
STRONG = 0.5  # [A], with which the jaws go to an opening
WAYS = {
    "force": "force feedback",
    "position": "position alone",
    "current": "only the motor's current",
}
SPREAD = ("least", "mean", "largest")
DRAWN_EVERY = 20  # milliseconds


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the grasps."""
    if options.bags:
        raise OptionError("--on BAG: the chip is grasped in a closed loop, which no recording is; expected twin")
    count = QUICK_GRASPS if options.quick else GRASPS
    source = options.source or ("truth" if options.quick else "images")
    cases = []
    for way in WAYS:
        for number in range(count):
            seed = options.seed + number
            settings = {"way": way, "seed": seed, "source": source if way == "force" else ""}
            cases.append(Case(name=f"{way}_{number:02d}", settings=settings | {"size": options.size}))
    return cases


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the figures of a grasp."""
    way, seed, told, untold = case.settings["way"], case.settings["seed"], [], []
    pressed = _lay(seed)
    plant = Plant(force_at=pressed.elastic_force, touch_opening=pressed.touch_opening, terms=pressed.material.terms)
    grasp = GraspCase(plant=plant, force=BEARS, speed=SPEED, latency=LATENCY, seed=seed)
    if way == "force":
        make = ImageSensor if case.settings["source"] == "images" else EstimatorSensor
        more = {"size": case.settings["size"]} if make is ImageSensor else {}
        sensor = make(pressed, seed, **more)
        trace, untold = World(grasp, sensor, holding=HOLDING).run(), sensor.untold
        told = sensor.told
    else:
        opening = find_taught_opening() if way == "position" else 0.0
        trace = World(grasp, NoisySensor(0.0, seed)).run_blind(opening, STRONG if way == "position" else CURRENT)
    stated, off = np.reshape(told, (-1, 2)).T
    times, forces = np.array(trace.times), np.array(trace.forces)
    start = trace.touched_at if np.isfinite(trace.touched_at) else 0.0
    return {
        "way": way,
        "peak_N": float(forces.max(initial=0.0)),
        "end_N": float(forces[times > times[-1] - 1.0].mean()),
        "is_broken": bool(forces.max(initial=0.0) >= BREAKS),
        "error": trace.error,
        "within_3_sigma_pct": 100.0 * float((np.abs(off) <= 3.0 * stated).mean()) if told else float("nan"),
        "untold": [[round(stamp - start, 3), words] for stamp, words in untold],
        "violations": sum(trace.violations.values()),
        "drawn": {
            "seconds": np.round(times[::DRAWN_EVERY] - start, 3).tolist(),
            "force": np.round(forces[::DRAWN_EVERY], 3).tolist(),
        },
    }


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return how many broke."""
    draw_chips(figures).savefig(folder / "chips.png")
    rows = []
    for way, grasps in tabulate(figures).groupby("way", sort=False):
        row: dict[str, Any] = {"by": WAYS[way], "grasps": len(grasps), "broken": int(grasps.is_broken.sum())}
        for column, heading in (("peak_N", "peak/N"), ("end_N", "at the end/N")):
            spread = grasps[column].agg(["min", "mean", "max"]).tolist()
            row |= {f"{heading}: {name}": value for name, value in zip(SPREAD, spread, strict=True)}
        row["within 3σ/%"] = grasps.within_3_sigma_pct.mean()
        row["ended early"] = int(grasps.error.astype(bool).sum())
        row["images without force"] = int(grasps.untold.map(len).sum())
        rows.append(row | {"violations": int(grasps.violations.sum())})
    notes = [f"Broken: a true force of {BREAKS:g} N was reached; wanted: {BEARS:g} N."]
    for name, row in figures.items():
        if row["error"]:
            last = f" ({row['untold'][-1][1]})" if row["untold"] else ""
            notes.append(f"{name} ended early: {row['error']}{last}.")
    drawn = {"True force over time; the line is where it breaks": "chips.png"}
    return Figures(tables={"Grasps": pd.DataFrame(rows)}, notes=notes, drawn=drawn)


def _lay(seed: int | None) -> PressedGrasp:
    """Return the twin's grasp of the thing: as it was taught (None), or as a seed lays it."""
    height, scale = HEIGHT, 1.0
    if seed is not None:
        rng = np.random.default_rng((seed, 7))
        height += float(rng.uniform(-ANY_HEIGHT, ANY_HEIGHT))
        scale += float(rng.normal(0.0, ANY_WIDTH)) / WIDTH
    return PressedGrasp(build_scenario("grasp_cylinder", object=OBJECT, height=height, scale=scale), step=5e-4)


@cache
def find_taught_opening() -> float:
    """Return the opening [m] that makes 5 N where the thing lay when it was taught."""
    taught = _lay(None)
    return float(taught.touch_opening - 2.0 * taught.find_closing(BEARS))


def draw_chips(figures: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return a figure of the true forces [N] over time, a panel for each way of grasping."""
    ways: dict[str, list[Mapping[str, Any]]] = {}
    for row in figures.values():
        ways.setdefault(row["way"], []).append(row)
    titles = {
        f"by {way}: {sum(row['is_broken'] for row in rows)} of {len(rows)} broken": rows for way, rows in ways.items()
    }

    def draw(axes: Any, title: str) -> None:
        for row in titles[title]:
            colour = ORANGE if row["is_broken"] else BLUE
            axes.plot(row["drawn"]["seconds"], row["drawn"]["force"], color=colour, linewidth=0.9, alpha=0.7)
        axes.axhline(BREAKS, color=BLACK, linewidth=0.9, dashes=(4, 2))
        axes.axhline(BEARS, color=GREEN, linewidth=0.9, dashes=(4, 2))
        axes.set_xlim(-0.5, 8.0)

    return draw_panels(list(titles), len(titles), "true force [N]", draw)


CHIP = Experiment(
    name="chip",
    title="Grasping something that breaks",
    about=(
        "The paper grasps and lifts a potato chip with the force of its camera in the loop, raising the threshold by "
        "1 N until the chip breaks: it bore 5 N and broke at 5.43 N. Here a thing that breaks when the true force "
        "reaches 5.43 N is grasped to 5 N through the driver and the emulated gripper, its frames, delays and steps "
        "of the position included. It lies up to 4 mm higher or lower than in the grasp that was taught, and its "
        "width strays by 0.5 mm (one standard deviation). Without a camera, *position* goes to the opening that made "
        "5 N in the taught grasp; *current* closes with 150 mA, the least with which this gripper is stable."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
