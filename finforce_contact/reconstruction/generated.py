"""Meshes from a generator: reading, closing, and the paper's alignment to a depth image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from finforce.camera import compute_rays
from finforce.errors import PoseError
from finforce.optional import import_open3d
from finforce.surfaces import LARGEST
from finforce_contact.errors import ObjectMeshError, ReconstructionError
from finforce_contact.mesh.object_mesh import ObjectMesh, prepare_object_mesh, read_triangles
from finforce_contact.mesh.views import MeshView, sample_surface
from finforce_contact.reconstruction.evidence import ImageEvidence

PLACE, OPACITY = ("x", "y", "z"), "opacity"
HEADER_BOUND = 65536  # bytes
FAINT = 0.1  # opacity below which a splat is none
MOST = 30000  # splats that a surface is made of, at most
FEWEST = 100  # and at least
NEIGHBOURS = 24
STRAY = 3.0  # times the usual distance to its neighbours: a splat that far away is none


def read_generated(path: Path | str) -> tuple[NDArray, NDArray]:
    """Return vertices (n, 3) and triangles (m, 3) of a generator's file, in its own unit and frame.

    A PLY file without triangles holds Gaussian splats: its surface is the Poisson surface of their centres.

    Raises:
        ObjectMeshError: the file is missing or damaged, or holds neither.
        MissingDependencyError: trimesh or, for splats, Open3D is not installed.
    """
    path = Path(path)
    splats = read_splats(path) if path.suffix.lower() == ".ply" and path.is_file() else None
    if splats is not None:
        return build_splat_surface(splats, path.name)
    vertices, triangles = read_triangles(path)
    if len(triangles) == 0:
        raise ObjectMeshError(f"{path}: no triangles; expected a mesh, or splats with {OPACITY} in a binary PLY file")
    return vertices, triangles


def read_splats(path: Path) -> NDArray | None:
    """Return the centres (n, 3) of the splats of a binary PLY file that can be seen; None of a file with triangles.

    Raises:
        ObjectMeshError: the file is too large, or shorter than its header says.
    """
    if path.stat().st_size > LARGEST:
        raise ObjectMeshError(f"{path.name}: got {path.stat().st_size} bytes, expected {LARGEST} at most")
    with path.open("rb") as file:
        head, end, _ = file.read(HEADER_BOUND).partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    elements = [line for line in lines if line[:1] == ["element"]]
    names = [line[2] for line in lines if line[:2] == ["property", "float"] and len(line) == 3]
    is_plain = len(names) == sum(line[:1] == ["property"] for line in lines)
    if not end or len(elements) != 1 or not is_plain or not {*PLACE, OPACITY} <= set(names):
        return None
    count = int(elements[0][2]) if elements[0][2:] and elements[0][2].isdigit() else -1
    body = path.read_bytes()[len(head) + len(end) :]
    if ["format", "binary_little_endian", "1.0"] not in lines or not 0 <= count * 4 * len(names) <= len(body):
        raise ObjectMeshError(
            f"{path.name}: got {len(body)} bytes for {count} splats of {len(names)} numbers, expected as many as the "
            "header says, binary_little_endian; export it again"
        )
    rows = np.frombuffer(body, "<f4", count * len(names)).reshape(count, len(names)).astype(float)
    places = rows[:, [names.index(name) for name in PLACE]]
    seen = np.isfinite(places).all(axis=1) & (rows[:, names.index(OPACITY)] > np.log(FAINT / (1.0 - FAINT)))
    return places[seen]


def build_splat_surface(places: NDArray, name: str) -> tuple[NDArray, NDArray]:
    """Return vertices (n, 3) and triangles (m, 3) of the surface on which splats (k, 3) lie.

    Raises:
        ObjectMeshError: there are too few of them.
        MissingDependencyError: Open3D is not installed.
    """
    if len(places) < FEWEST:
        raise ObjectMeshError(f"{name}: got {len(places)} splats that can be seen, expected at least {FEWEST}")
    open3d = import_open3d()
    chosen = np.random.default_rng(0).permutation(len(places))[:MOST]
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(places[chosen]))
    cloud, _ = cloud.remove_statistical_outlier(NEIGHBOURS, STRAY)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    cloud.orient_normals_consistent_tangent_plane(NEIGHBOURS)
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    # the farthest point along any direction faces outwards
    outer = int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))
    if normals[outer] @ (points[outer] - points.mean(axis=0)) < 0.0:
        normals = -normals
    return solve_poisson(points, normals, POISSON_SCALES[0])


POISSON_POINTS = 60000
POISSON_DEPTH = 7  # 128 cells along the largest extent: 0.9 mm for an object of 100 mm
POISSON_SCALES = (1.1, 1.3, 1.6)  # where a hole is large, its cover swells and needs room to close


def close_mesh(mesh: ObjectMesh) -> ObjectMesh:
    """Return a watertight mesh: the given one where it is that already, else its Poisson surface.

    The Poisson surface rounds edges and fills what is thinner than its cells; a closed mesh is the better one as it is.
    """
    return mesh if mesh.watertight else build_poisson_mesh(mesh)


def build_poisson_mesh(mesh: ObjectMesh) -> ObjectMesh:
    """Return the Poisson surface (Kazhdan and Hoppe 2013) of points drawn evenly on a mesh in metres.

    Raises:
        ReconstructionError: it does not close, because too much of the mesh is missing.
        ObjectMeshError: it has no body.
        MissingDependencyError: Open3D is not installed.
    """
    points = sample_surface(mesh, POISSON_POINTS, np.random.default_rng(0)).points
    normals = MeshView(mesh).closest(points, np.eye(4)).normals
    for scale in POISSON_SCALES:
        vertices, triangles = solve_poisson(points, normals, scale)
        closed = prepare_object_mesh(vertices, triangles, name=mesh.name)
        if closed.watertight:
            return replace(closed, notes=(*mesh.notes, "Closed by a Poisson surface.", *closed.notes))
    raise ReconstructionError(
        f"{mesh.name}: its surface is too open to be closed; fill its holes in a mesh editor, or leave it out"
    )


def solve_poisson(points: NDArray, normals: NDArray, scale: float) -> tuple[NDArray, NDArray]:
    """Return vertices (n, 3) and triangles (m, 3) of the Poisson surface of points (k, 3) with outward normals.

    Of several pieces the largest is kept: the others are specks between walls that are nearly touching.

    Args:
        points: of the surface.
        normals: there.
        scale: side of the cube that is solved in, over the largest extent of the points.
    """
    open3d = import_open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    solve = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson
    surface, _ = solve(cloud, depth=POISSON_DEPTH, scale=scale, n_threads=1)
    pieces, sizes, _ = surface.cluster_connected_triangles()
    return np.asarray(surface.vertices), np.asarray(surface.triangles)[np.asarray(pieces) == np.argmax(sizes)]


REACH = 0.02  # [m] of correspondences; the paper names none
ITERATIONS = 100


def scale_coarsely(mesh: ObjectMesh, affine: NDArray, cloud: NDArray) -> NDArray:
    """Return the map (4, 4) with the mesh scaled, about its own middle, to the x extent of the cloud.

    Args:
        mesh: generated.
        affine: (4, 4) the generator's map into the camera frame.
        cloud: (n, 3) measured points of the object, camera frame [m].
    """
    placed = mesh.vertices @ affine[:3, :3].T + affine[:3, 3]
    factor = np.ptp(cloud[:, 0]) / np.ptp(placed[:, 0])
    middle = 0.5 * (placed.min(axis=0) + placed.max(axis=0))
    scaling = np.diag([factor, factor, factor, 1.0])
    scaling[:3, 3] = middle - factor * middle
    return scaling @ affine


def align_as_paper(mesh: ObjectMesh, affine: NDArray, evidence: ImageEvidence) -> NDArray:
    """Return the map (4, 4) after the coarse scale and two point-to-point alignments, the second with scale.

    The visible part of the mesh is what the camera's pixel grid shows of it; it is looked at anew before each.

    Raises:
        ReconstructionError: the mesh is out of the camera's sight.
    """
    wanted = evidence.mask & np.isfinite(evidence.depth)
    cloud = compute_rays(evidence.camera)[wanted] * evidence.depth[wanted, None]
    affine = scale_coarsely(mesh, affine, cloud)
    for with_scale in (False, True):
        visible = MeshView(mesh).render(affine, evidence.camera).points
        if len(visible) < 10:
            raise ReconstructionError(
                "the generated mesh lies out of the camera's sight after the coarse scale; "
                "is its pose meant for this camera? The method 'robust' needs no good pose"
            )
        affine = _register(visible, cloud, with_scale) @ affine
    return affine


def _register(source: NDArray, target: NDArray, with_scale: bool) -> NDArray:
    """Return the map (4, 4) of source points (n, 3) onto target points (m, 3), by iterated closest points."""
    open3d = import_open3d()
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (source, target)]
    registration = open3d.pipelines.registration
    result = registration.registration_icp(
        *clouds,
        REACH,
        np.eye(4),
        registration.TransformationEstimationPointToPoint(with_scale),
        registration.ICPConvergenceCriteria(max_iteration=ITERATIONS),
    )
    return np.array(result.transformation)


# p_canonical = C p_glb, (x, y, z) of the GLB being (x, z, -y) of the canonical frame
CANONICAL_FROM_GLB = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
CAMERA_FROM_PYTORCH3D = np.diag([-1.0, -1.0, 1.0])
MESH_AXES = ("glb", "canonical")
NORM_TOLERANCE = 1e-2  # of a quaternion that a network gave


def affine_from_generator(
    rotation: ArrayLike, translation: ArrayLike, scale: ArrayLike, mesh_axes: str = "glb"
) -> NDArray:
    """Return the map (4, 4) of a generated mesh into the camera frame.

    p_cv = D (s R(q)^T C p_glb + t) with D = diag(-1, -1, 1); C falls away for canonical points.

    Args:
        rotation: quaternion w, x, y, z, of shape (4,) or (1, 4).
        translation: (3,) or (1, 3) [m].
        scale: one number, or (3,) or (1, 3) along the canonical axes.
        mesh_axes: "glb" for the vertices of a GLB file, "canonical" for those of a PLY.

    Raises:
        PoseError: a shape is wrong, a number is not finite, the quaternion is not of unit length, or a scale is not
            positive.
    """
    quaternion, t, s = (np.asarray(value, dtype=float).ravel() for value in (rotation, translation, scale))
    if mesh_axes not in MESH_AXES:
        raise PoseError(f"axes of the generated mesh '{mesh_axes}': expected one of {', '.join(MESH_AXES)}")
    if quaternion.shape != (4,) or t.shape != (3,) or s.shape not in ((1,), (3,)):
        raise PoseError(
            f"pose of the generated mesh: {quaternion.size}, {t.size} and {s.size} numbers for rotation, translation "
            "and scale; expected 4 (w x y z), 3, and 1 or 3"
        )
    if not (np.isfinite(quaternion).all() and np.isfinite(t).all() and np.isfinite(s).all()):
        raise PoseError("pose of the generated mesh: NaN or infinite numbers")
    if abs(np.linalg.norm(quaternion) - 1.0) > NORM_TOLERANCE or s.min() <= 0.0:
        raise PoseError(
            f"pose of the generated mesh: quaternion of length {np.linalg.norm(quaternion):.4g}, scale {s.tolist()}; "
            "expected length 1 (w x y z) and positive scales"
        )
    A = np.eye(4)
    # rows times R in PyTorch3D are columns times its transpose here
    R = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix().T
    A[:3, :3] = CAMERA_FROM_PYTORCH3D @ R * s
    if mesh_axes == "glb":
        A[:3, :3] = A[:3, :3] @ CANONICAL_FROM_GLB
    A[:3, 3] = CAMERA_FROM_PYTORCH3D @ t
    return A
