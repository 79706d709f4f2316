"""Tasks on a Dask cluster, of this machine or at an address; Dask is imported here alone, once one is asked for.

Dask gives the tasks of a worker that dies to others, limits memory and has a dashboard. Tasks are futures rather than
calls through joblib's Dask backend, where the first one that Dask gives up ends all of them.
"""

from __future__ import annotations

import logging
import os
import pickle
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from queue import Empty, Queue
from time import monotonic
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from finforce.errors import one_line
from finforce.optional import import_library
from finforce_eval.errors import ClusterError
from finforce_eval.machine import version

if TYPE_CHECKING:
    from finforce_eval.tasks import EngineOptions, Line, Manifest, Task

LOOK_PERIOD = 2.0  # between two looks at a cluster where no task ends [s]
ANSWER_TIMEOUT = 60.0  # of whatever a scheduler is asked [s]
START_TIMEOUT = 600.0  # of the workers of this machine, beside whatever else it does [s]
CLOSE_TIMEOUT = 5.0  # of leaving a cluster, which may be gone [s]
IDLE_TIMEOUT = "10 minutes"  # unless Dask's own setting says otherwise; batch systems start workers late
MOST_FILES = 100  # whose state is sent with a task; folders of pictures and replay buffers have thousands
_TIMEOUT_SETTING = "distributed.scheduler.no-workers-timeout"
_LOCAL_SETTINGS = {
    "distributed.scheduler.allowed-failures": 1,  # on this machine a worker dies of its task
    # Dask does not replace a worker that takes longer to start anew than this, by default 15 s.
    "distributed.deploy.lost-worker-timeout": "10 minutes",
    "distributed.worker.multiprocessing-method": "forkserver",  # starts anew in 1 s, not in 10
    # A worker that pauses waits for memory to become free, which here belongs to the set-ups that it keeps.
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.target": False,
}
_GIGABYTE = 1e9  # [bytes]
_CHECKOUT = Path(__file__).parents[1]
_DIED = "the workers that were at it died: out of memory, or killed"


@dataclass(frozen=True, kw_only=True)
class Order:
    """A task for a worker, and what the worker has to share with the process that sends it.

    Attributes:
        task: pickled; unpickled after the checks.
        package: that the task's work is in.
        sources: of it and of finforce.
        folder: working directory, from which relative paths start.
        mark: file in the output folder.
        run_id: its content.
        files: size [bytes] and time of change [s] of the task's input files, by path.
    """

    task: bytes
    package: str
    sources: str
    folder: str
    mark: str
    run_id: str
    files: Mapping[str, tuple[int, int]]

    def find_fault(self, threads: int) -> str:
        """Return why a worker with so many threads cannot do the task, as a predicate; "" where it can."""
        found, shared = describe_sources(self.package), "expected a file system that all workers share"
        if found != self.sources:
            return f"has finforce {found}, expected {self.sources}: install that, and restart the worker"
        if threads != 1:
            return f"has {threads} threads, expected 1: start workers with --nthreads 1 --nworkers {threads}"
        if not _holds(Path(self.mark), self.run_id):
            return f"does not see the output folder {Path(self.mark).parent}; {shared}"
        if not os.path.isdir(self.folder):
            return f"does not see the working directory {self.folder}; {shared}"
        changed = self.files.items() - describe_files(self.files).items()
        for path, (size, _) in changed:
            return f"does not see {path} as it was sent, with {size} bytes; {shared}"
        return ""


@cache
def describe_sources(package: str) -> str:
    """Return the version of finforce and a hash of its modules, and of those of a package beside it such as `lab`."""
    files = {path for name in ("finforce*", package) for path in _CHECKOUT.glob(f"{name}/**/*.py")}
    digest = sha256(b"".join(path.read_bytes() for path in sorted(files)))
    return f"{version()} (modules {digest.hexdigest()[:8]})"


def describe_files(paths: Iterable[str | Path]) -> dict[str, tuple[int, int]]:
    """Return size [bytes] and time of change [s] by absolute path, without files that cannot be read."""
    states = {}
    for path in paths:
        with suppress(OSError):
            state = os.stat(path)
            states[os.path.abspath(path)] = (state.st_size, int(state.st_mtime))
    return states


def run_order(packed: bytes, threads: int) -> Line:
    """Run the task of a pickled order on a worker with so many threads, and return the task's line of the manifest.

    Raises:
        ClusterError: the worker cannot do it; the message is a predicate.
    """
    order: Order = pickle.loads(packed)
    fault = order.find_fault(threads)
    if fault:
        raise ClusterError(fault)
    if str(_CHECKOUT) not in sys.path:
        sys.path.append(str(_CHECKOUT))  # the lab, which is not installed
    before = os.getcwd()
    os.chdir(order.folder)
    try:
        return pickle.loads(order.task).run()
    finally:
        os.chdir(before)


def run_in_cluster(tasks: Sequence[Task], options: EngineOptions, manifest: Manifest) -> Iterator[Line]:
    """Yield the lines of tasks as these end, in any order.

    A task that Dask gave up may have suffered from its neighbour on the worker: it is tried again by itself.

    Args:
        tasks: whose input files and output folder all workers see under the same paths.
        options: with the address of a scheduler, or a number of workers on this machine.
        manifest: of the output folder; `alone` of this run.

    Raises:
        MissingDependencyError: Dask is not installed.
        ClusterError: the cluster cannot be reached or used, or is lost.
    """
    with _open_client(options, len(tasks)) as client:
        cluster = _Cluster(client, options.scheduler or "workers of this machine", manifest)
        given_up = yield from cluster.run(tasks)
        for suspect in given_up:
            for task in (yield from cluster.run([suspect])):
                yield task.line(_DIED)


class _Cluster:
    """Runs tasks on the workers of a cluster, and never waits for what cannot come.

    Args:
        client: of Dask, connected.
        name: for messages.
        manifest: of the output folder.
    """

    def __init__(self, client: Any, name: str, manifest: Manifest) -> None:
        import dask

        self._client, self._name, self._manifest = client, name, manifest
        self._idle_timeout = dask.utils.parse_timedelta(dask.config.get(_TIMEOUT_SETTING, None) or IDLE_TIMEOUT)
        self._last_sign, self._warned = monotonic(), False

    def run(self, tasks: Sequence[Task]) -> Generator[Line, None, list[Task]]:
        """Yield the lines of tasks as these end, and return the tasks whose workers died too often."""
        from distributed import CancelledError, KilledWorker, TimeoutError

        orders, ended, given_up = [self._make_order(task) for task in tasks], Queue(), []
        packed = [pickle.dumps(order) for order in orders]
        futures = self._client.map(_make_entrance(), packed, sources=orders[0].sources, pure=False)
        left = {future.key: each for future, *each in zip(futures, tasks, orders, strict=True)}
        for future in futures:
            future.add_done_callback(ended.put)
        del futures, future
        while left:
            future = self._wait(ended)
            task, order = left[future.key]
            try:
                line = future.result(timeout=ANSWER_TIMEOUT)
            except CancelledError:
                raise self._lost() from None
            except (KilledWorker, TimeoutError):  # the latter once a worker died before it gave its result
                line = None
                given_up.append(task)
            except Exception as error:
                if describe_files(order.files) == order.files:
                    raise ClusterError(one_line(error)) from error
                line = task.line("its files changed after the run had begun")
            del left[future.key]
            if line is not None:
                yield line
        return given_up

    def _make_order(self, task: Task) -> Order:
        """Return the order of a task."""
        package = task.work.__module__.partition(".")[0]
        return Order(
            task=pickle.dumps(task),
            package=package,
            sources=describe_sources(package),
            folder=os.getcwd(),
            mark=str(self._manifest.lock.resolve()),
            run_id=self._manifest.run_id,
            files=describe_files(task.files[:MOST_FILES]),
        )

    def _wait(self, ended: Queue) -> Any:
        """Return the next future that has ended.

        Raises:
            ClusterError: none can end any more.
        """
        while True:
            with suppress(Empty):
                future = ended.get(timeout=LOOK_PERIOD)
                self._last_sign = monotonic()
                return future
            self._look()

    def _look(self) -> None:
        """Check that the scheduler answers, and that a worker was at a task lately."""
        from distributed import TimeoutError

        try:
            found = self._client.sync(self._client.scheduler.identity, callback_timeout=ANSWER_TIMEOUT)
        except (OSError, TimeoutError, AttributeError) as error:  # of a client that has closed itself
            raise self._lost() from error
        if any(worker["metrics"].get("task_counts", {}).get("executing") for worker in found["workers"].values()):
            self._last_sign = monotonic()
        if not found["workers"] and not self._warned:
            self._warned = True
            tqdm.write(f"note: {self._name}: no worker yet; waits for {self._idle_timeout:g} s", file=sys.stderr)
        if monotonic() - self._last_sign > self._idle_timeout:
            text = f"{self._name}: none of {len(found['workers'])} workers was at a task for {self._idle_timeout:g} s"
            raise ClusterError(f"{text}; expected some, as `dask worker` starts them")

    def _lost(self) -> ClusterError:
        """Return the error of a scheduler that does not answer any more."""
        kept = f"what is done stands in {self._manifest.path}, and the same command does the rest"
        return ClusterError(f"{self._name}: the scheduler is gone; {kept}")


def _holds(file: Path, text: str) -> bool:
    """Say whether a file can be read, and holds a text."""
    try:
        return file.read_text(encoding="utf-8") == text
    except (OSError, UnicodeDecodeError):
        return False


def _make_entrance() -> Callable[..., Line]:
    """Return what a worker calls: nested, so that it is sent as code and can name a worker without finforce."""

    def run_finforce(packed: bytes, sources: str) -> Line:
        from distributed import get_worker

        worker = get_worker()
        name = f"worker {worker.name}" if worker.name == worker.address else f"worker {worker.name} at {worker.address}"
        try:
            from finforce_eval.cluster import run_order
        except ImportError as error:
            raise RuntimeError(f"{name} has no such finforce ({error}); expected {sources}: install it there") from None
        try:
            return run_order(packed, worker.state.nthreads)
        except Exception as error:
            raise RuntimeError(f"{name} {error}") from None

    return run_finforce


@contextmanager
def _open_client(options: EngineOptions, count: int) -> Iterator[Any]:
    """Yield a client of the cluster that the options name, or of one of this machine for so many tasks."""
    distributed = import_library("distributed", "a cluster (--workers, --scheduler)", "'finforce[dask]'")
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # it is told in our own words
    with ExitStack() as stack:
        where = options.scheduler or stack.enter_context(_start_workers(options, count))
        try:
            client = distributed.Client(where, timeout=ANSWER_TIMEOUT, set_as_default=False)
        except (OSError, distributed.TimeoutError, ValueError) as error:
            expected = "expected the address that `dask scheduler` prints, such as tcp://host:8786"
            raise ClusterError(f"--scheduler {where}: {one_line(error)}; {expected}") from error
        stack.callback(_close, client)
        if client.dashboard_link and (options.scheduler or find_spec("bokeh")):
            print(f"Dashboard: {client.dashboard_link}")
        yield client


def _close(client: Any) -> None:
    """Leave a cluster."""
    from distributed import TimeoutError

    with suppress(OSError, TimeoutError):
        client.close(CLOSE_TIMEOUT)


@contextmanager
def _start_workers(options: EngineOptions, count: int) -> Iterator[Any]:
    """Yield a cluster of this machine, which only its own processes can speak to."""
    import dask
    from distributed import LocalCluster, TimeoutError

    import_library("cryptography", "a cluster of this machine", "'finforce[dask]'")
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_LOCAL_SETTINGS))
        try:
            cluster = LocalCluster(
                n_workers=min(options.workers or dask.system.CPU_COUNT, count),
                threads_per_worker=1,
                memory_limit=int(options.memory * _GIGABYTE),
                env=dict(os.environ),
                death_timeout=START_TIMEOUT,
                security=True,
                silence_logs=logging.CRITICAL,
                dashboard_address="127.0.0.1:0" if find_spec("bokeh") else None,
            )
        except (OSError, RuntimeError, TimeoutError) as error:
            raise ClusterError(f"workers of this machine: they do not start: {one_line(error)}") from error
        yield stack.enter_context(cluster)
