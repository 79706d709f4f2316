"""Recordings that were cut off, as when a robot's computer lost power, or damaged: read as far as they are good."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from finforce.sandbox import SandboxError, run_limited
from finforce_eval.errors import OutOfBoundsError, RecordingError
from finforce_eval.recordings.bags import NO_DIGEST, STEP_MEMORY, allowed_bytes, allowed_seconds, bag_files


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
        note: number and duration of its messages.
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
            raise RecordingError(f"{reason}; not one message is whole and in CDR, as ROS 2 has them")
        self.note = f"{reason}; read as far as it is good: {found}"


def copy_good_part(source: Path, target: Path) -> str:
    """Write the messages that are whole as a new bag; return how many they are, "" without any."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    files = bag_files(source)
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
        return ""
    if source.is_dir():
        for path in source.iterdir():
            if path.is_file() and path not in files and path.name != "metadata.yaml":
                shutil.copy2(path, target / path.name)
    return f"{len(times)} messages of {1e-9 * (max(times) - min(times)):.1f} s"


def _read_mcap(path: Path) -> Iterator[_Message]:
    """Yield the messages of an mcap file; a damaged chunk costs itself, a wrong length all that follows."""
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import StreamReader, breakup_chunk

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    with path.open("rb") as file, suppress(Exception):  # of a record's fields, anything
        for record in StreamReader(file, emit_chunks=True, record_size_limit=path.stat().st_size).records:
            parts = [record]
            if isinstance(record, Chunk):
                parts = []
                with suppress(Exception):  # of decompressors, anything
                    parts = breakup_chunk(record, validate_crc=True)
            for part in parts:
                if isinstance(part, Schema):
                    schemas[part.id] = part
                elif isinstance(part, Channel):
                    channels[part.id] = part
                elif isinstance(part, Message) and part.channel_id in channels:
                    channel = channels[part.channel_id]
                    schema = schemas[channel.schema_id]
                    text = schema.data.decode(errors="replace")
                    if channel.message_encoding == "cdr":
                        yield _Message(channel.topic, schema.name, text, part.log_time, part.data)


def _read_sqlite(path: Path) -> Iterator[_Message]:
    """Yield the messages of a db3 file in the order in which they were written, up to a page that is damaged."""
    with TemporaryDirectory(prefix="finforce_") as folder:
        copy = shutil.copyfile(path, Path(folder) / path.name)
        with copy.open("r+b") as file:
            page = int.from_bytes(file.read(18)[16:], "big")  # of 64 kB stands as 1
            file.truncate(path.stat().st_size // max(page, 512) * max(page, 512))  # half a page passes for a whole one
        with closing(sqlite3.connect(copy)) as base, suppress(sqlite3.DatabaseError):
            base.execute("PRAGMA writable_schema = ON")  # else a file without its last pages is not opened
            topics = {row[0]: row[1:] for row in base.execute("SELECT id, name, type FROM topics")}
            for topic, time, data in base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"):
                if topic in topics and isinstance(data, bytes) and isinstance(time, int):
                    yield _Message(*topics[topic], "", time, data)
