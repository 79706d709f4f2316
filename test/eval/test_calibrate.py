"""Claims about what `finforce calibrate` hands to the fit and prints of it."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from eval_fakes import PERIOD, FakeContactEstimator, make_recording

from finforce.transforms import pose_from_quaternion
from finforce_eval.calibration.calibrate import calibration_case, fitted_values, format_fit
from finforce_eval.cli.main import main
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.contact_source import ContactChoice, parse_contacts
from finforce_eval.recordings.writer import write_recording
from finforce_ifea.jaw.calibration import Calibration, load_calibration
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.relaxation import RelaxationTerm


@pytest.fixture(scope="module")
def jaw():
    return load_jaw("bench")


def bench_recording(name="pressed", **options):
    return make_recording(name, keypoints=15, **options)


def make_fit(cases=1):
    terms = (RelaxationTerm(share=0.2, time_constant=0.5), RelaxationTerm(share=0.1, time_constant=12.0))
    return SimpleNamespace(
        calibration=Calibration(young_modulus=31.4e6, clamped_z=0.0002, relaxation=terms, force_error=0.012),
        uncertainty={"young_modulus": 0.5e6, "clamped_z": 0.0001, "share_1": 0.01, "time_constant_2": 2.0},
        radii=(0.0125, *(None,) * (cases - 1)),
        force_rms=0.034,
        shape_rms=0.00007,
        plateaus=14,
    )


def test_case_holds_every_observation_and_the_truth_at_their_stamps(jaw):
    recording = bench_recording()
    case = calibration_case(recording, jaw, ContactChoice())
    track = recording.jaws["left"]
    assert case.name == "pressed"
    assert len(case.observations) == 60
    np.testing.assert_array_equal(case.observations[7].points, track.keypoints.points[7])
    np.testing.assert_allclose(case.stamps_true, track.keypoints.stamps)
    np.testing.assert_array_equal(case.forces_true, track.truth.force)
    assert case.contact.points[0, 2] == pytest.approx(0.040)


def pressed_by_a_mesh(monkeypatch, estimator):
    """A recording whose object is known, three frames unloaded, and the fake that locates it."""
    monkeypatch.setattr("finforce_eval.evaluation.contact_source.build_estimator", lambda *_: estimator)
    recording = bench_recording()
    track = recording.jaws["left"]
    force = track.truth.force.copy()
    force[:12] = 0.0
    force[12] = [-0.1, 0.0, 0.0]
    return replace(recording, jaws={"left": replace(track, truth=replace(track.truth, force=force))})


def test_first_touch_is_that_of_the_mean_pose_before_the_load(jaw, monkeypatch):
    estimator = FakeContactEstimator()
    recording = pressed_by_a_mesh(monkeypatch, estimator)
    poses = recording.object_pose
    T_camera_jaw = pose_from_quaternion(poses.position[0], poses.quaternion[0])
    # up to frame 12 the poses come at frames 0, 3, 6, 9; what comes later does not count
    heights = np.where(np.arange(len(poses.stamps_ns)) < 4, 0.0401, 0.060)
    heights[:4] += np.array([3e-4, -3e-4, 1e-4, -1e-4])
    position = (T_camera_jaw @ np.stack([0 * heights, 0 * heights, heights, 1 + 0 * heights]))[:3].T
    seen = replace(recording, object_pose=replace(poses, position=position))
    case = calibration_case(seen, jaw, parse_contacts(["estimate"]))
    assert [name for name, *_ in estimator.calls] == ["pose", "update"]
    np.testing.assert_allclose(case.contact.points, [[0.014, 0.0, 0.0401]], atol=1e-12)
    assert case.contact.free
    assert case.contact.touching is False


def test_first_touch_needs_poses_before_the_load(jaw, monkeypatch):
    recording = pressed_by_a_mesh(monkeypatch, FakeContactEstimator())
    late = replace(recording.object_pose, stamps_ns=recording.object_pose.stamps_ns + 6 * PERIOD)
    with pytest.raises(RecordingError, match="2 object poses before the force rises; expected at least 3"):
        calibration_case(replace(recording, object_pose=late), jaw, parse_contacts(["estimate"]))


def test_first_touch_that_is_not_found_is_refused_with_the_reason(jaw, monkeypatch):
    class Blind(FakeContactEstimator):
        def take_pose(self, *_, **__):
            """Forgets it."""

    recording = pressed_by_a_mesh(monkeypatch, Blind())
    with pytest.raises(RecordingError, match="pressed: no location of first touch: no pose yet"):
        calibration_case(recording, jaw, parse_contacts(["paper"]))


def test_frames_without_truth_are_observations_without_force(jaw):
    recording = bench_recording()
    track = recording.jaws["left"]
    late = replace(track.truth, stamps_ns=track.truth.stamps_ns + 10 * PERIOD)
    case = calibration_case(
        replace(recording, jaws={"left": replace(track, truth=late)}),
        jaw,
        parse_contacts(["fixed:20"]),
    )
    assert len(case.observations) == 60
    assert len(case.stamps_true) == len(case.forces_true) == 50
    assert case.contact.points[0, 2] == pytest.approx(0.020)


def test_recordings_that_cannot_be_used_are_refused(jaw):
    with pytest.raises(RecordingError, match="no ground truth"):
        calibration_case(bench_recording(truth=False), jaw, ContactChoice())
    with pytest.raises(RecordingError, match="4 key points"):
        calibration_case(make_recording(), jaw, ContactChoice())
    with pytest.raises(OptionError, match="no contact height"):
        calibration_case(replace(bench_recording(), case={}), jaw, ContactChoice())


def test_true_forces_of_another_time_are_refused(jaw, tmp_path, monkeypatch, capsys):
    recording = bench_recording()
    track = recording.jaws["left"]
    late = replace(track.truth, stamps_ns=track.truth.stamps_ns + 100 * 10**9)
    with pytest.raises(RecordingError, match="pressed: no true force at the time of an image: do both have one clock"):
        calibration_case(replace(recording, jaws={"left": replace(track, truth=late)}), jaw, ContactChoice())
    off = replace_error(make_fit(), 0.2)
    monkeypatch.setattr("finforce_eval.calibration.calibrate.fit_calibration", lambda *_: off)
    words = ["calibrate", str(write_recording(recording, tmp_path / "bag")), "-o", str(tmp_path / "finger.yaml")]
    assert main(words) == 2 and not (tmp_path / "finger.yaml").exists()
    assert (
        "20 % of a force left over, expected at most 15 %: do forces and images have one clock"
        in capsys.readouterr().err
    )
    assert main([*words, "--force"]) == 0


def replace_error(fit, force_error):
    return SimpleNamespace(**{**vars(fit), "calibration": fit.calibration.changed(force_error=force_error)})


def test_recordings_of_the_right_jaw_calibrate_its_mirror_image(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        "finforce_eval.calibration.calibrate.fit_calibration", lambda jaw, *_: seen.append(jaw.side) or make_fit()
    )
    bag = write_recording(bench_recording(side="right"), tmp_path / "bag")
    found = tmp_path / "found.json"
    assert main(["calibrate", str(bag), "-o", str(tmp_path / "finger.yaml"), "--json", str(found)]) == 0
    assert seen == ["right"]
    assert json.loads(found.read_text())["calibration"]["young_modulus"] == 31.4e6


def test_every_uncertainty_has_its_value():
    assert fitted_values(make_fit()) == {
        "young_modulus": 31.4e6,
        "clamped_z": 0.0002,
        "share_1": 0.2,
        "time_constant_2": 12.0,
    }


def test_fit_is_printed_with_units_and_uncertainty():
    contact = SimpleNamespace(points=np.array([[0.014, 0.0, 0.0402]]))
    text = format_fit(make_fit(2), [SimpleNamespace(name=name, contact=contact) for name in ("pressed", "meshed")])
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "young_modulus 31.400 ± 0.500 MPa" in lines
    assert "clamped_z 0.200 ± 0.100 mm" in lines
    assert "pressed: first touch at 40.20 mm, radius of the object 12.5 mm" in lines
    assert "meshed: first touch at 40.20 mm, outline of its mesh" in lines
    assert "force 0.034 N (1.2 %), key points 0.070 mm" in lines[-1]


def test_command_writes_a_calibration_that_loads(tmp_path, monkeypatch, capsys):
    seen = []

    def fit(jaw, cases, settings, progress):
        seen.append((jaw.name, [case.name for case in cases], settings.solver))
        progress(3.0)
        return make_fit(len(cases))

    monkeypatch.setattr("finforce_eval.calibration.calibrate.fit_calibration", fit)
    bags = [str(write_recording(bench_recording(), tmp_path / name)) for name in ("first", "second")]
    output = tmp_path / "new" / "finger.yaml"
    assert main(["calibrate", *bags, "--solver", "solid", "-o", str(output)]) == 0
    assert seen == [("bench", ["first", "second"], "solid")]
    assert load_calibration(output) == make_fit().calibration.changed(
        solver="solid", uncertainty=make_fit().uncertainty
    )
    assert "young_modulus" in capsys.readouterr().out
