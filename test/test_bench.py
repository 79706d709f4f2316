"""Claims about the benchmark and the recording that it and the demo run on."""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from finforce_eval.bench import RECORDING, format_rows, measure_steps, row_from_times, write_figures
from finforce_eval.bench_live import MIRROR_MOMENT, LiveFigures, with_both_jaws
from finforce_eval.cli import main
from finforce_eval.memory import child_processes, resident_bytes
from finforce_eval.recording import read_recording
from finforce_ifea.errors import MissingDependencyError
from finforce_ifea.jaw import load_jaw


@pytest.fixture(scope="module")
def recording():
    return read_recording(RECORDING)


def test_shipped_recording_is_small_and_one_cycle_that_begins_unloaded(recording):
    assert sum(file.stat().st_size for file in RECORDING.iterdir()) < 3e6
    assert set(recording.phases.cycle) == {0}
    track = recording.jaws["left"]
    assert track.keypoints.count == len(load_jaw("bench").keypoint_names)
    seconds = (track.truth.stamps - track.truth.stamps[0]) * 1e-9
    magnitude = np.linalg.norm(track.truth.force, axis=1)
    assert (magnitude[seconds < 2.5] == 0).all()
    assert magnitude.max() > 3.5
    assert magnitude[-1] == 0
    assert recording.case["object"]["z"] == 40.0


def test_times_become_percentiles_in_milliseconds():
    row = row_from_times("step", 1e-3 * np.arange(101))
    assert (row.n, row.p50, row.p95, row.p99, row.max) == pytest.approx((101, 50, 95, 99, 100))
    assert format_rows([row]).splitlines()[-1].split() == ["step", "50.00", "95.00", "99.00", "100.00", "101"]


def test_only_loaded_solved_steps_are_timed(recording, monkeypatch):
    class Estimator:
        def __init__(self, *_, **__):
            self.steps = 0

        def update(self, observation, contact):
            self.steps += 1
            return SimpleNamespace(status="ok" if self.steps % 4 == 0 else "unloaded")

    monkeypatch.setattr("finforce_eval.bench.JawEstimator", Estimator)
    assert len(measure_steps(recording, load_jaw("bench"), "solid", "coarse", 100)) == 25


def test_process_takes_memory_and_knows_its_children():
    assert 1e6 < resident_bytes() < 1e11
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        assert child.pid in child_processes(os.getpid())
        child.communicate(b"\n")
    assert child.pid not in child_processes(os.getpid())
    assert resident_bytes(child.pid) == 0


def test_right_jaw_is_the_mirror_image_of_the_left(recording):
    both = with_both_jaws(recording, 5.0)
    left, right = both.jaws["left"], both.jaws["right"]
    assert len(left.keypoints.stamps) == len(right.keypoints.stamps) == 150
    np.testing.assert_array_equal(right.keypoints.points[..., 1], -left.keypoints.points[..., 1])
    np.testing.assert_array_equal(right.truth.force[:, [0, 2]], left.truth.force[:, [0, 2]])
    arm = np.array([0.014, 0.003, 0.04])
    force = np.array([-1.0, 0.2, 0.3])
    mirrored = np.cross(arm * [1, -1, 1], force * [1, -1, 1])
    np.testing.assert_allclose(mirrored, np.cross(arm, force) * MIRROR_MOMENT)


def test_bench_prints_a_table_and_writes_json(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("finforce_eval.bench.measure_memory", lambda solver, mesh: 123.0)
    monkeypatch.setattr("finforce_eval.bench.measure_steps", lambda *_: np.full(9, 2e-3))
    live = LiveFigures(latency=np.full(9, 5e-3), memory=150_000_000)
    monkeypatch.setattr("finforce_eval.bench.measure_live", lambda source: live)
    out = tmp_path / "new" / "bench.json"
    assert main(["bench", "--json", str(out)]) == 0
    content = json.loads(out.read_text())
    assert {"machine", "times_ms", "memory_MB"} <= content.keys()
    assert {"processor", "python", "commit"} <= content["machine"].keys()
    names = [row["name"] for row in content["times_ms"]]
    assert names[0] == "SuperLU, 522 vertices"
    assert "step: frame" in names
    assert all(row.keys() == {"name", "n", "p50", "p95", "p99", "max"} for row in content["times_ms"])
    assert names[-1] == "key points to wrench, both jaws live"
    assert content["memory_MB"]["solver node"] == 150.0
    assert "123 MB" in capsys.readouterr().out


def test_figures_are_written_with_where_they_are_from_and_null_for_what_is_not_finite(tmp_path):
    write_figures(tmp_path / "new" / "figures.json", {"rows": [{"p95": float("nan"), "n": 3}]})
    content = json.loads((tmp_path / "new" / "figures.json").read_text())
    assert content["rows"] == [{"p95": None, "n": 3}]
    assert content["machine"]["numpy"] == np.__version__
    assert {"processor", "cores", "python", "commit"} <= set(content["machine"])


def test_bench_without_ros_says_what_it_left_out(monkeypatch, capsys):
    def refuse(source):
        raise MissingDependencyError("needs ROS 2")

    monkeypatch.setattr("finforce_eval.bench.measure_memory", lambda solver, mesh: 123.0)
    monkeypatch.setattr("finforce_eval.bench.measure_steps", lambda *_: np.full(9, 2e-3))
    monkeypatch.setattr("finforce_eval.bench.measure_live", refuse)
    assert main(["bench"]) == 0
    assert "both jaws live: not measured: needs ROS 2" in capsys.readouterr().out


def test_bench_without_frames_is_refused(capsys):
    assert main(["bench", "--frames", "0"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
