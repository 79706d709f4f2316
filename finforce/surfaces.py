"""Triangles out of surface and CAD files, cells out of volume meshes.

Formats that can announce more than they hold are read in a sandbox.
"""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError, one_line
from finforce.files import FileError, read_bytes
from finforce.optional import import_library, import_trimesh
from finforce.sandbox import SandboxError, run_limited

LARGEST = 1 << 30  # bytes, more than any format needs for millions of triangles
# What these formats take goes with the size of the file.
_PLAIN = (".stl", ".obj", ".ply", ".off")
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])  # after 80 bytes and a number
_LIBRARIES = {".step": ("cascadio",), ".stp": ("cascadio",), ".3mf": ("networkx", "lxml")}
_MEMORY, _SECONDS = 2 << 30, 60


def read_surface(path: Path) -> tuple[NDArray, NDArray]:
    """Return the vertices (n, 3) and triangles (m, 3) of a file, in its own unit and frame, its parts put together.

    Raises:
        FileError: It cannot be read, or took too much memory or time; the message is a predicate.
        MissingDependencyError: The library that reads it is not installed.
    """
    suffix = path.suffix.lower()
    for library in _LIBRARIES.get(suffix, ()):
        import_library(library, f"reading {path.name}, which may be exported as STL instead,")
    try:
        if suffix in _PLAIN:
            return _load_triangles(path)
        return run_limited(_load_triangles, path, memory=_MEMORY, seconds=_SECONDS)
    except SandboxError as error:
        raise FileError(f"{error}; expected a whole {suffix} file: export it again") from error
    except FinforceError:
        raise
    except Exception as error:  # trimesh has no base error
        reason = f"{type(error).__name__}: {one_line(error, 120)}"
        raise FileError(f"cannot be read ({reason}); expected a whole {suffix} file: export it again") from error


Cells = list[tuple[str, NDArray]]


def read_cells(path: Path) -> tuple[NDArray, Cells]:
    """Return the points (n, 3) and the blocks of cells (kind, indices) of a volume mesh file that meshio reads.

    Raises:
        FileError: It cannot be read, or took too much memory or time; the message is a predicate.
    """
    state = path.stat()
    try:
        return _read_cells(path, state.st_size, state.st_mtime_ns)
    except SandboxError as error:
        raise FileError(f"{error}; expected a whole volume mesh: export it again") from error


@lru_cache(maxsize=2)
def _read_cells(path: Path, size: int, changed: int) -> tuple[NDArray, Cells]:
    """Read a file in a sandbox, once as long as it stays the same."""
    if size > LARGEST:
        raise FileError(f"has {size >> 20} MB, expected at most {LARGEST >> 20} of a volume mesh")
    return run_limited(_load_cells, path, memory=_MEMORY, seconds=_SECONDS)


def _load_cells(path: Path) -> tuple[NDArray, Cells]:
    """Return points and cells, the way meshio has them."""
    import meshio

    said = io.StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said):
            content = meshio.read(path)
    # meshio has no base error, and ends the process when it knows no way to read a file
    except (Exception, SystemExit) as error:
        reason = said.getvalue() if isinstance(error, SystemExit) else f"{type(error).__name__}: {error}"
        raise FileError(f"meshio cannot read it ({' '.join(reason.split())})") from error
    return content.points, [(block.type, block.data) for block in content.cells]


def _refuse_other_kinds(content: bytes) -> None:
    """Refuse by name what has the ending of a mesh and is none, or one of a version that is not read."""
    if content[:4] == b"glTF" and content[4:8] == b"\1\0\0\0":
        raise FileError("is glTF 1.0, expected 2.0: export it again, from Blender as one")
    header, end, _ = content.partition(b"end_header")
    if content[:3] == b"ply" and end and b"element vertex 0" not in header:
        if b"f_dc_0" in header:
            raise FileError(
                "holds Gaussian splats, no triangles: `finforce reconstruct --mesh` takes those of a binary PLY"
            )
        if b"element face" not in header and b"element tristrips" not in header:
            raise FileError("is a point cloud, expected triangles: reconstruct its surface, as MeshLab does")


def _load_triangles(path: Path) -> tuple[NDArray, NDArray]:
    """Return vertices and triangles; without the file's name, its content leads to no other file."""
    content, kind = read_bytes(path, LARGEST), path.suffix[1:].lower()
    if not content:
        raise FileError(f"got 0 bytes, expected a whole .{kind} file: export it again")
    _refuse_other_kinds(content)
    count = int.from_bytes(content[80:84], "little")
    if kind == "stl" and count and len(content) == 84 + count * _STL.itemsize:  # trimesh takes a second to load
        vertices = np.frombuffer(content, _STL, offset=84)["corners"].reshape(-1, 3).astype(float)
        triangles = np.arange(len(vertices)).reshape(-1, 3)
    else:
        scene = import_trimesh().load_scene(io.BytesIO(content), file_type=kind, process=False, skip_materials=True)
        mesh = scene.to_mesh()
        vertices, triangles = np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64)
    if len(triangles) and not np.ptp(vertices, axis=0).any():
        raise FileError("has all its points in one place, as where they are compressed in a way that is not read")
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3)
