"""Where what was built once is kept."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """Return the folder of the cache, which may not exist yet: FINFORCE_CACHE, else `finforce` in the user's own."""
    named = os.environ.get("FINFORCE_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "finforce"
