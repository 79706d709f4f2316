"""Where compiled code is kept."""

import ast
import os
import shutil
import subprocess
import sys
import time

import pytest

from finforce import caches
from finforce_eval.evaluation.setup import announce_compilation


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FINFORCE_CACHE", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    import numba

    monkeypatch.setattr(numba.config, "CACHE_DIR", numba.config.CACHE_DIR)
    return tmp_path / "compiled"


KERNELS = """from finforce.compiled import njit
from finforce.deep import constants


@njit(cache=True)
def scale(x):
    return constants.FACTOR * x
"""
SCALE = (
    "from finforce.deep.kernels import scale as f; print(f(2.0), len(f.stats.cache_hits), len(f.stats.cache_misses))"
)


def make_sources(root, constants="from finforce.bottom import FACTOR", factor=3.0):
    """Write a package with one function, which is compiled with what two other modules say."""
    deep = root / "finforce" / "deep"
    deep.mkdir(parents=True)
    (root / "finforce" / "__init__.py").touch()
    for name in ("errors", "caches", "compiled"):
        shutil.copyfile(caches.ROOT / "finforce" / f"{name}.py", root / "finforce" / f"{name}.py")
    (deep / "kernels.py").write_text(KERNELS)
    (deep / "constants.py").write_text(f"{constants}\n")
    (deep / "unused.py").write_text("one = 1\n")
    (root / "finforce" / "bottom.py").write_text(f"FACTOR = {factor}\n")
    return root


def test_compiled_code_is_kept_by_the_content_of_all_that_it_depends_on(tmp_path):
    cache = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    cache["FINFORCE_CACHE"] = str(tmp_path / "cache")

    def scale(name, factor, before=""):
        root = make_sources(tmp_path / name, factor=factor)
        return subprocess.check_output([sys.executable, "-c", before + SCALE], cwd=root, env=cache, text=True).split()

    assert scale("one", 3.0) == ["6.0", "0", "1"]
    assert scale("same", 3.0) == ["6.0", "1", "0"]
    assert scale("other", 4.0) == ["8.0", "0", "1"]
    assert scale("old Numba", 3.0, "from numba.core import caching; del caching.CacheImpl\n") == ["6.0", "0", "1"]


LINK = """from finforce.deep.kernels import njit, scale

assert scale(2.0) == 6.0
[loaded] = (kept.library for kept in scale.overloads.values())
print(len(scale.stats.cache_hits), loaded._shared_module is None)
print(njit(lambda x: scale(x) + 1.0)(2.0))
"""


def test_a_kept_function_is_parsed_when_another_is_compiled_against_it(tmp_path):
    cache = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    cache["FINFORCE_CACHE"] = str(tmp_path / "cache")
    root = make_sources(tmp_path / "one")

    def link():
        return subprocess.check_output([sys.executable, "-c", LINK], cwd=root, env=cache, text=True).split()

    assert link() == ["0", "False", "7.0"]
    assert link() == ["1", "True", "7.0"]


@pytest.mark.parametrize(
    "constants",
    [
        "import finforce.bottom",
        "from finforce import (\n  bottom,\n)",
        "def f():\n    from finforce.bottom import FACTOR",
    ],
)
def test_another_content_has_another_name(tmp_path, constants):
    root = make_sources(tmp_path / "one", constants)
    name = caches.name_sources(root)
    assert caches.name_sources(make_sources(tmp_path / "same", constants)) == name
    assert caches.name_sources(make_sources(tmp_path / "other", constants, 4.0)) != name
    unused = make_sources(tmp_path / "unused", constants)
    (unused / "finforce" / "deep" / "unused.py").write_text("one = 2\n")
    assert caches.name_sources(unused) == name
    os.utime(root / "finforce" / "bottom.py", (0, 0))
    assert caches.name_sources(root) != name  # as it is loaded from now on, it may be another


def test_all_that_a_module_imports_is_found():
    """Whatever the way in which it is written; a relative import would not be."""
    for path in [path for package in caches.COMPILED for path in (caches.ROOT / package).rglob("*.py")]:
        source, names = path.read_text(encoding="utf-8"), set()
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom):
                assert not node.level, path
                names |= {node.module} | {f"{node.module}.{each.name}" for each in node.names}
            elif isinstance(node, ast.Import):
                names |= {each.name for each in node.names}
        assert names <= set(caches._find_imports(source)), path


def test_numba_is_told_before_and_after_its_import(cache):
    import numba

    caches.keep_compiled()
    (folder,) = cache.iterdir()
    assert os.environ["NUMBA_CACHE_DIR"] == numba.config.CACHE_DIR == str(folder)


def test_a_folder_that_was_named_is_left_alone(cache, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "elsewhere")
    caches.keep_compiled()
    assert os.environ["NUMBA_CACHE_DIR"] == "elsewhere"
    assert not cache.exists()


def test_what_nobody_has_used_for_long_is_removed(cache):
    old, recent = cache / "old", cache / "recent"
    for folder, days in ((old, 40), (recent, 3)):
        folder.mkdir(parents=True)
        os.utime(folder, (time.time() - days * 86400,) * 2)
    caches.keep_compiled()
    assert not old.exists()
    assert recent.exists()


def test_a_folder_that_cannot_be_written_stops_nobody(cache, monkeypatch):
    cache.parent.joinpath("file").write_text("")
    monkeypatch.setenv("FINFORCE_CACHE", str(cache.parent / "file" / "below"))
    caches.keep_compiled()
    assert not cache.exists()


def test_a_first_start_is_known_by_its_empty_cache_and_told_at_once(cache, capsys):
    assert not caches.is_compiled()
    announce_compilation.cache_clear()
    announce_compilation()
    assert "compiling, which takes a minute or two once" in capsys.readouterr().err
    (folder,) = cache.iterdir()
    (folder / "kernels.1.nbc").touch()
    assert caches.is_compiled()
    announce_compilation.cache_clear()
    announce_compilation()
    assert not capsys.readouterr().err


@pytest.mark.parametrize("place", ["cache", "above"])
def test_a_cache_that_others_can_write_is_not_used(place, tmp_path, monkeypatch, capsys):
    above = tmp_path / "above"
    folder = above / "cache"
    folder.mkdir(parents=True, mode=0o700)
    monkeypatch.setenv("FINFORCE_CACHE", str(folder))
    assert caches.cache_folder() == folder
    (folder if place == "cache" else above).chmod(0o777)
    with pytest.raises(caches.CacheError, match=f"{place}: others can write there"):
        caches.cache_folder()
    above.chmod(0o1777)
    if place == "above":  # as in /tmp, nobody can replace what is another's
        assert caches.cache_folder() == folder


def test_compiled_code_in_a_folder_of_others_is_left_alone(cache, capsys):
    cache.parent.chmod(0o777)
    caches.keep_compiled()
    assert "others can write there" in capsys.readouterr().err
    assert not cache.exists() and not os.environ["NUMBA_CACHE_DIR"].startswith(str(cache.parent))


def test_a_cache_of_another_user_is_refused(cache, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: os.stat(cache.parent).st_uid + 1)
    with pytest.raises(caches.CacheError):
        caches.cache_folder()


def test_compiled_code_that_was_cut_off_is_removed(cache):
    caches.keep_compiled()
    (folder,) = cache.iterdir()
    for name, content in (("whole.nbi", b"pickled."), ("cut.nbi", b"pick"), ("empty.1.nbc", b"")):
        (folder / name).write_bytes(content)
    caches._remove_truncated.cache_clear()
    caches.keep_compiled()
    assert [path.name for path in folder.iterdir()] == ["whole.nbi"]
