"""The scenes of synthetic recordings, as numbers with names, and their motion over time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce.errors import FinforceError
from finforce.gripper_frames import CAMERAS
from finforce.settings import check_bounds, setting
from finforce_ifea.jaw.jaw import load_jaw


class ScenarioError(FinforceError, ValueError):
    """A scenario is not known, or its numbers fit no gripper."""


class BalanceError(FinforceError, RuntimeError):
    """Jaws and object find no equilibrium: a jaw buckles, or the object slips or falls."""


RATE = 30.0  # [Hz] of the images, unless a scene says otherwise
LIGHTS = ("bright", "dim", "any")
HELD = 1e-6  # [kg] of mass from which on an object is lifted


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A sequence of motions of one or two jaws and an object, every number of which can be overridden.

    The robot's two jaws close alike on an object that is free along x; the bench's left jaw stays where it is and the
    object comes to it. The object lies with the middle of its bounding box at (offset, shift, height).
    """

    name: str
    jaw: str = setting("bench", "Jaw file, or name of an included jaw", "")
    object: str = setting("rod25", "Object, by a name of finforce_sim.objects or a mesh file; empty for none", "")
    unit: str = setting("m", "Unit of a mesh file", choices=("m", "mm", "cm", "inch"))
    scale: float = setting(1.0, "Scale of the object", "", 0.05, 20.0)
    turn_x: float = setting(0.0, "Rotation of the object about the gripper's x, before y and z", "rad", -np.pi, np.pi)
    turn_y: float = setting(0.0, "Rotation of the object about the gripper's y", "rad", -np.pi, np.pi)
    turn_z: float = setting(0.0, "Rotation of the object about the gripper's z", "rad", -np.pi, np.pi)
    height: float = setting(0.042, "Initial z of the object's middle", "m", 0.0, 0.2)
    offset: float = setting(0.0, "Initial x of the object's middle between two jaws", "m", -0.05, 0.05)
    shift: float = setting(0.0, "y of the object's middle", "m", -0.05, 0.05)
    camera: str = setting(
        "robot",
        "Camera: on the wrist, of the bench before a single jaw, on the wrist upside down, or beyond the tips",
        choices=tuple(CAMERAS),
    )
    light: str = setting("bright", "Light", choices=LIGHTS)
    rate: float = setting(RATE, "Image rate", "Hz", 1.0, 240.0)
    readout: float = setting(
        0.0, "Readout time from the first row of an image to the last one, which the stamp is of", "s", 0.0, 0.1
    )
    clearance: float = setting(0.008, "Distance of each open jaw from first touch", "m", 5e-4, 0.06)
    closing_speed: float = setting(0.020, "Speed of each jaw", "m/s", 5e-4, 0.3)
    displacement: float = setting(0.006, "Maximum displacement of each jaw beyond first touch", "m", 0.0, 0.02)
    levels: int = setting(1, "Number of equal steps up to the displacement", "", 1, 20)
    cycles: int = setting(1, "Number of grasps", "", 1, 20)
    tare: float = setting(1.7, "Unloaded time at the beginning", "s", 1.7, 60.0)
    settle: float = setting(0.5, "Settling time at each step", "s", 0.0, 60.0)
    record: float = setting(0.7, "Recorded time at each step", "s", 0.1, 60.0)
    mass: float = setting(0.0, "Mass of the object that is lifted", "kg", 0.0, 2.0)
    friction: float = setting(0.9, "Friction coefficient, up to which the object does not slip", "", 0.05, 2.0)
    roughness: float = setting(0.0, "Coulomb coefficient at an object whose height is kept; 0: none", "", 0.0, 1.5)
    tracking: float = setting(10.0, "Rate of the object's measured poses", "Hz", 0.5, 240.0)
    probe: float = setting(0.0, "Way back of each jaw at half the displacement, before it goes on", "m", 0.0, 0.01)
    drag: float = setting(0.0, "Drag of an object that slips; 0: slipping is an error", "N s/m", 0.0, 1e4)
    turn_angle: float = setting(0.0, "Rotation of the wrist with the object", "rad", -2.0 * np.pi, 2.0 * np.pi)
    turn_rate: float = setting(0.8, "Rate of that rotation", "rad/s", 0.05, 10.0)
    turn_heading: float = setting(
        0.0, "Direction of the rotation axis in the x-y plane, from x to y", "rad", -np.pi, np.pi
    )
    turn_tilt: float = setting(
        0.0, "Angle of the rotation axis out of that plane, to z", "rad", -0.5 * np.pi, 0.5 * np.pi
    )
    pitch: float = setting(0.0, "Pitch of the gripper about its x; 0: it looks down", "rad", -np.pi, np.pi)
    slide: float = setting(0.0, "Distance by which a hand moves the held object along z, and back", "m", -0.03, 0.03)
    rock: float = setting(0.0, "Angle by which a hand tilts the held object from x to z, and back", "rad", -0.4, 0.4)
    shift_time: float = setting(1.5, "Time of each of these motions", "s", 0.1, 60.0)

    def __post_init__(self) -> None:
        """Refuse numbers beyond their bounds, and what cannot be together.

        Raises:
            ScenarioError: a value is out of its bounds, an image takes longer than there is to the next, or a weight is
                lifted while a hand holds it, on the bench, or without an object.
        """
        check_bounds(self, ScenarioError)
        lifted = self.mass > HELD
        if lifted and (self.is_guided or not self.object):
            raise ScenarioError(
                f"{self.name}: got a mass of {self.mass:g} kg to lift together with a slide, a rock, a roughness, the "
                "bench or no object; set mass to 0, or the others to 0 with the robot's camera and an object"
            )
        if self.readout * self.rate > 1.0:
            raise ScenarioError(
                f"{self.name}: got a readout of {self.readout:g} s at {self.rate:g} Hz; expected no more than the "
                f"{1.0 / self.rate:g} s between two images"
            )
        if self.turn_angle and not lifted:
            raise ScenarioError(f"{self.name}: the wrist turns with nothing held, expected a mass above 0")

    @property
    def sides(self) -> tuple[str, ...]:
        """The jaws that there are."""
        return ("left",) if self.camera == "bench" else ("left", "right")

    @property
    def is_guided(self) -> bool:
        """True if something else than the jaws keeps the object's height."""
        return bool(self.camera == "bench" or self.slide or self.rock or self.roughness)


_BENCH = {"camera": "bench", "closing_speed": 0.002, "clearance": 0.001, "levels": 3, "height": 0.040}
_TURN = {"object": "rod25", "displacement": 0.007, "mass": 0.08, "turn_angle": 0.5 * np.pi, "turn_heading": 0.6}
_SLIP = {"height": 0.036, "mass": 0.25, "friction": 0.3, "drag": 150.0, "record": 1.0}
_ALL = (
    Scenario(name="bench_cylinder", object="rod25", **_BENCH),
    Scenario(name="bench_cylinder_upper", object="rod15", **{**_BENCH, "height": 0.058}),
    Scenario(name="bench_cylinder_lower", object="rod35", **{**_BENCH, "height": 0.024}),
    Scenario(name="bench_cube", object="block", **_BENCH),
    Scenario(name="grasp_cylinder", object="rod25"),
    Scenario(name="grasp_cube", object="block"),
    Scenario(name="grasp_asymmetric", object="wedge", offset=0.003),
    Scenario(name="hold", object="rod35", displacement=0.007, record=6.0),
    Scenario(name="weight_turn", **_TURN),
    Scenario(name="weight_turn_dim", light="dim", **_TURN),
    Scenario(name="shifting", object="rod15", slide=0.012, height=0.038),
    Scenario(name="slipping", object="block", displacement=0.005, **_SLIP),
    Scenario(name="rocking", object="block", rock=0.12, displacement=0.005),
    Scenario(name="fast_close", object="rod25", closing_speed=0.06, clearance=0.015, cycles=3, record=0.4, settle=0.2),
    Scenario(name="empty_close", object="", clearance=0.028, displacement=0.0, cycles=2),
)
SCENARIOS: dict[str, Scenario] = {scenario.name: scenario for scenario in _ALL}


def build_scenario(name: str, **overrides: Any) -> Scenario:
    """Return the scenario of a name with some of its fields replaced.

    Raises:
        ScenarioError: There is no such scenario or field, or a value is out of its bounds.
        JawFileError: There is no such jaw.
    """
    if name not in SCENARIOS:
        raise ScenarioError(f"scenario {name!r}: expected one of {', '.join(SCENARIOS)}")
    unknown = [key for key in overrides if key not in Scenario.__dataclass_fields__]
    if unknown:
        known = ", ".join(Scenario.__dataclass_fields__)
        raise ScenarioError(f"scenario {name!r}: got the field {unknown[0]!r}, expected one of {known}")
    return replace(SCENARIOS[name], **_fit_jaw(SCENARIOS[name], overrides), **overrides)


def _fit_jaw(scenario: Scenario, overrides: dict[str, Any]) -> dict[str, float]:
    """Return height and displacement for another jaw than the scene's, where they are not given.

    The object meets the same share of the jaw's candidates, and a shorter jaw is pressed as much less.
    """
    if overrides.get("jaw", scenario.jaw) == scenario.jaw:
        return {}
    own, other = (load_jaw(name).candidates[:, 2] for name in (scenario.jaw, overrides["jaw"]))
    share = (scenario.height - own.min()) / np.ptp(own)
    fitted = {
        "height": float(other.min() + share * np.ptp(other)),
        "displacement": scenario.displacement * min(float(np.ptp(other) / np.ptp(own)), 1.0),
    }
    return {key: value for key, value in fitted.items() if key not in overrides}


GRAVITY = 9.81  # [m/s^2]
_DOWN = np.array([0.0, 0.0, 1.0])  # of a gripper that looks down
_LIFT_TIME = 0.6
_TARE_RECORD = 0.5


@dataclass(frozen=True, kw_only=True)
class Posture:
    """The positions of everything at one instant.

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
class _ScriptStep:
    """A straight way from the last posture to the next; its phase is that of `/bench/phase`."""

    phase: str
    duration: float
    end: Posture


@dataclass(frozen=True, kw_only=True, eq=False)
class Script:
    """The motions at every image, n of them.

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
    """Return the motions of a scenario, sampled at its `rate`."""
    start = Posture(closing=-scenario.clearance)
    steps = list(_plan_steps(scenario, start))
    ends = np.concatenate([[0.0], np.cumsum([step.duration for step in steps])])
    stamps = np.arange(int(round(ends[-1] * scenario.rate)) + 1) / scenario.rate
    corners = np.array([list(vars(posture).values()) for posture in (start, *(step.end for step in steps))])
    columns = [np.interp(stamps, ends, column) for column in corners.T]
    # an image between two steps belongs to the later one, whatever the rounding
    running = np.clip(np.searchsorted(ends, stamps + 1e-9) - 1, 0, len(steps) - 1)
    postures = tuple(Posture(**dict(zip(vars(start), row, strict=True))) for row in np.stack(columns, axis=1).tolist())
    heading, tilt = scenario.turn_heading, scenario.turn_tilt
    axis = np.array([np.cos(tilt) * np.cos(heading), np.cos(tilt) * np.sin(heading), np.sin(tilt)])
    begin = Rotation.from_rotvec([scenario.pitch, 0.0, 0.0]).apply(_DOWN)
    gravity = Rotation.from_rotvec(np.outer([posture.turn for posture in postures], axis)).apply(begin)
    lifted = np.array([posture.lifted for posture in postures])
    return Script(
        stamps=stamps,
        phases=tuple(steps[i].phase for i in running),
        postures=postures,
        gravity=gravity,
        weight=scenario.mass * GRAVITY * lifted[:, None] * gravity,
    )


def _plan_steps(scenario: Scenario, start: Posture) -> Iterator[_ScriptStep]:
    """Yield still, close, load level by level, what is done while held, unload, open; the middle for each cycle."""
    yield _ScriptStep(phase="0:load:0:settle", duration=scenario.tare - _TARE_RECORD, end=start)
    yield _ScriptStep(phase="0:load:0:record", duration=_TARE_RECORD, end=start)
    levels = scenario.displacement * np.arange(scenario.levels + 1) / scenario.levels
    levels = levels if scenario.displacement > 0.0 else levels[:1]
    for cycle in range(scenario.cycles):
        closed = Posture(closing=0.0)
        approach = scenario.clearance / scenario.closing_speed
        yield _ScriptStep(phase=f"{cycle}:load:0:ramp", duration=approach, end=closed)
        if scenario.probe:
            half = 0.5 * float(levels[-1])
            for way in (half, max(half - scenario.probe, 0.0)):
                probed = replace(closed, closing=way)
                duration = abs(way - closed.closing) / scenario.closing_speed
                yield _ScriptStep(phase=f"{cycle}:load:{_millimetres(way)}:ramp", duration=duration, end=probed)
                closed = probed
        for level in levels[1:]:
            yield from _hold_level(scenario, f"{cycle}:load", level, closed)
            closed = replace(closed, closing=float(level))
        yield from _plan_manipulation(scenario, f"{cycle}:load:{_millimetres(levels[-1])}", closed)
        for level in levels[-2:0:-1]:
            yield from _hold_level(scenario, f"{cycle}:unload", level, closed)
            closed = replace(closed, closing=float(level))
        yield from _release(scenario, f"{cycle}:unload:0", closed, start)


def _release(scenario: Scenario, phase: str, held: Posture, start: Posture) -> Iterator[_ScriptStep]:
    """Yield the way back to first touch, the opening beyond it, and the rest there."""
    speed = scenario.closing_speed
    yield _ScriptStep(phase=f"{phase}:ramp", duration=held.closing / speed, end=replace(held, closing=0.0))
    yield _ScriptStep(phase=f"{phase}:settle", duration=scenario.clearance / speed, end=start)
    yield _ScriptStep(phase=f"{phase}:settle", duration=scenario.settle, end=start)
    yield _ScriptStep(phase=f"{phase}:record", duration=scenario.record, end=start)


def _hold_level(scenario: Scenario, prefix: str, level: float, before: Posture) -> Iterator[_ScriptStep]:
    """Yield the way to a level [m] and the rest there."""
    phase, end = f"{prefix}:{_millimetres(level)}", replace(before, closing=float(level))
    yield _ScriptStep(phase=f"{phase}:ramp", duration=abs(level - before.closing) / scenario.closing_speed, end=end)
    yield _ScriptStep(phase=f"{phase}:settle", duration=scenario.settle, end=end)
    yield _ScriptStep(phase=f"{phase}:record", duration=scenario.record, end=end)


def _plan_manipulation(scenario: Scenario, phase: str, held: Posture) -> Iterator[_ScriptStep]:
    """Yield lifting, turning there and back and setting down; or drawing the object aside and back."""
    record = f"{phase}:record"
    if scenario.mass > HELD:
        lifted = replace(held, lifted=1.0)
        turned = replace(lifted, turn=scenario.turn_angle)
        yield _ScriptStep(phase=record, duration=_LIFT_TIME, end=lifted)
        if scenario.turn_angle:
            duration = abs(scenario.turn_angle) / scenario.turn_rate
            yield _ScriptStep(phase=record, duration=duration, end=turned)
            yield _ScriptStep(phase=record, duration=scenario.record, end=turned)
            yield _ScriptStep(phase=record, duration=duration, end=lifted)
        yield _ScriptStep(phase=record, duration=scenario.record, end=lifted)
        yield _ScriptStep(phase=record, duration=_LIFT_TIME, end=held)
    if scenario.slide or scenario.rock:
        moved = replace(held, slide=scenario.slide, rock=scenario.rock)
        yield _ScriptStep(phase=record, duration=scenario.shift_time, end=moved)
        yield _ScriptStep(phase=record, duration=scenario.record, end=moved)
        yield _ScriptStep(phase=record, duration=scenario.shift_time, end=held)


def _millimetres(length: float) -> str:
    return f"{1e3 * length:.3g}"
