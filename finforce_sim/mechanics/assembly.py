"""The jaws of a synthetic gripper, of drawn material, and the object that they shut on, as they are put together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce.gripper_frames import BENCH_ORIGIN_X
from finforce_contact.localization.section import cut_outline
from finforce_ifea.grasp_force import R_GRIPPER_JAW
from finforce_ifea.jaw.drawing import MeshDensity
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.relaxation import Relaxation, RelaxationTerm, invert_relaxation
from finforce_sim.errors import ScenarioError
from finforce_sim.mechanics.balance import GraspSetting, HeldObject
from finforce_sim.mechanics.pressed_jaw import TWIN_DENSITY, JawShape, PressedJaw
from finforce_sim.scenes.objects import place_object
from finforce_sim.scenes.scenarios import Posture, Scenario

WIDEST = 0.058  # [m] of a jaw's origin from the middle; fingers of 14 mm half depth leave 88 mm between them
_EMPTY_GAP = 0.002  # [m] from each inner face to the middle where jaws with nothing between them stop


class Assembly:
    """The jaws of a scenario, of a material drawn from a seed, and its object.

    Attributes:
        scenario: what is put together.
        material: of the jaws.
        object_mesh: in its own frame; None without an object.
        touch_origin: of the jaws' origins from the middle [m] where the object just fits.
    """

    def __init__(self, scenario: Scenario, seed: int, density: MeshDensity | str = TWIN_DENSITY) -> None:
        """Builds jaws and object.

        Args:
            scenario: what is put together.
            seed: of the material; the same seed gives the same forces to the last digit.
            density: of the jaws' meshes, where they are drawings.

        Raises:
            ScenarioError: The object is too wide for the gripper, or out of the jaws' reach.
            ObjectMeshError: There is no such object.
            JawFileError: There is no such jaw.
        """
        self.scenario = scenario
        jaws = {side: load_jaw(scenario.jaw, side) for side in scenario.sides}
        material = jaws["left"].material
        # always of both jaws: the bench's is the same left one
        self.material: PrintedMaterial = draw_material(material, ("left", "right"), np.random.default_rng(seed))
        lateral = bool(scenario.mass and (scenario.turn_angle or scenario.pitch))
        self._jaws = {
            side: PressedJaw(jaw, self.material.elastic[side], density, lateral=lateral) for side, jaw in jaws.items()
        }
        self._object = place_object(scenario) if scenario.object else None
        self.object_mesh = self._object.mesh if self._object else None
        self.touch_origin = self._meet_object()

    @property
    def jaws(self) -> Mapping[str, Jaw]:
        """The jaws by side."""
        return {side: pressed.jaw for side, pressed in self._jaws.items()}

    @property
    def inner_face_x(self) -> float:
        """Where the undeformed inner face is in the jaw frame [m]."""
        return float(self._jaws["left"].jaw.inner_face_x)

    def triangles(self, side: str) -> NDArray:
        """Returns the surface of a jaw as (m, 3) indices of its vertices, normals outwards."""
        return self._jaws[side].mesh.surface

    def rest_vertices(self, side: str) -> NDArray:
        """Returns the undeformed vertices (n, 3) [m] of a jaw in its own frame."""
        return self._jaws[side].mesh.nodes

    def rest_shapes(self) -> Mapping[str, JawShape]:
        """Returns the jaws as they are when nothing touches them."""
        return {side: jaw.describe(np.zeros(jaw.model.size), None) for side, jaw in self._jaws.items()}

    def hold_object(self) -> HeldObject | None:
        """Returns the object between jaws at rest; None without one."""
        if self._object is None:
            return None
        scenario = self.scenario
        told = {"guided": scenario.is_guided, "friction": scenario.friction, "drag": scenario.drag}
        return HeldObject(self._jaws, scenario.offset, **told)

    def setting_of(self, posture: Posture, weight: NDArray | None = None) -> GraspSetting:
        """Returns what a posture, and a weight (3,) [N] in `gripper_base`, mean to the jaws."""
        return GraspSetting(
            opening=self.touch_origin - posture.closing,
            height=self.scenario.height + posture.slide,
            tilt=posture.rock,
            weight=np.zeros(3) if weight is None else weight,
        )

    def origin_x(self, side: str, posture: Posture) -> float:
        """Returns where a jaw is on the closing axis [m]; that of the bench does not move."""
        if self.scenario.camera == "bench":
            return BENCH_ORIGIN_X
        origin = self.touch_origin - posture.closing
        return -origin if side == "left" else origin

    def object_pose(self, posture: Posture, x: float) -> NDArray | None:
        """Returns T_gripper_object (4, 4) of an object at x [m] between two jaws; None without an object."""
        if self._object is None:
            return None
        if self.scenario.camera == "bench":
            x = BENCH_ORIGIN_X + self.touch_origin - posture.closing
        place = np.array([x, self.scenario.shift, self.scenario.height + posture.slide])
        return self._object.pose_at(place, posture.rock)

    def _meet_object(self) -> float:
        """Shows each jaw the object's outline; returns the origins' distance [m] at which the object just fits.

        Raises:
            ScenarioError: It does not fit, or the jaws would not touch it.
        """
        face, scenario = self.inner_face_x, self.scenario
        if self._object is None:
            return face + _EMPTY_GAP
        touches = []
        for side, pressed in self._jaws.items():
            R = R_GRIPPER_JAW[side].T
            polygons = cut_outline(self._object.centred, R, pressed.half_width, float(R[1, 1]) * scenario.shift)
            if not polygons:
                raise ScenarioError(f"{scenario.name}: the object lies beside the jaws; set shift nearer to 0")
            pressed.meet(polygons)
            touches.append(pressed.find_touch(scenario.height, 0.0))
        origin = float(np.mean(touches))
        if not origin + scenario.clearance <= WIDEST and len(touches) > 1:
            raise ScenarioError(
                f"{scenario.name}: the object is {2e3 * (origin - face):.0f} mm wide between the jaws, with a "
                f"clearance of {1e3 * scenario.clearance:.0f} mm expected at most "
                f"{2e3 * (WIDEST - face - scenario.clearance):.0f} mm; give a scale, a turn or another object"
            )
        return origin


# Printed parts are stiffer than the data sheet says; two parts of one print differ less than two prints.
_STIFFER, _PART_STDDEV = (1.1, 1.4), 0.02
_SHARE = (0.04, 0.09)
_TIMES = ((1.5, 3.0), (7.0, 14.0))  # [s]


@dataclass(frozen=True, kw_only=True, eq=False)
class PrintedMaterial:
    """What the jaws of one gripper are made of.

    Attributes:
        elastic: of each side.
        terms: of the relaxation, the same in both jaws, so that relaxed forces balance as elastic ones do.
    """

    elastic: Mapping[str, Material]
    terms: tuple[RelaxationTerm, ...]


def draw_material(datasheet: Material, sides: Sequence[str], rng: np.random.Generator) -> PrintedMaterial:
    """Returns a material about that of the data sheet, with two branches of relaxation."""
    modulus = datasheet.young_modulus * rng.uniform(*_STIFFER)
    parts = {side: float(modulus * np.exp(_PART_STDDEV * rng.standard_normal())) for side in sides}
    terms = tuple(
        RelaxationTerm(share=float(rng.uniform(*_SHARE)), time_constant=float(rng.uniform(*times))) for times in _TIMES
    )
    elastic = {
        side: Material(young_modulus=value, poisson_ratio=datasheet.poisson_ratio) for side, value in parts.items()
    }
    return PrintedMaterial(elastic=elastic, terms=terms)


def find_elastic_weight(weight: NDArray, stamps: NDArray, terms: Sequence[RelaxationTerm]) -> NDArray:
    """Returns the loads (n, 3) [N] that an elastic jaw must carry so that the relaxed forces are the weight (n, 3) [N].

    Under a steady weight the jaws creep: their shape is that of a load which grows from less than the weight to it.
    """
    return np.stack([invert_relaxation(column, stamps, terms) for column in weight.T], axis=1)


class RelaxedWrench:
    """Force and torque on one jaw as its material gives way; both by the same linear filter."""

    def __init__(self, terms: Sequence[RelaxationTerm]) -> None:
        """Starts relaxed."""
        self._force, self._torque = Relaxation(terms), Relaxation(terms)

    def update(self, force: NDArray, torque: NDArray, dt: float) -> tuple[NDArray, NDArray]:
        """Returns force (3,) [N] and torque (3,) [N m] for the elastic ones, dt [s] later; no torque without force."""
        relaxed, turned = self._force.update(force, dt), self._torque.update(torque, dt)
        return relaxed, turned if relaxed.any() else np.zeros(3)
