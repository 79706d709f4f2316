"""The forward problem: a jaw pressed on a rigid object step by step."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import SMOOTH_DEPTH, PenaltyContact, RoundIndenter
from finforce_ifea.contact_mechanics.pressed_jaw import ContactSurface, limit_step
from finforce_ifea.errors import ContactError
from finforce_ifea.fem.model import JawModel

# Of the last Newton step: absolute [m], and as a share of the depth.
_TOLERANCE, _FINE = 1e-8, 1e-6
_ITERATIONS = 60
_LONGEST_STEP = 0.5e-3
_SHORTEST_STEP = 1e-6
# A falling force that loses more than this share of the step's work, or any that gains as much, is a snap to another
# shape; smooth limit points keep the balance within 3 %.
_SNAP = 0.1


class RigidObject(Protocol):
    """A rigid object, endless along y; its nearest point to the jaw comes first into the jaw."""

    def press(self, points: NDArray, stiffness: NDArray, face_x: float, depth: float, height: float) -> PenaltyContact:
        """Return the contact with points (p, 3) [m] of an object sunk by depth [m] below x = face_x at height [m]."""
        ...


@dataclass(frozen=True, kw_only=True)
class RigidCylinder:
    """A cylinder with its axis along y; radius [m]."""

    radius: float

    def press(self, points: NDArray, stiffness: NDArray, face_x: float, depth: float, height: float) -> PenaltyContact:
        """See `RigidObject`."""
        return RoundIndenter().press(points, stiffness, face_x, np.array([depth, np.log(self.radius), height]))


def measure_penalty_energy(forces: NDArray, stiffness: NDArray) -> float:
    """Return the energy [J] that the penalty stores where it pushes with forces (p, 3) [N].

    With k = stiffness (p,) [N/m], s = 20 um and d the depth that belongs to a force it is k d^3 / (6 s) up to s, and
    k (d^2 - s^2) / 2 - k s (d - s) / 2 more beyond.
    """
    push, smooth = np.linalg.norm(forces, axis=1) / stiffness, SMOOTH_DEPTH
    depth = np.where(push < 0.5 * smooth, np.sqrt(2.0 * smooth * push), push + 0.5 * smooth)
    beyond = np.maximum(depth - smooth, 0.0)
    cubic = np.minimum(depth, smooth) ** 3 / (6.0 * smooth)
    return float((stiffness * (cubic + 0.5 * beyond * (depth + smooth) - 0.5 * smooth * beyond)).sum())


@dataclass(frozen=True, kw_only=True, eq=False)
class PressState:
    """One equilibrium of the pressed jaw.

    Attributes:
        depth: of the object below the undeformed inner face [m].
        q: unknowns of the model.
        force: on the jaw (3,) [N].
        torque: of the contact forces about the jaw frame's origin (3,) [N m].
        pressure_centre: on the deformed surface (3,) [m]; NaN without contact.
        pressure_location: the same material point on the undeformed surface (3,) [m].
        energy: elastic energy [J].
        iterations: Newton iterations since the last returned depth.
    """

    depth: float
    q: NDArray
    force: NDArray
    torque: NDArray
    pressure_centre: NDArray
    pressure_location: NDArray
    energy: float
    iterations: int


def press_jaw(
    model: JawModel,
    surface: ContactSurface,
    face_x: float,
    rigid: RigidObject,
    height: float,
    depths: Sequence[float],
) -> list[PressState]:
    """Press a rigid object into the inner surface, displacement driven, frictionless.

    Args:
        model: the jaw's mechanics.
        surface: its contact points.
        face_x: plane of the undeformed inner surface [m].
        rigid: the object.
        height: of its centre above the clamped base [m].
        depths: rising depths [m]; steps between them are cut to half a millimetre, and further where needed.

    Raises:
        ContactError: No stable equilibrium is found that is reached without a snap; the message says at which depth.
    """
    setting = _Setting(model=model, surface=surface, face_x=face_x, rigid=rigid, height=height)
    state, reached, results = _State(q=np.zeros(model.size), push=0.0, energy=0.0, iterations=0), 0.0, []
    for depth in depths:
        iterations, step = 0, _LONGEST_STEP
        while reached < depth - 1e-12:
            target = min(reached + step, depth)
            trial = _find_equilibrium(setting, state.q, target)
            if trial is not None and not _snaps(state, trial, target - reached):
                state, reached, iterations = trial, target, iterations + trial.iterations
                continue
            step *= 0.5
            if step < _SHORTEST_STEP:
                raise ContactError(
                    f"no equilibrium beyond a depth of {1e3 * reached:.3f} mm: the jaw buckles or slips off"
                )
        results.append(_describe(setting, state.q, depth, iterations))
    return results


def follow_points(model: JawModel, points: NDArray, presses: Sequence[PressState]) -> NDArray:
    """Return where material points (k, 3) [m] of a jaw are at rest and in n presses (n + 1, k, 3) [m]."""
    probe = model.attach(points, max_distance=1.0)
    return np.stack([model.positions(probe, q) for q in (np.zeros(model.size), *(press.q for press in presses))])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Setting:
    """What is pressed, and on what."""

    model: JawModel
    surface: ContactSurface
    face_x: float
    rigid: RigidObject
    height: float

    def press(self, points: NDArray, depth: float) -> PenaltyContact:
        """Return the contact with the surface's points (p, 3) [m] at a depth [m]."""
        return self.rigid.press(points, self.surface.stiffness, self.face_x, depth, self.height)


@dataclass(frozen=True, kw_only=True, eq=False)
class _State:
    """An equilibrium: unknowns, force against the object [N], energy of jaw and surface [J], Newton iterations."""

    q: NDArray
    push: float
    energy: float
    iterations: int


def _find_equilibrium(setting: _Setting, q: NDArray, depth: float) -> _State | None:
    """Return the stable equilibrium at `depth` by Newton's method, or None when it finds none."""
    model, surface, tolerance = setting.model, setting.surface, min(_TOLERANCE, _FINE * depth)
    for iteration in range(1, _ITERATIONS + 1):
        contact = setting.press(model.positions(surface.probe, q), depth)
        state = model.linearize(q)
        if not state.smallest_det > 0:
            return None
        model.stiffen(state.tangent, surface.probe, q, contact.springs)
        load, factor = model.load(surface.probe, q, contact.forces), model.factorise(state.tangent)
        step = limit_step(model, factor.solve(load - state.force))
        q = q + step
        if not np.isfinite(q).all():
            return None
        if np.abs(step).max() < tolerance:
            energy = state.energy + measure_penalty_energy(contact.forces, surface.stiffness)
            push = -float(contact.forces[:, 0].sum())
            return _State(q=q, push=push, energy=energy, iterations=iteration) if factor.positive else None
    return None


def _snaps(before: _State, after: _State, way: float) -> bool:
    """Whether the jaw has jumped to another shape over a way [m] of the object, or has let go of it."""
    if before.push > 0.0 and after.push == 0.0:
        return True
    work = 0.5 * way * (before.push + after.push)
    lost = work - (after.energy - before.energy)
    return lost < -_SNAP * abs(work) or (after.push < before.push and lost > _SNAP * abs(work))


def _describe(setting: _Setting, q: NDArray, depth: float, iterations: int) -> PressState:
    model, surface = setting.model, setting.surface
    points = model.positions(surface.probe, q)
    forces = setting.press(points, depth).forces
    size = np.linalg.norm(forces, axis=1)
    share = size / size.sum() if size.any() else np.full(len(size), np.nan)
    in_plane = np.array([1.0, 0.0, 1.0])
    return PressState(
        depth=depth,
        q=q,
        force=forces.sum(0),
        torque=np.cross(points * in_plane, forces).sum(0),
        pressure_centre=(share @ points) * in_plane,
        pressure_location=(share @ surface.points) * in_plane,
        energy=model.linearize(q, tangent=False).energy,
        iterations=iterations,
    )
