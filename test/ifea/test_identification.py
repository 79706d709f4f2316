"""Claims about the identification of a finger from recordings with true forces."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from estimator_fakes import SMOOTH, magnitudes, make_estimator, ramp, record, run
from mechanics_fakes import BENCH, MODULUS

from finforce_ifea import identification
from finforce_ifea.errors import CalibrationError
from finforce_ifea.identification import CalibrationCase, find_plateaus, fit_calibration
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.relaxation import RelaxationTerm, apply_relaxation
from finforce_ifea.settings import EstimatorSettings

TERMS = (RelaxationTerm(share=0.12, time_constant=1.5), RelaxationTerm(share=0.06, time_constant=12.0))
FRAME = EstimatorSettings(solver="frame", **SMOOTH)
COURSE = ramp(2, 4, 6, 4, 2, 0, hold=3.0)
COSTS = []  # that the fit below has told


def make_case(height, *, seed=0, depths=COURSE):
    """A recording of a relaxing finger whose modulus the jaw file does not know."""
    recording = record(depths, height=height, seed=seed)
    stamps = np.array([observation.stamp for observation in recording.observations])
    elastic = np.linalg.norm(recording.forces, axis=1)
    share = apply_relaxation(elastic, stamps, TERMS) / np.maximum(elastic, 1e-12)
    return CalibrationCase(
        name=f"pressed_at_{height}",
        observations=recording.observations,
        contact=recording.contact,
        stamps_true=stamps,
        forces_true=recording.forces * share[:, None],
    )


@pytest.fixture(scope="module")
def fit():
    """From two recordings of 24 s; the jaw file says 26 MPa, the truth has 30."""
    return fit_calibration(load_jaw("bench"), [make_case(20), make_case(60, seed=1)], FRAME, COSTS.append)


def test_modulus_is_recovered_within_its_uncertainty(fit):
    found, stddev = fit.calibration.young_modulus, fit.uncertainty["young_modulus"]
    assert stddev < 0.12 * MODULUS
    assert abs(found - MODULUS) < 2.5 * stddev
    assert found == pytest.approx(MODULUS, rel=0.12)


def test_thicknesses_stay_near_the_drawing_that_made_the_truth(fit):
    """The truth is the drawn finger; thickness and modulus trade against each other by some per cent, measured ten."""
    names = ("inner_thickness_factor", "outer_thickness_factor", "rib_thickness_factor")
    for name in names:
        assert getattr(fit.calibration, name) == pytest.approx(1.0, abs=0.12)
        assert abs(getattr(fit.calibration, name) - 1.0) < 3.0 * fit.uncertainty[name]
    assert fit.calibration.clamped_z < 0.001


def test_bending_stiffness_is_recovered_better_than_its_parts(fit):
    """E t^3 of both bands is what shape and force tell together."""
    factors = fit.calibration.inner_thickness_factor, fit.calibration.outer_thickness_factor
    stiffness = fit.calibration.young_modulus * np.mean(np.power(factors, 3))
    assert stiffness == pytest.approx(MODULUS, rel=0.07)


def test_relaxation_is_recovered(fit):
    fast, slow = fit.calibration.relaxation
    assert fast.time_constant < slow.time_constant
    assert fast.share + slow.share == pytest.approx(0.18, abs=0.03)
    # time constants are told by 3 s of holding: within a third
    assert fast.time_constant == pytest.approx(1.5, rel=0.35)
    assert slow.time_constant == pytest.approx(12.0, rel=0.4)


def test_fit_says_how_good_it_is(fit):
    assert fit.plateaus == 10
    assert fit.force_rms < 0.07
    assert fit.shape_rms < 0.06e-3
    assert 0.005 <= fit.calibration.force_error < 0.04
    assert fit.calibration.jaw == "bench"
    assert set(fit.uncertainty) >= {"young_modulus", "share_1", "time_constant_2", "clamped_z"}
    assert all(np.isfinite(value) and value > 0 for value in fit.uncertainty.values())
    # at small depths a cylinder's radius of 12.5 mm is hardly seen
    assert all(0.003 < radius < 0.05 for radius in fit.radii)


@pytest.mark.parametrize(("diameter", "height", "bound"), [(15, 40, 0.05), (35, 60, 0.06), (35, 20, 0.26)])
def test_calibrated_finger_gives_the_force_of_a_recording_it_has_not_seen(fit, diameter, height, bound):
    """Another object, place and noise; measured 0.02, 0.03 and 0.20 N of up to 2.1, 2.6 and 5.7."""
    recording = record(COURSE, diameter=diameter, height=height, seed=5)
    stamps = np.array([observation.stamp for observation in recording.observations])
    true = apply_relaxation(np.linalg.norm(recording.forces, axis=1), stamps, TERMS)
    rms = {}
    for name, calibration in (("fitted", fit.calibration), ("drawn", None)):
        found = magnitudes(run(recording, make_estimator(load_jaw("bench"), calibration=calibration, solver="frame")))
        rms[name] = np.sqrt(np.nanmean((found - true)[true > 0.3] ** 2))
    assert rms["fitted"] < bound
    assert rms["drawn"] > 2 * rms["fitted"]


def test_progress_is_told(fit):
    finite = [cost for cost in COSTS if np.isfinite(cost)]
    assert len(finite) > 10
    assert min(finite[-10:]) < 0.5 * finite[0]


def test_the_fit_is_repeatable():
    case = make_case(40, depths=ramp(3, 6, 0, hold=1.0))
    once, again = (fit_calibration(load_jaw("bench"), [case], FRAME).calibration for _ in range(2))
    assert once == again


# --- steady loads


def test_plateaus_are_the_held_loads():
    case = make_case(40)
    found = find_plateaus([case], BENCH, FRAME, per_case=14)
    assert len(found) == 5
    depths = np.array([2, 4, 6, 4, 2])
    elastic = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) * 0.66
    assert [plateau.force for plateau in found] == pytest.approx(elastic, rel=0.12)
    for plateau, depth in zip(found, depths, strict=True):
        moved = np.nanmax(np.abs(plateau.keypoints[:, 0]))
        # the key point nearest to the contact is a little behind it
        assert moved == pytest.approx(1e-3 * depth, rel=0.05)
        assert plateau.keypoints.shape == (15, 2)
        assert (plateau.variance > 0).all()
        assert (np.diff(plateau.instants) > 0).all()


def test_truth_may_come_at_a_rate_of_its_own():
    case = make_case(40)
    dense = np.linspace(case.stamps_true[0], case.stamps_true[-1], 3 * len(case.stamps_true))
    forces = np.stack([np.interp(dense, case.stamps_true, column) for column in case.forces_true.T], axis=1)
    other = replace(case, stamps_true=dense, forces_true=forces)
    first, second = (find_plateaus([one], BENCH, FRAME, per_case=14) for one in (case, other))
    assert len(first) == len(second)
    for left, right in zip(first, second, strict=True):
        assert right.force == pytest.approx(left.force, rel=0.01)
        np.testing.assert_allclose(dense[right.instants], case.stamps_true[left.instants], atol=0.2)


@pytest.mark.parametrize(("late", "words"), [(0.15, "later"), (-0.15, "earlier"), (-0.02, ""), (0.0, "")])
def test_forces_of_another_clock_are_refused_instead_of_taken_for_relaxation(late, words, monkeypatch):
    stamps = np.arange(0.0, 40.0, 1.0 / 30.0)
    elastic = np.interp(stamps % 20.0, [2.0, 3.0, 6.0, 7.0, 10.0, 11.0, 14.0], [0.0, 2.0, 2.0, 4.0, 4.0, 0.0, 0.0])
    true = np.interp(stamps - late, stamps, apply_relaxation(elastic, stamps, TERMS))
    history = identification._ForceHistory(stamps=stamps, elastic=elastic, true=true)
    monkeypatch.setattr(identification, "_track_force", lambda *given: history)
    given = load_jaw("bench"), [SimpleNamespace(name="pressed")], [FRAME], None, lambda cost: None
    if words:
        with pytest.raises(CalibrationError, match=rf"the forces fit those 0.15 s {words} than the images.*one clock"):
            identification.fit_force_history(*given)
    else:
        terms = identification.fit_force_history(*given).terms
        assert [term.share for term in terms] == pytest.approx([0.12, 0.06], abs=0.1 * (late != 0) + 0.02)


@pytest.mark.parametrize(("drift", "noise"), [(0.3, 0.03), (-0.3, 0.03), (0.05, 0.03), (0.0, 0.2)])
def test_forces_of_a_sensor_that_drifts_are_refused_and_those_of_a_noisy_one_are_not(drift, noise, monkeypatch):
    """The norm of noise along three axes is not 0, either, where nothing presses."""
    stamps, rng = np.arange(0.0, 60.0, 1.0 / 30.0), np.random.default_rng(5)
    elastic = np.interp(stamps % 20.0, [2.0, 3.0, 6.0, 7.0, 10.0, 11.0, 14.0], [0.0, 2.0, 2.0, 4.0, 4.0, 0.0, 0.0])
    x = apply_relaxation(elastic, stamps, TERMS) + (0.4 if drift < 0.0 else 0.0) + drift * stamps / stamps[-1]
    true = np.linalg.norm(np.outer(x, [1.0, 0.0, 0.0]) + rng.normal(scale=noise, size=(len(x), 3)), axis=1)
    history = identification._ForceHistory(stamps=stamps, elastic=elastic, true=true)
    monkeypatch.setattr(identification, "_track_force", lambda *given: history)
    given = load_jaw("bench"), [SimpleNamespace(name="pressed")], [FRAME], None, lambda cost: None
    if abs(drift) > 0.1:
        with pytest.raises(CalibrationError, match="pressed: where nothing presses.*does the sensor drift"):
            identification.fit_force_history(*given)
    else:
        identification.fit_force_history(*given)


def test_a_clock_of_which_held_forces_tell_nothing_is_not_doubted(monkeypatch):
    stamps, rng = np.arange(0.0, 20.0, 1.0 / 30.0), np.random.default_rng(5)
    elastic = np.full(len(stamps), 2.0)
    true = elastic + rng.normal(scale=0.05, size=len(stamps))
    history = identification._ForceHistory(stamps=stamps, elastic=elastic, true=true)
    monkeypatch.setattr(identification, "_track_force", lambda *given: history)
    best = min(identification._LEADS, key=lambda lead: identification._fit_branches([history], lead).cost)
    assert abs(best) > identification._ONE_CLOCK
    identification.fit_force_history(
        load_jaw("bench"), [SimpleNamespace(name="held")], [FRAME], None, lambda cost: None
    )


def test_forces_too_small_to_fit_are_doubted_in_their_unit(monkeypatch):
    stamps = np.arange(0.0, 20.0, 1.0 / 30.0)
    elastic = np.interp(stamps % 10.0, [2.0, 3.0, 6.0, 7.0], [0.0, 2.0, 2.0, 0.0])
    history = identification._ForceHistory(stamps=stamps, elastic=elastic, true=elastic / 9.8)
    monkeypatch.setattr(identification, "_track_force", lambda *given: history)
    with pytest.raises(
        CalibrationError, match="forces of 0.2 N at most; expected more than 0.3 N: are they in newtons"
    ):
        identification.fit_force_history(
            load_jaw("bench"), [SimpleNamespace(name="held")], [FRAME], None, lambda cost: None
        )


def test_forces_that_no_modulus_explains_are_refused_before_the_jaw_file_is_doubted():
    case = make_case(40)
    with pytest.raises(CalibrationError, match="the true forces are 1.* times those of.*expected newtons"):
        fit_calibration(load_jaw("bench"), [replace(case, forces_true=102.0 * case.forces_true)], FRAME)


def test_only_so_many_plateaus_of_a_case_are_taken():
    assert len(find_plateaus([make_case(40), make_case(60)], BENCH, FRAME, per_case=2)) == 4


def test_hidden_key_points_are_left_out_of_a_plateau():
    case = make_case(40)
    observations = list(case.observations)
    for i in range(60, len(observations)):
        likelihood = observations[i].likelihood.copy()
        likelihood[[3, 9]] = 0.1
        observations[i] = replace(observations[i], likelihood=likelihood)
    plateau = find_plateaus([replace(case, observations=observations)], BENCH, FRAME, per_case=14)[0]
    assert np.isnan(plateau.keypoints[[3, 9]]).all()
    assert np.isfinite(np.delete(plateau.keypoints, [3, 9], axis=0)).all()


# --- recordings that tell nothing


def test_no_recordings_are_refused():
    with pytest.raises(CalibrationError, match="no recordings"):
        fit_calibration(load_jaw("bench"), [])


def begin_later(case, frames):
    late = slice(frames, None)
    return replace(
        case,
        observations=case.observations[late],
        stamps_true=case.stamps_true[late],
        forces_true=case.forces_true[late],
    )


def test_recording_with_too_short_a_rest_is_refused_by_name():
    case = begin_later(make_case(40), 50)
    with pytest.raises(CalibrationError, match="pressed_at_40: 10 frames without load at the start; expected"):
        fit_calibration(load_jaw("bench"), [case], FRAME)


def test_stills_need_no_rest():
    """Loaded from the first frame on: key points are where the jaw file has them, and nothing is said of relaxation."""
    fit = fit_calibration(load_jaw("bench"), [begin_later(make_case(40), 150)], FRAME)
    assert fit.calibration.relaxation == ()
    assert fit.calibration.force_error >= 0.05
    assert set(fit.uncertainty) == {
        "young_modulus",
        "inner_thickness_factor",
        "outer_thickness_factor",
        "rib_thickness_factor",
        "clamped_z",
    }
    # what has relaxed by then counts as modulus
    relaxed = MODULUS * (1.0 + sum(term.share for term in TERMS))
    assert 0.85 * MODULUS < fit.calibration.young_modulus < 1.15 * relaxed
    assert abs(fit.calibration.young_modulus - MODULUS) < 2.5 * fit.uncertainty["young_modulus"]


def test_strips_with_a_rigid_tip_keep_their_centre_lines():
    steel = load_jaw("steel")
    thicker = Calibration(young_modulus=2e11, inner_thickness_factor=1.3, outer_thickness_factor=1.2).apply(steel)
    for before, after in ((steel.drawing.inner, thicker.drawing.inner), (steel.drawing.outer, thicker.drawing.outer)):
        assert after.thickness > 1.1 * before.thickness
        np.testing.assert_allclose(after.centre_x(np.array([0.0, 0.1])), before.centre_x(np.array([0.0, 0.1])))


def test_recording_without_a_held_load_is_refused_by_name():
    with pytest.raises(CalibrationError, match="pressed_at_40.*steady"):
        fit_calibration(load_jaw("bench"), [make_case(40, depths=ramp(6, 0, hold=0.1))], FRAME)


def test_recording_without_any_load_is_refused_by_name():
    with pytest.raises(CalibrationError, match="pressed_at_40"):
        fit_calibration(load_jaw("bench"), [make_case(40, depths=np.zeros(300))], FRAME)


def test_key_points_of_another_finger_are_refused():
    """Key points that move against the load belong to no shape of this jaw."""
    case = make_case(40)
    flipped = [replace(o, points=2 * BENCH.keypoints - o.points) for o in case.observations]
    with pytest.raises(CalibrationError):
        fit_calibration(load_jaw("bench"), [replace(case, observations=flipped)], FRAME)
