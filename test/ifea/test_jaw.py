"""Jaws from their files."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from mechanics_fakes import SHIPPED_BENCH, changed, content_of, write_jaw, write_mesh_jaw

from finforce_ifea.errors import MeshError
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.fem.solid import find_mirror_nodes
from finforce_ifea.jaw.jaw import list_shipped_jaws, load_jaw
from finforce_ifea.jaw.mesh import to_tet10
from finforce_ifea.settings import EstimatorSettings

STEEL = load_jaw("steel")
# As an independent finite-element program has them, in mm.
BENCH_KEYPOINTS = [
    *[(13.2, 10.0, z) for z in (9.0, 18.5, 28.0, 37.5, 47.0, 56.5, 66.0)],
    (-10.5, 10.0, 9.0),
    (-7.65, 10.0, 18.5),
    (-4.8, 10.0, 28.0),
    (-1.95, 10.0, 37.5),
    (0.9, 10.0, 47.0),
    (3.75, 10.0, 56.5),
    (6.6, 10.0, 66.0),
    (12.0, 10.0, 80.0),
]
DOCUMENT = Path(__file__).parents[2] / "docs" / "your_finger.md"


def test_bench_keypoints_are_those_of_the_independent_program():
    np.testing.assert_allclose(1e3 * SHIPPED_BENCH.keypoints, BENCH_KEYPOINTS, atol=1e-9)
    names = [f"inner_{i}" for i in range(1, 8)] + [f"outer_{i}" for i in range(1, 8)] + ["tip"]
    assert list(SHIPPED_BENCH.keypoint_names) == names


def test_bench_candidates_stand_every_five_millimetres_on_the_inner_face():
    expected = [(14.0, 0.0, 8.0 + 5.0 * i) for i in range(14)]
    np.testing.assert_allclose(1e3 * SHIPPED_BENCH.candidates, expected, atol=1e-9)
    assert SHIPPED_BENCH.inner_face_x == 0.014
    assert SHIPPED_BENCH.model == "solid"


def test_steel_hinges_are_where_they_were_measured():
    angle = np.arctan2(150.16, -73.24)
    strip_a = [(0.0, arc) for arc in (27.0, 54.0, 81.0, 108.0)]
    strip_b = [(73.24 + arc * np.cos(angle), arc * np.sin(angle)) for arc in (45.67, 78.69, 107.5, 132.27)]
    x, z = np.array(strip_a + strip_b).T
    hinges = np.column_stack([36.62 - x, z])
    np.testing.assert_allclose(1e3 * STEEL.drawing.junctions.reshape(-1, 2), hinges, atol=1e-6)
    # the screws that the pictures show sit one to three millimetres off them
    offsets = np.linalg.norm(1e3 * STEEL.keypoints[:, [0, 2]] - hinges, axis=1)
    assert (offsets > 0.5).all() and (offsets < 3.0).all()
    assert STEEL.model == "frame"
    assert STEEL.drawing.joints == "hinged"
    assert STEEL.drawing.bars == "rigid"
    assert STEEL.material.young_modulus == 213e9


def test_shipped_jaws_load_by_name_and_by_path():
    assert list_shipped_jaws() == ("bench", "ssg48_fin_ray_1", "ssg48_fin_ray_3", "steel", "umi", "xlerobot")


def test_the_modulus_of_a_printed_jaw_is_a_datasheets_and_spreads():
    printed = [jaw for jaw in map(load_jaw, list_shipped_jaws()) if jaw.material.young_modulus < 1e9]
    assert len(printed) == 5 and all(jaw.material.spread == 0.3 for jaw in printed)
    for name in list_shipped_jaws():
        jaw = load_jaw(name)
        np.testing.assert_array_equal(load_jaw(jaw.path).keypoints, jaw.keypoints)
        np.testing.assert_array_equal(load_jaw(str(jaw.path)).keypoints, jaw.keypoints)


def test_the_right_jaw_is_the_mirror_image_of_the_left():
    right = load_jaw("bench", side="right")
    mirror = np.array([1.0, -1.0, 1.0])
    np.testing.assert_array_equal(right.keypoints, SHIPPED_BENCH.keypoints * mirror)
    np.testing.assert_array_equal(right.candidates, SHIPPED_BENCH.candidates * mirror)
    assert right.side == "right"
    assert right.mirrored().side == "left"
    np.testing.assert_array_equal(right.mirrored().keypoints, SHIPPED_BENCH.keypoints)


@pytest.mark.parametrize("name", list_shipped_jaws())
def test_a_mesh_from_a_drawing_or_section_is_its_own_mirror_image(name):
    left, right = (load_jaw(name, side).build_mesh("coarse") for side in ("left", "right"))
    assert find_mirror_nodes(left) is not None
    np.testing.assert_array_equal(right.nodes, left.nodes)
    np.testing.assert_array_equal(right.elements, left.elements)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("convert", [lambda mesh: mesh, to_tet10])
def test_a_mesh_file_makes_the_same_jaw_as_its_drawing(tmp_path, side, convert):
    source = convert(SHIPPED_BENCH.build_mesh("coarse"))
    jaw = load_jaw(write_mesh_jaw(tmp_path, source), side=side)
    mesh = jaw.build_mesh()
    mirror = [1.0, 1.0, 1.0] if side == "left" else [1.0, -1.0, 1.0]
    np.testing.assert_allclose(mesh.nodes, source.nodes * mirror, atol=1e-12)
    np.testing.assert_array_equal(mesh.clamped, source.clamped)
    np.testing.assert_allclose(jaw.candidates, SHIPPED_BENCH.candidates)
    assert jaw.name == "finger"
    assert jaw.model == "solid"


def test_a_mesh_file_keeps_its_own_density(tmp_path):
    jaw = load_jaw(write_mesh_jaw(tmp_path))
    assert len(jaw.build_mesh("default").nodes) == 522
    with pytest.raises(MeshError, match="finger.vtu has its own"):
        jaw.build_mesh("fine")


def test_numbers_that_yaml_reads_as_text_are_numbers(tmp_path):
    text = SHIPPED_BENCH.path.read_text().replace("26.0e+6", "26e6")
    assert isinstance(yaml.safe_load(text)["material"]["young_modulus"], str)
    assert load_jaw(write_jaw(tmp_path, text)).material.young_modulus == 26e6


def test_points_and_candidates_can_be_listed(tmp_path):
    content = changed(content_of(SHIPPED_BENCH), "keypoints", {"root": [0.0132, 0.01, 0.009], 7: [0.012, 0.01, 0.08]})
    content = changed(content, "candidates", [[0.014, 0.0, 0.020], [0.014, 0.002, 0.040]])
    content = changed(content, "reference_point", [0.0, 0.01, 0.0])
    jaw = load_jaw(write_jaw(tmp_path, content))
    assert jaw.keypoint_names == ("root", "7")
    np.testing.assert_allclose(jaw.candidates, [[0.014, 0.0, 0.020], [0.014, 0.002, 0.040]])
    np.testing.assert_allclose(jaw.mirrored().reference_point, [0.0, -0.01, 0.0])


def test_ribs_can_tilt_and_differ_in_thickness(tmp_path):
    ribs = {"inner_z": [0.02, 0.04], "outer_z": [0.025, 0.05], "thickness": [0.001, 0.0015]}
    jaw = load_jaw(write_jaw(tmp_path, changed(content_of(SHIPPED_BENCH), "drawing.ribs", ribs)))
    assert [rib.outer_z for rib in jaw.drawing.ribs] == [0.025, 0.05]
    assert [rib.thickness for rib in jaw.drawing.ribs] == [0.001, 0.0015]
    jaw.build_mesh()


def test_a_mesh_path_is_relative_to_the_jaw_file(tmp_path, monkeypatch):
    path = write_mesh_jaw(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert len(load_jaw(path).build_mesh().nodes) == 522


def documented_examples():
    return re.findall(r"```yaml\n(.*?)```", DOCUMENT.read_text(), flags=re.DOTALL)


def test_the_examples_of_the_documentation_load(tmp_path):
    complete = [text for text in documented_examples() if "material:" in text]
    assert complete
    for text in complete:
        path = write_mesh_jaw(tmp_path)
        path.write_text(text.replace("finger.msh", "finger.vtu"))
        jaw = load_jaw(path)
        jaw.build_mesh()
        assert len(jaw.candidates) > 1


def test_a_hard_finger_is_expected_to_be_smoother_than_an_elastomer_unless_the_friction_is_stated():
    soft, hard = (EstimatorSettings().resolve_friction(load_jaw(name).material) for name in ("bench", "steel"))
    assert (soft.friction, soft.friction_stddev) == (0.45, 0.25)
    assert (hard.friction, hard.friction_stddev) == (0.35, 0.15)
    stated = EstimatorSettings(friction=0.2, friction_stddev=0.05)
    assert stated.resolve_friction(load_jaw("steel").material) == stated
    assert ForceEstimator(load_jaw("steel")).friction.mean == pytest.approx(0.35, abs=0.01)
