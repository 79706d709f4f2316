"""Volume meshes from files."""

import numpy as np
import pytest
from mechanics_fakes import compute_volume

from finforce_ifea.errors import MeshError
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.jaw.mesh import to_tet4, to_tet10
from finforce_ifea.jaw.mesh_file import ClampRule, read_volume_mesh

meshio = pytest.importorskip("meshio")

MESH = load_jaw("bench").build_mesh("coarse")
BASE = ClampRule(z_below=1e-6)
KINDS = {"hexahedron": MESH, "tetra": to_tet4(MESH), "tetra10": to_tet10(MESH)}


def write(path, nodes, cells, **options):
    meshio.write(path, meshio.Mesh(nodes, cells), **options)
    return path


@pytest.mark.parametrize(
    ("suffix", "file_format"),
    [(".vtk", "vtk"), (".vtu", "vtu"), (".msh", "gmsh"), (".msh", "gmsh22"), (".inp", "abaqus")],
)
@pytest.mark.parametrize("kind", KINDS)
def test_mesh_survives_the_way_through_a_file(tmp_path, kind, suffix, file_format):
    mesh = KINDS[kind]
    # beside the volume, generators write the boundary; meshio writes only one block in this format
    blocks = [("triangle", mesh.surface[:5]), (kind, mesh.elements[:40]), (kind, mesh.elements[40:])]
    cells = [(kind, mesh.elements)] if file_format == "gmsh" else blocks
    path = write(tmp_path / f"finger{suffix}", mesh.nodes, cells, file_format=file_format)
    read = read_volume_mesh(path, clamp=BASE)
    np.testing.assert_array_equal(read.elements, mesh.elements)
    np.testing.assert_allclose(read.nodes, mesh.nodes, atol=1e-12)
    np.testing.assert_array_equal(read.clamped, mesh.clamped)
    assert compute_volume(read) == pytest.approx(compute_volume(mesh))


def test_middle_nodes_in_the_order_of_gmsh_are_reordered(tmp_path):
    mesh = KINDS["tetra10"]
    swapped = mesh.elements[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]
    path = write(tmp_path / "finger.vtu", mesh.nodes, [("tetra10", swapped)])
    np.testing.assert_array_equal(read_volume_mesh(path, clamp=BASE).elements, mesh.elements)


def test_scale_turns_millimetres_into_metres(tmp_path):
    path = write(tmp_path / "finger.vtu", 1e3 * MESH.nodes, [("hexahedron", MESH.elements)])
    np.testing.assert_allclose(read_volume_mesh(path, scale=1e-3, clamp=BASE).nodes, MESH.nodes, atol=1e-12)
    with pytest.raises(MeshError, match="finger.vtu: the mesh is 80 m long.*millimetres; give scale: 0.001"):
        read_volume_mesh(path, clamp=BASE)


@pytest.mark.parametrize(
    "rule",
    [
        ClampRule(z_below=5e-4),
        ClampRule(box=[[-0.02, -0.02, -1e-6], [0.02, 0.02, 1e-6]]),
        ClampRule(nodes=tuple(MESH.clamped[::-1].tolist())),
    ],
)
def test_every_clamp_rule_finds_the_base(rule):
    np.testing.assert_array_equal(rule.select(MESH.nodes), MESH.clamped)


@pytest.mark.parametrize("rules", [{}, {"z_below": 0.0, "nodes": (1, 2, 3)}])
def test_a_clamp_rule_is_one_rule(rules):
    with pytest.raises(ValueError, match="exactly one of z_below, box, nodes"):
        ClampRule(**rules)


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ([("hexahedron", MESH.elements), ("tetra", KINDS["tetra"].elements)], "a mixture of hexahedron, tetra"),
        ([("wedge", MESH.elements[:, :6])], "got wedge, expected only one of tetra, tetra10, hexahedron"),
        ([("triangle", MESH.surface)], "got triangle, expected volume elements"),
        ([("tetra", KINDS["tetra"].elements[:, [0, 2, 1, 3]])], "1116 of 1116 elements are inverted"),
        ([("tetra", KINDS["tetra"].elements[:100])], "belong to no element"),
    ],
)
def test_unsuitable_cells_are_refused_by_name(tmp_path, cells, words):
    path = write(tmp_path / "finger.vtu", MESH.nodes, cells)
    with pytest.raises(MeshError, match="finger.vtu: .*" + words):
        read_volume_mesh(path, clamp=BASE)


@pytest.mark.parametrize("content", [b"", b"not a mesh", b"\x00\xff" * 50, b"$MeshFormat\n4.1 0 8\n"])
@pytest.mark.parametrize("suffix", [".msh", ".vtk", ".vtu", ".unknown"])
def test_unreadable_files_are_refused_by_name(tmp_path, content, suffix):
    path = tmp_path / f"finger{suffix}"
    path.write_bytes(content)
    with pytest.raises(MeshError, match=f"finger{suffix}: "):
        read_volume_mesh(path, clamp=BASE)


def test_truncated_file_is_refused(tmp_path):
    path = write(tmp_path / "finger.vtk", MESH.nodes, [("hexahedron", MESH.elements)], binary=True)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(MeshError, match="finger.vtk: "):
        read_volume_mesh(path, clamp=BASE)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(MeshError, match="there is no mesh file .*absent.msh"):
        read_volume_mesh(tmp_path / "absent.msh", clamp=BASE)
