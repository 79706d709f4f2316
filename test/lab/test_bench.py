"""Claims about the benchmark command and the recording that it and the demo run on."""

import inspect
import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from process_fakes import running

from finforce.errors import MissingDependencyError
from finforce_eval.cli.main import main
from finforce_eval.errors import OptionError
from finforce_eval.machine import write_figures
from finforce_eval.recordings.recording import DEMO as RECORDING
from finforce_eval.recordings.recording import read_recording
from finforce_eval.replay.process_group import resident_bytes
from finforce_ifea.jaw.jaw import load_jaw
from lab import harness
from lab.cli import bench
from lab.harness import PARTS, Figures, choose_names, percentiles

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def recording():
    return read_recording(RECORDING)


def figures_of(name):
    rows = [{"way": name, "p50/ms": 1.0, "p99/ms": 2.0, "error/N": 0.5, "answered/%": 100.0}]
    return Figures(tables={"rows": pd.DataFrame(rows)}, notes=[f"note of {name}"])


@pytest.fixture
def two_parts(monkeypatch):
    """Replace the parts by some that measure nothing; return what they were asked for."""
    asked = []

    def make(name):
        def measure(quick):
            asked.append((name, quick))
            return figures_of(name)

        monkeypatch.setitem(sys.modules, f"lab.bench.{name}", SimpleNamespace(measure=measure))
        return f"Title of {name}"

    parts = {name: make(name) for name in ("first", "second")}
    monkeypatch.setattr(harness, "PARTS", parts)
    monkeypatch.setattr(bench, "PARTS", parts)
    return asked


def test_shipped_recording_is_small_and_one_cycle_that_begins_unloaded(recording):
    assert sum(file.stat().st_size for file in RECORDING.iterdir()) < 3e6
    assert set(recording.phases.cycle) == {0}
    track = recording.jaws["left"]
    assert track.keypoints.count == len(load_jaw("bench").keypoint_names)
    seconds = (track.truth.stamps_ns - track.truth.stamps_ns[0]) * 1e-9
    magnitude = np.linalg.norm(track.truth.force, axis=1)
    assert (magnitude[seconds < 2.5] == 0).all()
    assert magnitude.max() > 3.5
    assert magnitude[-1] == 0
    assert recording.case["object"]["z"] == 40.0


def test_times_become_percentiles_in_milliseconds():
    row = percentiles(1e-3 * np.arange(101), "step")
    assert list(row.values()) == pytest.approx([101, 50, 95, 99, 100])
    assert list(row) == ["step n", "step p50/ms", "step p95/ms", "step p99/ms", "step max/ms"]
    nothing = percentiles([])
    assert nothing["n"] == 0 and np.isnan(nothing["p50/ms"])


def test_a_table_has_words_first_and_nothing_where_nothing_was_measured():
    text = harness.format_table(pd.DataFrame({"x/N": [0.12345, np.nan], "name": ["a", "b"], "n": [1, 20]}))
    assert [cell.strip() for cell in text.splitlines()[2].split("|")[1:-1]] == ["a", "0.1235", "1"]
    assert [cell.strip() for cell in text.splitlines()[3].split("|")[1:-1]] == ["b", "", "20"]


def test_a_process_takes_memory_until_it_has_gone():
    assert 1e6 < resident_bytes() < 1e11
    with running([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        child.communicate(b"\n")
    assert resident_bytes(child.pid) == 0


def test_all_are_chosen_unless_some_are_named():
    known = {"first": 1, "second": 2}
    assert choose_names("--parts", None, known) == ("first", "second")
    assert choose_names("--parts", "second, first,second", known) == ("second", "first")
    assert choose_names("--rules", "gross errors; first", ["first", "gross errors"], ";") == ("gross errors", "first")
    with pytest.raises(OptionError, match="--parts third: expected some of first, second"):
        choose_names("--parts", "third", known)
    with pytest.raises(OptionError, match="--rules third: expected some of first; second"):
        choose_names("--rules", "first; third", known, ";")


def test_every_listed_part_can_be_measured():
    for part in PARTS:
        assert "quick" in inspect.signature(import_module(f"lab.bench.{part}").measure).parameters, part


def test_command_prints_tables_and_writes_json(two_parts, tmp_path, capsys):
    out = tmp_path / "new" / "bench.json"
    assert main(["bench", "--quick", "--json", str(out)]) == 0
    assert two_parts == [("first", True), ("second", True)]
    content = json.loads(out.read_text())
    assert {"processor", "python", "commit"} <= content["machine"].keys()
    assert [content[name]["rows"]["rows"][0]["way"] for name in ("first", "second")] == ["first", "second"]
    printed = capsys.readouterr().out
    assert "Title of first" in printed and "note of second" in printed


def test_part_that_cannot_be_measured_is_said_and_the_others_are_measured(two_parts, tmp_path, monkeypatch, capsys):
    def refuse(quick):
        raise MissingDependencyError("needs ROS 2")

    monkeypatch.setattr(sys.modules["lab.bench.first"], "measure", refuse)
    assert main(["bench", "--json", str(tmp_path / "bench.json")]) == 0
    content = json.loads((tmp_path / "bench.json").read_text())
    assert content["first"]["not_measured"] == "needs ROS 2"
    assert content["second"]["notes"] == ["note of second"]
    assert "not measured: needs ROS 2" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--parts", "none"], ["FOLDER"], ["--frames", "9"]])
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


MACHINE = {"commit": "abc", "processor": "P", "cores": 2, "python": "3"}
ROWS = [{"way": "on time", "Hz": 30, "error/N": 0.05}, {"way": "on time", "Hz": 60, "error/N": 0.07}]
FOUND = {"machine": MACHINE, "chain": {"rows": {"chain": ROWS}, "tables": {"chain": "| t |"}, "axes": [1.0, 2.0]}}


def test_a_template_is_filled_with_the_numbers_at_their_places(fill_pages):
    template = (
        "{chain.rows.chain.on time.60.error/N|1000*.0f}, {max(chain.rows.*.on time.*.error/N)|}, {chain.axes.1|.1f} N"
    )
    places = ["chain.tables.chain", *(match["place"] for match in fill_pages._FIELD.finditer(template))]
    known = fill_pages.take_figures({"other": {"machine": "", "values": {}}}, FOUND, places)
    texts = fill_pages.write_texts(known, {"t": template, "unknown": "{chain.axes.0|}"})
    assert (
        texts["t"] == "70, 0.07, 2.0 N" and texts["chain.tables.chain"] == "| t |" and "abc" in texts["machine.chain"]
    )
    assert "unknown" not in texts and "other" in known
    page = "x\n<!-- begin {0} -->\nold\n<!-- end {0} -->\n"
    assert fill_pages.fill(page.format("t") + page.format("nodes"), texts) == page.format("t").replace(
        "old", texts["t"]
    ) + page.format("nodes").replace("old\n", "")


def test_a_table_without_figures_keeps_its_head_alone(fill_pages):
    head, row, end = "<!-- begin a.tables.t -->\n| tier |\n|---|\n", "| a |\n", "<!-- end a.tables.t -->\n"
    assert fill_pages.fill(head + row + end, {}) == head + end


@pytest.mark.parametrize(
    "place", ["chain.rows.chain.late.error/N", "chain.row", "mean(chain.rows.chain.on time.90.Hz)"]
)
def test_a_file_without_a_number_that_a_page_needs_changes_nothing(fill_pages, place):
    with pytest.raises(LookupError):
        fill_pages.take_figures({}, FOUND, [place])


def test_every_table_of_the_pages_is_what_the_kept_figures_say(fill_pages, measure_pages):
    templates = fill_pages.yaml.safe_load(fill_pages.TEMPLATES.read_text(encoding="utf-8"))
    known = json.loads(fill_pages.FIGURES.read_text(encoding="utf-8"))
    texts, shown = fill_pages.list_parameters() | fill_pages.write_texts(known, templates), set()
    for path in fill_pages.PAGES:
        page = path.read_text(encoding="utf-8")
        shown |= {match["name"] for match in fill_pages._BLOCK.finditer(page)}
        assert fill_pages.fill(page, texts) == page, path.name
    assert templates.keys() <= shown
    unmeasured = [templates.get(name, f"{{{name}|}}") for name in shown - texts.keys()]
    places = [match["place"] for text in unmeasured for match in fill_pages._FIELD.finditer(text)]
    assert {fill_pages.source_of(place) for place in places} <= measure_pages.PARTS.keys()


@pytest.fixture
def measure_pages(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(ROOT))
    module = __import__("tools.measure_pages", fromlist=["main"])
    monkeypatch.setattr(module, "REPORT", tmp_path)
    return module


def list_stale(known, repository=ROOT):
    """Return the sources of kept figures that are not of the last release or later; none before the first release."""
    tag = _ask_git(repository, "describe", "--tags", "--abbrev=0")
    named = {source: figures["machine"].partition("at commit ")[2] for source, figures in known.items()}
    commits = {source: text.partition(" ")[0].partition("-dirty")[0] for source, text in named.items()}
    return [
        source
        for source, name in commits.items()
        if tag and (not name or _ask_git(repository, "merge-base", "--is-ancestor", tag, name) is None)
    ]


def _ask_git(repository, *words):
    """Return what git says, None where it fails or is absent."""
    try:
        return subprocess.run(
            ["git", *words], cwd=repository, capture_output=True, check=True, text=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def test_a_figure_from_before_the_last_release_is_stale(tmp_path):
    def git(*words):
        who = ("git", "-c", "user.name=A", "-c", "user.email=a@b.c")
        done = subprocess.run((*who, *words), cwd=tmp_path, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "One")
    old = git("rev-parse", "HEAD")
    known = {"old": {"machine": f"Measured at commit {old} on P."}, "unnamed": {"machine": ""}}
    assert list_stale(known, tmp_path) == []
    git("commit", "-q", "--allow-empty", "-m", "Two")
    git("tag", "-a", "v1", "-m", "v1")
    new = git("rev-parse", "HEAD")
    known["new"] = {"machine": f"Measured at commit {new}-dirty-1a2b on P."}
    assert list_stale(known, tmp_path) == ["old", "unnamed"]


def test_no_page_shows_figures_from_before_the_last_release(measure_pages):
    assert list_stale(json.loads(measure_pages.FIGURES.read_text(encoding="utf-8"))) == []


def test_no_part_changes_the_commit_of_the_next_one(measure_pages):
    """Pictures are drawn into the report, and copied to the pages at the end."""
    for part in measure_pages.PARTS:
        assert "docs/" not in measure_pages.PARTS[part], part


def test_a_part_of_this_commit_is_not_measured_again_and_one_that_fails_is_dropped(measure_pages, monkeypatch):
    ran, filled = [], []

    def run(words, **options):
        ran.append(words[3:])
        if "solvers" in words:
            found = {"machine": MACHINE | {"commit": measure_pages.commit()}, "solvers": {"rows": {}}}
            Path(words[words.index("--json") + 1]).write_text(json.dumps(found))
        return SimpleNamespace(returncode=0 if "solvers" in words else 1)

    monkeypatch.setattr(measure_pages.subprocess, "run", run)
    monkeypatch.setattr(measure_pages, "commit", lambda: "abc")
    monkeypatch.setattr(measure_pages, "list_places", lambda templates: ["solvers.rows"])
    monkeypatch.setattr(measure_pages, "fill_pages", filled.append)
    measure_pages.main(["solvers", "grasp"])
    assert [words[:2] for words in ran] == [["bench", "--parts"], ["experiment", "grasp"]]
    assert filled[0]["solvers"]["values"] == {"solvers.rows": {}} and "grasp" not in filled[0]
    measure_pages.main(["solvers"])
    assert len(ran) == 2
    with pytest.raises(SystemExit):
        measure_pages.main(["nothing"])


def test_page_chooses_the_columns_of_its_tables(fill_pages):
    page = "<!-- begin a.tables.t -->\n| tier | error |\n|---|---:|\n| a | 9 |\n<!-- end a.tables.t -->\n"
    texts = {"a.tables.t": "| tier | time | error |\n|---|---:|---:|\n| a | 1 | 2 |\nA note."}
    assert fill_pages.fill(page, texts) == page.replace("| a | 9 |", "| a | 2 |\nA note.")
