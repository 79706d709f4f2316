"""Claims about traces: what is noted, whose time is whose, and which image stands for all."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header

from finforce.ros import tracing
from finforce_eval.cli.main import parse
from finforce_eval.cli.trace import (
    WAY,
    format_trace,
    read_spans,
    stage_figures,
)
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.setup import make_setup
from finforce_eval.recordings.recording import read_recording
from finforce_eval.replay import replay as replaying

OFFSET = 5_000
MS = 1_000_000


def write(folder, name, *spans):
    (folder / f"{name}.json").write_text(json.dumps(spans), encoding="utf-8")


@pytest.fixture
def ways(tmp_path):
    """Two images: the detector calls the solver, another process hears the first image, too."""
    write(
        tmp_path,
        "one",
        ("solver", "/left/keypoints", 10 + OFFSET, 13 * MS, 16 * MS),
        ("detector", "/color", 10 + OFFSET, 11 * MS, 18 * MS),
        ("detector", "/color", 20 + OFFSET, 31 * MS, 33 * MS),
        ("detector", "/color", 30 + OFFSET, 41 * MS, 43 * MS),
    )
    write(tmp_path, "two", ("other", "/left/wrench", 10 + OFFSET, 17 * MS, 19 * MS), ("other", "/clock", 10, 0, 1))
    return read_spans(tmp_path, OFFSET, {10: 0.010, 20: 0.030})


def test_spans_are_those_of_images_that_left_and_begin_with_them(ways):
    assert ways["image"].tolist() == [10, 10, 10, 20]
    first = ways[ways["image"] == 10]
    assert [stage.split(":")[0] for stage in first["stage"]] == ["detector", "solver", "other"]
    assert first["begin"].tolist() == pytest.approx([1.0, 3.0, 7.0])


def test_what_a_stage_called_is_not_its_own_time_and_another_process_is_none_of_it(ways):
    assert ways["own"].tolist()[:3] == pytest.approx([4.0, 3.0, 2.0])


def test_figures_come_in_the_order_of_the_way_with_the_whole_of_it_last(ways):
    figures = stage_figures(ways, [9.5e-3, 4e-3, 30e-3])
    assert list(figures) == ["detector: color", "solver: left/keypoints", "other: left/wrench", WAY]
    assert figures["detector: color"]["n"] == 2 and figures[WAY]["own_ms"][0] == pytest.approx(9.5)
    text = format_trace(figures, 4, {"left jaw": "1 late"})
    assert "3 of 4 images answered" in text and "left jaw: 1 late" in text
    assert "| solver: left/keypoints | 1 | 3.00 | 3.00 |" in text


def test_a_folder_without_anything_of_an_image_is_said(tmp_path):
    with pytest.raises(RecordingError, match="nothing was noted|noted anything"):
        read_spans(tmp_path, 0, {10: 0.0})


def test_nothing_is_noted_unless_it_is_asked_for(monkeypatch, tmp_path):
    def take(_):
        pass

    monkeypatch.delenv(tracing.FOLDER, raising=False)
    assert tracing.note("node", "/topic", take) is take
    monkeypatch.setenv(tracing.FOLDER, str(tmp_path))
    monkeypatch.setattr(tracing, "_spans", [])
    tracing.note("node", "/topic", take)(PoseStamped(header=Header(stamp=Time(nanosec=7))))
    tracing.note("node", "/said", take)("no header")
    tracing.write_trace()
    (path,) = tmp_path.glob("*.json")
    noted = json.loads(path.read_text(encoding="utf-8"))
    assert [entry[:3] for entry in noted] == [["node", "/topic", 7], ["node", "/said", 0]]
    assert all(begin <= end for *_, begin, end in noted)


class BegunError(Exception):
    """The nodes would have been started."""


def test_a_recording_without_ground_truth_is_traced_but_not_scored(monkeypatch):
    def begin(*_, **__):
        raise BegunError

    monkeypatch.setattr(replaying, "run_nodes", begin)
    recording = read_recording(Path(replaying.__file__).parents[1] / "data" / "bench_cyl25_middle")
    jaws = {side: replace(track, truth=None) for side, track in recording.jaws.items()}
    plain, setup = replace(recording, jaws=jaws), make_setup(parse(["trace", "bag", "--contact", "fixed:40"]))
    with pytest.raises(BegunError):
        replaying.play_to_nodes(plain, setup, calibration_file="", playing=replaying.Playing())
    with pytest.raises(RecordingError, match="ground truth"):
        replaying.replay(plain, setup)
