"""The synthetic gripper at work: jaws, object and true wrenches image by image."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce_ifea.jaw.drawing import MeshDensity
from finforce_sim.mechanics.assembly import Assembly, RelaxedWrench, find_elastic_weight
from finforce_sim.mechanics.pressed_jaw import TWIN_DENSITY, JawShape
from finforce_sim.scenes.scenarios import Posture, Scenario, write_script


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

    def blend(self, other: "TwinState", share: float) -> "TwinState":
        """Returns the state at a share of the way to another: x = (1 - s) x + s x_other; turns the short way."""
        pose = self.T_gripper_object
        if pose is not None:
            pose = _blend_poses(pose, other.T_gripper_object, share)
        return replace(
            self,
            stamp=_blend(self.stamp, other.stamp, share),
            jaws={side: _blend_jaws(jaw, other.jaws[side], share) for side, jaw in self.jaws.items()},
            T_gripper_object=pose,
            gravity=_blend(self.gravity, other.gravity, share),
        )


def _blend(value: Any, other: Any, share: float) -> Any:
    return (1.0 - share) * value + share * other


def _blend_jaws(jaw: JawState, other: JawState, share: float) -> JawState:
    """Returns a jaw between two states: place, shape and wrench."""
    return replace(jaw, **{name: _blend(value, vars(other)[name], share) for name, value in vars(jaw).items()})


def _blend_poses(pose: NDArray, other: NDArray, share: float) -> NDArray:
    """Returns a pose (4, 4) between two."""
    turn = Rotation.from_matrix(pose[:3, :3].T @ other[:3, :3]).as_rotvec()
    blended = _blend(pose, other, share)
    blended[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    return blended


class TwinGripper(Assembly):
    """A gripper that plays a scenario, with a material drawn from a seed."""

    def __init__(self, scenario: Scenario, seed: int, density: MeshDensity | str = TWIN_DENSITY) -> None:
        """Builds jaws and object and writes the script; see `Assembly`."""
        super().__init__(scenario, seed, density)
        self._script = write_script(scenario)

    def __len__(self) -> int:
        """Returns the number of states."""
        return len(self._script.stamps)

    def states(self) -> Iterator[TwinState]:
        """Yields the states at the scenario's rate, always from the beginning.

        Raises:
            GraspError: A jaw buckles, or the object slips or falls.
        """
        script = self._script
        weights = find_elastic_weight(script.weight, script.stamps, self.material.terms)
        # set down, the object rests on the table, which also takes what the creep left
        weights[~script.weight.any(axis=1)] = 0.0
        held = self.hold_object()
        wrenches = {side: RelaxedWrench(self.material.terms) for side in self._jaws}
        posture, weight, shapes, slid = None, None, self.rest_shapes(), 0.0
        for index, stamp in enumerate(script.stamps):
            slid += held.creep / self.scenario.rate if held is not None else 0.0
            planned = script.postures[index]
            planned = replace(planned, slide=planned.slide + slid)
            is_same = planned == posture and np.array_equal(weights[index], weight)
            posture, weight = planned, weights[index]
            if held is not None and not is_same:
                shapes = held.follow(self.setting_of(posture, weight))
            x = held.x if held is not None else 0.0
            yield TwinState(
                stamp=float(stamp),
                phase=script.phases[index],
                jaws={side: self._jaw_state(side, posture, shapes[side], wrenches[side]) for side in self._jaws},
                T_gripper_object=self.object_pose(posture, x),
                gravity=script.gravity[index],
            )

    def _jaw_state(self, side: str, posture: Posture, shape: JawShape, wrench: RelaxedWrench) -> JawState:
        force, torque = wrench.update(shape.force, shape.torque, 1.0 / self.scenario.rate)
        return JawState(
            origin_x=self.origin_x(side, posture),
            vertices=shape.vertices,
            keypoints=shape.keypoints,
            reference=self._jaws[side].jaw.reference_point,
            force=force,
            torque=torque,
        )
