"""Where compiled code is kept."""

import os
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


def make_sources(root):
    for package in ("finforce_contact", "finforce_ifea", "finforce_keypoints"):
        (root / package / "deep").mkdir(parents=True)
        (root / package / "deep" / "kernels.py").write_text("one = 1\n")
    return root


def test_another_source_has_another_folder(tmp_path):
    root = make_sources(tmp_path)
    name = caches._name_sources(root)
    assert caches._name_sources(root) == name
    (root / "finforce_ifea" / "deep" / "kernels.py").write_text("one = 11\n")
    assert caches._name_sources(root) != name


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
