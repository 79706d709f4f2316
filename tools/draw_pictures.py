"""Draw the pictures of forces in docs/images, from a folder of `finforce evaluate ... --out FOLDER` (docs/results.md).

python -m tools.draw_pictures FOLDER
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from finforce_eval.evaluation.scoring import LEAST_FORCE
from finforce_eval.figures.figures import BLACK, BLUE, GREEN, GREY, ORANGE, draw_errors, new_figure, style_axes
from finforce_eval.table import read_table
from lab.experiments.grasp_world import WIDTH, GraspCase, NoisySensor, Plant, World

IMAGES = Path(__file__).parents[1] / "docs" / "images"
SHOWN = "mooney_cyl25_middle"  # of the recordings
STIFFNESS = 1300.0  # [N/m] of fingers about the object that is grasped


def draw_over_time(time: NDArray, found: NDArray, truth: NDArray, deviation: NDArray, quantity: str) -> Figure:
    """Draw an estimate within two standard deviations, and the truth, over time [s], and the error below."""
    figure = new_figure(11.0, 5.0)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    band = np.maximum(found - 2.0 * deviation, 0.0), found + 2.0 * deviation
    upper.fill_between(time, *band, color=GREEN, alpha=0.3, linewidth=0.0)
    upper.plot(time, found, color=GREEN, linewidth=1.2, label="estimate")
    upper.plot(time, truth, color=BLACK, linewidth=0.9, dashes=(4, 2), label="truth")
    lower.plot(time, found - truth, color=BLUE, linewidth=0.7)
    upper.set(ylabel=quantity)
    lower.set(xlabel="time [s]", ylabel=f"error {quantity[quantity.index('[') :]}")
    for axes in (upper, lower):
        style_axes(axes)
    figure.legend(loc="outside upper right", ncols=2, frameon=False, fontsize=9)
    return figure


def draw_grasps() -> Figure:
    """Draw emulated grasps by force: true force, newest measured force, set force."""
    figure = new_figure(8.0, 4.2)
    axes = figure.subplots()
    style_axes(axes)
    plant = Plant(force_at=lambda opening: STIFFNESS * max(0.0, WIDTH - opening))
    for force in (1.0, 2.0, 3.0, 4.0, 5.0):
        case = GraspCase(plant=plant, force=force, speed=0.004, latency=0.06, seed=1)
        trace = World(case, NoisySensor(0.05, 1)).run()
        measured = np.array([(now - trace.touched_at, status.force) for now, status in trace.statuses])
        axes.axhline(force, color=GREY, linewidth=0.9, dashes=(4, 2))
        axes.plot(*measured.T, ".", color=ORANGE, markersize=2)
        axes.plot(np.array(trace.times) - trace.touched_at, trace.forces, color=BLUE, linewidth=1.5)
    axes.set(xlim=(-0.4, 6.0), ylim=(0.0, 5.5), xlabel="time since first touch [s]", ylabel="grasp force [N]")
    return figure


def main(folder: Path) -> None:
    """Draw all of them."""
    series = [one for path in sorted(folder.glob("*.parquet")) for one in read_table(path)[0]]
    (shown,) = [one for one in series if one.name == SHOWN]
    deviation, found = shown.column("magnitude_stddev"), shown.column("contact_location")[:, 2]
    force = draw_over_time(shown.seconds, shown.magnitude, shown.true_magnitude, deviation, "force on the jaw [N]")
    known = np.where(shown.solved & (shown.true_magnitude > LEAST_FORCE), 1e3, np.nan)  # [mm/m]
    heights = known * found, known * shown.column("true_height"), 0.0 * found
    place = draw_over_time(shown.seconds, *heights, "height [mm]")
    drawn = {"errors": draw_errors(series), "force": force, "contact_place": place, "grasp_force": draw_grasps()}
    for name, figure in drawn.items():
        figure.savefig(IMAGES / f"{name}.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
