"""A Dask scheduler and workers as processes, which end with their test."""

import json
import os
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

from process_fakes import running

ROOT = Path(__file__).parents[2]
START = 120.0  # [s] that a process may take to come up beside other work
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def wait_until(true, what, seconds=START):
    """Return what a condition gives once it is true."""
    deadline = time.monotonic() + seconds
    while not (found := true()):
        assert time.monotonic() < deadline, f"no {what} within {seconds:g} s"
        time.sleep(0.02)
    return found


class Cluster:
    """A scheduler, and workers that are started by name.

    Their working directory is of their own; they import finforce, and the modules of these tests, by absolute paths.
    """

    def __init__(self, folder, stack):
        self.folder, self._stack, self._file = folder, stack, folder / "scheduler.json"
        self.workers, self._log = {}, stack.enter_context((folder / "log.txt").open("ab"))
        words = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(self._file))
        self.scheduler = self._start("scheduler", *words)
        self.address = wait_until(self._read_address, "scheduler")

    def _read_address(self):
        assert self.scheduler.poll() is None, self.log()
        try:
            return json.loads(self._file.read_text())["address"]
        except (OSError, ValueError, KeyError):
            return None

    def _start(self, kind, *words, before=()):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *words]
        paths = os.pathsep.join(map(str, (*before, ROOT, ROOT / "test" / "eval", ROOT / "test" / "lab")))
        environment = os.environ | dict.fromkeys(THREADS, "1") | {"PYTHONPATH": paths}
        options = {"stdout": self._log, "stderr": self._log, "cwd": self.folder, "env": environment}
        return self._stack.enter_context(running(command, **options))

    def start_worker(self, name, threads=1, before=()):
        """Start a worker without a nanny, so that it dies for good; `before` are folders to import from first."""
        words = (self.address, "--name", name, "--nthreads", str(threads), "--no-nanny", "--no-dashboard")
        self.workers[name] = self._start("worker", *words, "--local-directory", str(self.folder), before=before)

    def kill(self, name):
        self.workers[name].kill()
        self.workers.pop(name).wait()

    def log(self):
        return (self.folder / "log.txt").read_text()


@contextmanager
def cluster(folder, *names):
    """A cluster with workers of these names."""
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        made = Cluster(folder, stack)
        for name in names:
            made.start_worker(name)
        yield made
