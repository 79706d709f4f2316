"""The jaw by its stored equilibria: full geometric nonlinearity without an element.

The unknowns q (2 n + 2,) are the loads on the n rows of the inner face (x and z interleaved) [N], whatever presses, and
the grid coordinates of the stored equilibrium that is nearest in shape. See `finforce_ifea.reduced.equilibria`. Under a
rigid object it is the same as `RigidContact`, at the price of a look-up.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce.elimination import eliminate
from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, POINT_SHAPE, Traction, add_traction
from finforce_ifea.contact_mechanics.indenter import (
    Indenter,
    PressedObject,
    RoundIndenter,
    is_clear_of,
    measure_gap,
    pose_object,
    touch_object,
)
from finforce_ifea.contact_mechanics.pressed_jaw import (
    BISECTIONS,
    TOUCH,
    ContactSurface,
    PressedState,
    RigidContact,
)
from finforce_ifea.fem.model import LARGEST_MOVE, Across, Factor, JawModel, Linearization
from finforce_ifea.jaw.section import FaceLine
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
class _Probe:
    """Material points of a reduced jaw.

    Attributes:
        points: undeformed positions (p, 3) [m].
        basis: motion of the points per shape of the jaw (3 p, r).
        rows: weight of each row in a point (p, n), for loads.
    """

    points: NDArray
    basis: NDArray
    rows: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _FacePoints:
    """Points of the inner face, which the rows beside them move.

    Attributes:
        points: undeformed positions (p, 3) [m].
        rows: weight of each row in a point (p, n).
    """

    points: NDArray
    rows: NDArray

    def spread(self, moves: NDArray) -> NDArray:
        """Return the motions (p, 3) [m] of the points for those of the rows (2 n,) [m]."""
        out = np.zeros(self.points.shape)
        out[:, ::2] = self.rows @ moves.reshape(-1, 2)
        return out


class _Identity:
    """The factor of loads that are unknowns themselves."""

    def solve(self, b: NDArray) -> NDArray:
        """Return b."""
        return np.asarray(b)


class ReducedModel:
    """A jaw of stored equilibria; see `finforce_ifea.fem.model.JawModel`. No springs can be added to its tangent.

    Attributes:
        size: number of unknowns.
        reach: largest change of each unknown at once (size,).
        softness: modulus of the stored equilibria over that of the jaw, whose loads are smaller by that factor.

    Args:
        manifold: equilibria of such a jaw of any modulus.
        full: model of the jaw.
        face: its inner face.
        young_modulus: of the jaw [Pa].
    """

    rotations = None
    across: Across = "middle"

    def __init__(self, manifold: Manifold, full: JawModel, face: FaceLine, young_modulus: float) -> None:
        self.manifold, self._full, self._face = manifold, full, face
        self.softness = manifold.young_modulus / young_modulus
        self.rows = manifold.loads.shape[2]
        self.size = self.rows + 2
        self._rows = manifold.moves, manifold.compliance, manifold.loads, self.softness
        self.shapes = manifold.shapes, manifold.shape_compliance, manifold.loads, self.softness
        stiffness = LARGEST_MOVE / (self.softness * np.abs(np.diagonal(manifold.compliance[0, 0])))
        self.reach = np.r_[stiffness, LARGEST_GRID_STEP, manifold.loads.shape[1]]

    def linearize(self, q: NDArray) -> Linearization:
        """Return the loads that q (size,) holds, and how far its grid coordinates are from the nearest equilibrium."""
        moves = self.moves(q)
        step = find_grid_step(self.manifold.moves, moves, q[-2:])[:2]
        if q[-2] < _SHALLOW:
            step = self._find_shallow_step(q, step[0])
        force = np.r_[q[:-2], -step]
        return Linearization(force=force, energy=0.5 * float(moves @ q[:-2]), smallest_det=1.0, tangent=None)

    def _find_shallow_step(self, q: NDArray, by_depth: float) -> NDArray:
        """Return the step (2,) of grid coordinates where the loads tell the height: that first, then the depth."""
        sizes, rods = np.abs(q[:-2:2]), self.manifold.rods
        if not sizes.any():
            return np.array([by_depth, 0.0])
        height = float(sizes @ self.manifold.heights[1:] / sizes.sum())
        by_height = np.interp(height, rods, np.arange(len(rods))) - q[-1]
        return np.array([by_depth if abs(by_height) < _BESIDE else 0.0, by_height])

    def moves(self, q: NDArray) -> NDArray:
        """Return the motions of the rows (2 n,) [m], x and z interleaved."""
        return _follow(self._rows, q)

    def attach(self, points: NDArray, max_distance: float = 1e-3) -> _Probe | _FacePoints:
        """Return a probe of material points (p, 3) [m, undeformed]; raises MeshError when one is off the jaw."""
        points = np.array(points, float)
        low, high = self.manifold.heights[[0, -1]]
        on_face = self._face.holds(points, _ON_FACE) & (points[:, 2] >= low) & (points[:, 2] <= high)
        if on_face.all():
            return _FacePoints(points=points, rows=_share_rows(self.manifold.heights, points[:, 2]))
        full, zero = self._full, np.zeros(self._full.size)
        basis = full.project(full.attach(points, max_distance), zero, self.manifold.basis)
        return _Probe(
            points=points,
            basis=basis.reshape(3 * len(points), -1),
            rows=_share_rows(self.manifold.heights, points[:, 2]),
        )

    def positions(self, probe: _Probe | _FacePoints, q: NDArray) -> NDArray:
        """Return the deformed positions (p, 3) [m] of a probe."""
        if isinstance(probe, _FacePoints):
            return probe.points + probe.spread(self.moves(q))
        return _place_probe(probe.points, probe.basis, self.shapes, q)

    def project(self, probe: _Probe | _FacePoints, q: NDArray, modes: NDArray) -> NDArray:
        """Return the motions (p, 3, k) [m] of a probe for changes modes (size, k) of the loads alone."""
        if isinstance(probe, _FacePoints):
            now = self.moves(q)
            return np.stack([probe.spread(self.moves(q + mode) - now) for mode in modes.T], axis=2)
        return _move_probe(probe.basis, self.shapes, q, np.ascontiguousarray(modes))

    def load(self, probe: _Probe | _FacePoints, q: NDArray, forces: NDArray) -> NDArray:
        """Return the loads (size,) [N] at the rows of forces (p, 3) [N] at points of the inner face."""
        return np.r_[(probe.rows.T @ forces[:, [0, 2]]).ravel(), 0.0, 0.0]

    def factorise(self, tangent: None) -> Factor:
        """Return the factor of the unknowns, which are loads."""
        return _Identity()

    def vertices(self, q: NDArray) -> NDArray:
        """Return the deformed mesh vertices (v, 3) [m], in mesh order."""
        return self._full.vertices(self.expand(q))

    def expand(self, q: NDArray) -> NDArray:
        """Return the unknowns of the full model (m,) at this one's (size,), as far as its basis goes."""
        return self.manifold.basis @ _follow(self.shapes, q)


def _share_rows(heights: NDArray, places: NDArray) -> NDArray:
    """Return what share each row has in points at `places` (p,) [m] along the face, (p, n), linear between rows.

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
_MAX_FORCE_RATIO = 0.5
# A step larger than this share of what is allowed is cut where the energy rises by this share of the fall at its start.
_LARGE_STEP, _TOO_FAR, _BISECTIONS = 0.3, 0.5, 6


class ReducedContact(RigidContact):
    """A reduced model, its contact surface, and the object pressed into it.

    Attributes:
        packed: `_Jaw` as a plain tuple.
        max_force: force beyond which no equilibrium is believed [N]: half of the largest that is stored, beside the
            clamp; in its middle the bench finger bears a sixth of that.
    """

    def __init__(self, model: ReducedModel, surface: ContactSurface, face: FaceLine) -> None:
        """Keep the model, its contact surface, one point per height, and the undeformed inner face."""
        self.model, self.surface, self.face, self.face_x = model, surface, face, face.plane
        self.indenter: Indenter = RoundIndenter()
        shares = _share_rows(model.manifold.heights, surface.heights)
        upper = np.clip(np.searchsorted(model.manifold.heights, surface.heights) - 1, 0, shares.shape[1] - 1)
        share = shares[np.arange(len(upper)), upper]
        length = surface.heights[-1] - surface.heights[0]
        # the rest alone is stored on purpose where no rod was pressed in
        farthest = _FARTHEST_SHAPE * length if model.manifold.depths.any() else np.inf
        x, z = (model.manifold.loads[:, :, axis::2].sum(axis=2) / model.softness for axis in (0, 1))
        self.max_force = _MAX_FORCE_RATIO * float(np.hypot(x, z).max()) if np.isfinite(farthest) else np.inf
        self._jaw = _Jaw(
            moves=model.manifold.moves,
            compliance=model.manifold.compliance,
            loads=model.manifold.loads,
            softness=model.softness,
            points=surface.points,
            low=upper - 1,
            share=share,
            rods=model.manifold.rods,
            stiffness=surface.stiffness,
            face_x=face.plane,
            farthest=farthest,
        )
        self.packed = tuple(self._jaw)
        self._no_points = np.zeros((0, 3)), np.zeros((0, len(model.manifold.basis.T))), model.shapes

    def place_points(self, q: NDArray) -> NDArray:
        """See `RigidContact`."""
        return _place_contact(self._jaw.points, self._jaw.low, self._jaw.share, self.model.moves(q))

    def begin(self, height: float) -> NDArray:
        """Return the unknowns (size,) of the unloaded jaw that is to be touched at a height [m]."""
        q, rods = np.zeros(self.model.size), self.model.manifold.rods
        q[-1] = np.interp(height, rods, np.arange(len(rods)))
        return q

    def linearize(self, q: NDArray, x: NDArray, traction: Traction = FRICTIONLESS) -> PressedState:
        """Linearise the equilibrium with the object in a contact state x (depth, shape, height); see `RigidContact`."""
        pressed = tuple(self.indenter.pressed)
        return linearize_reduced(self.packed, pressed, tuple(traction), q, x, self._no_points)[0]

    def linearize_points(
        self, probe: _Probe | _FacePoints, q: NDArray, x: NDArray, traction: Traction
    ) -> tuple[PressedState, NDArray, NDArray]:
        """See `RigidContact`."""
        if isinstance(probe, _FacePoints):
            return super().linearize_points(probe, q, x, traction)
        pressed, points = tuple(self.indenter.pressed), (probe.points, probe.basis, self.model.shapes)
        return linearize_reduced(self.packed, pressed, tuple(traction), q, x, points)

    def approach(self, q: NDArray, step: NDArray, x: NDArray) -> NDArray:
        """See `RigidContact`."""
        return _approach_reduced(self.packed, tuple(self.indenter.pressed), q, step, x)


_OPTIONS = {"cache": True, "error_model": "numpy"}
# The grid coordinates wait until a correction is below this share of what is allowed: a shape far from equilibrium says
# little of the nearest one.
_CALM = 0.15
# A jaw that should be by more than this of the grid elsewhere and cannot get there is in no equilibrium that is stored.
_LARGEST_LEFT = 0.1
# Below this grid coordinate of the depth a jaw is too little bent to tell the height by its shape.
_SHALLOW = 0.5


class _Jaw(NamedTuple):
    """A reduced model and its contact surface for compiled code.

    Attributes:
        moves: of the rows at the stored equilibria (T, Z, 2 n) [m].
        compliance: of the rows (T, Z, 2 n, 2 n) [m/N].
        loads: stored (T, Z, 2 n) [N].
        softness: see `ReducedModel`.
        points: contact points, undeformed (p, 3) [m].
        low: the row below each point (p,), -1 for the clamp.
        share: of the row above in each point (p,).
        rods: heights of the grid (Z,) [m].
        stiffness: penalty of each point (p,) [N/m].
        face_x: from which depths count [m].
        farthest: distance of a shape from the stored ones that these are good for [m].
    """

    moves: NDArray
    compliance: NDArray
    loads: NDArray
    softness: float
    points: NDArray
    low: NDArray
    share: NDArray
    rods: NDArray
    stiffness: NDArray
    face_x: float
    farthest: float


class _Gathered(NamedTuple):
    """Contact at the rows; see `_gather`.

    Attributes:
        loads: now, and by what changes the contact (2 n, 5) [N].
        stiffness: band with the entries i - 3 ... i + 3 of each line i (2 n, 7) [N/m].
        held: force of the contact taken by the clamp, and its derivatives (2, 5) [N].
        grip: springs between the clamp and the first row (2, 2) [N/m].
        size: sum of the sizes of the forces [N].
        point: pressure centre (3,) [m], NaN without contact.
        location: the same on the undeformed surface (3,) [m].
    """

    loads: NDArray
    stiffness: NDArray
    held: NDArray
    grip: NDArray
    size: float
    point: NDArray
    location: NDArray


class _PlacedObject(NamedTuple):
    """An object `PressedObject`, its pose by `pose_object`, and the `Traction` between it and a jaw."""

    pressed: Any
    pose: Any
    traction: Any


@njit(**_OPTIONS)
def _follow(tables, q):
    """Return motions (k,) [m] for unknowns q (2 n + 2,).

    Args:
        tables: stored motions (T, Z, k) [m], their compliance (T, Z, k, 2 n) [m/N], the loads (T, Z, 2 n) [N], and
            `ReducedModel.softness`.
        q: unknowns.
    """
    moves, compliance, loads, softness = tables
    count = loads.shape[2]
    m, extra, out = q[count:], np.empty(count), np.empty(moves.shape[2])
    interpolate(loads, m, extra)
    for k in range(count):
        extra[k] = softness * q[k] - extra[k]
    interpolate(moves, m, out)
    add_product(compliance, m, extra, 1, out)
    return out


@njit(**_OPTIONS)
def _follow_rows(jaw, q):
    """Return the motions of the rows (2 n,) [m] for unknowns q (2 n + 2,)."""
    return _follow((jaw.moves, jaw.compliance, jaw.loads, jaw.softness), q)


@njit(**_OPTIONS)
def _place_probe(points, basis, tables, q):
    """Return material points (p, 3) [m], moved as a jaw with unknowns q is bent.

    Args:
        points: undeformed (p, 3) [m].
        basis: their motion per shape (3 p, r).
        tables: of the shapes, see `_follow`.
        q: unknowns (2 n + 2,).
    """
    if len(points) == 0:
        return points
    return points + (basis @ _follow(tables, q)).reshape(points.shape)


@njit(**_OPTIONS)
def _move_probe(basis, tables, q, modes):
    """Return the motions (p, 3, k) [m] of points for modes (2 n + 2, k) of the loads.

    Args:
        basis: motion of the points per shape (3 p, r).
        tables: of the shapes, see `_follow`.
        q: unknowns (2 n + 2,).
        modes: changes of the loads [N].
    """
    _, compliance, _, softness = tables
    (rank, count), k = compliance.shape[2:], modes.shape[1]
    if len(basis) == 0:
        return np.zeros((0, 3, k))
    first, last = count, 0
    for c in range(k):
        begin, end = find_ends(modes[:count, c])
        if end > 0:
            first, last = min(first, begin), max(last, end)
    first = min(first, last)
    part = np.empty((rank, last - first))
    blend(compliance, q[count:], (0, rank), (first, last), part)
    return (basis @ (softness * (part @ modes[first:last]))).reshape(len(basis) // 3, 3, k)


@njit(**_OPTIONS)
def _place_contact(points, low, share, moves):
    """Return contact points (p, 3) [m], moved by the rows beside them, whose motions are (2 n,) [m]."""
    placed = points.copy()
    for p in range(len(points)):
        for a in range(2):
            move = share[p] * moves[2 * (low[p] + 1) + a]
            if low[p] >= 0:
                move += (1.0 - share[p]) * moves[2 * low[p] + a]
            placed[p, 2 * a] += move
    return placed


@njit(**_OPTIONS)
def _add_springs(out, weight, row, low, share, stiffness):
    """Add a point's springs, see `add_traction`, seen from a row with a weight, to the band stiffness (2 n, 7)."""
    for j in range(2):
        other = low + j
        if other < 0:
            continue
        w = weight * (share if j else 1.0 - share)
        for a in range(2):
            for b in range(2):
                stiffness[2 * row + a, 3 + 2 * (other - row) + b - a] += w * out[a, 1 + b]


@njit(**_OPTIONS)
def _add_to_clamp(out, weight, share, held, grip):
    """Add what the clamp takes of a point, see `add_traction`, to held (2, 5), and its springs to grip (2, 2)."""
    for a in range(2):
        held[a, 0] += weight * out[a, 0]
        for c in range(4):
            held[a, c + 1] += weight * out[a, 3 + c]
        for b in range(2):
            grip[a, b] += weight * share * out[a, 1 + b]


@njit(**_OPTIONS)
def _gather(jaw, placed, points):
    """Return the contact of an object with contact points (p, 3) [m] at the rows."""
    count, (pressed, pose, traction) = jaw.loads.shape[2], placed
    loads, stiffness, held, grip = np.zeros((count, 5)), np.zeros((count, 7)), np.zeros((2, 5)), np.zeros((2, 2))
    total, point, location = 0.0, np.zeros(3), np.zeros(3)
    out = np.zeros(POINT_SHAPE)
    for p in range(len(points)):
        x, z = points[p, 0], points[p, 2]
        if is_clear_of(pressed, pose, x, z):
            continue
        touch = touch_object(pressed, pose, x, z, jaw.stiffness[p])
        if touch.kxx == 0.0 and touch.kzz == 0.0:
            continue
        add_traction(traction, touch, p, x, z, jaw.stiffness[p], out)
        size = np.hypot(out[0, 0], out[1, 0])
        total += size
        for a in range(3):
            point[a] += size * points[p, a]
            location[a] += size * jaw.points[p, a]
        low, share = jaw.low[p], jaw.share[p]
        for i in range(2):
            row, w = low + i, (share if i else 1.0 - share)
            if row < 0:
                _add_to_clamp(out, w, share, held, grip)
                continue
            for a in range(2):
                loads[2 * row + a, 0] += w * out[a, 0]
                for c in range(4):
                    loads[2 * row + a, c + 1] += w * out[a, 3 + c]
            _add_springs(out, w, row, low, share, stiffness)
    for a in range(3):
        point[a] /= total
        location[a] /= total
    return _Gathered(loads, stiffness, held, grip, total, point, location)


@njit(**_OPTIONS)
def _solve_rows(jaw, q, loads, stiffness):
    """Return (2 n, 5): the step of the loads to equilibrium, and their derivatives by the state; and its motion [m].

    With loads p(u) of the object at the rows, springs S = -dp/du and compliance C, one step of Newton's method on
    lambda = p(u(lambda)) solves

        (I + S C) [step, modes] = [p - lambda, dp/dx].
    """
    out, known = np.zeros(loads.shape), np.zeros(len(loads))
    for k in range(len(loads)):
        loads[k, 0] -= q[k]
        known[k] = abs(q[k]) + abs(stiffness[k, 3])
    first, last = find_ends(known)
    size = last - first
    if size == 0:
        return out, 0.0
    C, A = np.empty((size, size)), np.zeros((size, size))
    blend(jaw.compliance, q[len(loads) :], (first, last), (first, last), C)
    C *= jaw.softness
    for i in range(size):
        A[i, i] = 1.0
        for c in range(5):
            out[first + i, c] = loads[first + i, c]
        for d in range(7):
            k, s = i + d - 3, stiffness[first + i, d]
            if s != 0.0:
                for j in range(size):
                    A[i, j] += s * C[k, j]
    eliminate(A, out[first:last])
    largest = 0.0
    for i in range(size):
        move = 0.0
        for j in range(size):
            move += C[i, j] * out[first + j, 0]
        largest = max(largest, abs(move))
    return out, largest


@njit(**_OPTIONS)
def _change_energy(jaw, placed, points, motion, share, work):
    """Return by how much the energy changes along a step of which a share has been made; see `_find_share`."""
    pressed, pose, traction = placed
    out, change = np.zeros(POINT_SHAPE), work[0] + share * work[1]
    for p in range(len(points)):
        x, z = points[p, 0] + share * motion[p, 0], points[p, 2] + share * motion[p, 2]
        if is_clear_of(pressed, pose, x, z):
            continue
        touch = touch_object(pressed, pose, x, z, jaw.stiffness[p])
        if touch.kxx != 0.0 or touch.kzz != 0.0:
            add_traction(traction, touch, p, x, z, jaw.stiffness[p], out)
            change -= out[0, 0] * motion[p, 0] + out[1, 0] * motion[p, 2]
    return change


@njit(**_OPTIONS)
def _find_share(jaw, placed, points, moves, q, step):
    """Return the share of a step up to which the energy of jaw and object falls; corners make it rise again.

    Along a step of the loads that moves the rows by du and contact points (p, 3) by dx, it changes by
    (lambda - p)^T du, all as far as the step has gone.
    """
    moved = _follow_rows(jaw, q + step)
    motion = _place_contact(jaw.points, jaw.low, jaw.share, moved) - points
    work = np.zeros(2)
    for k in range(len(moves)):
        work[0] += q[k] * (moved[k] - moves[k])
        work[1] += step[k] * (moved[k] - moves[k])
    parts = (jaw, placed, points, motion)
    share, low, high = 1.0, 0.0, 1.0
    if _change_energy(*parts, 1.0, work) <= _TOO_FAR * abs(_change_energy(*parts, 0.0, work)):
        return 1.0
    for _ in range(_BISECTIONS):
        share = 0.5 * (low + high)
        if _change_energy(*parts, share, work) > 0.0:
            high = share
        else:
            low = share
    return share


@njit(**_OPTIONS)
def _step_grid(jaw, q, moves, steps, size, contact):
    """Return the step (2,) of the grid coordinates after a step of the loads, and the distance from the grid [m].

    Beside it stands the length of a step that had to be left out, 0 for none.

    Args:
        jaw: see `_Jaw`.
        q: unknowns (2 n + 2,).
        moves: of the rows now (2 n,) [m].
        steps: of the loads, and their derivatives (2 n, 5).
        size: of the step, as a share of what is allowed at once.
        contact: see `_Gathered`.
    """
    count, tables = len(moves), (jaw.moves, jaw.compliance, jaw.loads)
    after, change, there = np.empty(count), np.empty(count), np.empty(count)
    for k in range(count):
        after[k], change[k] = moves[k], jaw.softness * steps[k, 0]
        there[k] = jaw.softness * q[k] + change[k]
    add_product(jaw.compliance, q[count:], change, WATCHED, after)
    nearest = find_grid_step(jaw.moves, after, q[count:])
    left = approach_grid(tables, there, q[count:], nearest) if size <= _CALM else 0.0
    if q[count] < _SHALLOW and contact.size > 0.0:
        nearest[1] = _read_grid(jaw.rods, contact.location[2]) - q[count + 1]
        bound_grid_step(nearest, q[count:], jaw.moves)
        left = 0.0
    return nearest, left


@njit(**_OPTIONS)
def _read_grid(rods, height):
    """Return the grid coordinate of a height [m] among rising ones (Z,) [m]."""
    last = len(rods) - 1
    if not height > rods[0]:
        return 0.0
    for k in range(last):
        if height < rods[k + 1]:
            return k + (height - rods[k]) / (rods[k + 1] - rods[k])
    return float(last)


@njit(**_OPTIONS)
def linearize_reduced(jaw, pressed, traction, q, x, probe):
    """Return one linearised equilibrium as `PressedState`; there, places (p, 3) [m] and motions (p, 3, 4) of a probe.

    Plain tuples are handed over from Python several times as fast as named ones.

    Args:
        jaw: `_Jaw` as a plain tuple.
        pressed: `PressedObject` as a plain tuple.
        traction: `Traction` as a plain tuple.
        q: unknowns (2 n + 2,).
        x: depth [m], shape and height [m] of the object (3,).
        probe: points and basis of a `_Probe`, and `ReducedModel.shapes`.
    """
    jaw, pressed, traction = _Jaw(*jaw), PressedObject(*pressed), Traction(*traction)
    count = jaw.loads.shape[2]
    moves = _follow_rows(jaw, q)
    points = _place_contact(jaw.points, jaw.low, jaw.share, moves)
    placed = _PlacedObject(pressed, pose_object(pressed, jaw.face_x, x), traction)
    contact = _gather(jaw, placed, points)
    touches = contact.size > 0.0
    steps, moved = _solve_rows(jaw, q, contact.loads, contact.stiffness)
    size = moved / LARGEST_MOVE
    if touches and size > 1.0:
        for k in range(len(steps)):
            steps[k, 0] /= size
    nearest, left = _step_grid(jaw, q, moves, steps, size, contact)
    correction, modes = np.zeros(count + 2), np.zeros((count + 2, 4))
    turned = max(abs(nearest[0]), abs(nearest[1])) / LARGEST_GRID_STEP
    if size <= _CALM:
        correction[count], correction[count + 1] = nearest[0], nearest[1]
    size = max(size, turned)
    force, force_modes = np.zeros(3), np.zeros((3, 4))
    _hold_base(jaw, q, contact, steps, force, force_modes)
    for k in range(count):
        axis = 2 * (k % 2)
        correction[k] = steps[k, 0]
        force[axis] += q[k] + steps[k, 0]
        for c in range(4):
            modes[k, c] = steps[k, c + 1]
            force_modes[axis, c] += steps[k, c + 1]
    if touches and size > _LARGE_STEP and correction[count] == 0.0 and correction[count + 1] == 0.0:
        share = _find_share(jaw, placed, points, moves, q, correction)
        for k in range(len(correction)):
            correction[k] *= share
        for axis in range(0, 3, 2):
            force[axis] = share * force[axis] + (1.0 - share) * q[axis // 2 : count : 2].sum()
    far = max(nearest[2] / jaw.farthest, left / _LARGEST_LEFT)
    where = contact.point, contact.location
    state = PressedState(touches, correction, modes, force, force_modes, *where, 1.0, size, far)
    (material, basis, tables), q = probe, q + correction
    return state, _place_probe(material, basis, tables, q), _move_probe(basis, tables, q, modes)


@njit(**_OPTIONS)
def _hold_base(jaw, q, contact, steps, force, force_modes):
    """Add what of the contact force the clamp holds below the first row to force (3,) and derivatives (3, 4) [N]."""
    if not (contact.grip[0, 0] + contact.grip[1, 1] > 0.0):
        return
    count = len(steps)
    rows, moved = np.empty((2, count)), np.zeros((2, 5))
    blend(jaw.compliance, q[count:], (0, 2), (0, count), rows)
    rows *= jaw.softness
    for a in range(2):
        for k in range(count):
            for c in range(5):
                moved[a, c] += rows[a, k] * steps[k, c]
    for a in range(2):
        for c in range(5):
            held = contact.held[a, c] - contact.grip[a, 0] * moved[0, c] - contact.grip[a, 1] * moved[1, c]
            if c == 0:
                force[2 * a] += held
            else:
                force_modes[2 * a, c - 1] += held


@njit(**_OPTIONS)
def _approach_reduced(jaw, pressed, q, step, x):
    """Return the step of a jaw that has lost contact, cut where it meets the object again; see `linearize_reduced`."""
    jaw, pressed = _Jaw(*jaw), PressedObject(*pressed)
    low, high, pose = 0.0, 1.0, pose_object(pressed, jaw.face_x, x)
    for _ in range(BISECTIONS):
        share = 0.5 * (low + high)
        moves = _follow_rows(jaw, q + share * step)
        if measure_gap(pressed, pose, _place_contact(jaw.points, jaw.low, jaw.share, moves)) < -TOUCH:
            high = share
        else:
            low = share
    return high * step
