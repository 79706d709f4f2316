"""The benchmark of starts: it waits for all nodes of a process, and says why one is not ready."""

import os
import sys
from textwrap import dedent

import pytest

from finforce.systems.processes import executables_of, merge
from finforce_eval.replay.processes import ProcessError
from lab.bench import first_start as bench


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


def test_the_table_says_what_was_compiled_before():
    rows = [
        bench.StartRow(name="solver", compiled=compiled, n=3, seconds=1.25, most=2.0, memory_MB=300.4)
        for compiled in (False, True)
    ]
    table = bench.format_table(bench.FirstStartFigures(rows=rows, import_ms=3.14))
    assert "| solver | meanwhile | 3 | 1.25 | 2.00 | 300 |" in table
    assert "| solver | before |" in table and "3.1 ms" in table
