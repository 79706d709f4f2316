"""Where what was built once is kept."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

# Packages whose functions are compiled, and days after which what nobody has used is removed.
_COMPILED = ("finforce", "finforce_contact", "finforce_ifea", "finforce_keypoints")
_UNUSED = 30.0
ROOT = Path(__file__).parents[1]


def cache_folder() -> Path:
    """Return the folder of the cache, which may not exist yet: FINFORCE_CACHE, else `finforce` in the user's own."""
    named = os.environ.get("FINFORCE_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "finforce"


def keep_compiled() -> None:
    """Let Numba keep what it compiles in a folder of these very sources, unless NUMBA_CACHE_DIR names one.

    Numba compiles a function anew when its own file has changed, and does not look at the files of what that calls.
    Called before anything is compiled; a folder that cannot be written leaves Numba to its own choice.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    folder = cache_folder() / "compiled" / _name_sources(ROOT)
    with suppress(OSError, RuntimeError):
        if not folder.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            _remove_unused(folder.parent)
        os.utime(folder)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other processes that lock the same file from doing the same; where locks cannot be had, all do it."""
    with ExitStack() as stack:
        with suppress(ImportError, OSError):
            import fcntl

            path.parent.mkdir(parents=True, exist_ok=True)
            fcntl.flock(stack.enter_context(path.open("w")), fcntl.LOCK_EX)
        yield


def is_compiled() -> bool:
    """Say whether anything of these sources was compiled before."""
    keep_compiled()
    return any(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbc"))


def _name_sources(root: Path) -> str:
    """Return a name for the sources below a folder: where they lie, and when each was written."""
    digest = hashlib.sha256(str(root).encode())
    for package in _COMPILED:
        for path in sorted((root / package).rglob("*.py")):
            state = path.stat()
            digest.update(f"{path} {state.st_size} {state.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


def _remove_unused(parent: Path) -> None:
    """Remove the folders that no start has used for long."""
    for folder in parent.iterdir():
        if time.time() - folder.stat().st_mtime > _UNUSED * 86400.0:
            shutil.rmtree(folder, ignore_errors=True)
