"""What the search for a place asks of a jaw's mechanics: by their methods, or compiled where the jaw is a reduced one.

Each function is called with a `RollingContact` and the probe of its model from Python. From compiled code the contact
is a plain tuple of the plain tuples `ReducedJaw`, `PressedObject` and `Rubbing`, and the probe the points, shapes and
compliance of a `ReducedProbe`.
"""

from typing import Any

from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import FaceProfile, PressedObject, find_first_touch
from finforce_ifea.contact_mechanics.pressed_jaw import PressedState, limit_step
from finforce_ifea.reduced.evaluation import (
    ReducedJaw,
    approach_reduced,
    linearize_reduced,
    move_points,
    place_points,
)

_INLINE = {"inline": "always"}


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


@overload(linearize_at, **_INLINE)
def _linearize_at(contact, q, place):
    if isinstance(contact, types.BaseTuple):
        return lambda contact, q, place: linearize_reduced(contact[0], contact[1], contact[2], q, place)


@overload(approach_at, **_INLINE)
def _approach_at(contact, q, step, place):
    if isinstance(contact, types.BaseTuple):
        return lambda contact, q, step, place: approach_reduced(contact[0], contact[1], q, step, place)


@overload(touch_at)
def _touch_at(contact, place):
    if not isinstance(contact, types.BaseTuple):
        return None

    def touch(contact, place):
        jaw = ReducedJaw(*contact[0])
        face = FaceProfile(jaw.face_points, jaw.is_flat, jaw.face_x)
        return find_first_touch(PressedObject(*contact[1]), face, place)

    return touch


@overload(limit_at)
def _limit_at(contact, step):
    if not isinstance(contact, types.BaseTuple):
        return None

    def limit(contact, step):
        reach, largest = ReducedJaw(*contact[0]).reach, 0.0
        for k in range(len(step)):
            largest = max(largest, abs(step[k]) / reach[k])
        return step if largest <= 1.0 else step / largest

    return limit


@overload(positions_at, **_INLINE)
def _positions_at(contact, probe, q):
    if isinstance(contact, types.BaseTuple):
        return lambda contact, probe, q: place_points(probe[0], probe[1], probe[2], contact[0][2], q)


@overload(motions_at, **_INLINE)
def _motions_at(contact, probe, q, modes):
    if isinstance(contact, types.BaseTuple):
        return lambda contact, probe, q, modes: move_points(probe[2], q, modes)
