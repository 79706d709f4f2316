"""Claims about child processes: none is lost, none outlives its group."""

import os
import signal
import sys
from dataclasses import dataclass
from time import monotonic, sleep

import pytest

from finforce_eval.replay.process_group import ProcessError, ProcessGroup


@dataclass(frozen=True)
class Script:
    """A process that runs a few lines of Python."""

    label: str
    code: str

    def command(self):
        return [sys.executable, "-c", self.code]


WAIT = "import time; print('up', flush=True); time.sleep(60)"
STUBBORN = "import signal, time; signal.signal(2, signal.SIG_IGN); signal.signal(15, signal.SIG_IGN); time.sleep(60)"


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def pids(group):
    return [child.pid for child in group._children]


def wait_for(condition):
    until = monotonic() + 10.0
    while not condition():
        assert monotonic() < until
        sleep(0.02)


def fails(group):
    try:
        group.check()
    except ProcessError:
        return True
    return False


def test_all_are_ended_with_the_block():
    with ProcessGroup([Script("a", WAIT), Script("b", WAIT)], {}) as group:
        group.check()
        started = pids(group)
        assert all(map(is_running, started))
    assert not any(map(is_running, started))


def test_all_are_ended_when_the_block_fails():
    with pytest.raises(KeyboardInterrupt), ProcessGroup([Script("a", WAIT)], {}) as group:
        started = pids(group)
        raise KeyboardInterrupt
    assert not any(map(is_running, started))


def test_one_that_ignores_signals_is_killed(monkeypatch):
    patience = ((signal.SIGINT, 0.2), (signal.SIGTERM, 0.2), (signal.SIGKILL, 5.0))
    monkeypatch.setattr("finforce_eval.replay.process_group.PATIENCE", patience)
    with ProcessGroup([Script("a", STUBBORN), Script("b", WAIT)], {}) as group:
        sleep(0.5)
        started = pids(group)
    assert not any(map(is_running, started))


def test_what_a_process_has_started_ends_with_it():
    code = f"import subprocess, sys; p = subprocess.Popen([sys.executable, '-c', {WAIT!r}]); p.wait()"
    with ProcessGroup([Script("a", code)], {}) as group:
        (parent,) = pids(group)
        wait_for(lambda: os.path.exists(f"/proc/{parent}/task/{parent}/children"))
        children = []

        def has_child():
            with open(f"/proc/{parent}/task/{parent}/children", encoding="ascii") as file:
                children[:] = [int(word) for word in file.read().split()]
            return bool(children)

        wait_for(has_child)
    wait_for(lambda: not any(map(is_running, children)))


def test_an_early_end_is_reported_with_the_last_words():
    code = "import sys; print('first', flush=True); print('no such jaw', file=sys.stderr); sys.exit(2)"
    with ProcessGroup([Script("solver", code)], {}) as group:
        wait_for(lambda: fails(group))
        with pytest.raises(ProcessError, match="solver ended with status 2: no such jaw"):
            group.check()


def test_variables_reach_the_processes():
    code = "import os, sys; print(os.environ['ROS_DOMAIN_ID'], os.environ['OMP_NUM_THREADS']); sys.exit(3)"
    with ProcessGroup([Script("a", code)], {"ROS_DOMAIN_ID": "42"}) as group:
        wait_for(lambda: fails(group))
        with pytest.raises(ProcessError, match="42 1"):
            group.check()


@pytest.mark.parametrize("domain", ["233", "9999", "-1", "one"])
def test_a_domain_that_cannot_be_is_refused_before_anything_starts(domain, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(ProcessError, match=f"^ROS_DOMAIN_ID={domain}: expected 0 to 232"), ProcessGroup([], {}):
        pass


def test_domains_that_can_be_are_none_and_those_with_ports(monkeypatch):
    for domain in ("", "0", "232"):
        monkeypatch.setenv("ROS_DOMAIN_ID", domain)
        with ProcessGroup([], {}):
            pass
