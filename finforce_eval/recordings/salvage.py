"""Recordings that were cut off, as when a robot's computer lost power, or damaged: read as far as they are good."""

from __future__ import annotations

import io
import shutil
import sqlite3
import struct
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

from finforce.errors import MissingDependencyError
from finforce.optional import import_library
from finforce_eval.errors import OutOfBoundsError, RecordingError
from finforce_eval.recordings.bags import NO_DIGEST
from finforce_eval.recordings.bounded import (
    STEPS,
    check_chunks,
    import_zstd,
    refuse_computed,
    step_limit,
    unpack_lz4,
    unpack_zstd,
)

# No record of an mcap file is longer [bytes]: chunks have megabytes, an uncompressed 4K image 25.
_LONGEST = 1 << 30
# Of a record: opcode, length. Of those that are read, that end the data, and of all.
_MAGIC, _HEAD = 8, struct.Struct("<BQ")
_READ_OPCODES, _END_OPCODES, _OPCODES = (0x03, 0x04, 0x05), (0x02, 0x0F), range(0x01, 0x10)
_CHUNK_HEAD = struct.Struct("<QQQII")
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


class SalvagedCopy:
    """The good part of a damaged recording as a bag of its own, which goes with this object.

    Attributes:
        path: of the bag.
        note: what was lost.
    """

    def __init__(self, source: Path, reason: str) -> None:
        """Copy what can be read.

        Args:
            source: as `bag_source` returned it.
            reason: why it is not read as it is.

        Raises:
            RecordingError: not one message of it is whole.
            MissingDependencyError: the library that reads what was cut off is not installed.
        """
        self._folder = TemporaryDirectory(prefix="finforce_")
        self.path = Path(self._folder.name) / source.stem
        loss = _Loss()
        count, seconds = _copy_good_part(source, self.path, reason, loss)
        self.note = f"{reason}; read as far as it is good: {count} messages of {seconds:.1f} s{loss.words()}"


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


def _copy_good_part(source: Path, target: Path, reason: str, loss: _Loss) -> tuple[int, float]:
    """Write the messages that are whole as a new bag; return their number, and the time that they span [s]."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    files = _bag_files(source)
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


def _read_mcap(path: Path, loss: _Loss) -> Iterator[_Message]:
    """Yield the messages of an mcap file that are whole."""
    try:
        from mcap.records import Channel, Message, Schema
    except ImportError as error:
        raise MissingDependencyError("reading a recording that was cut off needs mcap: pip install mcap") from error
    with path.open("rb") as file:
        summary = _read_summary(file, path.stat().st_size)
        schemas: dict[int, Any] = dict(summary.schemas) if summary else {}
        channels: dict[int, Any] = dict(summary.channels) if summary else {}
        known = sorted(each.chunk_start_offset for each in summary.chunk_indexes) if summary else []
        for record in _walk_records(file, path.stat().st_size, known, loss):
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


def _walk_records(file: BinaryIO, size: int, known: Sequence[int], loss: _Loss) -> Iterator[Any]:
    """Yield the records of a file that are whole; after what is not, go on with the next of the known chunks."""
    place, unpacked = _MAGIC, 0
    while place + _HEAD.size <= size:
        file.seek(place)
        head = file.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head)
        end = place + _HEAD.size + length
        after = next((other for other in known if other > place), size)
        is_torn = end > size or (opcode == _CHUNK_OPCODE and end > after)
        if is_torn or opcode not in _OPCODES:
            if opcode == _CHUNK_OPCODE and after == size:  # the last one: its beginning may be good
                file.seek(place)
                yield from _parse_records(_read_torn_chunk(file))
            loss.add(after - place)
            place = after
            continue
        if opcode == _CHUNK_OPCODE:
            content = _unpack_chunk(file.read(length))
            unpacked += len(content or b"")
            check_chunks([unpacked], size)
            if content is None:
                loss.add(length)
            else:
                yield from _parse_records(content, loss)
        elif opcode in _READ_OPCODES:
            yield from _parse_records(head + file.read(length), loss)
        elif opcode in _END_OPCODES:
            return
        place = end


def _read_summary(file: BinaryIO, size: int) -> Any:
    """Return what the end of a file [bytes] says of its topics, and where chunks begin; None where it is gone."""
    from mcap.reader import SeekingReader

    try:
        return SeekingReader(file, record_size_limit=min(size, _LONGEST)).get_summary()
    except Exception:  # it, too, may be damaged in any way
        return None


def _unpack_chunk(content: bytes) -> bytes | None:
    """Return the records of a chunk; None where they are not what was written."""
    if len(content) < _CHUNK_HEAD.size:
        return None
    _, _, size, checksum, length = _CHUNK_HEAD.unpack_from(content)
    begin = _CHUNK_HEAD.size + length + 8
    compression, data = content[_CHUNK_HEAD.size : begin - 8], content[begin:]
    check_chunks([size], len(content))
    unpackers = {b"": lambda plain, _: plain, b"lz4": unpack_lz4, b"zstd": unpack_zstd}
    if compression not in unpackers:
        return None
    try:
        found = unpackers[compression](data, size)
    except OutOfBoundsError:
        raise
    except Exception:  # each decompressor has its own classes
        return None
    return found if len(found) == size and (not checksum or crc32(found) == checksum) else None


def _parse_records(content: bytes, loss: _Loss | None = None) -> Iterator[Any]:
    """Yield the records in some bytes up to the first that is not whole."""
    from mcap.stream_reader import StreamReader

    stream = io.BytesIO(content)
    records = iter(StreamReader(stream, skip_magic=True, record_size_limit=len(content)).records)
    while True:
        begin = stream.tell()
        try:
            record = next(records)
        except StopIteration:
            return
        except Exception:  # of a record's fields, anything
            if loss is not None and begin < len(content):
                loss.add(len(content) - begin)
            return
        yield record


def _read_torn_chunk(file: BinaryIO) -> bytes:
    """Return what is left of the records of the chunk at which a file is."""
    head = file.read(_CHUNK.size)
    if len(head) < _CHUNK.size:
        return b""
    _, _, _, _, size, _, length = _CHUNK.unpack(head)
    if length > len("none"):
        return b""
    compression = file.read(length).decode(errors="replace")
    file.read(8)
    check_chunks([size], 0)
    torn = file.read(min(size, _LONGEST))
    return torn if compression == "" else _decompress(torn, compression, size)


def _decompress(torn: bytes, compression: str, size: int) -> bytes:
    """Return the beginning of compressed bytes of which the end is missing; of the whole, at most `size` [bytes]."""
    if compression == "lz4":
        decompressor = import_library("lz4.frame", "reading a recording", "lz4").LZ4FrameDecompressor()
    elif compression == "zstd":
        decompressor = import_zstd().ZstdDecompressor()
    else:
        return b""
    found, left = [], size
    for begin in range(0, len(torn), _PIECE):
        try:
            found.append(decompressor.decompress(torn[begin : begin + _PIECE], max_length=left))
        except Exception:  # what follows is damaged; each decompressor has its own classes
            break
        left -= len(found[-1])
        if left <= 0 or decompressor.eof:
            break
    return b"".join(found)


def _read_sqlite(path: Path, loss: _Loss) -> Iterator[_Message]:
    """Yield the messages of a db3 file that are whole."""
    with TemporaryDirectory(prefix="finforce_") as folder:
        copy = _pad_sqlite(path, Path(folder) / path.name)
        last: deque[_Message] = deque()
        for message in _read_rows(copy or path, loss):
            last.append(message)
            if len(last) > _NEIGHBOURS:
                yield last.popleft()
        # the end of a message may be of what was put in place of the missing pages
        for message in last:
            if copy is not None and not any(message.data[-_ENDING:]):
                return
            yield message


def _read_rows(path: Path, loss: _Loss) -> Iterator[_Message]:
    """Yield the messages of a db3 file in the order in which they were written, without those on damaged pages."""
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro&immutable=1", uri=True)) as base:
        try:
            refuse_computed(path)
            topics = {row[0]: row[1:] for row in base.execute("SELECT id, name, type FROM topics")}
        except (sqlite3.DatabaseError, ValueError):
            return
        base.set_progress_handler(step_limit(path), STEPS)
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


_ROWS = "SELECT rowid, topic_id, timestamp, data FROM messages WHERE rowid >= ? ORDER BY rowid"
_MOST_ROWS = 1 << 24


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
