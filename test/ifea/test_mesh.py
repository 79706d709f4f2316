"""The mesh of a drawing, its checks, its surface and its tetrahedra."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_fakes import compute_volume, shoelace_area

from finforce_ifea.errors import JawFileError, MeshError
from finforce_ifea.jaw.drawing import PRESETS, MeshDensity, Rib, mesh_drawing
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.jaw.mesh import FACES_HEX, FACES_TET, build_volume_mesh, split_hexes, to_tet4, to_tet10

BENCH = load_jaw("bench").drawing
CUBE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], dtype=float)


def section_area(drawing):
    bands = (drawing.inner.thickness + drawing.outer.thickness) * drawing.length
    ribs = sum(shoelace_area(drawing.rib_edges(rib)[[0, 0, 1, 1], [0, 1, 1, 0]]) for rib in drawing.ribs)
    ends = np.array([drawing.tip_z, drawing.length])
    gaps = drawing.inner.back_x(ends) - drawing.outer.back_x(ends)
    return bands + ribs + gaps.mean() * (drawing.length - drawing.tip_z)


def tet_volumes(nodes, tets):
    a, b, c, d = np.moveaxis(nodes[tets[:, :4]], 1, 0)
    return np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a)) / 6


def faces_of(elements):
    table = FACES_HEX if elements.shape[1] == 8 else FACES_TET
    return np.sort(elements[:, table].reshape(-1, table.shape[1]), axis=1)


@st.composite
def drawings(draw):
    """Fingers with up to five ribs of any tilt that fits, some clamped above the base."""
    count = draw(st.integers(0, 5))
    room = 0.065 / max(count, 1)
    shares = st.floats(0.15, 0.75)
    ribs = tuple(
        Rib(
            inner_z=0.005 + room * (i + draw(shares)),
            outer_z=0.005 + room * (i + draw(shares)),
            thickness=draw(st.floats(0.05, 0.15)) * room,
        )
        for i in range(count)
    )
    clamped_z = draw(st.sampled_from([0.0, 0.002]))
    tip_z = draw(st.floats(0.0725, 0.078))
    try:
        return replace(BENCH, ribs=ribs, clamped_z=clamped_z, tip_z=tip_z)
    except JawFileError:  # a thick, steep rib that reaches below the clamp
        return draw(st.nothing())


@st.composite
def densities(draw):
    return MeshDensity(**{field.name: draw(st.integers(1, 3)) for field in fields(MeshDensity)})


def test_coarse_bench_mesh_has_the_522_vertices_of_the_paper():
    mesh = mesh_drawing(BENCH, "coarse")
    assert mesh.nodes.shape == (522, 3)
    assert len(mesh.clamped) == 12


@pytest.mark.parametrize("name", PRESETS)
def test_bench_mesh_fills_its_drawing(name):
    mesh = mesh_drawing(BENCH, name)
    assert compute_volume(mesh) == pytest.approx(section_area(BENCH) * BENCH.width, rel=1e-9)
    assert mesh.nodes.min(axis=0) == pytest.approx([-0.014, -0.010, 0.0])
    assert mesh.nodes.max(axis=0) == pytest.approx([0.014, 0.010, 0.080])


@settings(max_examples=60)
@given(drawing=drawings(), density=densities())
def test_any_drawing_meshes_without_inverted_elements_and_fills_its_outline(drawing, density):
    mesh = mesh_drawing(drawing, density)
    assert compute_volume(mesh) == pytest.approx(section_area(drawing) * drawing.width, rel=1e-8)
    assert (mesh.nodes[mesh.clamped, 2] <= drawing.clamped_z + 1e-9).all()
    assert mesh.nodes[mesh.clamped, 2].max() == pytest.approx(drawing.clamped_z)


@settings(max_examples=20)
@given(drawing=drawings(), density=densities())
def test_mesh_is_symmetric_about_the_middle_plane(drawing, density):
    nodes = mesh_drawing(drawing, density).nodes
    mirrored = nodes * [1.0, -1.0, 1.0]
    assert {tuple(node) for node in nodes.tolist()} == {tuple(node) for node in mirrored.tolist()}


@settings(max_examples=20)
@given(drawing=drawings(), density=densities())
def test_surface_is_closed_and_faces_outwards(drawing, density):
    for mesh in (mesh_drawing(drawing, density), mesh_drawing(drawing, density).mirrored()):
        edges = mesh.surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).tolist()
        # every directed edge is met by its opposite, which holds for closed surfaces only
        assert sorted(map(tuple, edges)) == sorted((b, a) for a, b in edges)
        assert compute_volume(mesh) > 0


@settings(max_examples=20)
@given(drawing=drawings(), density=densities())
def test_tetrahedra_conform_and_fill_the_hexahedra(drawing, density):
    mesh = mesh_drawing(drawing, density)
    tets = split_hexes(mesh.elements)
    volumes = tet_volumes(mesh.nodes, tets)
    assert (volumes > 0).all()
    assert volumes.sum() == pytest.approx(compute_volume(mesh), rel=1e-9)
    _, counts = np.unique(faces_of(tets), axis=0, return_counts=True)
    assert counts.max() <= 2
    assert (counts == 1).sum() == len(mesh.surface)


@given(order=st.permutations(range(8)))
def test_a_cube_splits_into_six_tetrahedra_whatever_its_node_numbers(order):
    numbers = np.array(order)
    nodes = np.empty((8, 3))
    nodes[numbers] = CUBE
    volumes = tet_volumes(nodes, split_hexes(numbers[None]))
    assert volumes.shape == (6,)
    assert (volumes > 1e-12).all()
    assert volumes.sum() == pytest.approx(1.0)


def test_ten_node_tetrahedra_keep_nodes_and_clamp_the_middles_of_the_base():
    mesh = mesh_drawing(BENCH, "coarse")
    fine = to_tet10(mesh)
    np.testing.assert_array_equal(fine.nodes[:522], mesh.nodes)
    assert fine.elements.shape == (6 * len(mesh.elements), 10)
    assert set(fine.clamped) == set(np.flatnonzero(fine.nodes[:, 2] == 0.0))
    assert compute_volume(fine) == pytest.approx(compute_volume(mesh))
    edges = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
    np.testing.assert_allclose(fine.nodes[fine.elements[:, 4:]], fine.nodes[fine.elements[:, edges]].mean(axis=2))


def test_ten_node_tetrahedra_reduce_to_the_linear_ones_they_came_from():
    linear = to_tet4(mesh_drawing(BENCH, "coarse"))
    back = to_tet4(to_tet10(linear))
    np.testing.assert_array_equal(back.elements, linear.elements)
    np.testing.assert_array_equal(back.clamped, linear.clamped)
    assert to_tet4(linear) is linear
    assert to_tet10(to_tet10(linear)).elements.shape[1] == 10


@pytest.mark.parametrize("convert", [lambda mesh: mesh, to_tet4, to_tet10])
def test_mirror_image_keeps_node_numbers_and_positive_jacobians(convert):
    mesh = convert(mesh_drawing(BENCH, "coarse"))
    mirror = mesh.mirrored()
    np.testing.assert_array_equal(mirror.nodes, mesh.nodes * [1.0, -1.0, 1.0])
    parts = {"elements": mirror.elements}
    rebuilt = build_volume_mesh(nodes=mirror.nodes, clamped=mirror.clamped, **parts)
    assert compute_volume(rebuilt) == pytest.approx(compute_volume(mesh))
    assert compute_volume(mirror) == pytest.approx(compute_volume(mesh))


def test_a_frame_drawing_has_a_skin():
    mesh = mesh_drawing(load_jaw("steel").drawing, "fine")
    assert compute_volume(mesh) == pytest.approx(2 * 0.0002 * 0.028 * 0.15016, rel=0.1)


def test_surface_tells_a_boundary_face_from_a_shared_one():
    two = np.vstack([CUBE, CUBE[4:] + [0, 0, 1]]) * 0.01
    hexes = np.array([[0, 1, 2, 3, 4, 5, 6, 7], [4, 5, 6, 7, 8, 9, 10, 11]])
    mesh = build_volume_mesh(nodes=two, elements=hexes, clamped=[0, 1, 2, 3])
    assert len(mesh.surface) == 2 * 10


def cube_parts(**changes):
    parts = {"nodes": 0.01 * CUBE, "elements": np.arange(8)[None], "clamped": [0, 1, 2, 3]}
    return parts | changes


BAD_NODES = 0.01 * CUBE
BAD_NODES[5, 1] = np.nan


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"elements": np.array([[4, 5, 6, 7, 0, 1, 2, 3]])}, r"1 of 1 elements are inverted.*element 0"),
        ({"elements": np.array([[0, 1, 2, 3, 4, 5, 6, 6]])}, "inverted|no element"),
        ({"clamped": []}, "no clamped nodes"),
        ({"clamped": [0, 1]}, "at least three"),
        ({"clamped": range(8)}, "all nodes are clamped"),
        ({"clamped": [0, 1, 99]}, r"expected 0\.\.7"),
        ({"clamped": [-1, 0, 1]}, r"expected 0\.\.7"),
        ({"nodes": BAD_NODES}, "1 of 8 nodes are NaN or infinite.*node 5"),
        ({"nodes": 80.0 * CUBE}, "looks like millimetres; give scale: 0.001"),
        ({"nodes": 1e-5 * CUBE}, "check its scale"),
        ({"nodes": np.vstack([0.01 * CUBE, [[0.02, 0, 0]]])}, "1 of 9 nodes belong to no element.*node 8"),
        ({"nodes": np.vstack([0.01 * CUBE, [[0, 0, 0]]])}, "1 pairs of duplicate nodes.*0 and 8"),
        ({"nodes": np.zeros((8, 2))}, r"got shape \(8, 2\)"),
        ({"elements": np.arange(1, 9)[None]}, r"out of 0\.\.7.*element 0"),
        ({"elements": np.empty((0, 8), int)}, r"got shape \(0, 8\)"),
        ({"elements": np.zeros((1, 6), int)}, r"got shape \(1, 6\)"),
    ],
)
def test_bad_mesh_is_refused_by_name(change, words):
    build_volume_mesh(**cube_parts())
    with pytest.raises(MeshError, match=words):
        build_volume_mesh(**cube_parts(**change))


def test_the_number_of_inverted_elements_is_told():
    mesh = mesh_drawing(BENCH, "coarse")
    hexes = mesh.elements.copy()
    hexes[[7, 30]] = hexes[[7, 30]][:, [4, 5, 6, 7, 0, 1, 2, 3]]
    with pytest.raises(MeshError, match=r"2 of 186 elements are inverted or flat \(first: element 7 "):
        build_volume_mesh(nodes=mesh.nodes, elements=hexes, clamped=mesh.clamped)


def test_a_middle_node_out_of_place_inverts_a_ten_node_tetrahedron():
    mesh = to_tet10(to_tet4(mesh_drawing(BENCH, "coarse")))
    nodes = mesh.nodes.copy()
    ends = nodes[mesh.elements[3, :2]]
    nodes[mesh.elements[3, 4]] = 0.1 * ends[0] + 0.9 * ends[1]
    with pytest.raises(MeshError, match="inverted"):
        build_volume_mesh(nodes=nodes, elements=mesh.elements, clamped=mesh.clamped)


@pytest.mark.parametrize("number", [0, -1, 2.0, True, "3"])
def test_density_takes_positive_whole_numbers_only(number):
    with pytest.raises(MeshError, match="between_ribs"):
        replace(PRESETS["coarse"], between_ribs=number)


def test_unknown_density_names_the_presets():
    with pytest.raises(MeshError, match="'finest', expected one of coarse, default, fine"):
        mesh_drawing(BENCH, "finest")
