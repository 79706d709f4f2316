"""The messages of a recording in the order of their times, read ahead of the player."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Collection, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from finforce.messages import NANOSECONDS, color_from_message, depth_encoding, depth_steps, read_stamp
from finforce.video_packets import MissingFrameError, PacketDecoder
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.bags import BagReader, RawSample, bag_source, open_bag, restamp
from finforce_eval.recordings.images import (
    CAMERA_INFO,
    COLOR_ENDS,
    DEPTH_ENDS,
    IMAGE,
    PACKED,
    ImageTrack,
)
from finforce_eval.recordings.writer import make_message
from finforce_sim.simulated_recording import info_fields

HEADER = "std_msgs/msg/Header"
FIRST, HEAD = 50, 12  # messages, and their first bytes, that tell whether receipts and stamps are of one clock
OTHER_CLOCK = 60 * NANOSECONDS  # [ns] between receipt and stamp, beyond all delays: those of a simulation, of a camera
# where the nodes listen -> the ends of the topics that are played there
PLAYED = {COLOR_TOPIC: COLOR_ENDS, DEPTH_TOPIC: DEPTH_ENDS, INFO_TOPIC: ("color/camera_info",)}


class RawMessage(NamedTuple):
    """One recorded message.

    Attributes:
        time: when the bag received it [ns], by the clock of the stamps.
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
        return read_stamp(self.data) if self.has_header else self.time

    def restamped(self, stamp: int) -> bytes:
        """Return the bytes with another stamp [ns]; unchanged without a header."""
        return restamp(self.data, stamp) if self.has_header else self.data


class Playback:
    """The messages of a bag in the order of their receipt; every iteration reads them anew.

    Camera topics come out where the nodes listen, compressed images as plain ones, given intrinsics beside each.

    Args:
        path: rosbag2 folder, .mcap or .db3 file.
        without: topics to be left out.
        images: topics to play to the nodes; None: those of the usual names.

    Attributes:
        begin: receipt of the first message [ns], by the clock of the stamps.

    Raises:
        RecordingError: the bag cannot be read, or holds nothing to be played.
    """

    def __init__(self, path: str | Path, without: Collection[str] = (), images: ImageTrack | None = None) -> None:
        self._source = source = bag_source(Path(path))
        given = {} if images is None else dict(zip((*images.topics, images.info), PLAYED, strict=True))
        with open_bag(source, source.name) as bag:
            known = [entry for entry in bag.connections if entry.topic not in without and bag.knows(entry.msgtype)]
            ours = {entry.topic: given.get(entry.topic) or _played_topic(entry.topic) for entry in known}
            # of several cameras one is played
            chosen = [each for each in known if not given or each.topic in given or ours[each.topic] not in PLAYED]
            self._topics = {entry.topic: ours[entry.topic] for entry in chosen}
            self._count = sum({id(entry): entry.msgcount for entry in chosen}.values())
            types = {entry.topic: _played_type(entry.msgtype) for entry in chosen}
            self._headed = {topic: _begins_with_header(bag.definition(kind)) for topic, kind in types.items()}
            came = [
                (raw.time, raw.time - read_stamp(bytes(raw.data[:HEAD])) if self._headed[raw.topic] else None)
                for raw in islice(bag.raw(self._topics), FIRST)
            ]
        if not came:
            raise RecordingError(f"{source.name}: nothing to be played in it")
        lag = round(median([late for _, late in came if late is not None] or [0]))
        self._lag = lag if abs(lag) > OTHER_CLOCK else 0
        self.begin = came[0][0] - self._lag
        self.types = {self._topics[topic]: kind for topic, kind in types.items()}
        self._camera = images.camera if images is not None and not images.info else None
        self.types |= {INFO_TOPIC: CAMERA_INFO} if self._camera else {}

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[RawMessage]:
        videos: dict[str, PacketDecoder] = defaultdict(PacketDecoder)
        with open_bag(self._source, self._source.name) as bag:
            for raw in bag.raw(self._topics):
                topic, kind, data = self._topics[raw.topic], bag.types[raw.topic], bytes(raw.data)
                if kind in PACKED:
                    try:
                        data = _decompress(bag, raw, topic, videos[raw.topic])
                    except MissingFrameError:
                        continue
                time = raw.time - self._lag
                yield RawMessage(time, topic, _played_type(kind), data, self._headed[raw.topic])
                if self._camera and topic == COLOR_TOPIC:
                    info = make_message(CAMERA_INFO, header=bag.decode(raw).header, **info_fields(self._camera))
                    yield RawMessage(time, INFO_TOPIC, CAMERA_INFO, bag.encode(CAMERA_INFO, vars(info)), True)


def _played_topic(topic: str) -> str:
    """Return where a topic is played: those of any camera under the names that the nodes listen to."""
    return next((ours for ours, ends in PLAYED.items() if topic.endswith(tuple(f"/{end}" for end in ends))), topic)


def _played_type(msgtype: str) -> str:
    return IMAGE if msgtype in PACKED else msgtype


def _decompress(bag: BagReader, raw: RawSample, topic: str, video: PacketDecoder) -> bytes:
    """Return the CDR bytes of a sensor_msgs/Image with the pixels of a compressed one."""
    message: Any = bag.decode(raw)
    pixels = depth_steps(message) if topic == DEPTH_TOPIC else color_from_message(message, video)
    fields = {
        "header": message.header,
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": depth_encoding(pixels) if topic == DEPTH_TOPIC else "rgb8",
        "is_bigendian": 0,
        "step": pixels.strides[0],
        "data": pixels.reshape(-1).view("u1"),
    }
    return bag.encode(IMAGE, fields)


def _begins_with_header(definition: tuple) -> bool:
    """Say whether a type's first field is a std_msgs/Header."""
    entries = definition[1]
    return bool(entries) and entries[0][0] == "header" and entries[0][1][1] == HEADER


DEPTH = 256  # items in waiting; as many RGB-D images of 640 x 480 take 400 MB


class ReadAhead:
    """The items of a generator, up to `depth` of them ready; making them begins at once, in another thread.

    Args:
        items: source of the items.
        depth: items that may wait.
    """

    def __init__(self, items: Generator[Any, None, None], depth: int = DEPTH) -> None:
        self._items, self._reader = items, ThreadPoolExecutor(1)
        self._ready = deque(self._reader.submit(next, items, self) for _ in range(depth))

    def __iter__(self) -> Iterator[Any]:
        """Yield the items; what the generator raises is raised here, in its place."""
        while (item := self._ready.popleft().result()) is not self:
            self._ready.append(self._reader.submit(next, self._items, self))
            yield item

    def close(self) -> None:
        """Make no more items; what was not asked for is dropped."""
        self._reader.shutdown(cancel_futures=True)
        self._items.close()
