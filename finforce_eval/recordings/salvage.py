"""Recordings that were cut off, as when a robot's computer lost power, or damaged: read as far as they are good."""

from __future__ import annotations

import io
import shutil
import sqlite3
import struct
from collections import deque
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

from finforce.sandbox import SandboxError, run_limited
from finforce_eval.errors import OutOfBoundsError, RecordingError
from finforce_eval.recordings.bags import NO_DIGEST, STEP_MEMORY, allowed_bytes, allowed_seconds, bag_files

_MAGIC = 8  # bytes before the first record of an mcap file
# Of a chunk: opcode, length, first and last time, uncompressed size, checksum, length of the compression's name.
_CHUNK, _CHUNK_OPCODE, _PIECE = struct.Struct("<BQQQQII"), 0x06, 1 << 12
# Of an SQLite file: size of a page, and their number. Messages that may share a page; zeros that end a torn one.
_SQLITE_HEAD, _NEIGHBOURS, _ENDING = struct.Struct(">16xH10xI"), 8, 256
_LARGEST_BASE = 1 << 42
_ROWS = "SELECT rowid, topic_id, timestamp, data FROM messages WHERE rowid >= ? ORDER BY rowid"
_MOST_ROWS = 1 << 24


class _Message(NamedTuple):
    """One message that is whole, and what is known of its topic."""

    topic: str
    msgtype: str
    definition: str
    time: int
    data: bytes


class SalvagedCopy:
    """The good part of a damaged recording as a bag of its own, which goes with this object.

    Attributes:
        path: of the bag.
        note: what was lost.
    """

    def __init__(self, source: Path, reason: str) -> None:
        """Copy what can be read, in a process of its own.

        Args:
            source: as `bag_source` returned it.
            reason: why it is not read as it is.

        Raises:
            RecordingError: Not one message of it is whole.
            OutOfBoundsError: It takes more memory, time or disk than one of its size does.
        """
        self._folder = TemporaryDirectory(prefix="finforce_")
        self.path = Path(self._folder.name) / source.stem
        limits = {"seconds": allowed_seconds(source), "disk": allowed_bytes(source)}
        try:
            found = run_limited(copy_good_part, source, self.path, memory=2 * STEP_MEMORY, **limits)
        except SandboxError as error:
            raise OutOfBoundsError(f"{reason}; what is left of it {error}") from error
        if not found:
            raise RecordingError(f"{reason}; not one message is whole")
        self.note = f"{reason}; read as far as it is good: {found}"


@dataclass
class _Loss:
    """What could not be read.

    Attributes:
        count: parts of files.
        size: of them [bytes].
    """

    count: int = 0
    size: int = 0

    def add(self, size: int) -> None:
        """Count a part."""
        self.count += 1
        self.size += size

    def words(self) -> str:
        """Return what to say of it, "" of nothing."""
        if not self.count:
            return ""
        parts = "one part" if self.count == 1 else f"{self.count} parts"
        size = f" of {self.size / 1e3:.1f} kB" if self.size else ""
        return f", {parts}{size} lost"


def copy_good_part(source: Path, target: Path) -> str:
    """Write the messages that are whole as a new bag; return how many there are and what was lost, "" without any."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    files, loss = bag_files(source), _Loss()
    is_sqlite = bool(files) and files[0].suffix == ".db3"
    connections: dict[tuple[str, str], Any] = {}
    times: list[int] = []
    with Writer(target, version=9, storage_plugin=StoragePlugin.SQLITE3 if is_sqlite else StoragePlugin.MCAP) as writer:
        for path in files:
            for message in _read_sqlite(path, loss) if is_sqlite else _read_mcap(path, loss):
                key = (message.topic, message.msgtype)
                if key not in connections:
                    connections[key] = writer.add_connection(
                        message.topic, message.msgtype, msgdef=message.definition, rihs01=NO_DIGEST
                    )
                writer.write(connections[key], message.time, message.data)
                times.append(message.time)
    if not times:
        return ""
    if source.is_dir():
        for path in source.iterdir():
            if path.is_file() and path not in files and path.name != "metadata.yaml":
                shutil.copy2(path, target / path.name)
    return f"{len(times)} messages of {1e-9 * (max(times) - min(times)):.1f} s{loss.words()}"


def _read_mcap(path: Path, loss: _Loss) -> Iterator[_Message]:
    """Yield the messages of an mcap file that are whole."""
    from mcap.reader import SeekingReader
    from mcap.records import Channel, Message, Schema

    size, summary = path.stat().st_size, None
    with path.open("rb") as file:
        with suppress(Exception):  # the end of the file may be gone, or damaged in any way
            summary = SeekingReader(file, record_size_limit=size).get_summary()
        schemas: dict[int, Any] = dict(summary.schemas) if summary else {}
        channels: dict[int, Any] = dict(summary.channels) if summary else {}
        known = {each.chunk_start_offset for each in summary.chunk_indexes} if summary else set()
        for begin, end in pairwise(sorted({_MAGIC, size} | {start for start in known if start < size})):
            for record in _read_stretch(file, begin, end, loss, is_last=end == size):
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


def _read_stretch(file: BinaryIO, begin: int, end: int, loss: _Loss, *, is_last: bool) -> Iterator[Any]:
    """Yield the records between two positions of a file that are whole, up to the first that is not."""
    from mcap.records import Chunk, Footer
    from mcap.stream_reader import StreamReader

    file.seek(begin)
    records = StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=end - begin).records
    while (start := file.tell()) < end:
        record = None
        with suppress(Exception):  # of a record's fields, anything
            record = next(records, None) if file.peek(1)[:1] != b"\0" else None  # zeros follow where power was lost
        if record is None or file.tell() > end:
            file.seek(start)
            if file.read(1)[:1] == bytes([_CHUNK_OPCODE]) and is_last:  # its beginning may be good
                file.seek(start)
                yield from _parse_records(_unpack_torn(file.read(end - start)))
            loss.add(end - start)
            return
        if isinstance(record, Footer):
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        content = _unpack(record.compression, record.data)
        checksum = record.uncompressed_crc
        if len(content) != record.uncompressed_size or (checksum and crc32(content) != checksum):
            loss.add(len(record.data))
        else:
            yield from _parse_records(content, loss)


def _unpack(compression: str, data: bytes) -> bytes:
    """Return what a chunk unpacks to, as far as it does."""
    import lz4.frame
    from rosbags.rosbag2.storage_mcap import zstd

    if compression not in ("lz4", "zstd"):
        return data if compression == "" else b""
    found, file = [], (lz4.frame if compression == "lz4" else zstd).open(io.BytesIO(data))
    with file, suppress(EOFError, OSError, RuntimeError, zstd.ZstdError):
        while piece := file.read(_PIECE):
            found.append(piece)
    return b"".join(found)


def _unpack_torn(content: bytes) -> bytes:
    """Return what is left of the records of a chunk of which the end is missing."""
    if len(content) < _CHUNK.size:
        return b""
    length = _CHUNK.unpack_from(content)[-1]
    name, data = content[_CHUNK.size : _CHUNK.size + length], content[_CHUNK.size + length + 8 :]
    return _unpack(name.decode(errors="replace"), data)


def _parse_records(content: bytes, loss: _Loss | None = None) -> Iterator[Any]:
    """Yield the records in some bytes up to the first that is not whole."""
    from mcap.stream_reader import StreamReader

    stream = io.BytesIO(content)
    records = StreamReader(stream, skip_magic=True, record_size_limit=len(content)).records
    while (begin := stream.tell()) < len(content):
        try:
            record = next(records)
        except Exception:  # of a record's fields, anything
            if loss is not None:
                loss.add(len(content) - begin)
            return
        yield record


def _read_sqlite(path: Path, loss: _Loss) -> Iterator[_Message]:
    """Yield the messages of a db3 file that are whole."""
    with TemporaryDirectory(prefix="finforce_") as folder:
        copy = _pad_sqlite(path, Path(folder) / path.name)
        last: deque[_Message] = deque()
        for message in _read_rows(copy or path, loss):
            last.append(message)
            if len(last) > _NEIGHBOURS:
                yield last.popleft()
        # the end of a message may be of what was put instead of the missing pages
        for message in last:
            if copy is not None and not any(message.data[-_ENDING:]):
                return
            yield message


def _read_rows(path: Path, loss: _Loss) -> Iterator[_Message]:
    """Yield the messages of a db3 file in the order in which they were written, without those on damaged pages."""
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro&immutable=1", uri=True)) as base:
        try:
            topics = {row[0]: row[1:] for row in base.execute("SELECT id, name, type FROM topics")}
        except sqlite3.DatabaseError:
            return
        begin, step = -(1 << 62), 1
        while step < _MOST_ROWS:
            try:
                for number, topic, time, data in base.execute(_ROWS, (begin,)):
                    if number < begin:  # pages lead back to one another
                        raise sqlite3.DatabaseError
                    begin, step = number + 1, 1
                    if topic in topics and isinstance(data, bytes) and isinstance(time, int):
                        name, msgtype = topics[topic]
                        yield _Message(name, msgtype, "", time, data)
                return
            except sqlite3.DatabaseError:
                # rows on a page that cannot be read are passed over, ever more of them
                begin = max(begin, 0) + step
                if step == 1:
                    loss.add(0)
                step *= 2


def _pad_sqlite(path: Path, copy: Path) -> Path | None:
    """Write a db3 file with empty pages instead of those that are missing, without which nothing can be read of it.

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
