"""Claims about fingers that are given by their section: meshes, the plane model, jaw files, truth."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from estimator_fakes import SMOOTH
from mechanics_fakes import compute_volume
from section_fakes import BASE, LENGTH, MILLIMETRE, TPU, draw_keypoints, draw_polygon, make_section, write_section_jaw

from finforce_ifea.errors import CalibrationError, JawFileError, MeshError
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.fem.plane import PlaneModel
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw import list_shipped_jaws, load_jaw
from finforce_ifea.jaw.jaw_file import MATERIALS, Material
from finforce_ifea.jaw.section_mesh import extrude_section, mesh_section
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.reduced.build import Face, has_own_rows
from finforce_ifea.reduced.cache import name_manifold
from finforce_ifea.settings import EstimatorSettings
from lab.presses import RigidCylinder, press_jaw

DATA = Path(__file__).parents[1] / "data"


def triangle_areas(plane):
    a, b, c = np.moveaxis(plane.points[plane.triangles[:, :3]], 1, 0)
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


@pytest.mark.parametrize("share", [2.0, 1.0, 0.6])
def test_triangles_fill_the_section_once(share):
    section = make_section(draw_polygon(bolts=()))
    areas = triangle_areas(mesh_section(section, share))
    assert areas.min() > 0.0
    # bends by less than 25 degrees count as curves, of which corners are cut off
    assert areas.sum() == pytest.approx(section.polygon.area, rel=5e-4)


def test_curves_have_twelve_elements_a_turn():
    plane = mesh_section(make_section())
    polygon = make_section().polygon
    assert triangle_areas(plane).sum() == pytest.approx(polygon.area, rel=2e-3)
    around = plane.points[: plane.corners] - MILLIMETRE * np.array([8.0, 5.0])
    on_bolt = np.abs(np.hypot(*around.T) - 1.5e-3) < 2e-5
    assert on_bolt.sum() >= 10


def test_every_edge_of_the_outline_is_an_edge_of_the_mesh():
    plane = mesh_section(make_section(draw_polygon(bolts=())))
    edges = np.sort(plane.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    rows, count = np.unique(edges, axis=0, return_counts=True)
    boundary = rows[count == 1]
    assert count.max() == 2
    length = np.linalg.norm(np.diff(plane.points[boundary], axis=1)[:, 0], axis=1).sum()
    assert length == pytest.approx(make_section(draw_polygon(bolts=())).polygon.length, rel=5e-4)


def test_many_thin_ribs_are_divided_one_after_another():
    """Points that halve the edges of one rib are too close to those of the next, up to the tip."""
    whole, room = shapely.box(0.0, 0.0, 16.0, 60.0), shapely.box(0.6, 10.0, 15.4, 59.4)
    for z in np.arange(-10.0, 78.0, 1.2):
        room = room.difference(shapely.LineString([(-10.0, z - 2.0), (26.0, z + 5.0)]).buffer(0.19, cap_style="flat"))
    holes = [part for part in shapely.get_parts(room) if part.length > 3.0]
    section = make_section(shapely.Polygon(whole.exterior, [hole.exterior for hole in holes]))
    areas = triangle_areas(mesh_section(section, 2.0))
    assert len(holes) > 40 and areas.sum() == pytest.approx(section.polygon.area, rel=5e-3)


def test_extruded_finger_has_its_volume_and_mirrors_itself():
    section = make_section(draw_polygon(bolts=()))
    mesh = extrude_section(section, 2.0)
    assert compute_volume(mesh) == pytest.approx(section.polygon.area * section.width, rel=5e-4)
    assert SolidModel(mesh, TPU).symmetric
    assert mesh.nodes[mesh.clamped, 2].max() <= MILLIMETRE * BASE + 1e-9
    free = np.setdiff1d(np.arange(len(mesh.nodes)), mesh.clamped)
    # a middle node goes with both ends of its edge
    assert mesh.nodes[free, 2].min() > MILLIMETRE * (BASE - 2.0)


def test_bolts_hold_what_is_around_them():
    circle = [-0.0055, 0.030, 0.004]
    mesh = extrude_section(make_section(circles=[circle]), 1.0)
    held = mesh.nodes[mesh.clamped]
    around = np.hypot(held[:, 0] - circle[0], held[:, 2] - circle[1]) < circle[2] + 1e-9
    assert around.any()
    assert (around | (held[:, 2] <= MILLIMETRE * BASE + 1e-9)).all()


def strip(length=40.0, thickness=2.0):
    """A strip that stands upright, clamped at its foot."""
    return make_section(shapely.box(-0.5 * thickness, 0.0, 0.5 * thickness, length), clamped_z=0.0)


def plane_model(section, material=TPU, share=1.0):
    return PlaneModel(extrude_section(section, share), mesh_section(section, share), section, material)


def test_strip_bends_as_in_plane_strain():
    """Deflection P L^3 / (3 E' I) and shear (1 + nu) P L 12 / (5 E A), E' = E / (1 - nu^2)."""
    section, material = strip(), Material(young_modulus=26.0e6, poisson_ratio=0.3)
    model = plane_model(section, material, 0.6)
    top = np.array([[x, 0.0, 0.04] for x in (-1e-3, 0.0, 1e-3)])
    probe, rest = model.attach(top), np.zeros(model.size)
    load = model.load(probe, rest, np.array([[1.0, 0.0, 0.0]] * 3) / 3.0 * 1e-3)
    q = model.factorise(model.linearize(rest).tangent).solve(load)
    inertia, area = 0.02 * 0.002**3 / 12.0, 0.02 * 0.002
    modulus = material.young_modulus / (1.0 - 0.3**2)
    bent = 1e-3 * 0.04**3 / (3.0 * modulus * inertia) + 1e-3 * 0.04 * 2.6 * 1.2 / (material.young_modulus * area)
    assert model.project(probe, rest, q[:, None])[1, 0, 0] == pytest.approx(bent, rel=0.01)


def test_tangent_is_the_derivative_of_the_force_and_force_that_of_the_energy():
    model = plane_model(make_section(), share=2.0)
    rng = np.random.default_rng(0)
    q, v = 2e-5 * rng.normal(size=model.size), 1e-9 * rng.normal(size=model.size)
    state = model.linearize(q)
    ahead, behind = (model.linearize(q + s * v) for s in (1.0, -1.0))
    change = 0.5 * (ahead.force - behind.force)
    np.testing.assert_allclose(model.sparse_tangent(state.tangent) @ v, change, atol=1e-6 * np.abs(change).max())
    assert 0.5 * (ahead.energy - behind.energy) == pytest.approx(state.force @ v, rel=1e-6)


def test_a_turn_costs_nothing():
    """A strip without a clamp in its way: all nodes turned by a radian hold no energy."""
    model = plane_model(make_section(), share=2.0)
    angle = 1.0
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    moved = model.plane.points @ turn.T - model.plane.points
    force = np.zeros_like(moved)
    from finforce_ifea.fem.plane import _add_triangles

    triangles = model.plane.triangles
    energy, smallest = _add_triangles(moved, triangles, model._points, model._moduli, force, model._Ke)
    assert energy < 1e-20 and smallest == pytest.approx(1.0)
    assert np.abs(force).max() < 1e-9


@pytest.fixture(scope="module")
def jaw(tmp_path_factory):
    return load_jaw(write_section_jaw(tmp_path_factory.mktemp("jaw")))


def press(mechanics, jaw, height=0.04, depth=2e-3):
    depths = np.linspace(0.5 * depth, depth, 2)
    model, surface = mechanics.model, mechanics.contact.surface
    return press_jaw(model, surface, jaw.inner_face_x, RigidCylinder(radius=12.5e-3), height, depths)[-1]


def test_plane_model_has_the_solid_finger_s_force(jaw):
    """The section in plane strain, its modulus lowered to the solid's stiffness at rest, against the solid."""
    settings = EstimatorSettings(mesh="coarse")
    plane, solid = (build_mechanics(jaw, replace(settings, solver=name)) for name in ("plane", "solid"))
    assert plane.model.size < 0.4 * solid.model.size
    for height in (0.03, 0.05):
        forces = [press(mechanics, jaw, height).force for mechanics in (plane, solid)]
        np.testing.assert_allclose(forces[0], forces[1], atol=0.02 * np.linalg.norm(forces[1]))


@pytest.mark.parametrize(("name", "places"), [("plane", (0.0303, 0.0391, 0.0507)), ("solid", (0.0391,))])
def test_no_load_is_lost_between_two_rows(tmp_path, name, places):
    """Rows are farther apart than nodes: what presses between two of them stands on both."""
    table = {"file": "finger.section.json", "width": 0.02, "size": 0.6e-3, "clamped": {"z_below": 0.012}}
    jaw = load_jaw(write_section_jaw(tmp_path, section=table))
    mechanics = build_mechanics(jaw, EstimatorSettings(solver=name, mesh="coarse"))
    assert not has_own_rows(mechanics)
    heights = np.linspace(0.012, 0.068, 30)
    face = Face(mechanics, heights[1:])
    for height in places:
        pressed = press(mechanics, jaw, height)
        load = face.describe(pressed.q)["loads"].reshape(-1, 2)
        np.testing.assert_allclose(load.sum(0), pressed.force[[0, 2]], atol=2e-3 * np.linalg.norm(pressed.force))
        assert load[:, 0] @ heights[1:] / load[:, 0].sum() == pytest.approx(pressed.pressure_location[2], abs=2e-4)


TAPER = [0.0, -0.2]


def test_tapered_finger_has_its_volume_and_its_plane_model_the_solid_s_force(tmp_path):
    table = {"file": "finger.section.json", "width": 0.02, "taper": TAPER, "clamped": {"z_below": 0.012}}
    points = {name: [x, 0.5 * (0.02 - 0.2 * z), z] for name, (x, _, z) in draw_keypoints().items()}
    jaw = load_jaw(write_section_jaw(tmp_path, section=table, keypoints=points))
    middle = np.array(jaw.section.polygon.centroid.coords[0])
    volume = jaw.section.polygon.area * float(jaw.section.read_width(middle))
    assert compute_volume(jaw.build_mesh("coarse")) == pytest.approx(volume, rel=2e-3)
    settings = EstimatorSettings(mesh="coarse")
    plane, solid = (build_mechanics(jaw, replace(settings, solver=name)) for name in ("plane", "solid"))
    assert plane.model._points[1].sum() == pytest.approx(volume, rel=2e-3)
    assert solid.model.symmetric
    for height in (0.03, 0.05):
        forces = [press(mechanics, jaw, height).force for mechanics in (plane, solid)]
        np.testing.assert_allclose(forces[0], forces[1], atol=0.025 * np.linalg.norm(forces[1]))


def test_plane_model_of_a_drawing_is_refused():
    with pytest.raises(
        JawFileError, match="the jaw 'bench' is not a section, which solver plane needs; expected solver"
    ):
        build_mechanics(load_jaw("bench"), EstimatorSettings(solver="plane"))


def test_both_sides_share_their_equilibria(jaw):
    settings = EstimatorSettings(solver="plane", mesh="coarse")
    sides = [item for item in (jaw, jaw.mirrored())]
    mechanics = [build_mechanics(item, settings) for item in sides]
    names = [name_manifold(full, item) for full, item in zip(mechanics, sides, strict=True)]
    assert names[0] == names[1]
    assert (mechanics[0].model.dof == mechanics[1].model.dof).all()
    other = replace(jaw, section=replace(jaw.section, width=0.03))
    assert name_manifold(build_mechanics(other, settings), other) != names[0]


def test_contact_surface_begins_at_the_clamp(jaw):
    surface = build_mechanics(jaw, EstimatorSettings(solver="plane", mesh="coarse")).contact.surface
    assert 0.010 < surface.heights[0] < 0.0125
    assert (surface.points[:, 1] == 0.0).all()


BULGE = 1.5


@pytest.fixture(scope="module")
def curved(tmp_path_factory):
    """A finger whose inner face bulges by 1.5 mm."""
    folder = tmp_path_factory.mktemp("curved")
    return load_jaw(write_section_jaw(folder, draw_polygon(bulge=BULGE)))


def test_curved_face_is_a_line_of_its_own(curved, jaw):
    assert jaw.face.is_flat and not curved.face.is_flat
    z = np.array([0.020, 0.041, 0.060])
    drawn = 0.014 + 1e-3 * BULGE * np.sin(np.pi * (1e3 * z - BASE) / (LENGTH - BASE))
    np.testing.assert_allclose(curved.face.read(z), drawn, atol=2e-5)
    assert curved.inner_face_x == pytest.approx(0.014 + 1e-3 * BULGE, abs=2e-5)
    np.testing.assert_allclose(curved.candidates[:, 0], curved.face.read(curved.candidates[:, 2]))


def test_first_touch_of_a_curved_face_is_where_it_stands_out(curved):
    """A small rod beside the middle touches as much deeper as the face recedes there, less what is beside it."""
    contact = build_mechanics(curved, EstimatorSettings(solver="plane", mesh="coarse")).contact
    radius, places = 1e-3, {}
    for height in (0.022, 0.041, 0.060):
        place = np.array([0.0, radius, height])
        places[height] = contact.find_touch(place)
        gap = contact.indenter.find_gap(contact.place_points(np.zeros(contact.model.size)), contact.face_x, place)
        assert gap > -1e-6
        place[0] = places[height] + 2e-5
        assert contact.indenter.find_gap(contact.surface.points, contact.face_x, place) < 0.0
    assert places[0.041] == pytest.approx(0.0, abs=2e-5)
    for height in (0.022, 0.060):
        assert places[height] == pytest.approx(curved.inner_face_x - curved.face.read(height), abs=1e-4)


def test_curved_face_has_the_solid_finger_s_force(curved):
    settings = EstimatorSettings(mesh="coarse")
    plane, solid = (build_mechanics(curved, replace(settings, solver=name)) for name in ("plane", "solid"))
    for height in (0.03, 0.05):
        forces = [press(mechanics, curved, height, depth=3e-3).force for mechanics in (plane, solid)]
        assert np.linalg.norm(forces[1]) > 0.2
        np.testing.assert_allclose(forces[0], forces[1], atol=0.03 * np.linalg.norm(forces[1]))


@pytest.mark.parametrize("height", [0.030, 0.052])
def test_force_on_a_curved_face_is_estimated(curved, height):
    """Key points of the plane model under a rod, by stored equilibria: within 3 % and three deviations."""
    settings = EstimatorSettings(solver="reduced", mesh="coarse", radius=0.0125, radius_stddev=0.6e-3, **SMOOTH)
    modelled = replace(curved, material=curved.material.model_copy(update={"spread": 0.0}))
    estimator = ForceEstimator(modelled, settings=settings)
    mechanics = build_mechanics(modelled, replace(settings, solver="plane"))
    probe = mechanics.model.attach(curved.keypoints, 3e-3)
    depths = np.linspace(0.25e-3, 4e-3, 16)
    rod = RigidCylinder(radius=12.5e-3)
    presses = press_jaw(mechanics.model, mechanics.contact.surface, curved.inner_face_x, rod, height, depths)
    points = [curved.keypoints] * 50 + [mechanics.model.positions(probe, item.q) for item in presses for _ in range(6)]
    contact = Contact.fixed(curved, height)
    for number, place in enumerate(points):
        seen = Observation(stamp=number / 30.0, points=place, likelihood=np.ones(len(place)))
        solution = estimator.update(seen, contact)
    assert solution.status == "ok"
    true = presses[-1].force
    assert np.linalg.norm(true) > 0.4
    assert np.linalg.norm(solution.force - true) < 0.03 * np.linalg.norm(true)


def test_truth_of_the_ssg48_finger_is_met():
    """Forces and inner face of an independent program (CalculiX, 15-node wedges, E = 30 MPa), 1 to 3 mm deep."""
    truth = np.load(DATA / "pressed_ssg48.npz")
    jaw = load_jaw("ssg48_fin_ray_1")
    jaw = replace(jaw, material=Material(young_modulus=30.0e6, poisson_ratio=0.45))
    mechanics = build_mechanics(jaw, EstimatorSettings(solver="plane"))
    shift = np.array([jaw.inner_face_x - 0.014, 0.0, 0.0])
    for height in (32, 44):
        depths = np.arange(0.5, 3.01, 0.5) * 1e-3
        presses = press_jaw(
            mechanics.model,
            mechanics.contact.surface,
            jaw.inner_face_x,
            RigidCylinder(radius=12.5e-3),
            height * 1e-3,
            depths,
        )[1::2]
        probe = mechanics.model.attach(truth[f"rest_{height}"] + shift, 1e-3)
        for state, force, face in zip(presses, truth[f"force_{height}"], truth[f"face_{height}"], strict=True):
            # its clamp ends between nodes, within 0.6 mm of where it should
            assert np.linalg.norm(state.force - force) < 0.045 * np.linalg.norm(force)
            off = np.linalg.norm(mechanics.model.positions(probe, state.q) - shift - face, axis=1)
            assert np.sqrt(np.mean(off**2)) < 0.05e-3 and off.max() < 0.15e-3


@pytest.mark.parametrize("name", [name for name in list_shipped_jaws() if name not in ("bench", "steel")])
def test_shipped_sections_can_be_built(name):
    jaw = load_jaw(name)
    mesh = jaw.build_mesh("coarse")
    model = PlaneModel(mesh, jaw.build_plane("coarse"), jaw.section, jaw.material)
    assert model.size > 500
    model.attach(jaw.keypoints, 3e-3)
    assert len(jaw.keypoints) >= 7 and jaw.material.spread > 0.0


BAD_SECTIONS = [
    ({"section": {"file": "finger.section.json", "width": 0.02}}, "section.clamped is missing"),
    ({"section": {"file": "none.json", "width": 0.02, "clamped": {"z_below": 0.01}}}, "no section file none.json"),
    ({"section": {"file": "finger.section.json", "clamped": {"z_below": 0.01}}}, "section.width: got None"),
    ({"section": {"file": "finger.section.json", "width": -0.02, "clamped": {"z_below": 0.01}}}, "section.width: got"),
    ({"section": {"file": "finger.section.json", "width": 20.0, "clamped": {"z_below": 0.01}}}, "like millimetres"),
    ({"section": {"file": "finger.section.json", "width": 0.02, "clamped": {}}}, "expected z_below, or circles"),
    (
        {"section": {"file": "finger.section.json", "width": 0.02, "taper": 0.1, "clamped": {"z_below": 0.012}}},
        "section.taper: got 0.1, expected",
    ),
    (
        {"section": {"file": "finger.section.json", "width": 0.01, "taper": [0, -0.2], "clamped": {"z_below": 0.012}}},
        "section.taper: leaves a width of -4",
    ),
    ({"material": "cheese"}, "material: got 'cheese', expected one of tpu85a"),
    ({"model": "frame"}, "model: got frame, expected plane or solid for a section"),
    ({"candidates": [[0.0, 0.0, 0.03]]}, "lies off the inner surface"),
    ({"keypoints": {"far": [0.030, 0.0, 0.03]}}, "keypoints.far .* off the jaw"),
]


@pytest.mark.parametrize(("changes", "message"), BAD_SECTIONS)
def test_bad_jaw_file_is_refused(tmp_path, changes, message):
    with pytest.raises(JawFileError, match=message):
        load_jaw(write_section_jaw(tmp_path, **changes))


SQUARE = [[0, 0], [10, 0], [10, 10], [0, 10]]
BAD_LOOPS = [
    ("no json", "expected JSON"),
    (json.dumps({"unit": "furlong", "loops": [SQUARE]}), "expected JSON with unit"),
    (json.dumps({"unit": "mm", "loops": []}), "0 loops"),
    (json.dumps({"unit": "mm", "loops": [[[0, 0], [1, 1]]]}), r"loops\[0\] has shape \(2, 2\)"),
    (json.dumps({"unit": "mm", "loops": [[[0, 0], [1, None], [2, 2]]]}), "finite"),
    (json.dumps({"unit": "mm", "loops": [[[0, 0], [10, 10], [10, 0], [0, 10]]]}), "touches or crosses itself"),
    (json.dumps({"unit": "mm", "loops": [SQUARE, [[20, 0], [25, 0], [25, 5]]]}), "not inside the largest"),
    (
        json.dumps({"unit": "mm", "loops": [SQUARE, [[2, 2], [6, 2], [6, 6]], [[5, 3], [8, 3], [8, 6]]]}),
        "touch each other",
    ),
]


@pytest.mark.parametrize(("text", "message"), BAD_LOOPS)
def test_bad_section_file_is_refused(tmp_path, text, message):
    path = write_section_jaw(tmp_path)
    (tmp_path / "finger.section.json").write_text(text)
    with pytest.raises(JawFileError, match=message):
        load_jaw(path)


def test_elements_too_small_are_refused():
    with pytest.raises(MeshError, match="asks for .* points along its outline"):
        mesh_section(make_section(size=2e-5))


def test_material_by_name_has_its_spread(jaw):
    assert jaw.material == MATERIALS["tpu95a"]


def test_calibration_of_another_shape_is_refused(jaw, tmp_path):
    calibration = Calibration(young_modulus=20e6, jaw=jaw.name, finger=jaw.digest, solver="plane")
    assert calibration.apply(jaw).material.young_modulus == 20e6
    assert calibration.apply(jaw.mirrored()).side == "right"
    thicker = load_jaw(write_section_jaw(tmp_path, draw_polygon(rib=1.4)))
    with pytest.raises(CalibrationError, match="a finger of another shape"):
        calibration.apply(thicker)
