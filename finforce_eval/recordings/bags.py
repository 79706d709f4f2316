"""rosbag2 files (mcap, sqlite3) opened and their messages decoded."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from finforce.errors import FinforceError, MissingDependencyError, one_line
from finforce.stamps import NANOSECONDS
from finforce_eval.errors import DamagedError, OutOfBoundsError, RecordingError
from finforce_eval.recordings.bounded import make_reader

# Of a type that was recorded without its definition nothing is known but its name.
NO_DIGEST = "RIHS01_" + 64 * "0"


class BagMessage(NamedTuple):
    """A message and the time [ns] at which the bag received it."""

    time: int
    message: Any


class RawSample(NamedTuple):
    """An undecoded message: its topic, the time of receipt [ns] and its CDR bytes."""

    topic: str
    time: int
    data: bytes | memoryview


class BagReader:
    """An open bag.

    Args:
        reader: of rosbags.
        types: of rosbags; what is not in it cannot be decoded.
        name: of the recording, for messages.
    """

    def __init__(self, reader: Any, types: Any, name: str) -> None:
        self._reader, self._types, self.name = reader, types, name
        self.connections = reader.connections
        self.count = reader.message_count
        self.types = {connection.topic: connection.msgtype for connection in reader.connections}

    def raw(self, topics: Collection[str]) -> Iterator[RawSample]:
        """Yield the messages of some topics in the order of their receipt."""
        chosen = [connection for connection in self.connections if connection.topic in topics]
        for connection, time, data in self._reader.messages(connections=chosen) if chosen else ():
            yield RawSample(connection.topic, time, data)

    def messages(self) -> Iterator[tuple[Any, int, bytes | memoryview]]:
        """Yield connection (of rosbags), time of receipt [ns] and bytes of all messages, in the order of receipt."""
        yield from self._reader.messages()

    def decode(self, sample: RawSample) -> Any:
        """Return the message of a sample."""
        return self._types.deserialize_cdr(sample.data, self.types[sample.topic])

    def encode(self, msgtype: str, fields: Mapping[str, Any]) -> bytes:
        """Return the CDR bytes of a message with these fields."""
        return bytes(self._types.serialize_cdr(self._types.types[msgtype](**fields), msgtype))

    def knows(self, msgtype: str) -> bool:
        """Say whether messages of a type can be decoded."""
        return msgtype in self._types.fielddefs

    def definition(self, msgtype: str) -> tuple:
        """Return the fields of a known type as rosbags describes them."""
        return self._types.fielddefs[msgtype]

    def foreign_notes(self) -> list[str]:
        """Name the topics whose type is unknown."""
        return [
            f"{connection.topic} skipped: unknown type {connection.msgtype}"
            for connection in self.connections
            if not self.knows(connection.msgtype)
        ]


@contextmanager
def open_bag(source: Path, name: str) -> Iterator[BagReader]:
    """Open a bag for the length of a `with` block.

    Args:
        source: what `bag_source` returned.
        name: of the recording, for messages.

    Raises:
        RecordingError: damaged or empty; also when it shows later, in the block.
        MissingDependencyError: rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingDependencyError("reading a recording needs rosbags: pip install rosbags") from error
    # not AnyReader: it registers every definition in the bag and ends at a foreign one it cannot parse
    types = get_typestore(Stores.ROS2_JAZZY)
    with damage_reported(name), make_reader(source) as reader:
        if reader.message_count == 0:
            raise RecordingError(f"{name}: the recording is empty: it holds no messages")
        yield BagReader(reader, types, name)


def check_types(connections: Iterable[Any], expected: Mapping[str, Collection[str]], name: str) -> None:
    """Refuse a topic of ours with another type than one of those expected.

    Raises:
        RecordingError: there is one.
    """
    for connection in connections:
        allowed = expected.get(connection.topic)
        if allowed is not None and connection.msgtype not in allowed:
            wanted = " or ".join(allowed)
            raise RecordingError(f"{name}: {connection.topic} is {connection.msgtype}; expected {wanted}")


def bag_source(path: Path) -> Path:
    """Return what rosbags can open: a folder with metadata.yaml, or the one bag file in a folder without.

    Raises:
        RecordingError: there is no such thing.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such recording")
    path = path.resolve()
    if path.is_file() and path.suffix not in (".mcap", ".db3"):
        raise RecordingError(f"{path.name}: not a recording; expected a rosbag2 folder, .mcap or .db3")
    if path.is_file():
        return path
    _refuse_pipes(path)
    if (path / "metadata.yaml").exists():
        return path
    files = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    if len(files) != 1:
        found = f"no metadata.yaml and {len(files)} bag files" if files else "no metadata.yaml, .mcap or .db3"
        raise RecordingError(f"{path.name}: the folder is no recording: {found} in it")
    return files[0]


def list_files(path: Path) -> list[Path]:
    """Return the files of a recording; none where there is no such recording."""
    try:
        source = bag_source(path)
        return [source] if source.is_file() else [each for each in source.iterdir() if each.is_file()]
    except (RecordingError, OSError):
        return []


def name_recordings(texts: Sequence[str | Path], between: str) -> list[tuple[str, Path]]:
    """Return recordings with names of their own: of their file or folder, and as much of their paths as that takes.

    Args:
        texts: paths.
        between: stands between the parts of a name.

    Raises:
        RecordingError: one was given twice.
    """
    paths = [Path(text).resolve() for text in texts]
    if len(set(paths)) < len(paths):
        raise RecordingError("a recording was given twice")
    plain = [_bag_stem(path) for path in paths]
    most = max((len(path.parts) for path in paths), default=0)
    for depth in range(1, most + 1):
        names = [between.join(path.parts[-depth:]) for path in plain]
        if len(set(names)) == len(names):
            return list(zip(names, paths, strict=True))
    return [(between.join(path.parts[1:]), path) for path in paths]


def _bag_stem(path: Path) -> Path:
    """Return the path of a recording without the ending of its file."""
    with suppress(RecordingError):
        source = bag_source(path)
        return source.with_suffix("") if source.is_file() else source
    return path


def _refuse_pipes(folder: Path) -> None:
    """Refuse a folder with something in place of its files that a reader would wait for.

    Raises:
        RecordingError: there is such a thing.
    """
    for path in [folder / "metadata.yaml", *folder.glob("*.mcap*"), *folder.glob("*.db3*")]:
        if path.exists() and not path.is_file():
            raise RecordingError(f"{folder.name}: {path.name} is no plain file")


@contextmanager
def damage_reported(name: str) -> Iterator[None]:
    """Turn whatever a bag reader raises on damaged bytes into one DamagedError."""
    try:
        yield
    except OutOfBoundsError as error:
        raise OutOfBoundsError(f"{name}: {str(error).removeprefix(f'{name}: ')}") from error
    except (FinforceError, KeyboardInterrupt):
        raise
    except Exception as error:  # struct, sqlite3, zstd, lz4, yaml, ... each has its own classes
        reason = one_line(error)
        raise DamagedError(f"{name}: truncated or damaged: {reason}") from error


def restamp(data: bytes | memoryview, stamp: int) -> bytes:
    """Return CDR bytes that begin with a std_msgs/Header with another stamp [ns]."""
    changed = bytearray(data)
    struct.pack_into(_stamp_layout(data), changed, 4, *divmod(stamp, NANOSECONDS))
    return bytes(changed)


def _stamp_layout(data: bytes | memoryview) -> str:
    """Return int32 sec, uint32 nanosec in the byte order that the encapsulation names."""
    return "<iI" if data[1] & 1 else ">iI"
