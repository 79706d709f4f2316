"""Claims about the `finforce` command: what it writes, and that bad input costs one line and status 2."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from eval_fakes import FakeEstimator, make_recording

from finforce_eval.cli import replay
from finforce_eval.cli.main import COMMANDS, build_parser, main, parse
from finforce_eval.cli.parser import CommandResult
from finforce_eval.errors import RecordingError, SilentReplayError
from finforce_eval.evaluation.keypoint_source import KeypointSource
from finforce_eval.recordings.writer import write_entries, write_recording

BENCH_KEYPOINTS = 15
ROOT = Path(__file__).resolve().parents[2]
CYLINDER = ROOT / "finforce_eval" / "data" / "objects" / "cylinder_25.stl"


def bench_recording(name="pressed", **options):
    return make_recording(name, keypoints=BENCH_KEYPOINTS, **options)


@pytest.fixture
def bag(tmp_path):
    return write_recording(bench_recording(), tmp_path / "pressed")


@pytest.fixture
def exact(monkeypatch):
    """Estimates that are a tenth above the truth."""
    forces = bench_recording().jaws["left"].truth.force * 1.1
    monkeypatch.setattr("finforce_eval.evaluation.setup.ForceEstimator", lambda *_, **__: FakeEstimator(forces))


def assert_refused(capsys, arguments, reason):
    """Status 2 and one line on stderr that gives the reason."""
    try:
        status = main([str(argument) for argument in arguments])
    except SystemExit as stop:
        status = stop.code
    captured = capsys.readouterr()
    assert status == 2
    assert captured.err.count("\n") == 1, captured.err
    assert captured.err.startswith("finforce")
    assert reason in captured.err
    assert captured.out == ""


def test_evaluate_prints_the_table_and_writes_json_and_report(tmp_path, bag, exact, capsys):
    out, report = tmp_path / "new" / "scores.json", tmp_path / "report"
    assert main(["evaluate", str(bag), "--json", str(out), "--report", str(report)]) == 0
    printed = capsys.readouterr().out
    assert "pressed" in printed
    assert "RMSE/N" in printed
    content = json.loads(out.read_text())
    assert content["cases"].keys() == {"pressed"}
    assert content["cases"]["pressed"]["all"] == content["all"]["all"]
    assert content["all"]["all"]["bias_N"] > 0
    assert (report / "report.html").exists()


def test_recordings_of_one_name_are_told_apart_by_their_folders(tmp_path, exact, capsys):
    for folder in ("monday", "tuesday"):
        write_recording(bench_recording(), tmp_path / folder / "bag")
    out = tmp_path / "scores.json"
    bags = [str(tmp_path / folder / "bag") for folder in ("monday", "tuesday")]
    assert main(["evaluate", *bags, "--json", str(out)]) == 0
    names = list(json.loads(out.read_text())["cases"])
    assert [name.split("/")[-2:] for name in names] == [["monday", "bag"], ["tuesday", "bag"]]


def test_note_about_unknown_types_goes_to_stderr(tmp_path, exact, capsys, monkeypatch):
    noted = replace(bench_recording(), notes=("/odd skipped: unknown type own_msgs/msg/Odd",))
    monkeypatch.setattr("finforce_eval.evaluation.keypoint_source.read_recording", lambda *_, **__: noted)
    assert main(["evaluate", "pressed"]) == 0
    assert capsys.readouterr().err == "note: pressed: /odd skipped: unknown type own_msgs/msg/Odd\n"


def test_absent_recording_is_refused(capsys, tmp_path):
    assert_refused(capsys, ["evaluate", tmp_path / "nowhere"], "no such recording")
    assert_refused(capsys, ["calibrate", tmp_path / "nowhere", "-o", tmp_path / "c.yaml"], "no such recording")


def test_empty_folder_is_refused(capsys, tmp_path):
    assert_refused(capsys, ["evaluate", tmp_path], "the folder is not a recording")


def test_a_recording_of_which_nothing_is_left_is_refused(capsys, bag):
    file = bag / "pressed.mcap"
    file.write_bytes(file.read_bytes()[:5000])
    assert_refused(capsys, ["evaluate", bag, "--strict"], "truncated or damaged")
    file.write_bytes(file.read_bytes()[:500])
    assert_refused(capsys, ["evaluate", file], "not one message is whole")


def test_empty_recording_is_refused(capsys, tmp_path):
    write_entries([], tmp_path / "bag")
    assert_refused(capsys, ["evaluate", tmp_path / "bag"], "empty")


def test_recording_without_truth_is_refused(capsys, tmp_path):
    bag = write_recording(bench_recording(truth=False), tmp_path / "bag")
    assert_refused(capsys, ["evaluate", bag], "no ground truth")
    assert_refused(capsys, ["calibrate", bag, "-o", tmp_path / "c.yaml"], "force of the object on the jaw in its frame")


def test_recording_of_another_jaw_is_refused(capsys, tmp_path):
    bag = write_recording(make_recording(keypoints=8), tmp_path / "bag")
    assert_refused(capsys, ["evaluate", bag], "8 key points in /left/keypoints; the jaw 'bench' has 15")
    assert_refused(capsys, ["calibrate", bag, "-o", tmp_path / "c.yaml"], "8 key points")


def test_one_bad_recording_among_good_ones_is_named(capsys, bag, tmp_path, exact):
    out = tmp_path / "scores.json"
    assert main(["evaluate", str(bag), str(tmp_path / "nowhere"), "--json", str(out)]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("failed: ") and "nowhere: no such recording" in said.err
    scores = json.loads(out.read_text())
    assert list(scores["cases"]) == [Path(bag).name] and list(scores["failed"]) == ["nowhere"]


def test_evaluate_goes_on_where_it_was(capsys, bag, tmp_path, exact):
    other = write_recording(bench_recording(), tmp_path / "other")
    kept, scores, again = tmp_path / "kept", tmp_path / "scores.json", tmp_path / "again.json"
    for part in (bag, other):
        assert main(["evaluate", str(part), "--out", str(kept)]) == 0
    times = {path: path.stat().st_mtime_ns for path in kept.glob("*.parquet")}
    assert len(times) == 2
    assert main(["evaluate", str(bag), str(other), "--out", str(kept), "--json", str(scores)]) == 0
    assert {path: path.stat().st_mtime_ns for path in kept.glob("*.parquet")} == times
    assert main(["evaluate", str(bag), str(other), "--json", str(again)]) == 0
    resumed, fresh = (json.loads(path.read_text()) for path in (scores, again))
    assert list(resumed["cases"]) == list(fresh["cases"]) == [Path(bag).name, "other"]
    for name, case in fresh["cases"].items():
        assert resumed["cases"][name]["all"] == case["all"]
    assert len(pd.read_parquet(kept)) == sum(len(pd.read_parquet(path)) for path in times)  # the folder is one table
    next(iter(times)).unlink()  # what is lost is done again
    assert main(["evaluate", str(bag), str(other), "--out", str(kept)]) == 0
    assert len(list(kept.glob("*.parquet"))) == 2


def test_same_recording_twice_is_refused(capsys, bag):
    assert_refused(capsys, ["evaluate", bag, bag], "given twice")


def test_recording_without_height_is_refused(capsys, tmp_path):
    bag = write_recording(replace(bench_recording(), case={}), tmp_path / "bag")
    assert_refused(capsys, ["evaluate", bag], "give --contact fixed:Z_MM")


def test_height_off_the_jaw_is_refused(capsys, bag):
    assert_refused(capsys, ["evaluate", bag, "--contact", "fixed:400"], "400")


@pytest.mark.parametrize("contact", ["somewhere", "fixed:x"])
def test_contact_that_cannot_be_used_is_refused(capsys, bag, contact):
    assert_refused(capsys, ["evaluate", bag, "--contact", contact], f"--contact {contact}")


def test_estimate_without_mesh_or_poses_is_refused(capsys, bag, tmp_path):
    assert_refused(capsys, ["evaluate", bag, "--contact", "estimate"], "no object mesh: no mesh in a case.json")
    blind = write_recording(replace(bench_recording(), object_pose=None), tmp_path / "blind")
    assert_refused(capsys, ["evaluate", blind, "--contact", "paper", "--object", CYLINDER], "no object poses")
    track = bench_recording().jaws["left"]
    still = replace(bench_recording(), jaws={"left": replace(track, pose=None)})
    jawless = write_recording(still, tmp_path / "jawless")
    assert_refused(
        capsys, ["evaluate", jawless, "--contact", "closest", "--object", CYLINDER], "no jaw poses: /left/jaw_pose"
    )
    calibrate = ["calibrate", bag, "-o", tmp_path / "c.yaml", "--contact", "estimate"]
    assert_refused(capsys, calibrate, "no object mesh")


def test_object_that_cannot_be_used_is_refused(capsys, bag, tmp_path):
    pytest.importorskip("trimesh")
    assert_refused(capsys, ["evaluate", bag, "--object", tmp_path / "no.stl"], "no.stl")
    assert_refused(capsys, ["evaluate", bag, "--object", CYLINDER, "--object-unit", "mm"], "unit")
    assert_refused(capsys, ["evaluate", bag, "--object", CYLINDER, "--object-unit", "ell"], "--object-unit")
    (tmp_path / "object.txt").write_text("")
    assert_refused(capsys, ["evaluate", bag, "--object", tmp_path / "object.txt"], ".txt")


def test_units_are_those_of_the_mesh_reader():
    from finforce_contact.mesh.object_mesh import UNITS as READ
    from finforce_eval.cli.parser import UNITS

    assert set(UNITS) == set(READ)


def test_nan_pose_is_refused_with_its_message(capsys, tmp_path):
    pytest.importorskip("trimesh")
    recording = bench_recording()
    recording.object_pose.position[4] = np.nan
    bag = write_recording(recording, tmp_path / "bag")
    assert_refused(capsys, ["evaluate", bag, "--object", CYLINDER], "/object_pose message 4")


def test_absent_jaw_and_calibration_are_refused(capsys, bag, tmp_path):
    assert_refused(capsys, ["evaluate", bag, "--jaw", tmp_path / "no.yaml"], "no.yaml")
    assert_refused(capsys, ["evaluate", bag, "--calibration", tmp_path / "no.yaml"], "no.yaml")


def test_unknown_solver_and_missing_bag_are_refused(capsys, bag):
    assert_refused(capsys, ["evaluate", bag, "--solver", "magic"], "--solver")
    assert_refused(capsys, ["evaluate"], "BAG")
    assert_refused(capsys, [], "COMMAND")
    assert_refused(capsys, ["calibrate", bag], "-o/--output")


@pytest.mark.parametrize("change", ["magic=1", "iterations=many", "automatic_tare=perhaps", "iterations=0", "gate"])
def test_setting_that_cannot_be_is_refused(capsys, bag, change):
    assert_refused(capsys, ["evaluate", bag, "--set", change], change.split("=")[0])


def test_settings_take_the_type_of_their_default():
    from finforce_eval.evaluation.setup import parse_settings

    settings = parse_settings("solid", "coarse", ["iterations=3", "gate=2", "automatic_tare=No"])
    assert (settings.solver, settings.mesh) == ("solid", "coarse")
    assert (settings.iterations, settings.gate, settings.automatic_tare) == (3, 2.0, False)
    assert isinstance(settings.gate, float)


def test_all_key_points_hidden_is_refused(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("finforce_eval.evaluation.setup.ForceEstimator", lambda *_, **__: FakeEstimator([None] * 60))
    bag = write_recording(bench_recording(), tmp_path / "bag")
    assert_refused(capsys, ["evaluate", bag], "none of the frames to be scored was solved")


def test_what_was_noted_of_the_key_points_is_told_with_the_reason_of_a_failure(capsys, tmp_path, monkeypatch):
    """The note may be the cause: depth in another unit lets nothing be solved."""
    apply = KeypointSource.apply
    monkeypatch.setattr(KeypointSource, "apply", lambda *given: replace(apply(*given), notes=("the depth is off",)))
    monkeypatch.setattr("finforce_eval.evaluation.setup.ForceEstimator", lambda *_, **__: FakeEstimator([None] * 60))
    bag = write_recording(bench_recording(), tmp_path / "bag")
    assert_refused(capsys, ["evaluate", bag], "; the depth is off")


def test_key_points_all_nan_are_refused_by_the_real_estimator(capsys, tmp_path):
    recording = bench_recording()
    track = recording.jaws["left"]
    hidden = replace(track.keypoints, points=np.full_like(track.keypoints.points, np.nan))
    blind = replace(recording, jaws={"left": replace(track, keypoints=hidden)})
    bag = write_recording(blind, tmp_path / "bag")
    assert_refused(capsys, ["evaluate", bag], "none of the frames to be scored was solved")


def test_output_that_cannot_be_written_is_refused(capsys, bag, exact, tmp_path):
    (tmp_path / "file").write_text("")
    status = main(["evaluate", str(bag), "--json", str(tmp_path / "file" / "out.json")])
    assert status == 2
    assert capsys.readouterr().err.count("\n") == 1


def run_command(*arguments):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "finforce_eval.cli.main", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


def test_process_exits_with_two_one_line_and_no_traceback(tmp_path):
    done = run_command("evaluate", str(tmp_path / "nowhere"))
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr


def test_help_needs_no_heavy_import():
    code = (
        "import sys\nfrom finforce_eval.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'scipy', 'numba', 'rosbags', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    for command in ("evaluate", "calibrate", "replay", "demo", "bench", "--version"):
        assert command in done.stdout


def test_a_reader_that_has_seen_enough_is_no_error():
    command = [sys.executable, "-m", "finforce_eval.cli.main", "twin", "list"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT) as process:
        process.stdout.close()
        assert process.stderr.read() == b"" and process.wait() == 128 + signal.SIGPIPE


def test_a_jaw_file_is_no_finger_to_make_one_of(capsys):
    assert main(["jaw", "mine.yaml"]) == 2
    assert "mine.yaml: is a jaw file already, for --jaw" in capsys.readouterr().err


def test_version_is_printed(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("finforce ")


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["evalute"], "got 'evalute', did you mean evaluate?"),
        (["evaluate", "BAG", "--calibraton", "bench"], "no option --calibraton, did you mean --calibration?"),
        (["evaluate", "BAG", "--solver", "solidd"], "got 'solidd', did you mean solid?"),
        (["evaluate", "BAG", "--jaw", "bnch"], "did you mean bench?"),
        (["evaluate", "BAG", "--calibration", "twinn"], "did you mean twin?"),
        (["evaluate", "BAG", "--set", "iteration=3"], "did you mean iterations?"),
        (
            ["evaluate", "BAG", "--contact", "fixed:0.040"],
            "--contact fixed:0.040: expected millimetres, such as fixed:40",
        ),
        (["evaluate", "BAG", "--from", "images", "--extrinsics", "-0.01,0,0"], "expected robot, bench, "),
        (["jaw", "finger.stl", "--width", "0.022"], "--width: 0.022: expected millimetres, such as 22"),
    ],
)
def test_the_likely_mistake_is_named_in_one_line(capsys, words, meant):
    assert_refused(capsys, words, meant)


def test_a_pose_may_begin_with_a_minus():
    assert parse(["extrinsics", "BAG", "--extrinsics", "-0.01,0,0,0,0,0,1"]).extrinsics == "-0.01,0,0,0,0,0,1"


def test_quiet_prints_nothing_wherever_it_stands(capsys):
    for words in (["--quiet", "twin", "list"], ["twin", "--quiet", "list"], ["twin", "list", "-q"]):
        assert main(words) == 0
        assert capsys.readouterr() == ("", "")
    assert main(["evaluate", "nowhere", "-q"]) == 2
    assert "no such recording" in capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_every_command_says_what_it_does(command):
    text = build_parser(command).format_help()
    assert COMMANDS[command][:20] in text and "--quiet" in text and "--json" in text


def test_every_command_writes_what_it_found_and_on_which_machine(tmp_path):
    for words, name in (
        (["twin", "list"], "scenes"),
        (["launch", "robot", "-s"], "arguments"),
    ):
        assert main([*words, "--quiet", "--json", str(tmp_path / "found.json")]) == 0
        assert {"machine", name} == set(json.loads((tmp_path / "found.json").read_text()))


def test_the_demo_of_a_busy_machine_is_played_once_more_and_slower(monkeypatch, capsys):
    rates = []

    def play(options):
        rates.append(options.rate)
        if len(rates) < 2:
            raise SilentReplayError("no wrench came")
        return CommandResult({"grasp": {"n": 10 * len(rates)}, "grasp_frames": 50})

    monkeypatch.setattr(replay, "run", play)
    assert main(["demo", "--from", "keypoints", "--rate", "2"]) == 0
    assert rates == [2.0, 0.5, 0.125] and "Once more at 0.125 x real time" in capsys.readouterr().out


def test_the_options_of_evaluate_stand_in_groups_with_examples():
    text = build_parser("evaluate").format_help()
    for group in ("finger and mechanics:", "object and contact:", "key points and camera:", "results:", "examples:"):
        assert f"\n{group}" in text


def test_a_shell_completes_commands_and_options(tmp_path):
    pytest.importorskip("argcomplete")
    for line, expected in (("finforce eva", "evaluate"), ("finforce evaluate --calib", "--calibration")):
        told = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "|"}
        told |= {
            "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "out"),
            "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}",
        }
        command = [sys.executable, "-m", "finforce_eval.cli.main"]
        subprocess.run(command, env=os.environ | told, check=True)
        assert expected in (tmp_path / "out").read_text()


@pytest.mark.parametrize(("command", "plays"), [("trace", "play_to_nodes"), ("replay", "replay")])
def test_what_is_noted_of_a_recording_is_told_before_it_is_played(command, plays, capsys, tmp_path, monkeypatch):
    """As that it breaks off: the figures are those of a part."""

    def play(*_, **__):
        raise RecordingError("played")

    read = KeypointSource.read
    monkeypatch.setattr(KeypointSource, "read", lambda *given: replace(read(*given), notes=("it breaks off",)))
    monkeypatch.setattr(f"finforce_eval.cli.{command}.{plays}", play)
    assert main([command, str(write_recording(bench_recording(), tmp_path / "bag"))]) == 2
    assert capsys.readouterr().err == "note: bag: it breaks off\nfinforce: played\n"
