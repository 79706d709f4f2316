"""The messages of a bench scene as a camera of some rate gives them, in memory.

They are decoded before they are played, so that the player takes no time from the nodes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from finforce.messages import NANOSECONDS
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.keypoint_source import TRUTH, KeypointSource
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_eval.replay.node_run import OBJECT_TOPIC
from finforce_eval.replay.playback import Playback, RawMessage, read_playback


@dataclass(frozen=True, kw_only=True, eq=False)
class SyntheticStream:
    """Messages that are played as a `Playback` is; every iteration gives the same.

    Attributes:
        messages: in the order of their times.
        repeats: how often they are played, each time as if it had gone on.
        period: from the beginning of one time to that of the next [ns].
    """

    messages: Sequence[RawMessage]
    repeats: int = 1
    period: int = 0

    @property
    def begin(self) -> int:
        """Time of the first message [ns]."""
        return self.messages[0].time

    @property
    def types(self) -> dict[str, str]:
        """Type by topic."""
        return {message.topic: message.msgtype for message in self.messages}

    def __len__(self) -> int:
        return self.repeats * len(self.messages)

    def __iter__(self) -> Iterator[RawMessage]:
        yield from self.messages
        for number in range(1, self.repeats):
            shift = number * self.period
            for message in self.messages:
                data = message.restamped(message.stamp + shift)
                yield message._replace(time=message.time + shift, data=data)


def stream_images(source: Path, rate: int) -> SyntheticStream:
    """Return what a camera sees at a rate [Hz], with the object's poses at 10 Hz.

    Args:
        source: the scene.
        rate: of the images [Hz].

    Raises:
        RecordingError: the scene has no images at this rate.
    """
    topics = {COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC, OBJECT_TOPIC}
    return thin_messages(read_playback(source), topics, rate)


def stream_keypoints(source: Path, rate: int) -> SyntheticStream:
    """Return the true key points and jaw poses of a scene at a rate [Hz], with the object's poses at 10 Hz.

    Raises:
        RecordingError: the scene has no images at this rate.
    """
    recording = KeypointSource(source=TRUTH).apply(read_recording(source))
    with TemporaryDirectory() as folder:
        plain = write_recording(replace(recording, images=None), Path(folder) / "truth")
        topics = {f"/{side}/{name}" for side in recording.jaws for name in ("keypoints", "jaw_pose")}
        return thin_messages(read_playback(plain), topics | {OBJECT_TOPIC}, rate)


def thin_messages(messages: Playback, topics: set[str], rate: int) -> SyntheticStream:
    """Return the messages of some topics at a rate [Hz]."""
    if FINE_RATE % rate:
        raise RecordingError(f"rate {rate} Hz: expected a divisor of {FINE_RATE} Hz")
    step = FINE_RATE // rate
    kept = [
        message
        for message in messages
        if message.topic in topics
        and slot_of(message.stamp) % (POSE_SLOTS if message.topic == OBJECT_TOPIC else step) == 0
    ]
    images = {slot_of(message.stamp) // step for message in kept if message.topic != OBJECT_TOPIC}
    if not images or len(images) <= max(images):
        raise RecordingError(
            f"the scene has {len(images)} images at {rate} Hz, some are missing; expected one for {rate} Hz"
        )
    return SyntheticStream(messages=kept, period=len(images) * step * NANOSECONDS // FINE_RATE)


FINE_RATE = 180  # [Hz] of the slots in which images can lie; 30, 60 and 90 divide it
POSE_SLOTS = 18  # the object is tracked at 10 Hz
START = 1_000_000_000_000  # [ns] stamp of slot 0, as the twin has it


def slot_of(stamp: int) -> int:
    """Return in which slot of 1/180 s a stamp [ns] of a scene lies."""
    return round((stamp - START) * FINE_RATE / 1_000_000_000)
