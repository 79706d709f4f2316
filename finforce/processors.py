"""Threads and processors, where there are no more of these than of those.

Linux wakes a sleeping thread on the processor of the one that wakes it, and spreads them only after a while. An image
at 30 Hz is over before: a network of two threads takes 6.7 ms on two processors, 4.4 ms where each has its own.
"""

from __future__ import annotations

import os

ALL = frozenset(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else frozenset()


def are_scarce(threads: int) -> bool:
    """Say whether so many threads that work together would share processors unless they are bound."""
    return 1 < len(ALL) <= threads


def bind_caller(threads: int) -> None:
    """Bind the calling thread, of so many that work together, to the first processor, where they are scarce."""
    if are_scarce(threads):
        os.sched_setaffinity(0, {min(ALL)})


def bind_helper(threads: int) -> None:
    """Bind the calling thread, a helper of one that is bound, to the other processors, where they are scarce."""
    if are_scarce(threads):
        os.sched_setaffinity(0, ALL - {min(ALL)})


def free_caller() -> None:
    """Let the calling thread run everywhere, whoever it was started by."""
    if ALL:
        os.sched_setaffinity(0, ALL)


def places_of_helpers(threads: int) -> str:
    """Return the processors of the threads beside the caller as onnxruntime wants them, from 1; "" for free ones."""
    if not are_scarce(threads):
        return ""
    others = sorted(ALL)[1:]
    return ";".join(str(1 + others[number % len(others)]) for number in range(threads - 1))
