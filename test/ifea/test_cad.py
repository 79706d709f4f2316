"""Claims about `finforce jaw`: from files of printed fingers to jaw files, and what is refused."""

import json
import re
import zipfile
from dataclasses import replace

import cv2
import numpy as np
import pytest
import shapely
import shapely.affinity
import trimesh
from mechanics_fakes import compute_volume
from PIL import Image
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation
from section_fakes import BASE, LENGTH, MILLIMETRE, TPU, WIDTH, draw_polygon, make_section

from finforce.triangle_surface import Surface
from finforce_eval.cli.main import main
from finforce_ifea.errors import JawFileError
from finforce_ifea.fem.plane import PlaneModel
from finforce_ifea.jaw.cad.cad_file import _GRID, _cut, read_section
from finforce_ifea.jaw.cad.make_jaw import _find_wall_error, choose_keypoints, make_jaw
from finforce_ifea.jaw.cad.photo import Photo, read_photo
from finforce_ifea.jaw.cad.recognition import Overrides, recognize
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.jaw.section import Layer, join_loops, order_rings
from finforce_ifea.jaw.section_mesh import extrude_section, mesh_section
from finforce_ifea.mechanics import measure_warping

RIBS, UP = 4, np.array([0.0, 0.0, 1.0])


def finger_surface(polygon=None, size=2e-3):
    """The closed surface of a finger, in millimetres."""
    mesh = extrude_section(make_section(polygon, size=size))
    return trimesh.Trimesh(mesh.nodes / MILLIMETRE, mesh.surface, process=True)


@pytest.fixture(scope="module")
def surface():
    return finger_surface()


def check_found(finger):
    assert finger.length == pytest.approx(LENGTH * MILLIMETRE, abs=2e-5)
    assert finger.width == pytest.approx(WIDTH * MILLIMETRE, abs=2e-5)
    assert len(finger.ribs) == RIBS and len(finger.bolts) == 2
    assert finger.face_deviation < 2e-5
    free = finger.inner.line[:, 1] > BASE * MILLIMETRE + 1e-3
    assert np.median(finger.inner.thickness[free]) == pytest.approx(1.6e-3, abs=3e-5)
    for rib in finger.ribs:
        assert rib.wall.usual == pytest.approx(1.2e-3, abs=3e-5)
        assert rib.outer[0] < rib.inner[0] and rib.outer[1] > rib.inner[1]
    # a base bolt's hole of 3 mm, 5 mm up, holds to three radii above its middle
    assert finger.clamped_z == pytest.approx((5.0 + 3 * 1.5) * MILLIMETRE, abs=3e-4)


@pytest.mark.parametrize(
    ("unit", "turn"), [("m", [0.0, 0.0, 0.0]), ("inch", [90.0, 0.0, 0.0]), ("mm", [17.0, -41.0, 133.0])]
)
def test_a_finger_is_found_in_any_unit_and_any_way_round(tmp_path, surface, unit, turn):
    mesh = surface.copy()
    mesh.apply_scale({"mm": 1.0, "m": 1e-3, "inch": 1.0 / 25.4}[unit])
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    mesh.apply_transform(frame)
    path = tmp_path / "finger.stl"
    mesh.export(path)
    if unit == "inch":  # of which centimetres make a finger, too
        with pytest.raises(JawFileError, match="--unit cm .* or --unit inch"):
            read_section(path)
    raw = read_section(path, unit="inch" if unit == "inch" else None)
    assert not raw.taper.any()
    assert f"unit: {unit}" in raw.notes[0]
    check_found(recognize(raw.polygon, raw.width, Overrides()))


def boxes_joined(surface, *boxes, cut=False):
    """A finger with boxes (extents, middle) [mm] added or cut away."""
    solids = [trimesh.creation.box(extents, trimesh.transformations.translation_matrix(at)) for extents, at in boxes]
    return (trimesh.boolean.difference if cut else trimesh.boolean.union)([surface, *solids], engine="manifold")


def write_3mf(path, mesh):
    """A 3MF file; trimesh would need networkx and lxml to write one."""
    corners = "".join('<vertex x="{}" y="{}" z="{}"/>'.format(*map(float, one)) for one in mesh.vertices)
    triangles = "".join('<triangle v1="{}" v2="{}" v3="{}"/>'.format(*one) for one in mesh.faces)
    mesh = f"<mesh><vertices>{corners}</vertices><triangles>{triangles}</triangles></mesh>"
    model = f"""<model xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">
        <resources><object id="1">{mesh}</object></resources><build><item objectid="1"/></build></model>"""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("3D/3dmodel.model", model)


def read_mesh(tmp_path, mesh, name="finger.stl", **options):
    if name.endswith(".3mf"):
        write_3mf(tmp_path / name, mesh)
    else:
        mesh.export(tmp_path / name)
    return read_section(tmp_path / name, **options)


@pytest.mark.parametrize("name", ["finger.3mf", "finger.obj", "finger.ply"])
def test_what_else_programs_export_is_the_same_finger(tmp_path, surface, name):
    check_found(recognize((raw := read_mesh(tmp_path, surface, name)).polygon, raw.width, Overrides()))


def test_a_crumb_beside_a_finger_is_left_out_and_a_void_in_it_stays(tmp_path, surface):
    crumb = trimesh.creation.box((0.8, WIDTH, 0.04), trimesh.transformations.translation_matrix((30.0, 0.0, 40.0)))
    void = trimesh.creation.box((2.0, 2.0, 2.0), trimesh.transformations.translation_matrix((0.0, 0.0, 9.0)))
    void.invert()
    raw = read_mesh(tmp_path, trimesh.util.concatenate([surface, crumb, void]))
    check_found(recognize(raw.polygon, raw.width, Overrides()))
    assert {"1 crumb of its surface left out", "1 closed voids inside"} < set(raw.notes)
    solid = read_mesh(tmp_path, trimesh.util.concatenate([surface, crumb, void]), layered=True)
    assert min(layer.area.area for layer in solid.layers) < raw.polygon.area - 3e-6
    crumb.apply_scale(5.0)
    with pytest.raises(JawFileError, match="holds 2 bodies"):
        read_mesh(tmp_path, trimesh.util.concatenate([surface, crumb]))


def test_a_floor_and_a_slot_are_named_with_their_place(tmp_path, surface):
    low, high = surface.bounds
    size, middle, side = high - low, 0.5 * (low + high), np.array([0.0, 0.5 * WIDTH, 0.0])
    floor = boxes_joined(surface, ((0.6 * size[0], 1.0, 0.6 * size[2]), middle - side + [0.0, 0.5, 0.0]))
    slot = boxes_joined(surface, ((3.0, 0.4 * WIDTH, 0.5 * size[2]), [high[0], middle[1], middle[2]]), cut=True)
    for mesh, word in ((floor, "a floor"), (slot, "a slot")):
        with pytest.raises(JawFileError, match=f"have another section.*{word}"):
            read_mesh(tmp_path, mesh)
    with pytest.raises(JawFileError, match="its usual section is drawn in"):
        make_jaw(tmp_path / "finger.stl", tmp_path / "out" / "jaw.yaml", Overrides(name="slotted"))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["jaw.png"]


def cut_fork(surface, top, share=0.6):
    low, high = surface.bounds
    slot = ((share * (high[0] - low[0]), 0.4 * WIDTH, 2.0 * top), [*0.5 * (low + high)[:2], low[2]])
    return boxes_joined(surface, slot, cut=True)


@pytest.mark.parametrize("top", [8.0, 11.5])  # below the clamp of 9.5 mm, and above it next to the first cell
def test_a_fork_in_the_base_is_held(tmp_path, surface, top):
    raw = read_mesh(tmp_path, cut_fork(surface, top))
    assert "its sections differ within the base, which the clamp has to hold" in raw.notes
    finger = recognize(raw.polygon, raw.width, Overrides(), base=raw.base, unlike=raw.unlike)
    assert finger.clamped_z == pytest.approx(max(top, 9.5) * MILLIMETRE, abs=3e-4)
    assert ("clamped up to z = 11.5 mm, as far as its sections differ" in finger.notes) == (top > 9.5)
    check_found(replace(finger, clamped_z=9.5e-3))


def test_a_fork_that_reaches_beside_cells_is_refused(tmp_path, surface):
    cut_fork(surface, 22.0).export(tmp_path / "finger.stl")
    with pytest.raises(JawFileError, match="is not prismatic along.*have another section.*section is drawn in"):
        make_jaw(tmp_path / "finger.stl", tmp_path / "jaw.yaml", Overrides(name="fork"))


def test_a_fork_across_half_of_the_base_leaves_its_whole_edge(tmp_path, surface):
    low, high = surface.bounds
    half = ((0.5 * (high[0] - low[0]), 0.6 * WIDTH, 16.0), [high[0], 0.5 * (low + high)[1], low[2]])
    raw = read_mesh(tmp_path, boxes_joined(surface, half, cut=True))
    assert raw.polygon.symmetric_difference(read_mesh(tmp_path, surface).polygon).area < 1e-6 * raw.polygon.area


def test_a_small_hole_across_is_left_out_beside_a_fork_and_a_small_floor_is_not(tmp_path, surface):
    low, high = surface.bounds
    drill = trimesh.creation.cylinder(0.5, 200.0)
    drill.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, [0, 1, 0]))
    drill.apply_translation([0.0, 0.0, low[2] + 0.75 * (high[2] - low[2])])
    drilled = trimesh.boolean.difference([cut_fork(surface, 8.0), drill], engine="manifold")
    raw = read_mesh(tmp_path, drilled)
    assert any("hole across it is left out" in note for note in raw.notes)
    check_found(recognize(raw.polygon, raw.width, Overrides(), base=raw.base, unlike=raw.unlike))
    floor = ((6.0, 1.0, 10.0), [high[0] - 3.5, low[1] + 0.5, low[2] + 60.0])
    with pytest.raises(JawFileError, match="have another section"):
        read_mesh(tmp_path, boxes_joined(drilled, floor))


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [17.0, -41.0, 133.0], [84.0, 3.0, 11.0], [40.0, 40.0, 40.0]])
def test_ribs_in_two_layers_are_refused_however_the_finger_is_turned(tmp_path, turn):
    halves = [trimesh.creation.extrude_polygon(draw_polygon(ribs=ribs), 0.5 * WIDTH) for ribs in (4, 5)]
    halves[1].apply_translation([0.0, 0.0, 0.5 * WIDTH])
    mesh = trimesh.boolean.union(halves, engine="manifold")
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    mesh.apply_transform(frame)
    mesh.export(tmp_path / "finger.stl")
    with pytest.raises(JawFileError, match="have another section"):
        make_jaw(tmp_path / "finger.stl", tmp_path / "jaw.yaml", Overrides(name="layers"))


def test_a_floor_of_one_cell_is_no_base(tmp_path, surface):
    low, high = surface.bounds
    floor = boxes_joined(surface, ((20.0, 1.0, 8.0), [high[0] - 10.5, low[1] + 0.5, low[2] + 18.0]))
    floor.export(tmp_path / "finger.stl")
    with pytest.raises(JawFileError, match="is not prismatic along.*a floor"):
        make_jaw(tmp_path / "finger.stl", tmp_path / "jaw.yaml", Overrides(name="floor"))


def test_marks_raised_on_a_side_are_left_out_and_a_rim_is_refused(tmp_path, surface):
    low, high = surface.bounds
    places = [[high[0] - 0.8, high[1], z] for z in np.arange(low[2] + 24.0, high[2] - 14.0, 5.0)]
    raw = read_mesh(tmp_path, boxes_joined(surface, *[((1.0, 2.0, 2.0), place) for place in places]))
    assert any("with raised marks, which are left out" in note for note in raw.notes)
    assert raw.width == pytest.approx(WIDTH * MILLIMETRE) and raw.base is None
    check_found(recognize(raw.polygon, raw.width, Overrides()))
    rim = boxes_joined(surface, ((1.6, 8.0, high[2] - low[2]), [high[0] - 0.8, high[1], 0.5 * (low[2] + high[2])]))
    with pytest.raises(JawFileError, match="have another section"):
        read_mesh(tmp_path, rim)


def test_shells_that_overlap_are_printed_as_one_and_those_that_touch_are_not(tmp_path, surface):
    polygon, width = draw_polygon(ribs=0), WIDTH / 2
    whole = [trimesh.creation.extrude_polygon(polygon, WIDTH)]
    for z in (22.0, 32.0, 42.0, 54.0):
        rib = shapely.LineString([(20.0, z), (-20.0, z + 5.0)]).buffer(0.6, cap_style="flat")
        rib = rib.intersection(shapely.Polygon(polygon.exterior).buffer(-0.4))
        whole.append(trimesh.creation.extrude_polygon(rib, WIDTH))
    raw = read_mesh(tmp_path, trimesh.util.concatenate(whole))
    assert "5 bodies that overlap are one, as printed (--body)" in raw.notes
    assert len(recognize(raw.polygon, raw.width, Overrides()).ribs) == len(whole) - 1
    pad = trimesh.creation.box((2.0, WIDTH, 30.0), trimesh.transformations.translation_matrix((15.0, width, 40.0)))
    with pytest.raises(JawFileError, match="holds 6 bodies"):
        read_mesh(tmp_path, trimesh.util.concatenate([*whole, pad]))


def make_layered(folder, **stated):
    """The jaw of a folder's finger.stl, taken as a solid, and what was found."""
    overrides = Overrides(name="layered", solid=True, **stated)
    _, notes = make_jaw(folder / "finger.stl", folder / "jaw.yaml", overrides, measure_warping=measure_warping)
    return load_jaw(folder / "jaw.yaml"), notes


@pytest.mark.parametrize("kind", ["floor", "slot"])
def test_a_solid_that_is_no_prism_is_taken_in_layers(tmp_path, surface, kind):
    low, high = surface.bounds
    size, middle, side = high - low, 0.5 * (low + high), np.array([0.0, 0.5 * WIDTH, 0.0])
    box = {
        "floor": ((0.6 * size[0], 1.0, 0.6 * size[2]), middle - side + [0.0, 0.5, 0.0]),
        "slot": ((1.0, 0.4 * WIDTH, 0.5 * size[2]), [high[0], middle[1], middle[2]]),
    }[kind]
    mesh = boxes_joined(surface, box, cut=kind == "slot")
    mesh.export(tmp_path / "finger.stl")
    jaw, notes = make_layered(tmp_path)
    depth = 0.4 * WIDTH * MILLIMETRE
    heights = {"floor": [1.0, WIDTH], "slot": [0.3 * WIDTH, 0.7 * WIDTH, WIDTH]}[kind]
    tops = [layer.high - jaw.section.layers[0].low for layer in jaw.section.layers]
    if kind == "floor" and jaw.section.layers[0].high > 0.0:  # on either side, as the axis was found
        heights[0] = WIDTH - heights[0]
    assert tops == pytest.approx(np.array(heights) * MILLIMETRE, abs=1e-5)
    assert compute_volume(jaw.build_mesh("coarse")) == pytest.approx(mesh.volume * MILLIMETRE**3, rel=5e-3)
    # a finger of which one side alone is stiffer twists
    assert jaw.model == ("solid" if kind == "floor" else "plane")
    assert any("layers move apart" in note for note in notes) == (kind == "floor")
    make_jaw(tmp_path / "jaw.section.json", tmp_path / "again.yaml", Overrides(name="again"))
    again = load_jaw(tmp_path / "again.yaml").section
    assert [layer.low for layer in again.layers] == pytest.approx([layer.low for layer in jaw.section.layers], abs=1e-6)
    parted = [
        one.area.symmetric_difference(two.area).area for one, two in zip(again.layers, jaw.section.layers, strict=True)
    ]
    assert max(parted) < 1e-3 * jaw.section.polygon.area
    if kind == "slot":
        face = np.array([[jaw.inner_face_x - 2e-4, 0.035], [jaw.inner_face_x - 2e-3, 0.035]])
        assert jaw.section.read_width(face[:1]) == pytest.approx(WIDTH * MILLIMETRE - depth, abs=1e-5)


def test_parts_that_touch_along_an_edge_are_closed(tmp_path, surface):
    low, middle = surface.bounds[0], surface.bounds.mean(axis=0)
    holes = [((3.0, 2 * WIDTH, 3.0), [at, middle[1], low[2] + 3.0 + at]) for at in (0.0, 3.0)]
    mesh = boxes_joined(surface, *holes, cut=True)
    mesh.merge_vertices()
    assert not mesh.is_watertight
    whole = read_mesh(tmp_path, surface).polygon
    assert whole.area - read_mesh(tmp_path, mesh).polygon.area == pytest.approx(2 * 9e-6, rel=1e-3)


def test_layers_of_a_section_file_that_are_apart_are_refused(tmp_path):
    squares = [[[x, 0.0], [x + 10.0, 0.0], [x + 10.0, 60.0], [x, 60.0]] for x in (0.0, 30.0)]
    layers = [{"y": [10.0 * number, 10.0 * number + 10.0], "loops": [square]} for number, square in enumerate(squares)]
    file = tmp_path / "apart.json"
    file.write_text(json.dumps({"unit": "mm", "loops": squares[:1], "layers": layers}))
    with pytest.raises(JawFileError, match=r"apart\.json.*2 separate areas"):
        make_jaw(file, tmp_path / "jaw.yaml", Overrides(name="apart"))


def test_layers_that_are_alike_are_as_stiff_as_one():
    prism = make_section(size=4e-3)
    half = 0.5 * prism.width
    layers = tuple(Layer(low=a, high=b, area=prism.polygon) for a, b in ((-half, 0.002), (0.002, half)))
    found = []
    for section in (prism, replace(prism, layers=layers)):
        mesh, plane = extrude_section(section), mesh_section(section)
        model = PlaneModel(mesh, plane, section, TPU)
        probe = model.attach(np.array([[0.014, 0.0, 0.04]]))
        load = model.load(probe, np.zeros(model.size), np.array([[-1.0, 0.0, 0.0]]))
        found.append(float(load @ model.factorise(model.linearize(np.zeros(model.size)).tangent).solve(load)))
        assert compute_volume(mesh) == pytest.approx(prism.polygon.area * prism.width, rel=5e-3)
    assert found[1] == pytest.approx(found[0], rel=0.01)


def test_a_finger_without_ribs_is_taken_as_a_solid(tmp_path):
    wedge = shapely.Polygon([(14.0, 0.0), (14.0, 70.0), (10.0, 70.0), (-14.0, 0.0)])
    trimesh.creation.extrude_polygon(wedge, WIDTH).export(tmp_path / "finger.stl")
    with pytest.raises(JawFileError, match="0 cells"):
        make_jaw(tmp_path / "finger.stl", tmp_path / "jaw.yaml", Overrides(name="wedge"))
    jaw, _ = make_layered(tmp_path)
    assert jaw.section.polygon.area == pytest.approx(wedge.area * MILLIMETRE**2, rel=1e-3)
    assert len(jaw.keypoints) > 10


def test_a_slotted_block_is_extruded_along_its_slot_and_has_no_cells_or_bolts_beside_it(tmp_path):
    outline = shapely.box(0.0, 0.0, 40.0, 12.0).difference(shapely.box(0.0, 4.0, 8.0, 9.0))
    trimesh.creation.extrude_polygon(outline, 11.0).export(tmp_path / "finger.stl")
    found = []
    for flip in (True, False):
        jaw, notes = make_layered(tmp_path, flip=flip)
        assert jaw.section.width == pytest.approx(11e-3) and "1 layer along [0.0, 0.0, 1.0]" in " ".join(notes)
        assert len(jaw.keypoints) > 10 and len(jaw.section.clamped_circles) == 0
        assert not any("bolts" in note for note in notes)
        tip = jaw.keypoints[jaw.keypoint_names.index("tip")]
        assert jaw.section.polygon.contains(shapely.Point(tip[[0, 2]]))
        found.append(jaw.section.clamped_z)
    assert max(found) == pytest.approx(8e-3, abs=5e-4)  # all of the slot, where that is the base


def test_ribs_that_cross_are_taken_as_a_solid(tmp_path):
    polygon = draw_polygon(ribs=0)
    for z in (14.0, 26.0, 38.0):
        for start, end in ((z, z + 14.0), (z + 14.0, z)):
            rib = shapely.LineString([(20.0, start), (-20.0, end)]).buffer(0.6)
            polygon = polygon.union(rib.intersection(shapely.Polygon(polygon.exterior)))
    trimesh.creation.extrude_polygon(polygon, WIDTH).export(tmp_path / "finger.stl")
    with pytest.raises(JawFileError, match="ribs cross next to its cells .*take a closed solid as it is"):
        make_jaw(tmp_path / "finger.stl", tmp_path / "jaw.yaml", Overrides(name="lattice"))
    jaw, notes = make_layered(tmp_path)
    assert "no ribs found: key points stand at even heights, as if there were some" in notes
    assert jaw.section.polygon.area == pytest.approx(polygon.area * MILLIMETRE**2, rel=1e-3)


def test_a_cut_is_closed_wherever_it_meets_vertices_and_rounding():
    # a lattice of vertices on the plane itself, and walls whose cut is rounded next to the middle of two grid lines
    block = trimesh.creation.box((40.0, 20.0, 10.0)).subdivide().subdivide()
    surface = Surface(vertices=(block.vertices + 0.5 * _GRID / MILLIMETRE) * MILLIMETRE, triangles=block.faces)
    turned = Rotation.from_euler("xy", [0.3, 0.5]).as_matrix()
    skew = replace(surface, vertices=surface.vertices @ turned.T)
    for height in (0.5 * _GRID, 0.5 * _GRID + 2.5e-3, 1e-3):
        for mesh, axis in ((surface, UP), (skew, turned @ UP)):
            assert _cut(mesh, axis, height).area == pytest.approx(800e-6, rel=1e-3)


@pytest.mark.parametrize(("height", "clamp"), [(8.0, 10.5), (15.0, 15.0), (40.0, None)])
def test_a_blade_on_a_wider_base_has_its_own_width_where_the_clamp_holds_the_base(tmp_path, surface, height, clamp):
    low, high = surface.bounds
    size, middle = high - low, 0.5 * (low + high)
    base = boxes_joined(surface, ((size[0], 1.6 * WIDTH, height), [middle[0], middle[1], low[2] + 0.5 * height]))
    raw = read_mesh(tmp_path, base)
    assert raw.width == pytest.approx(WIDTH * MILLIMETRE)
    if clamp is None:
        with pytest.raises(JawFileError, match="wider than its blade up to z = 40 of 70 mm"):
            recognize(raw.polygon, raw.width, Overrides(), base=raw.base)
        return
    finger = recognize(raw.polygon, raw.width, Overrides(), base=raw.base)
    assert finger.clamped_z == pytest.approx(clamp * MILLIMETRE, abs=3e-4)
    assert finger.width == pytest.approx(WIDTH * MILLIMETRE)


def draw_seat(kind, x):
    if kind.endswith("slot"):
        return shapely.LineString([(x - 1.3, 5.0), (x + (4.0 if kind == "long slot" else 1.3), 5.0)]).buffer(1.5)
    angles = np.pi / 4.0 + np.pi / 2.0 * np.arange(4) if kind == "square nut" else np.pi / 3.0 * np.arange(6)
    return shapely.Polygon(np.column_stack([x + 1.7 * np.cos(angles), 5.0 + 1.7 * np.sin(angles)]))


@pytest.mark.parametrize("kind", ["nut", "square nut", "slot", "long slot"])
def test_seats_of_nuts_and_slots_are_bolts_and_no_cells(kind):
    polygon = draw_polygon(bolts=()).difference(shapely.union_all([draw_seat(kind, x) for x in (-8.0, 4.0)]))
    if kind == "square nut":  # is a smaller one than the bolt
        found = recognize(shapely.affinity.scale(polygon, 1e-3, 1e-3, origin=(0, 0)), 0.02, Overrides())
        assert len(found.bolts) == 2 and len(found.ribs) == RIBS
        return
    check_found(recognize(shapely.affinity.scale(polygon, 1e-3, 1e-3, origin=(0, 0)), 0.02, Overrides()))


def draw_triangle(tilt, ribs, plate=1.6, band=1.6):
    """A triangle with an upright inner face on a base that rises towards it, and ribs given by their ends."""
    corners = [(14.0, 0.0), (14.0, 80.0), (-14.0, -28.0 * tilt)]
    whole = shapely.Polygon([(14.0, -plate), *corners, (-14.0, -28.0 * tilt - plate)])
    room = shapely.Polygon(corners).buffer(-band, join_style="mitre")
    for start, end in ribs:
        room = room.difference(shapely.LineString([start, end]).buffer(0.5, cap_style="flat"))
    return shapely.affinity.scale(whole.difference(room), 1e-3, 1e-3, origin=(0, 0))


LEVEL = [((-20.0, z + 4.0), (20.0, z)) for z in (12.0, 26.0, 40.0, 54.0)]


@pytest.mark.parametrize("tilt", [-0.1, 0.1, 0.4])
def test_a_tilted_base_is_held_from_band_to_band(tmp_path, tilt):
    finger = recognize(draw_triangle(tilt, LEVEL), 0.02, Overrides())
    assert finger.clamp_slope == pytest.approx(tilt, abs=1e-3) and len(finger.ribs) == len(LEVEL)
    floor = finger.rings[0][finger.find_clamped(finger.rings[0])]
    assert np.ptp(floor[:, 0]) == pytest.approx(28e-3, abs=1e-3)  # all of the edge, and nothing above the plate
    assert (finger.clamp_height(floor[:, 0]) - floor[:, 1]).max() < 3.5e-3
    stated = recognize(draw_triangle(tilt, LEVEL), 0.02, Overrides(clamp_z=0.02))
    assert stated.clamp_height(stated.face_x) == pytest.approx(0.02) and stated.clamp_slope == finger.clamp_slope
    level = recognize(draw_triangle(0.0, LEVEL), 0.02, Overrides())
    assert level.clamp_slope == 0.0


def test_a_tilted_base_below_the_finger_is_no_wider_body():
    drawn = draw_triangle(-0.95, LEVEL).buffer(-4e-4).buffer(4e-4)
    rounded = drawn.intersection(shapely.Polygon(drawn.exterior).buffer(-3e-3).buffer(3e-3))
    finger = recognize(rounded, 0.02, Overrides())
    assert finger.clamp_slope == pytest.approx(-0.95, abs=0.01)
    assert "wider than the blade" not in " ".join(finger.notes)


def test_the_long_steep_side_of_a_hull_is_not_its_base():
    hull = shapely.Polygon([(14.0, 0.0), (14.0, 90.0), (-17.0, 23.0), (-1.0, 0.0)])
    room = hull.buffer(-1.6, join_style="mitre").intersection(shapely.box(-50.0, 1.6, 50.0, 82.0))
    for z in (24.0, 38.0, 52.0):
        room = room.difference(shapely.box(-50.0, z, 50.0, z + 1.2))
    section = shapely.affinity.scale(hull.difference(room), 1e-3, 1e-3, origin=(0, 0))
    assert recognize(section, 0.02, Overrides()).clamp_slope == 0.0


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_a_base_as_thin_as_a_band_is_held(turn):
    whole = shapely.Polygon([(14.0, 0.0), (14.0, 70.0), (10.0, 70.0), (-14.0, 0.0)])
    room = whole.buffer(-1.6, join_style="mitre").intersection(shapely.box(-50.0, 1.6, 50.0, 64.0))
    for z in (20.0, 35.0, 50.0):
        room = room.difference(shapely.box(-50.0, z, 50.0, z + 1.2))
    section = shapely.affinity.rotate(whole.difference(room), turn, origin=(0.0, 0.0), use_radians=True)
    finger = recognize(shapely.affinity.scale(section, *2 * [MILLIMETRE], origin=(0.0, 0.0)), 0.02, Overrides())
    assert finger.find_clamped(np.array([[finger.face_x - 1e-4, 5e-4], [finger.face_x - 27.5e-3, 5e-4]])).all()
    assert not finger.find_clamped(np.array([[finger.face_x - 1e-4, 1.7e-3]])).any()


def test_a_rib_that_ends_on_the_base_is_a_rib_without_a_key_point_there():
    ribs = [((-20.0, 30.0), (4.0, -2.0)), ((-20.0, 48.0), (20.0, 10.0)), ((-20.0, 64.0), (20.0, 26.0))]
    finger = recognize(draw_triangle(0.0, ribs), 0.02, Overrides())
    assert len(finger.ribs) == 3
    points = choose_keypoints(finger)
    assert {name for name in points if "_" in name and name.count("_") == 1} >= {"outer_1", "outer_2", "inner_2"}
    assert "inner_1" not in points
    places = np.array(list(points.values()))[:, [0, 2]]
    apart = np.linalg.norm(places[:, None] - places, axis=2) + np.eye(len(places))
    assert apart.min() > 2e-3


def test_fillets_beside_ribs_hide_no_key_points():
    drawn = draw_triangle(0.0, LEVEL[:3])
    room = shapely.union_all([shapely.Polygon(hole) for hole in drawn.interiors]).buffer(-2.5e-3).buffer(2.5e-3)
    filleted = shapely.Polygon(drawn.exterior).difference(room)
    assert (
        choose_keypoints(recognize(filleted, 0.02, Overrides())).keys()
        == choose_keypoints(recognize(drawn, 0.02, Overrides())).keys()
    )


NOSE = [(0.0, 0.0), (16.0, 0.0), (16.0, 50.0), (14.0, 55.0), (0.0, 40.0)]


@pytest.mark.parametrize("step", [5.0, 8.0])
def test_a_finger_with_a_short_nose_has_its_tip_there(step):
    room = shapely.Polygon(NOSE).buffer(-1.0, join_style="mitre").intersection(shapely.box(-50.0, 10.0, 50.0, 90.0))
    levels = np.arange(13.0, 48.0, step)
    for z in levels:
        room = room.difference(shapely.box(-50.0, z, 50.0, z + 1.0))
    drawn = shapely.Polygon(NOSE).difference(room)
    finger = recognize(shapely.affinity.scale(drawn, 1e-3, 1e-3, origin=(0, 0)), 0.02, Overrides())
    assert len(finger.ribs) == len(levels)
    assert np.ptp(finger.rings[0][finger.rings[0][:, 1] < 1e-6, 0]) == pytest.approx(16e-3, abs=1e-5)  # the base


@pytest.mark.parametrize(("slope", "step"), [(0.0, 1.7), (0.18, 1.7), (0.36, 2.5), (0.58, 1.7), (0.84, 1.7)])
def test_slanted_ribs_that_end_on_base_and_notch_are_ribs(slope, step):
    """Corners that they leave are small cells, or none, and of no chain; none is a slot in a band."""
    outline = shapely.Polygon([*NOSE[:3], (13.0, 54.0), (10.5, 43.5), (2.0, 45.0), (0.0, 40.0)])
    room = outline.buffer(-0.6, join_style="mitre").intersection(shapely.box(-50.0, 10.7, 50.0, 90.0))
    for z in np.arange(-5.0, 60.0, step):
        rib = shapely.LineString([(-20.0, z - 28.0 * slope), (36.0, z + 28.0 * slope)])
        room = room.difference(rib.buffer(0.2, cap_style="flat"))
    drawn = outline.difference(room)
    finger = recognize(shapely.affinity.scale(drawn, 1e-3, 1e-3, origin=(0, 0)), 0.02, Overrides())
    cells = [hole for hole in drawn.interiors if hole.length > 3.0]
    assert len(finger.ribs) == len(cells) - 1 > 15
    assert not any("slot" in note for note in finger.notes)
    heights = [rib.wall.line[:, 1].mean() for rib in finger.ribs]
    assert min(heights[:3]) == min(heights) and 40e-3 < max(heights[-5:]) == max(heights)
    assert all(rib.wall.usual == pytest.approx(0.4e-3, abs=2e-5) for rib in finger.ribs)
    points = np.array(list(choose_keypoints(finger).values()))
    assert pdist(points).min() > 0.6e-3 and len(points) > 1.5 * len(finger.ribs)


def test_sides_that_are_alike_are_told_and_a_step_of_the_base_bends_no_face():
    step = draw_triangle(0.0, LEVEL).union(shapely.box(4e-3, -10e-3, 14e-3, -1e-3))
    finger = recognize(step, 0.02, Overrides())
    assert finger.face_deviation < 2e-5 and finger.clamp_slope == 0.0
    assert 8.4e-3 < finger.clamped_z < 10.1e-3  # the step and a part of the plate
    alike = shapely.Polygon([(-12.0, 0.0), (12.0, 0.0), (0.0, 80.0)])
    room = alike.buffer(-1.6, join_style="mitre")
    for z in (14.0, 28.0, 42.0):
        room = room.difference(shapely.LineString([(-30.0, z + 15.0), (30.0, z - 15.0)]).buffer(0.5, cap_style="flat"))
    alike = shapely.affinity.scale(alike.difference(room), 1e-3, 1e-3, origin=(0, 0))
    for polygon in (alike, shapely.affinity.rotate(alike, 130.0), shapely.affinity.scale(alike, -1.0, 1.0)):
        finger = recognize(polygon, 0.02, Overrides())
        assert any("alike" in note for note in finger.notes)
        assert all(rib.inner[1] > rib.outer[1] for rib in finger.ribs)


@pytest.mark.parametrize(
    ("tooth", "pitch"), [([(0.0, 0.0), (0.9, 0.5), (0.0, 1.0)], 2.0), ([(0.6, 0.0), (0.6, 1.5)], 3.0)]
)
def test_teeth_bend_no_face(tooth, pitch):
    polygon = draw_polygon()
    for z in np.arange(16.0, 64.0, pitch):
        corners = [(13.9, z), *((14.0 + x, z + up) for x, up in tooth), (13.9, z + tooth[-1][1])]
        polygon = polygon.union(shapely.Polygon(corners))
    metres = [shapely.affinity.scale(each, 1e-3, 1e-3, origin=(0, 0)) for each in (polygon, draw_polygon())]
    toothed, plain = (recognize(each, 0.02, Overrides(face_x=0.014)) for each in metres)
    assert toothed.face_deviation == pytest.approx(max(x for x, _ in tooth) * MILLIMETRE, abs=1e-4)
    assert toothed.clamp_slope == 0.0 and toothed.clamped_z == plain.clamped_z
    for rib, other in zip(toothed.ribs, plain.ribs, strict=True):
        np.testing.assert_allclose(rib.outer - rib.inner, other.outer - other.inner, atol=5e-4)


def test_a_small_hole_across_is_left_out_with_a_word(tmp_path, surface):
    low, high = surface.bounds
    drill = trimesh.creation.cylinder(0.5, 200.0)
    drill.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, [0, 1, 0]))
    drill.apply_translation([0.0, 0.0, low[2] + 0.75 * (high[2] - low[2])])
    raw = read_mesh(tmp_path, trimesh.boolean.difference([surface, drill], engine="manifold"))
    assert any("hole across" in note for note in raw.notes)
    check_found(recognize(raw.polygon, raw.width, Overrides()))


def test_a_void_is_no_body(tmp_path, surface):
    path, void = tmp_path / "finger.stl", trimesh.creation.box((2.0, 0.5, 2.0))
    void.apply_translation((0.0, 0.0, 6.0))
    trimesh.util.concatenate([surface, void]).export(path)
    with pytest.raises(JawFileError, match="2 bodies"):
        read_section(path)
    void.invert()
    trimesh.util.concatenate([surface, void]).export(path)
    assert "1 closed voids inside" in read_section(path).notes


def test_a_missing_triangle_and_doubled_faces_are_mended_with_a_word(tmp_path, surface):
    lacking = surface.copy()
    lacking.update_faces(np.arange(len(lacking.faces)) != 7)
    far = surface.vertices[:, 2].argmax()
    flap = np.append(surface.faces[surface.faces[:, 0] != far][0, :2], far)  # from an edge to another place and back
    more = (surface.faces[:5], surface.faces[:, ::-1], [flap, flap[::-1]])
    doubled = [trimesh.Trimesh(surface.vertices, np.vstack([surface.faces, faces]), process=False) for faces in more]
    for mesh in (lacking, *doubled):
        raw = read_mesh(tmp_path, mesh)
        assert any(note.startswith("mended") for note in raw.notes)
        check_found(recognize(raw.polygon, raw.width, Overrides()))


def test_cracks_are_closed_and_facets_that_look_inwards_are_turned(tmp_path, surface):
    corners = surface.triangles.reshape(-1, 3)
    apart = corners + np.random.default_rng(0).uniform(-2e-3, 2e-3, corners.shape)  # a fifth of what is closed
    raw = read_mesh(tmp_path, trimesh.Trimesh(apart, np.arange(len(apart)).reshape(-1, 3), process=False))
    assert any("vertices merged with others within 0.01 mm" in note for note in raw.notes)
    assert raw.polygon.area == pytest.approx(draw_polygon().area * MILLIMETRE**2, rel=2e-3)
    tapered = taper_surface(surface, 0.12, 0.0)
    faces = tapered.faces.copy()
    faces[::3] = faces[::3, ::-1]
    turned = read_mesh(tmp_path, trimesh.Trimesh(tapered.vertices, faces, process=False))
    np.testing.assert_allclose(turned.taper, read_mesh(tmp_path, tapered).taper, atol=1e-9)


@pytest.mark.parametrize(("unit", "scale"), [("um", 1e3), ("m", 1e-3)])
def test_a_unit_is_found_where_only_one_makes_a_finger_and_a_stated_one_is_checked(tmp_path, surface, unit, scale):
    mesh = surface.copy()
    mesh.apply_scale(scale)
    assert f"unit: {unit}" in read_mesh(tmp_path, mesh).notes[0]
    with pytest.raises(JawFileError, match="expected a finger of 5 to 1000 mm"):
        read_mesh(tmp_path, mesh, unit="m" if unit == "um" else "um")


def test_a_finger_that_would_stand_on_one_leg_is_refused():
    polygon = shapely.affinity.scale(draw_polygon(), MILLIMETRE, MILLIMETRE, origin=(0, 0))
    with pytest.raises(JawFileError, match="would not be held"):
        recognize(polygon, WIDTH * MILLIMETRE, Overrides(clamp_z=-1e-3))


def taper_surface(surface, slope, lean):
    """A finger whose one side is slanted along its length, and whose walls lean as it gets wider."""
    mesh = surface.copy()
    points = np.array(mesh.vertices)
    share = (points[:, 1] + 0.5 * WIDTH) / WIDTH
    points[:, 1] = share * (WIDTH - slope * points[:, 2])
    points[:, 0] += lean * points[:, 1]
    return trimesh.Trimesh(points, mesh.faces, process=True)


@pytest.mark.parametrize(("turn", "lean"), [([0.0, 0.0, 0.0], 0.1), ([90.0, 0.0, 0.0], 0.0), ([90.0, 40.0, 0.0], 0.1)])
def test_a_tapered_finger_is_taken_as_symmetric_about_its_middle(tmp_path, surface, turn, lean):
    mesh = taper_surface(surface, 0.12, lean)
    volume = mesh.volume
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    mesh.apply_transform(frame)
    mesh.export(tmp_path / "finger.stl")
    raw = read_section(tmp_path / "finger.stl")
    assert any("tapered" in note for note in raw.notes)
    finger = recognize(raw.polygon, raw.width, Overrides(), raw.taper)
    stretch = np.hypot(1.0, lean)  # along the walls
    assert finger.taper == pytest.approx([0.0, -0.12 * stretch], abs=2e-3)
    assert finger.width == pytest.approx(WIDTH * MILLIMETRE * stretch, abs=5e-5)
    assert len(finger.ribs) == RIBS
    main(["jaw", str(tmp_path / "finger.stl"), "-o", str(tmp_path / "finger.yaml")])
    jaw = load_jaw(tmp_path / "finger.yaml")
    made = jaw.build_mesh("coarse")
    assert trimesh.Trimesh(made.nodes, made.surface).volume == pytest.approx(volume * MILLIMETRE**3, rel=3e-3)
    tip = jaw.keypoints[list(jaw.keypoint_names).index("tip")]
    assert tip[1] == pytest.approx(0.5 * stretch * (WIDTH * MILLIMETRE - 0.12 * tip[2]), abs=5e-5)


def test_a_side_that_is_no_plane_and_walls_that_run_apart_are_refused(tmp_path, surface):
    mesh = taper_surface(surface, 0.12, 0.0)
    mesh.vertices[:, 1] *= 1.0 + 0.02 * mesh.vertices[:, 0]
    mesh.export(tmp_path / "round.stl")
    with pytest.raises(JawFileError, match="a side leaves its plane"):
        read_section(tmp_path / "round.stl")
    mesh = surface.copy()
    mesh.vertices[:, 0] *= 1.0 + 0.03 * mesh.vertices[:, 1]
    mesh.export(tmp_path / "cone.stl")
    with pytest.raises(JawFileError, match="walls all run in one direction"):
        read_section(tmp_path / "cone.stl")


def test_a_finger_with_its_holder_is_refused_with_a_picture_and_taken_as_a_solid(tmp_path, surface):
    low, high = surface.bounds
    middle = 0.5 * (low + high)
    # a bracket of two plates beside the finger, on a bridge across its base that leans
    plates = [((60.0, 4.0, 50.0), [middle[0], y, low[2] - 27.0]) for y in (low[1] - 14.0, high[1] + 14.0)]
    bridge = trimesh.creation.cone(20.0, 24.0, sections=24)
    bridge.apply_translation([middle[0], middle[1], low[2] - 12.0])
    sides = [((30.0, 16.0, 6.0), [middle[0], y, low[2] - 3.0]) for y in (low[1] - 6.0, high[1] + 6.0)]
    held = trimesh.boolean.union([boxes_joined(surface, *plates, *sides), bridge], engine="manifold")
    held.export(tmp_path / "finger.stl")
    with pytest.raises(JawFileError, match=r"not prismatic.*--solid.*export the finger alone.*drawn in .*jaw\.png"):
        make_jaw(tmp_path / "finger.stl", tmp_path / "jaw.yaml", Overrides(name="held"))
    assert (tmp_path / "jaw.png").exists()
    raw = read_section(tmp_path / "finger.stl", layered=True)
    finger = recognize(raw.polygon, raw.width, Overrides())
    assert len(finger.ribs) == RIBS and len(finger.bolts) == 2
    volume = sum((layer.high - layer.low) * layer.area.area for layer in raw.layers)
    assert volume == pytest.approx(held.volume * MILLIMETRE**3, rel=0.06)


def test_layers_of_a_body_that_changes_everywhere_have_ribs_where_it_has_some(tmp_path):
    """A lens of 40 mm has ribs over half of its width: thinner than outlines may move, they are no outline."""
    lens = trimesh.creation.icosphere(4)
    lens.apply_scale([25.0, LENGTH, 20.0])
    parts = []
    for ribs, width in ((0, 40.0), (RIBS, 20.0)):
        prism = trimesh.creation.extrude_polygon(draw_polygon(ribs=ribs), width)
        prism.apply_translation([0.0, 0.0, -0.5 * width])
        parts.append(trimesh.boolean.intersection([prism, lens], engine="manifold"))
    body = trimesh.boolean.union(parts, engine="manifold")
    body.export(tmp_path / "finger.stl")
    layers = read_section(tmp_path / "finger.stl", layered=True).layers
    volume = sum((layer.high - layer.low) * layer.area.area for layer in layers)
    assert len(layers) > 10 and volume == pytest.approx(body.volume * MILLIMETRE**3, rel=0.02)


def test_a_surface_that_is_inside_out_is_turned(tmp_path, surface):
    mesh = surface.copy()
    mesh.invert()
    mesh.export(tmp_path / "finger.stl")
    raw = read_section(tmp_path / "finger.stl")
    assert any("inside out" in note for note in raw.notes)
    check_found(recognize(raw.polygon, raw.width, Overrides()))


def test_one_body_of_several_is_chosen(tmp_path, surface):
    box = trimesh.creation.box((8.0, 8.0, 8.0))
    box.apply_translation([60.0, 0.0, 0.0])
    trimesh.util.concatenate([surface, box]).export(tmp_path / "two.stl")
    with pytest.raises(JawFileError, match=r"holds 2 bodies, expected one; choose the finger with --body N"):
        read_section(tmp_path / "two.stl")
    with pytest.raises(JawFileError, match="no number 3"):
        read_section(tmp_path / "two.stl", body=3)
    raw = read_section(tmp_path / "two.stl", body=1)
    check_found(recognize(raw.polygon, raw.width, Overrides()))


def test_junctions_are_where_rib_and_band_were_drawn():
    """The centre line of rib k meets that of the inner band, 0.8 mm behind the face, where it was drawn."""
    finger = recognize(shapely.affinity.scale(draw_polygon(), 1e-3, 1e-3, origin=(0, 0)), 0.02, Overrides())
    heights = np.linspace(BASE + 10.0, LENGTH - 16.0, RIBS) * MILLIMETRE
    slope = 4.0 / 28.0
    for z, rib in zip(heights, finger.ribs, strict=True):
        assert rib.inner[1] == pytest.approx(z + slope * (19.0 - 13.2) * MILLIMETRE, abs=1e-4)
        assert finger.face_x - rib.inner[0] == pytest.approx(0.8e-3, abs=5e-5)


def test_wishes_go_before_guesses():
    polygon = shapely.affinity.scale(draw_polygon(), 1e-3, 1e-3, origin=(0, 0))
    finger = recognize(polygon, 0.02, Overrides(clamp_z=0.02, face_x=0.014))
    assert finger.clamped_z == 0.02 and finger.face_x == pytest.approx(0.014)
    other = recognize(polygon, 0.02, Overrides(other_face=True))
    assert np.linalg.norm(other.inner.line[-1] - finger.inner.line[-1]) > 1e-3


def test_a_finger_is_not_held_by_its_tip_and_ends_that_are_alike_are_asked_for():
    polygon = shapely.affinity.scale(draw_polygon(), 1e-3, 1e-3, origin=(0, 0))
    with pytest.raises(JawFileError, match="would hold it by its tip"):
        recognize(polygon, 0.02, Overrides(flip=True))
    box = shapely.box(-14.0, 0.0, 14.0, 70.0)
    rooms = [shapely.box(-12.0, z, 12.0, z + 12.0) for z in (10.0, 24.0, 38.0, 52.0)]
    box = shapely.affinity.scale(box.difference(shapely.union_all(rooms)), 1e-3, 1e-3, origin=(0, 0))
    with pytest.raises(JawFileError, match="--flip or --no-flip"):
        recognize(box, 0.02, Overrides())
    ends = [recognize(box, 0.02, Overrides(flip=flip)).ribs[0].inner[1] for flip in (False, True)]
    assert abs(ends[0] - ends[1]) > 1e-3


def test_a_bolt_above_a_whole_cell_is_held_by_itself():
    drawn = draw_polygon(ribs=5)
    inside = shapely.union_all([shapely.Polygon(ring) for ring in drawn.interiors])
    lug, hole = shapely.Point(-6.0, 40.0).buffer(5.0), shapely.Point(-7.0, 40.0).buffer(1.5, quad_segs=12)
    polygon = drawn.union(lug.difference(inside)).difference(hole)
    finger = recognize(shapely.affinity.scale(polygon, 1e-3, 1e-3, origin=(0, 0)), 0.02, Overrides())
    assert len(finger.clamped_circles) == 1
    assert finger.clamped_circles[0, 1:] == pytest.approx([0.040, 3e-3], abs=2e-4)


def test_a_hole_in_the_tip_holds_nothing_and_a_window_in_the_base_no_more_than_the_base():
    polygon = draw_polygon(bolts=()).difference(shapely.Point(12.0, 67.5).buffer(0.8, quad_segs=12))
    polygon = polygon.difference(shapely.box(-4.0, 3.0, 4.0, 9.0))
    finger = recognize(shapely.affinity.scale(polygon, 1e-3, 1e-3, origin=(0, 0)), 0.02, Overrides())
    assert len(finger.clamped_circles) == 0 and len(finger.ribs) == RIBS
    assert 0.8 * BASE * MILLIMETRE < finger.clamped_z <= BASE * MILLIMETRE


def test_bolts_of_a_large_finger_are_large():
    # 2.2 times as large, its bolts are M6, which clear 3.3 mm
    scale = 2.2 * MILLIMETRE
    finger = recognize(shapely.affinity.scale(draw_polygon(), scale, scale, origin=(0, 0)), 0.02, Overrides())
    assert finger.clamped_z == pytest.approx((5.0 + 3 * 1.5) * scale, abs=6e-4)
    assert any("2 base bolts" in note for note in finger.notes)


@pytest.mark.parametrize("is_round", [True, False])
def test_a_window_beside_the_bolts_is_no_bolt_and_no_cell(is_round):
    triangle = shapely.Polygon([(-3.0, 4.0), (4.0, 4.0), (0.0, 9.0)])
    window = shapely.Point(0.0, 6.0).buffer(3.2, quad_segs=12) if is_round else triangle
    polygon = shapely.affinity.scale(draw_polygon().difference(window), 1e-3, 1e-3, origin=(0, 0))
    finger = recognize(polygon, 0.02, Overrides())
    check_found(replace(finger, bolts=finger.bolts[[0, -1]]))
    assert any("1 window in its base" in note for note in finger.notes) != is_round


def test_a_hole_with_a_wall_as_thin_as_a_band_is_a_cell():
    hole = shapely.Polygon([(-12.2, 1.9), (-12.2, 11.0), (-10.0, 11.0)])
    polygon = shapely.affinity.scale(draw_polygon(bolts=()).difference(hole), 1e-3, 1e-3, origin=(0, 0))
    assert len(recognize(polygon, 0.02, Overrides()).ribs) == RIBS + 1


@pytest.mark.parametrize("half", [0.8, 0.5])  # mm; the walls of the narrower one are thick for its size
def test_a_slot_in_a_band_is_no_cell_and_no_bolt(half):
    # along the outer band, 4 mm thick there
    polygon = draw_polygon().union(shapely.LineString([(-8.5, 20.0), (-1.0, 38.0)]).buffer(2.0, cap_style="flat"))
    wall = shapely.LineString([(-7.5, 23.0), (-3.3, 33.0)])
    drawn = shapely.affinity.scale(polygon.difference(wall.buffer(half)), 1e-3, 1e-3, origin=(0, 0))
    finger = recognize(drawn, 0.02, Overrides())
    assert len(finger.ribs) == RIBS and len(finger.clamped_circles) == 0
    assert any("1 slot in its bands: no cell" in note for note in finger.notes)


def write_dxf(path, loops):
    ezdxf = pytest.importorskip("ezdxf")
    document = ezdxf.new(units=4)
    for loop in loops:
        document.modelspace().add_lwpolyline(loop, close=True)
    document.saveas(path)


def write_svg(path, loops):
    pytest.importorskip("svgelements")
    data = " ".join("M " + " L ".join(f"{x},{-y}" for x, y in loop) + " Z" for loop in loops)
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="60mm" height="100mm" viewBox="0 0 60 100">'
        f'<path d="{data}"/></svg>'
    )


@pytest.mark.parametrize(("suffix", "write"), [(".dxf", write_dxf), (".svg", write_svg)])
def test_a_drawing_is_read_and_needs_a_width(tmp_path, capsys, suffix, write):
    path = tmp_path / f"finger{suffix}"
    write(path, [ring.tolist() for ring in order_rings(draw_polygon())])
    raw = read_section(path)
    assert raw.width is None
    check_found(recognize(raw.polygon, WIDTH * MILLIMETRE, Overrides()))
    assert main(["jaw", str(path), "-o", str(tmp_path / "out.yaml")]) == 2
    assert "a flat file has no width; give it in millimetres: --width" in capsys.readouterr().err


PER_MM, TWO_MARKS = 8, "360,60,360,620=70"


def photograph(path, light=(0.7, 0.6, 0.1), ground=(0.02, 0.02, 0.02), shown=None, orientation=1):
    """Draws a finger and a longer ruler in linear light, blurs, adds noise, and writes that as sRGB and JPEG."""
    fine, rng = 4 * PER_MM, np.random.default_rng(0)
    mask, ruler = (np.zeros((fine * 85, fine * 60), np.uint8) for _ in range(2))
    for number, ring in enumerate(order_rings(draw_polygon())):
        # fillPoly draws the line around, too
        ring = shapely.get_coordinates(shapely.Polygon(ring).buffer(-0.5 / fine, join_style="mitre"))
        cv2.fillPoly(
            mask, [np.round(256 * fine * (ring * [1, -1] + [22, 77])).astype(np.int32)], 255 * (not number), 8, 8
        )
    cv2.rectangle(ruler, (43 * fine, 2 * fine), (58 * fine, 82 * fine), 255, -1)
    cover = [
        cv2.resize(part, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)[..., None] for part in (mask, ruler)
    ]
    picture = np.array(ground) * (1 + 0.3 * np.linspace(-0.5, 0.5, 60 * PER_MM)[None, :, None])
    for part, colour in zip(cover, (light, (0.9, 0.9, 0.9)), strict=True):
        picture = picture + part / 255 * (np.array(colour) - picture)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.0)
    picture = np.where(picture > 0.0031308, 1.055 * picture ** (1 / 2.4) - 0.055, 12.92 * picture)
    picture = np.clip(255 * (picture + 0.01 * rng.standard_normal(picture.shape)), 0, 255).astype(np.uint8)
    picture = Image.fromarray(picture if shown is None else picture[shown])
    exif = picture.getexif()
    exif[0x0112] = orientation
    turned = picture.transpose(Image.Transpose.ROTATE_90) if orientation == 6 else picture
    turned.save(path, quality=90, exif=exif)
    return path


BLACK_ON_WHITE = {"light": (0.03, 0.03, 0.03), "ground": (0.8, 0.8, 0.8)}


@pytest.mark.parametrize("colours", [{}, BLACK_ON_WHITE, {"orientation": 6}])
def test_a_photograph_gives_walls_to_a_fraction_of_a_pixel(tmp_path, colours):
    photo = read_photo(photograph(tmp_path / "finger.jpg", **colours), TWO_MARKS)
    assert photo.is_dark == (colours is BLACK_ON_WHITE)
    finger = recognize(join_loops(photo.loops), WIDTH * MILLIMETRE, Overrides())
    free = finger.inner.line[:, 1] > BASE * MILLIMETRE + 1e-3
    walls = [np.median(finger.inner.thickness[free]), *(rib.wall.usual for rib in finger.ribs)]
    # 3 % of a wall of 13 px is 0.4 px, and 9 % of its stiffness
    assert walls == pytest.approx([1.6e-3, *[1.2e-3] * RIBS], rel=0.03)
    assert len(finger.bolts) == 2 and finger.length == pytest.approx(LENGTH * MILLIMETRE, abs=1e-4)


@pytest.mark.parametrize(
    ("scale", "changes", "message"),
    [
        (None, {}, r"no scale; expected --scale X1,Y1,X2,Y2=50 .* or --scale MM_PER_PIXEL"),
        ("360,60,360=70", {}, "scale '360,60,360=70' for 480 x 680 pixels; expected --scale"),
        ("360,60,360,60=70", {}, "expected --scale"),
        ("360,60,360,6200=70", {}, "expected --scale"),
        ("0.125", {}, "two similar pieces at .*, expected one on a plain ground, marks on the ruler"),
        ("360,60,360,620=700", {}, "mm long at 0.8 pixels a millimetre, expected a finger of 20 to 300 mm"),
        ("360,60,360,540=60", {"shown": np.s_[:600]}, "the edge of the picture cuts its largest piece"),
        (TWO_MARKS, {"light": (0.025, 0.02, 0.02)}, "nothing stands out beside the ruler"),
    ],
)
def test_a_photograph_that_shows_no_whole_finger_to_scale_is_refused(tmp_path, scale, changes, message):
    with pytest.raises(JawFileError, match=message):
        read_photo(photograph(tmp_path / "finger.jpg", **changes), scale)


def test_a_photographed_finger_states_how_sure_its_stiffness_is(tmp_path, capsys):
    path, output = photograph(tmp_path / "finger.jpg"), tmp_path / "out.yaml"
    command = ["jaw", str(path), "-o", str(output), "--width", "20"]
    assert main([*command, "--unit", "mm"]) == 2
    assert "finger.jpg: expected --unit, or of a photograph --scale" in capsys.readouterr().err
    assert main([*command, "--scale", TWO_MARKS]) == 0
    found = re.search(r"walls (.*) pixels across: a stiffness \+- (.*)%\n", capsys.readouterr().out)
    across, doubt = float(found[1]), 0.01 * float(found[2])
    assert across == pytest.approx(
        1.2 * PER_MM, rel=0.03
    )  # blur over 1 px leaves 0.5 px of them, of stiffness thrice that
    assert doubt == pytest.approx(1.5 / across, rel=0.2)
    assert load_jaw(output).material.spread == pytest.approx(np.hypot(0.3, doubt), abs=0.01)
    polygon = shapely.affinity.scale(draw_polygon(), MILLIMETRE, MILLIMETRE, origin=(0, 0))
    finger = recognize(polygon, WIDTH * MILLIMETRE, Overrides())
    assert _find_wall_error(finger, Photo([], 1e-4, 2e-4, True)) > 1.0  # a camera sees the sides of dark walls, too
    with pytest.raises(JawFileError, match="walls are 4.0 pixels across, expected at least 5"):
        _find_wall_error(finger, Photo([], 3e-4, 6e-4, False))


def test_the_command_writes_a_jaw_that_loads(tmp_path, capsys, surface):
    surface.export(tmp_path / "my_finger.stl")
    output = tmp_path / "made" / "my_finger.yaml"
    found = tmp_path / "found.json"
    words = ["-o", str(output), "--material", "tpu85a", "--json", str(found)]
    assert main(["jaw", str(tmp_path / "my_finger.stl"), *words]) == 0
    assert str(output) in json.loads(found.read_text())["files"]
    said = capsys.readouterr().out
    for word in ("unit: mm", "prismatic", "inner face", "clamped below", "4 ribs", "19 key points", "tpu85a: 12 MPa"):
        assert word in said
    jaw = load_jaw(output)
    assert jaw.name == "my_finger"
    assert jaw.keypoint_names[0] == "inner_1" and jaw.keypoint_names[8] == "tip"
    np.testing.assert_allclose(jaw.keypoints[:, 1], 0.5 * WIDTH * MILLIMETRE)
    assert 0.0 < jaw.reference_point[2] < jaw.section.clamped_z
    assert output.with_suffix(".png").stat().st_size > 20_000
    assert len(output.read_text().splitlines()) < 35


def test_of_few_key_points_those_between_are_taken_too(tmp_path, surface):
    polygon = shapely.affinity.scale(draw_polygon(), MILLIMETRE, MILLIMETRE, origin=(0, 0))
    finger = recognize(polygon, WIDTH * MILLIMETRE, Overrides())
    points = choose_keypoints(finger)
    assert list(points)[9:14] == ["inner_clamp_1", "inner_1_2", "inner_2_3", "inner_3_4", "inner_4_tip"]
    for name, (x, _, z) in list(points.items())[9:]:
        band, below, above = name.split("_")
        ends = [points[end if end == "tip" else f"{band}_{end}"][2] for end in (below, above) if end != "clamp"]
        assert z == pytest.approx(np.mean([*ends, finger.clamped_z][:2]))
        assert finger.polygon.contains(shapely.Point(x, z))
    others = [replace(rib, inner=rib.inner + [0.0, 2.5e-3], outer=rib.outer + [0.0, 2.5e-3]) for rib in finger.ribs]
    many = replace(finger, ribs=[*finger.ribs, *others])
    assert len(choose_keypoints(many)) == 17


def test_a_curved_inner_face_is_taken(tmp_path, capsys):
    """The straighter side is guessed to be the inner face; a user who knows better says so."""
    path = tmp_path / "bulge.json"
    loops = [ring.tolist() for ring in order_rings(draw_polygon(bulge=1.5))]
    path.write_text(json.dumps({"unit": "mm", "width": 20, "loops": loops}))
    faces = {}
    for option in ([], ["--other-face"]):
        assert main(["jaw", str(path), "-o", str(tmp_path / "finger.yaml"), *option]) == 0
        faces[len(option)] = load_jaw(tmp_path / "finger.yaml").face
    assert "inner face curved: it leaves its plane by" in capsys.readouterr().out
    assert faces[0].is_flat and not faces[1].is_flat
    free = faces[1].heights < LENGTH * MILLIMETRE - 5e-3
    assert np.ptp(faces[1].x[free]) > 1e-3


def test_candidates_end_where_a_flat_inner_face_does(tmp_path):
    """Above a notch in the inner face there is a nose, which is off the plane of the face."""
    outline = shapely.Polygon([(0.0, 0.0), (16.0, 0.0), (16.0, 44.0), (11.0, 45.0), (12.0, 54.0), (0.0, 36.0)])
    room = outline.buffer(-1.2, join_style="mitre").intersection(shapely.box(-50.0, 10.0, 50.0, 90.0))
    for z in (18.0, 26.0, 34.0):
        room = room.difference(shapely.box(-50.0, z, 50.0, z + 1.0))
    loops = [ring.tolist() for ring in order_rings(outline.difference(room))]
    (tmp_path / "notch.json").write_text(json.dumps({"unit": "mm", "width": 12, "loops": loops}))
    make_jaw(tmp_path / "notch.json", tmp_path / "jaw.yaml", Overrides(name="notch"))
    jaw = load_jaw(tmp_path / "jaw.yaml")
    assert shapely.distance(jaw.section.polygon.exterior, shapely.points(jaw.candidates[:, [0, 2]])).max() < 1e-4
    assert 38e-3 < jaw.candidates[:, 2].max() < 44e-3


def test_another_origin_is_another_number_alone(tmp_path, surface):
    """Key points keep their places on the finger wherever x = 0 is."""
    surface.export(tmp_path / "finger.stl")
    jaws = []
    for options in ([], ["--face-x", "20"]):
        assert main(["jaw", str(tmp_path / "finger.stl"), "-o", str(tmp_path / "finger.yaml"), *options]) == 0
        jaws.append(load_jaw(tmp_path / "finger.yaml"))
    shift = np.array([jaws[1].inner_face_x - jaws[0].inner_face_x, 0.0, 0.0])
    assert jaws[1].inner_face_x == pytest.approx(0.02)
    np.testing.assert_allclose(jaws[1].keypoints, jaws[0].keypoints + shift, atol=2e-5)


def holed_plate():
    plate = shapely.box(0.0, 0.0, 30.0, 90.0)
    for z in (15.0, 35.0, 55.0, 75.0):
        plate = plate.difference(shapely.box(2.0, z - 9.0, 28.0, z + 9.0))
    return plate


def crossing_loops():
    return json.dumps({"unit": "mm", "loops": [[[0, 0], [30, 60], [30, 0], [0, 60]]]})


def test_no_fin_ray_finger_is_refused(tmp_path, capsys):
    polygon = draw_polygon()
    wedge = shapely.Polygon(order_rings(polygon)[0])
    cases = {
        "wedge": (wedge, "its section has 0 cells between ribs and 0 round holes, expected at least two cells"),
        "plate": (holed_plate(), "30 mm wide at one end and 30 mm at the other, expected a tip that is narrower"),
    }
    for name, (shape, message) in cases.items():
        name, *options = name.split()
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps({"unit": "mm", "width": 20, "loops": [r.tolist() for r in order_rings(shape)]}))
        assert main(["jaw", str(path), "-o", str(tmp_path / "out.yaml"), *options]) == 2
        said = capsys.readouterr().err
        assert len(said.splitlines()) == 1
        assert re.search(message, said), said
    assert not (tmp_path / "out.yaml").exists()


# a surface that is part of itself crashes the reader
LOOP = "ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\n#1=SHELL_BASED_SURFACE_MODEL('',(#1));\nENDSEC;\nEND-ISO-10303-21;\n"


def test_bad_files_are_refused_in_one_line(tmp_path, capsys, surface):
    open_one = surface.copy()
    open_one.update_faces(np.arange(len(open_one.faces)) > len(open_one.faces) // 2)
    open_one.export(tmp_path / "open.stl")
    surface.export(tmp_path / "whole.stl")
    whole = (tmp_path / "whole.stl").read_bytes()
    (tmp_path / "cut.stl").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "huge.stl").write_bytes(b"\0" * 80 + (10_000_000).to_bytes(4, "little") + b"\0" * 200)
    (tmp_path / "noise.stl").write_bytes(np.random.default_rng(0).bytes(5000))
    (tmp_path / "noise.obj").write_bytes(np.random.default_rng(0).bytes(5000))
    (tmp_path / "noise.dxf").write_bytes(np.random.default_rng(0).bytes(5000))
    (tmp_path / "noise.svg").write_bytes(np.random.default_rng(0).bytes(5000))
    (tmp_path / "loop.step").write_text(LOOP)
    (tmp_path / "cross.json").write_text(crossing_loops())
    (tmp_path / "text.txt").write_text("a finger")
    cases = {
        "open.stl": "open and 0 doubled edges, expected a closed one: repair it",
        "cut.stl": "expected 1 to 2000000 of a whole .stl file|cannot be read",
        "huge.stl": "expected 1 to 2000000 of a whole .stl file|cannot be read",
        "noise.stl": "expected 1 to 2000000 of a whole .stl file|cannot be read",
        "noise.obj": "expected 1 to 2000000 of a whole .obj file|cannot be read",
        "loop.step": "loop.step: .* expected a whole .step file",
        "noise.dxf": "noise.dxf: made its reader fail",
        "noise.svg": "noise.svg: made its reader fail",
        "cross.json": "touches or crosses itself",
        "text.txt": "files of this kind are not read; expected one of .stl",
        "none.stl": "there is no file",
    }
    for name, message in cases.items():
        assert main(["jaw", str(tmp_path / name), "-o", str(tmp_path / "out.yaml")]) == 2, name
        said = capsys.readouterr().err
        assert len(said.splitlines()) == 1, said
        assert re.search(message, said), said


@pytest.mark.parametrize(
    ("option", "message"),
    [("--width=0.025", "--width: 0.025: expected millimetres, such as 25"), ("--clamp=2000", "millimetres")],
)
def test_metres_in_options_are_refused(tmp_path, capsys, surface, option, message):
    surface.export(tmp_path / "finger.stl")
    with pytest.raises(SystemExit, match="2"):
        main(["jaw", str(tmp_path / "finger.stl"), "-o", str(tmp_path / "out.yaml"), option])
    assert message in capsys.readouterr().err


def test_step_without_its_reader_says_what_to_install(tmp_path, capsys, monkeypatch):
    (tmp_path / "cascadio.py").write_text("raise ImportError")
    monkeypatch.syspath_prepend(tmp_path)  # handed on to the process that reads the file
    (tmp_path / "finger.step").write_text("ISO-10303-21;")
    assert main(["jaw", str(tmp_path / "finger.step")]) == 2
    assert "needs cascadio: pip install cascadio" in capsys.readouterr().err
