"""How tasks are carried out: here, one after the other; in processes; on a Ray cluster. The outcome is the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from finforce.errors import FinforceError, one_line
from finforce.optional import import_library
from finforce_eval.engine.tasks import FAILED, Manifest, Task, make_line, run_task
from finforce_eval.errors import OptionError

SEQUENTIAL, PROCESSES, RAY = ENGINES = ("sequential", "processes", "ray")
# Tasks of a process before another one takes its place: what a library leaks stays bounded. Python's own
# max_tasks_per_child waits for ever, now and then, once all processes have done that many (3.11 to 3.13).
_TASKS_PER_PROCESS = 50
_GIGABYTE, _LARGEST_MEMORY = 1 << 30, 1e6
Line = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """How many tasks are carried out, and where; raises OptionError where that cannot be.

    Attributes:
        engine: "sequential", "processes" or "ray".
        workers: at once; 0: one for each processor.
        memory: that a task of "processes" or "ray" may have [GB]; 0: any.
        address: of a Ray cluster; "": one of this machine alone.
    """

    engine: str = SEQUENTIAL
    workers: int = 0
    memory: float = 4.0
    address: str = ""

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise OptionError(f"--workers {self.workers}: expected the number of recordings at once, or 0")
        if not 0.0 <= self.memory < _LARGEST_MEMORY:
            raise OptionError(f"--memory {self.memory}: expected gigabytes, or 0")


def run_tasks(
    tasks: Sequence[Task],
    options: EngineOptions,
    manifest: Manifest,
    done: Callable[[Task], Line | None] = lambda task: None,
    unit: str = "recording",
) -> list[Line]:
    """Carry out the tasks that are not done yet, under one progress bar, and return the lines of all in their order.

    Args:
        tasks: with names of their own.
        options: of the engine.
        manifest: where lines are kept; what it holds as done with the same key is not done again.
        done: says what has become of a task that ended just before a run was killed; its line, or None.
        unit: what a task is, for the bar.

    Raises:
        FinforceError: the engine cannot be used.
    """
    from tqdm import tqdm

    lines: dict[str, Line] = {}
    before, left = manifest.read(), []
    for task in tasks:
        line = before.get(task.name)
        known = line if task.is_done(line) else None
        if known is None and (known := done(task)) is not None:
            manifest.append(known)
        if known is None:
            left.append(task)
        else:
            lines[task.name] = known
    with tqdm(total=len(tasks), initial=len(lines), unit=unit, disable=None, leave=False) as bar:
        for line in _RUNNERS[options.engine](left, options):
            manifest.append(line)
            lines[line["name"]] = line
            bar.set_postfix_str(f"{sum(each['status'] == FAILED for each in lines.values())} failed")
            bar.update()
    return [lines[task.name] for task in tasks]


def _run_here(tasks: Sequence[Task], options: EngineOptions) -> Iterator[Line]:
    yield from map(run_task, tasks)


def _run_in_processes(tasks: Sequence[Task], options: EngineOptions) -> Iterator[Line]:
    """Yield lines as processes end their tasks; one that dies costs the task that it was at."""
    from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context

    workers, left, alone = options.workers or _count_processors(), list(tasks), False
    while left:
        pool = ProcessPoolExecutor(
            1 if alone else min(workers, len(left)),
            mp_context=get_context("spawn"),
            initializer=_limit_memory,
            initargs=(options.memory,),
        )
        batch = left[: 1 if alone else _TASKS_PER_PROCESS * workers]
        try:
            running = {pool.submit(run_task, task): task for task in batch}
            while running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    line, task = future.result(), running[future]
                    del running[future]
                    left.remove(task)
                    yield line
            alone = False
        except BrokenProcessPool:
            # which task it was is not known: the first one is tried again by itself, then all others as before
            if alone:
                yield _died(left.pop(0))
            alone = not alone
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _died(task: Task) -> Line:
    """Return the line of a task whose process ended without a word."""
    return make_line(task, error="the process that was at it died: out of memory, or killed")


def _limit_memory(gigabytes: float) -> None:
    """Bound what this process may allocate."""
    if gigabytes > 0.0:
        import resource

        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (int(gigabytes * _GIGABYTE), hard))


def _count_processors() -> int:
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _run_on_ray(tasks: Sequence[Task], options: EngineOptions) -> Iterator[Line]:
    """Yield lines as a cluster ends its tasks.

    Ray ends the process that it runs in where its cluster is lost: it runs in one of its own.
    """
    import_library("ray", "--engine ray", "'finforce[ray]'")
    if not tasks:
        return
    _check_reachable(options.address)
    from multiprocessing import get_context

    context, left = get_context("spawn"), len(tasks)
    mine, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_drive_ray, args=(theirs, list(tasks), options))
    process.start()
    theirs.close()
    try:
        while left:
            line = mine.recv()
            if isinstance(line, str):
                raise FinforceError(line)
            left -= 1
            yield line
    except (EOFError, OSError) as error:
        raise FinforceError("the Ray cluster has gone; start again to go on where this run was") from error
    finally:
        mine.close()
        process.join(timeout=_PATIENCE if not left else 0.0)
        process.kill()
        process.join()


def _run_limited(task: Task, gigabytes: float) -> Line:
    """Return the line of a task that is carried out here, where it may have so much memory."""
    _limit_memory(gigabytes)
    return run_task(task)


_PATIENCE = 20.0  # [s] in which a cluster of this machine ends, and one elsewhere answers


def _check_reachable(address: str) -> None:
    """Refuse an address at which nobody listens; Ray itself would try for minutes.

    Raises:
        FinforceError: nobody does.
    """
    import re
    import socket

    found = re.fullmatch(r"(?:ray://)?\[?([^\[\]/]+?)\]?:(\d{1,5})", address)
    if not found:
        return
    try:
        socket.create_connection((found[1], int(found[2])), _PATIENCE / 4).close()
    except (OSError, OverflowError) as error:
        raise FinforceError(f"--address {address}: no Ray cluster: {error}") from error


def _drive_ray(results: Any, tasks: Sequence[Task], options: EngineOptions) -> None:
    """Send lines as a cluster ends its tasks, or what is wrong with the cluster."""
    import os

    ray = import_library("ray", "--engine ray", "'finforce[ray]'")
    # what Ray says of a lost cluster, at length, is said in one line by the process that waits for this one
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    where = {"address": options.address} if options.address else {"num_cpus": options.workers or _count_processors()}
    try:
        ray.init(log_to_driver=False, logging_level="CRITICAL", **where)
    except (Exception, SystemExit) as error:
        cause: BaseException = error
        while (deeper := cause.__cause__ or cause.__context__) is not None:
            cause = deeper
        words = one_line(cause, 10_000).rpartition("ray.exceptions.")[2][:200]
        results.send(f"--address {options.address}: no Ray cluster: {words}" if options.address else f"Ray: {words}")
        return
    remote = ray.remote(_run_limited).options(num_cpus=1, max_retries=1)
    running = {remote.remote(task, options.memory): task for task in tasks}
    while running:
        (ready,), _ = ray.wait(list(running), num_returns=1)
        task = running.pop(ready)
        try:
            results.send(ray.get(ready))
        except ray.exceptions.WorkerCrashedError:
            results.send(_died(task))
    ray.shutdown()


_RUNNERS: dict[str, Callable[[Sequence[Task], EngineOptions], Iterator[Line]]] = {
    SEQUENTIAL: _run_here,
    PROCESSES: _run_in_processes,
    RAY: _run_on_ray,
}
