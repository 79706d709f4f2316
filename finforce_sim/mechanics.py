"""Jaws of drawn material in equilibrium with an object: one pressed jaw, the balance of two, and their assembly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.gripper_frames import BENCH_ORIGIN_X
from finforce_contact.section import cut_outline
from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, Traction, measure_shear
from finforce_ifea.contact_mechanics.indenter import OutlineIndenter, PenaltyContact, flat_profile
from finforce_ifea.contact_mechanics.pressed_jaw import (
    build_contact_surface,
    limit_step,
    load_columns,
    profile_surface,
    solve_contact,
)
from finforce_ifea.fem.model import JawModel
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.grasp_force import R_GRIPPER_JAW, Wrench
from finforce_ifea.jaw.drawing import MeshDensity
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw, load_jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.mechanics import build_plane_model
from finforce_ifea.relaxation import Relaxation, RelaxationTerm, invert_relaxation
from finforce_sim.objects import place_object
from finforce_sim.scenarios import BalanceError, Posture, Scenario, ScenarioError

# Finer along bands and ribs than the mesh that the estimator takes by default.
TWIN_DENSITY = MeshDensity(between_ribs=10, through_band=1, along_rib=10, through_rib=1, tip=2, across_width=2)


@dataclass(frozen=True, kw_only=True, eq=False)
class Load:
    """The loads on a jaw from outside; all in the jaw frame.

    Attributes:
        origin: x and z of the outline's origin (2,) [m].
        tilt: of the outline [rad].
        pull: force along the surface (3,) [N], spread over the contact as the pressure is.
    """

    origin: NDArray
    tilt: float
    pull: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class JawStep:
    """A Newton step of one jaw.

    Attributes:
        correction: of the unknowns towards equilibrium (size,).
        mode: motion of the unknowns as the object moves along x (size,) [per m].
        force: of the pressure (3,) [N] before the step.
        push: its x component after the correction [N].
        slope: derivative of that by the object's x [N/m].
        smallest_det: smallest det F of all elements [-].
    """

    correction: NDArray
    mode: NDArray
    force: NDArray
    push: float
    slope: float
    smallest_det: float


@dataclass(frozen=True, kw_only=True, eq=False)
class JawShape:
    """One jaw as it stands, in its own frame.

    Attributes:
        vertices: deformed (n, 3) [m], in mesh order.
        keypoints: (K, 3) [m], in the order of the jaw file.
        force: that the object applies, by pressure and pull (3,) [N]; elastic as long as nothing relaxes it.
        torque: of the same about the jaw frame's origin (3,) [N m].
    """

    vertices: NDArray
    keypoints: NDArray
    force: NDArray
    torque: NDArray


class PressedJaw:
    """The mechanics of one jaw, and the outline that is pressed into it, which its surface may stick to."""

    def __init__(
        self,
        jaw: Jaw,
        material: Material,
        density: MeshDensity | str | None,
        *,
        lateral: bool,
        roughness: float = 0.0,
    ) -> None:
        """Build mesh, model and contact surface.

        Args:
            jaw: the jaw, of its own side.
            material: material of this jaw.
            density: of the mesh of a drawing.
            lateral: True if loads along y will come; else a mesh that mirrors itself is halved.
            roughness: Coulomb coefficient [-] between surface and object while these move; 0: none.
        """
        self.jaw, self._roughness = jaw, roughness
        self.mesh = jaw.build_mesh(density if jaw.drawing is not None else None)
        self.model = _build_model(jaw, self.mesh, material, lateral=lateral)
        self.surface = build_contact_surface(jaw, self.mesh, self.model, across=self.model.across)
        self.half_width = float(np.abs(self.mesh.nodes[:, 1]).max())
        self._keypoints = self.model.attach(jaw.keypoints, KEYPOINT_DISTANCE)
        self._indenter: OutlineIndenter | None = None
        self._origin: NDArray | None = None
        self._traction = FRICTIONLESS

    def keep(self, q: NDArray, load: Load | None) -> None:
        """Keep what the next equilibrium has to know of friction in this one at unknowns q (size,); None: no load."""
        if not self._roughness:
            return
        points = self.model.positions(self.surface.probe, q)
        shear = np.zeros(len(points))
        if load is not None:
            shear = measure_shear(self._press(q, load).forces, self._press(q, load, FRICTIONLESS).forces)
        self._traction = Traction(0.0, np.full(len(points), self._roughness), shear, points, np.zeros(2))
        self._origin = None if load is None else load.origin

    def meet(self, polygons: tuple[NDArray, ...]) -> None:
        """Take the outline of the object, polygons (n, 2) [m] about its origin; raises ContactError if too small."""
        self._indenter = OutlineIndenter(polygons)

    def find_touch(self, height: float, tilt: float) -> float:
        """Return the x [m] of an outline's origin at the given height [m] where it first touches the jaw at rest."""
        pose = np.array([0.0, tilt, height])
        if self.jaw.face.is_flat:
            profile = flat_profile(float(self.surface.low[1]), float(self.surface.high[1]), self.jaw.inner_face_x)
        else:
            profile = profile_surface(self.surface, self.jaw.face)
        depth = self._indenter.find_touch(pose, profile)
        return self.jaw.inner_face_x + self._indenter.pressed.front - depth

    def find_pressure(self, q: NDArray, load: Load) -> NDArray:
        """Return the force of the pressure alone (3,) [N] at unknowns q (size,)."""
        return self._press(q, load).forces.sum(0)

    def find_carry(self, before: NDArray, q: NDArray, load: Load) -> NDArray:
        """Return the pressure times the surface's motion along z [N m] since unknowns (size,), and the pressure [N]."""
        size = np.linalg.norm(self._press(q, load).forces, axis=1)
        before, now = (self.model.positions(self.surface.probe, unknowns)[:, 2] for unknowns in (before, q))
        return np.array([size @ (now - before), size.sum()])

    def linearize(self, q: NDArray, load: Load) -> JawStep:
        """Return the Newton step of f_int(q) = J^T (p(J q, origin) + pull shares) at unknowns q (size,).

        With S the springs of the points, the load by the object's x is J^T S e_x, and J^T S^T e_x tells the push that
        the jaw's motion takes away; friction makes S unsymmetric.
        """
        model, probe = self.model, self.surface.probe
        contact = self._press(q, load)
        state = model.linearize(q)
        model.stiffen(state.tangent, probe, q, 0.5 * (contact.springs + contact.springs.transpose(0, 2, 1)))
        forces = contact.forces + _share_pull(contact.forces, load.pull)
        columns = np.stack([forces, contact.springs[:, :, 0], contact.springs[:, 0]], axis=2)
        loads = load_columns(model, probe, q, columns)
        loads[:, 0] -= state.force
        steps = solve_contact(model, probe, q, model.factorise(state.tangent), loads[:, :2], contact.springs)
        force = contact.forces.sum(0)
        return JawStep(
            correction=steps[:, 0],
            mode=steps[:, 1],
            force=force,
            push=float(force[0] - loads[:, 2] @ steps[:, 0]),
            slope=float(contact.springs[:, 0, 0].sum() - loads[:, 2] @ steps[:, 1]),
            smallest_det=state.smallest_det,
        )

    def describe(self, q: NDArray, load: Load | None) -> JawShape:
        """Return shape and elastic wrench at equilibrium; without a load nothing touches."""
        points = self.model.positions(self.surface.probe, q)
        forces = np.zeros_like(points)
        if load is not None:
            forces = self._press(q, load).forces
            forces = forces + _share_pull(forces, load.pull)
        if getattr(self.model, "symmetric", False):
            # each point stands for its mirror image, too
            points, forces = points * [1.0, 0.0, 1.0], forces * [1.0, 0.0, 1.0]
        return JawShape(
            vertices=self.model.vertices(q),
            keypoints=self.model.positions(self._keypoints, q),
            force=forces.sum(0),
            torque=np.cross(points, forces).sum(0),
        )

    def _press(self, q: NDArray, load: Load, traction: Traction | None = None) -> PenaltyContact:
        points = self.model.positions(self.surface.probe, q)
        pose = np.array([self._indenter.pressed.front - load.origin[0], load.tilt, load.origin[1]])
        if traction is None:
            traction = self._traction
            if self._origin is not None:
                traction = traction._replace(moved=load.origin - self._origin)
        return self._indenter.press(points, self.surface.stiffness, 0.0, pose, traction)


def _share_pull(forces: NDArray, pull: NDArray) -> NDArray:
    """Return the pull (3,) [N] divided among points (p, 3) as the sizes of their forces (p, 3) are; none without."""
    size = np.linalg.norm(forces, axis=1)
    total = size.sum()
    return size[:, None] / total * pull if total > 0.0 else np.zeros_like(forces)


def _build_model(jaw: Jaw, mesh: Any, material: Material, *, lateral: bool) -> JawModel:
    """Return a solid, the plane model of a section without loads along y, or the frame of what no solid describes."""
    if jaw.section is not None and not lateral:
        return build_plane_model(replace(jaw, material=material), mesh)
    if jaw.drawing is None or jaw.drawing.is_solid:
        return SolidModel(mesh, material, symmetric=not lateral)
    from finforce_ifea.fem.frame import FrameModel

    return FrameModel(jaw.drawing, material, mesh=mesh)


_SETTLED = 1e-6  # [m] of the last Newton step, a hundredth of what a camera sees
_LEAST_PULL = 0.02  # [N] that sticks anyhow
_ITERATIONS = 40
_FULL_STEPS = 12  # iterations before steps are shortened ...
_LATER_STEPS = 0.3  # [-], to this share
_SHORTEST = 1.0 / 128.0  # of the way from one image to the next
_LARGEST_SHIFT = 1e-3  # [m] of the object in one Newton step
_SOFTEST = 1e-3  # [N/m] of both jaws together, below which a balance tells nothing of the object's position
_STRONGEST = 50.0  # [N]; fingers that bend give way far below


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspSetting:
    """The command to the jaws.

    Attributes:
        opening: of the jaws' origins from the middle [m].
        height: z of the object's origin [m].
        tilt: of the object from x to z [rad].
        weight: (3,) [N] in `gripper_base`.
    """

    opening: float
    height: float
    tilt: float
    weight: NDArray

    def between(self, other: GraspSetting, share: float) -> GraspSetting:
        """Return the setting that lies the share [-] of the way towards another."""
        mine, theirs = vars(self), vars(other)
        return GraspSetting(**{key: mine[key] + share * (theirs[key] - mine[key]) for key in mine})


@dataclass(frozen=True, kw_only=True, eq=False)
class _Balance:
    """An equilibrium: unknowns (size,) and loads of each jaw, and the object's x [m]."""

    q: Mapping[str, NDArray]
    loads: Mapping[str, Load | None]
    x: float


class HeldObject:
    """An object between the jaws, free along x, or before a single jaw at x = 0; height and tilt are given.

    The pressure follows from the shapes and has no friction. What it and the weight leave along y and z is taken up by
    the jaws' surfaces as a pull, each in proportion to its pressure, unless a hand guides the object. The surfaces that
    hold it carry it along the fingers as these bend.

    Attributes:
        carried: distance along z by which the jaws have carried the object [m].
        creep: speed at which the object slides along z [m/s]: what the pulls have beyond the friction, over the drag.
    """

    def __init__(self, jaws: Mapping[str, PressedJaw], x: float, *, guided: bool, friction: float, drag: float) -> None:
        """Start with jaws at rest.

        Args:
            jaws: by side.
            x: of the object [m].
            guided: True if a hand holds the object.
            friction: share of a pressure that the pull may have before the object slides.
            drag: of a sliding object [N s/m]; 0: it would fall, which is an error.
        """
        self._jaws, self._guided, self._is_free = jaws, guided, len(jaws) > 1
        self._friction, self._drag, self.creep, self.carried = friction, drag, 0.0, 0.0
        rest = {side: np.zeros(jaw.model.size) for side, jaw in jaws.items()}
        for side, jaw in jaws.items():
            jaw.keep(rest[side], None)
        self._balance = _Balance(q=rest, loads=dict.fromkeys(jaws), x=x if self._is_free else 0.0)
        self._setting: GraspSetting | None = None
        self._before: _Balance | None = None

    @property
    def x(self) -> float:
        """The position of the object on the closing axis [m]."""
        return self._balance.x

    def follow(self, setting: GraspSetting) -> Mapping[str, JawShape]:
        """Move to a setting and returns the jaws' shapes; the way is halved where Newton's method does not converge.

        Raises:
            BalanceError: There is no equilibrium, or the object would slip or fall.
        """
        start, reached, step = self._setting or setting, 0.0, 1.0
        while reached < 1.0:
            share = min(reached + step, 1.0)
            balance, carried = self._carry(start.between(setting, share))
            if balance is not None:
                self._before = self._balance if step == 1.0 else None
                self._balance, self.carried, reached = balance, carried, share
                for side, jaw in self._jaws.items():
                    jaw.keep(balance.q[side], balance.loads[side])
                continue
            self._before, step = None, 0.5 * step
            if step < _SHORTEST:
                raise BalanceError(
                    f"no equilibrium at an opening of {1e3 * setting.opening:.2f} mm: a jaw buckles or slips off; "
                    "close less far or grasp at another height"
                )
        self._setting = setting
        q, loads = self._balance.q, self._balance.loads
        return {side: jaw.describe(q[side], loads[side]) for side, jaw in self._jaws.items()}

    def _carry(self, setting: GraspSetting) -> tuple[_Balance | None, float]:
        """Return the balance at a setting, None where none is found, and how far the object is carried [m]."""
        balance = self._solve(setting, self.carried)
        carried = self._find_carry(balance)
        if carried != self.carried:
            balance = self._solve(setting, carried, balance)
            carried = self._find_carry(balance)
        return balance, carried

    def _find_carry(self, balance: _Balance | None) -> float:
        """Return how far the object is carried [m] where the jaws go on to another balance."""
        loads = [] if balance is None else [*self._balance.loads.values(), *balance.loads.values()]
        if self._guided or not self._is_free or not loads or None in loads:
            return self.carried
        found = [jaw.find_carry(self._balance.q[s], balance.q[s], balance.loads[s]) for s, jaw in self._jaws.items()]
        moved, pressure = np.sum(found, axis=0)
        return self.carried + (float(moved / pressure) if pressure > 0.0 else 0.0)

    def _solve(self, setting: GraspSetting, carried: float, near: _Balance | None = None) -> _Balance | None:
        """Return the balance of an object that is carried [m]; None when Newton's method does not find it.

        Args:
            setting: of the jaws, and where the object would lie without being carried.
            carried: along z [m].
            near: where the search begins; None: on as the jaws went.
        """
        setting = replace(setting, height=setting.height + carried)
        gaps = {side: self._gap(side, setting) for side in self._jaws}
        if sum(gaps.values()) >= 0.0:
            return self._release(setting, gaps)
        q, x = self._predict(gaps) if near is None else (dict(near.q), near.x)
        for iteration in range(_ITERATIONS):
            loads = self._find_loads(q, x, setting)
            steps = {side: jaw.linearize(q[side], loads[side]) for side, jaw in self._jaws.items()}
            if not all(step.smallest_det > 0.0 for step in steps.values()):
                return None
            dx = self._find_shift(steps, setting)
            moves = {side: step.correction + _along(side) * dx * step.mode for side, step in steps.items()}
            cut = min(_cut(self._jaws[side], move) for side, move in moves.items())
            # points that stick and slide in turn keep full steps from settling
            cut *= 1.0 if iteration < _FULL_STEPS else _LATER_STEPS
            q, x = {side: q[side] + cut * move for side, move in moves.items()}, x + cut * dx
            change = max(np.abs(move).max() for move in moves.values())
            if not np.isfinite(change):
                return None
            if change < _SETTLED:
                loads = self._find_loads(q, x, setting)
                self._check_grip(steps, loads)
                return _Balance(q=q, loads=loads, x=x)
        return None

    def _predict(self, gaps: Mapping[str, float]) -> tuple[dict[str, NDArray], float]:
        """Return where the search begins: on as it went, or with the object in the middle when first touched."""
        last = self._balance
        if not all(load is not None for load in last.loads.values()):
            return dict(last.q), 0.5 * (gaps["right"] - gaps["left"]) if self._is_free else last.x
        if self._before is None:
            return dict(last.q), last.x
        return {side: 2.0 * last.q[side] - self._before.q[side] for side in last.q}, 2.0 * last.x - self._before.x

    def _find_loads(self, q: Mapping[str, NDArray], x: float, setting: GraspSetting) -> dict[str, Load]:
        """Return each jaw's load: the object's position, and as pull what pressures leave of the weight in y and z."""
        loads = {
            side: Load(
                origin=np.array([setting.opening + _along(side) * x, setting.height]),
                tilt=_along(side) * setting.tilt,
                pull=np.zeros(3),
            )
            for side in q
        }
        if self._guided:
            return loads
        pressures = {side: jaw.find_pressure(q[side], loads[side]) for side, jaw in self._jaws.items()}
        sizes = {side: float(np.linalg.norm(pressure)) for side, pressure in pressures.items()}
        total = sum(sizes.values())
        rest = setting.weight - sum(R_GRIPPER_JAW[side] @ pressure for side, pressure in pressures.items())
        rest = rest * (0.0, 1.0, 1.0) / total if total > 0.0 else np.zeros(3)
        return {side: replace(load, pull=sizes[side] * R_GRIPPER_JAW[side].T @ rest) for side, load in loads.items()}

    def _gap(self, side: str, setting: GraspSetting) -> float:
        """Return how far [m] the object at x = 0 is from first touch with a jaw at rest."""
        return setting.opening - self._jaws[side].find_touch(setting.height, _along(side) * setting.tilt)

    def _release(self, setting: GraspSetting, gaps: Mapping[str, float]) -> _Balance:
        """Return jaws at rest, and the object where it was unless a jaw has pushed it."""
        if np.abs(setting.weight).max() > 0.0:
            raise BalanceError(f"the jaws let go of {np.linalg.norm(setting.weight):.2f} N; set the object down first")
        self.creep = 0.0
        rest = {side: np.zeros(jaw.model.size) for side, jaw in self._jaws.items()}
        x = float(np.clip(self.x, -gaps["left"], gaps["right"])) if self._is_free else 0.0
        return _Balance(q=rest, loads=dict.fromkeys(self._jaws), x=x)

    def _find_shift(self, steps: Mapping[str, JawStep], setting: GraspSetting) -> float:
        """Return the object's way dx [m] that balances the pushes: sum of +-(push +- slope dx) = weight_x."""
        slope = sum(step.slope for step in steps.values())
        if not self._is_free or slope < _SOFTEST:
            return 0.0
        push = sum(_along(side) * step.push for side, step in steps.items())
        return float(np.clip((setting.weight[0] - push) / slope, -_LARGEST_SHIFT, _LARGEST_SHIFT))

    def _check_grip(self, steps: Mapping[str, JawStep], loads: Mapping[str, Load]) -> None:
        self.creep = 0.0
        for side, load in loads.items():
            pressure, needed = np.linalg.norm(steps[side].force), np.linalg.norm(load.pull)
            if pressure > _STRONGEST:
                raise BalanceError(
                    f"the {side} jaw is pressed with {pressure:.0f} N, more than such a finger bears: the object meets "
                    "its clamped base; close less far or raise the object's height"
                )
            held = self._friction * pressure
            if needed <= held + _LEAST_PULL:
                continue
            if self._drag == 0.0:
                raise BalanceError(
                    f"the object slips: the {side} jaw must pull with {needed:.2f} N and holds at most {held:.2f} N; "
                    "close further, or lift less"
                )
            self.creep += (needed - held) * float(load.pull[2]) / needed / self._drag


def _along(side: str) -> float:
    """Return the sign of a jaw's x axis in the gripper; a tilt from x to z has the same sign."""
    return float(R_GRIPPER_JAW[side][0, 0])


def _cut(jaw: PressedJaw, move: NDArray) -> float:
    """Return the share [-] of a Newton step that moves no node too far at once."""
    size = np.abs(move).max()
    return float(np.abs(limit_step(jaw.model, move)).max() / size) if size > 0.0 else 1.0


WIDEST = 0.058  # [m] of a jaw's origin from the middle; fingers of 14 mm half depth leave 88 mm between them
_EMPTY_GAP = 0.002  # [m] from each inner face to the middle where jaws with nothing between them stop


class Assembly:
    """The jaws of a scenario, of a material drawn from a seed, and its object.

    Attributes:
        scenario: object, jaws and motion.
        material: of the jaws.
        pressed: the jaws' mechanics and meshes, by side.
        object_mesh: in its own frame; None without an object.
        touch_origin: of the jaws' origins from the middle [m] where the object just fits.
    """

    def __init__(self, scenario: Scenario, seed: int, density: MeshDensity | str = TWIN_DENSITY) -> None:
        """Build jaws and object.

        Args:
            scenario: object, jaws and motion.
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
        told = {"lateral": lateral, "roughness": scenario.roughness}
        self.pressed = {
            side: PressedJaw(jaw, self.material.elastic[side], density, **told) for side, jaw in jaws.items()
        }
        self._object = place_object(scenario) if scenario.object else None
        self.object_mesh = self._object.mesh if self._object else None
        self.touch_origin = self._meet_object()

    @property
    def jaws(self) -> Mapping[str, Jaw]:
        """The jaws by side."""
        return {side: pressed.jaw for side, pressed in self.pressed.items()}

    def rest_shapes(self) -> Mapping[str, JawShape]:
        """Return the jaws as they are when nothing touches them."""
        return {side: jaw.describe(np.zeros(jaw.model.size), None) for side, jaw in self.pressed.items()}

    def hold_object(self) -> HeldObject | None:
        """Return the object between jaws at rest; None without one."""
        if self._object is None:
            return None
        scenario = self.scenario
        told = {"guided": scenario.is_guided, "friction": scenario.friction, "drag": scenario.drag}
        return HeldObject(self.pressed, scenario.offset, **told)

    def setting_of(self, posture: Posture, weight: NDArray | None = None) -> GraspSetting:
        """Return what a posture, and a weight (3,) [N] in `gripper_base`, mean to the jaws."""
        return GraspSetting(
            opening=self.touch_origin - posture.closing,
            height=self.scenario.height + posture.slide,
            tilt=posture.rock,
            weight=np.zeros(3) if weight is None else weight,
        )

    def origin_x(self, side: str, posture: Posture) -> float:
        """Return where a jaw is on the closing axis [m]; that of the bench does not move."""
        if self.scenario.camera == "bench":
            return BENCH_ORIGIN_X
        origin = self.touch_origin - posture.closing
        return -origin if side == "left" else origin

    def object_pose(self, posture: Posture, x: float, carried: float) -> NDArray | None:
        """Return T_gripper_object (4, 4) of an object at x [m] between two jaws, see `HeldObject`; None without one."""
        if self._object is None:
            return None
        if self.scenario.camera == "bench":
            x = BENCH_ORIGIN_X + self.touch_origin - posture.closing
        position = np.array([x, self.scenario.shift, self.scenario.height + posture.slide + carried])
        return self._object.pose_at(position, posture.rock)

    def _meet_object(self) -> float:
        """Show each jaw the object's outline; return the origins' distance [m] at which the object just fits.

        Raises:
            ScenarioError: It does not fit, or the jaws would not touch it.
        """
        face, scenario = self.jaws["left"].inner_face_x, self.scenario
        if self._object is None:
            return face + _EMPTY_GAP
        touches = []
        for side, pressed in self.pressed.items():
            R = R_GRIPPER_JAW[side].T
            polygons = cut_outline(self._object.centred, R, pressed.half_width, float(R[1, 1]) * scenario.shift)
            if not polygons:
                raise ScenarioError(f"{scenario.name}: the object lies out of reach of the jaws; set shift nearer to 0")
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


_STIFFER = (1.1, 1.4)  # [-], range of the modulus of prints over that of the data sheet
_PART_STDDEV = 0.02  # [-], 1 sigma between parts of one print, which differ less than two prints
_SHARE = (0.04, 0.09)
_TIMES = ((1.5, 3.0), (7.0, 14.0))  # [s]


@dataclass(frozen=True, kw_only=True, eq=False)
class PrintedMaterial:
    """The material of the jaws of one gripper.

    Attributes:
        elastic: of each side.
        terms: of the relaxation, the same in both jaws, so that relaxed forces balance as elastic ones do.
    """

    elastic: Mapping[str, Material]
    terms: tuple[RelaxationTerm, ...]


def draw_material(datasheet: Material, sides: Sequence[str], rng: np.random.Generator) -> PrintedMaterial:
    """Return a material about that of the data sheet, with two branches of relaxation."""
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
    """Return the loads (n, 3) [N] that an elastic jaw must carry so that the relaxed forces are the weight (n, 3) [N].

    Under a steady weight the jaws creep: their shape is that of a load which grows from less than the weight to it.
    """
    return np.stack([invert_relaxation(column, stamps, terms) for column in weight.T], axis=1)


class RelaxedWrench:
    """Force and torque on one jaw as its material gives way; both by the same linear filter."""

    def __init__(self, terms: Sequence[RelaxationTerm]) -> None:
        """Start relaxed."""
        self._force, self._torque = Relaxation(terms), Relaxation(terms)

    def update(self, elastic: Wrench, dt: float) -> Wrench:
        """Return the wrench for an elastic one, dt [s] later; no torque without force."""
        force, torque = self._force.update(elastic.force, dt), self._torque.update(elastic.torque, dt)
        return Wrench(force=force, torque=torque if force.any() else np.zeros(3))
