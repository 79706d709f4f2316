"""The cache of what is built once."""

from __future__ import annotations

import atexit
import hashlib
import os
import re
import shutil
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib.metadata import version
from itertools import accumulate
from pathlib import Path
from tempfile import mkdtemp

from finforce.errors import FinforceError

FIRST_START = "compiling, which takes a minute or two once; `finforce prepare` does it ahead of time"
# Packages whose functions are compiled, and days after which what nobody has used is removed.
COMPILED = ("finforce", "finforce_contact", "finforce_ifea", "finforce_keypoints", "finforce_sim")
_UNUSED = 30.0
_IMPORTS = re.compile(r"import[ \t]+(.*)"), re.compile(r"from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|.*)")
ROOT = Path(__file__).parents[1]


class CacheError(FinforceError, PermissionError):
    """Others can write into the folder of the cache, from which compiled code is run."""


def cache_folder() -> Path:
    """Return the folder of the cache, which may not exist yet: FINFORCE_CACHE, else `finforce` in the user's own.

    Raises:
        CacheError: others can write there, or into a folder above it.
    """
    named = os.environ.get("FINFORCE_CACHE")
    folder = Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "finforce"
    refuse_foreign(folder)
    return folder


def refuse_foreign(folder: Path) -> None:
    """Refuse a folder that others could have put something into, as ssh refuses a file of keys.

    Raises:
        CacheError: it, what lies in it, or a folder above it is another user's, or open to the group or to all; above
            it root's folders count as one's own, and such as /tmp, where nobody can touch what is another's.
    """
    folder = folder.resolve()
    for path in (folder, *folder.parents):
        try:
            state = path.stat()
        except OSError:
            continue
        above = path != folder
        writers = stat.S_IWOTH if _is_own_group(state.st_gid) else stat.S_IWGRP | stat.S_IWOTH
        is_open = state.st_mode & writers and not (above and state.st_mode & stat.S_ISVTX)
        if is_open or state.st_uid not in ({os.geteuid(), 0} if above else {os.geteuid()}):
            raise CacheError(
                f"{path}: others can write there, and code is run from the cache {folder}; expected a folder of your "
                "own: chmod go-w, or another FINFORCE_CACHE"
            )


def _is_own_group(number: int) -> bool:
    """Say whether a group is the user's own, as Debian gives one to everybody."""
    import grp
    import pwd

    with suppress(KeyError):
        group, user = grp.getgrgid(number), pwd.getpwuid(os.geteuid()).pw_name
        return group.gr_name == user and set(group.gr_mem) <= {user}
    return False


def keep_compiled() -> None:
    """Let Numba keep what it compiles in a folder of the content of these sources, unless NUMBA_CACHE_DIR names one.

    Called before anything is compiled; a folder that cannot be written leaves Numba to its own choice.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return _remove_truncated(Path(os.environ["NUMBA_CACHE_DIR"]))
    try:
        folder = cache_folder() / "compiled" / _read_sources(ROOT)[0]
        refuse_foreign(folder)
    except CacheError as error:
        print(f"finforce: {error}; compiled code is kept for this process only", file=sys.stderr)
        folder = Path(mkdtemp(prefix="finforce_"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    with suppress(OSError, RuntimeError):
        if not folder.is_dir():
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            _remove_unused(folder.parent)
        os.utime(folder)
        _remove_truncated(folder)
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


def name_sources(root: Path) -> str:
    """Return a name for the content of all that compiled code below a folder depends on, and for what compiles it.

    Numba keeps the values of module attributes in the code that it compiles, and what is called with it. So these are
    the modules with compiled functions, and all that those import, wherever they lie. Once one of them is written while
    the process runs, which of the contents it has loaded is not known, and the name is one that nobody else has.
    """
    name, before = _read_sources(root)
    now = {path: _find_state(path) for path in before}
    return name if now == before else f"{name} {sorted(now.values())}"


@cache
def _read_sources(root: Path) -> tuple[str, dict[str, tuple[int, int]]]:
    """Return the name, and for each of the files when it was written, and its size."""
    files = [path for package in COMPILED for path in (root / package).rglob("*.py")]
    paths = {".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path for path in files}
    states = {name: _find_state(str(path)) for name, path in paths.items()}
    sources = {name: path.read_text(encoding="utf-8") for name, path in paths.items()}
    found, pending = set(), [name for name, source in sources.items() if "numba" in source or "njit" in source]
    while pending:
        if (name := pending.pop()) in sources and name not in found:
            found.add(name)
            pending += _find_imports(sources[name])
    digest = hashlib.sha256(f"numba {version('numba')} numpy {version('numpy')}".encode())
    for name in sorted(found):
        digest.update(f"\n{name} {hashlib.sha256(sources[name].encode()).hexdigest()}".encode())
    return digest.hexdigest()[:16], {str(paths[name]): states[name] for name in found}


def _find_state(path: str) -> tuple[int, int]:
    """Return when a file was written [ns], and its size [bytes]; zeros for one that is gone."""
    with suppress(OSError):
        state = os.stat(path)
        return state.st_mtime_ns, state.st_size
    return 0, 0


def _find_imports(source: str) -> Iterator[str]:
    """Yield the names of all that a module imports, anywhere in it: packages, modules and what is in these."""
    plain, parts = _IMPORTS
    found = [("", names) for names in plain.findall(source)] + parts.findall(source)
    for module, names in found:
        for name in re.findall(r"[\w.]+", names):
            yield from accumulate(f"{module}.{name}".strip(".").split("."), "{}.{}".format)


@cache
def _remove_truncated(folder: Path) -> None:
    """Remove compiled code that was cut off, by a full disk or a crash: a pickle ends with a point."""
    for path in folder.rglob("*.nb[ci]"):
        with suppress(OSError), path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - 1))
            if file.read(1) != b".":
                path.unlink()


def _remove_unused(parent: Path) -> None:
    """Remove the folders that no start has used for long."""
    for folder in parent.iterdir():
        if time.time() - folder.stat().st_mtime > _UNUSED * 86400.0:
            shutil.rmtree(folder, ignore_errors=True)
