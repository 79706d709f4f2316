"""What tests of the mechanics are given."""

import pytest
from mechanics_fakes import bench_mechanics, bench_press


@pytest.fixture(scope="module")
def pressed():
    """The coarse bench finger with a cylinder of 25 mm pressed 8 mm into its middle, and its unknowns."""
    return bench_mechanics("coarse").model, bench_press("coarse", "solid", 25, 40, (2, 8))[-1].q
