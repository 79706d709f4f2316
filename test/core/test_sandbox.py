"""Claims about work in a process of its own: its answer comes back, and whatever ends it costs one sentence."""

import itertools
import operator
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from finforce.errors import one_line
from finforce.files import FileError, parse_json
from finforce.sandbox import SandboxError, run_limited


def test_the_answer_comes_back_and_what_is_printed_does_not_disturb_it(capfd):
    assert run_limited(divmod, 7, 2) == (3, 1)
    assert run_limited(print, "words") is None
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("function", "arguments", "words"),
    [
        (np.ones, (1 << 29,), "took more than 512 MB of memory; FINFORCE_BUDGET=10 would allow"),
        (sum, (itertools.count(),), "took more than 1 s; FINFORCE_BUDGET=10 would allow"),
        (os.abort, (), "made its reader crash .SIGABRT"),
        (os._exit, (3,), "made its reader end with 3"),
        (operator.truediv, (1, 0), "made its reader fail .ZeroDivisionError"),
    ],
)
def test_whatever_ends_it_costs_one_sentence(function, arguments, words):
    with pytest.raises(SandboxError, match=words) as caught:
        run_limited(function, *arguments, memory=1 << 29, seconds=1)
    assert "\n" not in str(caught.value)


def test_what_only_waits_ends_too(monkeypatch):
    monkeypatch.setattr("finforce.sandbox.WAITS", 1)
    with pytest.raises(SandboxError, match="waited more than 1 s; expected an answer"):
        run_limited(time.sleep, 60, seconds=1)


def test_an_error_of_ours_is_raised_as_it_is():
    with pytest.raises(FileError, match="is not valid JSON"):
        run_limited(parse_json, "{")


def test_a_budget_allows_more(monkeypatch):
    monkeypatch.setenv("FINFORCE_BUDGET", "10")
    assert run_limited(np.ones, 1 << 24, memory=1 << 26).nbytes == 1 << 27


def test_files_of_a_process_that_did_not_remove_them_are_removed():
    left = Path(run_limited(tempfile.mkdtemp))
    assert left.parent.parent == Path(tempfile.gettempdir()) and not left.parent.exists()


def test_of_a_long_error_both_ends_are_told():
    said = one_line(ValueError("reader.cc:256 " + "detail " * 100 + "unsupported\nversion 15"), 60)
    assert len(said) <= 60 and said.startswith("reader.cc:256") and said.endswith("unsupported version 15")
    assert one_line(ValueError("a" * 60), 60) == "a" * 60 and one_line(ValueError()) == "ValueError"
