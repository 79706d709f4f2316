"""Recorded messages as they lie in a bag, undecoded, ready to be published again; knows no ROS node."""

from __future__ import annotations

import struct
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from finforce_eval.errors import RecordingError
from finforce_eval.recording import bag_source, damage_reported
from finforce_eval.tracks import NANOSECONDS

HEADER = "std_msgs/msg/Header"


class RawMessage(NamedTuple):
    """One recorded message.

    Attributes:
        time: when the bag received it [ns].
        topic: its topic.
        msgtype: its type, `package/msg/Name`.
        data: CDR bytes with their four bytes of encapsulation.
        has_header: the message begins with a std_msgs/Header, whose stamp can be read and written here.
    """

    time: int
    topic: str
    msgtype: str
    data: bytes
    has_header: bool

    @property
    def stamp(self) -> int:
        """The header's stamp [ns]; the time of receipt without a header."""
        if not self.has_header:
            return self.time
        seconds, nanoseconds = struct.unpack_from(self._layout, self.data, 4)
        return seconds * NANOSECONDS + nanoseconds

    def restamped(self, stamp: int) -> bytes:
        """Return the bytes with another stamp [ns]; unchanged without a header."""
        if not self.has_header:
            return self.data
        data = bytearray(self.data)
        struct.pack_into(self._layout, data, 4, *divmod(stamp, NANOSECONDS))
        return bytes(data)

    @property
    def _layout(self) -> str:
        """Return int32 sec, uint32 nanosec in the byte order that the encapsulation names."""
        return "<iI" if self.data[1] & 1 else ">iI"


def read_playback(path: str | Path, without: Collection[str] = ()) -> list[RawMessage]:
    """Return the messages of a bag in the order of their receipt.

    Args:
        path: rosbag2 folder, .mcap or .db3 file.
        without: topics to be left out.

    Raises:
        RecordingError: the bag cannot be read, or holds nothing to be played.
    """
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY).fielddefs
    source = bag_source(Path(path))
    with damage_reported(source.name), Reader(source) as reader:
        chosen = [entry for entry in reader.connections if entry.topic not in without and entry.msgtype in types]
        headed = {entry.msgtype: _begins_with_header(types[entry.msgtype]) for entry in chosen}
        messages = [
            RawMessage(time, entry.topic, entry.msgtype, bytes(data), headed[entry.msgtype])
            for entry, time, data in (reader.messages(connections=chosen) if chosen else ())
        ]
    if not messages:
        raise RecordingError(f"{source.name}: nothing to be played in it")
    return messages


def _begins_with_header(definition: tuple) -> bool:
    """Say whether a type's first field is a std_msgs/Header."""
    entries = definition[1]
    return bool(entries) and entries[0][0] == "header" and entries[0][1][1] == HEADER
