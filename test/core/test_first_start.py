"""A first start compiles in other processes, once, and never stands in the way of a node."""

import os
import signal
import subprocess
import sys
import time
from importlib import import_module
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
    import os
    from finforce import caches
    with open(os.path.join(os.environ["NUMBA_CACHE_DIR"], "runs"), "a") as file:
        file.write("x")
    caches.note_prepared()
"""
# `finforce prepare --once`, with something quicker to compile
ONCE = """
    import os, sys, time
    from finforce_eval import preparation
    from finforce_eval.cli import main, prepare

    def work(jaws, calibration):
        time.sleep(1.0)
        with open(os.path.join(os.environ["NUMBA_CACHE_DIR"], "runs"), "a") as file:
            file.write("x")
        return iter(())

    prepare.prepare = work
    sys.exit(main.main(["prepare", *sys.argv[1:]]))
"""


def test_only_the_first_start_compiles(folder):
    log = Log()
    for _ in range(2):
        first_start.prepare_first_start(log, python(WORK))
    assert (folder / "runs").read_text() == "x"
    assert log.said == [first_start.WORDS] and not log.warned


def test_of_two_processes_one_compiles_and_the_other_waits(folder):
    folder.mkdir()
    running = [subprocess.Popen([*python(ONCE), "--once"]) for _ in range(2)]
    assert [process.wait(timeout=START_PATIENCE) for process in running] == [0, 0]
    assert (folder / "runs").read_text() == "x"
    # who asks for it by hand has it done again
    assert subprocess.run(python(ONCE), timeout=START_PATIENCE, check=False).returncode == 0
    assert (folder / "runs").read_text() == "xx"


def test_the_same_sources_are_compiled_wherever_a_node_is_started(folder, tmp_path, monkeypatch):
    (tmp_path / "finforce_eval").mkdir()
    (tmp_path / "finforce_eval" / "__init__.py").write_text("raise SystemExit('of the present folder')")
    monkeypatch.chdir(tmp_path)
    caches.note_prepared()
    done = subprocess.run(first_start.COMMAND, capture_output=True, text=True, timeout=START_PATIENCE, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_another_processor_or_source_compiles_again(folder, monkeypatch):
    caches.note_prepared()
    assert caches.find_prepared().exists()
    monkeypatch.setattr("llvmlite.binding.get_host_cpu_name", lambda: "another")
    assert not caches.find_prepared().exists()
    monkeypatch.undo()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    monkeypatch.setattr(caches, "_name_sources", lambda root: "other sources")
    assert not caches.find_prepared().exists()


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (python("raise SystemExit('no memory')"), "status 1, no memory"),
        (python("raise SystemExit(3)"), "status 3, without a word"),
        (("/nowhere/finforce",), "/nowhere/finforce: No such file"),
    ],
)
def test_what_fails_is_said_once_and_left_to_the_node(folder, command, reason):
    log = Log()
    for _ in range(2):
        first_start.prepare_first_start(log, command)
    assert len(log.warned) == 1 and "compiles by itself" in log.warned[0] and reason in log.warned[0]
    assert not caches.find_prepared().exists()
    # after an hour, or once it was done by hand, that is forgotten
    (failed,) = folder.glob("*.failed")
    os.utime(failed, (time.time() - 4000.0,) * 2)
    first_start.prepare_first_start(log, python(WORK))
    assert caches.find_prepared().exists() and not failed.exists()


@pytest.mark.parametrize(
    ("module", "kind"),
    [
        ("finforce_ifea.node", "IfeaSolverNode"),
        ("finforce_contact.node", "ContactEstimatorNode"),
        ("finforce_keypoints.node", "KeypointDetectorNode"),
        ("finforce_sim.node", "TwinCameraNode"),
    ],
)
def test_every_node_that_compiles_has_it_done_ahead(probe, module, kind, monkeypatch):
    class AskedError(Exception):
        pass

    def ask(log):
        raise AskedError

    monkeypatch.setattr("finforce.ros.node.prepare_first_start", ask)
    with pytest.raises(AskedError):
        getattr(import_module(module), kind)(context=probe.context)


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
