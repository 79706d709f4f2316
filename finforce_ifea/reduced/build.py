"""Builds the manifold of a jaw's equilibria: a rod is pressed in at every height.

Each equilibrium comes with what loads on the rows of the jaw's inner face do to it.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import splu

from finforce_ifea.contact_mechanics.indenter import RoundIndenter
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics, PressedState, RigidContact, limit_step
from finforce_ifea.errors import ContactError
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.reduced.equilibria import STENCIL, Manifold

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

# Loads below this share of the largest are rounding errors; rows that the mesh cannot tell apart share a load.
_NOTHING, _RIDGE = 1e-7, 1e-9
_EVERY = 3
# Of the responses of one equilibrium so many combinations say nearly all.
_LEADING = 12


class Face:
    """The rows of the inner face as the full model moves them.

    Attributes:
        basis: shapes of the unknowns (size, r), orthonormal; to be set before an equilibrium is described.
    """

    def __init__(self, mechanics: Mechanics, heights: NDArray) -> None:
        """Keep the rows at heights (n,) [m]."""
        surface, face, self._model = mechanics.contact.surface, mechanics.contact.face, mechanics.model
        columns = surface.points[:, 1].reshape(-1, surface.across).T
        sides = np.stack([np.interp(heights, surface.heights, y) for y in columns], axis=1)
        points = np.array([[face.read(z), y, z] for z, row in zip(heights, sides, strict=True) for y in row])
        self._probe, self._across, self._count = self._model.attach(points, 1e-3), surface.across, len(heights)
        self._loads: sparse.csr_matrix | None = None
        self._share = None if has_own_rows(mechanics) else self._share_nodes(mechanics, heights)
        self.basis = np.zeros((self._model.size, 0))

    def _share_nodes(self, mechanics: Mechanics, heights: NDArray) -> sparse.csr_matrix:
        """Return what each unknown's force is on the rows (2 n, size): rows and nodes of the face stand apart.

        A force between two rows is shared by both as by the ends of a beam; one below the first row goes to the clamp,
        too.
        """
        nodes, dof = mechanics.mesh.nodes, mechanics.model.dof
        face = np.flatnonzero(mechanics.contact.face.holds(nodes))
        base = 2.0 * heights[0] - heights[1]
        place = np.interp(nodes[face, 2], np.r_[base, heights], np.arange(-1.0, len(heights)))
        low = np.clip(np.floor(place), -1, len(heights) - 2).astype(int)
        table = sparse.lil_matrix((2 * len(heights), mechanics.model.size))
        for number, axis in enumerate((0, 2)):
            for node, row, share in zip(face, low, place - low, strict=True):
                column = dof[node, axis]
                if column < mechanics.model.size:
                    if row >= 0:
                        table[2 * row + number, column] = 1.0 - share
                    table[2 * row + 2 + number, column] = share
        return table.tocsr()

    def describe(self, q: NDArray) -> dict[str, NDArray]:
        """Return the equilibrium of unknowns q (size,) and what unit loads at the rows do to it, as in `Manifold`."""
        model, loads = self._model, self._unit_loads(q)
        state = model.linearize(q)
        factor = model.factorise(state.tangent)
        moved = model.positions(self._probe, q) - model.positions(self._probe, np.zeros(model.size))
        return {
            "loads": self._find_load(loads, state.force),
            "moves": moved.reshape(self._count, self._across, 3).mean(1)[:, [0, 2]].ravel(),
            "compliance": factor.condense(loads).astype(np.float32),
            "shapes": self.basis.T @ q,
            "shape_compliance": (loads.T @ factor.solve(self.basis)).T.astype(np.float32),
        }

    def describe_all(self, states: NDArray) -> list[dict[str, NDArray]]:
        """Return the equilibria of unknowns (n, size); see `describe`."""
        return [self.describe(q) for q in states]

    def find_basis(self, states: NDArray, count: int) -> None:
        """Set the basis to the `count` shapes that say most of equilibria (m, size) and of what loads do to them."""
        parts, largest = [], 0.0
        for q in states[:: _EVERY**2]:
            factor = self._model.factorise(self._model.linearize(q).tangent)
            responses = factor.solve(self._unit_loads(q)[:, ::_EVERY].toarray())
            largest = max(largest, np.abs(responses).max())
            parts.append(_condense(responses, _LEADING))
        share = (np.abs(states).max() or 1.0) / largest / len(states)
        samples = np.concatenate([states.T, share * np.concatenate(parts, axis=1)], axis=1)
        self.basis = np.linalg.qr(_condense(samples, min(count, *samples.shape)))[0]

    def _find_load(self, loads: sparse.csr_matrix, force: NDArray) -> NDArray:
        """Return the load on the rows (2 n,) [N] that balances an internal force (size,), as far as it can."""
        if self._share is not None:
            return self._share @ force
        normal = (loads.T @ loads).tocsc()
        normal += _RIDGE * normal.diagonal().max() * sparse.eye(normal.shape[0], format="csc")
        load = splu(normal).solve(loads.T @ force)
        load[np.abs(load) < _NOTHING * np.abs(load).max()] = 0.0
        return load

    def _unit_loads(self, q: NDArray) -> sparse.csr_matrix:
        """Return the loads (size, 2 n) of unit forces along x and z at each row."""
        if self._loads is not None:
            return self._loads
        if not isinstance(self._model, SolidModel):
            moved = self._model.project(self._probe, q, np.eye(len(q)))[:, [0, 2]]
            return sparse.csr_matrix(moved.reshape(self._count, self._across, 2, -1).mean(1).reshape(-1, len(q)).T)
        columns = np.zeros((len(q), 2 * self._count))
        for row in range(self._count):
            for number, axis in enumerate((0, 2)):
                forces = np.zeros((self._count * self._across, 3))
                forces[row * self._across : (row + 1) * self._across, axis] = 1.0 / self._across
                columns[:, 2 * row + number] = self._model.load(self._probe, q, forces)
        self._loads = sparse.csr_matrix(columns)  # they do not depend on the state
        return self._loads


def _condense(samples: NDArray, count: int) -> NDArray:
    """Return the `count` orthogonal combinations (size, count) that say most of samples (size, m).

    By the smaller one of the products of the samples (m, m) and of the unknowns (size, size), which a large mesh could
    not store.
    """
    size, m = samples.shape
    if size < m:
        values, vectors = eigh(samples @ samples.T, subset_by_index=(max(size - count, 0), size - 1))
        return vectors * np.sqrt(np.maximum(values, 0.0))
    return samples @ eigh(samples.T @ samples, subset_by_index=(max(m - count, 0), m - 1))[1]


DEPTHS, HEIGHTS, SHAPES, ROWS = 16, 33, 40, 56
# As shares of the face: radius of the rod, largest depth, where the rod is first, and how far from the top it is last.
_ROD, _DEEPEST, _LOWEST, _TOP = 0.2, 0.19, 0.11, 0.03
# By so much the rods stand denser at base and tip than on the average: forces change fastest with height there.
_DENSER = 0.5
# So much of a path is divided by the square of the step's number: a jaw may stiffen early.
_EARLY = 0.8
# The rod stops where it needs this many times the force that it needs half way up at full depth.
_HARDEST = 12.0
# Steps of a solid must agree with its motions at both ends, to this share; short ones [m], in which these may change,
# go less than so many times as far. The longest of a frame, whose hinged bars snap over.
_APART, _SURE, _FURTHER, _LONGEST = 0.1, 0.1e-3, 1.5, 0.5e-3
# Shortest step of a depth [m]; iterations to an equilibrium, and its tolerance [m], a hundredth of what a camera tells
# apart. What takes more is no near one, nor what corrects as much as at first after so many. Steps below the last [m]
# are followed by much smaller ones.
_SHORTEST, _ITERATIONS, _TOLERANCE, _TRIED, _NEAR = 0.02e-3, 9, 1e-8, 5, 1e-6
# Quarters of a path that are tried next where it cannot be divided.
_KEPT = 3
_FEWEST_ROWS, _MOST_ROWS = 12, 84
# Rows of nodes nearer together than this share of their mean distance are those of an unstructured mesh.
_CLOSEST = 0.1
# What the outcome depends on beside the jaw.
GRID = (DEPTHS, HEIGHTS, SHAPES, ROWS, _ROD, _DEEPEST, _LOWEST, _TOP, _DENSER, _EARLY, _HARDEST, _ITERATIONS, _TRIED)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Equilibrium:
    depth: float
    q: NDArray
    state: PressedState


Share = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


def build_manifold(
    mechanics: Mechanics, young_modulus: float, progress: Callable[[float], None], share: Share = map
) -> Manifold:
    """Press a rod into the jaw at every height and store equilibria and compliances.

    Args:
        mechanics: of the jaw.
        young_modulus: of its material [Pa].
        progress: called with the share that is done.
        share: `map`, or that of an executor of processes; the outcome is the same to rounding.

    Raises:
        ContactError: the jaw cannot be pressed at enough heights.
    """
    grid = _press_everywhere(mechanics.contact, lambda done: progress(0.5 * done), share)
    heights = _choose_rows(mechanics)
    face, parts = Face(mechanics, heights[1:]), []
    face.find_basis(grid.q.reshape(-1, grid.q.shape[-1]), SHAPES)
    for row in share(face.describe_all, grid.q):
        parts.append(row)
        progress(0.5 + 0.5 * len(parts) / len(grid.q))
    return _store(young_modulus, grid, heights, parts, face)


def build_rest(mechanics: Mechanics, young_modulus: float) -> Manifold:
    """Store the unloaded jaw alone, at all grid points; see `build_manifold`."""
    heights, rest = _choose_rows(mechanics), np.zeros(mechanics.model.size)
    face = Face(mechanics, heights[1:])
    face.find_basis(rest[None], SHAPES)
    grid = _Grid(rods=np.arange(float(STENCIL)), depths=np.zeros(STENCIL), q=np.zeros((STENCIL, STENCIL, len(rest))))
    return _store(young_modulus, grid, heights, [[face.describe(rest)] * STENCIL] * STENCIL, face)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Grid:
    """Equilibria q (T, Z, size) under rods at heights (Z,) [m], pressed in up to depths (Z,) [m]."""

    rods: NDArray
    depths: NDArray
    q: NDArray


def _press_everywhere(contact: RigidContact, progress: Callable[[float], None], share: Share) -> _Grid:
    """Return the equilibria under rods at all heights."""
    low, high = contact.surface.heights[[0, -1]]
    place = np.linspace(0.0, 1.0, HEIGHTS)
    place = place - _DENSER * np.sin(2.0 * np.pi * place) / (2.0 * np.pi)
    heights = low + (_LOWEST + (1.0 - _TOP - _LOWEST) * place) * (high - low)
    (middle,) = share(partial(_press_fully, contact), [heights[HEIGHTS // 2]])
    hardest = _HARDEST * float(np.linalg.norm(middle.state.force))
    depths, states = [], []
    for depth, divided in share(partial(_press_rod, contact, hardest), heights):
        depths.append(depth)
        states.append(divided)
        progress(len(depths) / HEIGHTS)
    return _Grid(rods=heights, depths=np.array(depths), q=np.array(states).transpose(1, 0, 2))


def _press_fully(contact: RigidContact, height: float) -> _Equilibrium:
    """Return the deepest equilibrium under a rod at a height [m]."""
    return _Rod(contact, height).press(np.inf)[-1]


def _press_rod(contact: RigidContact, hardest: float, height: float) -> tuple[float, list[NDArray]]:
    """Return the largest depth [m] of a rod at one height [m], and the equilibria (T, size) that divide its path.

    Raises:
        ContactError: the jaw cannot be pressed there.
    """
    rod = _Rod(contact, height)
    path = rod.press(hardest)
    depth = _find_depth(path, hardest)
    while (divided := rod.divide(path, depth)) is None:
        path = path[: _KEPT * len(path) // 4]
        if not path:
            raise ContactError(f"the jaw cannot be pressed evenly at a height of {1e3 * height:.1f} mm")
        depth = path[-1].depth
    return depth, divided


def _find_depth(path: list[_Equilibrium], hardest: float) -> float:
    """Return the depth [m] at which a path ends or, found between its steps, needs the largest force [N].

    Depths that change smoothly with height make equilibria that do.
    """
    from scipy.interpolate import CubicHermiteSpline  # a third of a second that stored equilibria need not wait

    if len(path) < 2:
        return path[-1].depth
    forces = np.array([item.state.force for item in path[-2:]])
    sizes, depths = np.linalg.norm(forces, axis=1), [item.depth for item in path[-2:]]
    if not sizes[0] < hardest < sizes[1]:
        return depths[1]
    slopes = [item.state.force_modes[:, 0] for item in path[-2:]]
    return float(CubicHermiteSpline(sizes, depths, sizes / np.einsum("ij,ij->i", forces, slopes))(hardest))


def _choose_rows(mechanics: Mechanics) -> NDArray:
    """Return the heights (n + 1,) [m] of the rows, the clamp's first.

    A solid moves linearly between its nodes: their own heights are best, divided where they are few. Where they are too
    many or too close together, as in unstructured meshes, and of frames the rows divide the face evenly.
    """
    surface, own, base = mechanics.contact.surface, *_find_own_rows(mechanics)
    if base >= own[0] > -np.inf and np.isfinite(base):
        raise ContactError("the inner face is held above its lower end, expected one that is held at its base or not")
    if not np.isfinite(base):  # nothing holds the face: its lower end is a row of its own
        base = surface.low[1] - (surface.high[1] - surface.low[1]) / ROWS
    if not (isinstance(mechanics.model, SolidModel) and has_own_rows(mechanics)):
        return np.linspace(base, surface.high[1], ROWS + 1)
    parts = 1 if len(own) >= _FEWEST_ROWS else -(-ROWS // len(own))
    return np.interp(np.arange(parts * len(own) + 1) / parts, np.arange(len(own) + 1), np.r_[base, own])


def _find_own_rows(mechanics: Mechanics) -> tuple[NDArray, float]:
    """Return the heights of the face's free nodes (n,) [m], and the highest of its clamped ones, -inf without any."""
    mesh, on_face = mechanics.mesh, mechanics.contact.face.holds(mechanics.mesh.nodes)
    held = np.isin(np.arange(len(mesh.nodes)), mesh.clamped)
    own = np.unique(np.round(mesh.nodes[on_face & ~held, 2], 7))
    return own, float(mesh.nodes[on_face & held, 2].max(initial=-np.inf))


def has_own_rows(mechanics: Mechanics) -> bool:
    """Return True if the rows can be those of the mesh's nodes: of a frame always, which has no mesh of its own."""
    if not isinstance(mechanics.model, SolidModel):
        return True
    own, base = _find_own_rows(mechanics)
    gaps = np.diff(np.r_[base if np.isfinite(base) else own[0] - (own[-1] - own[0]) / ROWS, own])
    return bool(gaps.min() > _CLOSEST * gaps.mean() and len(own) <= _MOST_ROWS)


def _divide(largest: float) -> NDArray:
    """Return the depths (T - 1,) [m] up to the largest at which equilibria are stored, denser at the beginning."""
    share = np.arange(1, DEPTHS + 1) / DEPTHS
    return largest * ((1.0 - _EARLY) * share + _EARLY * share**2)


def _are_joined(start: _Equilibrium, end: _Equilibrium) -> bool:
    """Return True if a jaw went from one equilibrium to another as it moves at both, and not over to another shape."""
    moved = end.q - start.q
    along = 0.5 * (end.depth - start.depth) * (start.state.modes[:, 0] + end.state.modes[:, 0])
    if end.depth - start.depth <= _SURE:
        return bool(np.linalg.norm(moved) < _FURTHER * np.linalg.norm(along))
    return bool(np.linalg.norm(moved - along) < _APART * np.linalg.norm(moved))


def _join(start: _Equilibrium, end: _Equilibrium) -> "CubicHermiteSpline":
    """Return the unknowns (size,) by depth [m] from one equilibrium to the next, as the jaw moves at both."""
    from scipy.interpolate import CubicHermiteSpline

    ends = (start, end)
    return CubicHermiteSpline(*zip(*((item.depth, item.q, item.state.modes[:, 0]) for item in ends), strict=True))


class _Rod:
    """A rod at one height, pressed in deeper and deeper."""

    def __init__(self, contact: RigidContact, height: float) -> None:
        low, high = contact.surface.heights[[0, -1]]
        self._contact, self._height = contact, height
        self._radius, self._deepest = _ROD * (high - low), _DEEPEST * (high - low)
        contact.set_indenter(RoundIndenter())
        self._touch = contact.find_touch(np.array([0.0, self._radius, height]))

    def press(self, hardest: float) -> list[_Equilibrium]:
        """Return equilibria at rising depths below first touch, up to where the jaw gives way or resists."""
        path: list[_Equilibrium] = []
        for depth in _divide(self._deepest):
            path += self._advance(path[-1] if path else None, depth, hardest)
            if not path or path[-1].depth < depth or np.linalg.norm(path[-1].state.force) > hardest:
                break
        if not path:
            raise ContactError(f"the jaw cannot be pressed at a height of {1e3 * self._height:.1f} mm")
        return path

    def _advance(self, start: _Equilibrium | None, depth: float, hardest: float) -> list[_Equilibrium]:
        """Return the equilibria on the way to a depth [m], the last one there unless the jaw gives way or resists."""
        way: list[_Equilibrium] = []
        done = start.depth if start else 0.0
        is_solid = isinstance(self._contact.model, SolidModel)
        step = depth - done if is_solid else min(depth - done, _LONGEST)
        while done < depth:
            last = way[-1] if way else start
            found = self._settle(done + step if done + step < depth - 1e-9 else depth, last)
            if found is None or (is_solid and last and not _are_joined(last, found)):
                step *= 0.5
                if step < _SHORTEST:
                    break
            else:
                way.append(found)
                done = found.depth if np.linalg.norm(found.state.force) <= hardest else depth
        return way

    def divide(self, path: list[_Equilibrium], largest: float) -> list[NDArray] | None:
        """Return the unknowns of equilibria that divide a path up to a depth [m], denser at its beginning.

        The unloaded one comes first. None where one is not found: the jaw goes over to another shape there.
        """
        depths = np.array([item.depth for item in path])
        states = [np.zeros(self._contact.model.size)]
        for depth in _divide(largest):
            below = int(np.searchsorted(depths, depth + 1e-12)) - 1
            start, end = (path[at] if 0 <= at < len(path) else None for at in (below, below + 1))
            found = start if start and start.depth > depth - 1e-12 else self._settle(depth, start, end)
            way = [found] if found else self._advance(start, depth, np.inf)
            if not way or way[-1].depth < depth - 1e-12:
                return None
            states.append(way[-1].q)
        return states

    def _settle(self, depth: float, start: _Equilibrium | None, end: _Equilibrium | None = None) -> _Equilibrium | None:
        """Return the equilibrium at a depth [m] of the rod, by one above it and one below it if known; or None."""
        contact, model = self._contact, self._contact.model
        place = np.array([self._touch + depth, self._radius, self._height])
        q, before, first = np.zeros(model.size), _NEAR, np.inf
        if start is not None and end is not None:
            q = _join(start, end)(depth)
        elif start is not None:
            q = start.q + start.state.modes[:, 0] * (depth - start.depth)
        elif end is not None:
            q = end.q * (depth / end.depth)
        for count in range(_ITERATIONS):
            state = contact.linearize(q, place)
            if not state.touches:
                q = q + contact.approach(q, state.correction, place)
                continue
            step = limit_step(model, state.correction)
            q = q + step
            if not (np.isfinite(q).all() and state.smallest_det > 0):
                return None
            size = float(np.abs(step).max())
            if size * min(size / before, 1.0) < _TOLERANCE:  # the next step is smaller still
                return _Equilibrium(depth=depth, q=q, state=state)
            if count == 0:
                first = size
            elif count >= _TRIED and size > first:
                return None
            before = size
        return None


def _store(
    young_modulus: float, grid: _Grid, heights: NDArray, parts: list[list[dict[str, NDArray]]], face: Face
) -> Manifold:
    """Return the manifold of a grid of equilibria as `Face` describes them (T, Z)."""
    tables = {name: np.array([[part[name] for part in row] for row in parts]) for name in parts[0][0]}
    return Manifold(
        young_modulus=young_modulus, heights=heights, rods=grid.rods, depths=grid.depths, basis=face.basis, **tables
    )
