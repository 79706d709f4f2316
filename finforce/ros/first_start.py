"""A first start compiles in processes of their own: several take less time, and they give their memory back."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from subprocess import DEVNULL, Popen
from typing import IO, TYPE_CHECKING

from finforce.caches import ROOT, find_prepared

if TYPE_CHECKING:
    from rclpy.impl.rcutils_logger import RcutilsLogger

# These very sources, wherever the node was started: `python -m` would look into the present folder first.
_MAIN = """
import sys
root = sys.argv.pop(1)
sys.path[:] = [*([] if root in sys.path else [root]), *filter(None, sys.path)]
from finforce_eval.cli.main import main
sys.exit(main())
"""
COMMAND = (sys.executable, "-c", _MAIN, str(ROOT), "prepare", "--once", "--calibration", "bench")
WORDS = "waits until what a first start needs is compiled, most of a minute; 'finforce prepare' does it ahead"
_AGAIN = 3600.0  # [s] after which what has failed is tried again
_RUNNING: list[Popen] = []


def prepare_first_start(log: RcutilsLogger, command: Sequence[str] = COMMAND) -> None:
    """Compile everything, unless that was done before; of several processes one does, and the others wait.

    What hinders it is said and left to the node, which compiles by itself what it misses.

    Args:
        log: where it is said.
        command: what compiles, and notes when it is done.
    """
    prepared = find_prepared()
    failed = prepared.with_suffix(".failed")
    if prepared.exists() or _has_failed(failed) or not _can_write(prepared.parent):
        return
    log.info(WORDS)
    fault = _run(command)
    if fault:
        failed.touch()
        log.warning(f"nothing was compiled ahead, this node compiles by itself: {fault}")


def end_preparation() -> None:
    """End what compiles; what it keeps is written whole or not at all."""
    for run in _RUNNING:
        with suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)


def _run(command: Sequence[str]) -> str:
    """Run a command with all its processes in a group of their own; return its last words where it fails."""
    with tempfile.TemporaryFile() as said:
        try:
            run = Popen(command, stdin=DEVNULL, stdout=DEVNULL, stderr=said, start_new_session=True)
        except OSError as error:
            return f"{command[0]}: {error.strerror}"
        _RUNNING.append(run)
        try:
            status = run.wait()
        except BaseException:
            end_preparation()
            raise
        finally:
            _RUNNING.remove(run)
        return f"status {status}, {_read_last(said)}" if status else ""


def _read_last(said: IO[bytes]) -> str:
    """Return the last line of what was said."""
    said.seek(0)
    lines = said.read().decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else "without a word"


def _has_failed(failed: Path) -> bool:
    """Say whether it has failed of late."""
    try:
        return time.time() - failed.stat().st_mtime < _AGAIN
    except OSError:
        return False


def _can_write(folder: Path) -> bool:
    """Say whether what is compiled can be kept in a folder."""
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)
