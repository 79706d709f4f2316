"""A first start compiles in other processes, once, and never stands in the way of a node."""

import os
import signal
import subprocess
import sys
import time
from textwrap import dedent

import pytest
from node_fakes import START_PATIENCE

from finforce import caches
from finforce.ros import first_start


class Log:
    """Keeps what is said."""

    def __init__(self):
        self.said, self.warned = [], []

    def info(self, text):
        self.said.append(text)

    def warning(self, text):
        self.warned.append(text)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "compiled"))
    return tmp_path / "compiled"


def python(text):
    return (sys.executable, "-c", dedent(text))


# notes that it ran, and that all is compiled, as `finforce prepare` does at its end
WORK = """
    import os, pathlib, time
    from finforce import caches
    time.sleep(0.5)
    with open(os.path.join(os.environ["NUMBA_CACHE_DIR"], "runs"), "a") as file:
        file.write("x")
    caches.note_prepared()
"""


def test_only_the_first_start_compiles(folder):
    log = Log()
    for _ in range(2):
        first_start.prepare_first_start(log, python(WORK))
    assert (folder / "runs").read_text() == "x"
    assert log.said == [first_start.WORDS] and not log.warned


def test_of_two_processes_one_compiles_and_the_other_waits(folder):
    start = f"""
        import logging
        from finforce.ros import first_start
        first_start.prepare_first_start(logging.getLogger(), {python(WORK)!r})
        from finforce.caches import find_prepared
        assert find_prepared().exists()
    """
    running = [subprocess.Popen(python(start)) for _ in range(2)]
    assert [process.wait(timeout=START_PATIENCE) for process in running] == [0, 0]
    assert (folder / "runs").read_text() == "x"


def test_another_processor_or_source_compiles_again(folder, monkeypatch):
    caches.note_prepared()
    assert caches.find_prepared().exists()
    monkeypatch.setattr("llvmlite.binding.get_host_cpu_name", lambda: "another")
    assert not caches.find_prepared().exists()
    monkeypatch.undo()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    monkeypatch.setattr(caches, "_name_sources", lambda root: "other sources")
    assert not caches.find_prepared().exists()


@pytest.mark.parametrize("command", [python("raise SystemExit(3)"), ("/nowhere/finforce",)])
def test_what_fails_is_said_and_left_to_the_node(folder, command):
    log = Log()
    first_start.prepare_first_start(log, command)
    assert len(log.warned) == 1 and "compiles by itself" in log.warned[0]
    assert not caches.find_prepared().exists()


def test_where_nothing_can_be_kept_nothing_is_compiled_ahead(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "below"))
    log = Log()
    first_start.prepare_first_start(log, python("raise SystemExit(3)"))
    assert not log.said and not log.warned


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_node_that_compiles_and_what_it_started(folder, number):
    work = "import os, pathlib, time; pathlib.Path(os.environ['MARK']).write_text(str(os.getpid())); time.sleep(600)"
    node = f"""
        from finforce.ros import first_start
        from finforce.ros.node import run_node
        from rclpy.logging import get_logger
        run_node("node", lambda: first_start.prepare_first_start(get_logger("node"), {python(work)!r}), [])
    """
    mark = folder.parent / "mark"
    process = subprocess.Popen(python(node), env={**os.environ, "MARK": str(mark)})
    end = time.monotonic() + START_PATIENCE
    while not (mark.exists() and mark.read_text()):
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.05)
    process.send_signal(number)
    assert process.wait(timeout=START_PATIENCE) == 0
    end = time.monotonic() + START_PATIENCE
    while is_running(int(mark.read_text())):
        assert time.monotonic() < end
        time.sleep(0.05)


def is_running(pid):
    """Whether a process is there, and no mere zombie whose parent has gone."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
