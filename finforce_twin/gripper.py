"""The synthetic gripper at work: jaws, object and true wrenches image by image; knows no picture and no message."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_contact.outlines import cut_outline
from finforce_ifea.gripper import R_GRIPPER_JAW
from finforce_ifea.jaw import Jaw, load_jaw
from finforce_ifea.meshing import MeshDensity
from finforce_keypoints.gripper_geometry import BENCH_ORIGIN_X
from finforce_twin.errors import ScenarioError
from finforce_twin.grasp import HeldObject, Setting
from finforce_twin.material import PrintedMaterial, RelaxedWrench, draw_material, find_elastic_weight
from finforce_twin.placed_object import place_object
from finforce_twin.pressed_jaw import TWIN_DENSITY, JawShape, PressedJaw
from finforce_twin.scenarios import Scenario
from finforce_twin.script import RATE, Posture, write_script

WIDEST = 0.058  # [m] of a jaw's origin from the middle; fingers of 14 mm half depth leave 88 mm between them
_EMPTY_GAP = 0.002  # [m] from each inner face to the middle where jaws with nothing between them stop


@dataclass(frozen=True, kw_only=True, eq=False)
class JawState:
    """One jaw at one instant; all but its place in its own jaw frame.

    Attributes:
        origin_x: of its frame on the closing axis of `gripper_base` [m].
        vertices: deformed (n, 3) [m], in mesh order.
        keypoints: (K, 3) [m], in the order of the jaw file.
        reference: of the reference point, which does not deform (3,) [m].
        force: that the object applies to the jaw (3,) [N].
        torque: of the same about the jaw frame's origin (3,) [N m].
    """

    origin_x: float
    vertices: NDArray
    keypoints: NDArray
    reference: NDArray
    force: NDArray
    torque: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class TwinState:
    """The gripper at the time of one image.

    Attributes:
        stamp: [s] since the scenario began.
        phase: as in `/bench/phase`, "cycle:load|unload:displacement_mm:ramp|settle|record".
        jaws: by side.
        T_gripper_object: (4, 4) of the object mesh's own frame in `gripper_base`; None without an object.
        gravity: unit vector (3,) in `gripper_base`.
    """

    stamp: float
    phase: str
    jaws: Mapping[str, JawState]
    T_gripper_object: NDArray | None
    gravity: NDArray


class TwinGripper:
    """A gripper that plays a scenario, with a material drawn from a seed."""

    def __init__(self, scenario: Scenario, seed: int, density: MeshDensity | str = TWIN_DENSITY) -> None:
        """Builds jaws and object.

        Args:
            scenario: what happens.
            seed: of the material; the same seed gives the same states to the last digit.
            density: of the jaws' meshes, where they are drawings.

        Raises:
            ScenarioError: The object is too wide for the gripper, or out of the jaws' reach.
            ObjectMeshError: There is no such object.
            JawFileError: There is no such jaw.
        """
        self.scenario = scenario
        self._script = write_script(scenario)
        jaws = {side: load_jaw(scenario.jaw, side) for side in scenario.sides}
        material = jaws["left"].material
        # always of both jaws: the bench's is the same left one
        self.material: PrintedMaterial = draw_material(material, ("left", "right"), np.random.default_rng(seed))
        lateral = bool(scenario.mass and scenario.turn_angle)
        self._jaws = {
            side: PressedJaw(jaw, self.material.elastic[side], density, lateral=lateral) for side, jaw in jaws.items()
        }
        self._object = place_object(scenario) if scenario.object else None
        self.object_mesh = self._object.mesh if self._object else None
        self._touch_opening = self._meet_object()

    def __len__(self) -> int:
        """Returns the number of states."""
        return len(self._script.stamps)

    @property
    def jaws(self) -> Mapping[str, Jaw]:
        """The jaws by side."""
        return {side: pressed.jaw for side, pressed in self._jaws.items()}

    def triangles(self, side: str) -> NDArray:
        """Returns the surface of a jaw as (m, 3) indices of its vertices, normals outwards."""
        return self._jaws[side].mesh.surface

    def rest_vertices(self, side: str) -> NDArray:
        """Returns the undeformed vertices (n, 3) [m] of a jaw in its own frame."""
        return self._jaws[side].mesh.nodes

    def states(self) -> Iterator[TwinState]:
        """Yields the states at `RATE`, always from the beginning.

        Raises:
            GraspError: A jaw buckles, or the object slips or falls.
        """
        script = self._script
        weights = find_elastic_weight(script.weight, script.stamps, self.material.terms)
        # set down, the object rests on the table, which also takes what the creep left
        weights[~script.weight.any(axis=1)] = 0.0
        held = self._hold_object()
        wrenches = {side: RelaxedWrench(self.material.terms) for side in self._jaws}
        posture, weight, shapes = None, None, self._rest_shapes()
        for index, stamp in enumerate(script.stamps):
            is_same = script.postures[index] == posture and np.array_equal(weights[index], weight)
            posture, weight = script.postures[index], weights[index]
            if held is not None and not is_same:
                shapes = held.follow(self._setting(posture, weight))
            x = held.x if held is not None else 0.0
            yield TwinState(
                stamp=float(stamp),
                phase=script.phases[index],
                jaws={side: self._jaw_state(side, posture, shapes[side], wrenches[side]) for side in self._jaws},
                T_gripper_object=self._object_pose(posture, x),
                gravity=script.gravity[index],
            )

    def _meet_object(self) -> float:
        """Shows each jaw the object's outline; returns the opening [m] at which the object just fits.

        Raises:
            ScenarioError: It does not fit, or the jaws would not touch it.
        """
        face, scenario = self._jaws["left"].jaw.inner_face_x, self.scenario
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
        opening = float(np.mean(touches))
        if not opening + scenario.clearance <= WIDEST and len(touches) > 1:
            raise ScenarioError(
                f"{scenario.name}: the object is {2e3 * (opening - face):.0f} mm wide between the jaws, with a "
                f"clearance of {1e3 * scenario.clearance:.0f} mm expected at most "
                f"{2e3 * (WIDEST - face - scenario.clearance):.0f} mm; give a scale, a turn or another object"
            )
        return opening

    def _hold_object(self) -> HeldObject | None:
        if self._object is None:
            return None
        return HeldObject(self._jaws, self.scenario.offset, guided=self.scenario.is_guided)

    def _setting(self, posture: Posture, weight: NDArray) -> Setting:
        return Setting(
            opening=self._touch_opening - posture.closing,
            height=self.scenario.height + posture.slide,
            tilt=posture.rock,
            weight=weight,
        )

    def _rest_shapes(self) -> Mapping[str, JawShape]:
        return {side: jaw.describe(np.zeros(jaw.model.size), None) for side, jaw in self._jaws.items()}

    def _jaw_state(self, side: str, posture: Posture, shape: JawShape, wrench: RelaxedWrench) -> JawState:
        force, torque = wrench.update(shape.force, shape.torque, 1.0 / RATE)
        return JawState(
            origin_x=self._origin_x(side, posture),
            vertices=shape.vertices,
            keypoints=shape.keypoints,
            reference=self._jaws[side].jaw.reference_point,
            force=force,
            torque=torque,
        )

    def _origin_x(self, side: str, posture: Posture) -> float:
        """Returns where a jaw is on the closing axis [m]; that of the bench does not move."""
        if self.scenario.camera == "bench":
            return BENCH_ORIGIN_X
        opening = self._touch_opening - posture.closing
        return -opening if side == "left" else opening

    def _object_pose(self, posture: Posture, x: float) -> NDArray | None:
        if self._object is None:
            return None
        if self.scenario.camera == "bench":
            x = BENCH_ORIGIN_X + self._touch_opening - posture.closing
        return self._object.pose_at(
            np.array([x, self.scenario.shift, self.scenario.height + posture.slide]), posture.rock
        )
