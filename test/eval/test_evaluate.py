"""Claims about running an estimator over a recording."""

from dataclasses import replace

import numpy as np
import pytest
from eval_fakes import PERIOD, FakeContactEstimator, FakeEstimator, FakeJaw, evaluate_recording, make_recording

from finforce.errors import FinforceError, ObservationError
from finforce_contact.loop import GivenContact
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.contact_source import RecordedContact, parse_contacts
from finforce_eval.evaluation.score_tables import evaluation_json, format_tables, score_table
from finforce_eval.evaluation.scoring import score_results
from finforce_eval.recordings.objects import track_object
from finforce_eval.recordings.tracks import DetectionTruth, JawTrack
from finforce_ifea.observation import Contact

CONTACT = Contact(points=np.array([[0.014, 0.0, 0.042]]), weights=np.ones(1), free=True)


def truth_of(recording):
    return recording.jaws["left"].truth.force


def run(recording, forces, **options):
    estimator = FakeEstimator(forces)
    jaw = FakeJaw(keypoints=np.zeros((4, 3)))
    result = evaluate_recording(recording, jaw, GivenContact(CONTACT), estimator, **options)
    return result, estimator


def test_every_frame_is_given_once_in_order_with_its_stamp_and_contact():
    recording = make_recording()
    _, estimator = run(recording, truth_of(recording))
    track = recording.jaws["left"].keypoints
    assert [round(seen.stamp * 1e9) for seen in estimator.observations] == track.stamps_ns.tolist()
    for seen, points, likelihood in zip(estimator.observations, track.points, track.likelihood, strict=True):
        np.testing.assert_array_equal(seen.points, points)
        np.testing.assert_array_equal(seen.likelihood, likelihood)
    assert set(estimator.contacts) == {CONTACT}


def test_true_estimate_has_no_error_and_a_bias_shows_with_its_sign():
    recording = make_recording()
    exact, _ = run(recording, truth_of(recording))
    assert score_results([exact], [recording]).total.all.rmse_N == 0.0
    weak, _ = run(recording, truth_of(recording) * 0.9)
    score = score_results([weak], [recording]).total
    magnitude = np.linalg.norm(truth_of(recording), axis=1)[exact.scored]
    assert score.all.bias_N == pytest.approx(-0.1 * magnitude.mean())
    assert score.all.rmse_N == pytest.approx(0.1 * np.sqrt(np.mean(magnitude**2)))


def test_phases_decide_what_is_scored():
    result, _ = run(make_recording(), truth_of(make_recording()))
    assert result.scored.tolist() == ([False] * 5 + [True] * 5) * 6
    assert result.column("cycle").tolist() == [0] * 30 + [1] * 30
    assert result.column("direction")[[0, 19, 20, 29, 59]].tolist() == ["load", "load", "unload", "unload", "unload"]


def test_every_frame_is_scored_without_phases():
    recording = make_recording(phases=False)
    result, _ = run(recording, truth_of(recording))
    score = score_results([result], [recording]).total
    assert score.all.n == score.record_frames == 60
    assert score.load.n == score.unload.n == 0


def test_frames_before_the_first_phase_are_not_scored():
    recording = make_recording()
    late = replace(recording, phases=replace(recording.phases, stamps_ns=recording.phases.stamps_ns + 20 * PERIOD))
    result, _ = run(late, truth_of(recording))
    assert not result.scored[:25].any()
    assert result.column("direction")[0] == ""


def test_without_a_frame_to_be_scored_the_phases_are_named():
    recording = make_recording()
    settling = replace(recording.phases, stage=np.full_like(recording.phases.stage, "settle"))
    with pytest.raises(RecordingError, match="none of the 60 frames is to be scored: /bench/phase names no 'record'"):
        run(replace(recording, phases=settling), truth_of(recording))
    late = replace(recording.phases, stamps_ns=recording.phases.stamps_ns + 1000 * PERIOD)
    with pytest.raises(RecordingError, match="its 'record' phases lie at none of their stamps"):
        run(replace(recording, phases=late), truth_of(recording))


def test_untrusted_steps_are_skipped_and_keep_their_status():
    recording = make_recording()
    forces = [None if index % 3 == 0 else force for index, force in enumerate(truth_of(recording))]
    result, _ = run(recording, forces)
    score = score_results([result], [recording]).total
    assert (score.frames, score.solved, score.skipped) == (60, 40, 20)
    assert np.isnan(result.force[0]).all()
    assert result.column("status")[:2].tolist() == ["not_enough_points", "ok"]
    assert not result.column("used")[0].any()


def test_truth_sampled_at_other_stamps_is_matched():
    recording = make_recording(phases=False)
    track = recording.jaws["left"]
    truth = replace(track.truth, stamps_ns=track.truth.stamps_ns + PERIOD // 2)
    shifted = replace(recording, jaws={"left": replace(track, truth=truth)})
    result, _ = run(shifted, truth.force)
    expected = 0.5 * (truth.force[:-1] + truth.force[1:])
    np.testing.assert_allclose(result.true_force[1:], expected, atol=1e-6)
    assert np.isnan(result.true_force[0]).all()
    assert score_results([result], [shifted]).total.all.n == 59


def test_same_recording_gives_the_same_result():
    recording = make_recording()
    first, _ = run(recording, truth_of(recording))
    second, _ = run(recording, truth_of(recording))
    np.testing.assert_array_equal(first.force, second.force)


def test_recording_without_truth_is_refused():
    with pytest.raises(RecordingError, match="no ground truth"):
        run(make_recording(truth=False), [])


def test_recording_of_another_jaw_is_refused():
    with pytest.raises(RecordingError, match="5 key points in /left/keypoints; the jaw 'fake' has 4"):
        run(make_recording(keypoints=5), [])
    recording = make_recording()
    stamps = recording.jaw("left").keypoints.stamps_ns
    sight = DetectionTruth(
        stamps_ns=stamps,
        points=np.zeros((len(stamps), 5, 3)),
        pixels=np.zeros((len(stamps), 5, 2)),
        visible=np.ones((len(stamps), 5), bool),
    )
    jaws = {**recording.jaws, "left": replace(recording.jaw("left"), sight=sight)}
    with pytest.raises(RecordingError, match="5 true key points of the left jaw; the jaw 'fake' has 4"):
        run(replace(recording, jaws=jaws), [])


def test_recording_of_which_nothing_is_solved_is_refused_with_the_reason():
    with pytest.raises(RecordingError, match=r"none of the frames .* \(30 not_enough_points\): all are hidden"):
        run(make_recording(), [None] * 60)


def test_truth_of_another_time_is_refused():
    recording = make_recording()
    track = recording.jaws["left"]
    truth = replace(track.truth, stamps_ns=track.truth.stamps_ns + 10**12)
    with pytest.raises(RecordingError, match="stamps of the key points; it begins 1000.0 s after them: two clocks"):
        run(replace(recording, jaws={"left": replace(track, truth=truth)}), truth.force)


def test_frame_that_the_estimator_refuses_is_named():
    class Refusing(FakeEstimator):
        def update(self, observation, contact):
            raise ObservationError("odd")

    with pytest.raises(ObservationError, match="case: frame 0: odd"):
        evaluate_recording(make_recording(), FakeJaw(), GivenContact(CONTACT), Refusing([]))


def test_two_cases_of_one_name_are_refused():
    recording = make_recording()
    result, _ = run(recording, truth_of(recording))
    with pytest.raises(FinforceError, match="two recordings are called case"):
        score_results([result, result], [recording, recording])


def test_right_jaw_is_evaluated_on_its_own_topics():
    recording = make_recording(side="right")
    assert isinstance(recording.jaws["right"], JawTrack)
    result, _ = run(recording, recording.jaws["right"].truth.force, side="right")
    assert result.side == "right"
    assert score_results([result], [recording]).total.all.rmse_N == 0.0


STATS = {
    "n",
    "rmse_N",
    "nrmsd_pct",
    "max_error_N",
    "bias_N",
    "vector_rmse_N",
    "axis_rmse_N",
    "within_3_sigma_pct",
    "sharpness",
    "n_off",
    "answered_pct",
    "torque_rmse_Nm",
    "torque_pct",
}
CASE = {"frames", "solved", "skipped", "all", "load", "unload", "moving", "step_ms"}


def test_json_has_the_agreed_keys():
    recording = make_recording("pressed")
    result, _ = run(recording, truth_of(recording) * 1.1)
    content = evaluation_json(score_results([result], [recording]), solver="fake")
    assert content["solver"] == "fake"
    assert list(content["cases"]) == ["pressed"]
    for case in (content["cases"]["pressed"], content["all"]):
        assert case.keys() >= CASE
        assert case["step_ms"].keys() == {"p50", "p95", "p99", "max"}
        for phase in ("all", "load", "unload", "moving"):
            assert case[phase].keys() == STATS


def test_tables_have_a_row_per_case_and_one_for_all():
    first, second = make_recording("first"), make_recording("second")
    results = [run(recording, truth_of(recording) * 1.1)[0] for recording in (first, second)]
    evaluation = score_results(results, [first, second])
    lines = format_tables(evaluation).splitlines()
    assert [line.split()[0] for line in lines if line[:1].isalpha()][:3] == ["first", "second", "all"]
    assert max(map(len, lines[:5])) <= 130
    table, spread = score_table(evaluation), evaluation.scores["first"].cycles["load"]["rmse_N"]
    assert table.index.tolist() == ["first", "second", "all"]
    assert table.loc["first", ("load", "RMSE/N")] == f"{spread['mean']:.2f}±{spread['std']:.2f}"


def estimated(recording, gain=1.0):
    source = RecordedContact(FakeContactEstimator(), track_object(recording, "left"))
    estimator = FakeEstimator(truth_of(recording) * gain)
    jaw = FakeJaw(keypoints=np.zeros((4, 3)))
    return evaluate_recording(recording, jaw, source, estimator)


def test_json_says_how_well_the_contact_was_known():
    recording = make_recording("pressed")
    content = evaluation_json(score_results([estimated(recording)], [recording]))
    case = content["cases"]["pressed"]
    assert case["contact"] == "estimate"
    # the object's origin is the jaw's: rows at -1 and 3 mm weigh 3 to 1, the truth is at 40 mm
    assert case["place"] == pytest.approx({"n": case["place"]["n"], "median_mm": 40.0, "p95_mm": 40.0, "max_mm": 40.0})
    assert case["solved_place"]["max_mm"] == pytest.approx(0.0, abs=1e-6)
    assert case["onset"].keys() == {"n", "missed", "median_frames", "earliest_frames", "max_frames", "false_pct"}
    assert case["contact_ms"]["p50"] > 0.0
    assert content["all"]["place"] == case["place"]


def test_contact_table_has_a_row_per_case_and_one_for_all():
    first, second = make_recording("first"), make_recording("second")
    evaluation = score_results([estimated(first), run(second, truth_of(second))[0]], [first, second])
    lines = format_tables(evaluation).splitlines()
    begin = next(index for index, line in enumerate(lines) if "given/mm" in line)
    assert [line.split()[0] for line in lines[begin + 2 : begin + 5]] == ["first", "second", "all"]
    assert lines[begin + 2].split()[1:4] == ["estimate", "40.00", "40.00"]
    assert lines[begin + 3].split()[1:3] == ["given", "2.00"]
    assert lines[begin + 3].split()[-6:] == ["-"] * 6


def test_table_of_a_case_without_counted_frames_has_dashes():
    recording = make_recording()
    result, _ = run(recording, truth_of(recording))
    nothing = result.with_columns(true_force=np.full_like(result.true_force, np.nan), step_ms=np.nan)
    text = format_tables(score_results([nothing], [recording]))
    assert "worst - N (case)" in text
    assert "p50 -" in text


def test_height_comes_from_the_option_then_from_the_case():
    recording = make_recording("pressed")
    assert parse_contacts([]).height(recording) == pytest.approx(0.040)
    assert parse_contacts(["fixed:case"]).height(recording) == pytest.approx(0.040)
    assert parse_contacts(["fixed:61.5"]).height(recording) == pytest.approx(0.0615)
    assert parse_contacts(["fixed:61.5", "pressed=20"]).height(recording) == pytest.approx(0.020)
    assert parse_contacts(["other=20"]).height(recording) == pytest.approx(0.040)


@pytest.mark.parametrize(
    "case", [{}, {"object": {}}, {"object": {"z": "high"}}, {"object": {"z": True}}, {"object": 3}]
)
def test_case_without_height_is_refused(case):
    with pytest.raises(OptionError, match="give --contact fixed:Z_MM"):
        parse_contacts([]).height(replace(make_recording(), case=case))


def test_a_mesh_without_poses_is_told_what_is_missing():
    choice = replace(parse_contacts([]), object_file="can.stl")
    with pytest.raises(OptionError, match="--object needs poses of the object: expected PoseStamped on /object_pose"):
        choice.height(make_recording())


@pytest.mark.parametrize("text", ["estimate", "closest", "paper"])
def test_estimators_have_no_fixed_height_but_a_name_may_have_one(text):
    recording = make_recording("pressed")
    choice = parse_contacts([text, "pressed=20"])
    assert choice.mode_for(recording, "left") == "fixed"
    assert choice.height(recording) == pytest.approx(0.020)
    assert choice.mode_for(make_recording("other"), "left") == text
    with pytest.raises(OptionError, match=f"--contact {text} has no fixed height"):
        choice.height(make_recording("other"))


@pytest.mark.parametrize("text", ["fixed:", "fixed:high", "fixed:nan", "40", "pressed=x", "somewhere"])
def test_malformed_contact_is_refused(text):
    with pytest.raises(OptionError, match="--contact"):
        parse_contacts([text])
