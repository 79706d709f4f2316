"""Files of mesh generators: meshes, and the Gaussian splats that SAM 3D Objects writes beside its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_open3d
from finforce.surfaces import LARGEST
from finforce_contact.errors import ObjectMeshError
from finforce_contact.mesh.closing import POISSON_ROOMS, solve_poisson
from finforce_contact.mesh.object_mesh import read_triangles

PLACE, OPACITY = ("x", "y", "z"), "opacity"
HEADER_BOUND = 65536  # bytes
FAINT = 0.1  # opacity below which a splat is none
MOST, FEWEST = 30000, 100  # splats that a surface is made of
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
    return solve_poisson(points, normals, POISSON_ROOMS[0])
