"""The benchmark of starts: it waits for all nodes of a process, and says why one is not ready."""

import os
import sys
from textwrap import dedent

import pytest

from finforce.systems.processes import executables_of, merge
from finforce_eval.replay.processes import ProcessError
from lab.bench import start as bench


def python(text):
    return [sys.executable, "-c", dedent(text)]


def test_a_start_lasts_until_all_nodes_are_ready():
    slow = (
        "import time; print('one ready', flush=True); time.sleep(0.4); print('two, ready', flush=True); time.sleep(99)"
    )
    one, _ = bench.time_start(python(slow), 1, os.environ)
    two, memory = bench.time_start(python(slow), 2, os.environ)
    assert one + 0.3 < two < 30.0
    assert memory > 1e6


def test_a_node_that_ends_is_named_with_its_last_words():
    with pytest.raises(ProcessError, match="no such jaw"):
        bench.time_start(python("print('no such jaw')"), 1, os.environ)


def test_the_pipeline_has_all_nodes():
    nodes = bench.list_nodes()
    assert len(executables_of([merge(nodes)])) == len(nodes) == 4
    assert len(executables_of(nodes[:1])) == 1
