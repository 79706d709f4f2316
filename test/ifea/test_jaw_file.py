"""What a jaw file must not say."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_fakes import SHIPPED_BENCH, changed, content_of, write_jaw, write_mesh_jaw

from finforce.errors import FinforceError
from finforce_ifea.errors import JawFileError, MeshError
from finforce_ifea.jaw.jaw import load_jaw

POINTS = {"a": [0.0132, 0.01, 0.009]}
BAD_VALUES = [
    ("drawng", {}, "unknown key 'drawng'; did you mean 'drawing'"),
    ("drawing", ..., "got none, expected exactly one of drawing, section, mesh"),
    ("colour", "red", "unknown key 'colour'; expected one of name, model, drawing"),
    ("inner_face_x", 0.014, "inner_face_x: a drawing has its own, expected none"),
    ("drawing.lenght", 0.08, "drawing: unknown key 'lenght'; did you mean 'length'"),
    (
        "drawing.inner_band.thikness",
        0.1,
        "drawing.inner_band: unknown key 'thikness'; did you mean 'thickness'",
    ),
    ("drawing.ribs.inner_zz", [0.1], "drawing.ribs: unknown key 'inner_zz'"),
    ("drawing.tip.from", 0.1, "drawing.tip: unknown key 'from'"),
    ("material.youngs_modulus", 1e7, "material: unknown key 'youngs_modulus'; did you mean 'young_modulus'"),
    ("keypoints.side", 0.01, "keypoints: unknown key 'side'; did you mean 'side_y'"),
    ("candidates.step", 0.01, "candidates: unknown key 'step'; did you mean 'step_z'"),
    ("mesh", {"file": "a.msh", "clamped": {"z_below": 0.0}}, "got drawing and mesh, expected exactly one"),
    ("material", ..., "material is missing"),
    ("drawing.width", ..., "drawing.width is missing"),
    ("drawing.outer_band.face_x", ..., "drawing.outer_band: got none"),
    ("drawing.outer_band.centre_x", 0.0, "got face_x and centre_x"),
    ("drawing.ribs.thickness", ..., "drawing.ribs.thickness is missing"),
    ("drawing.ribs.z", ..., "drawing.ribs: got none"),
    ("material.poisson_ratio", ..., "material.poisson_ratio is missing"),
    ("candidates.count", ..., "candidates.count is missing"),
    ("drawing", [1, 2], "drawing: got a list"),
    ("drawing.ribs", "seven", "drawing.ribs: got the text 'seven', expected a mapping"),
    ("drawing.length", "long", "drawing.length: got the text 'long', expected a valid number"),
    ("drawing.length", None, "drawing.length: got nothing, expected a valid number"),
    ("drawing.length", True, "drawing.length: got the switch True"),
    ("drawing.width", [0.02], "drawing.width: got a list"),
    ("drawing.tip", "soft", "drawing.tip: got 'soft', expected rigid or"),
    ("drawing.joints", "glued", "drawing.joints: got the text 'glued', expected 'stiff' or 'hinged'"),
    ("drawing.outer_band.face_x", [0.0, 0.0, 0.0], "got a list .*, expected at most 2 items"),
    ("drawing.ribs.thickness", [0.001, 0.001], "got 7 inner ends, 7 outer ends and 2 thicknesses"),
    ("name", 7, "name: got 7, expected a valid string"),
    ("model", "shell", "model: got the text 'shell', expected 'solid', 'frame' or 'plane'"),
    ("candidates.count", 2.5, "candidates.count: got 2.5"),
    ("candidates.count", 0, "candidates.count: got 0"),
    ("candidates.count", 10**12, "candidates.count: got 1e.12, expected less than or equal to 10000"),
    ("candidates", [], "candidates: got none"),
    ("candidates", 4, "candidates: got 4"),
    ("keypoints", {}, "keypoints: got none"),
    ("keypoints", [[0, 0, 0]], "keypoints: got a list"),
    ("keypoints", {"a": [0.0132, 0.01]}, r"keypoints.a: got a list .* expected a point \[x, y, z\]"),
    ("keypoints.rule", "corners", "keypoints.rule: got the text 'corners'"),
    ("keypoints.tip", "yes please", "keypoints.tip: got the text 'yes please', expected a valid boolean"),
    ("drawing.length", float("nan"), "drawing.length: got nan, expected a finite number"),
    ("material.young_modulus", float("inf"), "material.young_modulus: got inf"),
    ("keypoints", {"a": [0.0132, float("nan"), 0.009]}, r"keypoints.a\[1\]: got nan"),
    ("reference_point", [0.0, 0.0, float("-inf")], r"reference_point\[2\]: got -inf"),
    ("drawing.length", 80.0, "drawing.length: got 80, which looks like millimetres; .* such as 0.08"),
    ("drawing.inner_band.face_x", 14.0, r"drawing.inner_band.face_x\[0\]: got 14, which looks like millimetres"),
    ("drawing.inner_band.thickness", 1.6, "inner_band.thickness: got 1.6, which looks like millimetres"),
    ("drawing.ribs.thickness", 0.2, r"ribs.thickness\[0\]: got 0.2, which looks like millimetres"),
    ("drawing.ribs.z", [9.0, 18.5], r"drawing.ribs.z\[0\]: got 9, which looks like millimetres"),
    ("drawing.tip.solid_from_z", 74, "solid_from_z: got 74, which looks like millimetres"),
    ("candidates.first_z", 8.0, "candidates.first_z: got 8, which looks like millimetres"),
    ("candidates", [[14.0, 0.0, 20.0]], r"candidates\[0\]\[0\]: got 14, which looks like millimetres"),
    ("keypoints", {"a": [13.2, 10.0, 9.0]}, r"keypoints.a\[0\]: got 13.2, which looks like millimetres"),
    ("material.young_modulus", 26.0, "looks like MPa; expected Pa, such as 2.600e"),
    ("material.young_modulus", -1.0, "material.young_modulus: got -1, expected greater than 0"),
    ("material.poisson_ratio", 0.5, "poisson_ratio: got 0.5, expected less than 0.5"),
    ("material.poisson_ratio", -1.0, "poisson_ratio: got -1"),
    ("drawing.length", -0.08, "drawing.length: got -0.08"),
    ("drawing.width", 0.0, "drawing.width: got 0.0, expected a positive length"),
    ("drawing.tip.solid_from_z", 0.09, "drawing.tip: solid from z = 0.09"),
    ("candidates", [[0.014, 0, 0.02], [0.013, 0, 0.03]], r"candidates\[1\] at \(13.000, 0.000, 30.000\) mm"),
    ("candidates.step_z", 0.007, r"candidates\[11\] .* off the inner surface"),
    ("candidates.y", 0.011, r"candidates\[0\] .* off the inner surface; expected y from -0.01 to 0.01"),
    ("keypoints", {**POINTS, "b": [0.0, 0.01, 0.014]}, r"keypoints.b at .* is 4 mm off the jaw"),
    ("keypoints.side_y", 0.02, "keypoints.inner_1 at .* is 10 mm off the jaw"),
    ("drawing.joints", "hinged", "model: got solid, expected frame for this drawing"),
]


@pytest.mark.parametrize(("place", "value", "words"), BAD_VALUES)
def test_bad_value_is_refused_by_name(tmp_path, place, value, words):
    path = write_jaw(tmp_path, changed(content_of(SHIPPED_BENCH), place, value))
    with pytest.raises(JawFileError, match="^finger.yaml: .*" + words):
        load_jaw(path)


def test_everything_in_millimetres_is_refused(tmp_path):
    def scaled(value):
        if isinstance(value, dict):
            return {key: scaled(item) for key, item in value.items()}
        if isinstance(value, list):
            return [scaled(item) for item in value]
        return 1e3 * value if isinstance(value, float) else value

    with pytest.raises(JawFileError, match="looks like millimetres"):
        load_jaw(write_jaw(tmp_path, scaled(content_of(SHIPPED_BENCH))))


def test_a_misspelt_key_gets_a_suggestion_before_the_right_one_is_missed(tmp_path):
    text = SHIPPED_BENCH.path.read_text().replace("drawing:", "drawng:")
    with pytest.raises(JawFileError, match="unknown key 'drawng'; did you mean 'drawing'"):
        load_jaw(write_jaw(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("# nothing\n", "is empty"),
        ("- 1\n- 2\n", "got a list .*, expected a mapping of name"),
        ("finger", "got the text 'finger', expected a mapping of name"),
        ("a: [1, 2\nb: 3", "is not valid YAML"),
        ("a: 1\na: 2\n", "'a' stands twice"),
        ("m: {b: 1, b: 2}\n", "'b' stands twice"),
        ("when: 2024-99-99\n", "is not valid YAML"),
        ("[" * 5000, "is nested more than 50 deep"),
        ("? [1, 2]\n: 3\n", "is not valid YAML"),
        ("a: !!python/object/apply:os.system ['true']\n", "is not valid YAML"),
    ],
)
def test_what_is_no_mapping_is_refused(tmp_path, text, words):
    with pytest.raises(JawFileError, match="^finger.yaml: .*" + words):
        load_jaw(write_jaw(tmp_path, text))


def test_a_binary_file_is_refused(tmp_path):
    path = tmp_path / "finger.yaml"
    path.write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(JawFileError, match="is not UTF-8 text"):
        load_jaw(path)


def test_a_missing_file_names_the_shipped_jaws(tmp_path):
    with pytest.raises(JawFileError, match="absent.yaml.*one of bench, .*steel"):
        load_jaw(tmp_path / "absent.yaml")
    with pytest.raises(JawFileError, match="there is no jaw file"):
        load_jaw(tmp_path)


def test_a_side_is_left_or_right():
    with pytest.raises(JawFileError, match="'up', expected 'left' or 'right'"):
        load_jaw("bench", side="up")


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("inner_face_x", ..., "inner_face_x is missing"),
        ("mesh__clamped", ..., "mesh.clamped is missing"),
        ("mesh__clamped", {}, "mesh.clamped: got none"),
        ("mesh__clamped", {"z_below": 0.001, "nodes": [1]}, "got z_below and nodes"),
        ("mesh__clamped", {"z_bellow": 0.001}, "mesh.clamped: unknown key 'z_bellow'; did you mean 'z_below'"),
        ("mesh__clamped", {"nodes": [0.5]}, r"mesh.clamped.nodes\[0\]: got 0.5, expected a valid integer"),
        ("mesh__clamped", {"box": [[0.0, 0.0, 0.0]]}, "mesh.clamped.box: got a list .*, expected at least 2 items"),
        ("mesh__clamped", {"box": [[0.1, 0.0, 0.0], [0.0, 0.1, 0.1]]}, "lowest corner first"),
        ("mesh__scale", -1.0, "mesh.scale: got -1"),
        ("mesh__file", 3, "mesh.file: got 3"),
        ("mesh__scal", 1.0, "mesh: unknown key 'scal'; did you mean 'scale'"),
        ("keypoints", {"rule": "rib_junctions", "side_y": 0.01}, "rib_junctions needs a drawing"),
        ("keypoints", {"off": [0.0, 0.01, 0.014]}, "keypoints.off at .* off the mesh"),
        ("inner_face_x", 0.0132, r"candidates\[\d+\] at .* off the surface"),
        ("candidates__count", 16, r"candidates\[15\] at .* off the surface"),
        ("model", "frame", "model: got frame, expected solid for a mesh file"),
    ],
)
def test_bad_value_of_a_mesh_jaw_is_refused_by_name(tmp_path, place, value, words):
    path = write_mesh_jaw(tmp_path, **{place: value})
    with pytest.raises(JawFileError, match="^finger.yaml: .*" + words):
        load_jaw(path)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("mesh__clamped", {"z_below": -0.001}, "finger.vtu: no clamped nodes"),
        ("mesh__clamped", {"nodes": [0, 1, 9999]}, r"finger.vtu: .*expected 0\.\.521"),
        ("mesh__scale", 1.0, "finger.vtu: .*looks like millimetres; give scale: 0.001"),
        ("mesh__scale", 1e-6, "finger.vtu: .*check its scale"),
        ("mesh__file", "absent.msh", "there is no mesh file .*absent.msh"),
    ],
)
def test_a_bad_mesh_of_a_jaw_is_refused_by_name(tmp_path, place, value, words):
    path = write_mesh_jaw(tmp_path, **{place: value})
    with pytest.raises(MeshError, match="^finger.yaml: .*" + words):
        load_jaw(path)


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
PLACES_IN_FILE = sorted({place for place, value, _ in BAD_VALUES if value is ...} | {"keypoints", "candidates"})


@settings(max_examples=150)
@given(place=st.sampled_from(PLACES_IN_FILE), value=VALUES)
def test_no_content_causes_anything_but_our_errors(tmp_path_factory, place, value):
    path = write_jaw(tmp_path_factory.mktemp("jaw"), changed(content_of(SHIPPED_BENCH), place, value))
    try:
        jaw = load_jaw(path)
    except FinforceError as error:
        assert str(error).startswith("finger.yaml: ")
    else:
        assert np.isfinite(jaw.keypoints).all() and np.isfinite(jaw.candidates).all()
