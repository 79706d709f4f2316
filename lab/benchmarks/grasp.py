"""Grasps by force at 4 mm/s to 1, 2, 3, 4 and 5 N on the emulated gripper: overshoot, steady error, time to hold.

    python -m lab.benchmarks.grasp [--json report/grasp.json] [--figure docs/images/grasp_force.png] [--seeds N]
                               [--estimator [N]]

Overshoot is the largest true force less the set force, over the whole grasp with 10 s of holding; steady error the mean
difference over its last 5 s, and sensor that of the measured force to the true one; time to hold is from the first true
0.02 N. Forces come at 30 Hz, 2 % of them never, with
noise of 0.05 N and a jitter of 8 ms; with --estimator also from the solver on the twin's key points, N grasps of each
set force.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from finforce_driver.grasp.settings import GraspPhase
from finforce_eval.figures.figures import BLACK, BLUE, GREY, ORANGE, new_figure, style_axes
from finforce_eval.machine import describe_machine, write_figures
from finforce_sim.gripper.pressing import PressedGrasp
from finforce_sim.scenes.scenarios import build_scenario
from lab.experiments.grasp_world import (
    EstimatorSensor,
    GraspCase,
    GraspTrace,
    NoisySensor,
    Plant,
    World,
    build_plant,
    build_spring,
)

FORCES = (1.0, 2.0, 3.0, 4.0, 5.0)  # [N]
SPEEDS = (0.004, 0.008)  # [m/s] of the opening: 4 mm/s of the opening, and of each jaw
LATENCIES = (0.03, 0.06, 0.1)  # [s]
NOISE = 0.05  # [N]
SPRINGS = {
    "spring 0.3 N/mm": (300.0, 1.0),
    "spring 1.3 N/mm": (1300.0, 1.0),
    "spring 0.4 to 1.2 N/mm": (400.0, 3.0),
}
DRAWN = "spring 1.3 N/mm"
STEADY = 5.0  # [s]


@dataclass(frozen=True, kw_only=True, eq=False)
class Grasped:
    """A case with its course."""

    case: GraspCase
    sensor: str
    course: GraspTrace

    @property
    def overshoot(self) -> float:
        """Largest true force less the set force [N]."""
        return max(self.course.forces) - self.case.force

    @property
    def steady_error(self) -> float:
        """Mean true force of the last seconds less the set force [N]."""
        times, forces = np.array(self.course.times), np.array(self.course.forces)
        return float(forces[times > times[-1] - STEADY].mean() - self.case.force)

    @property
    def sensor_error(self) -> float:
        """Mean measured less mean true force of the last seconds [N]: what no controller can know of."""
        end = self.course.times[-1]
        measured = [status.force for time, status in self.course.statuses if time > end - STEADY]
        return float(np.mean(measured)) - self.case.force - self.steady_error

    @property
    def bound(self) -> float:
        """Largest overshoot bound that was shown while loading or holding [N]."""
        shown = [s.overshoot_bound for _, s in self.course.statuses if s.phase is not GraspPhase.APPROACH]
        return max(shown, default=float("nan"))

    @property
    def is_held(self) -> bool:
        """Whether the force was held to the end."""
        return not self.course.error


def list_cases(plants: Sequence[Plant], seeds: int) -> list[GraspCase]:
    """Return every combination that the fingers can reach; seeds and firmware variants alternate."""
    cases = []
    for plant, speed, latency, force, seed in product(plants, SPEEDS, LATENCIES, FORCES, range(seeds)):
        if force > plant.force_at(0.0):
            continue
        number = len(cases)
        cases.append(
            GraspCase(
                plant=plant,
                force=force,
                speed=speed,
                latency=latency,
                seed=1000 * seed + number,
                variant=("new", "old")[number % 2],
            )
        )
    return cases


def run_noisy(plants: Sequence[Plant], seeds: int) -> Iterator[Grasped]:
    """Yield the grasps seen by a camera with white noise, under a progress bar."""
    for case in tqdm(list_cases(plants, seeds), desc="grasps", disable=None, leave=False):
        course = World(case, NoisySensor(NOISE, case.seed)).run()
        yield Grasped(case=case, sensor="noise", course=course)


def run_estimated(name: str, seeds: int) -> Iterator[Grasped]:
    """Yield grasps of the twin seen by the estimator, some for each set force, under a progress bar."""
    pressed = build_pressed(name)
    plant = build_plant(name, pressed)
    forces = [force for force in FORCES if force <= plant.force_at(0.0)]
    cases = [force for _ in range(seeds) for force in forces]
    for number, force in enumerate(tqdm(cases, desc="with the estimator", disable=None, leave=False)):
        case = GraspCase(plant=plant, force=force, speed=SPEEDS[0], latency=LATENCIES[1], seed=number)
        course = World(case, EstimatorSensor(pressed, number)).run()
        yield Grasped(case=case, sensor="estimator", course=course)


def summarize(grasps: Sequence[Grasped]) -> dict[str, Any]:
    """Return the figures of grasps of one kind."""
    over = [one.overshoot for one in grasps]
    held = [one.course.held_at - one.course.touched_at for one in grasps if one.is_held]
    return {
        "n": len(grasps),
        "held": sum(one.is_held for one in grasps),
        "overshoot_N": _quantiles(over),
        "beyond_bound": sum(one.overshoot > one.bound + 0.02 for one in grasps),
        "bound_N": _quantiles([one.bound for one in grasps]),
        "steady_error_N": _quantiles([abs(one.steady_error) for one in grasps if one.is_held]),
        "sensor_error_N": _quantiles([abs(one.sensor_error) for one in grasps if one.is_held]),
        "time_to_hold_s": _quantiles(held),
        "violations": sum(sum(one.course.violations.values()) for one in grasps),
        "errors": sorted({one.course.error for one in grasps if one.course.error}),
    }


def group(grasps: Sequence[Grasped]) -> dict[str, dict[str, Any]]:
    """Return the figures by plant, speed and sensor, and by set force."""
    rows: dict[str, list[Grasped]] = {}
    for one in grasps:
        case, by = one.case, "" if one.sensor == "noise" else ", estimator"
        rows.setdefault(f"{case.plant.name}, {1e3 * case.speed:g} mm/s{by}", []).append(one)
    noisy = [one for one in grasps if one.sensor == "noise"]
    for one in noisy:
        rows.setdefault(f"to {one.case.force:g} N", []).append(one)
    rows["all but the estimator's"] = noisy
    return {name: summarize(members) for name, members in rows.items()}


def format_table(figures: dict[str, dict[str, Any]]) -> str:
    """Return a row per kind of grasp; forces in newtons, times in seconds."""
    head = f"{'':40s}    n held | overshoot p50   p95   p99   max | bound max | |steady| p50  max "
    head += "| sensor max | to hold p50"
    lines = [head, "-" * len(head)]
    for name, one in figures.items():
        over, steady, held = one["overshoot_N"], one["steady_error_N"], one["time_to_hold_s"]
        lines.append(
            f"{name:40s} {one['n']:4d} {one['held']:4d} | {over['median']:13.3f} {over['p95']:5.3f} {over['p99']:5.3f} "
            f"{over['max']:5.3f} | {one['bound_N']['max']:9.2f} | {steady['median']:12.3f} {steady['max']:4.2f} | "
            f"{one['sensor_error_N']['max']:10.2f} | {held['median']:11.2f}"
        )
    return "\n".join(lines)


def trace(grasps: Sequence[Grasped]) -> list[dict[str, Any]]:
    """Return the courses that are drawn: one per set force at 4 mm/s and 60 ms, every 10 ms."""
    chosen = {}
    for one in grasps:
        case = one.case
        if (case.plant.name, case.speed, case.latency, one.sensor) == (DRAWN, SPEEDS[0], LATENCIES[1], "noise"):
            chosen.setdefault(case.force, one)
    return [_trace_of(one) for _, one in sorted(chosen.items())]


def _trace_of(one: Grasped) -> dict[str, Any]:
    course = one.course
    words = [(time - course.touched_at, status) for time, status in course.statuses[::2]]
    return {
        "goal_N": one.case.force,
        "time_s": [round(time - course.touched_at, 3) for time in course.times[::10]],
        "force_N": [round(force, 4) for force in course.forces[::10]],
        "status_time_s": [round(time, 3) for time, _ in words],
        "measured_N": [round(status.force, 3) for _, status in words],
        "bound_N": [round(status.overshoot_bound, 3) for _, status in words],
    }


def _quantiles(values: Sequence[float]) -> dict[str, float]:
    if not len(values):
        return dict.fromkeys(("median", "p95", "p99", "max"), float("nan"))
    return dict(zip(("median", "p95", "p99", "max"), np.quantile(values, (0.5, 0.95, 0.99, 1.0)).tolist(), strict=True))


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    parser.add_argument("--figure", type=Path, help="picture to draw from them; needs matplotlib")
    parser.add_argument("--seeds", type=int, default=1, help="grasps of each case")
    parser.add_argument(
        "--estimator", type=int, nargs="?", const=1, default=0, help="also with the solver on the twin's key points"
    )
    options = parser.parse_args()
    plants = [Plant(name=name, force_at=build_spring(*spring)) for name, spring in SPRINGS.items()]
    plants += [build_plant(name, build_pressed(name)) for name in TWINS]
    grasps = list(run_noisy(plants, options.seeds))
    if options.estimator:
        grasps += [one for name in TWINS for one in run_estimated(name, options.estimator)]
    figures = {"grasps": group(grasps), "traces": trace(grasps)}
    print(format_table(figures["grasps"]))
    machine = describe_machine()
    print(f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}, {machine['commit']}")
    if options.json:
        write_figures(options.json, figures)
    if options.figure:
        draw_traces(figures["traces"]).savefig(options.figure)
    return 0


# name: object, and height of its middle [m]
TWINS = {"twin, rod 35 low": ("rod35", 0.026), "twin, rod 25": ("rod25", 0.042)}


def build_pressed(name: str) -> PressedGrasp:
    """Return the twin's grasp of a name in `TWINS`."""
    body, height = TWINS[name]
    return PressedGrasp(build_scenario("grasp_cylinder", object=body, height=height))


BEFORE, AFTER = -0.4, 6.0  # [s] about first touch that are drawn


def draw_traces(traces: Sequence[dict[str, Any]]) -> Any:
    """Return a figure of forces and bounds, one course per set force."""
    figure = new_figure(8.0, 4.2)
    axes = figure.subplots()
    for number, one in enumerate(traces):
        draw_trace(axes, one, labelled=number == 0)
    axes.set(xlim=(BEFORE, AFTER), ylim=(0.0, None), xlabel="time since first touch [s]", ylabel="grasp force [N]")
    style_axes(axes)
    axes.legend(frameon=False, loc="lower right", ncols=2, fontsize=8)
    return figure


def draw_trace(axes: Any, one: dict[str, Any], *, labelled: bool) -> None:
    """Draw one course: set force, true force, measured forces, and how far it might have gone beyond."""

    def label(text: str) -> str | None:
        return text if labelled else None

    goal = one["goal_N"]
    times, bound = np.array(one["status_time_s"]), np.array(one["bound_N"], dtype=float)
    axes.axhline(goal, color=GREY, linewidth=0.8, linestyle="--", label=label("set force"))
    shown = times > 0.0
    axes.fill_between(
        times[shown], goal, goal + bound[shown], color=ORANGE, alpha=0.25, linewidth=0, label=label("bound shown")
    )
    axes.plot(times, one["measured_N"], ".", color=GREY, markersize=2, label=label("measured, when it arrived"))
    axes.plot(one["time_s"], one["force_N"], color=BLUE, linewidth=1.4, label=label("true force"))
    axes.annotate(f"{goal:g} N", (AFTER, goal), xytext=(4, 0), textcoords="offset points", va="center", color=BLACK)


if __name__ == "__main__":
    sys.exit(main())
