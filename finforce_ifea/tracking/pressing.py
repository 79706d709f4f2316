"""What the search for a place asks of a jaw's mechanics: by their methods, or compiled where the jaw is a reduced one.

Each function is called with a `RollingContact` from Python and with a `CompiledContact` from compiled code.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.friction import Rubbing
from finforce_ifea.contact_mechanics.indenter import (
    FaceProfile,
    PressedObject,
    find_first_touch,
    measure_gap,
    pose_object,
)
from finforce_ifea.contact_mechanics.pressed_jaw import BISECTIONS, TOUCH, PressedState, limit_step
from finforce_ifea.reduced.evaluation import (
    ReducedJaw,
    follow,
    linearize_reduced,
    move_points,
    place_contact,
    place_points,
)


class CompiledContact(NamedTuple):
    """A reduced jaw with the object that is pressed into it, for compiled code."""

    jaw: ReducedJaw
    pressed: PressedObject
    rubbing: Rubbing


class CompiledProbe(NamedTuple):
    """Material points of a reduced jaw for compiled code; see `ReducedProbe`."""

    points: NDArray
    shapes: NDArray
    compliance: NDArray


def linearize_at(contact: Any, q: NDArray, place: NDArray) -> PressedState:
    """Returns the linearised equilibrium at unknowns q (size,) and a place (3,)."""
    return contact.linearize(q, place)


def approach_at(contact: Any, q: NDArray, step: NDArray, place: NDArray) -> NDArray:
    """Returns the step (size,) of a jaw that has lost contact, cut where its surface meets the object again."""
    return contact.approach(q, step, place)


def touch_at(contact: Any, place: NDArray) -> float:
    """Returns the depth [m] at which the object of a place (3,) first touches the undeformed jaw."""
    return contact.find_touch(place)


def limit_at(contact: Any, step: NDArray) -> NDArray:
    """Returns a step of the unknowns (size,) shortened so that none exceeds the model's reach."""
    return limit_step(contact.model, step)


def positions_at(contact: Any, probe: Any, q: NDArray) -> NDArray:
    """Returns the deformed positions (p, 3) [m] of a probe."""
    return contact.model.positions(probe, q)


def motions_at(contact: Any, probe: Any, q: NDArray, modes: NDArray) -> NDArray:
    """Returns the motions (p, 3, k) [m] of a probe for changes modes (size, k) of the unknowns."""
    return contact.model.project(probe, q, modes)


@overload(linearize_at)
def _linearize_at(contact, q, place):
    if isinstance(contact, types.NamedTuple):
        return lambda contact, q, place: linearize_reduced(contact.jaw, contact.pressed, contact.rubbing, q, place)


@overload(approach_at)
def _approach_at(contact, q, step, place):
    if not isinstance(contact, types.NamedTuple):
        return None

    def approach(contact, q, step, place):
        jaw, low, high = contact.jaw, 0.0, 1.0
        pose = pose_object(contact.pressed, jaw.face_x, place)
        for _ in range(BISECTIONS):
            share = 0.5 * (low + high)
            moves = follow(jaw.moves, jaw.compliance, jaw.loads, q + share * step)
            if measure_gap(contact.pressed, pose, place_contact(jaw.points, jaw.low, jaw.share, moves)) < -TOUCH:
                high = share
            else:
                low = share
        return high * step

    return approach


@overload(touch_at)
def _touch_at(contact, place):
    if not isinstance(contact, types.NamedTuple):
        return None

    def touch(contact, place):
        jaw = contact.jaw
        return find_first_touch(contact.pressed, FaceProfile(jaw.face_points, jaw.is_flat, jaw.face_x), place)

    return touch


@overload(limit_at)
def _limit_at(contact, step):
    if not isinstance(contact, types.NamedTuple):
        return None

    def limit(contact, step):
        largest = np.abs(step / contact.jaw.reach).max()
        return step if largest <= 1.0 else step / largest

    return limit


@overload(positions_at)
def _positions_at(contact, probe, q):
    if isinstance(contact, types.NamedTuple):
        return lambda contact, probe, q: place_points(
            probe.points, probe.shapes, probe.compliance, contact.jaw.loads, q
        )


@overload(motions_at)
def _motions_at(contact, probe, q, modes):
    if isinstance(contact, types.NamedTuple):
        return lambda contact, probe, q, modes: move_points(probe.compliance, q, modes)
