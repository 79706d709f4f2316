"""Claims about the score, against numbers computed by hand."""

from dataclasses import replace

import numpy as np
import pytest
from eval_fakes import make_recording

from finforce_eval.evaluation.score_tables import doubt_truth
from finforce_eval.evaluation.scoring import compute_stats, match_truth, score_case, score_series, true_range
from finforce_eval.recordings.tracks import WrenchTrack
from finforce_eval.table import ForceSeries


def make_result(name="case", *, truth, force, **changes):
    """A result with forces along -x given by their magnitudes; NaN = not solved."""
    frames = len(truth)
    direction = np.array([-1.0, 0.0, 0.0])
    values = {
        "true_force": np.asarray(truth, float)[:, None] * direction,
        "force": np.asarray(force, float)[:, None] * direction,
        "magnitude_stddev": np.zeros(frames),
        "contact_location": np.zeros((frames, 3)),
        "residual": np.zeros(frames),
        "used": np.ones((frames, 4), dtype=bool),
        "status": np.full(frames, "ok"),
        "step_ms": np.arange(1.0, frames + 1),
        "cycle": np.zeros(frames, dtype=int),
        "direction": np.full(frames, "load"),
        "scored": np.ones(frames, dtype=bool),
    }
    stamps = changes.pop("stamps", np.arange(frames) * 33_333_333)
    return ForceSeries.build(name, "left", stamps, **(values | changes))


def test_errors_are_estimate_minus_truth():
    stats = compute_stats(np.array([0.3, -0.1, 0.1]), span=10.0)
    assert stats.n == 3
    assert stats.rmse_N == pytest.approx(np.sqrt(0.11 / 3))
    assert stats.nrmsd_pct == pytest.approx(10 * np.sqrt(0.11 / 3))
    assert stats.max_error_N == pytest.approx(0.3)
    assert stats.bias_N == pytest.approx(0.1)


def test_estimate_that_is_too_small_has_negative_bias_and_positive_maximum():
    score = score_case([make_result(truth=[2.0, 2.0], force=[1.5, 1.9])], span=2.0)
    assert score.all.bias_N == pytest.approx(-0.3)
    assert score.all.max_error_N == pytest.approx(0.5)


def test_only_magnitudes_are_compared():
    result = make_result(truth=[2.0], force=[2.0])
    turned = result.with_columns(force=np.array([[0.0, 0.0, 2.0]]))
    assert score_case([turned], span=1.0).all.rmse_N == 0.0


def test_loading_and_unloading_are_told_apart_and_all_is_both():
    result = make_result(
        truth=[1.0, 1.0, 2.0, 2.0],
        force=[1.1, 1.1, 1.6, 1.6],
        direction=np.array(["load", "load", "unload", "unload"]),
    )
    score = score_case([result], span=4.0)
    assert (score.load.n, score.unload.n, score.all.n) == (2, 2, 4)
    assert score.load.rmse_N == pytest.approx(0.1)
    assert score.unload.rmse_N == pytest.approx(0.4)
    assert score.unload.nrmsd_pct == pytest.approx(10.0)
    assert score.all.rmse_N == pytest.approx(np.sqrt((0.01 + 0.16) / 2))
    assert score.all.bias_N == pytest.approx(-0.15)


def test_only_scored_frames_count():
    result = make_result(truth=[1.0, 1.0], force=[1.2, 9.0], scored=np.array([True, False]))
    assert score_case([result], span=1.0).all.rmse_N == pytest.approx(0.2)


def test_unsolved_frames_are_skipped_and_never_a_zero_error():
    solved = make_result(truth=[1.0, 1.0], force=[1.4, 1.4])
    gaps = make_result(truth=[1.0] * 4, force=[1.4, np.nan, np.nan, 1.4])
    score = score_case([gaps], span=1.0)
    assert (score.frames, score.solved, score.skipped) == (4, 2, 2)
    assert (score.record_frames, score.record_skipped) == (4, 2)
    assert replace(score.all, answered_pct=100.0) == score_case([solved], span=1.0).all
    assert score.all.answered_pct == 50.0


def test_nothing_solved_gives_no_number_instead_of_zero():
    score = score_case([make_result(truth=[1.0], force=[np.nan])], span=1.0)
    assert score.all.n == 0
    assert score.all.rmse_N is score.all.nrmsd_pct is score.all.max_error_N is score.all.bias_N is None


def test_zero_range_gives_no_nrmsd():
    assert compute_stats(np.array([0.1]), span=0.0).nrmsd_pct is None


def test_variation_over_cycles_is_the_sample_standard_deviation():
    result = make_result(truth=[1.0] * 3, force=[1.1, 1.2, 1.6], cycle=np.array([0, 1, 2]))
    cycles = score_case([result], span=1.0).cycles
    assert cycles["all"]["n"] == 3
    assert cycles["all"]["rmse_N"]["mean"] == pytest.approx(0.3)
    assert cycles["all"]["rmse_N"]["std"] == pytest.approx(np.sqrt((0.04 + 0.01 + 0.09) / 2))
    assert cycles["unload"]["n"] == 0
    assert cycles["unload"]["rmse_N"]["mean"] is None


def test_single_cycle_has_no_standard_deviation():
    assert score_case([make_result(truth=[1.0], force=[1.1])], span=1.0).cycles["all"]["rmse_N"]["std"] is None


def test_cases_together_pool_their_frames_and_average_their_rmse():
    first = make_result("first", truth=[1.0] * 3, force=[1.1] * 3)
    second = make_result("second", truth=[1.0], force=[1.5])
    total = score_case([first, second], span=1.0)
    assert (total.frames, total.all.n) == (4, 4)
    assert total.all.rmse_N == pytest.approx(np.sqrt((3 * 0.01 + 0.25) / 4))
    assert total.mean_rmse_N == pytest.approx(0.3)
    assert total.cycles["all"]["n"] == 2


def test_step_times_are_percentiles_of_all_steps():
    times = score_case([make_result(truth=np.ones(101), force=np.ones(101))], span=1.0).step_ms
    assert times == pytest.approx({"p50": 51, "p95": 96, "p99": 100, "max": 101})


def test_steps_that_were_not_timed_are_left_out():
    times = score_case([make_result(truth=[1.0] * 3, force=[1.0] * 3, step_ms=np.array([np.nan, 2, 4]))], span=1.0)
    assert times.step_ms["p50"] == pytest.approx(3.0)
    untimed = make_result(truth=[1.0], force=[1.0], step_ms=np.array([np.nan]))
    assert score_case([untimed], span=1.0).step_ms["max"] is None


def test_range_is_that_of_all_recordings_of_the_call():
    case = make_result(truth=[3.0], force=[4.0])
    assert score_series([case], [(0.0, 5.0), (1.0, 6.0)]).span == 6.0
    assert score_series([case], []).span == 0.0
    recording = make_recording()
    force = np.array([[0.0, 0, 0], [-3, 0, 4], [np.nan, 0, 0]])
    truth = WrenchTrack(stamps_ns=np.arange(3), force=force, torque=force)
    jaws = {"left": replace(recording.jaws["left"], truth=truth)}
    assert true_range(replace(recording, jaws=jaws)) == (0.0, 5.0)


def truth_at(stamps, magnitudes):
    force = np.asarray(magnitudes, float)[:, None] * np.array([-1.0, 0.0, 0.0])
    return WrenchTrack(stamps_ns=np.asarray(stamps), force=force, torque=np.zeros_like(force))


def test_truth_at_the_same_stamp_is_taken_as_it_is():
    matched = match_truth(truth_at([0, 10, 20], [1, 2, 4]), np.array([10, 20]))
    np.testing.assert_array_equal(matched[:, 0], [-2, -4])


def test_truth_between_stamps_is_interpolated():
    matched = match_truth(truth_at([0, 10, 20], [1, 2, 4]), np.array([5, 12]))
    np.testing.assert_allclose(matched[:, 0], [-1.5, -2.4])


def test_truth_is_never_extrapolated_nor_carried_over_a_gap():
    matched = match_truth(truth_at([0, 10, 20, 90, 100], np.ones(5)), np.array([-1, 5, 50, 100, 101]))
    np.testing.assert_array_equal(matched[:, 0], [np.nan, -1, np.nan, -1, np.nan])


def test_single_truth_matches_only_its_own_stamp():
    matched = match_truth(truth_at([10], [3]), np.array([9, 10, 11]))
    np.testing.assert_array_equal(matched[:, 0], [np.nan, -3, np.nan])


def vectors(**changes):
    truth = np.array([[-3.0, 0.0, 0.4], [-2.0, 0.0, 0.2]])
    given = {"force": truth + [[0.3, 0.0, -0.4], [-0.3, 0.0, 0.0]], "force_stddev": np.array([[0.2, 0.0, 0.1]] * 2)}
    return make_result(truth=[3.0, 2.0], force=[3.0, 2.0]).with_columns(true_force=truth, **{**given, **changes})


def test_the_force_is_compared_as_a_vector_axis_by_axis():
    stats = score_case([vectors()], span=1.0).all
    assert stats.axis_rmse_N == pytest.approx((0.3, 0.0, np.sqrt(0.08)))
    assert stats.vector_rmse_N == pytest.approx(np.sqrt(0.09 + 0.08))
    # along x both are within 0.6 N, along y there is no difference, along z one is beyond 0.3 N
    assert stats.within_3_sigma_pct == pytest.approx((100.0, 100.0, 50.0))


def test_sharpness_is_the_stated_deviation_over_the_error_axis_by_axis():
    sharpness = score_case([vectors()], span=1.0).all.sharpness
    assert sharpness == pytest.approx((0.2 / 0.3, None, 0.1 / np.sqrt(0.08)))
    wider = score_case([vectors(force_stddev=np.full((2, 3), 0.9))], span=1.0).all.sharpness
    assert wider[0] == pytest.approx(3.0)


def test_images_off_by_more_than_three_tenths_of_a_newton_along_an_axis_are_counted():
    truth = vectors().true_force
    for error, count in ([0.31, 0.0, 0.0], 2), ([0.0, 0.0, -0.31], 2), ([0.2, 0.2, 0.2], 0):
        assert score_case([vectors(force=truth + error)], span=1.0).all.n_off == count


def test_images_outside_the_record_phases_are_scored_by_themselves():
    truth = np.array([[-1.0, 0.0, 0.5]] * 4)
    force = truth + np.array([[0.1, 0, 0], [0.4, 0, -0.3], [np.nan] * 3, [0.0, 0, 0.6]])
    columns = {"true_force": truth, "force": force, "force_stddev": np.full((4, 3), 0.2)}
    scored = np.array([True, False, False, False])
    score = score_case([vectors().at(np.array([0, 0, 0, 0])).with_columns(scored=scored, **columns)], span=1.0)
    assert (score.all.n, score.moving.n) == (1, 2)
    assert score.moving.answered_pct == pytest.approx(200 / 3)
    assert score.moving.vector_rmse_N == pytest.approx(np.sqrt((0.25 + 0.36) / 2))
    assert score.moving.axis_rmse_N == pytest.approx((np.sqrt(0.08), 0.0, np.sqrt(0.225)))
    assert (score.all.n_off, score.moving.n_off) == (0, 2)
    unmeasured = vectors().with_columns(scored=np.zeros(2, bool), true_force=np.full((2, 3), np.nan))
    assert score_case([unmeasured], span=1.0).moving.n == 0


def test_without_stated_deviations_nothing_is_said_of_them():
    stats = score_case([vectors(force_stddev=None)], span=1.0).all
    assert stats.within_3_sigma_pct is stats.sharpness is None and stats.vector_rmse_N is not None


def test_each_direction_and_cycle_has_its_own_errors():
    truth = np.tile(vectors().true_force[:1], (4, 1))
    force = truth + np.outer([0.1, 0.2, 0.3, 0.4], [0.0, 0.0, 1.0])
    stages = {"direction": np.array(["load", "unload", "load", "unload"]), "cycle": np.array([1, 1, 2, 2])}
    case = vectors().at(np.zeros(4, int)).with_columns(true_force=truth, force=force, **stages)
    found = {name: stats.axis_rmse_N[2] for name, stats in score_case([case], span=1.0).stages.items()}
    assert found == pytest.approx({"load 1": 0.1, "unload 1": 0.2, "load 2": 0.3, "unload 2": 0.4})
    assert not score_case([case.with_columns(direction=np.full(4, ""))], span=1.0).stages


def test_a_truth_that_is_a_magnitude_along_x_says_nothing_of_the_vector():
    stats = score_case([make_result(truth=[1.0, 2.0], force=[1.1, 2.0])], span=1.0).all
    assert (stats.vector_rmse_N, stats.axis_rmse_N, stats.within_3_sigma_pct) == (None, None, None)


def test_answered_is_the_share_of_what_was_to_be_answered():
    result = make_result(
        truth=[1.0, 1.0, 1.0, 1.0],
        force=[1.0, np.nan, 1.0, np.nan],
        direction=np.array(["load", "load", "unload", "unload"]),
        scored=np.array([True, True, True, False]),
    )
    score = score_case([result], span=1.0)
    assert score.all.answered_pct == pytest.approx(200.0 / 3.0)
    assert (score.load.answered_pct, score.unload.answered_pct) == (50.0, 100.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda force: force, ""),
        (lambda force: 1.3 * force + 0.1, ""),
        (lambda force: 102.0 * force, "gram-force"),
        (lambda force: 102.0 * (force + 0.5), "gram-force"),
        (lambda force: 0.225 * force, "pound-force"),
        (lambda force: 1e6 * force, "1e+06 times the estimated ones: counts"),
        (lambda force: 1.3 * np.roll(force, 9), "come 0.30 s later than the estimated ones"),
        (lambda force: np.roll(force, -15), "come 0.50 s earlier than the estimated ones"),
        (lambda force: np.roll(force, 2), ""),
        (lambda force: force + 0.6, "is the sensor tared"),
        (lambda force: force + np.linspace(0.0, 0.8, len(force)), "by +0.70 N where no force is estimated: does the"),
        (lambda force: np.abs(force + np.random.default_rng(0).normal(scale=0.1, size=len(force))), ""),
    ],
)
def test_true_forces_in_other_units_or_of_an_untared_or_drifting_sensor_are_doubted(change, words):
    force = np.concatenate((np.zeros(30), np.linspace(0.1, 3.0, 60), np.zeros(40)))
    said = doubt_truth(make_result(truth=change(force), force=force))
    assert (words in said) if words else not said
