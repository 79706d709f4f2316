"""rosbags' reader within bounds: a small file unpacks to little, and a length that is not there is not allocated.

What a chunk unpacks to, what all of them do, and how many messages there may be goes with the size of the files;
FINFORCE_BUDGET, a factor, raises it.
"""

from __future__ import annotations

import io
import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

from finforce.errors import MissingDependencyError
from finforce.files import FileError, parse_yaml, raise_budget, read_text
from finforce.optional import import_library
from finforce_eval.errors import OutOfBoundsError

MEGABYTE = 1 << 20
# Bytes: of one chunk, of all together, and of what they may have for each byte of the files.
LARGEST_CHUNK, LARGEST_ALL, PER_BYTE = 96 * MEGABYTE, 192 * MEGABYTE, 100
# Messages of our topics, and bytes of a file that let there be one more.
MOST_MESSAGES, BYTES_PER_MESSAGE = 250_000, 16
LARGEST_METADATA = 4 * MEGABYTE
_HINT = "FINFORCE_BUDGET=10 would allow ten times as much"
_SMALL = 1 << 16  # bytes that are read without looking how many there are


def most_messages(source: Path) -> int:
    """Return how many messages of our topics a recording may hold [-]."""
    return raise_budget(MOST_MESSAGES + _size_of(source) // BYTES_PER_MESSAGE)


def check_messages(count: int, source: Path) -> None:
    """Refuse a recording with more messages of our topics than its size can hold.

    Raises:
        OutOfBoundsError: there are more.
    """
    most = most_messages(source)
    if count > most:
        raise OutOfBoundsError(f"more than {most} messages, in files that hold fewer; {_HINT}")


def _size_of(source: Path) -> int:
    """Return the size of a bag [bytes]."""
    files = [source] if source.is_file() else [path for path in source.iterdir() if path.is_file()]
    return sum(path.stat().st_size for path in files)


def _allowed(size: int) -> int:
    """Return what files of some size [bytes] may unpack to [bytes]."""
    return raise_budget(LARGEST_ALL + PER_BYTE * size)


def make_reader(source: Path) -> Any:
    """Return a reader of rosbags that keeps within bounds.

    Args:
        source: what `bag_source` returned.

    Raises:
        ValueError: the bag's description is none.
        MissingDependencyError: rosbags is not installed, or a release of which this is not known.
    """
    if source.is_dir():
        try:
            _check_yaml(read_text(source / "metadata.yaml", LARGEST_METADATA))
        except FileError as error:
            raise ValueError(f"metadata.yaml: {error}") from error
    return _bound_reader()(source)


_readers: list[type] = []


def _bound_reader() -> type:
    """Return rosbags' reader with bounds; made once."""
    if _readers:
        return _readers[0]
    try:
        from rosbags.rosbag2 import reader, storage_mcap, storage_sqlite3
    except ImportError as error:
        raise MissingDependencyError("reading a recording needs rosbags: pip install rosbags") from error
    try:
        known: Any = (storage_mcap.DECOMPRESSORS, storage_mcap.read_exact, reader.zstd.open, reader.DirectoryReader)
        known += tuple(module.parse_qos for module in (reader, storage_mcap, storage_sqlite3))
    except AttributeError as error:
        raise MissingDependencyError(f"reading a recording needs rosbags 0.11: {error}") from error
    storage_mcap.DECOMPRESSORS = {"": _take_plain, "lz4": unpack_lz4, "zstd": unpack_zstd}
    storage_mcap.read_exact = _read_exact
    reader.zstd = SimpleNamespace(
        open=_OpenZstd, decompress=lambda data: unpack_zstd(data, raise_budget(LARGEST_CHUNK))
    )
    for module in (reader, storage_mcap, storage_sqlite3):
        module.parse_qos = _bound_qos(module.parse_qos)

    class BoundedMcap(storage_mcap.McapReader):
        """An mcap file whose chunks are looked at before one is unpacked."""

        def read_index(self) -> None:
            """Read the index, and refuse chunks that no such file has."""
            super().read_index()
            size = os.fstat(self.bio.fileno()).st_size
            ends = [(each.chunk_start_offset, each.compressed_size) for each in self.chunks]
            if any(begin + length > size for begin, length in ends):
                raise ValueError("the index names a chunk that reaches beyond the file")
            check_chunks([each.uncompressed_size for each in self.chunks], size)

        def meta_scan(self) -> None:
            """Go through a file without an index, once its chunks were looked at."""
            size = os.fstat(self.bio.fileno()).st_size
            check_chunks(_list_chunks(self.bio, self.data_start, self.data_end), size)
            super().meta_scan()

    class BoundedSqlite(storage_sqlite3.Sqlite3Reader):
        """A db3 file in which tables are tables."""

        def open(self) -> None:
            """Open it, unless something in place of a table would be computed."""
            path = Path(self.path)
            refuse_computed(path)
            hooks, limit = storage_sqlite3.apsw.connection_hooks, step_limit(path)
            hooks.append(lambda base: base.set_progress_handler(limit, STEPS))
            try:
                super().open()
            finally:
                hooks.pop()

    plugins = {"mcap": BoundedMcap, "sqlite3": BoundedSqlite}

    class BoundedFolder(reader.DirectoryReader):
        """A folder of such files."""

        STORAGE_PLUGINS = plugins

    class BoundedReader(reader.Reader):
        """A folder, or one such file."""

        STORAGE_PLUGINS = {"dir": BoundedFolder, ".mcap": BoundedMcap, ".db3": BoundedSqlite}

    _readers.append(BoundedReader)
    return BoundedReader


def check_chunks(sizes: list[int], size: int) -> None:
    """Refuse chunks that unpack to more than a file of some size [bytes] may hold."""
    largest, total = max(sizes, default=0), sum(sizes)
    if largest > raise_budget(LARGEST_CHUNK):
        limit = raise_budget(LARGEST_CHUNK) // MEGABYTE
        raise OutOfBoundsError(f"a chunk of {largest // MEGABYTE} MB unpacked; expected {limit} at most; {_HINT}")
    if total > _allowed(size):
        limit = _allowed(size) // MEGABYTE
        raise OutOfBoundsError(f"chunks of {total // MEGABYTE} MB unpacked; expected {limit} of such a file; {_HINT}")


def _list_chunks(file: BinaryIO, begin: int, end: int) -> list[int]:
    """Return what the chunks between two places of a file say that they unpack to [bytes]."""
    sizes, place = [], begin
    while place + 9 <= end:
        file.seek(place)
        head = file.read(9 + 24)
        length = int.from_bytes(head[1:9], "little")
        if length > end - place - 9:
            raise ValueError(f"a record of {length} bytes at {place}, of which the file has {end - place - 9}")
        if head[0] == _CHUNK:
            sizes.append(int.from_bytes(head[25:33], "little"))
        place += 9 + length
    return sizes


_CHUNK = 0x06


def _read_exact(file: BinaryIO, size: int) -> bytes:
    """Return some bytes of a file; as rosbags' own, but nothing is allocated for bytes that are not there."""
    if size > _SMALL:
        place = file.tell()
        left = (len(file.getbuffer()) if isinstance(file, io.BytesIO) else os.fstat(file.fileno()).st_size) - place
        if size > left:
            raise ValueError(f"a record of {size} bytes at {place}, of which there are {left}")
    data = file.read(size)
    if len(data) != size:
        raise ValueError(f"a record of {size} bytes, of which there are {len(data)}")
    return data


def _take_plain(data: bytes, size: int) -> bytes:
    return data


def unpack_lz4(data: bytes, size: int) -> bytes:
    """Return what a chunk unpacks to: as many bytes as it says, or an error after one more."""
    lz4 = import_library("lz4.frame", "reading a recording", "lz4")
    check_chunks([size], len(data))
    found = lz4.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    if len(found) > size:
        raise OutOfBoundsError(f"compressed data unpack to more than {size} bytes; {_HINT}")
    return found


def unpack_zstd(data: bytes, size: int) -> bytes:
    """Return what a chunk unpacks to: as many bytes as it says, or an error after one more."""
    zstd = import_zstd()
    found, left = [], size + 1
    while data and left > 0:  # a chunk may be of several frames
        unpacker = zstd.ZstdDecompressor()
        found.append(unpacker.decompress(data, max_length=left))
        left -= len(found[-1])
        if left > 0 and not unpacker.eof:
            raise ValueError("compressed data end before they should")
        data = unpacker.unused_data
    if left <= 0:
        raise OutOfBoundsError(f"compressed data unpack to more than {size} bytes; {_HINT}")
    return found[0] if len(found) == 1 else b"".join(found)


def import_zstd() -> Any:
    """Return the module that rosbags has for zstd."""
    from rosbags.rosbag2 import storage_mcap

    return storage_mcap.zstd


class _OpenZstd:
    """A compressed file that is read up to what it may unpack to.

    Args:
        file: compressed.
        mode: of rosbags; always for reading.
    """

    def __init__(self, file: BinaryIO, mode: str) -> None:
        self._file = import_zstd().open(file, mode)
        self._left = _allowed(os.fstat(file.fileno()).st_size)

    def __enter__(self) -> _OpenZstd:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes."""
        data = self._file.read(min(size, _SMALL) if size >= 0 else _SMALL)
        self._left -= len(data)
        if self._left < 0:
            raise OutOfBoundsError(f"the compressed file unpacks to more than such a file may; {_HINT}")
        return data


def _check_yaml(text: str) -> None:
    """Refuse a YAML text that would take more than its length; only one with references or much nesting could.

    Raises:
        FileError: it would.
    """
    if "&" in text or "*" in text or text.count("[") + text.count("{") > _FEW_BRACKETS:
        parse_yaml(text, text_keys=False)


_FEW_BRACKETS = 1000


def _bound_qos(parse: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return rosbags' parser of QoS for texts that are no YAML bombs."""

    def parse_bounded(value: Any) -> Any:
        if isinstance(value, str):
            _check_yaml(value)
        return parse(value)

    return parse_bounded


STEPS = 100_000  # of SQLite's machine, between two looks at how many there were
_MOST_STEPS, _STEPS_PER_BYTE = 50_000_000, 4


def step_limit(path: Path) -> Callable[[], bool]:
    """Return what says, asked every `STEPS` steps, that a db3 file takes more of them than one of its size does.

    Pages that are damaged may lead back to one another, and be read for ever.
    """
    left = [raise_budget(_MOST_STEPS + _STEPS_PER_BYTE * path.stat().st_size) // STEPS]

    def is_spent() -> bool:
        left[0] -= 1
        return left[0] < 0

    return is_spent


def refuse_computed(path: Path) -> None:
    """Refuse a db3 file with a view, a trigger or a computed column, which may go on for ever."""
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
        for kind, name, text in base.execute("SELECT type, name, coalesce(sql, '') FROM sqlite_master"):
            words = " ".join(str(text).upper().split())
            computed = kind in ("view", "trigger") or "VIRTUAL" in words or " AS (" in words or " AS(" in words
            if computed:
                raise ValueError(f"the {kind} {name!r}, which is computed; expected tables")
