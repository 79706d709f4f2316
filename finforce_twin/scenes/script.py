"""The course of a scenario over time: how far closed, where the object is drawn, how the wrist is turned."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce_twin.scenes.scenarios import HELD, Scenario

RATE = 30.0  # [Hz] of the images
GRAVITY = 9.81  # [m/s^2]
_DOWN = np.array([0.0, 0.0, 1.0])  # the gripper looks down at first
_LIFT_TIME = 0.6
_TARE_RECORD = 0.5


@dataclass(frozen=True, kw_only=True)
class Posture:
    """Where everything stands at one instant.

    Attributes:
        closing: of each jaw beyond first touch [m], negative while open.
        slide: of the object along z [m].
        rock: of the object from x to z [rad].
        lifted: share [-] of the object's weight that the jaws carry.
        turn: of the wrist [rad].
    """

    closing: float
    slide: float = 0.0
    rock: float = 0.0
    lifted: float = 0.0
    turn: float = 0.0


@dataclass(frozen=True, kw_only=True)
class ScriptStep:
    """A straight way from the last posture to the next; its phase is that of `/bench/phase`."""

    phase: str
    duration: float
    end: Posture


@dataclass(frozen=True, kw_only=True, eq=False)
class Script:
    """The course at every image, n of them.

    Attributes:
        stamps: (n,) [s], from 0 on.
        phases: n words.
        postures: n of them.
        gravity: (n, 3) unit vectors in `gripper_base`.
        weight: (n, 3) [N] that the jaws carry, in `gripper_base`.
    """

    stamps: NDArray
    phases: tuple[str, ...]
    postures: tuple[Posture, ...]
    gravity: NDArray
    weight: NDArray


def write_script(scenario: Scenario) -> Script:
    """Returns the course of a scenario, sampled at `RATE`."""
    start = Posture(closing=-scenario.clearance)
    steps = list(_plan_steps(scenario, start))
    ends = np.concatenate([[0.0], np.cumsum([step.duration for step in steps])])
    stamps = np.arange(int(round(ends[-1] * RATE)) + 1) / RATE
    corners = np.array([list(vars(posture).values()) for posture in (start, *(step.end for step in steps))])
    courses = [np.interp(stamps, ends, column) for column in corners.T]
    # an image between two steps belongs to the later one, whatever the rounding
    running = np.clip(np.searchsorted(ends, stamps + 1e-9) - 1, 0, len(steps) - 1)
    postures = tuple(Posture(**dict(zip(vars(start), row, strict=True))) for row in np.stack(courses, axis=1).tolist())
    heading = np.array([np.cos(scenario.turn_heading), np.sin(scenario.turn_heading), 0.0])
    gravity = Rotation.from_rotvec(np.outer([posture.turn for posture in postures], heading)).apply(_DOWN)
    lifted = np.array([posture.lifted for posture in postures])
    return Script(
        stamps=stamps,
        phases=tuple(steps[i].phase for i in running),
        postures=postures,
        gravity=gravity,
        weight=scenario.mass * GRAVITY * lifted[:, None] * gravity,
    )


def _plan_steps(scenario: Scenario, start: Posture) -> Iterator[ScriptStep]:
    """Yields still, close, load level by level, what is done while held, unload, open; the middle for each cycle."""
    yield ScriptStep(phase="0:load:0:settle", duration=scenario.tare - _TARE_RECORD, end=start)
    yield ScriptStep(phase="0:load:0:record", duration=_TARE_RECORD, end=start)
    levels = scenario.displacement * np.arange(scenario.levels + 1) / scenario.levels
    levels = levels if scenario.displacement > 0.0 else levels[:1]
    for cycle in range(scenario.cycles):
        closed = Posture(closing=0.0)
        approach = scenario.clearance / scenario.closing_speed
        yield ScriptStep(phase=f"{cycle}:load:0:ramp", duration=approach, end=closed)
        for level in levels[1:]:
            yield from _hold_level(scenario, f"{cycle}:load", level, closed)
            closed = replace(closed, closing=float(level))
        yield from _plan_manipulation(scenario, f"{cycle}:load:{_millimetres(levels[-1])}", closed)
        for level in levels[-2:0:-1]:
            yield from _hold_level(scenario, f"{cycle}:unload", level, closed)
            closed = replace(closed, closing=float(level))
        yield from _release(scenario, f"{cycle}:unload:0", closed, start)


def _release(scenario: Scenario, phase: str, held: Posture, start: Posture) -> Iterator[ScriptStep]:
    """Yields the way back to first touch, the opening beyond it, and the rest there."""
    speed = scenario.closing_speed
    yield ScriptStep(phase=f"{phase}:ramp", duration=held.closing / speed, end=replace(held, closing=0.0))
    yield ScriptStep(phase=f"{phase}:settle", duration=scenario.clearance / speed, end=start)
    yield ScriptStep(phase=f"{phase}:settle", duration=scenario.settle, end=start)
    yield ScriptStep(phase=f"{phase}:record", duration=scenario.record, end=start)


def _hold_level(scenario: Scenario, prefix: str, level: float, before: Posture) -> Iterator[ScriptStep]:
    """Yields the way to a level [m] and the rest there."""
    phase, end = f"{prefix}:{_millimetres(level)}", replace(before, closing=float(level))
    yield ScriptStep(phase=f"{phase}:ramp", duration=abs(level - before.closing) / scenario.closing_speed, end=end)
    yield ScriptStep(phase=f"{phase}:settle", duration=scenario.settle, end=end)
    yield ScriptStep(phase=f"{phase}:record", duration=scenario.record, end=end)


def _plan_manipulation(scenario: Scenario, phase: str, held: Posture) -> Iterator[ScriptStep]:
    """Yields lifting, turning there and back and setting down; or drawing the object aside and back."""
    record = f"{phase}:record"
    if scenario.mass > HELD:
        lifted = replace(held, lifted=1.0)
        turned = replace(lifted, turn=scenario.turn_angle)
        yield ScriptStep(phase=record, duration=_LIFT_TIME, end=lifted)
        if scenario.turn_angle:
            duration = abs(scenario.turn_angle) / scenario.turn_rate
            yield ScriptStep(phase=record, duration=duration, end=turned)
            yield ScriptStep(phase=record, duration=scenario.record, end=turned)
            yield ScriptStep(phase=record, duration=duration, end=lifted)
        yield ScriptStep(phase=record, duration=scenario.record, end=lifted)
        yield ScriptStep(phase=record, duration=_LIFT_TIME, end=held)
    if scenario.slide or scenario.rock:
        moved = replace(held, slide=scenario.slide, rock=scenario.rock)
        yield ScriptStep(phase=record, duration=scenario.shift_time, end=moved)
        yield ScriptStep(phase=record, duration=scenario.record, end=moved)
        yield ScriptStep(phase=record, duration=scenario.shift_time, end=held)


def _millimetres(length: float) -> str:
    return f"{1e3 * length:.3g}"
