"""Object meshes from one depth image, with or without a generated mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_erosion, distance_transform_edt, gaussian_filter, label, median_filter
from scipy.spatial import ConvexHull

from finforce.camera import compute_rays
from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.object_mesh import ObjectMesh, prepare_object_mesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.reconstruction.evidence import (
    DEPTH_UNITS,
    EDGE_BAND,
    HIDING_STEP,
    GeneratedMesh,
    ImageEvidence,
    Reconstruction,
    Report,
    check_agreement,
    score_shape,
)
from finforce_contact.reconstruction.generated import align_as_paper, build_poisson_mesh, close_mesh
from finforce_contact.reconstruction.shape_search import (
    Placement,
    ScaleFreedom,
    SearchFreedom,
    fit_primitive,
    search_shape,
    turn_starts,
)

GRID_POINTS = 4000
DEPTH_SMOOTHING = 2.0  # [px] standard deviation
PIT = 2  # [px] half width of the pits in the object's region that are filled
TAPER = 0.995  # of the back's breadth against the front's, so that the walls are not exactly along the rays
# [-], 1-sigma of the thickness of a completed object: as a whole within 3 % for a mug and a bottle, 8 to 35 % too thin
# for a leaning block with a shoulder, in three rendered views each.
UNSEEN_ERROR = 0.2
LEAST_THICKNESS = 0.02  # of the lateral extent


@dataclass(frozen=True, kw_only=True, eq=False)
class _DepthGrid:
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
        shape: result of `fit_primitive`, agreeing or not.
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
    thickness = float(np.median(back[grid.region] - grid.front[grid.region]))
    note = (
        "The back was not seen and is that of the likeliest simple shape: "
        f"{1e3 * thickness:.0f} ± {1e3 * UNSEEN_ERROR * thickness:.0f} mm behind the front."
    )
    mesh = replace(mesh, notes=(*mesh.notes, note), unseen_stddev=0.5 * UNSEEN_ERROR * thickness)
    report("closed", 1.0)
    T = np.eye(4)
    T[:3, 3] = centre
    score = score_shape(MeshView(mesh), T, evidence)
    check_agreement(score)
    return Reconstruction(mesh=mesh, T_camera_object=T, scale=np.ones(3), score=score, method="completion")


def _build_grid(evidence: ImageEvidence, shape: Reconstruction) -> _DepthGrid:
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
    return _DepthGrid(step=step, front=depth[::step, ::step], cells=_thicken_corners(cells), rays=rays, region=region)


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


def _guess_back(grid: _DepthGrid, evidence: ImageEvidence, shape: Reconstruction) -> NDArray:
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


def _join_sheets(grid: _DepthGrid, back: NDArray) -> tuple[NDArray, NDArray]:
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


METHODS = ("robust", "paper", "primitive", "completion")
FROM_GENERATED = ("robust", "paper")
WIDEST = 0.15  # [m], least width of an object that parallel grippers grasp
PRIMITIVE_MISFIT = 2e-3  # [m] above which an object is no primitive: true ones reach 0.7 to 1.6 mm, others 2.7 and more
# generators get proportions wrong by some per cent; what the image does not show keeps them
STRETCHABLE = SearchFreedom(late=ScaleFreedom(basis=np.eye(3), stiffness=0.03))


def reconstruct(
    evidence: ImageEvidence,
    generated: GeneratedMesh | None = None,
    method: str = "",
    report: Report | None = None,
) -> Reconstruction:
    """Return the object's mesh in metres and its pose.

    Args:
        evidence: of the masked depth image.
        generated: mesh with a guess of pose and scale, where there is one.
        method: "robust": many starts, surface and outline together, every axis with a scale of its own; "paper":
            scale by the x extent, two alignments, Poisson surface; "primitive": cylinder, box or sphere; "completion":
            what is seen, closed by the back of such a shape. When empty: "robust" with a generated mesh; without, a
            primitive if it explains the image, else the completion.
        report: called with the name of a stage and the share of it that is done.

    Raises:
        ReconstructionError: the method is unknown or lacks the generated mesh, or nothing explains the image.
        ObjectMeshError: the generated mesh is none.
        MissingDependencyError: Open3D or manifold3d is not installed.
    """
    report = report or (lambda stage, share: None)
    method = method or ("robust" if generated is not None else "")
    if method not in ("", *METHODS):
        raise ReconstructionError(f"method '{method}': expected one of {', '.join(METHODS)}")
    if method in FROM_GENERATED and generated is None:
        raise ReconstructionError(f"method '{method}' needs a generated mesh; without one use primitive or completion")
    if method not in FROM_GENERATED:
        found = _reconstruct_alone(evidence, method, report)
    else:
        mesh, affine = prepare_generated(generated, evidence)
        report("mesh prepared", 1.0)
        found = (_fit_robustly if method == "robust" else _fit_as_paper)(mesh, affine, evidence, report)
    if (thinnest := measure_width(found.mesh)) > WIDEST:
        raise ReconstructionError(
            f"the object is {1e3 * thinnest:.0f} mm wide at its narrowest; expected at most {1e3 * WIDEST:.0f} mm, as "
            f"jaws can grasp: {DEPTH_UNITS}"
        )
    return found


def measure_width(mesh: ObjectMesh) -> float:
    """Return the least distance of two parallel planes that a mesh fits between, one of them on a facet [m]."""
    hull = ConvexHull(mesh.vertices)
    corners = mesh.vertices[hull.vertices]
    return float(min((-(corners @ plane[:3]) - plane[3]).max() for plane in hull.equations))


def _reconstruct_alone(evidence: ImageEvidence, method: str, report: Report) -> Reconstruction:
    """Reconstruct without a generated mesh: a primitive where that is asked for or good enough, else a completion."""
    shape = fit_primitive(evidence, report)
    if method == "completion" or (method == "" and shape.score.misfit > PRIMITIVE_MISFIT):
        return complete_surface(evidence, shape, report)
    check_agreement(shape.score)
    return shape


def prepare_generated(generated: GeneratedMesh, evidence: ImageEvidence) -> tuple[ObjectMesh, NDArray]:
    """Return the generated mesh about its middle and of the object's likely size, and its guessed map (4, 4).

    Raises:
        ObjectMeshError: it is no mesh.
    """
    vertices = np.asarray(generated.vertices, dtype=float)
    if vertices.ndim != 2 or vertices.shape[-1] != 3 or len(vertices) < 4 or not np.isfinite(vertices).all():
        raise ReconstructionError(f"generated mesh: vertices {vertices.shape}; expected finite ones, (n, 3), n > 3")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = max(float(np.linalg.norm(high - low)), 1e-12)
    factor = float(np.linalg.norm(np.ptp(evidence.points, axis=0))) / size
    mesh = prepare_object_mesh((vertices - 0.5 * (low + high)) * factor, generated.triangles, name=generated.name)
    affine = np.array(generated.affine, dtype=float)
    affine[:3, 3] += affine[:3, :3] @ (0.5 * (low + high))
    affine[:3, :3] /= factor
    return mesh, affine


def _fit_robustly(mesh: ObjectMesh, affine: NDArray, evidence: ImageEvidence, report: Report) -> Reconstruction:
    """Fit from many starts; a mesh that is closed already stays as it is."""
    fit = search_shape(mesh, turn_starts(_start_at(affine)), evidence, STRETCHABLE, report)
    check_agreement(fit.score)
    closed = close_mesh(bake_scale(mesh, fit.placement))
    report("closed", 1.0)
    return Reconstruction(
        mesh=closed,
        T_camera_object=fit.placement.pose,
        scale=_relative_scale(fit.placement.affine, affine),
        score=fit.score,
        method="robust",
    )


def _fit_as_paper(mesh: ObjectMesh, affine: NDArray, evidence: ImageEvidence, report: Report) -> Reconstruction:
    """Fit as the paper does, and take the Poisson surface."""
    aligned = align_as_paper(mesh, affine, evidence)
    report("aligned", 1.0)
    placement = _start_at(aligned)
    score = score_shape(MeshView(mesh), aligned, evidence)
    check_agreement(score)
    closed = build_poisson_mesh(bake_scale(mesh, placement))
    report("closed", 1.0)
    return Reconstruction(
        mesh=closed,
        T_camera_object=placement.pose,
        scale=_relative_scale(aligned, affine),
        score=score,
        method="paper",
    )


def bake_scale(mesh: ObjectMesh, placement: Placement) -> ObjectMesh:
    """Return the mesh with the placement's scale in its vertices."""
    return replace(mesh, vertices=mesh.vertices * np.exp(placement.log_scale))


def _start_at(affine: NDArray) -> Placement:
    """Return the placement of a map (4, 4) without shear."""
    scales = np.linalg.norm(affine[:3, :3], axis=0)
    left, _, right = np.linalg.svd(affine[:3, :3] / scales)
    return Placement(rotation=left @ right, translation=affine[:3, 3], log_scale=np.log(scales))


def _relative_scale(found: NDArray, given: NDArray) -> NDArray:
    """Return the factors (3,) between the column lengths of two maps (4, 4)."""
    return np.linalg.norm(found[:3, :3], axis=0) / np.linalg.norm(given[:3, :3], axis=0)
