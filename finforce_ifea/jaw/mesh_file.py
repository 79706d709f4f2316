"""Volume meshes from files, checked."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.files import FileError
from finforce.surfaces import read_cells
from finforce_ifea.errors import MeshError
from finforce_ifea.jaw.mesh import EDGES_TET10, VolumeMesh, build_volume_mesh, check_connection

_VOLUME_CELLS = ("tetra", "tetra10", "hexahedron")
# Cells of fewer dimensions that mesh generators write beside the volume.
_OTHER_CELLS = ("vertex", "line", "line3", "triangle", "triangle6", "quad", "quad8", "quad9")


@dataclass(frozen=True, kw_only=True)
class ClampRule:
    """Which nodes of a mesh are clamped; exactly one of the three is given.

    Attributes:
        z_below: [m], nodes up to this height.
        box: (2, 3) [m], lowest and highest corner of a box, jaw frame.
        nodes: explicit node indices, from 0.
    """

    z_below: float | None = None
    box: NDArray | None = None
    nodes: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        """Refuse none or several of the three.

        Raises:
            MeshError: Not exactly one rule is given.
        """
        given = [rule for rule in (self.z_below, self.box, self.nodes) if rule is not None]
        if len(given) != 1:
            raise MeshError(f"clamped: got {len(given)} rules, expected exactly one of z_below, box, nodes")

    def select(self, nodes: NDArray) -> NDArray:
        """Return the indices (c,) of the clamped ones among nodes (n, 3) [m]."""
        if self.z_below is not None:
            return np.flatnonzero(nodes[:, 2] <= self.z_below)
        if self.box is not None:
            low, high = self.box
            return np.flatnonzero(((nodes >= low) & (nodes <= high)).all(axis=1))
        return np.unique(np.asarray(self.nodes, dtype=np.int64))


def read_volume_mesh(path: Path | str, *, scale: float = 1.0, clamp: ClampRule) -> VolumeMesh:
    """Read a volume mesh of one kind of element.

    Args:
        path: any file that meshio reads (.msh, .vtk, .vtu, .inp, ...), in the jaw frame.
        scale: [-], multiplies the coordinates; 0.001 for millimetres.
        clamp: which nodes are clamped, in metres after scaling.

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
    parts = {"hexes": elements} if kind == "hexahedron" else {"tets": elements}
    try:
        mesh = build_volume_mesh(nodes=nodes, clamped=clamp.select(nodes), **parts)
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
