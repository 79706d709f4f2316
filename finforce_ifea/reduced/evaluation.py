"""The jaw by its stored equilibria: full geometric nonlinearity without an element.

The unknowns q (2 n + 2,) are the loads on the n rows of the inner face (x and z interleaved) [N], whatever presses, and
the grid coordinates of the stored equilibrium that is nearest in shape. See `finforce_ifea.reduced.equilibria`. Under a
rigid object it is the same as `RollingContact`, at the price of a look-up.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.friction import Friction, LeaningContact
from finforce_ifea.contact_mechanics.indenter import Indenter, RoundIndenter
from finforce_ifea.contact_mechanics.pressed_jaw import ContactSurface, PressedState, RollingContact
from finforce_ifea.fem.factorisation import Factor
from finforce_ifea.fem.model import LARGEST_MOVE, Across, JawModel, Linearization
from finforce_ifea.jaw.face import FaceLine
from finforce_ifea.reduced.equilibria import (
    LARGEST_GRID_STEP,
    WATCHED,
    Manifold,
    add_product,
    approach_grid,
    blend,
    bound_grid_step,
    find_ends,
    find_grid_step,
    interpolate,
)

# The depth on the grid waits until its height is so near.
_BESIDE = 1.0
_ON_FACE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class ReducedProbe:
    """Material points of a reduced jaw.

    Attributes:
        points: undeformed positions (p, 3) [m].
        shapes: their motions at the stored equilibria (T, Z, 3 p) [m].
        compliance: what loads on the rows do to them (T, Z, 3 p, 2 n) [m/N], in single precision.
        rows: what share each row has in a point (p, n), for loads.
    """

    points: NDArray
    shapes: NDArray
    compliance: NDArray
    rows: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class FacePoints:
    """Points of the inner face, which the rows beside them move.

    Attributes:
        points: undeformed positions (p, 3) [m].
        rows: what share each row has in a point (p, n).
    """

    points: NDArray
    rows: NDArray

    def spread(self, moves: NDArray) -> NDArray:
        """Returns the motions (p, 3) [m] of the points for those of the rows (2 n,) [m]."""
        out = np.zeros(self.points.shape)
        out[:, ::2] = self.rows @ moves.reshape(-1, 2)
        return out


class _Identity:
    """The factor of loads that are unknowns themselves."""

    def solve(self, b: NDArray) -> NDArray:
        """Returns b."""
        return np.asarray(b)


class ReducedModel:
    """A jaw of stored equilibria; see `finforce_ifea.fem.model.JawModel`. No springs can be added to its tangent.

    Attributes:
        size: number of unknowns.
        reach: largest change of each unknown at once (size,).
    """

    rotations = None
    across: Across = "middle"

    def __init__(self, manifold: Manifold, full: JawModel, face: FaceLine) -> None:
        """Keeps the manifold of the jaw that `full` describes, with its inner face."""
        self.manifold, self._full, self._face = manifold, full, face
        self.rows = manifold.loads.shape[2]
        self.size = self.rows + 2
        self.loads, self.compliance = self.manifold.loads, self.manifold.compliance
        self.shape_compliance = self.manifold.shape_compliance
        stiffness = LARGEST_MOVE / np.abs(np.diagonal(self.compliance[0, 0]))
        self.reach = np.r_[stiffness, LARGEST_GRID_STEP, manifold.loads.shape[1]]

    def linearize(self, q: NDArray, *, tangent: bool = True) -> Linearization:
        """Returns the loads that q (size,) holds, and how far its grid coordinates are from the nearest equilibrium."""
        moves = self.moves(q)
        step = find_grid_step(self.manifold.moves, moves, q[-2:])[:2]
        if q[-2] < SHALLOW:
            step = self._find_shallow_step(q, step[0])
        force = np.r_[q[:-2], -step]
        return Linearization(force=force, energy=0.5 * float(moves @ q[:-2]), smallest_det=1.0, tangent=None)

    def _find_shallow_step(self, q: NDArray, by_depth: float) -> NDArray:
        """Returns the step (2,) of grid coordinates where the loads tell the height: that first, then the depth."""
        sizes, rods = np.abs(q[:-2:2]), self.manifold.rods
        if not sizes.any():
            return np.array([by_depth, 0.0])
        height = float(sizes @ self.manifold.heights[1:] / sizes.sum())
        by_height = np.interp(height, rods, np.arange(len(rods))) - q[-1]
        return np.array([by_depth if abs(by_height) < _BESIDE else 0.0, by_height])

    def moves(self, q: NDArray) -> NDArray:
        """Returns the motions of the rows (2 n,) [m], x and z interleaved."""
        return follow(self.manifold.moves, self.compliance, self.loads, q)

    def attach(self, points: NDArray, max_distance: float = 1e-3) -> ReducedProbe | FacePoints:
        """Returns a probe of material points (p, 3) [m, undeformed]; raises MeshError when one is off the jaw."""
        points = np.array(points, float)
        low, high = self.manifold.heights[[0, -1]]
        on_face = self._face.holds(points, _ON_FACE) & (points[:, 2] >= low) & (points[:, 2] <= high)
        if on_face.all():
            return FacePoints(points=points, rows=share_rows(self.manifold.heights, points[:, 2]))
        full, basis, zero = self._full, self.manifold.basis, np.zeros(self._full.size)
        motion = full.project(full.attach(points, max_distance), zero, basis).reshape(3 * len(points), -1)
        return ReducedProbe(
            points=points,
            shapes=self.manifold.shapes @ motion.T,
            compliance=np.ascontiguousarray(motion.astype(np.float32) @ self.shape_compliance),
            rows=share_rows(self.manifold.heights, points[:, 2]),
        )

    def positions(self, probe: ReducedProbe | FacePoints, q: NDArray) -> NDArray:
        """Returns the deformed positions (p, 3) [m] of a probe."""
        if isinstance(probe, FacePoints):
            return probe.points + probe.spread(self.moves(q))
        return place_points(probe.points, probe.shapes, probe.compliance, self.loads, q)

    def project(self, probe: ReducedProbe | FacePoints, q: NDArray, modes: NDArray) -> NDArray:
        """Returns the motions (p, 3, k) [m] of a probe for changes modes (size, k) of the loads alone."""
        if isinstance(probe, FacePoints):
            now = self.moves(q)
            return np.stack([probe.spread(self.moves(q + mode) - now) for mode in modes.T], axis=2)
        return move_points(probe.compliance, q, np.ascontiguousarray(modes))

    def load(self, probe: ReducedProbe | FacePoints, q: NDArray, forces: NDArray) -> NDArray:
        """Returns the loads (size,) [N] at the rows of forces (p, 3) [N] at points of the inner face."""
        return np.r_[(probe.rows.T @ forces[:, [0, 2]]).ravel(), 0.0, 0.0]

    def factorise(self, tangent: None) -> Factor:
        """Returns the factor of the unknowns, which are loads."""
        return _Identity()

    def vertices(self, q: NDArray) -> NDArray:
        """Returns the deformed mesh vertices (v, 3) [m], in mesh order."""
        return self._full.vertices(self.expand(q))

    def expand(self, q: NDArray) -> NDArray:
        """Returns the unknowns of the full model (m,) at this one's (size,), as far as its basis goes."""
        still = np.zeros((self.manifold.basis.shape[1], 1))
        shape = place_points(still, self.manifold.shapes, self.shape_compliance, self.loads, q)
        return self.manifold.basis @ shape.ravel()


def scale_manifold(manifold: Manifold, young_modulus: float) -> Manifold:
    """Returns the manifold of a jaw with another modulus [Pa]."""
    if young_modulus == manifold.young_modulus:
        return manifold
    factor = young_modulus / manifold.young_modulus
    soft = np.float32(1.0 / factor)
    return replace(
        manifold,
        young_modulus=young_modulus,
        loads=manifold.loads * factor,
        compliance=manifold.compliance * soft,
        shape_compliance=manifold.shape_compliance * soft,
    )


def share_rows(heights: NDArray, places: NDArray) -> NDArray:
    """Returns what share each row has in points at `places` (p,) [m] along the face, (p, n), linear between rows.

    Args:
        heights: of the clamp, where the jaw is held, and of the rows (n + 1,) [m].
        places: of the points (p,) [m].
    """
    below = np.clip(np.searchsorted(heights, places) - 1, 0, len(heights) - 2)
    upper = np.clip((places - heights[below]) / (heights[below + 1] - heights[below]), 0.0, 1.0)
    shares, points = np.zeros((len(places), len(heights))), np.arange(len(places))
    shares[points, below], shares[points, below + 1] = 1.0 - upper, upper
    return shares[:, 1:]


# A shape this share of the finger's length from a stored one has an error of about a per cent of its force.
_FARTHEST_SHAPE = 0.0056
_BEARABLE = 0.5
# A step larger than this share of what is allowed is cut where the energy rises by this share of the fall at its start.
_LARGE_STEP, _TOO_FAR, _BISECTIONS = 0.3, 0.5, 6


class ReducedContact(RollingContact):
    """A reduced model, its contact surface, and the object pressed into it.

    Attributes:
        rubbing: what acts along the surface: a lean of all forces, or friction with its history.
        bearable: force beyond which no equilibrium is believed [N]: half of the largest that is stored, beside the
            clamp; in its middle the bench finger bears a sixth of that.
    """

    def __init__(self, model: ReducedModel, surface: ContactSurface, face: FaceLine) -> None:
        """Keeps the model, its contact surface, one point per height, and the undeformed inner face."""
        self.model, self.surface, self.face, self.face_x = model, surface, face, face.plane
        self.indenter: Indenter = RoundIndenter()
        self.rubbing: LeaningContact | Friction = LeaningContact()
        shares = share_rows(model.manifold.heights, surface.heights)
        upper = np.clip(np.searchsorted(model.manifold.heights, surface.heights) - 1, 0, shares.shape[1] - 1)
        share = shares[np.arange(len(upper)), upper]
        self._rows = FaceRows(surface.points, upper - 1, share, model.manifold.rods)
        length = surface.heights[-1] - surface.heights[0]
        # the rest alone is stored on purpose where no rod was pressed in
        self._farthest = _FARTHEST_SHAPE * length if model.manifold.depths.any() else np.inf
        x, z = (model.loads[:, :, axis::2].sum(axis=2) for axis in (0, 1))
        self.bearable = _BEARABLE * float(np.hypot(x, z).max()) if np.isfinite(self._farthest) else np.inf
        self._tables = (model.manifold.moves, model.compliance, model.loads)

    def place_points(self, q: NDArray) -> NDArray:
        """See `RollingContact`."""
        return place_contact(self._rows, self.model.moves(q))

    def begin(self, height: float) -> NDArray:
        """Returns the unknowns (size,) of the unloaded jaw that is to be touched at a height [m]."""
        q, rods = np.zeros(self.model.size), self.model.manifold.rods
        q[-1] = np.interp(height, rods, np.arange(len(rods)))
        return q

    def linearize(self, q: NDArray, place: NDArray) -> PressedState:
        """Linearises the equilibrium with the object at a place (depth, shape, height); see `RollingContact`."""
        moves = self.model.moves(q)
        points = place_contact(self._rows, moves)
        contact = self.rub(points, place)
        parts = (contact.forces, contact.springs, contact.changes)
        step = step_contact(q, self._tables, self._rows, moves, points, parts)
        correction, force = step.correction, step.force
        if step.touches and step.size > _LARGE_STEP and not correction[-2:].any():
            share = self._find_share(q, points, correction, place)
            correction = share * correction
            force = share * force + (1.0 - share) * np.array([q[:-2:2].sum(), 0.0, q[1:-2:2].sum()])
        return PressedState(
            touches=step.touches,
            correction=correction,
            modes=step.modes,
            force=force,
            force_modes=step.force_modes,
            pressure_point=step.pressure_point,
            pressure_place=step.pressure_place,
            smallest_det=1.0,
            size=step.size,
            extrapolation=step.away / self._farthest,
        )

    def _find_share(self, q: NDArray, points: NDArray, step: NDArray, place: NDArray) -> float:
        """Returns the share of a step up to which the energy of jaw and object falls; corners make it rise again.

        Along a step of the loads that moves the rows by du and contact points (p, 3) by dx, it changes by
        (lambda - p)^T du, all as far as the step has gone.
        """
        after = self.model.moves(q + step)
        motion, moved = place_contact(self._rows, after) - points, after - self.model.moves(q)

        def change_energy(share: float) -> float:
            contact = self.rub(points + share * motion, place)
            return float((q[:-2] + share * step[:-2]) @ moved - (contact.forces * motion).sum())

        share, low, high = 1.0, 0.0, 1.0
        if change_energy(1.0) <= _TOO_FAR * abs(change_energy(0.0)):
            return 1.0
        for _ in range(_BISECTIONS):
            share = 0.5 * (low + high)
            low, high = (low, share) if change_energy(share) > 0.0 else (share, high)
        return share


_OPTIONS = {"cache": True, "error_model": "numpy"}
# The grid coordinates wait until a correction is below this share of what is allowed: a shape far from equilibrium says
# little of the nearest one.
_CALM = 0.15
# Below this grid coordinate of the depth a jaw is too little bent to tell the height by its shape.
SHALLOW = 0.5


class FaceRows(NamedTuple):
    """The contact points of the inner face on the rows that move them.

    Attributes:
        points: undeformed (p, 3) [m].
        low: the row below each point (p,), -1 for the clamp.
        share: of the row above in each point (p,).
        rods: heights of the grid (Z,) [m].
    """

    points: NDArray
    low: NDArray
    share: NDArray
    rods: NDArray


class ContactStep(NamedTuple):
    """One linearised equilibrium; see `finforce_ifea.contact_mechanics.pressed_jaw.PressedState`.

    Attributes:
        correction: of the unknowns (2 n + 2,).
        modes: (2 n + 2, 4).
        force: (3,) [N].
        force_modes: (3, 4).
        pressure_point: (3,) [m], NaN without contact.
        pressure_place: (3,) [m], NaN without contact.
        size: of the whole correction, as a share of what is allowed at once.
        away: root mean square distance of the shape from the nearest stored one [m].
        touches: whether any point is in contact.
    """

    correction: NDArray
    modes: NDArray
    force: NDArray
    force_modes: NDArray
    pressure_point: NDArray
    pressure_place: NDArray
    size: float
    away: float
    touches: bool


@njit(**_OPTIONS)
def follow(moves, compliance, loads, q):
    """Returns motions (k,) [m] of a table moves (T, Z, k) with its compliance (T, Z, k, 2 n) for unknowns q."""
    count = loads.shape[2]
    m, extra, out = q[count:], np.empty(count), np.empty(moves.shape[2])
    interpolate(loads, m, extra)
    for k in range(count):
        extra[k] = q[k] - extra[k]
    interpolate(moves, m, out)
    first, last = find_ends(extra)
    add_product(compliance, m, extra, first, last, 1, out)
    return out


@njit(**_OPTIONS)
def place_points(points, shapes, compliance, loads, q):
    """Returns points (p, c) [m] moved as the table shapes (T, Z, p c) [m] and its compliance say."""
    return points + follow(shapes, compliance, loads, q).reshape(points.shape)


@njit(**_OPTIONS)
def move_points(compliance, q, modes):
    """Returns the motions (p, 3, k) [m] of points whose compliance is (T, Z, 3 p, 2 n), for modes (2 n + 2, k)."""
    count, k = compliance.shape[3], modes.shape[1]
    first, last = count, 0
    for c in range(k):
        begin, end = find_ends(modes[:count, c])
        if end > 0:
            first, last = min(first, begin), max(last, end)
    first = min(first, last)
    size = compliance.shape[2]
    part = np.empty((size, last - first))
    blend(compliance, q[count:], 0, size, first, last, part)
    out = np.zeros((size, k))
    for i in range(size):
        for j in range(last - first):
            for c in range(k):
                out[i, c] += part[i, j] * modes[first + j, c]
    return out.reshape(size // 3, 3, k)


@njit(**_OPTIONS)
def place_contact(face, moves):
    """Returns the contact points (p, 3) [m], moved by the rows beside them, whose motions are (2 n,) [m]."""
    points = face.points.copy()
    for p in range(len(points)):
        low, share = face.low[p], face.share[p]
        for a in range(2):
            move = share * moves[2 * (low + 1) + a]
            if low >= 0:
                move += (1.0 - share) * moves[2 * low + a]
            points[p, 2 * a] += move
    return points


@njit(**_OPTIONS)
def _add_springs(spring, weight, row, low, share, stiffness):
    """Adds a point's springs (3, 3), seen from a row with a weight, to the band stiffness (2 n, 7)."""
    for j in range(2):
        other = low + j
        if other < 0:
            continue
        w = weight * (share if j else 1.0 - share)
        for a in range(2):
            for b in range(2):
                stiffness[2 * row + a, 3 + 2 * (other - row) + b - a] += w * spring[2 * a, 2 * b]


@njit(**_OPTIONS)
def _gather(face, contact, loads, stiffness):
    """Adds contact at points (forces, springs, changes) to the rows: loads (2 n, 5), band stiffness (2 n, 7).

    Columns of loads: now, and by what changes the contact. The band holds entries i - 3 ... i + 3 of each line i.
    """
    forces, springs, changes = contact
    for p in range(len(forces)):
        if springs[p, 0, 0] == 0.0 and springs[p, 2, 2] == 0.0:
            continue
        for i in range(2):
            row, w = face.low[p] + i, (face.share[p] if i else 1.0 - face.share[p])
            if row < 0:
                continue
            for a in range(2):
                k = 2 * row + a
                loads[k, 0] += w * forces[p, 2 * a]
                for c in range(changes.shape[2]):
                    loads[k, c + 1] += w * changes[p, 2 * a, c]
            _add_springs(springs[p], w, row, face.low[p], face.share[p], stiffness)


@njit(**_OPTIONS)
def _solve_rows(q, compliance, loads, stiffness):
    """Returns (2 n, 5): the step of the loads to equilibrium, and their derivatives by the place; and its motion [m].

    With loads p(u) of the object at the rows, springs S = -dp/du and compliance C, one step of Newton's method on
    lambda = p(u(lambda)) solves

        (I + S C) [step, modes] = [p - lambda, dp/dplace].
    """
    out, known = np.zeros(loads.shape), np.zeros(len(loads))
    for k in range(len(loads)):
        loads[k, 0] -= q[k]
        known[k] = abs(q[k]) + abs(stiffness[k, 3])
    first, last = find_ends(known)
    size = last - first
    if size == 0:
        return out, 0.0
    C, A = np.empty((size, size)), np.eye(size)
    blend(compliance, q[len(loads) :], first, last, first, last, C)
    for i in range(size):
        for d in range(7):
            k, s = i + d - 3, stiffness[first + i, d]
            if s != 0.0:
                for j in range(size):
                    A[i, j] += s * C[k, j]
    out[first:last] = np.linalg.solve(A, loads[first:last])
    return out, np.abs(C @ np.ascontiguousarray(out[first:last, 0])).max()


@njit(**_OPTIONS)
def _hold_base(q, compliance, face, contact, steps):
    """Returns what of the contact force the clamp holds below the first row, and its derivatives (2, 5) [N]."""
    forces, springs, changes = contact
    columns = changes.shape[2] + 1
    out, moved = np.zeros((2, columns)), np.zeros((2, columns))
    if not ((face.low < 0) & (springs[:, 0, 0] + springs[:, 2, 2] > 0.0)).any():
        return out
    rows = np.empty((2, len(steps)))
    blend(compliance, q[len(steps) :], 0, 2, 0, len(steps), rows)
    moved = rows @ steps
    for p in range(len(forces)):
        held, spring = 1.0 - face.share[p], springs[p]
        if face.low[p] >= 0:
            continue
        for a in range(2):
            out[a, 0] += held * forces[p, 2 * a]
            for c in range(1, columns):
                out[a, c] += held * changes[p, 2 * a, c - 1]
            for c in range(columns):
                share = spring[2 * a, 0] * moved[0, c] + spring[2 * a, 2] * moved[1, c]
                out[a, c] -= held * face.share[p] * share
    return out


@njit(**_OPTIONS)
def step_contact(
    q: NDArray, tables: tuple[NDArray, NDArray, NDArray], face: FaceRows, moves: NDArray, points: NDArray, contact: Any
) -> ContactStep:
    """Returns one linearised equilibrium with an object; see `ContactStep`.

    Args:
        q: unknowns (2 n + 2,).
        tables: motions of the rows at the stored equilibria (T, Z, 2 n) [m], their compliance (T, Z, 2 n, 2 n) and
            their loads (T, Z, 2 n) [N].
        face: the contact points on the rows.
        moves: of the rows now (2 n,) [m].
        points: contact points now (p, 3) [m].
        contact: forces (p, 3), springs (p, 3, 3) and changes (p, 3, 4); see `RubbedContact`.
    """
    count, columns = len(moves), contact[2].shape[2]
    loads, stiffness = np.zeros((count, columns + 1)), np.zeros((count, 7))
    _gather(face, contact, loads, stiffness)
    total, point, place = 0.0, np.zeros(3), np.zeros(3)
    for p in range(len(points)):
        size = np.hypot(contact[0][p, 0], contact[0][p, 2])
        if size > 0.0:
            total += size
            point += size * points[p]
            place += size * face.points[p]
    point, place = point / total, place / total
    steps, moved = _solve_rows(q, tables[1], loads, stiffness)
    size = moved / LARGEST_MOVE
    if total > 0.0 and size > 1.0:
        steps[:, 0] /= size
    correction, modes = np.zeros(count + 2), np.zeros((count + 2, columns))
    correction[:count], modes[:count] = steps[:, 0], steps[:, 1:]
    after = moves.copy()
    first, last = find_ends(correction[:count])
    add_product(tables[1], q[count:], correction[:count], first, last, WATCHED, after)
    nearest = find_grid_step(tables[0], after, q[count:])
    if size <= _CALM:
        approach_grid(tables, q[:count] + correction[:count], q[count:], nearest)
    correction[count:] = nearest[:2]
    if q[count] < SHALLOW and total > 0.0:
        step = np.array([correction[count], np.interp(place[2], face.rods, np.arange(len(face.rods))) - q[count + 1]])
        correction[count:] = bound_grid_step(step, q[count:], tables[0])
    turned = np.abs(correction[count:]).max() / LARGEST_GRID_STEP
    if size > _CALM:
        correction[count:] = 0.0
    size = max(size, turned)
    held = _hold_base(q, tables[1], face, contact, steps)
    force, force_modes = np.zeros(3), np.zeros((3, columns))
    force[::2], force_modes[::2] = held[:, 0], held[:, 1:]
    for k in range(count):
        axis = 2 * (k % 2)
        force[axis] += q[k] + correction[k]
        force_modes[axis] += modes[k]
    return ContactStep(correction, modes, force, force_modes, point, place, size, nearest[2], total > 0.0)
