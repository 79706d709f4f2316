"""The message package control_msgs for a process of its own: the installed one, or two of its actions built for it."""

import fcntl
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[1] / "action_messages"


def environment():
    """The environment variables of a process that imports control_msgs; skips the test where it cannot be had."""
    if importlib.util.find_spec("control_msgs") is not None:
        return dict(os.environ)
    target = Path(sys.prefix) / "control_msgs"
    target.mkdir(exist_ok=True)
    with (target / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another worker may be building it
        if not (target / "done").exists():
            _build(target)
    places = {
        "PYTHONPATH": str(next(target.glob("lib/python*/site-packages"))),
        "LD_LIBRARY_PATH": str(target / "lib"),
        "AMENT_PREFIX_PATH": str(target),
    }
    before = {name: os.environ.get(name) for name in places}
    return {
        **os.environ,
        **{name: os.pathsep.join(filter(None, (value, before[name]))) for name, value in places.items()},
    }


def _build(target):
    missing = [name for name in ("cmake", "c++") if shutil.which(name) is None]
    if missing or not (Path(sys.prefix) / "generators").exists():
        pytest.skip(f"neither control_msgs nor what builds it is installed: {missing or '.venv/generators'}")
    done = subprocess.run([sys.executable, SOURCES / "build.py", target], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
