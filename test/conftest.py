"""What tests of several packages are given."""

import pytest


@pytest.fixture
def probe():
    """A node on a DDS domain of its own that talks to the nodes of a test."""
    from node_fakes import ros_domain

    with ros_domain() as probe:
        yield probe
