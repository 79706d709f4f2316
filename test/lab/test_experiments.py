"""Claims about the paper's experiments: resumed after a kill, honest of what failed, and right in what they count."""

import json
import subprocess
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from eval_fakes import cut, make_recording

from finforce.errors import FinforceError
from finforce_eval.cli.main import main
from finforce_eval.evaluation.scoring import Stats
from finforce_eval.machine import describe_sources
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_eval.table import ForceSeries
from finforce_eval.tasks import Manifest
from finforce_ifea.jaw.jaw import load_jaw
from finforce_sim.objects import place_object
from finforce_sim.scenarios import build_scenario
from lab.experiments import grasp_world
from lab.experiments.chip import CHIP
from lab.experiments.drawn import DRAWN, draw_scene
from lab.experiments.experiment import (
    Case,
    Experiment,
    RunOptions,
    average,
    keep_poses,
    list_missing,
    run_experiment,
    tabulate,
)
from lab.experiments.friction import FRICTION
from lab.experiments.grasp import GRASP, find_phases, score_grasp, thin_poses
from lab.experiments.manipulation import MANIPULATION, find_gravity, score_weight
from lab.experiments.network import NETWORK, name_condition
from lab.experiments.paper_tables import PLACES
from lab.harness import Figures, format_figures

DATA = Path(__file__).parents[2] / "finforce_eval" / "data"


class Counting:
    """An experiment that counts its runs; a case called `bad` fails."""

    def __init__(self, names=("one", "two", "three"), settings=None, stop_after=99):
        self.names, self.settings, self.stop_after, self.ran = names, settings or {}, stop_after, []

    def carry_out(self, report, engine=None):
        own = {name: getattr(self, name) for name in ("list_cases", "run", "find")}
        made = Experiment(name="count", title="Counting", about="It counts.", **own)
        return run_experiment(made, RunOptions(), report, engine)

    def list_cases(self, options):
        return [Case(name=name, settings=self.settings) for name in self.names]

    def find(self, options, figures, folder):
        return Figures(tables={"Letters": tabulate(figures)})

    def run(self, options, case, folder):
        if len(self.ran) >= self.stop_after:
            raise KeyboardInterrupt
        if case.name == "bad":
            raise FinforceError("it is bad")
        self.ran.append(case.name)
        return {"letters": len(case.name), "nothing": float("nan")}


def test_a_run_that_was_killed_goes_on_where_it_was(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        Counting(stop_after=2).carry_out(tmp_path)
    assert not (tmp_path / "count" / "count.json").exists()
    again = Counting()
    again.carry_out(tmp_path)
    assert again.ran == ["three"]
    rows = json.loads((tmp_path / "count" / "count.json").read_text())["count"]["rows"]["Letters"]
    assert sum(row["letters"] for row in rows) == 11
    assert "It counts." in (tmp_path / "count" / "README.md").read_text()
    nothing = Counting()
    nothing.carry_out(tmp_path)
    assert nothing.ran == []


def test_a_line_that_was_cut_off_is_run_again_and_others_stay(tmp_path):
    Counting().carry_out(tmp_path)
    log = tmp_path / "count" / "_manifest.jsonl"
    log.write_text(log.read_text()[:-20])
    again = Counting()
    again.carry_out(tmp_path)
    assert again.ran == ["three"]
    assert list(Manifest(log.parent).read()) == ["one", "two", "three"]


def test_other_settings_are_another_case(tmp_path):
    Counting().carry_out(tmp_path)
    other = Counting(settings={"size": 2})
    other.carry_out(tmp_path)
    assert other.ran == ["one", "two", "three"]


def test_other_code_is_another_case(tmp_path, monkeypatch):
    Counting().carry_out(tmp_path)
    monkeypatch.setattr("lab.experiments.experiment.commit", lambda: "another")
    other = Counting()
    other.carry_out(tmp_path)
    assert other.ran == ["one", "two", "three"]


def test_sources_are_told_apart_by_their_changes(tmp_path):
    file = tmp_path / "module.py"
    file.write_text("one = 1\n")
    assert describe_sources(file) == "unknown"
    who = ("-c", "user.name=A", "-c", "user.email=a@b.c")
    for words in (("init", "-q"), ("add", "module.py"), (*who, "commit", "-qm", "One")):
        subprocess.run(("git", *words), cwd=tmp_path, check=True)
    clean = describe_sources(file)
    (tmp_path / "notes.txt").write_text("not of the sources")
    assert describe_sources(file) == clean and "dirty" not in clean
    told = []
    for text in ("one = 2\n", "one = 3\n"):
        file.write_text(text)
        told.append(describe_sources(file))
    assert all(text.startswith(f"{clean}-dirty-") for text in told) and told[0] != told[1]


def test_a_jaw_file_with_another_content_is_another_case(tmp_path):
    jaw = tmp_path / "jaw.yaml"
    cases = []
    for text in ("one", "two"):
        jaw.write_text(text)
        cases.append(MANIPULATION.list_cases(RunOptions(jaw=str(jaw)))[0])
    assert cases[0].settings != cases[1].settings


def test_a_case_that_fails_costs_itself_only_and_is_named(tmp_path, capsys):
    experiment = Counting(names=("one", "bad", "two"))
    experiment.carry_out(tmp_path)
    assert experiment.ran == ["one", "two"]
    assert "failed: bad: it is bad" in capsys.readouterr().err
    assert json.loads((tmp_path / "count" / "count.json").read_text())["count"]["failed"] == {"bad": "it is bad"}
    assert "2 of 3 cases" in (tmp_path / "count" / "README.md").read_text()


def test_nothing_but_failures_is_an_error(tmp_path):
    with pytest.raises(FinforceError, match="not one of 1 cases gave figures.*it is bad"):
        Counting(names=("bad",)).carry_out(tmp_path)


def first_table(figures):
    return next(iter(figures.tables.values()))


def grasp_of(error=0.0, stddev=0.1):
    """A grasp that rises to 4 N within a second, rests for one and is let go within another; an image each 20 ms."""
    seconds = np.arange(0.0, 4.0, 0.02)
    truth = np.interp(seconds, [0.5, 1.5, 2.5, 3.5], [0.0, 4.0, 4.0, 0.0])
    found = truth + error * (truth > 0.0)
    return pd.DataFrame({"seconds": seconds, "truth": truth, "found": found, "stddev": stddev, "delay": 0.0})


def test_phases_follow_from_the_true_force():
    grasp = grasp_of()
    phases, seconds = find_phases(grasp), grasp.seconds
    assert seconds[phases["load"]].max() == pytest.approx(1.5, abs=0.05)
    assert seconds[phases["release"]].min() == pytest.approx(2.75, abs=0.05)
    assert (phases["all"] == (phases["load"] | phases["hold"] | phases["release"])).all()


def test_a_grasp_is_scored_by_phase():
    score = score_grasp(grasp_of(error=0.2))
    assert score["rmse_N"] == pytest.approx(dict.fromkeys(("all", "load", "hold", "release"), 0.2))
    assert score["nrmsd_pct"]["all"] == pytest.approx(5.0, rel=0.04)
    assert score["answered_pct"] == 100.0
    assert score["within_3_sigma_pct"] == 100.0
    assert score_grasp(grasp_of(error=0.2, stddev=0.05))["within_3_sigma_pct"] == 0.0
    assert score["delay_ms"][0] < 20.0


def test_images_without_an_answer_are_counted():
    grasp = grasp_of()
    grasp.loc[find_phases(grasp)["hold"], "found"] = np.nan
    score = score_grasp(grasp)
    assert score["answered_pct"] < 75.0
    assert score["rmse_N"]["load"] == 0.0
    assert np.isnan(score["rmse_N"]["hold"])


def test_a_weight_is_scored_along_gravity():
    angles = np.linspace(0.0, 2.0 * np.pi, 50)
    true = np.column_stack((np.sin(angles), np.zeros(50), np.cos(angles)))
    found = 1.1 * true + (0.0, 0.3, 0.0)
    net = ForceSeries.build(
        "turn", "gripper", np.arange(50), force=found, true_force=true, force_stddev=np.full((50, 3), 0.1)
    )
    score = score_weight(net)
    assert score["along_rmse_N"] == pytest.approx(0.1)
    assert score["along_bias_N"] == pytest.approx(0.1)
    assert score["across_rmse_N"] == pytest.approx(0.3)
    assert score["within_3_sigma_pct"] == 100.0


def test_a_level_gripper_that_rolls_is_told_which_way_things_fall():
    case = MANIPULATION.list_cases(RunOptions())[0]
    directions = find_gravity(case.settings).direction
    assert directions[0] == pytest.approx([0.0, -1.0, 0.0])  # a level gripper that rolls
    assert directions[:, 0].min() == pytest.approx(-1.0, abs=1e-3) and np.abs(directions[:, 2]).max() < 1e-9


def test_the_twin_has_27_grasps_with_seeds_of_their_own():
    cases = GRASP.list_cases(RunOptions())
    assert len({case.name for case in cases}) == 27
    assert len({case.settings["seed"] for case in cases}) == 27
    assert len(MANIPULATION.list_cases(RunOptions())) == 12
    assert len(CHIP.list_cases(RunOptions())) == 60
    assert len(PLACES.list_cases(RunOptions())) == 3


def test_quick_cases_are_some_of_the_others():
    for kind in (GRASP, MANIPULATION, CHIP, PLACES):
        every, few = ([c.name for c in kind.list_cases(RunOptions(quick=q))] for q in (False, True))
        assert set(few) < set(every)


class ScriptedJaw:
    """A jaw that says of its images what it is told to."""

    def __init__(self, pressed, side):
        self._words = iter(pressed.script[side])
        self.contact = SimpleNamespace(estimate=SimpleNamespace(touching=True))

    def follow_jaw(self, T_camera_jaw):
        pass

    def update(self, observation):
        status, message = next(self._words)
        force = np.array([3.0, 0.0, 0.0])
        return SimpleNamespace(
            status=status, message=message, trusted=status == "ok", force=force, force_stddev=0.1 * force
        )


def test_images_without_a_force_are_told_with_what_the_jaws_said(monkeypatch):
    monkeypatch.setattr(grasp_world, "build_loop", ScriptedJaw)
    fine, doubt, start = ("ok", ""), ("unobservable", "they do not fit"), ("waiting", "for the tare")
    script = {"left": [start, fine, fine, fine], "right": [start, fine, doubt]}
    seen = SimpleNamespace(origin_x=0.0, keypoints=np.zeros((8, 3)))
    jaws = [{"left": seen, "right": seen}] * 3 + [{"left": seen}]
    states = iter(SimpleNamespace(stamp=0.1 * n, jaws=each, T_gripper_object=np.eye(4)) for n, each in enumerate(jaws))
    pressed = SimpleNamespace(script=script, jaws=script, state=lambda *_: next(states))
    sensor = grasp_world.EstimatorSensor(pressed, 0)
    sensor._next_pose = np.inf
    assert [sensor.measure(0.1 * n, 3.0, 0.02) for n in range(4)] == [None, 3.0, None, None]
    assert [words for _, words in sensor.untold] == [
        "right unobservable: they do not fit",
        "right not found in the image",
    ]
    assert [stamp for stamp, _ in sensor.untold] == pytest.approx([0.2, 0.3])


def test_why_a_grasp_ended_early_is_on_the_page(tmp_path):
    row = {"way": "force", "peak_N": 3.0, "end_N": 2.9, "is_broken": False, "error": "", "violations": 0,
           "drawn": {"seconds": [0.0], "force": [0.0]}, "untold": []}  # fmt: skip
    row |= {"within_3_sigma_pct": 100.0}
    early = {"error": "the newest force is 0.27 s old", "untold": [[0.1, "left waiting"], [0.2, "right unobservable"]]}
    findings = CHIP.find(RunOptions(), {"force_00": row, "force_01": row | early}, tmp_path)
    assert "force_01 ended early: the newest force is 0.27 s old (right unobservable)" in findings.notes[1]
    assert "force_00" not in findings.notes[1]
    (row,) = first_table(findings).to_dict("records")
    assert (row["grasps"], row["images without force"], row["ended early"]) == (2, 2, 1)


def test_a_recording_that_lacks_something_is_told_what(tmp_path, capsys):
    one = make_recording("one")
    assert list_missing(one, ("left", "right")) == ["/right/ground_truth_wrench"]
    assert list_missing(replace(one, object_pose=None), ("left",)) == ["/object_pose"]
    bag = write_recording(replace(one, object_pose=None), tmp_path / "one")
    assert main(["experiment", "grasp", "--on", str(bag), "--report", str(tmp_path / "report")]) == 2
    words = capsys.readouterr().err
    assert "/right/ground_truth_wrench; /object_pose" in words
    assert not (tmp_path / "report").exists()


def test_an_object_that_is_hidden_has_no_poses_any_more():
    one = make_recording("one")
    stamps = one.object_pose.stamps_ns
    hidden = keep_poses(one, stamps < stamps[5])
    assert len(hidden.object_pose.stamps_ns) == 5
    assert len(hidden.object_pose.position) == 5
    assert len(one.object_pose.stamps_ns) > 5


def tracked_recording():
    """A recording with poses of the object at 30 Hz for 3 s."""
    one = make_recording("one")
    track, count = one.object_pose, 90
    stamps = track.stamps_ns[0] + np.round(np.arange(count) * 1e9 / 30.0).astype(int)
    many = replace(
        track, stamps_ns=stamps, position=np.zeros((count, 3)), quaternion=np.tile([0.0, 0, 0, 1], (count, 1))
    )
    return replace(one, object_pose=many)


def test_poses_at_a_lower_rate_are_some_of_those_that_there_are():
    recording = tracked_recording()
    assert [len(thin_poses(recording, rate).object_pose.stamps_ns) for rate in (30.0, 10.0, 3.0)] == [90, 30, 9]
    gaps = np.diff(thin_poses(recording, 10.0).object_pose.stamps_ns)
    np.testing.assert_allclose(gaps, 1e8, atol=2)


@pytest.mark.parametrize(("settings", "counts", "delays"), [
    ({"words": {"level": "medium"}}, [30, 15, *[90] * 3, *[30] * 3, *[9] * 3], [0, 0, *[0, 100, 250] * 3]),
    ({"words": {"level": "high"}}, [30, 15], [0, 0]),
    ({"bag": "mine"}, [90, 45], [0, 0]),
])  # fmt: skip
def test_poses_of_the_twin_come_at_10_hz_and_at_medium_force_at_other_rates_and_delays_too(
    settings, counts, delays, monkeypatch, tmp_path
):
    recording, given = tracked_recording(), []
    joined = grasp_of().assign(stamp=lambda grasp: recording.object_pose.stamps_ns[0] + 1e9 * grasp.seconds)
    fakes = {
        "evaluate_all": lambda recordings, setup: given.append((recordings[0], setup)),
        "with_displacement": lambda case: case,
        "join_jaws": lambda *_: joined,
        "axis_sharpness": lambda _: {},
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(f"lab.experiments.grasp.{name}", fake)
    monkeypatch.setattr(RunOptions, "open_case", lambda *_: nullcontext(recording))
    found = GRASP.run(RunOptions(), Case(name="one", settings=RunOptions().shared | settings), tmp_path)
    assert [len(one.object_pose.stamps_ns) for one, _ in given] == counts
    assert [1e-6 * setup.contacts.pose_delay for _, setup in given] == delays
    assert len(found["poses"]) == len(given) - 2


def test_grasps_of_the_paper_are_repeated_with_friction_a_probe_and_in_each_light():
    cases = FRICTION.list_cases(RunOptions())
    assert len({case.name for case in cases}) == len(cases) == 27 + 9
    assert all(case.settings["changes"]["roughness"] == 0.5 for case in cases)
    probed = [case.settings for case in cases if case.settings["changes"]["probe"]]
    assert [one["words"]["level"] for one in probed] == ["medium"] * 9
    assert {case.settings["changes"]["tracking"] for case in GRASP.list_cases(RunOptions())} == {30.0}
    smooth = {case.settings["seed"]: case.settings["words"] for case in GRASP.list_cases(RunOptions())}
    assert all(case.settings["words"].items() >= smooth[case.settings["seed"]].items() for case in cases)
    assert [bool(case.settings["changes"]["probe"]) for case in FRICTION.list_cases(RunOptions(quick=True))] == [
        *[False] * 3, *[True] * 3
    ]  # fmt: skip
    words = [case.settings["words"] for case in NETWORK.list_cases(RunOptions(network="checkpoint.pt"))]
    assert pd.Series([name_condition(one) for one in words]).value_counts().to_dict() == {
        "trained object, trained light": 6,
        "trained object, unseen light": 6,
        "unseen object, trained light": 3,
        "unseen object, unseen light": 3,
    }


@pytest.mark.parametrize("jaw", ["bench", "ssg48_fin_ray_1"])
def test_drawn_scenes_are_the_same_for_a_seed_and_fit_the_jaw(jaw):
    candidates = load_jaw(jaw).candidates[:, 2]
    drawn = [draw_scene(seed, jaw) for seed in range(40)]
    assert drawn[7] == draw_scene(7, jaw)
    assert len({each["scene"] for each in drawn}) > 5 and len({each["size"] for each in drawn}) == 4
    for each in drawn:
        scenario = build_scenario(each["scene"], **each["changes"])  # refuses numbers out of their bounds
        assert candidates.min() < scenario.height < candidates.max()
        width = np.ptp(place_object(scenario).centred.vertices[:, 0])
        assert 0.0119 < width < 0.0451
        assert (each["lens"] == "d405") == (not each["detector"])


def test_the_median_and_the_worst_of_drawn_scenes_are_told():
    row = {"scene": "hold", "object": "cube", "camera": "", "light": "dim", "rate/Hz": 30.0, "friction": 0.0}
    row |= {"press/mm": 3.0, "images": 100, "answered": 90, "rmse_N": 0.1, "within_3_sigma_pct": 100.0}
    row |= {axis: {"rmse_N": 0.1} for axis in "xyz"} | {"sharpness": dict.fromkeys("xyz", 2.0)}
    worse = row | {"answered": 30, "rmse_N": 0.3, "within_3_sigma_pct": 60.0, "x": {"rmse_N": 0.5}}
    silent = row | {"answered": 0, "rmse_N": None, "within_3_sigma_pct": np.nan, "x": {"rmse_N": np.nan}}
    rows = {"100": row, "101": worse, "102": silent}
    tables = DRAWN.find(RunOptions(), rows, Path()).tables
    median, worst = (tables["all"].set_index("scene").loc[name] for name in ("median", "worst"))
    assert median["x/N"] == pytest.approx(0.3) and worst["x/N"] == 0.5
    assert median["answered/%"] == pytest.approx(30.0) and worst["answered/%"] == 0.0
    assert worst["within 3σ/%"] == 60.0 and worst["sharp x"] == 2.0
    assert list(tables["scenes"].seed) == list(rows)


def test_a_drawn_scene_is_rendered_and_scored_with_its_lens(tmp_path, monkeypatch):
    case = DRAWN.list_cases(RunOptions(seed=3))[0]
    made = []

    @contextmanager
    def opened(options, case, folder):
        made.append(case.settings)
        yield "recording"

    evaluation = SimpleNamespace(total=SimpleNamespace(all=Stats(n=0), record_frames=5))
    monkeypatch.setattr(RunOptions, "open_case", opened)
    monkeypatch.setattr("lab.experiments.drawn.evaluate_all", lambda recordings, setup: evaluation)
    found = DRAWN.run(RunOptions(), case, tmp_path)
    assert made[0]["lens"] == draw_scene(3)["lens"] and made[0]["size"] == draw_scene(3)["size"]
    assert found["images"] == 5 and found["answered"] == 0 and np.isnan(found["x"]["rmse_N"])
    quick = DRAWN.list_cases(RunOptions(seed=3, quick=True, size="320x240"))[0].settings
    assert quick["size"] == "320x240" and quick["changes"]["rate"] == 15.0 and quick["lens"] == made[0]["lens"]


def test_errors_of_both_methods_are_over_the_images_for_which_both_have_a_force(tmp_path):
    row = {"images": 10, "object": "cube", "light": "bright"}
    rows = {
        "one": row | {"compared": 8, "found": 0.08, "network": 2.0},
        "two": row | {"compared": 2, "found": 0.02, "network": 0.5},
    }
    tables = NETWORK.find(RunOptions(network="n"), rows, tmp_path).tables
    (found,) = tables["conditions"].to_dict("records")
    assert (found["seen"], found["grasps"], found["images"]) == ("trained object, trained light", 2, 20)
    assert found["compared"] == 10
    assert found["finforce: RMSE/N"] == pytest.approx(0.1) and found["network: RMSE/N"] == pytest.approx(0.5)
    assert found["network : finforce"] == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["network"], "--network RUN/checkpoint.pt"),
        (["friction", "--on", "some_bag"], "expected twin"),
        (["drawn", "--on", "some_bag"], "expected twin"),
        (["nothing"], "got 'nothing', expected one of"),
        (["chip", "--on", "some_bag"], "expected twin"),
        (["grasp", "--on", "twin", "a_bag"], "not both"),
        (["grasp", "--seed", "-1"], "from 0"),
        (["grasp", "--on", "no_such_bag"], "no_such_bag"),
    ],
)
def test_what_cannot_be_run_is_one_line(words, expected, tmp_path, capsys):
    try:
        code = main(["experiment", *words, "--report", str(tmp_path)])
    except SystemExit as end:
        code = end.code
    assert code == 2
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1


def test_places_run_on_a_recording_and_only_of_the_papers_cylinder(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("lab.experiments.paper_tables.OTHERS", {})  # what takes long, and is tested elsewhere
    whole = read_recording(DATA / "bench_cyl25_middle")
    begin = int(whole.jaw("left").keypoints.stamps_ns[0])
    (tmp_path / "objects").symlink_to(DATA / "objects")
    pressed = cut(whole, begin, begin + 11 * 10**9)

    def write(name, diameter):
        case = {**pressed.case, "object": {**pressed.case["object"], "diameter": diameter}}
        return str(write_recording(replace(pressed, case=case), tmp_path / name))

    command = ["experiment", "places", "--calibration", "bench", "--report", str(tmp_path), "--on"]
    assert main([*command, write("named_12", 12)]) == 2
    assert "object.diameter 12 and" in capsys.readouterr().err
    other, bag = write("named_25", 25), write("named_15", 15)
    assert main([*command, other]) == 2
    assert "none of 1 recordings is of 15 mm" in capsys.readouterr().err
    assert main([*command, other, bag]) == 0
    figures = json.loads((tmp_path / "places" / "places.json").read_text())["places"]["figures"]
    assert list(figures) == ["named_15"]
    contacts = figures["named_15"]["contacts"]
    assert contacts["estimate"]["rmse_N"] < 0.2 and contacts["middle"]["rmse_N"] < 0.2
    assert "(0.24)" in capsys.readouterr().out
    assert bag not in (tmp_path / "places" / "README.md").read_text()


def test_tables_have_a_title_and_a_note():
    table = tabulate({"x": {"b": 1, "drawn": [1]}})
    lines = format_figures(Figures(tables={"T": table}, notes=["N."])).splitlines()
    assert lines[0] == "**T**" and lines[2].split() == ["|", "case", "|", "b", "|"] and lines[-1] == "N."


def test_averages_are_of_what_is_known_in_the_order_of_the_groups():
    rows = {"a": {"g": "late", "e": {"all": 1.0}}, "b": {"g": "early", "e": {"all": None}}}
    rows |= {"c": {"g": "late", "e": {"all": 3.0}}}
    means = average(tabulate(rows), ("g",), {"e all": "error/N"})
    assert means.g.tolist() == ["late", "early"] and means.n.tolist() == [2, 1]
    assert means["error/N"].tolist() == pytest.approx([2.0, np.nan], nan_ok=True)
    assert means["±error/N"].tolist() == pytest.approx([1.0, np.nan], nan_ok=True)


def test_grasps_and_turns_are_put_in_tables(tmp_path):
    phases = dict.fromkeys(("all", "load", "hold", "release"), 0.1)
    series = {"seconds": [0.0, 1.0], "truth": [0.0, 2.0], "found": [0.0, 2.1]}
    score = {"rmse_N": phases, "nrmsd_pct": phases, "peak_N": 2.0, "bias_N": 0.0, "max_error_N": 0.1}
    score |= {"answered_pct": 100.0, "within_3_sigma_pct": 100.0, "delay_ms": [100.0, None]}
    score |= {"sharpness": {"x": 1.5, "y": None, "z": 2.0}}
    row = {**score, "hidden": score, "drawn": series, "object": "cube", "place": "upper", "level": "low"}
    found = GRASP.find(RunOptions(), {"one": row}, tmp_path)
    assert list(found.tables) == ["By force", "Each grasp"]
    slow = row | {"level": "medium", "poses": {"3 Hz, 0 ms late": score}}
    assert GRASP.find(RunOptions(), {"one": row, "two": slow}, tmp_path).tables["Poses"].n.tolist() == [1]
    conditions = {name: row | {"condition": name, "supported": score} for name in ("unprobed", "probed")}
    rough = first_table(FRICTION.find(RunOptions(), conditions, tmp_path))
    assert rough[["condition", "force"]].to_numpy().tolist() == [
        [name, force] for force in ("low", "all") for name in conditions
    ]
    assert first_table(found).force.tolist() == ["low", "all"]
    assert first_table(found)["shows after/ms"].tolist() == [100.0, 100.0]
    assert first_table(found)["sharp z"].tolist() == [2.0, 2.0]
    one = np.eye(3)[:2]
    net = ForceSeries.build("one", "gripper", np.arange(2), force=one, true_force=one)
    turn = score_weight(net) | {"axis": "roll", "light": "dim"}
    found = MANIPULATION.find(RunOptions(), {"one": turn}, tmp_path)
    assert first_table(found)["paper/N"].tolist() == ["0.28 ± 0.02"]
