"""How stiff an undeformed jaw is against what presses on its inner surface.

A jaw in equilibrium with a rigid object pressed into its inner surface.

An unknown object is taken for a cylinder: its depth, radius and height are enough to place the pressure. That moves
and spreads along the finger by itself as the finger bends.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import Indenter, RoundIndenter
from finforce_ifea.contact_mechanics.surface import ContactSurface
from finforce_ifea.fem.model import JawModel
from finforce_ifea.jaw.mesh import VolumeMesh

# Where along the surface the line loads stand, as shares of its points.
_HEIGHTS = (0.25, 0.5, 0.75)


def measure_stiffness(model: JawModel, surface: ContactSurface) -> float:
    """Returns one over the mean compliance against line loads along -x, one at a time [N/m].

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
    return float(1.0 / np.einsum("ij,ij->j", pushes, motions).mean())


_BISECTIONS = 10
_TOUCH = 2e-5
# Stiffness [N/m] of the finger that the surface's penalty is meant for: the bench finger's, about that of strips too.
_MEANT_STIFFNESS = 435.0


@dataclass(frozen=True, kw_only=True, eq=False)
class PressedState:
    """Linearised equilibrium of one state of jaw and object.

    Attributes:
        touches: whether any surface point is in contact.
        correction: Newton step of the unknowns towards equilibrium (size,); with contact, within the model's reach.
        modes: motions of the unknowns by depth [per m], shape and height [per m], (size, 3).
        force: total contact force on the jaw after `correction` (3,) [N].
        force_modes: its derivatives (3, 3), columns as in modes.
        pressure_point: pressure centre on the deformed surface (3,) [m]; NaN without contact.
        pressure_place: the same on the undeformed surface (3,) [m]; NaN without contact.
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
    pressure_place: NDArray
    smallest_det: float
    size: float
    extrapolation: float = 0.0


class RollingContact:
    """A model, its contact surface, and the object pressed into it."""

    def __init__(self, model: JawModel, surface: ContactSurface, face_x: float) -> None:
        """Keeps the model, its contact surface and the plane x = face_x [m] of the undeformed surface.

        The penalty goes with the jaw's own stiffness, so that forces scale with Young's modulus: a stiff jaw does not
        vanish in the object, and a soft one does not meet a wall.
        """
        self.model = model
        self.surface = replace(
            surface, stiffness=surface.stiffness * (measure_stiffness(model, surface) / _MEANT_STIFFNESS)
        )
        self.face_x = face_x
        self.indenter: Indenter = RoundIndenter()

    def begin(self, height: float) -> NDArray:
        """Returns the unknowns (size,) of the unloaded jaw that is to be touched at a height [m]."""
        return np.zeros(self.model.size)

    def linearize(self, q: NDArray, place: NDArray) -> PressedState:
        """Linearises the equilibrium f_int(q) = J^T p(J q, place) at unknowns q and place (depth, shape, height).

        With S the springs of all points and e_x, e_z unit motions of the object, the loads by depth and height are
        -J^T S e_x and J^T S e_z; as S is symmetric, the same loads give the forces that the jaw's motion takes away.
        """
        model, probe = self.model, self.surface.probe
        points = model.positions(probe, q)
        contact = self.indenter.press(points, self.surface.stiffness, self.face_x, place)
        state = model.linearize(q)
        model.stiffen(state.tangent, probe, q, contact.springs)
        along_x = np.ascontiguousarray(contact.springs[:, :, 0])
        along_z = np.ascontiguousarray(contact.springs[:, :, 2])
        load_x, load_z = model.load(probe, q, along_x), model.load(probe, q, along_z)
        imbalance = model.load(probe, q, contact.forces) - state.force
        loads = np.stack([imbalance, -load_x, model.load(probe, q, contact.by_shape), load_z], axis=1)
        steps = model.factorise(state.tangent).solve(loads)
        modes, size = steps[:, 1:], np.hypot(contact.forces[:, 0], contact.forces[:, 2])
        total = size.sum()
        share = size / total if total > 0 else np.full(len(size), np.nan)
        force_modes = np.stack([-along_x.sum(0), contact.by_shape.sum(0), along_z.sum(0)], axis=1)
        force_modes[0] -= load_x @ modes
        force_modes[2] -= load_z @ modes
        relief = np.array([load_x @ steps[:, 0], 0.0, load_z @ steps[:, 0]])
        reached = measure_step(model, steps[:, 0])
        return PressedState(
            touches=bool(total > 0),
            correction=steps[:, 0] / max(reached, 1.0) if total > 0 else steps[:, 0],
            modes=modes,
            force=contact.forces.sum(0) - relief,
            force_modes=force_modes,
            pressure_point=share @ points,
            pressure_place=share @ self.surface.points,
            smallest_det=state.smallest_det,
            size=reached,
        )

    def approach(self, q: NDArray, step: NDArray, place: NDArray) -> NDArray:
        """Returns the step of a jaw that has lost contact, cut where its surface meets the object again."""

        def find_gap(share: float) -> float:
            points = self.model.positions(self.surface.probe, q + share * step)
            return self.indenter.find_gap(points, self.face_x, place)

        return find_share_that_meets(find_gap) * step


def find_share_that_meets(find_gap: Callable[[float], float]) -> float:
    """Returns the share from 0 to 1 of a step at which the gap [m] to an object closes, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        share = 0.5 * (low + high)
        if find_gap(share) < -_TOUCH:
            high = share
        else:
            low = share
    return high


def measure_step(model: JawModel, step: NDArray) -> float:
    """Returns the largest change in a step of the unknowns (size,), as a share of the model's reach."""
    return float((np.abs(step) / model.reach).max(initial=0.0))


def limit_step(model: JawModel, step: NDArray) -> NDArray:
    """Returns a step of the unknowns shortened so that none exceeds the model's reach."""
    largest = measure_step(model, step)
    return step if largest <= 1.0 else step / largest


@dataclass(frozen=True, kw_only=True, eq=False)
class Mechanics:
    """A jaw's mesh, its model, and the model with its contact surface."""

    mesh: VolumeMesh
    model: JawModel
    contact: RollingContact
