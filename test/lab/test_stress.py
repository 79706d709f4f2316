"""Claims about the rules of a stress run: each of them can be broken, and then the run says so."""

import json
import time
from contextlib import suppress

import numpy as np
import pytest
from eval_fakes import answers, divide, fail_with, family_of, refuse

from finforce_eval.cli.main import main
from lab.cli.stress import FAMILIES, list_broken, worst_trials
from lab.stress.stress import (
    Plan,
    Trial,
    attempt,
    format_summaries,
    measure_longest,
    run_family,
    summarise,
    summarise_family,
    summarise_levels,
)


def broken(trials, **rules):
    return summarise("made", trials, **rules)["broken"]


# --- the rule: right within what is stated, or not sure


def test_answers_within_what_they_state_break_no_rule():
    assert broken(answers(200)) == []


def test_a_liar_is_caught():
    assert "97.0 % of the sure answers" in broken(answers(194) + answers(6, error=0.04))[0]


def test_one_in_a_hundred_may_be_beyond_three_sigma():
    assert broken(answers(99) + answers(1, error=0.04)) == []
    assert broken(answers(98) + answers(2, error=0.04))


def test_a_liar_who_says_that_it_is_not_sure_is_none():
    assert broken(answers(194) + answers(6, error=50.0, sure=False)) == []


def test_an_error_without_any_stated_deviation_is_a_lie():
    assert broken(answers(10, stddev=0.0))
    assert broken(answers(10, stddev=float("nan")))
    assert broken(answers(10, error=0.0, stddev=0.0)) == []


def test_the_farthest_component_decides():
    assert broken(answers(10, errors=(0.01, 0.0, 0.031, 0.0, 0.0)))
    assert broken(answers(10, errors=(0.01, 0.0, 0.029, 0.0, 0.0))) == []


def test_who_is_never_sure_is_useless():
    silent = answers(10, sure=False)
    assert broken(silent) == []
    assert "0.0 % of the answers are sure" in broken(silent, least_sure=0.5)[0]


# --- time, NaN, crashes, hanging


def test_a_step_of_eleven_medians_is_caught_and_one_of_nine_is_not():
    assert "11.0 times the median" in broken(answers(50) + answers(1, step_time=11e-3))[0]
    assert broken(answers(50) + answers(1, step_time=9e-3)) == []
    assert broken(answers(50) + answers(1, step_time=11e-3), timed=False) == []


def test_a_nan_that_leaves_is_caught():
    assert broken(answers(50) + answers(1, nan=True)) == ["1 answers are not finite"]


def test_our_errors_are_refusals_and_any_other_is_a_crash():
    assert fail_with(refuse).outcome == "refused"
    assert broken([*answers(5), fail_with(refuse)]) == []
    crashed = fail_with(divide)
    assert crashed.outcome == "crashed" and "ZeroDivisionError" in crashed.note
    assert broken([*answers(5), crashed]) == ["1 trials crashed"]


def test_a_step_that_hangs_is_ended():
    hung = fail_with(lambda: time.sleep(5.0), limit=0.05)
    assert hung.outcome == "hung"
    assert broken([*answers(5), hung]) == ["1 trials hung"]


def test_nothing_in_a_step_keeps_it_from_being_ended():
    def swallow():
        with suppress(Exception):
            time.sleep(5.0)

    assert fail_with(swallow, limit=0.05).outcome == "hung"


def test_no_trials_are_no_success():
    assert broken([]) == ["no trial was run"]


def test_a_family_that_fails_between_its_steps_is_a_crash():
    def run(plan):
        yield from answers(2)
        divide()

    family = family_of([])
    trials = run_family(type(family)(name="made", what="", run=run), Plan())
    assert [trial.outcome for trial in trials] == ["answer", "answer", "crashed"]


def test_a_step_that_was_long_by_chance_is_timed_again():
    times = iter([1e-3] * 9 + [50e-3] + [1e-3] * 10)

    def run(plan):
        yield from (Trial(step_time=next(times)) for _ in range(10))

    assert measure_longest(run_family(type(family_of([]))(name="made", what="", run=run), Plan())) == 1.0


def test_judging_is_not_timed():
    def judge(got):
        end = time.thread_time() + 0.05
        while time.thread_time() < end:
            pass
        return Trial()

    assert attempt(0, lambda: None, judge).step_time < 0.05


# --- summaries


def test_figures_are_of_what_they_say():
    trials = answers(3, error=0.02)
    trials += answers(1, sure=False, error=9.0)
    summary = summarise("made", trials)
    expected = {"n": 4, "sure": 0.75, "worst_error": 0.02}
    expected |= {"median_sigmas": pytest.approx(2.0)}
    assert {key: summary[key] for key in expected} == expected


def test_stated_deviations_as_large_as_the_errors_are_sharp():
    summary = summarise("made", answers(3, error=0.01, stddev=0.02) + answers(3, error=0.03, stddev=0.02))
    assert summary["sharpness_x"] == pytest.approx(0.02 / np.sqrt(5e-4))
    assert np.isnan(summary["sharpness_y"])  # no error, nothing to be sharp about


def test_levels_keep_their_order():
    trials = answers(2, level="b") + answers(1, level="a") + answers(1, level="b")
    assert [(level["name"], level["n"]) for level in summarise_levels(trials)] == [("b", 3), ("a", 1)]


def test_table_has_one_row_per_summary_and_no_nan():
    lines = format_summaries([summarise("first", answers(2)), summarise("second", [])]).splitlines()
    assert len(lines) == 4 and lines[2].startswith("| first") and "nan" not in "".join(lines)


def test_worst_trials_begin_with_what_is_broken():
    trials = answers(20) + answers(1, error=0.05) + [fail_with(divide)]
    outcomes = [(trial.outcome, trial.force_error) for trial in worst_trials(trials)[:2]]
    assert outcomes[0][0] == "crashed" and outcomes[1] == ("answer", 0.05)


def test_what_is_broken_is_told_of_the_family_and_of_each_level():
    family = family_of(answers(5) + answers(5, error=1.0, level="far"))
    trials = run_family(family, Plan())
    told = "\n".join(list_broken(summarise_family(family, trials), trials))
    assert "broken: made: 50.0 %" in told and "broken: made, far: 0.0 %" in told


# --- plans and the command


def test_a_seed_draws_the_same_and_other_keys_another():
    first, again = (Plan(seed=3).random("noise", 1).normal(size=4) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert (Plan(seed=3).random("noise", 2).normal(size=4) != first).all()
    assert (Plan(seed=4).random("noise", 1).normal(size=4) != first).all()


def test_families_have_names_of_their_own_and_say_what_they_do():
    assert {"subsets", "noise", "gross", "clusters", "jumps", "stamps", "long", "contacts", "forces"} <= set(FAMILIES)
    assert all(family.what and "\n" not in family.what for family in FAMILIES.values())


@pytest.fixture
def one_family(monkeypatch):
    def use(trials):
        monkeypatch.setattr("lab.cli.stress.FAMILIES", {"made": family_of(trials)})

    return use


def test_command_ends_with_zero_when_every_rule_holds(one_family, capsys, tmp_path):
    one_family(answers(5))
    out = tmp_path / "stress.json"
    assert main(["stress", "--json", str(out), "--seed", "4"]) == 0
    content = json.loads(out.read_text())
    assert content["plan"]["seed"] == 4 and content["families"]["made"]["n"] == 5 and "machine" in content
    assert "made" in capsys.readouterr().out


def test_command_ends_with_one_when_a_rule_is_broken(one_family, capsys):
    one_family(answers(5, error=1.0))
    assert main(["stress"]) == 1
    assert "broken: made: 0.0 % of the sure answers" in capsys.readouterr().out


def test_a_level_that_breaks_the_rule_is_not_averaged_away(one_family, capsys):
    one_family(answers(300, level="near") + answers(2, error=1.0, level="far"))
    assert main(["stress"]) == 1
    out = capsys.readouterr().out
    assert "broken: made, far: 0.0 % of the sure answers" in out and "broken: made: " not in out


def test_a_new_seed_is_drawn_and_told(one_family, capsys):
    one_family(answers(5))
    main(["stress", "--seed", "new"])
    main(["stress", "--seed", "new"])
    first, second = (line for line in capsys.readouterr().out.splitlines() if line.startswith("seed "))
    assert first.split(",")[0] != second.split(",")[0]


WRONG = [("--count", "0"), ("--count", "1e20"), ("--seed", "-1"), ("--families", "nothing")]


@pytest.mark.parametrize("options", WRONG)
def test_command_refuses_what_it_cannot_do(options, capsys):
    try:
        status = main(["stress", *options])
    except SystemExit as stop:
        status = stop.code
    assert status == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
