"""Object meshes: what is read, what is refused and why, what is repaired, and what decimation costs."""

import sys
from dataclasses import replace

import contact_fakes as fakes
import numpy as np
import pytest
import trimesh

from finforce.errors import FinforceError, MissingDependencyError
from finforce_contact.errors import ObjectMeshError
from finforce_contact.mesh import object_mesh
from finforce_contact.mesh.object_mesh import (
    UNITS,
    load_object_mesh,
    prepare_object_mesh,
    read_triangles,
    to_manifold,
)

CYLINDER_VOLUME = np.pi * 0.03**2 * 0.08
# 256 facets leave out 1 - sin(t)/t of a circle, t = 2 pi / 256; STL adds single precision.
FACETS = 2e-4


def write(folder, name, mesh, factor=1.0):
    vertices, triangles = mesh
    path = folder / name
    trimesh.Trimesh(vertices * factor, triangles, process=False).export(path)
    return path


def volume(mesh):
    return mesh.volume


def says(mesh, text):
    return any(text in note for note in mesh.notes)


def test_corners_of_an_obj_file_count_back_from_their_own_line(tmp_path):
    parts, lines = [fakes.box_triangles((0.02, 0.03, 0.04)), fakes.cylinder_triangles()], ["vn 0 0 1"]
    for number, (vertices, triangles) in enumerate(parts):
        lines += [f"o part{number}", *("v {} {} {}".format(*vertex) for vertex in vertices)]
        lines += ["f " + " ".join(f"{corner - len(vertices)}//-1" for corner in row) for row in triangles]
    path = tmp_path / "parts.obj"
    path.write_text("\n".join(lines) + "\n")
    vertices, triangles = read_triangles(path)
    expected = [corners for points, rows in parts for corners in points[rows]]
    np.testing.assert_allclose(vertices[triangles], expected, atol=1e-9)


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "glb", "STL"])
def test_every_format_gives_the_same_object(tmp_path, ending):
    moved = fakes.cylinder_triangles()[0] + (0.01, 0.02, 0.03), fakes.cylinder_triangles()[1]
    mesh = load_object_mesh(write(tmp_path, f"cup.{ending}", moved))
    assert mesh.watertight
    assert mesh.name == f"cup.{ending}"
    assert volume(mesh) == pytest.approx(CYLINDER_VOLUME, rel=FACETS)
    assert mesh.vertices.mean(axis=0) == pytest.approx([0.01, 0.02, 0.03], abs=1e-6)
    assert mesh.triangles.dtype == np.int32


def test_parts_of_a_scene_are_placed_by_their_transforms(tmp_path):
    scene = trimesh.Scene()
    for x in (-0.05, 0.05):
        part = trimesh.Trimesh(*fakes.box_triangles((0.02, 0.02, 0.02)))
        scene.add_geometry(part, transform=trimesh.transformations.translation_matrix([x, 0.0, 0.0]))
    scene.export(tmp_path / "two.glb")
    mesh = load_object_mesh(tmp_path / "two.glb")
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([0.12, 0.02, 0.02], abs=1e-6)
    assert says(mesh, "2 separate surfaces")


@pytest.mark.parametrize("unit", ["mm", "cm", "inch"])
def test_wrong_unit_is_refused_with_the_likely_one_named(tmp_path, unit):
    path = write(tmp_path, "cup.stl", fakes.cylinder_triangles(), 1.0 / UNITS[unit])
    with pytest.raises(
        ObjectMeshError, match=rf'cup.stl: .*unit \'m\'.*likely in another unit: unit="{unit}" \(80 mm\).*--object-unit'
    ):
        load_object_mesh(path)
    assert volume(load_object_mesh(path, unit=unit)) == pytest.approx(CYLINDER_VOLUME, rel=FACETS)


def test_metres_taken_for_millimetres_are_refused(tmp_path):
    with pytest.raises(ObjectMeshError, match=r'likely in another unit: unit="m" \(80 mm\)'):
        load_object_mesh(write(tmp_path, "cup.stl", fakes.cylinder_triangles()), unit="mm")


@pytest.mark.parametrize(("factor", "fits"), [(0.9, False), (1.1, True)])
def test_smallest_and_largest_objects_lie_at_the_stated_bounds(factor, fits):
    for size in (object_mesh.SMALLEST * factor, object_mesh.LARGEST / factor):
        box = fakes.box_triangles((size, size / 2, size / 2))
        if fits:
            assert prepare_object_mesh(*box).watertight
        else:
            with pytest.raises(ObjectMeshError, match="expected 5 to 600 mm"):
                prepare_object_mesh(*box)


def test_size_that_no_unit_explains_is_refused():
    with pytest.raises(ObjectMeshError, match="no unit makes it so"):
        prepare_object_mesh(*fakes.box_triangles((5000.0, 1.0, 1.0)))


def test_vertices_of_no_triangle_do_not_count_as_size():
    vertices, triangles = fakes.box_triangles((0.05, 0.05, 0.05))
    mesh = prepare_object_mesh(np.vstack([vertices, [9.0, np.nan, 0.0]]), triangles)
    assert len(mesh.vertices) == 8


def test_unknown_unit_is_refused(tmp_path):
    with pytest.raises(ObjectMeshError, match="got unit 'ft', expected one of m, mm, cm, inch"):
        load_object_mesh(tmp_path / "cup.stl", unit="ft")


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("empty.stl", b"", "got 0 bytes"),
        ("noise.glb", b"\x00\x01 no mesh at all", "made its reader fail"),
        ("noise.ply", b"ply\nformat ascii 1.0\n", "cannot be read"),
        ("points.obj", b"v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\n", "no triangles|cannot be read"),
        ("cut.stl", b"\x00" * 80 + b"\x64\x00\x00\x00" + b"\x00" * 30, "no triangles"),
        ("cup.fbx", b"ISO-10303-21;", "expected one of .stl .obj .ply .off .glb"),
        ("nan.obj", b"v nan 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n", "NaN or infinite"),
    ],
)
def test_file_that_is_no_mesh_is_refused(tmp_path, name, content, problem):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ObjectMeshError, match=f"{name}.*({problem})"):
        load_object_mesh(tmp_path / name)


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(ObjectMeshError, match="give a path, not a URI"):
        load_object_mesh("package://my_robot/meshes/can.stl")
    for path in (tmp_path / "none.stl", tmp_path):
        with pytest.raises(ObjectMeshError, match="no such file"):
            load_object_mesh(path)


def test_name_that_no_file_can_have_is_refused():
    with pytest.raises(ObjectMeshError, match="no such file"):
        load_object_mesh("x" * 5000 + ".stl")


def test_raw_triangles_are_read_whatever_their_size(tmp_path):
    vertices, triangles = read_triangles(write(tmp_path, "raw.ply", fakes.box_triangles((3.0, 2.0, 1.0))))
    assert np.ptp(vertices, axis=0) == pytest.approx([3.0, 2.0, 1.0])
    assert triangles.shape == (12, 3)


BOX = fakes.box_triangles((0.05, 0.05, 0.05))


@pytest.mark.parametrize(
    ("vertices", "triangles", "problem"),
    [
        (BOX[0], BOX[1][:0], "no triangles"),
        (BOX[0][:, :2], BOX[1], r"expected \(n, 3\)"),
        (BOX[0][:5], BOX[1], "name no vertex"),
        (BOX[0], BOX[1] - 1, "name no vertex"),
        (BOX[0], BOX[1].astype(float), "name no vertex"),
        (np.where(BOX[0] > 0.0, np.inf, BOX[0]), BOX[1], "NaN or infinite"),
        (BOX[0], np.zeros((object_mesh.TRIANGLE_BOUND + 1, 3), dtype=int), "expected 2000000 at most"),
        (BOX[0] * (1.0, 0.0, 0.0), BOX[1], "of 0 mm.2 in all, expected a surface"),
        (BOX[0] * (1.0, 1.0, 0.0), BOX[1], "sheet"),
        (BOX[0], np.array([[0, 0, 1], [2, 2, 1]]), "expected a surface"),
        (BOX[0] + (1.2, 0.0, 0.0), BOX[1], "from the origin of their frame"),
    ],
)
def test_arrays_that_are_no_body_are_refused(vertices, triangles, problem):
    with pytest.raises(ObjectMeshError, match=f"thing: .*{problem}") as caught:
        prepare_object_mesh(vertices, triangles, name="thing")
    assert isinstance(caught.value, FinforceError)
    assert isinstance(caught.value, ValueError)


def test_sound_mesh_is_left_as_it_is():
    mesh = prepare_object_mesh(*BOX)
    assert mesh.notes == ()
    assert mesh.watertight
    assert volume(mesh) == pytest.approx(0.05**3)


def test_triangle_soup_is_welded():
    vertices, triangles = fakes.cylinder_triangles()
    mesh = prepare_object_mesh(vertices[triangles].reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    assert mesh.watertight
    assert len(mesh.vertices) == 2 * 256 + 2


def test_cracks_are_merged_and_wide_gaps_are_not():
    vertices, triangles = BOX
    soup = vertices[triangles].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    noise = np.random.default_rng(0).uniform(-1.0, 1.0, (36, 3))
    assert prepare_object_mesh(soup[0] + 2e-6 * noise, soup[1]).watertight
    noise[6:] = 0.0
    assert not prepare_object_mesh(soup[0] + 5e-4 * noise, soup[1]).watertight


def test_triangles_without_neighbours_are_refused():
    vertices, triangles = fakes.sphere_triangles(0.03)
    soup = vertices[triangles] + 3e-4 * np.random.default_rng(0).standard_normal((len(triangles), 3, 3))
    with pytest.raises(ObjectMeshError, match="no neighbour at 100 % of their edges"):
        prepare_object_mesh(soup.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    kept = np.random.default_rng(0).random(len(triangles)) < 0.7  # a scan full of holes is still an object
    assert len(prepare_object_mesh(vertices, triangles[kept]).triangles)


@pytest.mark.parametrize("limit", [100, 400])  # none is left of them, or hardly any
def test_crumbs_that_decimation_swallows_are_refused(limit):
    places = np.random.default_rng(0).uniform(-0.05, 0.05, (300, 1, 3))
    corners, triangles = fakes.box_triangles((1e-3, 1e-3, 1e-3))
    crumbs = (
        (corners + places).reshape(-1, 3),
        (triangles + len(corners) * np.arange(300)[:, None, None]).reshape(-1, 3),
    )
    with pytest.raises(ObjectMeshError, match="remove fragments"):
        prepare_object_mesh(*crumbs, triangle_limit=limit)


def test_inside_out_mesh_is_turned():
    mesh = prepare_object_mesh(*fakes.flip(*fakes.cylinder_triangles()))
    assert volume(mesh) == pytest.approx(CYLINDER_VOLUME, rel=FACETS)
    assert says(mesh, "inside-out")


def test_inside_out_open_mesh_is_turned():
    tube = prepare_object_mesh(*fakes.flip(*fakes.tube_triangles()))
    assert volume(tube) > 0.0


def test_only_the_inside_out_body_is_turned():
    left, right = (fakes.box_triangles((0.02, 0.02, 0.02), (x, 0.0, 0.0)) for x in (-0.05, 0.05))
    mesh = prepare_object_mesh(*fakes.join(left, fakes.flip(*right)))
    assert to_manifold(mesh).volume() == pytest.approx(2 * 0.02**3)


@pytest.mark.parametrize("turn", [lambda *mesh: mesh, fakes.flip])
def test_cavity_stays_a_cavity(turn):
    inner = fakes.box_triangles((0.03, 0.03, 0.03))
    mesh = prepare_object_mesh(*turn(*fakes.join(BOX, fakes.flip(*inner))))
    assert to_manifold(mesh).volume() == pytest.approx(0.05**3 - 0.03**3)


def test_mixed_senses_are_made_one():
    vertices, triangles = fakes.cylinder_triangles()
    mixed = triangles.copy()
    mixed[::3] = mixed[::3, ::-1]
    mesh = prepare_object_mesh(vertices, mixed)
    assert mesh.watertight
    assert volume(mesh) == pytest.approx(CYLINDER_VOLUME, rel=FACETS)


def test_fin_on_a_closed_surface_is_kept_and_noted():
    vertices, triangles = BOX
    mesh = prepare_object_mesh(
        np.vstack([vertices, [0.0, 0.0, 0.04]]), np.vstack([triangles, [[*triangles[0, :2], 8]]])
    )
    assert not mesh.watertight
    assert len(mesh.triangles) == 13
    assert says(mesh, "More than two triangles meet at an edge")


def test_moebius_strip_is_kept_and_noted():
    """Half a turn over the way round, so that the strip ends on its own back."""
    angle = 2.0 * np.pi * np.arange(40) / 40
    across = 0.01 * np.stack([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)])
    middle = 0.04 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    here, there = np.arange(39), np.arange(1, 40)
    quads = np.vstack([np.stack([here, there, there + 40, here + 40], 1), [[39, 40, 0, 79]]])
    strip = np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    assert says(prepare_object_mesh(np.hstack([middle - across, middle + across]).T, strip), "one side only")


def test_small_holes_are_filled_and_large_ones_kept():
    sphere = fakes.sphere_triangles(0.03)
    small = prepare_object_mesh(*fakes.pierce(*sphere, (0.03, 0.0, 0.0), 0.004))
    large = prepare_object_mesh(*fakes.pierce(*sphere, (0.03, 0.0, 0.0), 0.012))
    assert small.watertight
    assert says(small, "1 holes")
    # the cap of a hole of 4 mm radius holds pi a^2 h / 2 = 7 mm^3
    assert volume(small) == pytest.approx(4 / 3 * np.pi * 0.03**3, rel=3e-3)
    assert not large.watertight
    assert to_manifold(large) is None
    assert says(large, "not closed")


def test_repeated_and_collapsed_triangles_fall_away():
    vertices, triangles = BOX
    mesh = prepare_object_mesh(vertices, np.vstack([triangles, triangles[:2], [[0, 0, 1]]]))
    assert mesh.watertight
    assert len(mesh.triangles) == 12


def test_overlapping_bodies_are_united():
    shifted = fakes.box_triangles((0.05, 0.05, 0.05), (0.02, 0.0, 0.01))
    mesh = prepare_object_mesh(*fakes.join(BOX, shifted))
    assert volume(mesh) == pytest.approx(2 * 0.05**3 - 0.03 * 0.05 * 0.04)
    assert says(mesh, "united")


def test_overlapping_bodies_with_a_cavity_are_not_united_over_it():
    cavity = fakes.flip(*fakes.box_triangles((0.02, 0.02, 0.02), (-0.01, 0.0, 0.0)))
    shifted = fakes.box_triangles((0.05, 0.05, 0.05), (0.03, 0.0, 0.0))
    mesh = prepare_object_mesh(*fakes.join(BOX, cavity, shifted))
    assert volume(mesh) == pytest.approx(2 * 0.05**3 - 0.02**3)


def test_mesh_that_is_said_to_be_open_gives_no_solid():
    assert to_manifold(replace(prepare_object_mesh(*BOX), watertight=False)) is None


def test_decimated_sphere_stays_within_a_tenth_of_a_millimetre():
    fine = fakes.sphere_triangles(0.03, rings=200, facets=400)
    mesh = prepare_object_mesh(*fine, triangle_limit=5000)
    middles = mesh.vertices[mesh.triangles].mean(axis=1)
    assert len(mesh.triangles) <= 5000
    assert mesh.watertight
    assert np.abs(np.linalg.norm(np.vstack([mesh.vertices, middles]), axis=1) - 0.03).max() < 1e-4
    assert says(mesh, "Decimated from 159200 to ")


def test_deviation_that_decimation_costs_is_told():
    coarse = prepare_object_mesh(*fakes.sphere_triangles(0.03), triangle_limit=100)
    assert says(coarse, "more than contact should have: is this one object?")
    middles = coarse.vertices[coarse.triangles].mean(axis=1)
    told = float(coarse.notes[-1].split("deviates by ")[1].split(" mm")[0])
    assert told >= 1e3 * (0.03 - np.linalg.norm(middles, axis=1).min()) - 0.1


def test_open_mesh_is_decimated_too():
    mesh = prepare_object_mesh(
        *fakes.revolve([(0.03, z) for z in np.linspace(-0.04, 0.04, 60)], 128), triangle_limit=1000
    )
    assert len(mesh.triangles) <= 1000
    assert not mesh.watertight
    assert np.abs(np.linalg.norm(mesh.vertices[:, :2], axis=1) - 0.03).max() < 1e-4


def test_silly_triangle_limit_is_refused():
    with pytest.raises(ObjectMeshError, match="expected 100 at least"):
        prepare_object_mesh(*BOX, triangle_limit=3)


def test_missing_library_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "manifold3d", None)
    with pytest.raises(MissingDependencyError, match="pip install manifold3d"):
        prepare_object_mesh(*BOX)


AXES = "".join(f"property float {axis}\n" for axis in "xyz")
PLY = f"ply\nformat ascii 1.0\nelement vertex 1\n{AXES}{{}}end_header\n0 0 0\n"
OTHERS = {
    "old.glb": (b"glTF\1\0\0\0" + bytes(12), "glTF 1.0, expected 2.0"),
    "cloud.ply": (PLY.format("").encode(), "is a point cloud"),
    "splats.ply": (PLY.format("property float f_dc_0\n").encode(), "Gaussian splats, no triangles.*reconstruct --mesh"),
    "cup.dae": (b"<COLLADA/>", "got ending '.dae'"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_no_mesh_of_ours_is_called_by_its_name(tmp_path, name):
    content, words = OTHERS[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ObjectMeshError, match=words):
        load_object_mesh(tmp_path / name)


def test_a_glb_of_any_scale_is_not_said_to_be_in_inches(tmp_path):
    for name, expected in (("cup.glb", False), ("cup.stl", True)):
        path = write(tmp_path, name, fakes.cylinder_triangles(), factor=39.37)
        with pytest.raises(ObjectMeshError) as raised:
            load_object_mesh(path)
        assert ('unit="inch"' in str(raised.value)) == expected
        assert ("scale it to the object's size" in str(raised.value)) != expected


def test_what_was_not_seen_of_a_reconstructed_object_is_stated_beside_its_mesh(tmp_path):
    trimesh.creation.box((0.03, 0.04, 0.05)).export(tmp_path / "box.stl")
    assert load_object_mesh(tmp_path / "box.stl").unseen_stddev == 0.0
    stated = tmp_path / "box.pose.json"
    stated.write_text('{"unseen_stddev_m": 0.004}')
    assert load_object_mesh(tmp_path / "box.stl").unseen_stddev == 0.004
    stated.write_text("[[1, 0], [0, 1]]")  # another program's
    assert load_object_mesh(tmp_path / "box.stl").unseen_stddev == 0.0
    for wrong in ('{"unseen_stddev_m": -1}', '{"unseen_stddev_m": NaN}', '{"unseen_stddev_m": "x"}', "{"):
        stated.write_text(wrong)
        with pytest.raises(ObjectMeshError, match="box.pose.json"):
            load_object_mesh(tmp_path / "box.stl")
