"""What happens in a synthetic recording, as numbers with names."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from finforce.settings import check_bounds, setting
from finforce_twin.errors import ScenarioError

CAMERAS = ("robot", "bench")
LIGHTS = ("bright", "dim", "any")
HELD = 1e-6  # [kg] of mass from which on an object is lifted


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A course of one or two jaws and an object, every number of which can be overridden.

    The robot's two jaws close alike on an object that is free along x; the bench's left jaw stays where it is and the
    object comes to it. The object lies with the middle of its bounding box at (offset, shift, height).
    """

    name: str
    jaw: str = setting("bench", "a shipped jaw's name or a jaw file", "")
    object: str = setting("rod25", "a name of finforce_twin.scenes.objects or a mesh file; empty for none", "")
    unit: str = setting("m", "of the coordinates of a mesh file", choices=("m", "mm", "cm", "inch"))
    scale: float = setting(1.0, "by which the object is enlarged", "", 0.05, 20.0)
    turn_x: float = setting(0.0, "turn of the object about the gripper's x, before y and z", "rad", -np.pi, np.pi)
    turn_y: float = setting(0.0, "turn of the object about the gripper's y", "rad", -np.pi, np.pi)
    turn_z: float = setting(0.0, "turn of the object about the gripper's z", "rad", -np.pi, np.pi)
    height: float = setting(0.042, "z of the object's middle at first", "m", 0.0, 0.2)
    offset: float = setting(0.0, "x of the object's middle at first, between two jaws", "m", -0.05, 0.05)
    shift: float = setting(0.0, "y of the object's middle", "m", -0.05, 0.05)
    camera: str = setting("robot", "two jaws before the wrist camera, or one before that of the bench", choices=CAMERAS)
    light: str = setting("bright", "how the scene is lit", choices=LIGHTS)
    clearance: float = setting(0.008, "from each jaw to first touch while open", "m", 5e-4, 0.06)
    closing_speed: float = setting(0.020, "of each jaw", "m/s", 5e-4, 0.3)
    displacement: float = setting(0.006, "of each jaw beyond first touch, at most", "m", 0.0, 0.02)
    levels: int = setting(1, "equal steps up to the displacement, and down again", "", 1, 20)
    cycles: int = setting(1, "how often the object is grasped", "", 1, 20)
    tare: float = setting(1.7, "of stillness without load at the beginning", "s", 1.7, 60.0)
    settle: float = setting(0.5, "of rest at each level before it is recorded", "s", 0.0, 60.0)
    record: float = setting(0.7, "of record at each level", "s", 0.1, 60.0)
    mass: float = setting(0.0, "of the object that is lifted", "kg", 0.0, 2.0)
    turn_angle: float = setting(0.0, "by which the wrist turns with the object", "rad", -2.0 * np.pi, 2.0 * np.pi)
    turn_rate: float = setting(0.8, "at which it does", "rad/s", 0.05, 10.0)
    turn_heading: float = setting(0.0, "of the wrist's axis in the x-y plane, from x to y", "rad", -np.pi, np.pi)
    slide: float = setting(0.0, "by which a hand draws the held object along z, and back", "m", -0.03, 0.03)
    rock: float = setting(0.0, "by which a hand tilts the held object from x to z, and back", "rad", -0.4, 0.4)
    shift_time: float = setting(1.5, "which each way of that takes", "s", 0.1, 60.0)

    def __post_init__(self) -> None:
        """Refuses numbers beyond their bounds, and what cannot be together.

        Raises:
            ScenarioError: a value is out of its bounds, or a weight is lifted while a hand holds it, on the bench, or
                without an object.
        """
        check_bounds(self, ScenarioError)
        lifted = self.mass > HELD
        if lifted and (self.slide or self.rock or self.camera == "bench" or not self.object):
            raise ScenarioError(
                f"{self.name}: got a mass of {self.mass:g} kg to lift together with a slide, a rock, the bench or no "
                "object; set mass to 0, or slide and rock to 0 with the robot's camera and an object"
            )
        if self.turn_angle and not lifted:
            raise ScenarioError(f"{self.name}: the wrist turns with nothing held, expected a mass above 0")

    @property
    def sides(self) -> tuple[str, ...]:
        """The jaws that there are."""
        return ("left",) if self.camera == "bench" else ("left", "right")

    @property
    def is_guided(self) -> bool:
        """Whether the object is held by something else than the jaws."""
        return bool(self.camera == "bench" or self.slide or self.rock)


_BENCH = {"camera": "bench", "closing_speed": 0.002, "clearance": 0.001, "levels": 3, "height": 0.040}
_TURN = {"object": "rod25", "displacement": 0.007, "mass": 0.08, "turn_angle": 0.5 * np.pi, "turn_heading": 0.6}
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
    Scenario(name="rocking", object="block", rock=0.12, displacement=0.005),
    Scenario(name="fast_close", object="rod25", closing_speed=0.06, clearance=0.015, cycles=3, record=0.4, settle=0.2),
    Scenario(name="empty_close", object="", clearance=0.028, displacement=0.0, cycles=2),
)
SCENARIOS: dict[str, Scenario] = {scenario.name: scenario for scenario in _ALL}


def build_scenario(name: str, **overrides: Any) -> Scenario:
    """Returns the scenario of a name with some of its fields replaced.

    Raises:
        ScenarioError: There is no such scenario or field, or a value is out of its bounds.
    """
    if name not in SCENARIOS:
        raise ScenarioError(f"scenario {name!r}: expected one of {', '.join(SCENARIOS)}")
    unknown = [key for key in overrides if key not in Scenario.__dataclass_fields__]
    if unknown:
        known = ", ".join(Scenario.__dataclass_fields__)
        raise ScenarioError(f"scenario {name!r}: got the field {unknown[0]!r}, expected one of {known}")
    return replace(SCENARIOS[name], **overrides)
