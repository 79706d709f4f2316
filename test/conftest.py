"""What tests of several packages are given."""

import os
import signal
import sys
from os import cpu_count

import pytest
from hypothesis import settings

settings.register_profile("finforce", deadline=None)  # a machine under load is not a counterexample
settings.load_profile("finforce")

# For processes that tests start: signals as in a shell's foreground, and modules compiled once.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_xdist_auto_num_workers(config):
    """One worker more than cores: tests of real nodes wait a third of their time."""
    return (cpu_count() or 1) + 1


@pytest.fixture(autouse=True)
def nothing_kept_warm(request):
    """Estimators that the tasks of a process share are its own of a test that patches something."""

    def forget():
        setup = sys.modules.get("finforce_eval.evaluation.setup")
        if patches and setup is not None:
            setup._last.clear()

    patches = "monkeypatch" in request.fixturenames
    forget()
    yield
    forget()


@pytest.fixture
def probe():
    """A node on a DDS domain of its own that talks to the nodes of a test."""
    from node_fakes import ros_domain

    with ros_domain() as probe:
        yield probe


@pytest.fixture
def tf(monkeypatch):
    """Transforms by target and source, as tf2_ros gives them away; what is sent is kept under "sent"."""
    from tf2_fakes import install

    return install(monkeypatch)
