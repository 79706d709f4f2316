"""The synthetic gripper: playing a scenario image by image, or as a function of the jaws' opening."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce_ifea.grasp_force import Wrench
from finforce_ifea.jaw.drawing import MeshDensity
from finforce_sim.mechanics import TWIN_DENSITY, Assembly, JawShape, RelaxedWrench, find_elastic_weight
from finforce_sim.scenarios import BalanceError, Posture, Scenario, ScenarioError, write_script

FINGER = 0  # seed of the material for which the package has a calibration, `twin`


@dataclass(frozen=True, kw_only=True, eq=False)
class JawState(JawShape):
    """One jaw at one instant.

    Attributes:
        origin_x: of its frame on the closing axis of `gripper_base` [m].
    """

    origin_x: float

    def blend(self, other: JawState, share: float) -> JawState:
        """Return the state at a share of the way to another: position, shape and wrench."""
        return JawState(**{name: _blend(value, vars(other)[name], share) for name, value in vars(self).items()})


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

    def looks_like(self, other: TwinState | None) -> bool:
        """Say whether jaws and object are where they are in another state; forces may differ."""
        if other is None or not np.array_equal(self.T_gripper_object, other.T_gripper_object):
            return False
        pairs = [(jaw, other.jaws[side]) for side, jaw in self.jaws.items()]
        return all(one.vertices is two.vertices and one.origin_x == two.origin_x for one, two in pairs)

    def blend(self, other: TwinState, share: float) -> TwinState:
        """Return the state at a share of the way to another: x = (1 - s) x + s x_other; turns the short way."""
        pose = self.T_gripper_object
        if pose is not None:
            turn = Rotation.from_matrix(pose[:3, :3].T @ other.T_gripper_object[:3, :3]).as_rotvec()
            blended = _blend(pose, other.T_gripper_object, share)
            blended[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
            pose = blended
        return replace(
            self,
            stamp=_blend(self.stamp, other.stamp, share),
            jaws={side: jaw.blend(other.jaws[side], share) for side, jaw in self.jaws.items()},
            T_gripper_object=pose,
            gravity=_blend(self.gravity, other.gravity, share),
        )


def _blend(value: Any, other: Any, share: float) -> Any:
    return (1.0 - share) * value + share * other


class TwinGripper(Assembly):
    """A gripper that plays a scenario, with a material drawn from a seed."""

    def __init__(self, scenario: Scenario, seed: int, density: MeshDensity | str = TWIN_DENSITY) -> None:
        """Build jaws and object and writes the script; see `Assembly`."""
        super().__init__(scenario, seed, density)
        self._script = write_script(scenario)

    def __len__(self) -> int:
        """Return the number of states."""
        return len(self._script.stamps)

    def states(self) -> Iterator[TwinState]:
        """Yield the states at the scenario's rate, always from the beginning.

        Raises:
            GraspError: A jaw buckles, or the object slips or falls.
        """
        script = self._script
        weights = find_elastic_weight(script.weight, script.stamps, self.material.terms)
        # set down, the object rests on the table, which also takes what the creep left
        weights[~script.weight.any(axis=1)] = 0.0
        held = self.hold_object()
        wrenches = {side: RelaxedWrench(self.material.terms) for side in self.jaws}
        posture, weight, shapes, slid = None, None, self.rest_shapes(), 0.0
        for index, stamp in enumerate(script.stamps):
            slid += held.creep / self.scenario.rate if held is not None else 0.0
            planned = script.postures[index]
            planned = replace(planned, slide=planned.slide + slid)
            is_same = planned == posture and np.array_equal(weights[index], weight)
            posture, weight = planned, weights[index]
            if held is not None and not is_same:
                shapes = held.follow(self.setting_of(posture, weight))
            x, carried = (held.x, held.carried) if held is not None else (0.0, 0.0)
            yield TwinState(
                stamp=float(stamp),
                phase=script.phases[index],
                jaws={side: self._jaw_state(side, posture, shapes[side], wrenches[side]) for side in self.jaws},
                T_gripper_object=self.object_pose(posture, x, carried),
                gravity=script.gravity[index],
            )

    def _jaw_state(self, side: str, posture: Posture, shape: JawShape, wrench: RelaxedWrench) -> JawState:
        relaxed = wrench.update(Wrench(shape.force, shape.torque), 1.0 / self.scenario.rate)
        return JawState(**vars(shape) | relaxed._asdict(), origin_x=self.origin_x(side, posture))


STEP = 1e-4  # [m] of each jaw from one solved grasp to the next
JAMMED = 5e4  # [N/m] of opening, by which the force grows where jaws find no equilibrium any more
_DOWN = np.array([0.0, 0.0, 1.0])


class PressedGrasp(Assembly):
    """A scenario's jaws and object, shut as far as one likes; no weight is lifted and nothing slides.

    Attributes:
        touch_opening: at which the object just fits [m]; -inf without an object.
        least_opening: down to which the grasp is solved [m]; below it the jaws jam.
    """

    def __init__(
        self, scenario: Scenario, seed: int = FINGER, density: MeshDensity | str = TWIN_DENSITY, step: float = STEP
    ) -> None:
        """Solve the grasp from first touch on, until the jaws' faces would meet or no equilibrium is left.

        Args:
            scenario: jaws, object and where it lies.
            seed: of the material.
            density: of the jaws' meshes, where they are drawings.
            step: of each jaw from one solved grasp to the next [m], at most.

        Raises:
            FinforceError: The scenario's object or jaw cannot be used.
            BalanceError: The jaws cannot shut on the object at all.
        """
        super().__init__(scenario, seed, density)
        self._reach = self.touch_origin - self.jaws["left"].inner_face_x  # of each jaw, from touch to closed
        self._solve(step)
        sizes = np.array([np.linalg.norm(table.force, axis=1) for table in self._tables.values()])
        self._forces = sizes.min(axis=0)
        is_empty = self.object_mesh is None
        self.touch_opening = -np.inf if is_empty else 2.0 * self._reach
        self.least_opening = 0.0 if is_empty else float(2.0 * (self._reach - self._closings[-1]))

    def _solve(self, step: float) -> None:
        """Solve grasps from first touch on, at most `step` [m] of closing apart; without an object the jaws at rest."""
        held, solved, places = self.hold_object(), [], []
        closings = np.linspace(0.0, self._reach, int(np.ceil(self._reach / step)) + 1) if held else np.zeros(1)
        for closing in closings:
            try:
                setting = self.setting_of(Posture(closing=float(closing)))
                solved.append(held.follow(setting) if held else self.rest_shapes())
            except BalanceError:
                if len(solved) < 2:
                    raise
                break
            places.append((held.x, held.carried) if held else (0.0, 0.0))
        self._closings, self._places = closings[: len(solved)], np.array(places)
        self._tables = {side: _stack_shapes([shapes[side] for shapes in solved]) for side in self.jaws}

    def relaxation(self) -> dict[str, RelaxedWrench]:
        """Return by side what makes of a jaw's elastic wrenches those of its material, which begins relaxed."""
        return {side: RelaxedWrench(self.material.terms) for side in self.jaws}

    def closing_at(self, opening: float) -> float:
        """Return how far each jaw is beyond first touch [m] at an opening [m], negative before."""
        return self._reach - 0.5 * opening

    def elastic_force(self, opening: float) -> float:
        """Return the grasp force [N] at an opening [m] before anything relaxes: that of the jaw pressed less."""
        if not opening < self.touch_opening:  # most of the time, and asked several times a millisecond
            return 0.0
        return self._find_growth(opening) * float(np.interp(self.closing_at(opening), self._closings, self._forces))

    def find_closing(self, force: float) -> float:
        """Return how far beyond first touch [m] each jaw goes for an elastic grasp force [N].

        Raises:
            ScenarioError: The jaws meet before they press that hard.
        """
        if not force <= self._forces[-1]:
            name, most = self.scenario.name, self._forces[-1]
            raise ScenarioError(f"{name}: {force:g} N, expected at most {most:.1f} N, with which the jaws have met")
        return float(np.interp(force, np.maximum.accumulate(self._forces), self._closings))

    def wrenches(self, opening: float) -> Mapping[str, Wrench]:
        """Return the elastic wrench on each jaw at an opening [m]."""
        growth = self._find_growth(opening)
        return {
            side: Wrench(
                force=growth * self._read(table.force, opening), torque=growth * self._read(table.torque, opening)
            )
            for side, table in self._tables.items()
        }

    def state(self, opening: float, stamp: float = 0.0) -> TwinState:
        """Return jaws and object at an opening [m], with elastic wrenches, as of a stamp [s]."""
        wrenches, posture = self.wrenches(opening), Posture(closing=self.closing_at(opening))
        jaws = {
            side: JawState(
                origin_x=self.origin_x(side, posture),
                vertices=self._read(table.vertices, opening),
                keypoints=self._read(table.keypoints, opening),
                **wrenches[side]._asdict(),
            )
            for side, table in self._tables.items()
        }
        return TwinState(stamp=stamp, phase="", jaws=jaws, T_gripper_object=self.pose_at(opening), gravity=_DOWN)

    def pose_at(self, opening: float) -> NDArray | None:
        """Return T_gripper_object (4, 4) at an opening [m]; None without an object."""
        closing = self.closing_at(opening)
        return self.object_pose(Posture(closing=closing), *self._place_object(closing))

    def _find_growth(self, opening: float) -> float:
        """Return by which factor forces exceed the table's last ones; 0 without contact, for that has no force."""
        if not opening < self.touch_opening:
            return 0.0
        return 1.0 + JAMMED * max(self.least_opening - opening, 0.0) / max(self._forces[-1], 1e-9)

    def _place_object(self, closing: float) -> tuple[float, float]:
        """Return x and `carried` [m]: solved in contact; before, where the object lay unless a jaw has pushed it."""
        if closing >= 0.0:
            x, carried = (float(np.interp(closing, self._closings, places)) for places in self._places.T)
            return x, carried
        pushed = self._places[0, 0]
        return float(np.clip(self.scenario.offset, pushed + closing, pushed - closing)), 0.0

    def _read(self, rows: NDArray, opening: float) -> NDArray:
        """Return what lies between two rows of a table (m, ...) at an opening [m]."""
        row = np.interp(self.closing_at(opening), self._closings, np.arange(len(self._closings)))
        low = min(int(row), max(len(rows) - 2, 0))
        share, high = row - low, min(low + 1, len(rows) - 1)
        return (1.0 - share) * rows[low] + share * rows[high]


def _stack_shapes(shapes: Sequence[JawShape]) -> JawShape:
    """Return shapes of one jaw as rows of arrays: vertices (m, n, 3), keypoints (m, K, 3), force and torque (m, 3)."""
    return JawShape(**{name: np.stack([getattr(shape, name) for shape in shapes]) for name in vars(shapes[0])})
