"""Numba's `njit`, which keeps what it compiles by the content of these sources, wherever they are installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numba import njit

from finforce.caches import COMPILED, ROOT, keep_compiled, name_sources

try:
    from numba.core.caching import CacheImpl, UserProvidedCacheLocator
    from numba.core.codegen import JITCodeLibrary, JITCPUCodegen, ll
except ImportError:  # another Numba, whose own locators go by path and time
    CacheImpl = UserProvidedCacheLocator = JITCodeLibrary = JITCPUCodegen = ll = object

__all__ = ["njit"]


class SourceLocator(UserProvidedCacheLocator):
    """Place at which Numba keeps a function of these sources: under the name of its package.

    Numba's own locators name the folder by the path of the file, and compile anew when that file alone has changed, or
    in older versions when it has been written.
    """

    _last = ("", 0, "")  # file, line and stamp of the last function

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> SourceLocator | None:
        """Return the place of a function; none leaves it to Numba's own locators."""
        path = Path(py_file)
        is_own = path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in COMPILED
        return super().from_function(py_func, py_file) if is_own else None

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        """Return the name of the folder."""
        return ".".join(Path(py_file).relative_to(ROOT).parent.parts)

    def get_source_stamp(self) -> str:
        """Return what changes with all that the function depends on, found out once while a module is executed."""
        file, line, stamp = SourceLocator._last
        if file != self._py_file or line >= self._lineno:
            stamp = name_sources(ROOT)
        SourceLocator._last = self._py_file, self._lineno, stamp
        return stamp


class LeanLibrary(JITCodeLibrary):
    """Machine code of a function, whose intermediate code is parsed when something is compiled against it.

    Numba parses that of every function that it loads: 1 MB each, which nobody needs where all is compiled.
    """

    _bitcode = b""

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, Any]) -> Any:
        """Return a function's library that was kept."""
        library = super()._unserialize(codegen, state)
        if state[1] == "object":
            _, library._bitcode = state[2]
            library._shared_module = None
        return library

    def _get_module_for_linking(self) -> Any:
        """Return the intermediate code."""
        if self._bitcode and self._shared_module is None:
            self._shared_module = ll.parse_bitcode(self._bitcode)
        return super()._get_module_for_linking()


keep_compiled()
getattr(CacheImpl, "_locator_classes", []).insert(0, SourceLocator)
if getattr(JITCPUCodegen, "_library_class", None) is JITCodeLibrary:
    JITCPUCodegen._library_class = LeanLibrary
