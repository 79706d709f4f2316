"""Claims about the benchmark command and the recording that it and the demo run on."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from process_fakes import running

from finforce.errors import MissingDependencyError
from finforce_eval.cli.main import main
from finforce_eval.errors import OptionError
from finforce_eval.machine import write_figures
from finforce_eval.recordings.recording import DEMO as RECORDING
from finforce_eval.recordings.recording import read_recording
from finforce_eval.replay.processes import child_processes, resident_bytes
from finforce_ifea.jaw.jaw import load_jaw
from lab.bench import bench
from lab.bench.bench import PARTS, BenchPart, format_rows, row_from_times, select_parts, time_calls

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def recording():
    return read_recording(RECORDING)


@pytest.fixture
def two_parts(monkeypatch):
    """Replaces the parts by two that measure nothing; returns what they were asked for."""
    asked = []

    def make(name, **options):
        def measure(quick, folder=None):
            asked.append((name, quick, folder))
            return name

        module = SimpleNamespace(
            measure=measure,
            format_table=lambda figures: f"table of {figures}",
            as_json=lambda figures: {"measured": figures},
            draw=lambda figures, path: path.write_text(figures),
        )
        monkeypatch.setitem(sys.modules, f"part_{name}", module)
        return BenchPart(name=name, module=f"part_{name}", title=f"Title of {name}", **options)

    parts = (make("first", takes_folder=True), make("second"), make("third", usual=False))
    monkeypatch.setattr(bench, "PARTS", parts)
    return asked


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


def test_every_call_is_timed_once():
    calls = []
    times = time_calls(lambda: calls.append(1), 4)
    assert len(times) == len(calls) == 4
    assert min(times) >= 0


def test_process_takes_memory_and_knows_its_children():
    assert 1e6 < resident_bytes() < 1e11
    with running([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        assert child.pid in child_processes(os.getpid())
        child.communicate(b"\n")
    assert child.pid not in child_processes(os.getpid())
    assert resident_bytes(child.pid) == 0


def test_usual_parts_are_measured_unless_others_are_named(two_parts):
    assert [part.name for part in select_parts(None)] == ["first", "second"]
    assert [part.name for part in select_parts("third, first,third")] == ["third", "first"]
    with pytest.raises(OptionError, match="no part 'fourth', expected some of first, second, third"):
        select_parts("fourth")


def test_every_listed_part_keeps_the_contract():
    for part in PARTS:
        module = __import__(part.module, fromlist=["measure"])
        assert all(callable(getattr(module, name)) for name in ("measure", "format_table", "as_json")), part


def test_command_prints_tables_and_writes_json_and_a_picture_for_each_part(two_parts, tmp_path, capsys):
    out, picture = tmp_path / "new" / "bench.json", tmp_path / "new" / "p.png"
    assert main(["bench", str(tmp_path), "--quick", "--json", str(out), "--figure", str(picture)]) == 0
    assert two_parts == [("first", True, str(tmp_path)), ("second", True, None)]
    content = json.loads(out.read_text())
    assert {"processor", "python", "commit"} <= content["machine"].keys()
    assert [content[name]["measured"] for name in ("first", "second")] == ["first", "second"]
    assert (picture.read_text(), picture.with_name("p_second.png").read_text()) == ("first", "second")
    printed = capsys.readouterr().out
    assert "Title of first" in printed and "table of second" in printed


def test_part_that_cannot_be_measured_is_said_and_the_others_are_measured(two_parts, tmp_path, monkeypatch, capsys):
    def refuse(quick, folder=None):
        raise MissingDependencyError("needs ROS 2")

    monkeypatch.setattr(sys.modules["part_first"], "measure", refuse)
    assert main(["bench", "--json", str(tmp_path / "bench.json")]) == 0
    content = json.loads((tmp_path / "bench.json").read_text())
    assert content["first"]["not_measured"] == "needs ROS 2"
    assert content["second"]["measured"] == "second"
    assert "not measured: needs ROS 2" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--parts", "none"], ["FOLDER", "--parts", "second"], ["--frames", "9"]])
def test_options_that_mean_nothing_are_refused_with_one_line(two_parts, words, capsys):
    try:
        code = main(["bench", *words])
    except SystemExit as end:
        code = end.code
    assert code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_figures_are_written_with_where_they_are_from_and_null_for_what_is_not_finite(tmp_path):
    write_figures(tmp_path / "new" / "figures.json", {"rows": [{"p95": float("nan"), "n": 3}]})
    content = json.loads((tmp_path / "new" / "figures.json").read_text())
    assert content["rows"] == [{"p95": None, "n": 3}]
    assert content["machine"]["numpy"] == np.__version__
    assert {"processor", "cores", "python", "commit"} <= set(content["machine"])


@pytest.fixture
def fill_pages(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return __import__("fill_pages")


def test_page_takes_its_tables_from_the_figures_and_keeps_what_they_do_not_hold(fill_pages, tmp_path):
    machine = {"commit": "abc", "processor": "P", "cores": 2, "python": "3"}
    content = {"machine": machine, "solvers": {"tables": {"tiers": "| t |"}}}
    (tmp_path / "bench.json").write_text(json.dumps(content))
    texts = fill_pages.read_texts(tmp_path / "bench.json")
    assert texts["solvers.tables.tiers"] == "| t |" and "abc" in texts["machine.solvers"]
    block = "x\n<!-- begin {0} -->\nold\n<!-- end {0} -->\n"
    page = block.format("solvers.tables.tiers") + block.format("nodes")
    filled = fill_pages.fill(page, texts)
    assert filled == page.replace("old", "| t |", 1)
    assert fill_pages.fill(filled, texts) == filled


def test_a_file_of_one_benchmark_is_named_after_it(fill_pages, tmp_path):
    (tmp_path / "verification.json").write_text(json.dumps({"tables": {"summary": "| s |"}}))
    assert fill_pages.read_texts(tmp_path / "verification.json") == {"verification.tables.summary": "| s |"}
