"""Recordings that were cut off, as when a robot's computer lost power: read up to the damage."""

from __future__ import annotations

import io
import shutil
import sqlite3
import struct
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, NamedTuple

from finforce.errors import MissingDependencyError
from finforce.optional import import_library
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.bags import NO_DIGEST, open_bag

# No record of an mcap file is longer [bytes]: chunks have megabytes, an uncompressed 4K image 25.
_LONGEST = 1 << 30
# Of a chunk: opcode, length, first and last time, uncompressed size, checksum, length of the compression's name.
_CHUNK, _CHUNK_OPCODE = struct.Struct("<BQQQQII"), 0x06
_PIECE = 1 << 12
# Of an SQLite file: size of a page, and their number. Messages that may share a page; zeros that end a torn one.
_SQLITE_HEAD, _NEIGHBOURS, _ENDING = struct.Struct(">16xH10xI"), 8, 256
_LARGEST_BASE = 1 << 42


class _Message(NamedTuple):
    """One message that is whole, and what is known of its topic."""

    topic: str
    msgtype: str
    definition: str
    time: int
    data: bytes


@contextmanager
def sound_source(source: Path) -> Iterator[tuple[Path, list[str]]]:
    """Yield a bag that can be read to its end, and what was lost: the bag itself, or a copy of its good part.

    Args:
        source: as `bag_source` returned it.

    Raises:
        RecordingError: nothing of it can be read.
        MissingDependencyError: the library that reads what was cut off is not installed.
    """
    name = source.stem
    try:
        with open_bag(source, name) as bag:
            for _ in bag.messages():
                pass
    except RecordingError as error:
        reason = str(error)
    else:
        yield source, []
        return
    with TemporaryDirectory(prefix="finforce_") as folder:
        target = Path(folder) / name
        count, seconds = _copy_good_part(source, target, reason)
        yield target, [f"{reason}; read up to the damage: {count} messages of {seconds:.1f} s"]


def _copy_good_part(source: Path, target: Path, reason: str) -> tuple[int, float]:
    """Write the messages before the damage as a new bag; return their number, and the time that they span [s]."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    files = _bag_files(source)
    is_sqlite = bool(files) and files[0].suffix == ".db3"
    connections: dict[tuple[str, str], Any] = {}
    times: list[int] = []
    with Writer(target, version=9, storage_plugin=StoragePlugin.SQLITE3 if is_sqlite else StoragePlugin.MCAP) as writer:
        for path in files:
            for message in _read_sqlite(path) if is_sqlite else _read_mcap(path):
                key = (message.topic, message.msgtype)
                if key not in connections:
                    connections[key] = writer.add_connection(
                        message.topic, message.msgtype, msgdef=message.definition, rihs01=NO_DIGEST
                    )
                writer.write(connections[key], message.time, message.data)
                times.append(message.time)
    if not times:
        raise RecordingError(f"{reason}; not one message is whole")
    if source.is_dir():
        for path in source.iterdir():
            if path.is_file() and path not in files and path.name != "metadata.yaml":
                shutil.copy2(path, target / path.name)
    return len(times), 1e-9 * (max(times) - min(times))


def _bag_files(source: Path) -> list[Path]:
    """Return the files of a bag in their order."""
    if source.is_file():
        return [source]
    found = [path for path in source.iterdir() if path.suffix in (".mcap", ".db3")]
    return sorted(found, key=lambda path: (len(path.name), path.name))


def _read_mcap(path: Path) -> Iterator[_Message]:
    """Yield the messages of an mcap file that are whole."""
    try:
        from mcap.records import Channel, Message, Schema
    except ImportError as error:
        raise MissingDependencyError("reading a recording that was cut off needs mcap: pip install mcap") from error
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    with path.open("rb") as file:
        for record in _read_records(file):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                schema = schemas.get(channel.schema_id)
                if schema is not None:
                    text = schema.data.decode(errors="replace")
                    yield _Message(channel.topic, schema.name, text, record.log_time, record.data)


def _read_records(file: BinaryIO, *, skip_magic: bool = False) -> Iterator[Any]:
    """Yield the records of a file that are whole, those of a chunk that was cut off, too."""
    from mcap.stream_reader import StreamReader

    records = iter(StreamReader(file, skip_magic=skip_magic, record_size_limit=_LONGEST).records)
    begin = 0
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except Exception:  # each decompressor has its own classes for damage
            break
        # records of one chunk come one after the other while the file stands behind it
        begin = file.tell()
        yield record
    if not skip_magic:
        file.seek(begin)
        yield from _read_records(io.BytesIO(_read_torn_chunk(file)), skip_magic=True)


def _read_torn_chunk(file: BinaryIO) -> bytes:
    """Return what is left of the records of the chunk at which a file is; nothing of another record."""
    head = file.read(_CHUNK.size)
    if len(head) < _CHUNK.size:
        return b""
    opcode, _, _, _, _, _, length = _CHUNK.unpack(head)
    if opcode != _CHUNK_OPCODE or length > len("none"):
        return b""
    compression = file.read(length).decode(errors="replace")
    file.read(8)
    torn = file.read(_LONGEST)
    if compression == "":
        return torn
    return _decompress(torn, compression)


def _decompress(torn: bytes, compression: str) -> bytes:
    """Return the beginning of compressed bytes of which the end is missing."""
    if compression == "lz4":
        decompressor = import_library("lz4.frame", "reading a recording", "lz4").LZ4FrameDecompressor()
    elif compression == "zstd":
        decompressor = import_library("zstandard", "reading a recording").ZstdDecompressor().decompressobj()
    else:
        return b""
    found = []
    for begin in range(0, len(torn), _PIECE):
        try:
            found.append(decompressor.decompress(torn[begin : begin + _PIECE]))
        except Exception:  # what follows is damaged; each decompressor has its own classes
            break
    return b"".join(found)


def _read_sqlite(path: Path) -> Iterator[_Message]:
    """Yield the messages of a db3 file that are whole."""
    with TemporaryDirectory(prefix="finforce_") as folder:
        copy = _pad_sqlite(path, Path(folder) / path.name)
        last: deque[_Message] = deque()
        for message in _read_rows(copy or path):
            last.append(message)
            if len(last) > _NEIGHBOURS:
                yield last.popleft()
        # the end of a message may be of what was put in place of the missing pages
        for message in last:
            if copy is not None and not any(message.data[-_ENDING:]):
                return
            yield message


def _read_rows(path: Path) -> Iterator[_Message]:
    """Yield the messages of a db3 file in the order in which they were written, up to the first damage."""
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro&immutable=1", uri=True)) as base:
        try:
            topics = {row[0]: row[1:] for row in base.execute("SELECT id, name, type FROM topics")}
            for topic, time, data in base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"):
                if topic in topics and isinstance(data, bytes):
                    name, msgtype = topics[topic]
                    yield _Message(name, msgtype, "", time, data)
        except sqlite3.DatabaseError:
            return


def _pad_sqlite(path: Path, copy: Path) -> Path | None:
    """Write a db3 file with empty pages in place of those that are missing, without which nothing can be read of it.

    Returns:
        The copy; None where no page is missing.
    """
    with path.open("rb") as file:
        head = file.read(_SQLITE_HEAD.size)
    if len(head) < _SQLITE_HEAD.size:
        return None
    page, count = _SQLITE_HEAD.unpack(head)
    page = page if page > 1 else 1 << 16
    whole, left = page * count, path.stat().st_size
    if not left < whole < _LARGEST_BASE:
        return None
    shutil.copyfile(path, copy)
    with copy.open("r+b") as file:
        file.truncate(left - left % page)  # half a page would pass for a whole one
        file.truncate(whole)
    return copy
