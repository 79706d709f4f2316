"""rosbag2 files (mcap, sqlite3) opened and their messages decoded."""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from errno import EDQUOT, ENOSPC
from pathlib import Path
from typing import Any, NamedTuple

from finforce.errors import FinforceError, one_line
from finforce.files import BUDGET, FileError, check_plain, parse_yaml, raise_budget, read_text
from finforce.messages import NANOSECONDS
from finforce.sandbox import SandboxError, limit_growth, run_limited
from finforce_eval.errors import DamagedError, OutOfBoundsError, RecordingError

# Of a type that was recorded without its definition nothing is known but its name.
NO_DIGEST = "RIHS01_" + 64 * "0"
MEGABYTE = 1 << 20
# Bytes that opening a recording, and reading one more message of it, may take.
STEP_MEMORY = 512 * MEGABYTE
# Bounds of all chunks of a recording unpacked, of its messages, and of the time to read it.
LARGEST_ALL = 192 * MEGABYTE  # [bytes]
PER_BYTE = 100  # bytes more for each byte of its files
MOST_MESSAGES = 250_000  # messages of our topics
BYTES_PER_MESSAGE = 16  # bytes of a file that allow one message more
LARGEST_METADATA = 4 * MEGABYTE  # [bytes]
SECONDS = 20  # [s], of work in a process of its own
BYTES_PER_SECOND = 5 * MEGABYTE  # bytes of a file that allow one second more
_HINT = f"{BUDGET}=10 would allow ten times as much"


class RawSample(NamedTuple):
    """An undecoded message: its topic, the time of receipt [ns] and its CDR bytes."""

    topic: str
    time: int
    data: bytes | memoryview


COMPRESSED = "sensor_msgs/msg/CompressedImage"
PACKETS = {  # packets of videos, as Foxglove and ffmpeg_image_transport have them, whose types ROS does not bring
    "foxglove_msgs/msg/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
    ),
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data"
    ),
}


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
        for connection, time, data in self._walk(chosen) if chosen else ():
            yield RawSample(connection.topic, time, data)

    def messages(self) -> Iterator[tuple[Any, int, bytes | memoryview]]:
        """Yield connection (of rosbags), time of receipt [ns] and bytes of all messages, in the order of receipt."""
        yield from self._walk(self.connections)

    def _walk(self, connections: Collection[Any]) -> Iterator[tuple[Any, int, bytes | memoryview]]:
        messages, memory = self._reader.messages(connections=connections), raise_budget(STEP_MEMORY)
        while True:
            with limit_growth(memory):
                message = next(messages, None)
            if message is None:
                return
            yield message

    def decode(self, sample: RawSample) -> Any:
        """Return the message of a sample; a packet of a video as a sensor_msgs/CompressedImage."""
        kind = self.types[sample.topic]
        message, types = self._types.deserialize_cdr(sample.data, kind), self._types.types
        if kind not in PACKETS:
            return message
        header = getattr(message, "header", None) or types["std_msgs/msg/Header"](message.timestamp, message.frame_id)
        words = message.encoding if hasattr(message, "encoding") else message.format
        return types[COMPRESSED](header=header, format=words, data=message.data)

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
        source: result of `bag_source`.
        name: of the recording, for messages.

    Raises:
        RecordingError: damaged or empty; also when it shows later, in the block.
    """
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    # not AnyReader: it registers every definition in the bag and ends at a foreign one it cannot parse
    types = get_typestore(Stores.ROS2_JAZZY)
    for kind, fields in PACKETS.items():
        types.register(get_types_from_msg(fields, kind))
    with damage_reported(name), ExitStack() as stack:
        with limit_growth(raise_budget(STEP_MEMORY), allowed_bytes(source)):
            _check_bounds(source)
            reader = stack.enter_context(Reader(source))
        if reader.message_count == 0:
            raise RecordingError(f"{name}: the recording is empty: it holds no messages")
        yield BagReader(reader, types, name)


def allowed_bytes(source: Path) -> int:
    """Return what a recording may unpack to [bytes]; it goes with its size."""
    return raise_budget(LARGEST_ALL + PER_BYTE * _size_of(source))


def allowed_seconds(source: Path) -> float:
    """Return the time that going through a recording may take [s]; it goes with its size."""
    return SECONDS + _size_of(source) / BYTES_PER_SECOND


def check_messages(count: int, source: Path) -> None:
    """Refuse a recording with more messages of our topics than its size can hold.

    Raises:
        OutOfBoundsError: There are more.
    """
    most = raise_budget(MOST_MESSAGES + _size_of(source) // BYTES_PER_MESSAGE)
    if count > most:
        raise OutOfBoundsError(f"more than {most} messages, in files that hold fewer; {_HINT}")


def bag_files(source: Path) -> list[Path]:
    """Return the files with the messages of a bag, in their order."""
    if source.is_file():
        return [source]
    found = [path for path in source.iterdir() if path.suffix in (".mcap", ".db3")]
    return sorted(found, key=lambda path: (len(path.name), path.name))


def _size_of(source: Path) -> int:
    """Return the size of a bag [bytes]."""
    files = [source] if source.is_file() else [path for path in source.iterdir() if path.is_file()]
    return sum(path.stat().st_size for path in files)


def _check_bounds(source: Path) -> None:
    """Refuse a bag that announces, or takes, more than one of its size does.

    Raises:
        OutOfBoundsError: It does.
        Exception: It is damaged; each library has its own classes.
    """
    if source.is_dir():
        try:
            text = read_text(source / "metadata.yaml", LARGEST_METADATA)
            if "&" in text or "*" in text or text.count("[") + text.count("{") > _FEW_BRACKETS:
                parse_yaml(text, text_keys=False)
        except FileError as error:
            raise ValueError(f"metadata.yaml: {error}") from error
    total = 0
    for path in bag_files(source):
        if path.suffix == ".mcap":
            total += sum(_chunk_sizes(path))
        else:
            _try_database(path)
    if total > allowed_bytes(source):
        limit = allowed_bytes(source) // MEGABYTE
        raise OutOfBoundsError(f"chunks of {total // MEGABYTE} MB unpacked; expected {limit} of such a file; {_HINT}")


_FEW_BRACKETS = 1000


def _chunk_sizes(path: Path) -> list[int]:
    """Return what the chunks of an mcap file say that they unpack to [bytes]."""
    from mcap.reader import SeekingReader
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    size = path.stat().st_size
    with path.open("rb") as file:
        summary = SeekingReader(file, record_size_limit=size).get_summary()
        if summary is not None and summary.chunk_indexes:
            return [each.uncompressed_size for each in summary.chunk_indexes]
        file.seek(0)
        records = StreamReader(file, emit_chunks=True, record_size_limit=size).records
        return [record.uncompressed_size for record in records if isinstance(record, Chunk)]


_tried: set[tuple[Path, int, int]] = set()


def _try_database(path: Path) -> None:
    """Go through an SQLite file in a process of its own: one that is damaged, or computes, may go on for ever.

    Raises:
        OutOfBoundsError: It takes more memory or time than one of its size does.
        ValueError: It cannot be read.
    """
    state = path.stat()
    mark = (path, state.st_size, state.st_mtime_ns)
    if mark in _tried:
        return
    try:
        error = run_limited(_read_through, path, memory=STEP_MEMORY, seconds=allowed_seconds(path))
    except SandboxError as ended:
        raise OutOfBoundsError(str(ended)) from ended
    if error:
        raise ValueError(error)
    _tried.add(mark)


def _read_through(path: Path) -> str:
    """Read all messages of a bag; return what is wrong with it, "" of nothing."""
    from rosbags.rosbag2 import Reader

    try:
        with Reader(path) as reader:
            for _ in reader.messages():
                pass
    except MemoryError:
        raise
    except Exception as error:  # of apsw and of rosbags
        return one_line(error)
    return ""


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


# what people have recordings in, by the ending of their names, and what makes one of ours of it
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
PICTURES = (".png", ".jpg", ".jpeg")
BUFFERS = (".zarr", ".zarr.zip")  # of UMI and UMI-FT
BAGS = ("metadata.yaml", "*.mcap", "*.db3", "meta/info.json")  # what makes a folder something else than pictures
_OTHERS = {
    ".bag": "a ROS 1 bag: rosbags-convert --src FILE --dst FOLDER makes a ROS 2 bag of it",
    ".hdf5": "HDF5, as ALOHA and robomimic write it: make a LeRobot dataset of it, with LeRobotDataset.create",
    ".zstd": "compressed as a whole: unpack it with zstd -d FILE",
    ".zip": "a zip file; a replay buffer of UMI is called NAME.zarr.zip",
    ".heic": "a picture as phones write it: make .jpg of all of them, with heif-convert or on the phone",
}
# of what is said of MCAP files that are not written by ROS 2
_FOREIGN = ("Profile is not ros2", "'protobuf'", "'jsonschema'", "'flatbuffer'", "'ros1msg'")
_OTHERS |= {".h5": _OTHERS[".hdf5"], ".zst": _OTHERS[".zstd"], ".heif": _OTHERS[".heic"]}


def bag_source(path: Path) -> Path:
    """Return what rosbags can open: a folder with metadata.yaml, or the one bag file in a folder without.

    Raises:
        RecordingError: there is no such thing.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such recording")
    path = path.resolve()
    if path.suffix.lower() in _OTHERS:
        raise RecordingError(f"{path.name}: {_OTHERS[path.suffix.lower()]}")
    if path.is_file() and path.suffix not in (".mcap", ".db3"):
        raise RecordingError(f"{path.name}: not a recording; expected a rosbag2 folder, .mcap or .db3")
    if path.is_file():
        return _check_bag(path)
    _refuse_pipes(path)
    if (path / "metadata.yaml").exists():
        return path
    files = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    if len(files) != 1:
        found = f"no metadata.yaml and {len(files)} bag files: run `ros2 bag reindex` on it; expected one or metadata"
        found = found if files else "no metadata.yaml, .mcap, .db3 or pictures"
        packed = [] if files else [each for each in sorted(path.iterdir()) if each.suffix.lower() in _OTHERS]
        if packed:
            raise RecordingError(f"{packed[0].name}: {_OTHERS[packed[0].suffix.lower()]}")
        kinds = ", ".join(sorted({each.suffix for each in path.iterdir() if each.suffix}))
        other = f", but {kinds}; expected pictures as {', '.join(PICTURES)}" if kinds and not files else ""
        raise RecordingError(f"{path.name}: the folder is not a recording: {found} in it{other}")
    return _check_bag(files[0])


def _check_bag(path: Path) -> Path:
    """Return the path of a bag file; raises RecordingError where Git LFS has not fetched it."""
    try:
        check_plain(path)
    except FileError as error:
        raise RecordingError(f"{path.name}: {error}") from error
    return path


def is_buffer(path: Path) -> bool:
    """Say whether a path is, by its name, a group of Zarr."""
    return path.name.endswith(BUFFERS)


def is_frames(path: Path) -> bool:
    """Say whether a path is a buffer, a video, or a folder of pictures and nothing else that is a recording."""
    if is_buffer(path):
        return True
    if not path.is_dir():
        return path.suffix.lower() in VIDEOS
    return not any(any(path.glob(pattern)) for pattern in BAGS) and bool(list_pictures(path))


def list_pictures(folder: Path) -> list[Path]:
    """Return the pictures of a folder in the order of the numbers in their names."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in PICTURES and path.is_file()]
    return sorted(found, key=lambda path: [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", path.name)])


def list_files(path: Path) -> list[Path]:
    """Return the files of a recording; none where there is no such recording."""
    try:
        source = path if is_frames(path) else bag_source(path)
        if source.is_file():
            return [source]
        return [*source.glob("*/*")] if is_buffer(source) else [each for each in source.iterdir() if each.is_file()]
    except (RecordingError, OSError):
        return []


def name_recordings(texts: Sequence[str | Path], between: str) -> list[tuple[str, Path]]:
    """Return recordings with names of their own: of their file or folder, and as much of their paths as that takes.

    Args:
        texts: paths.
        between: stands between the parts of a name.

    Raises:
        RecordingError: one was given twice, or has a name that is no UTF-8.
    """
    paths = [Path(text).resolve() for text in texts]
    odd = next((path for path in paths if not str(path).isprintable()), None)
    if odd is not None:
        raise RecordingError(f"{str(odd)!a}: expected a name in UTF-8 that can be printed: rename it")
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
    if is_buffer(path):
        return path.with_name(path.name.removesuffix(".zip").removesuffix(".zarr"))
    with suppress(RecordingError):
        source = path if is_frames(path) else bag_source(path)
        return source.with_suffix("") if source.is_file() else source
    return path


def _refuse_pipes(folder: Path) -> None:
    """Refuse a folder with something in place of its files that a reader would wait for.

    Raises:
        RecordingError: there is such a thing.
    """
    for path in [folder / "metadata.yaml", *folder.glob("*.mcap*"), *folder.glob("*.db3*")]:
        if path.exists():
            _check_bag(path)


@contextmanager
def damage_reported(name: str) -> Iterator[None]:
    """Turn whatever a bag reader raises on damaged bytes into one DamagedError."""
    try:
        yield
    except OutOfBoundsError as error:
        raise OutOfBoundsError(f"{name}: {str(error).removeprefix(f'{name}: ')}") from error
    except (FinforceError, KeyboardInterrupt):
        raise
    except OSError as error:
        if error.errno in (ENOSPC, EDQUOT):  # of where a damaged file is copied to
            raise
        raise DamagedError(f"{name}: truncated or damaged: {one_line(error)}") from error
    except MemoryError as error:
        limit = raise_budget(STEP_MEMORY) // MEGABYTE
        raise OutOfBoundsError(f"{name}: a part of it takes more than {limit} MB of memory; {_HINT}") from error
    except Exception as error:  # struct, sqlite3, zstd, lz4, yaml, ... each has its own classes
        reason = one_line(error)
        is_foreign = any(word in reason for word in _FOREIGN)
        raise DamagedError(f"{name}: {'not of ROS 2' if is_foreign else 'truncated or damaged'}: {reason}") from error


def restamp(data: bytes | memoryview, stamp: int) -> bytes:
    """Return CDR bytes that begin with a std_msgs/Header with another stamp [ns]."""
    changed = bytearray(data)
    # int32 sec, uint32 nanosec in the byte order that the encapsulation names
    struct.pack_into("<iI" if data[1] & 1 else ">iI", changed, 4, *divmod(stamp, NANOSECONDS))
    return bytes(changed)
