"""Jaws pressed on rigid objects: equilibria step by step, and what lies between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, Traction, measure_shear
from finforce_ifea.contact_mechanics.indenter import (
    SMOOTH_DEPTH,
    OutlineIndenter,
    PenaltyContact,
    RoundIndenter,
    flat_profile,
)
from finforce_ifea.contact_mechanics.pressed_jaw import ContactSurface, PressedState, RigidContact, limit_step
from finforce_ifea.errors import ContactError
from finforce_ifea.fem.model import JawModel

AROUND = 96  # corners of a polygon that stands for a circle
# Of the last Newton step: absolute [m], and as a share of the depth.
_TOLERANCE, _FINE = 1e-8, 1e-6
_ITERATIONS = 60
_LONGEST_STEP = 0.5e-3
_SHORTEST_STEP = 1e-6
# A falling force that loses more than this share of the step's work, or any that gains as much, is a snap to another
# shape; smooth limit points keep the balance within 3 %.
_SNAP = 0.1
# Newton steps that are taken in full.
_FULL_STEPS = 12
# Last Newton step of a jaw with friction, as a share of the model's reach.
_SETTLED = 1e-4
_Press = Callable[[NDArray, float], PenaltyContact]


def circle(radius: float) -> NDArray:
    """Return a round outline (n, 2) [m]."""
    angles = 2.0 * np.pi * np.arange(AROUND) / AROUND
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


@dataclass(frozen=True, kw_only=True)
class RigidCylinder:
    """A cylinder with its axis along y; radius [m]."""

    radius: float

    def press(self, points: NDArray, stiffness: NDArray, face_x: float, depth: float, height: float) -> PenaltyContact:
        """Return the contact with points (p, 3) [m] of the object sunk by depth [m] below x = face_x at height [m]."""
        return RoundIndenter().press(points, stiffness, face_x, np.array([depth, self.radius, height]))


class RigidOutline:
    """An object of any section, endless along y; depth counts from first touch with the undeformed jaw.

    Args:
        polygons: of the section (n, 2) [m].
        length: of the jaw [m].
        tilt: of the section from x to z [rad].

    Raises:
        ContactError: the section is too small.
    """

    def __init__(self, polygons: tuple[NDArray, ...], length: float, tilt: float = 0.0) -> None:
        self._indenter, self._length, self._tilt = OutlineIndenter(polygons), length, tilt

    def find_origin(self, face_x: float, depth: float, height: float) -> float:
        """Return x [m] of the outline's origin at a depth and height [m]."""
        return face_x + self._indenter.pressed.front - float(self._sink(depth, height)[0])

    def press(self, points: NDArray, stiffness: NDArray, face_x: float, depth: float, height: float) -> PenaltyContact:
        """See `RigidCylinder`."""
        return self._indenter.press(points, stiffness, face_x, self._sink(depth, height))

    def _sink(self, depth: float, height: float) -> NDArray:
        pose = np.array([0.0, self._tilt, height])
        pose[0] = depth + self._indenter.find_touch(pose, flat_profile(0.0, self._length))
        return pose


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
        energy: of jaw and surface [J].
    """

    depth: float
    q: NDArray
    force: NDArray
    torque: NDArray
    pressure_centre: NDArray
    pressure_location: NDArray
    energy: float


def press_jaw(
    model: JawModel,
    surface: ContactSurface,
    face_x: float,
    rigid: RigidCylinder | RigidOutline,
    height: float,
    depths: Sequence[float],
) -> list[PressState]:
    """Press a rigid object into the inner surface, displacement driven, frictionless.

    Args:
        model: the jaw's mechanics.
        surface: its contact points.
        face_x: plane of the undeformed inner surface [m].
        rigid: the object; its nearest point to the jaw comes first into the jaw.
        height: of its centre above the clamped base [m].
        depths: rising depths [m], at 0 the jaw at rest; steps between them are cut to half a millimetre, and further
            where needed.

    Raises:
        ContactError: No stable equilibrium is found that is reached without a snap; the message says at which depth.
    """

    def press(points: NDArray, depth: float) -> PenaltyContact:
        """Return the contact with the surface's points (p, 3) [m] at a depth [m]."""
        return rigid.press(points, surface.stiffness, face_x, depth, height)

    none, unknown = np.zeros(3), np.full(3, np.nan)
    state = PressState(
        depth=0.0,
        q=np.zeros(model.size),
        force=none,
        torque=none,
        pressure_centre=unknown,
        pressure_location=unknown,
        energy=0.0,
    )
    results = []
    for depth in depths:
        step = _LONGEST_STEP
        while state.depth < depth - 1e-12:
            trial = _find_equilibrium(model, surface, press, state.q, min(state.depth + step, depth))
            if trial is not None and not _snaps(state, trial):
                state = trial
                continue
            step *= 0.5
            if step < _SHORTEST_STEP:
                raise ContactError(
                    f"no equilibrium beyond a depth of {1e3 * state.depth:.3f} mm: the jaw buckles or slips off"
                )
        results.append(state)
    return results


def _find_equilibrium(
    model: JawModel, surface: ContactSurface, press: _Press, q: NDArray, depth: float
) -> PressState | None:
    """Return the stable equilibrium at `depth` by Newton's method, or None when it finds none."""
    tolerance = min(_TOLERANCE, _FINE * depth)
    for _ in range(_ITERATIONS):
        contact = press(model.positions(surface.probe, q), depth)
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
            return _describe(model, surface, press, q, depth, state.energy) if factor.positive else None
    return None


def rub_jaw(contact: RigidContact, states: Sequence[NDArray], coefficient: float) -> list[tuple[NDArray, PressedState]]:
    """Return the unknowns (size,) and the equilibrium of a jaw along the path of an object with Coulomb friction.

    Args:
        contact: of the jaw with the object.
        states: of the contact (3,), depth [m], shape and height [m]; their steps should not exceed 0.1 mm.
        coefficient: of friction [-].

    Raises:
        ContactError: No equilibrium is found; the message says at which depth.
    """
    q, rest = contact.begin(float(states[0][2])), contact.surface.points
    traction = Traction(0.0, np.full(len(rest), coefficient), np.zeros(len(rest)), rest, np.zeros(2))
    last, results = np.asarray(states[0], float), []
    for x in states:
        # towards the jaw is along -x, and the height along z
        traction = traction._replace(moved=np.array([last[0] - x[0], x[2] - last[2]]))
        for iteration in range(_ITERATIONS):
            pressed = contact.linearize(q, x, traction)
            if not pressed.touches:
                step = contact.approach(q, pressed.correction, x)
                q = q + step
                if np.array_equal(step, pressed.correction):  # nothing was met on the way to rest
                    break
                continue
            # points that stick and slide in turn keep full steps from settling
            q = q + limit_step(contact.model, pressed.correction) * (1.0 if iteration < _FULL_STEPS else 0.3)
            if pressed.size < _SETTLED:
                break
        else:
            raise ContactError(f"no equilibrium with friction at a depth of {1e3 * x[0]:.3f} mm")
        traction, last = keep_shear(contact, q, x, traction, coefficient), x
        results.append((q, pressed))
    return results


def keep_shear(contact: RigidContact, q: NDArray, x: NDArray, traction: Traction, coefficient: float) -> Traction:
    """Return what the next step has to know of the tangential forces at unknowns q (size,) and state x (3,)."""
    points = contact.place_points(q)
    pressure, total = (contact.press(points, x, each).forces for each in (FRICTIONLESS, traction))
    return Traction(0.0, np.full(len(points), coefficient), measure_shear(total, pressure), points, np.zeros(2))


def _snaps(before: PressState, after: PressState) -> bool:
    """Return True if the jaw has jumped to another shape between two depths, or has let go of the object."""
    push, last = -after.force[0], -before.force[0]
    if last > 0.0 and push == 0.0:
        return True
    work = 0.5 * (after.depth - before.depth) * (last + push)
    lost = work - (after.energy - before.energy)
    return lost < -_SNAP * abs(work) or (push < last and lost > _SNAP * abs(work))


def _describe(
    model: JawModel, surface: ContactSurface, press: _Press, q: NDArray, depth: float, elastic: float
) -> PressState:
    """Return the equilibrium at unknowns q, with the elastic energy of the jaw [J] there."""
    points = model.positions(surface.probe, q)
    forces = press(points, depth).forces
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
        energy=elastic + measure_penalty_energy(forces, surface.stiffness),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PressHistory:
    """A jaw pressed ever deeper by a cylinder.

    Attributes:
        height: of first touch [m].
        radius: of the cylinder [m].
        depth: the largest [m].
        keypoints: by depth, (n,) -> (n, K, 3) [m].
        forces: by depth, (n,) -> (n, 3) [N].
        torques: by depth, (n,) -> (n, 3) [N m]; None where nothing tells them.
    """

    height: float
    radius: float
    depth: float
    keypoints: PchipInterpolator
    forces: PchipInterpolator
    torques: PchipInterpolator | None = None
