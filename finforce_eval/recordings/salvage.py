"""Recordings that were cut off, as when a robot's computer lost power: read up to the damage."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from finforce.errors import MissingDependencyError
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.bags import open_bag

# No record of an mcap file is longer [bytes]: chunks have megabytes, an uncompressed 4K image 25.
_LONGEST = 1 << 30
_NO_DIGEST = "RIHS01_" + 64 * "0"


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
                        message.topic, message.msgtype, msgdef=message.definition, rihs01=_NO_DIGEST
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
        from mcap.stream_reader import StreamReader
    except ImportError as error:
        raise MissingDependencyError("reading a recording that was cut off needs mcap: pip install mcap") from error
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    with path.open("rb") as file:
        records = iter(StreamReader(file, record_size_limit=_LONGEST).records)
        while True:
            try:
                record = next(records)
            except Exception:  # the end, whole or not; each decompressor has its own classes for damage
                return
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


def _read_sqlite(path: Path) -> Iterator[_Message]:
    """Yield the messages of a db3 file that are whole."""
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro&immutable=1", uri=True)) as base:
        try:
            topics = {row[0]: row[1:] for row in base.execute("SELECT id, name, type FROM topics")}
            for topic, time, data in base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"):
                if topic in topics and isinstance(data, bytes):
                    name, msgtype = topics[topic]
                    yield _Message(name, msgtype, "", time, data)
        except sqlite3.DatabaseError:
            return
