"""The appearance of a finger from its side at rest, and the shapes that it can take.

A network that looks at small pieces mistakes one thin rib for the next. The finger's own compliance does not: few
motions, one for each way of loading its face, describe where all its key points can be at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit
from finforce.elimination import eliminate
from finforce_keypoints.geometry.side_picture import PlaneGrid

if TYPE_CHECKING:
    import shapely

    from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics
    from finforce_ifea.jaw.jaw import Jaw

FINER = 4  # times as many pixels are drawn each way, before they are averaged
BAR, SCREW_RADIUS = 3e-3, 1.3e-3  # [m] of bars that are only lines, and of what they turn on
MARK_RADIUS = 1.9e-3  # [m] of the dot at the reference point
BELOW, ABOVE, ASIDE, BESIDE = 0.07, 0.10, 0.27, 0.20  # free space around the finger, in lengths: z down and up, -x, +x
ROOM = 1.05  # of the width that a finger takes with its free space
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
LARGEST_SIZE = 3.0  # standard deviations that a motion can be large
TOLERANCE, SHARE = 1.0, 0.05  # [px] and share of a point's motion by which a finger may differ from its shapes
_PAIRS = np.array(PAIRS)
_OPTIONS = {"cache": True, "error_model": "numpy", "nogil": True}
_known: dict[tuple[str, bytes], NDArray] = {}


@dataclass(frozen=True, kw_only=True, eq=False)
class SideShape:
    """A finger at rest as seen from its side; all lengths in metres, x and z of the jaw frame.

    Attributes:
        rings: closed lines (n, 2) that bound its material; within an odd number of them there is some.
        clamped_z: everything up to this height is held.
        reference: (2,) the mark on what is held.
        bolts: (b, 3) x, z and radius of round things to be seen on its side.
    """

    rings: Sequence[NDArray]
    clamped_z: float
    reference: NDArray
    bolts: NDArray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def bounds(self) -> tuple[NDArray, NDArray]:
        """The least and the largest x and z (2,) of its material and its mark."""
        points = np.vstack((*self.rings, self.reference))
        return points.min(axis=0), points.max(axis=0)


def fit_grid(shape: SideShape, width: int = 176, height: int = 224) -> PlaneGrid:
    """Return the grid of width x height pixels in which a finger has room to bend."""
    low, high = shape.bounds
    length = high[1] - low[1]
    scale = max((1.0 + BELOW + ABOVE) * length / height, ROOM * (high[0] - low[0] + (ASIDE + BESIDE) * length) / width)
    middle_x = 0.5 * (low[0] + high[0]) + 0.5 * (BESIDE - ASIDE) * length
    middle_z = 0.5 * (low[1] + high[1]) + 0.5 * (ABOVE - BELOW) * length
    x, z = middle_x - 0.5 * (width - 1) * scale, middle_z - 0.5 * (height - 1) * scale
    return PlaneGrid(scale=float(scale), x=float(x), z=float(z), width=width, height=height)


def draw_template(shape: SideShape, grid: PlaneGrid) -> NDArray[np.uint8]:
    """Return the picture (height, width, 3) of a finger at rest: its material, what is held, its mark and bolts."""
    from finforce.optional import import_cv2

    cv2 = import_cv2()
    fine = np.zeros((3, FINER * grid.height, FINER * grid.width), np.uint8)

    def place(points: NDArray) -> NDArray:
        # fillPoly takes 1/16 px; the centre of a pixel lies at half its finer ones
        return np.round(16.0 * (FINER * (grid.pixels(points) + 0.5) - 0.5)).astype(np.int32)

    cv2.fillPoly(fine[0], [place(ring) for ring in shape.rings], 255, shift=4)
    held = grid.places(np.stack((np.zeros(grid.height), np.arange(grid.height)), axis=1))[:, 1] <= shape.clamped_z
    fine[1] = np.where(np.repeat(held, FINER), 255, 0)[:, None]
    for x, z, radius in ((*shape.reference, MARK_RADIUS), *shape.bolts):
        centre = place(np.array([[x, z]]))[0]
        cv2.circle(fine[2], tuple(centre.tolist()), round(16 * FINER * radius / grid.scale), 255, -1, shift=4)
    small = [cv2.resize(layer, (grid.width, grid.height), interpolation=cv2.INTER_AREA) for layer in fine]
    return np.stack(small, axis=-1)


def find_shape(jaw: Jaw) -> SideShape:
    """Return what a jaw looks like from its side, whatever describes it.

    Strips and bars without a thickness of their own are drawn as thick as bars usually are, and what joins them as the
    heads of screws at the key points.
    """
    import shapely

    bolts = np.zeros((0, 3))
    if jaw.section is not None:
        rings: Sequence[NDArray] = jaw.section.rings
        lowest = min(float(ring[:, 1].min()) for ring in rings)
        clamped_z = max(lowest, float(jaw.section.clamp_height(0.0)))
        bolts = jaw.section.clamped_circles
    elif jaw.drawing is not None:
        rings, clamped_z = _rings_of(_draw_bars(jaw)), jaw.drawing.clamped_z
        if jaw.drawing.joints == "hinged":
            bolts = np.column_stack((jaw.keypoints[:, [0, 2]], np.full(len(jaw.keypoints), SCREW_RADIUS)))
    else:
        mesh = jaw.build_mesh()
        corners = mesh.nodes[mesh.surface[:, :3]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = np.abs(normals[:, 1]) > 0.9 * np.linalg.norm(normals, axis=1)
        triangles = [shapely.Polygon(triangle) for triangle in corners[facing][:, :, [0, 2]]]
        rings = _rings_of(shapely.union_all([triangle.buffer(1e-6) for triangle in triangles]))
        clamped_z = float(mesh.nodes[mesh.clamped, 2].max())
    return SideShape(
        rings=tuple(rings),
        clamped_z=float(clamped_z),
        reference=jaw.reference_point[[0, 2]],
        bolts=bolts,
    )


def _draw_bars(jaw: Jaw) -> shapely.Geometry:
    """Return the material of a drawing; a bar without thickness joins the screws of its rib, if they are key points."""
    import shapely

    drawing, bars = jaw.drawing, []
    places = dict(zip(jaw.keypoint_names, jaw.keypoints[:, [0, 2]], strict=True))
    for number, (rib, ends) in enumerate(zip(drawing.ribs, drawing.junctions.swapaxes(0, 1), strict=True), start=1):
        if rib.thickness == 0.0:
            screws = [places.get(f"{band}_{number}", end) for band, end in zip(("inner", "outer"), ends, strict=True)]
            bars.append(shapely.LineString(screws).buffer(0.5 * BAR, cap_style="flat"))
    parts = [shapely.Polygon(part).buffer(1e-6, join_style="mitre") for part in drawing.outlines()]
    return shapely.union_all([*parts, *bars])


def _rings_of(area: shapely.Geometry) -> list[NDArray]:
    """Return the rings (n, 2) that bound an area."""
    polygons = getattr(area, "geoms", [area])
    return [np.array(ring.coords)[:-1] for polygon in polygons for ring in (polygon.exterior, *polygon.interiors)]


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
        moves: apparent motion of points (K, 2) [px]; not finite where unknown.
        stddev: of each along a row or a column (K,) [px].
        weight: weight of each (K,), 0 to 1.
    """
    numbers = (np.ascontiguousarray(values, dtype=float) for values in (moves, stddev, weight))
    return _fit_motion(shapes, *numbers)


@njit(**_OPTIONS)
def _fit_motion(shapes, moves, stddev, weight):
    """Return the motion (K, 2) [px] within a finger's shapes that is nearest to another; see `fit_motion`."""
    sizes, believed = np.zeros(shapes.shape[1] - len(_PAIRS)), np.zeros(len(moves))
    found, robust = np.zeros(moves.shape), np.ones(len(moves))
    for k in range(len(moves)):
        if np.isfinite(moves[k, 0]) and np.isfinite(moves[k, 1]) and np.isfinite(stddev[k]):
            believed[k] = weight[k] / stddev[k] ** 2
    for _ in range(ROUNDS):
        sizes = _improve_sizes(shapes, sizes, moves - found, believed * robust)
        sizes = np.minimum(np.maximum(sizes, -LARGEST_SIZE), LARGEST_SIZE)
        before, found = found, _move_by(shapes, sizes)
        if np.abs(found - before).max() < SETTLED:
            break
        for k in range(len(moves)):
            if believed[k] > 0.0:
                apart = (moves[k, 0] - found[k, 0]) ** 2 + (moves[k, 1] - found[k, 1]) ** 2
                robust[k] = 1.0 / (1.0 + 0.5 * apart / stddev[k] ** 2)
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
