"""Volume meshes from files, checked."""

from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, StrictInt, model_validator

from finforce.files import FileError
from finforce.surfaces import read_cells
from finforce.typed_yaml import FileModel, Length, Number, Point, Text
from finforce_ifea.errors import MeshError
from finforce_ifea.jaw.mesh import EDGES_TET10, VolumeMesh, build_volume_mesh, check_connection

_VOLUME_CELLS = ("tetra", "tetra10", "hexahedron")
# Cells of fewer dimensions that mesh generators write next to the volume.
_OTHER_CELLS = ("vertex", "line", "line3", "triangle", "triangle6", "quad", "quad8", "quad9")


class ClampRule(FileModel):
    """The clamped nodes of a mesh, by one rule of three."""

    z_below: Length | None = Field(None, description="All up to this height [m]")
    box: Annotated[list[Point], Field(min_length=2, max_length=2), AfterValidator(np.array)] | None = Field(
        None, description="All between two corners [[x, y, z], [x, y, z]], the lowest first [m]"
    )
    nodes: Annotated[tuple[StrictInt, ...], Field(min_length=1)] | None = Field(None, description="Indices from 0")

    @model_validator(mode="after")
    def _check(self) -> "ClampRule":
        self.expect_one_of("z_below", "box", "nodes")
        if self.box is not None and (self.box[0] > self.box[1]).any():
            raise ValueError("box: got the highest corner first, expected the lowest corner first")
        return self

    def select(self, nodes: NDArray) -> NDArray:
        """Return the indices (c,) of the clamped ones among nodes (n, 3) [m]."""
        if self.z_below is not None:
            return np.flatnonzero(nodes[:, 2] <= self.z_below)
        if self.box is not None:
            low, high = self.box
            return np.flatnonzero(((nodes >= low) & (nodes <= high)).all(axis=1))
        return np.unique(np.asarray(self.nodes, dtype=np.int64))


class MeshFile(FileModel):
    """A volume mesh file and how to read it."""

    file: Text = Field(description="Its path, relative to the folder of the jaw file")
    scale: Number = Field(1.0, gt=0.0, description="Factor on its coordinates [-]; 0.001 for millimetres")
    clamped: ClampRule = Field(description="Which of its nodes are clamped")


def read_volume_mesh(path: Path | str, *, scale: float = 1.0, clamp: ClampRule) -> VolumeMesh:
    """Read a volume mesh of one kind of element.

    Args:
        path: any file that meshio reads (.msh, .vtk, .vtu, .inp, ...), in the jaw frame.
        scale: [-], multiplies the coordinates; 0.001 for millimetres.
        clamp: rule for the clamped nodes, in metres after scaling.

    Returns:
        The checked mesh.

    Raises:
        MeshError: The file is missing, cannot be read, has no volume elements, several or unsupported kinds
            of them, its mesh does not pass `build_volume_mesh`, or is not one piece.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"there is no mesh file {path}; the path is relative to the jaw file")
    try:
        points, cells = read_cells(path)
    except FileError as error:
        raise MeshError(f"{path.name}: {error}") from error
    kind, elements = _merge_cells(cells, path)
    nodes = np.asarray(points, dtype=float) * scale
    if nodes.ndim != 2 or nodes.shape[1] != 3:
        raise MeshError(f"{path.name}: the points have shape {nodes.shape}, expected (n, 3)")
    if kind == "tetra10":
        elements = _order_middles(nodes, elements)
    try:
        mesh = build_volume_mesh(nodes=nodes, elements=elements, clamped=clamp.select(nodes))
        check_connection(mesh)
    except MeshError as error:
        raise MeshError(f"{path.name}: {error}") from error
    return mesh


def _merge_cells(cells: list[tuple[str, NDArray]], path: Path) -> tuple[str, NDArray]:
    """Join the volume cells of a file, which must be of one supported kind."""
    kinds = sorted({kind for kind, _ in cells if kind not in _OTHER_CELLS})
    supported = ", ".join(_VOLUME_CELLS)
    if not kinds:
        found = ", ".join(sorted({kind for kind, _ in cells})) or "no cells"
        raise MeshError(f"{path.name}: got {found}, expected volume elements: one of {supported}")
    unsupported = [kind for kind in kinds if kind not in _VOLUME_CELLS]
    if unsupported:
        raise MeshError(f"{path.name}: got {', '.join(unsupported)}, expected only one of {supported}")
    if len(kinds) > 1:
        raise MeshError(f"{path.name}: got a mixture of {', '.join(kinds)}, expected one kind of volume element")
    return kinds[0], np.concatenate([np.asarray(block) for kind, block in cells if kind == kinds[0]])


def _order_middles(nodes: NDArray, elements: NDArray) -> NDArray:
    """Bring 10-node tetrahedra into the VTK order, should the file keep gmsh's: the last two swapped."""
    swapped = elements[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]
    middles = nodes[elements[:, EDGES_TET10]].mean(axis=2)
    errors = [np.linalg.norm(nodes[table[:, 4:]] - middles, axis=2).sum() for table in (elements, swapped)]
    return elements if errors[0] <= errors[1] else swapped
