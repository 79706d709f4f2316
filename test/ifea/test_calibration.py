"""Claims about calibrations: what they change on a jaw, and their files."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from mechanics_fakes import BENCH

from finforce_ifea.errors import CalibrationError
from finforce_ifea.jaw.calibration import Calibration, load_calibration, save_calibration
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.relaxation import RelaxationTerm

FULL = Calibration(
    young_modulus=31.5e6,
    inner_thickness_factor=0.93,
    outer_thickness_factor=1.06,
    rib_thickness_factor=1.01,
    clamped_z=0.0003,
    relaxation=(RelaxationTerm(share=0.1, time_constant=2.5), RelaxationTerm(share=0.05, time_constant=20.0)),
    force_error=0.018,
    jaw="bench",
    finger=load_jaw("bench").digest,
)
PLAIN = {"young_modulus": 30.0e6}


def write(folder, content):
    path = folder / "finger.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


# --- files


@pytest.mark.parametrize("calibration", [FULL, Calibration(young_modulus=26e6)], ids=["full", "plain"])
def test_load_inverts_save(calibration, tmp_path):
    path = tmp_path / "finger.yaml"
    save_calibration(calibration, path)
    assert load_calibration(path) == calibration
    assert load_calibration(str(path)) == calibration


def test_uncertainty_is_written_for_people_and_changes_no_force(tmp_path):
    path = tmp_path / "finger.yaml"
    save_calibration(FULL.changed(uncertainty={"young_modulus": np.float64(1e6)}), path)
    assert yaml.safe_load(path.read_text())["uncertainty"] == {"young_modulus": 1e6}
    assert load_calibration(path).changed(uncertainty={}) == FULL


def test_modulus_alone_is_a_calibration(tmp_path):
    assert load_calibration(write(tmp_path, PLAIN)) == Calibration(young_modulus=30e6)
    assert load_calibration(write(tmp_path, {**PLAIN, "relaxation": None, "comment": "by hand"})).relaxation == ()


def test_shipped_calibration_fits_the_shipped_jaw():
    calibration = load_calibration("bench")
    assert calibration.jaw == "bench"
    assert calibration.apply(load_jaw("bench")).material.young_modulus == calibration.young_modulus
    # printed TPU: not the datasheet's 26 MPa
    assert 28e6 < calibration.young_modulus < 40e6


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({**PLAIN, "young_modulos": 1.0}, "unknown key 'young_modulos'"),
        ({"clamped_z": 0.001}, "young_modulus"),
        ([1, 2], "got a list .*, expected a mapping"),
        ("", "is empty, expected a mapping of young_modulus"),
        ("a: [", "finger.yaml"),
        ({"young_modulus": "soft"}, "young_modulus: got the text 'soft', expected a valid number"),
        ({"young_modulus": None}, "young_modulus"),
        ({"young_modulus": -3.0}, "young_modulus"),
        ({"young_modulus": 30.0}, "young_modulus: got 30, expected greater than or equal to 1000"),
        ({"young_modulus": float("nan")}, "young_modulus"),
        ({**PLAIN, "inner_thickness_factor": 10.0}, "inner_thickness_factor"),
        ({**PLAIN, "outer_thickness_factor": 0.0}, "outer_thickness_factor"),
        ({**PLAIN, "rib_thickness_factor": float("inf")}, "rib_thickness_factor"),
        ({**PLAIN, "clamped_z": -0.001}, "clamped_z"),
        ({**PLAIN, "clamped_z": 3.0}, "clamped_z: got 3, expected less than or equal to 0.05"),
        ({**PLAIN, "force_error": 2.0}, "force_error"),
        ({**PLAIN, "relaxation": [{"share": -0.1, "time_constant": 1.0}]}, "share"),
        ({**PLAIN, "relaxation": [{"share": 0.1, "time_constant": 0.0}]}, "time_constant"),
        ({**PLAIN, "relaxation": [{"share": 0.1}]}, "time_constant"),
        ({**PLAIN, "relaxation": [{"share": 0.1, "time_constant": 1.0, "tau": 1.0}]}, "tau"),
        ({**PLAIN, "relaxation": [{"share": "much", "time_constant": 1.0}]}, "finger.yaml"),
        ({**PLAIN, "relaxation": 3}, "finger.yaml"),
        ({**PLAIN, "relaxation": [{"share": float("nan"), "time_constant": 1.0}]}, "share"),
        ({**PLAIN, "jaw": 7}, "jaw"),
        ({"young_modulus": True}, "young_modulus"),
    ],
)
def test_nonsense_in_a_file_is_refused_by_name(content, words, tmp_path):
    with pytest.raises(CalibrationError, match=words):
        load_calibration(write(tmp_path, content))


def test_message_names_the_file(tmp_path):
    with pytest.raises(CalibrationError, match=r"^finger\.yaml: "):
        load_calibration(write(tmp_path, {**PLAIN, "clamped_z": 3.0}))


@pytest.mark.parametrize("name", ["missing.yaml", "nowhere/missing.yaml", "unknown"])
def test_missing_file_is_refused(name):
    with pytest.raises(CalibrationError, match="no calibration file"):
        load_calibration(name)


def test_binary_file_is_refused(tmp_path):
    path = tmp_path / "finger.yaml"
    path.write_bytes(b"\xff\xfe\x00\x80\x81")
    with pytest.raises(CalibrationError, match="finger.yaml"):
        load_calibration(path)


# --- application


def test_factors_change_what_they_name():
    jaw = FULL.apply(BENCH)
    assert jaw.material.young_modulus == 31.5e6
    assert jaw.material.poisson_ratio == BENCH.material.poisson_ratio
    assert jaw.drawing.inner.thickness == pytest.approx(0.93 * BENCH.drawing.inner.thickness)
    assert jaw.drawing.outer.thickness == pytest.approx(1.06 * BENCH.drawing.outer.thickness)
    assert [rib.thickness for rib in jaw.drawing.ribs] == pytest.approx([1.01e-3] * 7)
    assert jaw.drawing.clamped_z == 0.0003
    assert jaw.inner_face_x == BENCH.inner_face_x
    np.testing.assert_array_equal(jaw.keypoints, BENCH.keypoints)


def test_contact_face_stays_where_it_is():
    """A thinner band loses material inside; its outer face is where objects touch."""
    mesh = FULL.apply(BENCH).build_mesh("coarse")
    assert mesh.nodes[:, 0].max() == pytest.approx(BENCH.inner_face_x, abs=1e-12)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_a_modulus_in_another_unit_is_refused(factor):
    modulus = factor * BENCH.material.young_modulus
    with pytest.raises(CalibrationError, match="young_modulus 3e.* Pa, the jaw file of 'bench' says 3e.07 Pa"):
        Calibration(young_modulus=modulus).apply(BENCH)


def test_neutral_calibration_changes_the_modulus_alone():
    jaw = Calibration(young_modulus=BENCH.material.young_modulus).apply(BENCH)
    assert jaw.drawing == BENCH.drawing
    assert jaw.material == BENCH.material


def test_calibration_of_another_jaw_is_refused_with_both_names():
    with pytest.raises(CalibrationError, match="'bench'.*'steel'"):
        FULL.apply(load_jaw("steel"))


def test_calibration_without_a_name_fits_any_jaw():
    assert FULL.changed(jaw="", finger="").apply(load_jaw("umi")).material.young_modulus == 31.5e6


@pytest.mark.parametrize("name", ["bench", "twin"])
def test_a_shipped_calibration_is_refused_on_a_finger_with_other_ribs(name):
    drawing = BENCH.drawing
    other = replace(BENCH, drawing=replace(drawing, ribs=drawing.ribs[:-1]))
    assert load_calibration(name).apply(BENCH)
    with pytest.raises(CalibrationError, match="finger of another shape"):
        load_calibration(name).apply(other)


def test_thicknesses_of_an_unnamed_finger_are_refused_and_a_modulus_is_not():
    with pytest.raises(CalibrationError, match=f"add `finger: {BENCH.digest}`"):
        FULL.changed(finger="").apply(BENCH)
    assert Calibration(young_modulus=30e6, jaw="bench").apply(BENCH).material.young_modulus == 30e6


@pytest.mark.parametrize("modulus", [9.9e6, 91e6])
def test_a_modulus_that_no_such_print_has_is_refused(modulus):
    Calibration(young_modulus=33e6).check_plausible(BENCH)
    with pytest.raises(CalibrationError, match="expected 10 to 90 MPa.*says 30 MPa.*--force"):
        Calibration(young_modulus=modulus).check_plausible(BENCH)


def test_a_soft_finger_is_never_softer_or_harder_than_tpu():
    soft = replace(BENCH, material=BENCH.material.model_copy(update={"young_modulus": 12e6}))
    hard = replace(BENCH, material=BENCH.material.model_copy(update={"young_modulus": 110e6}))
    for jaw, modulus in ((soft, 4.5e6), (hard, 220e6)):
        with pytest.raises(CalibrationError, match="MPa, expected"):
            Calibration(young_modulus=modulus).check_plausible(jaw)
    Calibration(young_modulus=400e9).check_plausible(load_jaw("steel"))


def test_calibration_fits_both_sides():
    right = FULL.apply(BENCH.mirrored())
    assert right.side == "right"
    np.testing.assert_array_equal(right.keypoints, BENCH.keypoints * [1, -1, 1])
