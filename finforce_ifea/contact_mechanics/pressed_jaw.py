"""A jaw in equilibrium with a rigid object pressed into its inner surface, and how stiff it is against that.

An unknown object is taken for a cylinder: its depth, radius and height are enough to place the pressure. That moves
and spreads along the finger by itself as the finger bends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, Traction
from finforce_ifea.contact_mechanics.indenter import FaceProfile, Indenter, PenaltyContact, RoundIndenter
from finforce_ifea.errors import MeshError
from finforce_ifea.fem.model import Across, Factor, JawModel
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.mesh import VolumeMesh
from finforce_ifea.jaw.section import FaceLine

# Where along the surface the line loads stand, as shares of its points.
_HEIGHTS = (0.25, 0.5, 0.75)


def measure_compliances(model: JawModel, surface: ContactSurface) -> NDArray:
    """Return the compliances (3,) [m/N] against line loads along -x, one at a time.

    The loads stand at a quarter, half and three quarters of the surface.
    """
    rest, loads = np.zeros(model.size), []
    for share in _HEIGHTS:
        row = int(share * (len(surface.heights) - 1))
        forces = np.zeros_like(surface.points)
        forces[row * surface.across : (row + 1) * surface.across, 0] = -1.0 / surface.across
        loads.append(model.load(surface.probe, rest, forces))
    pushes = np.stack(loads, axis=1)
    motions = model.factorise(model.linearize(rest).tangent).solve(pushes)
    return np.einsum("ij,ij->j", pushes, motions)


BISECTIONS = 10
# Terms of the series by which springs of friction are solved for: each leaves a third of the error at most.
_TERMS = 6
TOUCH = 2e-5
# Stiffness [N/m] of the finger that the surface's penalty is meant for: the bench finger's, about that of strips too.
_MEANT_STIFFNESS = 435.0


class PressedState(NamedTuple):
    """Linearised equilibrium of one state of jaw and object.

    Attributes:
        touches: True if any surface point is in contact.
        correction: Newton step of the unknowns towards equilibrium (size,); with contact, within the model's reach.
        modes: motions of the unknowns by depth [per m], shape and height [per m], (size, 3); where forces
            have a traction ratio, by that too (size, 4).
        force: total contact force on the jaw after `correction` (3,) [N].
        force_modes: its derivatives (3, 3 or 4), columns as in modes.
        pressure_point: pressure centre on the deformed surface (3,) [m]; NaN without contact.
        pressure_location: the same on the undeformed surface (3,) [m]; NaN without contact.
        smallest_det: smallest det F of all elements [-].
        size: of the whole Newton step, as a share of the model's reach.
        extrapolation: distance of the shape from those that a model has stored, as a share of what it is good for.
    """

    touches: bool
    correction: NDArray
    modes: NDArray
    force: NDArray
    force_modes: NDArray
    pressure_point: NDArray
    pressure_location: NDArray
    smallest_det: float
    size: float
    extrapolation: float = 0.0


class RigidContact:
    """A model, its contact surface, and the object pressed into it.

    Attributes:
        indenter: the object.
        max_force: force beyond which no equilibrium is believed [N], infinite where unknown.
    """

    max_force = np.inf

    def __init__(self, model: JawModel, surface: ContactSurface, face: FaceLine) -> None:
        """Keep the model, its contact surface and the undeformed inner face.

        The penalty goes with the jaw's own stiffness, so that forces scale with Young's modulus: a stiff jaw does not
        vanish in the object, and a soft one does not meet a wall.
        """
        self.model = model
        stiffness = float(1.0 / measure_compliances(model, surface).mean())
        self.surface = replace(surface, stiffness=surface.stiffness * (stiffness / _MEANT_STIFFNESS))
        self.face, self.face_x = face, face.plane
        self.indenter: Indenter = RoundIndenter()

    def set_indenter(self, indenter: Indenter) -> None:
        """Take another object, which is pressed in from now on."""
        self.indenter = indenter

    def begin(self, height: float) -> NDArray:
        """Return the unknowns (size,) of the unloaded jaw that is to be touched at a height [m]."""
        return np.zeros(self.model.size)

    def find_touch(self, x: NDArray) -> float:
        """Return the depth [m] at which the object first touches the undeformed jaw, in a contact state x (3,)."""
        return self.indenter.find_touch(x, self.profile)

    @property
    def packed_object(self) -> tuple[tuple, tuple]:
        """The object and the surface that it touches as plain tuples, see `find_first_touch`."""
        return tuple(self.indenter.pressed), tuple(self.profile)

    @cached_property
    def reach(self) -> NDArray:
        """Largest change of each unknown of the model at once (size,)."""
        return np.full(self.model.size, self.model.reach, dtype=float)

    @cached_property
    def profile(self) -> FaceProfile:
        """The undeformed surface, for objects to touch."""
        return profile_surface(self.surface, self.face)

    def press(self, points: NDArray, x: NDArray, traction: Traction) -> PenaltyContact:
        """Return the contact of surface points (p, 3) [m] with the object in a state x (3,)."""
        return self.indenter.press(points, self.surface.stiffness, self.face_x, x, traction)

    def place_points(self, q: NDArray) -> NDArray:
        """Return the surface points (p, 3) [m] of the deformed jaw."""
        return self.model.positions(self.surface.probe, q)

    def linearize(self, q: NDArray, x: NDArray, traction: Traction = FRICTIONLESS) -> PressedState:
        """Linearise the equilibrium f_int(q) = J^T p(J q, x) at unknowns q, contact state x (depth, shape, height)."""
        model, probe = self.model, self.surface.probe
        points = self.place_points(q)
        contact = self.press(points, x, traction)
        state = model.linearize(q)
        model.stiffen(state.tangent, probe, q, 0.5 * (contact.springs + contact.springs.transpose(0, 2, 1)))
        loads = load_columns(model, probe, q, np.concatenate([contact.forces[:, :, None], contact.changes], axis=2))
        loads[:, 0] -= state.force
        steps = solve_contact(model, probe, q, model.factorise(state.tangent), loads, contact.springs)
        relief = np.tensordot(contact.springs, model.project(probe, q, steps), axes=((0, 2), (0, 1)))
        size = np.hypot(contact.forces[:, 0], contact.forces[:, 2])
        total = size.sum()
        share = size / total if total > 0 else np.full(len(size), np.nan)
        reached = measure_step(model, steps[:, 0])
        return PressedState(
            touches=bool(total > 0),
            correction=steps[:, 0] / max(reached, 1.0) if total > 0 else steps[:, 0],
            modes=steps[:, 1:],
            force=contact.forces.sum(0) - relief[:, 0],
            force_modes=contact.changes.sum(0) - relief[:, 1:],
            pressure_point=share @ points,
            pressure_location=share @ self.surface.points,
            smallest_det=state.smallest_det,
            size=reached,
        )

    def linearize_points(
        self, probe: Any, q: NDArray, x: NDArray, traction: Traction
    ) -> tuple[PressedState, NDArray, NDArray]:
        """Linearise, see `linearize`; return that with positions (k, 3) [m] and motions (k, 3, 4) of a probe there."""
        pressed = self.linearize(q, x, traction)
        q = q + pressed.correction
        # of one layout, so that nothing is compiled anew while a jaw waits
        pressed = pressed._replace(modes=np.ascontiguousarray(pressed.modes))
        placed, motions = self.model.positions(probe, q), self.model.project(probe, q, pressed.modes)
        return pressed, np.ascontiguousarray(placed), np.ascontiguousarray(motions)

    def approach(self, q: NDArray, step: NDArray, x: NDArray) -> NDArray:
        """Return the step of a jaw that has lost contact, cut where its surface meets the object again."""
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            share = 0.5 * (low + high)
            if self.indenter.find_gap(self.place_points(q + share * step), self.face_x, x) < -TOUCH:
                high = share
            else:
                low = share
        return high * step


def solve_contact(model: JawModel, probe: Any, q: NDArray, factor: Factor, loads: NDArray, springs: NDArray) -> NDArray:
    """Return the steps (size, k) under loads (size, k), with springs (p, 3, 3) that friction makes unsymmetric.

    The factor of K holds their symmetric part. With the rest B, (K + B)^-1 b is sought among the combinations of
    (-K^-1 B)^i K^-1 b, the one that leaves the least (GMRES).
    """
    steps = factor.solve(loads)
    rest = 0.5 * (springs - springs.transpose(0, 2, 1))
    if not rest.any():
        return steps
    terms = [steps]
    for _ in range(_TERMS):
        moved = rest @ model.project(probe, q, terms[-1])
        terms.append(-factor.solve(load_columns(model, probe, q, moved)))
    left = np.stack([one - other for one, other in pairwise(terms)])
    for k in range(steps.shape[1]):
        share = np.linalg.lstsq(left[:, :, k].T, steps[:, k], rcond=None)[0]
        steps[:, k] = sum(w * term[:, k] for w, term in zip(share, terms[:-1], strict=True))
    return steps


def load_columns(model: JawModel, probe: Any, q: NDArray, forces: NDArray) -> NDArray:
    """Return the loads (size, k) of forces (p, 3, k) [N] on the points of a probe, at unknowns q (size,)."""
    columns = (np.ascontiguousarray(column) for column in np.moveaxis(forces, 2, 0))
    return np.stack([model.load(probe, q, column) for column in columns], axis=1)


def measure_step(model: JawModel, step: NDArray) -> float:
    """Return the largest change in a step of the unknowns (size,), as a share of the model's reach."""
    return float((np.abs(step) / model.reach).max(initial=0.0))


def limit_step(model: JawModel, step: NDArray) -> NDArray:
    """Return a step of the unknowns shortened so that none exceeds the model's reach."""
    largest = measure_step(model, step)
    return step if largest <= 1.0 else step / largest


@dataclass(frozen=True, kw_only=True, eq=False)
class Mechanics:
    """A jaw's mesh, its model, and the model with its contact surface.

    Attributes:
        mesh: of the jaw.
        model: of its unknowns.
        contact: of its inner face with an object.
        full: the mechanics that a reduced one stands for, where that may be asked; None otherwise.
    """

    mesh: VolumeMesh
    model: JawModel
    contact: RigidContact
    full: Mechanics | None = None


# Distance of contact points along the face [m]: a corner, rounded by half a cell of its field and sunk in by a tenth of
# that, touches four or more, so that stiffness hardly changes as it slides from one to the next.
_SPACING = 0.1e-3
# Penalty per height [N/m per m]: soft enough for several points to share a touch, so that the force moves smoothly from
# one to the next; 10 N sink in by 0.07 mm, below what a camera sees.
_STIFFNESS = 5e7


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactSurface:
    """Surface that an object can touch.

    Attributes:
        points: on the undeformed inner surface (p, 3) [m], rising z, all y of one height together.
        heights: the distinct heights (h,) [m].
        across: points per height.
        stiffness: penalty of each point (p,) [N/m].
        probe: the model's probe of the points; None where the model moves them by itself.
        low: least y and z of the inner face (2,) [m].
        high: largest y and z (2,) [m].
    """

    points: NDArray
    heights: NDArray
    across: int
    stiffness: NDArray
    probe: Any
    low: NDArray
    high: NDArray


def profile_surface(surface: ContactSurface, face: FaceLine) -> FaceProfile:
    """Return the undeformed surface of a face, for objects to touch."""
    return FaceProfile(np.ascontiguousarray(surface.points[:: surface.across, [0, 2]]), face.is_flat, face.plane)


def build_contact_surface(jaw: Jaw, mesh: VolumeMesh, model: JawModel, *, across: Across) -> ContactSurface:
    """Return contact points every tenth of a millimetre along the inner surface.

    Args:
        jaw: the jaw.
        mesh: its undeformed mesh, whose nodes on the inner face bound the surface.
        model: its mechanics.
        across: where along y the points stand: in the "middle" for a planar model, on "half" of the width where each
            stands for its mirror image too, or on "both" halves.

    Raises:
        MeshError: The mesh has no nodes on the plane of the inner face.
    """
    face = mesh.nodes[jaw.face.holds(mesh.nodes)]
    if len(face) < 2:
        raise MeshError(f"the mesh has no nodes on the inner face x = {jaw.inner_face_x:g} m; check inner_face_x")
    low, high = face[:, 1:].min(0), face[:, 1:].max(0)
    if jaw.section is not None:  # what touches the clamped part does not bend the jaw
        held = mesh.nodes[mesh.clamped]
        low[1] = max(low[1], held[jaw.face.holds(held), 2].max(initial=-np.inf))
    heights = np.arange(low[1] + _SPACING, high[1] - 0.5 * _SPACING, _SPACING)
    gauss = np.array([0.5 - 0.5 / np.sqrt(3), 0.5 + 0.5 / np.sqrt(3)])
    right, left = gauss * high[0], gauss[::-1] * low[0]
    sides = {"middle": np.zeros(1), "half": right, "both": np.r_[left, right]}[across]
    z, y = np.meshgrid(heights, sides, indexing="ij")
    points = np.stack([jaw.face.read(z.ravel()), y.ravel(), z.ravel()], axis=1)
    if jaw.section is not None and jaw.section.taper.any():
        points[:, 1] *= jaw.section.read_width(points[:, [0, 2]]) / (high[0] - low[0])
    elif jaw.section is not None:
        points[:, 1] = jaw.section.place_across(points)
    stiffness = np.full(len(points), _STIFFNESS * _SPACING / len(sides))
    probe = model.attach(points, 1e-3)
    return ContactSurface(
        points=points, heights=heights, across=len(sides), stiffness=stiffness, probe=probe, low=low, high=high
    )
