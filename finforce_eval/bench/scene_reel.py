"""A recording cut into parts that are played one after the other, as often as asked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter

from finforce.stamps import NANOSECONDS
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.image_messages import CAMERA_INFO, IMAGE
from finforce_eval.recordings.recording import POSE
from finforce_eval.replay.playback import Playback, RawMessage
from finforce_keypoints.parameters import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC

PHASE_TOPIC, OBJECT_TOPIC, MASK_TOPIC = "/bench/phase", "/object_pose", "/object_mask"
PLAYED = {COLOR_TOPIC: IMAGE, DEPTH_TOPIC: IMAGE, INFO_TOPIC: CAMERA_INFO, OBJECT_TOPIC: POSE, MASK_TOPIC: IMAGE}
RATE = 30.0  # Hz


@dataclass(frozen=True, kw_only=True)
class StreamPart:
    """A stretch of time in which the images of one section are played, over and over where they do not suffice.

    Attributes:
        section: of the recording.
        seconds: how long.
        name: under which it is measured; empty: it is not.
    """

    section: str
    seconds: float
    name: str = ""


@dataclass(frozen=True, kw_only=True)
class Span:
    """When a part is played, from the beginning of all [s]."""

    part: StreamPart
    begin: float
    end: float


class SceneReel:
    """The messages of the sections of a recording, in the order and as long as the parts have them.

    It is played as a `Playback` is; every iteration gives the same.

    Attributes:
        begin: time of the first message [ns].
        types: of the topics.
        spans: of the parts.

    Args:
        sections: images by section: each a list of the messages that belong to one image.
        parts: what is played.
        rate: of the images [Hz].

    Raises:
        RecordingError: a part asks for a section that has no images.
    """

    def __init__(
        self, sections: Mapping[str, Sequence[Sequence[RawMessage]]], parts: Sequence[StreamPart], rate: float = RATE
    ) -> None:
        for part in parts:
            if not sections.get(part.section):
                raise RecordingError(f"the recording has no images of the section {part.section!r}")
        self._sections, self._parts, self._rate = sections, tuple(parts), rate
        self.begin = NANOSECONDS
        kinds = {
            message.topic: message.msgtype for images in sections.values() for image in images for message in image
        }
        self.types = kinds
        self.spans = tuple(self._lay_out())

    def _lay_out(self) -> Iterator[Span]:
        """Yield when each part is played."""
        begin = 0.0
        for part in self._parts:
            end = begin + round(part.seconds * self._rate) / self._rate
            yield Span(part=part, begin=begin, end=end)
            begin = end

    def __len__(self) -> int:
        return sum(1 for _ in self._images())

    def _images(self) -> Iterator[Sequence[RawMessage]]:
        for part in self._parts:
            images = self._sections[part.section]
            for index in range(round(part.seconds * self._rate)):
                yield images[index % len(images)]

    def __iter__(self) -> Iterator[RawMessage]:
        for index, image in enumerate(self._images()):
            time = self.begin + round(index * NANOSECONDS / self._rate)
            for message in image:
                yield message._replace(time=time, data=message.restamped(time))


def cut_sections(messages: Playback, names: Mapping[str, str]) -> dict[str, list[list[RawMessage]]]:
    """Return the images of a recording by section, each with all that has its stamp.

    Args:
        messages: camera images, poses of the object, and the words of `/bench/phase`.
        names: section by the beginning of such a word; images of other phases are left out.
    """
    sections: dict[str, list[list[RawMessage]]] = {}
    section = ""
    for _, group in groupby(messages, key=attrgetter("time")):
        image = list(group)
        for message in image:
            if message.topic == PHASE_TOPIC:
                word = read_word(message.data)
                section = next((name for start, name in names.items() if word.startswith(start)), "")
        kept = [message for message in image if message.topic in PLAYED]
        if section and any(message.topic == COLOR_TOPIC for message in kept):
            sections.setdefault(section, []).append(kept)
    return sections


def read_word(data: bytes) -> str:
    """Return the text of a std_msgs/String in CDR: four bytes of encapsulation, four of length, text and a zero."""
    size = int.from_bytes(data[4:8], "little")
    return data[8 : 8 + size].rstrip(b"\0").decode()
