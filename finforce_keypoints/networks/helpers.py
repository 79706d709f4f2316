"""Threads that share the pictures of a batch, a picture at a time.

Two threads that compute one picture wait for each other at every layer of a small network; two pictures do not.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from finforce.processors import bind_helper


class Helpers:
    """Threads beside the caller's own.

    Args:
        threads: all of them, the caller's included.
    """

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._pool = ThreadPoolExecutor(max(threads - 1, 1), "pictures", bind_helper, (threads,))

    def share(self, work: Callable[[int], Any], count: int) -> list[Any]:
        """Return what the work gives for the numbers from 0 to a count; the first error in one of them is raised."""
        found: list[Any] = [None] * count
        waiting = iter(range(count))

        def run() -> None:
            for number in waiting:
                found[number] = work(number)

        others = [self._pool.submit(run) for _ in range(min(self._threads, count) - 1)]
        run()
        for other in others:
            other.result()
        return found
