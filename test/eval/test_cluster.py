"""Claims about tasks on a Dask cluster: whatever dies, all are done, none twice, as in one process; nothing hangs."""

import json
import os
import signal
import sys
import threading
from dataclasses import replace

import dask
import pandas as pd
import pytest
from cluster_fakes import cluster, wait_until
from eval_fakes import cut
from task_fakes import squares

from finforce_eval import cluster as adapter
from finforce_eval.cli.main import main
from finforce_eval.cluster import Order, describe_files, describe_sources
from finforce_eval.errors import ClusterError
from finforce_eval.recordings.recording import DEMO, read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_eval.tasks import EngineOptions, Manifest, run_tasks

RECORDINGS, SECONDS = 3, 2
STORED = ("--contact", "fixed:42", "--calibration", "bench")  # the equilibria that the set-up has built


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Some seconds of a loading cycle each."""
    folder, whole = tmp_path_factory.mktemp("bags"), read_recording(DEMO)
    begin = int(whole.jaws["left"].keypoints.stamps_ns[0])
    starts = [begin + (3 + n) * 10**8 for n in range(RECORDINGS)]  # the first load is recorded after two seconds
    parts = [(start, start + SECONDS * 10**9) for start in starts]
    return [write_recording(cut(whole, *part), folder / f"part{n}") for n, part in enumerate(parts)]


def annotate(bags, out, *words):
    return main(["annotate", *map(str, bags), "--out", str(out), *STORED, *words])


def run_all(tasks, folder, **options):
    manifest = Manifest(folder)
    with manifest.alone():
        return run_tasks(tasks, EngineOptions(**options), manifest)


def lines_of(folder):
    path = folder / Manifest.NAME
    return [json.loads(text) for text in path.read_text().splitlines()] if path.exists() else []


def outcomes(lines):
    return [{name: line[name] for name in ("name", "key", "status", "error", "figures")} for line in lines]


@pytest.fixture
def once():
    """What does something in a thread of its own as soon as a condition is true."""
    threads = []

    def start(true, what):
        threads.append(threading.Thread(target=lambda: (wait_until(true, "sign"), what()), daemon=True))
        threads[-1].start()

    yield start
    for thread in threads:
        thread.join(10.0)
        assert not thread.is_alive()


def test_workers_of_this_machine_do_what_this_process_does_and_one_that_dies_costs_its_own_task(tmp_path):
    tasks = squares(9, fail=(3,))
    expected = run_all(tasks, tmp_path / "here")
    found = run_all(squares(9, fail=(3,), die=(5,)), tmp_path / "there", workers=2)
    assert "died" in found[5]["error"]
    del expected[5], found[5]
    assert outcomes(found) == outcomes(expected)
    assert [line["figures"].get("square") for line in found] == [0, 1, 4, None, 16, 36, 49, 64]


def test_recordings_come_out_to_the_bit_as_in_one_process_though_a_worker_is_killed(bags, tmp_path, once, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", *map(str, bags), *STORED, "--out", "here"]) == 0
    with cluster(tmp_path / "cluster", "one", "two") as made:
        once(lambda: lines_of(tmp_path / "there"), lambda: made.kill("one"))
        words = [*STORED, "--out", "there", "--scheduler", made.address]
        assert main(["evaluate", *map(str, bags), *words]) == 0
    assert sorted(line["name"] for line in lines_of(tmp_path / "there")) == [f"part{n}" for n in range(RECORDINGS)]
    tables = [read_forces(tmp_path / name) for name in ("here", "there")]
    assert tables[0].force_x.notna().sum() > 15 * SECONDS * RECORDINGS / 2
    pd.testing.assert_frame_equal(*tables, check_exact=True)


def read_forces(folder):
    """The table of a folder of recordings, as it stands, without what a clock has told."""
    table = pd.read_parquet(folder).sort_values(["case", "side", "stamp"], ignore_index=True)
    return table[[name for name in table if not name.endswith("_ms")]]


def test_a_run_whose_scheduler_is_killed_ends_in_words_and_resumes(bags, tmp_path, once, capsys):
    out = tmp_path / "out"
    with cluster(tmp_path / "first", "one") as made:
        once(lambda: lines_of(out), made.scheduler.kill)
        assert annotate(bags, out, "--scheduler", made.address) == 2
    said = capsys.readouterr().err
    assert f"{made.address}: the scheduler is gone" in said and "the same command does the rest" in said
    done = {line["name"]: (out / line["name"] / "metadata.yaml").stat().st_mtime_ns for line in lines_of(out)}
    assert 0 < len(done) < RECORDINGS
    with cluster(tmp_path / "second", "one") as made:
        assert annotate(bags, out, "--scheduler", made.address) == 0
    assert sorted(line["name"] for line in lines_of(out)) == [f"part{n}" for n in range(RECORDINGS)]
    assert {name: (out / name / "metadata.yaml").stat().st_mtime_ns for name in done} == done
    assert not list(out.glob(".*.part"))


def other_finforce(folder):
    """A folder that makes a worker think it has another version."""
    about = folder / "finforce-9.9.9.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: finforce\nVersion: 9.9.9\n")
    return folder


def no_finforce(folder):
    """A folder that keeps a worker from importing finforce."""
    (folder / "finforce_eval").mkdir(parents=True)
    (folder / "finforce_eval" / "__init__.py").write_text("raise ImportError('there is none')\n")
    return folder


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"before": other_finforce}, r"worker odd at tcp\S+ has finforce 9\.9\.9 \(.*, expected .*: install"),
        ({"before": no_finforce}, r"worker odd at tcp\S+ has no such finforce \(there is none\); expected"),
        (
            {"threads": 4},
            r"worker odd at tcp\S+ has 4 threads, expected 1: start workers with --nthreads 1 --nworkers 4",
        ),
    ],
)
def test_a_worker_that_may_give_other_results_is_refused_by_name(options, said, tmp_path):
    options = {name: [value(tmp_path / "odd")] if callable(value) else value for name, value in options.items()}
    with cluster(tmp_path / "cluster") as made:
        made.start_worker("odd", **options)
        with pytest.raises(ClusterError, match=said):
            run_all(squares(3), tmp_path / "out", scheduler=made.address)
    assert lines_of(tmp_path / "out") == []


@pytest.fixture
def order(tmp_path):
    """An order as it is sent: its files and its folders are there."""
    manifest, bag = Manifest(tmp_path / "out"), tmp_path / "bag"
    bag.write_text("12345")
    with manifest.alone():
        yield dict(
            task=b"",
            package="lab",
            sources=describe_sources("lab"),
            folder=str(tmp_path),
            mark=str(manifest.lock),
            run_id=manifest.run_id,
            files=describe_files([bag]),
        )


def test_a_worker_that_sees_all_files_has_no_fault(order):
    assert Order(**order).find_fault(1) == ""


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"run_id": "another"}, "does not see the output folder"),
        ({"mark": "/nowhere/.lock"}, "does not see the output folder /nowhere"),
        ({"folder": "/nowhere"}, "does not see the working directory /nowhere"),
        ({"files": {"/nowhere/bag": (5, 1)}}, "does not see /nowhere/bag as it was sent, with 5 bytes"),
    ],
)
def test_a_worker_that_does_not_see_the_files_is_refused(order, changes, said):
    assert said in Order(**order | changes).find_fault(1)


def test_a_file_of_another_size_or_time_is_another(order, tmp_path):
    (tmp_path / "bag").write_text("1234567")
    assert "with 5 bytes" in Order(**order).find_fault(1)
    (tmp_path / "bag").write_text("54321")
    os.utime(tmp_path / "bag", (1.0, 1.0))
    assert "with 5 bytes" in Order(**order).find_fault(1)


def test_a_recording_that_changes_during_the_run_costs_itself_only(tmp_path, monkeypatch):
    file = tmp_path / "bag"
    file.write_text("1")
    first, second = squares(2)
    before = adapter.describe_files

    def see_then_change(paths):
        found = before(paths)
        if found and next(iter(found.values()))[0] == 1:
            file.write_text("changed")
        return found

    with cluster(tmp_path / "cluster", "one") as made:
        monkeypatch.setattr(adapter, "describe_files", see_then_change)
        lines = run_all([replace(first, files=[file]), second], tmp_path / "out", scheduler=made.address)
    assert [line["error"] for line in lines] == ["its files changed after the run had begun", ""]


def test_a_cluster_without_workers_is_left_after_a_time_that_dask_knows(tmp_path, capsys):
    said = "none of 0 workers was at a task for 1 s; expected some, as `dask worker` starts them"
    with (
        cluster(tmp_path / "cluster") as made,
        dask.config.set({adapter._TIMEOUT_SETTING: "1s"}),
        pytest.raises(ClusterError, match=said),
    ):
        run_all(squares(3), tmp_path / "out", scheduler=made.address)
    assert "no worker yet; waits for 1 s" in capsys.readouterr().err


def test_a_worker_that_comes_late_is_waited_for(tmp_path, once):
    with cluster(tmp_path / "cluster") as made:
        once(lambda: (tmp_path / "out" / ".lock").exists(), lambda: made.start_worker("late"))
        lines = run_all(squares(3), tmp_path / "out", scheduler=made.address)
    assert [line["status"] for line in lines] == ["ok"] * 3


def test_a_scheduler_that_hangs_is_left_in_words(tmp_path, monkeypatch):
    monkeypatch.setattr(adapter, "ANSWER_TIMEOUT", 2.0)
    with cluster(tmp_path / "cluster", "one") as made:
        stop = threading.Timer(1.0, lambda: made.scheduler.send_signal(signal.SIGSTOP))
        tasks = squares(2, seconds=5.0)
        monkeypatch.setattr(adapter._Cluster, "_make_order", start_first(stop, adapter._Cluster._make_order))
        with pytest.raises(ClusterError, match="the scheduler is gone"):
            run_all(tasks, tmp_path / "out", scheduler=made.address)
        stop.join()


def start_first(timer, function):
    """A function that starts a timer when it is called first."""

    def call(*given):
        if not timer.is_alive():
            timer.start()
        return function(*given)

    return call


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense", "http://127.0.0.1:9"])
def test_an_address_without_a_scheduler_is_refused(address, tmp_path, monkeypatch):
    monkeypatch.setattr(adapter, "ANSWER_TIMEOUT", 1.0)
    with pytest.raises(
        ClusterError, match=f"--scheduler {address}: .*expected the address that `dask scheduler` prints"
    ):
        run_all(squares(2), tmp_path, scheduler=address)


def test_without_dask_one_process_works_and_a_cluster_is_refused_with_the_command(bags, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert annotate(bags[:1], tmp_path / "one") == 0
    assert annotate(bags[:1], tmp_path / "two", "--workers", "2") == 2
    assert "pip install 'finforce[dask]'" in capsys.readouterr().err


def test_evaluate_on_a_cluster_needs_a_folder_that_workers_see(bags, capsys):
    assert main(["evaluate", str(bags[0]), "--scheduler", "tcp://127.0.0.1:9"]) == 2
    assert "expected --out DIR, too" in capsys.readouterr().err
