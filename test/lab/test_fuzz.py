"""A claim about files from anywhere: crafted and damaged ones are read or refused, within memory and time."""

import pytest

from lab.benchmarks.fuzz import FAILURES, fuzz
from lab.benchmarks.fuzz_files import KINDS


@pytest.mark.parametrize("name", KINDS)
def test_files_from_anywhere_are_read_or_refused(name):
    kind = KINDS[name]
    tally = fuzz([kind], 60 // kind.cost + 5, 7, shown=False)[name]
    assert not tally.failures, tally.failures
    assert sum(tally.counts[outcome] for outcome in FAILURES) == 0
    assert tally.counts["refused"] + tally.counts["read"] >= 8
