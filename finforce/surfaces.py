"""Triangles out of surface and CAD files, cells out of volume meshes.

Formats that can announce more than they hold are read in a sandbox.
"""

from __future__ import annotations

import io
import re
import sys
import zipfile
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError, one_line
from finforce.files import FileError, read_bytes
from finforce.optional import import_library, import_trimesh
from finforce.sandbox import SandboxError, run_limited
from finforce.triangle_surface import Surface, join_surfaces

LARGEST = 1 << 30  # bytes, more than any format needs for millions of triangles
# What these formats take goes with the size of the file.
_PLAIN = (".stl", ".obj", ".ply", ".off")
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])  # after 80 bytes and a number
_MEMORY = 2 << 30  # [bytes]
_SECONDS = 60  # [s]
_DECIMAL_COMMA = re.compile(rb"^\s*(?:vertex|v)?\s*[-+]?\d+,\d+[eE\s]", re.MULTILINE)


def read_surface(path: Path) -> tuple[NDArray, NDArray]:
    """Return the vertices (n, 3) and triangles (m, 3) of a file, in its own unit and frame, its parts put together.

    Raises:
        FileError: It cannot be read, or took too much memory or time; the message is a predicate.
        MissingDependencyError: The library that reads it is not installed.
    """
    suffix = path.suffix.lower()
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
    if b"\0" not in content[:4096] and _DECIMAL_COMMA.search(content[:4096]):  # text as some languages write numbers
        content = content.replace(b",", b".")
    count = int.from_bytes(content[80:84], "little")
    if kind == "stl" and count and len(content) == 84 + count * _STL.itemsize:  # trimesh takes a second to load
        vertices = np.frombuffer(content, _STL, offset=84)["corners"].reshape(-1, 3).astype(float)
        triangles = np.arange(len(vertices)).reshape(-1, 3)
    elif kind == "3mf":
        vertices, triangles = _read_3mf(content)
    elif kind in ("step", "stp"):
        vertices, triangles = _read_step(content)
    else:
        content = _count_forward(content) if kind == "obj" else content
        scene = import_trimesh().load_scene(io.BytesIO(content), file_type=kind, process=False, skip_materials=True)
        mesh = scene.to_mesh()
        vertices, triangles = np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64)
    _check_numbers(triangles, len(vertices))
    if len(triangles) and not np.ptp(vertices, axis=0).any():
        raise FileError("has all its points in one place, as where they are compressed in a way that is not read")
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3)


def _count_forward(content: bytes) -> bytes:
    """Return an OBJ file whose faces name vertices by number alone, not by how far back they are from their line.

    trimesh counts back from the end of the file.
    """
    if not re.search(rb"^\s*f\s.*-", content, re.MULTILINE):
        return content
    lines, count = re.sub(rb"\\\r?\n", b" ", content).splitlines(), 0
    for place, line in enumerate(lines):
        kind, *words = line.split(b"#")[0].split() or [b""]
        count += kind == b"v"
        if kind == b"f":
            corners = [int(word.partition(b"/")[0]) for word in words]
            lines[place] = b"f " + b" ".join(b"%d" % (each if each > 0 else count + 1 + each) for each in corners)
    return b"\n".join(lines) + b"\n"


def _check_numbers(triangles: NDArray, count: int) -> None:
    """Refuse triangles (m, 3) that name none of so many vertices."""
    if ((triangles < 0) | (triangles >= count)).any():
        raise FileError(f"has triangles that name no vertex, expected numbers from 0 to {count - 1}: export it again")


def _read_step(content: bytes) -> tuple[NDArray, NDArray]:
    """Return the vertices [m] and triangles of a STEP file, which come by way of an OBJ file in millimetres."""
    sys.modules.setdefault("trimesh", None)  # which cascadio would load for a second; this process ends with its file
    cascadio = import_library("cascadio", "reading STEP files, which may be exported as STL instead,")
    with TemporaryDirectory() as folder:
        step, obj = Path(folder) / "whole.step", Path(folder) / "whole.obj"
        step.write_bytes(content)
        cascadio.step_to_obj(str(step), str(obj), use_colors=False)
        rows = [line.split() for line in obj.read_text().splitlines()]
    vertices = [row[1:4] for row in rows if row[:1] == ["v"]]
    triangles = [[corner.partition("/")[0] for corner in row[1:4]] for row in rows if row[:1] == ["f"]]
    return 1e-3 * np.array(vertices, float), np.array(triangles, int) - 1


def _read_3mf(content: bytes) -> tuple[NDArray, NDArray]:
    """Return vertices and triangles of what a 3MF file, zipped XML, builds."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        files = [info for info in archive.infolist() if info.filename.lower().endswith(".model")]
        if (size := sum(info.file_size for info in files)) > LARGEST:
            raise FileError(f"unzips to {size >> 20} MB, expected at most {LARGEST >> 20}")
        texts = {f"/{info.filename}": archive.read(info) for info in files}
    if any(b"<!ENTITY" in text.replace(b"\0", b"") for text in texts.values()):  # in UTF-16, too
        raise FileError("declares entities, expected none in a 3MF file")
    models = {name: ElementTree.fromstring(text) for name, text in texts.items()}
    items = [(item, name) for name, model in models.items() for item in model.iterfind("{*}build/{*}item")]
    placed = [part for item, name in items for part in _place_part(item, name, np.eye(4, 3), models)]
    if not placed:
        raise FileError("builds no object, expected one of triangles")
    whole = join_surfaces(placed)
    return whole.vertices, whole.triangles


def _place_part(reference: Element, name: str, T: NDArray, models: dict[str, Element]) -> Iterator[Surface]:
    """Yield the surfaces of the object that an item or a component refers to, and of what that consists of.

    Args:
        reference: in the model of a name, unless it states another one.
        name: of that model.
        T: (4, 3), where the whole is placed: rows (x, y, z, 1) times T.
        models: by their names.
    """
    name = next((value for key, value in reference.items() if key.endswith("}path")), name)
    within = np.array(reference.get("transform", "1 0 0 0 1 0 0 0 1 0 0 0").split(), float).reshape(4, 3)
    T = within @ T[:3] + np.outer([0.0, 0.0, 0.0, 1.0], T[3])
    part = models[name].find(f"{{*}}resources/{{*}}object[@id='{reference.get('objectid')}']")
    for mesh in part.iterfind("{*}mesh"):
        corners = [[one.get(axis) for axis in "xyz"] for one in mesh.iterfind("{*}vertices/{*}vertex")]
        numbers = [[one.get(f"v{k}") for k in (1, 2, 3)] for one in mesh.iterfind("{*}triangles/{*}triangle")]
        triangles = np.array(numbers, int).reshape(-1, 3)
        _check_numbers(triangles, len(corners))
        yield Surface(vertices=np.array(corners, float).reshape(-1, 3) @ T[:3] + T[3], triangles=triangles)
    for component in part.iterfind("{*}components/{*}component"):
        yield from _place_part(component, name, T, models)
