"""Zarr groups of format 2, in a folder or a zip file: arrays whose chunks are all there and as large as they say."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import one_line
from finforce.files import check_inside, check_plain, parse_json, raise_budget
from finforce.optional import import_library
from finforce.sandbox import MEMORY, limit_growth
from finforce_eval.errors import RecordingError

JPEG_XL = "imagecodecs_jpegxl"
_CODECS = ("blosc", "zstd", "lz4", "zlib", "gzip", "bz2")  # of numcodecs, one of whose others runs what a file says
_LARGEST_BLOCK = 1 << 29  # bytes of the chunks that hold one row


class ZarrStore:
    """A group of arrays.

    Args:
        path: a folder, or a zip file.

    Raises:
        RecordingError: it is neither, or of another format.
    """

    def __init__(self, path: Path) -> None:
        self.name, self._root = path.name, path
        if path.is_file():
            with self.damage_named("the file"):
                check_plain(path)
                self._root = zipfile.Path(path)
        if self.find(".zgroup") is None:
            newer = self.find("zarr.json") is not None
            found = "Zarr format 3" if newer else "no .zgroup in it"
            raise RecordingError(f"{self.name}: {found}; expected a group of Zarr format 2, as UMI and UMI-FT write it")

    @contextmanager
    def damage_named(self, key: str) -> Iterator[None]:
        """Turn what readers and codecs raise on damaged bytes into a RecordingError that names the array."""
        try:
            yield
        except (RecordingError, ImportError):
            raise
        except Exception as error:  # of zipfile, zlib, json, and every codec its own
            raise RecordingError(f"{self.name}: {key} is damaged: {one_line(error)}") from error

    def find(self, key: str) -> bytes | None:
        """Return the bytes under a key; None where there are none."""
        part = self._root / key
        with self.damage_named(key), limit_growth(raise_budget(MEMORY)):
            if isinstance(part, Path):
                check_inside(part, self._root)
            return part.read_bytes() if part.is_file() else None

    def list_members(self, group: str) -> list[str]:
        """Return the names of the arrays and groups in a group."""
        folder = self._root / group
        return sorted(each.name for each in folder.iterdir() if each.is_dir()) if folder.is_dir() else []

    def open_array(self, key: str, shape: tuple[int | None, ...], kinds: str) -> ZarrArray:
        """Return an array.

        Args:
            key: of the array.
            shape: expected; None along an axis of any length.
            kinds: letters of the data types expected, as NumPy has them.

        Raises:
            RecordingError: it is missing, damaged, or of another shape or type.
        """
        text = self.find(f"{key}/.zarray")
        if text is None:
            group = key.rpartition("/")[0]
            there = ", ".join(self.list_members(group)) or "nothing"
            raise RecordingError(f"{self.name}: no array {key}; {group} has {there}")
        with self.damage_named(key):
            about = parse_json(text.decode())
            sides = {name: tuple(map(int, about[name])) for name in ("shape", "chunks")}
            array = ZarrArray(store=self, key=key, about=about, dtype=np.dtype(about["dtype"]), **sides)
        fits = len(shape) == len(array.shape) == len(array.chunks) and min(array.chunks) > 0
        fits = fits and all(want in (None, have) for want, have in zip(shape, array.shape, strict=True))
        if not fits or array.dtype.kind not in kinds or about.get("filters"):
            wanted = " x ".join("n" if side is None else str(side) for side in shape)
            raise RecordingError(
                f"{self.name}: {key} is {array.dtype} of shape {array.shape}, filters {about.get('filters')}; expected "
                f"{wanted}, of type {' or '.join(kinds)}, without filters"
            )
        return array


@dataclass(frozen=True, kw_only=True, eq=False)
class ZarrArray:
    """An array in a store, `about` its `.zarray`, whose chunks are read when they are asked for."""

    store: ZarrStore
    key: str
    about: Mapping[str, Any]
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def rows(self, begin: int = 0, stop: int | None = None) -> Iterator[NDArray]:
        """Yield rows from one to before another; raises RecordingError where a chunk is missing or damaged."""
        stop, length = self.shape[0] if stop is None else stop, self.chunks[0]
        for number in range(begin // length, -(-stop // length)):
            block = self._read_block(number)
            yield from block[max(begin - number * length, 0) : stop - number * length]

    def read(self) -> NDArray:
        """Return all rows; see `rows`."""
        return np.array(list(self.rows()), dtype=self.dtype).reshape(self.shape)

    def _read_block(self, number: int) -> NDArray:
        """Return the chunks of the rows number * chunks[0] and on."""
        counts = [-(-side // part) for side, part in zip(self.shape[1:], self.chunks[1:], strict=True)]
        sides = [count * part for count, part in zip(counts, self.chunks[1:], strict=True)]
        if self.chunks[0] * math.prod(sides) * self.dtype.itemsize > raise_budget(_LARGEST_BLOCK):
            raise RecordingError(f"{self.store.name}: {self.key}: chunks of more than {_LARGEST_BLOCK >> 20} MiB")
        block = np.empty((self.chunks[0], *sides), self.dtype)
        for place in np.ndindex(*counts):
            parts = (slice(n * part, (n + 1) * part) for n, part in zip(place, self.chunks[1:], strict=True))
            block[(slice(None), *parts)] = self._read_chunk((number, *place))
        return block[(slice(None), *map(slice, self.shape[1:]))]

    def _read_chunk(self, place: tuple[int, ...]) -> NDArray:
        """Return a chunk; one that is missing stands for a fill value in Zarr, and here for a copy that failed."""
        key = f"{self.key}/{self.about.get('dimension_separator', '.').join(map(str, place))}"
        data = self.store.find(key)
        if data is None:
            raise RecordingError(f"{self.store.name}: {key} is missing; expected every chunk of the array")
        with self.store.damage_named(key), limit_growth(raise_budget(MEMORY)):
            content = np.frombuffer(np.ascontiguousarray(self._decode(data)).tobytes(), self.dtype)
            return content.reshape(self.chunks, order=self.about["order"])

    def _decode(self, data: bytes) -> Any:
        """Return the bytes or the numbers of a chunk."""
        compressor = self.about["compressor"]
        if compressor is None:
            return np.frombuffer(data, np.uint8)
        kind = compressor.get("id")
        if kind == JPEG_XL:
            return import_library("imagecodecs", f"{self.key}, compressed as JPEG XL,").jpegxl_decode(data)
        if kind not in _CODECS:
            raise ValueError(f"compressor {kind}; expected {', '.join((*_CODECS, JPEG_XL))}")
        codecs = import_library("numcodecs", f"{self.key}, compressed by {kind},", "'finforce[zarr]'")
        return np.frombuffer(codecs.get_codec(compressor).decode(data), np.uint8)
