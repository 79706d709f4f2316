"""A first start compiles in processes of their own: several take less time, and they give their memory back."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from subprocess import DEVNULL, Popen
from typing import TYPE_CHECKING

from finforce.caches import find_prepared, keep_compiled, locked

if TYPE_CHECKING:
    from rclpy.impl.rcutils_logger import RcutilsLogger

COMMAND = (sys.executable, "-m", "finforce_eval.cli.main", "prepare", "--calibration", "bench")
WORDS = "compiles what a first start needs, most of a minute; 'finforce prepare' does it ahead"
_RUNNING: list[Popen] = []


def prepare_first_start(log: RcutilsLogger, command: Sequence[str] = COMMAND) -> None:
    """Compile everything, unless that was done before; of several processes one does, and the others wait.

    What hinders it is left to the node, which compiles by itself what it misses.

    Args:
        log: where it is said.
        command: what compiles, and notes when it is done.
    """
    keep_compiled()
    prepared = find_prepared()
    if prepared.exists() or not _can_write(prepared.parent):
        return
    with locked(prepared.with_suffix(".lock")):
        if not prepared.exists():
            log.info(WORDS)
            _run(log, command)


def end_preparation() -> None:
    """End what compiles; what it keeps is written whole or not at all."""
    for run in _RUNNING:
        with suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)


def _run(log: RcutilsLogger, command: Sequence[str]) -> None:
    """Run a command with all its processes in a group of their own."""
    try:
        run = Popen(command, stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL, start_new_session=True)
    except OSError as error:
        log.warning(f"{command[0]} cannot be started ({error.strerror}): this node compiles by itself")
        return
    _RUNNING.append(run)
    status = run.wait()
    _RUNNING.remove(run)
    if status:
        log.warning(f"{' '.join(command)} ended with status {status}: this node compiles by itself")


def _can_write(folder: Path) -> bool:
    """Say whether what is compiled can be kept in a folder."""
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return os.access(folder, os.W_OK)
