"""Builds the manifold of a jaw's equilibria: a rod is pressed in at every height; knows no cache and no solver."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.errors import ContactError
from finforce_ifea.indenter import RoundIndenter
from finforce_ifea.manifold import STENCIL, Manifold
from finforce_ifea.mechanics import Mechanics
from finforce_ifea.rolling import PressedState, RollingContact, limit_step
from finforce_ifea.solid import SolidModel

DEPTHS, HEIGHTS, SHAPES, ROWS = 12, 27, 40, 56
# As shares of the face: radius of the rod, largest depth, where the rod is first, and how far from the top it is last.
_ROD, _DEEPEST, _LOWEST, _TOP = 0.07, 0.19, 0.11, 0.03
# The rod stops where it needs this many times the force that it needs half way up at full depth.
_HARDEST = 12.0
_LONGEST, _SHORTEST = 0.5e-3, 0.02e-3
_ITERATIONS, _TOLERANCE = 30, 1e-9
_LOADED_EVERY = 3
_ON_FACE = 1e-4
# Loads below this share of the largest are rounding errors.
_NOTHING = 1e-7
_FEWEST_ROWS, _MOST_ROWS = 12, 84
# What the outcome depends on beside the jaw.
GRID = (DEPTHS, HEIGHTS, SHAPES, ROWS, _ROD, _DEEPEST, _LOWEST, _TOP, _HARDEST)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Equilibrium:
    depth: float
    q: NDArray
    state: PressedState


def build_manifold(mechanics: Mechanics, young_modulus: float, progress: Callable[[float], None]) -> Manifold:
    """Presses a rod into the jaw at every height and stores equilibria and compliances.

    Args:
        mechanics: of the jaw.
        young_modulus: of its material [Pa].
        progress: called with the share that is done.

    Raises:
        ContactError: the jaw cannot be pressed at enough heights.
    """
    contact = mechanics.contact
    low, high = contact.surface.heights[[0, -1]]
    heights = np.linspace(low + _LOWEST * (high - low), high - _TOP * (high - low), HEIGHTS)
    rods = [_Rod(contact, height) for height in heights]
    hardest = _HARDEST * float(np.linalg.norm(rods[HEIGHTS // 2].press(np.inf)[-1].state.force))
    depths, states = [], []
    for number, rod in enumerate(rods):
        course = rod.press(hardest)
        depths.append(course[-1].depth)
        states.append(rod.divide(course, DEPTHS))
        progress(0.6 * (number + 1) / HEIGHTS)
    q = np.array(states).transpose(1, 0, 2)
    face, parts = _Face(mechanics, _choose_rows(mechanics)), []
    for number, row in enumerate(q):
        parts.append([face.describe(state) for state in row])
        progress(0.6 + 0.4 * (number + 1) / len(q))
    return _store(young_modulus, heights, np.array(depths), q, face, parts)


def build_rest(mechanics: Mechanics, young_modulus: float) -> Manifold:
    """Stores the unloaded jaw alone, at all grid points; see `build_manifold`."""
    face = _Face(mechanics, _choose_rows(mechanics))
    rest = np.zeros(mechanics.model.size)
    part = face.describe(rest)
    q = np.zeros((STENCIL, STENCIL, len(rest)))
    return _store(young_modulus, np.arange(STENCIL), np.zeros(STENCIL), q, face, [[part] * STENCIL] * STENCIL)


def _choose_rows(mechanics: Mechanics) -> NDArray:
    """Returns the heights (n + 1,) [m] of the rows, the clamp's first: a solid mesh's own, if they are not too many."""
    mesh, face_x = mechanics.mesh, mechanics.contact.face_x
    on_face = np.abs(mesh.nodes[:, 0] - face_x) < _ON_FACE
    held = np.isin(np.arange(len(mesh.nodes)), mesh.clamped)
    base = mesh.nodes[on_face & held, 2].max(initial=mechanics.contact.surface.low[1])
    own = np.unique(np.round(mesh.nodes[on_face & ~held, 2], 7))
    if not (isinstance(mechanics.model, SolidModel) and _FEWEST_ROWS <= len(own) <= _MOST_ROWS):
        own = np.linspace(base, mechanics.contact.surface.high[1], ROWS + 1)[1:]
    return np.r_[base, own]


class _Rod:
    """A rod at one height, pressed in deeper and deeper."""

    def __init__(self, contact: RollingContact, height: float) -> None:
        low, high = contact.surface.heights[[0, -1]]
        self._contact, self._height = contact, height
        self._radius, self._deepest = _ROD * (high - low), _DEEPEST * (high - low)
        contact.indenter = RoundIndenter()

    def press(self, hardest: float) -> list[_Equilibrium]:
        """Returns equilibria at rising depths up to the largest, or to where the jaw gives way or resists."""
        course, step = [], _LONGEST
        while not course or course[-1].depth < self._deepest - 1e-9:
            before = course[-1] if course else None
            depth = min((before.depth if before else 0.0) + step, self._deepest)
            found = self._settle(before, depth)
            if found is None:
                step *= 0.5
                if step < _SHORTEST:
                    break
                continue
            course.append(found)
            if np.linalg.norm(found.state.force) > hardest:
                break
        if not course:
            raise ContactError(f"the jaw cannot be pressed at a height of {1e3 * self._height:.1f} mm")
        return course

    def divide(self, course: list[_Equilibrium], count: int) -> list[NDArray]:
        """Returns the unknowns of equilibria that divide a course evenly in depth, the unloaded one first."""
        depths = np.array([item.depth for item in course])
        states = [np.zeros(self._contact.model.size)]
        for depth in depths[-1] * np.arange(1, count + 1) / count:
            below = int(np.searchsorted(depths, depth + 1e-12)) - 1
            found = self._settle(course[below] if below >= 0 else None, depth)
            if found is None:
                raise ContactError(
                    f"no equilibrium of a rod {1e3 * depth:.2f} mm deep at a height of {1e3 * self._height:.1f} mm"
                )
            states.append(found.q)
        return states

    def _settle(self, start: _Equilibrium | None, depth: float) -> _Equilibrium | None:
        """Returns the equilibrium at a depth [m] of the rod, None when it is not found."""
        contact, model = self._contact, self._contact.model
        place = np.array([depth, np.log(self._radius), self._height])
        q = np.zeros(model.size)
        if start is not None:
            q = start.q + limit_step(model, start.state.modes[:, 0] * (depth - start.depth))
        for _ in range(_ITERATIONS):
            state = contact.linearize(q, place)
            if not state.touches:
                q = q + contact.approach(q, state.correction, place)
                continue
            step = limit_step(model, state.correction)
            q = q + step
            if not (np.isfinite(q).all() and state.smallest_det > 0):
                return None
            if np.abs(step).max() < _TOLERANCE:
                return _Equilibrium(depth=depth, q=q, state=state)
        return None


@dataclass(frozen=True, kw_only=True, eq=False)
class _Tangent:
    """One equilibrium at the rows: load (2 n,) [N], move (2 n,) [m], compliance (2 n, 2 n), responses (size, 2 n)."""

    load: NDArray
    move: NDArray
    compliance: NDArray
    responses: NDArray


class _Face:
    """The rows of the inner face as the full model moves them."""

    def __init__(self, mechanics: Mechanics, rows: NDArray) -> None:
        self.heights = rows
        surface, self._model = mechanics.contact.surface, mechanics.model
        across = surface.points[: surface.across, 1]
        points = np.array([[mechanics.contact.face_x, y, z] for z in rows[1:] for y in across])
        self._probe, self._across, self._count = self._model.attach(points, 1e-3), len(across), len(rows) - 1

    def describe(self, q: NDArray) -> _Tangent:
        """Returns the equilibrium of unknowns q and what unit loads at the rows do to it."""
        model, count = self._model, 2 * self._count
        state, loads = model.linearize(q), self._unit_loads(q)
        responses = model.factorise(state.tangent).solve(loads)
        moves = self._average(model.project(self._probe, q, responses)).transpose(0, 1, 2).reshape(count, count)
        at_rest = np.zeros(model.size)
        moved = model.positions(self._probe, q) - model.positions(self._probe, at_rest)
        # the load that holds the jaw in this shape, as far as loads at the rows can
        load = np.linalg.lstsq(loads, state.force)[0]
        load[np.abs(load) < _NOTHING * np.abs(load).max()] = 0.0
        return _Tangent(
            load=load,
            move=self._average(moved[:, :, None]).reshape(count),
            compliance=0.5 * (moves + moves.T),
            responses=responses,
        )

    def _average(self, moves: NDArray) -> NDArray:
        """Returns x and z motions (n, 2, k) of the rows, the mean across the face, of those of points (p, 3, k)."""
        return moves.reshape(self._count, self._across, 3, -1).mean(1)[:, [0, 2]]

    def _unit_loads(self, q: NDArray) -> NDArray:
        """Returns the loads (size, 2 n) of unit forces along x and z at each row."""
        columns = np.zeros((len(q), 2 * self._count))
        for row in range(self._count):
            for number, axis in enumerate((0, 2)):
                forces = np.zeros((self._count * self._across, 3))
                forces[row * self._across : (row + 1) * self._across, axis] = 1.0 / self._across
                columns[:, 2 * row + number] = self._model.load(self._probe, q, forces)
        return columns


def _store(
    young_modulus: float, rods: NDArray, depths: NDArray, q: NDArray, face: _Face, parts: list[list[_Tangent]]
) -> Manifold:
    """Returns the manifold of equilibria q (T, Z, size) and their tangents."""
    basis = _find_basis(q, parts)
    return Manifold(
        young_modulus=young_modulus,
        heights=face.heights,
        rods=rods,
        depths=depths,
        loads=np.array([[part.load for part in row] for row in parts]),
        moves=np.array([[part.move for part in row] for row in parts]),
        compliance=np.array([[part.compliance for part in row] for row in parts], np.float32),
        shapes=q @ basis,
        shape_compliance=np.array([[basis.T @ part.responses for part in row] for row in parts], np.float32),
        basis=basis,
    )


def _find_basis(q: NDArray, parts: list[list[_Tangent]]) -> NDArray:
    """Returns orthonormal shapes (size, r) that span equilibria q (T, Z, size) and what loads do to them."""
    states = q.reshape(-1, q.shape[-1])
    some = [part.responses for row in parts[::_LOADED_EVERY] for part in row[::_LOADED_EVERY]]
    responses = np.concatenate(some, axis=1).T
    share = (np.abs(states).max() or 1.0) / np.abs(responses).max() / len(some)
    vectors, values, _ = np.linalg.svd(np.concatenate([states, share * responses]).T, full_matrices=False)
    return np.ascontiguousarray(vectors[:, : min(SHAPES, int((values > 0).sum()))])
