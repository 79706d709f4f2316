"""A closed body from the measured surface alone; its back, which nobody saw, is that of the likeliest simple shape."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_erosion, distance_transform_edt, gaussian_filter, label, median_filter

from finforce.camera import compute_rays
from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.object_mesh import prepare_object_mesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.reconstruction.evidence import EDGE_BAND, ImageEvidence
from finforce_contact.reconstruction.result import HIDING_STEP, Reconstruction, Report, check_agreement, score_shape

GRID_POINTS = 4000
DEPTH_SMOOTHING = 2.0  # [px] standard deviation
PIT = 2  # [px] half width of the pits in the object's region that are filled
TAPER = 0.995  # of the back's breadth against the front's, so that the walls are not exactly along the rays
LEAST_THICKNESS = 0.02  # of the lateral extent


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthGrid:
    """The front on every `step`-th pixel: depths [m], which are the object, the cells between them, and their rays."""

    step: int
    front: NDArray
    region: NDArray
    cells: NDArray
    rays: NDArray


def complete_surface(evidence: ImageEvidence, shape: Reconstruction, report: Report | None = None) -> Reconstruction:
    """Return what is seen of the object, closed by the back of the simple shape that fits best.

    Args:
        evidence: of the masked depth image.
        shape: what `fit_primitive` makes of it, agreeing or not.
        report: called with the name of a stage and the share of it that is done.

    Raises:
        ReconstructionError: the mask is too narrow for a body.
        ObjectMeshError: the body is none that a gripper holds.
        MissingDependencyError: Open3D or manifold3d is not installed.
    """
    report = report or (lambda stage, share: None)
    grid = _build_grid(evidence, shape)
    report("front", 1.0)
    back = _guess_back(grid, evidence, shape)
    vertices, triangles = _join_sheets(grid, back)
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    mesh = prepare_object_mesh(vertices - centre, triangles, name="completed object")
    mesh = replace(mesh, notes=(*mesh.notes, "The back was not seen and is that of the likeliest simple shape."))
    report("closed", 1.0)
    T = np.eye(4)
    T[:3, 3] = centre
    score = score_shape(MeshView(mesh), T, evidence)
    check_agreement(score)
    return Reconstruction(mesh=mesh, T_camera_object=T, scale=np.ones(3), score=score, method="completion")


def _build_grid(evidence: ImageEvidence, shape: Reconstruction) -> DepthGrid:
    """Return the smoothed front, continued to the outline of the object's largest part.

    Behind what hides the object, its front is that of the shape.
    """
    expected = MeshView(shape.mesh).render(shape.T_camera_object, evidence.camera).depth
    with np.errstate(invalid="ignore"):
        free = np.isnan(expected) | (evidence.depth >= expected - HIDING_STEP)
    # pixels that fly at the edge of what hides it leave pits
    parts, _ = label(binary_closing(np.pad(evidence.mask | ~free, PIT), iterations=PIT)[PIT:-PIT, PIT:-PIT])
    region = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
    depth = _smooth_depth(evidence, region & evidence.mask)
    depth = np.where(evidence.mask | np.isnan(expected), depth, expected)
    step = int(np.ceil(np.sqrt(region.sum() / GRID_POINTS)))
    region = region[::step, ::step]
    cells = region[:-1, :-1] & region[1:, :-1] & region[:-1, 1:] & region[1:, 1:]
    if not cells.any():
        raise ReconstructionError("mask: nowhere two pixels wide; move nearer to the object")
    rays = compute_rays(evidence.camera)[::step, ::step]
    return DepthGrid(step=step, front=depth[::step, ::step], cells=_thicken_corners(cells), rays=rays, region=region)


def _smooth_depth(evidence: ImageEvidence, mask: NDArray) -> NDArray:
    """Return depths (h, w) [m], averaged over the mask's inner pixels and continued beyond."""
    known = binary_erosion(mask, iterations=EDGE_BAND) & np.isfinite(evidence.depth)
    if not known.any():
        raise ReconstructionError(f"mask: nowhere wider than {2 * EDGE_BAND + 1} pixels with depth; move nearer")
    depth = median_filter(_fill(evidence.depth, known), 5)
    share = gaussian_filter(known.astype(float), DEPTH_SMOOTHING)
    smooth = gaussian_filter(np.where(known, depth, 0.0), DEPTH_SMOOTHING) / np.maximum(share, 1e-6)
    return _fill(smooth, known)


def _fill(values: NDArray, known: NDArray) -> NDArray:
    """Return values (h, w), the unknown ones those of the nearest known pixel."""
    rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[rows, columns]


def _thicken_corners(cells: NDArray) -> NDArray:
    """Return cells (h, w) of which no two touch at a corner only, where walls would meet in a non-manifold edge."""
    cells = cells.copy()
    while True:
        a, b, c, d = cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]
        falling, rising = a & d & ~b & ~c, b & c & ~a & ~d
        if not (falling.any() or rising.any()):
            return cells
        cells[:-1, 1:] |= falling
        cells[:-1, :-1] |= rising


def _guess_back(grid: DepthGrid, evidence: ImageEvidence, shape: Reconstruction) -> NDArray:
    """Return the depths (h, w) of the back on the grid of the front [m].

    Where the shape has none, the body is taken as thick as it is wide.
    """
    step = grid.step
    back = MeshView(shape.mesh).render_back(shape.T_camera_object, evidence.camera, step)
    width = 2.0 * step * distance_transform_edt(grid.region) * grid.front / evidence.camera.fx
    thickness = np.where(np.isnan(back), width, back - grid.front)
    least = LEAST_THICKNESS * float(np.ptp(evidence.points, axis=0)[:2].max())
    return grid.front + np.maximum(thickness, least)


def _used_vertices(cells: NDArray) -> NDArray:
    """Return which vertices (h + 1, w + 1) are corners of cells (h, w)."""
    padded = np.pad(cells, 1)
    return padded[:-1, :-1] | padded[1:, :-1] | padded[:-1, 1:] | padded[1:, 1:]


def _join_sheets(grid: DepthGrid, back: NDArray) -> tuple[NDArray, NDArray]:
    """Return vertices (n, 3) [m] and triangles (m, 3) of front, back and the walls between them."""
    used = _used_vertices(grid.cells)
    count = int(used.sum())
    index = np.full(used.shape, -1)
    index[used] = np.arange(count)
    rays = grid.rays[used]
    narrow = TAPER * rays + (1.0 - TAPER) * rays.mean(axis=0)
    vertices = np.vstack((rays * grid.front[used, None], narrow * back[used, None]))
    corners = [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]
    quads = np.stack([corner[grid.cells] for corner in corners], axis=1)
    # seen from the camera, x right and y down, the corners run clockwise: inward for the front
    triangles = [quads[:, [0, 2, 1]], quads[:, [0, 3, 2]], quads[:, [0, 1, 2]] + count, quads[:, [0, 2, 3]] + count]
    padded = np.pad(grid.cells, 1)
    for turn, (rows, columns) in enumerate([(0, 1), (1, 2), (2, 1), (1, 0)]):
        beside = padded[rows : rows + grid.cells.shape[0], columns : columns + grid.cells.shape[1]]
        is_wall = grid.cells & ~beside
        a, b = corners[turn][is_wall], corners[(turn + 1) % 4][is_wall]
        triangles += [np.stack((a, b, b + count), axis=1), np.stack((a, b + count, a + count), axis=1)]
    return vertices, np.vstack(triangles)
