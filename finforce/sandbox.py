"""Work on files from elsewhere, in a process of its own with bounded memory and time.

A library that crashes, hangs or takes all memory over a file then costs one sentence.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from finforce.errors import FinforceError, one_line
from finforce.files import BUDGET, raise_budget

MEMORY = 1 << 30  # [bytes]
SECONDS = 20  # [s] of computing
WAITS = 5  # how much longer than it computes a process may take, on a machine with other work
_CHILD = "from finforce.sandbox import _serve; _serve()"

ResultT = TypeVar("ResultT")


class SandboxError(FinforceError, RuntimeError):
    """Work in a process of its own failed, crashed, or ran out of memory or time; the message is a predicate."""


def run_limited(
    function: Callable[..., ResultT],
    *arguments: Any,
    memory: int = MEMORY,
    seconds: float = SECONDS,
    disk: int = MEMORY,
) -> ResultT:
    """Return `function(*arguments)`, computed in another process.

    Args:
        function: of a module, found there by its name.
        arguments: picklable, as the result has to be.
        memory: that the process may take [bytes].
        seconds: that it may compute [s].
        disk: that a file may have that it writes [bytes].

    Raises:
        SandboxError: The function failed, the process crashed, or a limit was reached.
        FinforceError: What the function itself raised.
    """
    memory, seconds = raise_budget(memory), raise_budget(seconds)
    order = pickle.dumps((memory, seconds, raise_budget(disk))) + pickle.dumps((function, arguments))
    paths = os.pathsep.join(os.path.abspath(path) for path in sys.path)
    environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command, longest = [sys.executable, "-c", _CHILD], WAITS * seconds
    try:
        with TemporaryDirectory(prefix="finforce_") as folder:  # a process that crashes does not tidy up
            environment["TMPDIR"] = folder
            done = subprocess.run(command, input=order, capture_output=True, timeout=longest, env=environment)
    except subprocess.TimeoutExpired:
        raise SandboxError(f"waited more than {longest:g} s; expected an answer") from None
    if not done.stdout:
        raise SandboxError(_say_how_it_ended(done.returncode, done.stderr.decode(errors="replace"), memory, seconds))
    result, error = pickle.loads(done.stdout)
    if isinstance(error, FinforceError):
        raise error
    if error is not None:
        raise SandboxError(error)
    return result


@contextmanager
def limit_growth(memory: int, disk: int = MEMORY) -> Iterator[None]:
    """Let this process take so many more bytes of memory, and write files of so many, within a `with` block.

    Raises:
        MemoryError: What is done there takes more, unless a library has an error of its own for that.
    """
    try:
        import resource

        with open("/proc/self/statm", "rb") as file:
            taken = int(file.read().split()[5]) * resource.getpagesize()
    except (ImportError, OSError):  # not on Linux: no limit is known to work
        yield
        return
    before = {kind: resource.getrlimit(kind) for kind in (resource.RLIMIT_DATA, resource.RLIMIT_FSIZE)}
    try:
        for (kind, (soft, hard)), limit in zip(before.items(), (taken + memory, disk), strict=True):
            wanted = [each for each in (limit, soft, hard) if each != resource.RLIM_INFINITY]
            resource.setrlimit(kind, (min(wanted), hard))
        yield
    finally:
        for kind, limits in before.items():
            resource.setrlimit(kind, limits)


def _say_how_it_ended(code: int, said: str, memory: int, seconds: float) -> str:
    """Return why a process gave no answer."""
    if code == -signal.SIGXCPU:
        return f"took more than {seconds:g} s; {BUDGET}=10 would allow ten times as much"
    if any(word in said for word in ("MemoryError", "bad_alloc", "out of memory")):
        return _say_memory(memory)
    if code < 0:
        return f"made its reader crash ({signal.Signals(-code).name})"
    return f"made its reader end with {code}: {said.strip().splitlines()[-1:]}"


def _say_memory(memory: int) -> str:
    return f"took more than {memory >> 20} MB of memory; {BUDGET}=10 would allow ten times as much"


def _serve() -> None:
    """Take limits and work from the standard input, and write the answer; what libraries print goes to the errors."""
    import resource

    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    memory, seconds, disk = pickle.load(sys.stdin.buffer)
    limits = {resource.RLIMIT_DATA: memory, resource.RLIMIT_CPU: seconds, resource.RLIMIT_CORE: 0}
    limits[resource.RLIMIT_FSIZE] = disk
    for kind, limit in limits.items():
        hard = resource.getrlimit(kind)[1]
        limit = int(limit) if hard == resource.RLIM_INFINITY else min(int(limit), hard)
        resource.setrlimit(kind, (limit, hard))
    result = error = None
    try:
        function, arguments = pickle.load(sys.stdin.buffer)
        result = function(*arguments)
    except FinforceError as raised:
        error = raised
    except MemoryError:
        error = _say_memory(memory)
    except Exception as raised:  # of any library
        error = f"made its reader fail ({type(raised).__name__}: {one_line(raised, 300)})"
    answer.write(pickle.dumps((result, error)))
    answer.close()
