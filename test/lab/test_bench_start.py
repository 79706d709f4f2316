"""The benchmark of starts: it waits for all nodes of a process, and says why one is not ready."""

import sys
from types import SimpleNamespace

import pytest

from finforce.systems.processes import executables_of, merge
from finforce_eval.replay.processes import ProcessError
from lab.bench import start as bench


@pytest.fixture
def start(monkeypatch):
    """Time the start of a program in place of a process with so many nodes."""

    def start(text, nodes):
        monkeypatch.setattr(bench, "executables_of", lambda _: ["node"] * nodes)
        process = SimpleNamespace(label="nodes", command=lambda: [sys.executable, "-c", text])
        return bench.time_start(process, {})

    return start


def test_a_start_lasts_until_all_nodes_are_ready(start):
    slow = (
        "import time; print('one ready', flush=True); time.sleep(0.4); print('two, ready', flush=True); time.sleep(9)"
    )
    one, _ = start(slow, 1)
    two, memory = start(slow, 2)
    assert one + 0.3 < two < 30.0
    assert memory > 1e6


def test_a_node_that_ends_is_named_with_its_last_words(start):
    with pytest.raises(ProcessError, match="no such jaw"):
        start("print('no such jaw')", 1)


def test_the_pipeline_has_all_nodes():
    nodes = bench.list_nodes()
    assert len(executables_of([merge(nodes)])) == len(nodes) == 4
    assert len(executables_of(nodes[:1])) == 1
