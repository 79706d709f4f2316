"""Memory that is kept for the next image instead of being given back."""

from __future__ import annotations

import ctypes
import sys

KEPT = 1 << 28  # [bytes] of free memory that stay with the process
LARGEST = 1 << 25  # [bytes] of a block, the most that glibc allows, up to which it comes from there
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of glibc's mallopt


def keep_heap() -> bool:
    """Have the C library keep freed memory, and return whether it does.

    It gives blocks of a megabyte back to the system, which clears their pages anew for every image: two thirds of what
    it costs to receive one.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries have none
    return mallopt is not None and all(
        [mallopt(name, size) for name, size in ((_TRIM_THRESHOLD, KEPT), (_MMAP_THRESHOLD, LARGEST))]
    )
