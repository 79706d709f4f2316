"""Claims about `finforce annotate`: nothing of a recording is lost, no force made up, nothing done twice."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from eval_fakes import cut, evaluate_recording
from process_fakes import running
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from task_fakes import squares

from finforce_eval.annotation import bag as annotated_bag
from finforce_eval.cli import annotate as annotate_command
from finforce_eval.cli.main import main
from finforce_eval.evaluation.setup import make_setup
from finforce_eval.recordings.objects import read_friction
from finforce_eval.recordings.recording import DEMO, read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_eval.tasks import OK, EngineOptions, Manifest, run_tasks

TYPES = get_typestore(Stores.ROS2_JAZZY)
SECONDS = 4


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """The first seconds of a loading cycle."""
    return short_bag(tmp_path_factory.mktemp("source") / "short")


def short_bag(folder, *, storage="mcap", begin=0):
    recording = read_recording(DEMO)
    start = int(recording.jaw("left").keypoints.stamps_ns[0]) + begin
    return write_recording(cut(recording, start, start + SECONDS * 10**9), folder, storage=storage)


def annotate(out, *words):
    return main(["annotate", *map(str, words), "--out", str(out)])


def messages(folder):
    with Reader(folder) as reader:
        return [(connection.topic, time, bytes(data)) for connection, time, data in reader.messages()]


def decoded(folder, topic):
    with Reader(folder) as reader:
        chosen = [each for each in reader.connections if each.topic == topic]
        return [TYPES.deserialize_cdr(data, each.msgtype) for each, _, data in reader.messages(connections=chosen)]


def lines_of(out):
    return [json.loads(text) for text in (out / "_manifest.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def annotated(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("annotated")
    assert annotate(out, source) == 0
    return out / source.name


def test_every_message_is_there_byte_for_byte_and_new_topics_between_them(source, annotated):
    before, after = messages(source), messages(annotated)
    topics = {topic for topic, *_ in before}
    assert [entry for entry in after if entry[0] in topics] == before
    added = {topic for topic, *_ in after} - topics
    own = ("wrench", "wrench_stddev", "wrench_status", "contact", "markers")
    assert added == {f"/left/{name}" for name in own} | {"/grasp_wrench", "/manipulation_wrench"}
    assert [time for _, time, _ in after] == sorted(time for _, time, _ in after)
    assert (annotated / "case.json").read_bytes() == (source / "case.json").read_bytes()


def test_types_and_qualities_of_the_topics_are_kept(source, annotated):
    with Reader(source) as before, Reader(annotated) as after:
        kept = {each.topic: each for each in after.connections}
        for each in before.connections:
            assert kept[each.topic].msgtype == each.msgtype
            assert kept[each.topic].digest == each.digest
            assert kept[each.topic].msgdef == each.msgdef
            assert kept[each.topic].ext == each.ext


def test_forces_are_those_of_evaluate_and_what_has_none_is_nan_with_its_reason(source, annotated, tmp_path):
    recording = read_recording(source)
    setup = make_setup(options_of(source))
    estimator = setup.estimator()
    estimator.expect_friction(read_friction(recording))
    expected = evaluate_recording(recording, setup.jaw, setup.source(recording), estimator)
    forces = decoded(annotated, "/left/wrench")
    found = np.array([[f.wrench.force.x, f.wrench.force.y, f.wrench.force.z] for f in forces])
    np.testing.assert_array_equal(found, expected.force)
    states = [message.status[0] for message in decoded(annotated, "/left/wrench_status")]
    unanswered = np.isnan(found).any(axis=1)
    assert 0 < unanswered.sum() < len(found)
    assert not (np.linalg.norm(found[unanswered], axis=1) == 0).any()
    for state, missing in zip(states, unanswered, strict=True):
        assert (state.level != 0) == missing
        assert state.message
    assert any("tare" in state.message for state in states)
    grasp = [message.wrench.force.x for message in decoded(annotated, "/grasp_wrench")]
    np.testing.assert_allclose(grasp, np.linalg.norm(found, axis=1))


def options_of(source):
    from finforce_eval.cli.main import parse

    return parse(["evaluate", str(source)])


@pytest.mark.parametrize(
    ("solved", "detection", "told"), [(0.4, "found", True), (0.6, "found", False), (0.4, None, False)]
)
def test_the_camera_is_looked_at_where_few_images_have_a_force(solved, detection, told, monkeypatch):
    monkeypatch.setattr(annotated_bag, "explain_camera", lambda recording, source: ["another lens"])
    jaws = {"left": SimpleNamespace(solved=np.arange(10) < 10 * solved)}
    recording = SimpleNamespace(jaws={"left": SimpleNamespace(detection=detection)})
    assert annotated_bag._explain_few(recording, None, jaws) == (["another lens"] if told else [])


def test_where_few_images_have_a_force_it_is_said_why_the_others_have_none(capsys):
    jaw = {"images": 100, "answered": 20, "largest_N": 2.0, "unanswered": {"waiting": 78, "diverged": 2}}
    jaw["why"] = "check their unit"
    for answered, words in ((20, "; without: 78 waiting, 2 diverged: check their unit\n"), (80, "2.00 N at most\n")):
        annotate_command._print_outcome(
            {"name": "a", "error": "", "status": OK, "figures": {"jaws": {"left": jaw | {"answered": answered}}}}
        )
        assert capsys.readouterr().out.endswith(words)


def test_an_sqlite_recording_stays_one(tmp_path):
    source = short_bag(tmp_path / "lite", storage="sqlite3")
    assert annotate(tmp_path / "out", source) == 0
    assert [path.suffix for path in (tmp_path / "out" / "lite").glob("lite*.*")] == [".db3"]
    kept = [entry for entry in messages(tmp_path / "out" / "lite") if entry[0] == "/left/keypoints"]
    assert kept == [entry for entry in messages(source) if entry[0] == "/left/keypoints"]


def test_a_side_file_has_the_new_messages_alone(source, annotated, tmp_path):
    assert annotate(tmp_path, source, "--side-file") == 0
    topics = {topic for topic, *_ in messages(source)}
    whole = [entry for entry in messages(annotated) if entry[0] not in topics]
    assert messages(tmp_path / source.name) == whole


def test_what_is_annotated_already_is_refused_unless_aside(annotated, tmp_path, capsys):
    assert annotate(tmp_path / "again", annotated) == 2
    assert "/left/wrench, " in capsys.readouterr().err
    assert not (tmp_path / "again" / annotated.name).exists()
    assert annotate(tmp_path / "aside", annotated, "--side-file") == 0


@pytest.mark.parametrize(("storage", "share"), [("mcap", 0.9), ("sqlite3", 0.6)])
def test_a_recording_that_was_cut_off_is_read_up_to_the_damage(tmp_path, capsys, storage, share):
    source = short_bag(tmp_path / "cut", storage=storage)
    (file,) = [path for path in source.iterdir() if path.suffix in (".mcap", ".db3")]
    whole = messages(source)
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    assert annotate(tmp_path / "out", source) == 0
    assert "read as far as it is good" in capsys.readouterr().err
    after = messages(tmp_path / "out" / "cut")
    own = [entry for entry in after if entry[0] == "/left/keypoints"]
    assert own == [entry for entry in whole if entry[0] == "/left/keypoints"][: len(own)]
    assert 0.3 * SECONDS * 30 < len(own) <= SECONDS * 30
    assert len([entry for entry in after if entry[0] == "/left/wrench"]) == len(own)


def test_of_a_recording_without_one_whole_message_only_that_is_said(tmp_path, capsys):
    (tmp_path / "torn.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\x01" * 30)
    assert annotate(tmp_path / "out", tmp_path / "torn.mcap") == 2
    assert "not one message is whole" in capsys.readouterr().err
    assert not (tmp_path / "out" / "torn").exists()


def test_a_bad_recording_costs_itself_only_and_a_second_run_does_what_is_left(source, tmp_path, capsys):
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"no recording")
    out = tmp_path / "out"
    assert annotate(out, bad, source) == 2
    assert "bad: " in capsys.readouterr().err
    assert {line["name"]: line["status"] for line in lines_of(out)} == {"bad": "failed", source.name: "ok"}
    written = (out / source.name / "metadata.yaml").stat().st_mtime_ns
    bad.unlink()
    bad.write_bytes(next(source.glob("*.mcap")).read_bytes())
    assert annotate(out, bad, source, "--contact", "fixed:40") == 2  # other settings: what is there is another's
    assert "exists already" in capsys.readouterr().err
    assert (out / source.name / "metadata.yaml").stat().st_mtime_ns == written
    (out / "_manifest.jsonl").unlink()
    assert annotate(out, source) == 0
    assert (out / source.name / "metadata.yaml").stat().st_mtime_ns == written
    assert [line["name"] for line in lines_of(out)] == [source.name]


def test_a_recording_that_is_not_there_costs_itself_only(source, tmp_path, capsys):
    assert annotate(tmp_path / "out", tmp_path / "nothing", source) == 2
    assert "nothing: no such recording" in capsys.readouterr().err
    assert {line["name"]: line["status"] for line in lines_of(tmp_path / "out")} == {
        "nothing": "failed",
        source.name: "ok",
    }


def test_a_full_disk_leaves_nothing(source, tmp_path, monkeypatch, capsys):
    def refuse(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(annotated_bag, "_copy_others", refuse)
    assert annotate(tmp_path / "out", source) == 2
    assert "No space left on device" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [".lock", "_manifest.jsonl"]


def test_two_runs_do_not_write_in_one_folder(source, tmp_path, capsys):
    with Manifest(tmp_path).alone():
        assert annotate(tmp_path, source) == 2
    assert "another run writes there" in capsys.readouterr().err


def test_a_line_that_was_cut_off_is_done_again(tmp_path):
    manifest, tasks = Manifest(tmp_path), squares(4)
    run_tasks(tasks, EngineOptions(), manifest)
    text = manifest.path.read_text()
    manifest.path.write_text(text[:-20])
    lines = run_tasks(tasks, EngineOptions(), manifest)
    assert [line["figures"]["square"] for line in lines] == [0, 1, 4, 9]
    read = [json.loads(line) for line in manifest.path.read_text().splitlines() if line.endswith("}")]
    assert [line["name"] for line in read] == ["0", "1", "2", "3"]


def look_at(out, names, written):
    """What is written, and when; whole once and for all."""
    times = {name: (out / name / "metadata.yaml") for name in names}
    now = {name: path.stat().st_mtime_ns for name, path in times.items() if path.exists()}
    assert now | written == now
    return now


def test_a_run_that_is_killed_loses_nothing_and_its_successor_does_nothing_twice(tmp_path):
    names, out = ["part0", "part1"], tmp_path / "out"
    bags = [short_bag(tmp_path / name, begin=number * 10**9) for number, name in enumerate(names)]
    command = [sys.executable, "-m", "finforce_eval.cli.main", "annotate", *map(str, bags), "--out", str(out)]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    with running(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment) as process:
        while not (out / names[0]).exists():
            assert process.poll() is None
            time.sleep(0.01)
        process.kill()
        assert process.wait() == -signal.SIGKILL
    written = look_at(out, names, {})
    assert annotate(out, *bags) == 0
    look_at(out, names, written)
    done = [line["name"] for line in lines_of(out) if line["status"] == "ok"]
    assert sorted(done) == names
    for bag, name in zip(bags, names, strict=True):
        topics = {topic for topic, *_ in messages(bag)}
        assert [entry for entry in messages(out / name) if entry[0] in topics] == messages(bag)


@pytest.mark.parametrize(
    "words",
    [
        ["--workers", "-1"],
        ["--memory", "nan"],
        ["--memory=-1"],
        ["--memory", "inf"],
        ["--workers", "2", "--scheduler", "a"],
    ],
)
def test_engines_that_cannot_be_are_refused(words, source, tmp_path, capsys):
    assert annotate(tmp_path, source, *words) == 2
    assert "expected" in capsys.readouterr().err
    assert not (tmp_path / source.name).exists()


def test_a_manifest_of_an_earlier_version_is_read(tmp_path):
    tasks, before = squares(4), Manifest(tmp_path / "before")
    done = run_tasks(tasks, EngineOptions(), before)
    (tmp_path / "after").mkdir()
    text = before.path.read_text().splitlines(keepends=True)
    (tmp_path / "after" / "manifest.jsonl").write_text("".join(text[:2]))
    (tmp_path / "after" / "manifest.2-of-2.jsonl").write_text(text[2])
    after = Manifest(tmp_path / "after")
    assert run_tasks(tasks, EngineOptions(), after) == done[:3] + run_tasks(tasks, EngineOptions(), after)[3:]
    assert [line["name"] for line in lines_of(tmp_path / "after")] == ["3"]


def test_a_changed_calibration_is_another_setting(source, tmp_path, capsys):
    from importlib.resources import files

    file = tmp_path / "my.yaml"
    file.write_text((files("finforce_ifea.jaw") / "calibrations" / "bench.yaml").read_text())
    assert annotate(tmp_path / "out", source, "--calibration", file) == 0
    assert annotate(tmp_path / "out", source, "--calibration", file) == 0
    file.write_text(file.read_text() + "\n")
    assert annotate(tmp_path / "out", source, "--calibration", file) == 2
    assert "exists already" in capsys.readouterr().err
