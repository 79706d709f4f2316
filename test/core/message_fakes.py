"""Message packages for a process of its own: installed ones, or what is needed of them, built for it."""

import fcntl
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[1] / "message_packages"


def environment(package):
    """The environment variables of a process that imports a package; skips the test where it cannot be had."""
    if importlib.util.find_spec(package) is not None:
        return dict(os.environ)
    target = Path(sys.prefix) / package
    target.mkdir(exist_ok=True)
    with (target / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another worker may be building it
        if not (target / "done").exists():
            _build(package, target)
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


def run_trials(package, trials):
    """What pytest prints of a file of trials, in a process that has a package; all of them pass."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", str(trials)]
    done = subprocess.run(command, env=environment(package), capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]
    return done.stdout


def _build(package, target):
    missing = [name for name in ("cmake", "c++") if shutil.which(name) is None]
    if missing or not (Path(sys.prefix) / "generators").exists():
        pytest.skip(f"neither {package} nor what builds it is installed: {missing or '.venv/generators'}")
    done = subprocess.run(
        [sys.executable, SOURCES / "build.py", package, target], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
