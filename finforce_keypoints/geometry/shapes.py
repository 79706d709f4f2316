"""The shapes that a finger can take: what its mechanics let the key points do together.

A network that looks at small pieces mistakes one thin rib for the next. The finger's own compliance does not: few
motions, one for each way of loading its face, describe where all its key points can be at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce.elimination import eliminate

if TYPE_CHECKING:
    from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics
    from finforce_ifea.jaw.jaw import Jaw

BENDS = 6  # motions of bending by small forces
PAIRS = ((0, 0), (0, 1), (1, 1))  # of them whose products tell what large motions have beside
COUNT = BENDS + len(PAIRS)
HEIGHTS = 12  # places along the face that are loaded
LARGEST = 0.2  # one standard deviation of the largest motion of a key point, in lengths of the finger
STRONGEST = 2.0  # force of large presses, in those that move the softest place so far
PIXELS = 2.0  # standard deviation of where the whole finger is in its picture [px]
TURN = 0.01  # standard deviation of how it is turned there [rad]
STEPS, NEWTON = 6, 4  # in which a jaw is pressed far, and of its equilibrium in each
RIDGE = 1e-4  # of the products' fit, in the mean of its normal matrix
ROUNDS, SETTLED = 10, 0.02  # of reweighting, and the largest change after which there is no other [px]
FARTHEST = 3.0  # standard deviations that a motion can be large
TOLERANCE, SHARE = 1.0, 0.05  # [px] and share of a point's motion by which a finger may differ from its shapes
_PAIRS = np.array(PAIRS)
_OPTIONS = {"cache": True, "error_model": "numpy", "nogil": True}
_known: dict[tuple[str, bytes], NDArray] = {}


def find_motions(jaw: Jaw) -> NDArray:
    """Return motions (COUNT, K, 2) of a jaw's key points in x and z, each times its standard deviation [m].

    The first ones are the main ones of the jaw's answers to small forces on its face, at rest. The others belong to the
    products (`PAIRS`) of the first ones' sizes: a finger that bends far turns, and grows shorter. Both sides of a jaw
    have the same.

    Raises:
        MeshError: the jaw cannot be meshed.
        JawFileError: the jaw has no mechanics.
    """
    key = (jaw.digest, jaw.keypoints[:, [0, 2]].tobytes())
    if key not in _known:
        _known[key] = _compute_motions(jaw)
    return _known[key]


def _compute_motions(jaw: Jaw) -> NDArray:
    from finforce_ifea.mechanics import build_mechanics
    from finforce_ifea.settings import EstimatorSettings

    mechanics = build_mechanics(jaw, EstimatorSettings(solver=jaw.model, mesh="coarse"))
    pressed, count = _PressedPoints(mechanics, jaw.keypoints), len(mechanics.contact.surface.heights)
    rows = np.unique(np.linspace(0, count - 1, HEIGHTS).round().astype(int))
    small = np.array([pressed.answer(row) for row in rows])
    largest = LARGEST * float(np.ptp(jaw.keypoints[:, 2]))
    softness = np.abs(small).max(axis=1)
    forces = largest / np.maximum(softness, softness.max() / STRONGEST)
    far = [motion for row, force in list(zip(rows, forces, strict=True))[1::3] for motion in pressed.press(row, force)]
    return find_ways(small, np.array(far), largest)


def find_ways(small: NDArray, far: NDArray, largest: float) -> NDArray:
    """Return motions (COUNT, K, 2), see `find_motions`.

    Args:
        small: of small forces (n, 2 K), of any size.
        far: of large ones (n, 2 K) [m]; may be none.
        largest: standard deviation of the largest motion of a key point [m].
    """
    _, sizes, ways = np.linalg.svd(small, full_matrices=False)
    ways, sizes = ways[:BENDS], sizes[:BENDS]
    sizes = sizes * largest / (sizes[0] * np.abs(ways[0]).max())
    linear = np.zeros((BENDS, small.shape[1]))
    linear[: len(ways)] = sizes[:, None] * ways
    products = np.zeros((len(PAIRS), small.shape[1]))
    if len(far) and len(ways) > 1:
        along = far @ ways.T
        terms = np.column_stack([along[:, i] * along[:, j] / (sizes[i] * sizes[j]) for i, j in PAIRS])
        normal = terms.T @ terms
        damped = normal + RIDGE * np.trace(normal) / len(PAIRS) * np.eye(len(PAIRS))
        products = np.linalg.solve(damped, terms.T @ (far - along @ ways))
    return np.vstack((linear, products)).reshape(COUNT, -1, 2)


class _PressedPoints:
    """The key points of a jaw under forces on single rows of its face."""

    def __init__(self, mechanics: Mechanics, keypoints: NDArray) -> None:
        from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE

        self._model, self._surface, self._keypoints = mechanics.model, mechanics.contact.surface, keypoints
        self._probe = mechanics.model.attach(keypoints, KEYPOINT_DISTANCE)
        self._rest = np.zeros(mechanics.model.size)
        self._factor = mechanics.model.factorise(mechanics.model.linearize(self._rest).tangent)

    def _force(self, row: int) -> NDArray:
        """Return the forces (p, 3) on the surface's points that press one row with 1 N."""
        forces = np.zeros_like(self._surface.points)
        forces[row * self._surface.across : (row + 1) * self._surface.across, 0] = -1.0 / self._surface.across
        return forces

    def answer(self, row: int) -> NDArray:
        """Return the motion in x and z (2 K,) by a small force [m/N]."""
        load = self._model.load(self._surface.probe, self._rest, self._force(row))
        motion = self._factor.solve(load)
        return self._model.project(self._probe, self._rest, motion[:, None])[:, [0, 2], 0].ravel()

    def press(self, row: int, force: float) -> list[NDArray]:
        """Return the motions in x and z, each (2 K,) [m], on the way to a force [N], as far as the jaw bears it."""
        from finforce_ifea.contact_mechanics.pressed_jaw import limit_step

        model, q, found = self._model, self._rest, []
        for share in np.linspace(0.0, 1.0, STEPS + 1)[1:]:
            for _ in range(NEWTON):
                state = model.linearize(q)
                if not state.smallest_det > 0.0:
                    return found
                load = model.load(self._surface.probe, q, share * force * self._force(row))
                q = q + limit_step(model, model.factorise(state.tangent).solve(load - state.force))
            if not np.isfinite(q).all():
                return found
            found.append((model.positions(self._probe, q) - self._keypoints)[:, [0, 2]].ravel())
        return found


def span_shapes(motions: NDArray, points: NDArray, scale: float) -> NDArray:
    """Return how the pixels of key points and reference point can move (2 (K + 1), m), by standard deviations [px].

    The last columns belong to products of the first ones' sizes (`PAIRS`).

    Args:
        motions: of the key points (COUNT, K, 2) [m], see `find_motions`.
        points: where they and the reference point are at rest (K + 1, 2) [px].
        scale: size of a pixel [m].
    """
    bending = np.pad(motions / scale, ((0, 0), (0, 1), (0, 0)))
    away = points - points[-1]
    whole = np.zeros((3, len(points), 2))
    whole[0, :, 0] = whole[1, :, 1] = PIXELS
    whole[2] = TURN * away[:, ::-1] * (-1.0, 1.0)
    return np.vstack((bending[:BENDS], whole, bending[BENDS:])).reshape(-1, 2 * len(points)).T.copy()


def fit_motion(shapes: NDArray, moves: NDArray, stddev: NDArray, weight: NDArray) -> NDArray:
    """Return the motion (K, 2) [px] within the shapes that is nearest to another, whatever single points claim.

    Args:
        shapes: of `span_shapes` (2 K, m).
        moves: how far points seem to have moved (K, 2) [px]; not finite where nobody knows.
        stddev: of each along a row or a column (K,) [px].
        weight: how much each is believed (K,), 0 to 1.
    """
    numbers = (np.ascontiguousarray(values, dtype=float) for values in (moves, stddev, weight))
    return _fit_motion(shapes, *numbers)


@njit(**_OPTIONS)
def _fit_motion(shapes, moves, stddev, weight):
    """Return the motion (K, 2) [px] within a finger's shapes that is nearest to another; see `fit_motion`."""
    sizes, believed = np.zeros(shapes.shape[1] - len(_PAIRS)), np.zeros(len(moves))
    found, doubt = np.zeros(moves.shape), np.ones(len(moves))
    for k in range(len(moves)):
        if np.isfinite(moves[k, 0]) and np.isfinite(moves[k, 1]) and np.isfinite(stddev[k]):
            believed[k] = weight[k] / stddev[k] ** 2
    for _ in range(ROUNDS):
        sizes = _improve_sizes(shapes, sizes, moves - found, believed * doubt)
        sizes = np.minimum(np.maximum(sizes, -FARTHEST), FARTHEST)
        before, found = found, _move_by(shapes, sizes)
        if np.abs(found - before).max() < SETTLED:
            break
        for k in range(len(moves)):
            if believed[k] > 0.0:
                apart = (moves[k, 0] - found[k, 0]) ** 2 + (moves[k, 1] - found[k, 1]) ** 2
                doubt[k] = 1.0 / (1.0 + 0.5 * apart / stddev[k] ** 2)
    return found


@njit(**_OPTIONS)
def _improve_sizes(shapes, sizes, left, weight):
    """Return the sizes (n,) of shapes by least squares of what is left (K, 2) [px], to first order around some."""
    count = len(sizes)
    A, g, slope = np.eye(count), np.zeros((count, 1)), np.empty(count)
    for row in range(len(shapes)):
        w = weight[row // 2]
        if not w > 0.0:
            continue
        slope[:] = shapes[row, :count]
        for p in range(len(_PAIRS)):
            i, j = _PAIRS[p]
            slope[i] += sizes[j] * shapes[row, count + p]
            slope[j] += sizes[i] * shapes[row, count + p]
        aim = left[row // 2, row % 2] + (slope * sizes).sum()
        for a in range(count):
            g[a, 0] += w * slope[a] * aim
            for b in range(count):
                A[a, b] += w * slope[a] * slope[b]
    eliminate(A, g)
    return g.reshape(count)


@njit(**_OPTIONS)
def _move_by(shapes, sizes):
    """Return the motion (K, 2) [px] of shapes by their sizes (n,)."""
    moved = np.zeros((len(shapes) // 2, 2))
    for row in range(len(shapes)):
        for a in range(len(sizes)):
            moved[row // 2, row % 2] += shapes[row, a] * sizes[a]
        for p in range(len(_PAIRS)):
            moved[row // 2, row % 2] += shapes[row, len(sizes) + p] * sizes[_PAIRS[p, 0]] * sizes[_PAIRS[p, 1]]
    return moved


def trust(moves: NDArray, shape: NDArray) -> NDArray:
    """Return factors (K,), 0 to 1, of the likelihood of points that moved (K, 2) [px] unlike their shape."""
    tolerance = np.hypot(TOLERANCE, SHARE * np.linalg.norm(shape, axis=1))
    return 1.0 / (1.0 + (np.linalg.norm(moves - shape, axis=1) / (3.0 * tolerance)) ** 4)
