"""Claims about `finforce compare`: a change that would not come again is called none."""

import json

import numpy as np
import pytest
from eval_fakes import FakeEstimator, FakeJaw, evaluate_recording, make_recording

from finforce_contact.loop import GivenContact
from finforce_eval.cli.main import main
from finforce_eval.evaluation.comparison import compare_evaluations, total_change
from finforce_eval.evaluation.score_tables import evaluation_json
from finforce_eval.evaluation.scoring import score_results, true_range
from finforce_eval.machine import write_figures
from finforce_eval.table import write_table


def evaluation(squares, *, skipped=0, name="a", **about):
    """An evaluation of one recording with mean squared errors second by second [N^2]."""
    seconds = [[number, float(value), 30] for number, value in enumerate(squares)]
    case = {
        "all": {"rmse_N": float(np.sqrt(np.mean(squares)))},
        "record_frames": 1000,
        "record_skipped": skipped,
        "seconds": seconds,
    }
    return {"cases": {name: case}, **about}


def only(before, after):
    (change,) = compare_evaluations(before, after)
    return change


RANDOM = np.random.default_rng(5)
ERRORS = RANDOM.uniform(0.002, 0.006, 100)


def test_what_is_the_same_is_called_so():
    change = only(evaluation(ERRORS), evaluation(ERRORS))
    assert (change.outcome, change.difference) == ("same", 0.0)


@pytest.mark.parametrize(("factor", "outcome"), [(0.7, "better"), (1.4, "worse")])
def test_a_change_in_every_second_is_one(factor, outcome):
    change = only(evaluation(ERRORS), evaluation(factor * ERRORS))
    assert change.outcome == outcome
    assert change.difference == pytest.approx((np.sqrt(factor) - 1.0) * np.sqrt(ERRORS.mean()))


def test_one_bad_second_is_no_change_for_the_worse():
    after = ERRORS.copy()
    after[50] += 0.5
    change = only(evaluation(ERRORS), evaluation(after))
    assert change.difference > 0.01
    assert change.outcome == "unsure"


@pytest.mark.parametrize("block", [1, 4])
def test_chance_alone_is_rarely_called_a_change(block):
    outcomes = []
    for seed in range(400):
        random = np.random.default_rng(seed)
        first, second = np.repeat(random.chisquare(2, (2, 100 // block)) * 0.002, block, axis=1)
        outcomes.append(only(evaluation(first), evaluation(second)).outcome)
    assert sum(outcome in ("better", "worse") for outcome in outcomes) < 0.03 * len(outcomes)


def test_the_stated_chance_is_that_of_other_recordings():
    differences, stated = [], []
    for seed in range(300):
        random = np.random.default_rng(seed)
        first, second = random.chisquare(3, (2, 120)) * 0.002
        change = only(evaluation(first), evaluation(second))
        differences.append(change.difference)
        stated.append(change.stddev)
    assert np.std(differences) == pytest.approx(np.mean(stated), rel=0.15)


def test_without_seconds_or_with_few_nothing_is_sure():
    before, after = evaluation(ERRORS), evaluation(2 * ERRORS)
    del after["cases"]["a"]["seconds"]
    assert only(before, after).outcome == "unsure"
    assert only(evaluation(ERRORS[:8]), evaluation(2 * ERRORS[:8])).outcome == "unsure"


def test_recordings_of_one_evaluation_are_named_and_in_no_mean():
    changes = compare_evaluations(evaluation(ERRORS), evaluation(ERRORS, name="b"))
    assert {change.name: change.outcome for change in changes} == {"a": "gone", "b": "new"}
    assert np.isnan(total_change(changes).difference)


@pytest.fixture
def files(tmp_path):
    paths = tmp_path / "old.json", tmp_path / "new.json"
    paths[0].write_text(json.dumps(evaluation(ERRORS, solver="reduced")))
    paths[1].write_text(json.dumps(evaluation(2 * ERRORS, skipped=100, solver="solid")))
    return [str(path) for path in paths]


def test_recordings_that_were_renamed_are_said_to_be_paired_by_name(files, tmp_path, capsys):
    renamed = tmp_path / "renamed.json"
    renamed.write_text(json.dumps(evaluation(ERRORS, name="b")))
    for other, is_said in ((renamed, True), (files[1], False)):
        assert main(["compare", files[0], str(other)]) == 0
        assert ("No recording is in both: recordings are paired by name" in capsys.readouterr().out) == is_said


def test_table_and_json_tell_the_same(files, tmp_path, capsys):
    out = tmp_path / "out.json"
    assert main(["compare", *files, "--json", str(out)]) == 0
    said = capsys.readouterr().out
    assert "solver: reduced -> solid" in said
    assert "1 worse" in said and "100.0 90.0" in said
    assert json.loads(out.read_text())["changes"][0]["outcome"] == "worse"
    assert main(["compare", *files, "--strict"]) == 1
    assert main(["compare", files[0], files[0], "--strict"]) == 0


NO_NUMBER = '{"cases": {"a": {"all": {"rmse_N": "x"}, "record_frames": 1, "record_skipped": 0}}}'


@pytest.mark.parametrize("text", ["", "{", "[]", '{"cases": 3}', '{"cases": {"a": {}}}', NO_NUMBER, "[" * 5000])
def test_another_file_is_refused(text, files, tmp_path, capsys):
    other = tmp_path / "other.json"
    other.write_text(text)
    assert main(["compare", files[0], str(other)]) == 2
    said = capsys.readouterr().err
    assert "expected what finforce evaluate --json writes" in said and "Error(" not in said


def test_a_folder_without_scores_is_told_what_is_expected(files, tmp_path, capsys):
    (tmp_path / "annotated").mkdir()
    assert main(["compare", files[0], str(tmp_path / "annotated")]) == 2
    assert "no scores in it; expected a folder of finforce evaluate --out" in capsys.readouterr().err


def test_the_tables_of_an_evaluation_say_what_its_json_says(tmp_path, capsys):
    recording = make_recording("pressed")
    estimator = FakeEstimator(1.1 * recording.truth("left").force)
    result = evaluate_recording(recording, FakeJaw(keypoints=np.zeros((4, 3))), GivenContact(None), estimator)
    (tmp_path / "out").mkdir()
    about = {"about": {"jaw": "fake"}, "true_range_N": true_range(recording)}
    write_table(tmp_path / "out" / "pressed.parquet", [result], about)
    write_figures(tmp_path / "scores.json", evaluation_json(score_results([result], [recording]), jaw="fake"))
    assert main(["compare", str(tmp_path / "out"), str(tmp_path / "scores.json"), "--strict"]) == 0
    said = capsys.readouterr().out
    assert "1 the same, 0 unsure or in one file only" in said and "->" not in said
