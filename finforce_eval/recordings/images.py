"""Colour and depth images of a recording, plain or compressed, read one by one."""

from __future__ import annotations

import io
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from finforce.camera import (
    DEPTH_TYPES,
    MILLIMETRE,
    CameraIntrinsics,
    ImageError,
    IntrinsicsError,
)
from finforce.camera_topics import COMPRESSED_COLOR, ENDS
from finforce.errors import ObservationError
from finforce.messages import (
    DEPTH_HEADER,
    camera_from_info,
    color_from_message,
    depth_from_message,
    find_nearest,
    is_packet,
    pairing_tolerance,
    read_stamp,
    same_camera,
    stamp_of,
)
from finforce.video_packets import MissingFrameError, PacketDecoder
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.bags import COMPRESSED, PACKETS, BagReader, check_types, open_bag
from finforce_eval.recordings.image_files import read_intrinsics
from finforce_eval.recordings.tracks import Timed, check_stamps
from finforce_keypoints.images import RgbdImage, check_image

# the ends of topics by which the images are found first, whatever the camera is called; the first that is there counts
COLOR_ENDS = tuple(f"color/{name}{end}" for end in ("", "/compressed") for name in ("image_raw", "image_rect_raw"))
DEPTH_ENDS = tuple(f"aligned_depth_to_color/image_raw{end}" for end in ("", "/compressedDepth", "/compressed"))
ALONE = -1  # instead of a depth image's stamp [ns], of a colour image without


@dataclass(frozen=True, kw_only=True)
class ImageChoice:
    """The images of a recording to read.

    Attributes:
        color: topic, of a dataset a feature; "" for the only one there is.
        depth: topic; "" for the only one in the frame of the colour images.
        info: topic of camera_info; "" for that next to the colour images.
        intrinsics: words of --intrinsics, instead of camera_info.
        camera: of a rig file, for images that do not describe theirs; others have to agree with it.
        T_gripper_camera: (4, 4), for what is recorded in the axes of the camera; None where nothing tells it.
        is_cut: True if images may be the middle of those that the intrinsics are of, scaled.
        episode: of a dataset.
        pairing: greatest distance between the stamps of a colour and a depth image that belong together [ns]; half a
            period of the colour images when absent.
    """

    color: str = ""
    depth: str = ""
    info: str = ""
    intrinsics: tuple[str, ...] = ()
    camera: CameraIntrinsics | None = None
    T_gripper_camera: NDArray[np.float64] | None = None
    is_cut: bool = False
    episode: int = 0
    pairing: int | None = None


class StampedImage(NamedTuple):
    """A whole image and its exact stamp [ns]."""

    stamp: int
    image: RgbdImage


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageTrack(Timed):
    """The images of a recording; iterating reads them.

    Attributes:
        source: the bag.
        name: of the recording, for messages.
        topics: of colour and depth, "" without.
        stamps_ns: (n,) of the colour images [ns], strictly rising.
        depth_stamps: (n,) of their depth images [ns], ALONE of an image without.
        camera: intrinsics.
        frame_id: of the camera.
        unpaired: (m,) stamps of colour images left out because no depth image is of their time [ns].
        depth_scale: one step of a 16-bit depth image [m].
        info: topic of camera_info, "" without.
        is_video: True if the colour images are packets of a video.
        notes: why recorded depth is not used, one sentence for each topic.
    """

    source: Path
    name: str
    topics: tuple[str, str]
    stamps_ns: NDArray[np.int64]
    depth_stamps: NDArray[np.int64]
    camera: CameraIntrinsics
    frame_id: str
    unpaired: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    depth_scale: float = MILLIMETRE
    info: str = ""
    is_video: bool = False
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def at(self, stamps: NDArray[np.int64]) -> ImageTrack:
        """Return the images at some stamps [ns]."""
        chosen = np.isin(self.stamps_ns, stamps)
        return replace(self, stamps_ns=self.stamps_ns[chosen], depth_stamps=self.depth_stamps[chosen])

    @property
    def has_depth(self) -> bool:
        """True if there are depth images."""
        return bool(self.topics[1])

    def all_colors(self) -> ImageTrack:
        """Return all colour images, those alone that have no depth image."""
        stamps = np.concatenate((self.stamps_ns, self.unpaired))
        depths = np.concatenate((self.depth_stamps, np.full(len(self.unpaired), ALONE)))
        order = np.argsort(stamps)
        return replace(self, stamps_ns=stamps[order], depth_stamps=depths[order], unpaired=self.unpaired[:0])

    def colors_alone(self) -> ImageTrack:
        """Return all colour images as if there was no depth."""
        track = self.all_colors()
        return replace(track, topics=(self.topics[0], ""), depth_stamps=np.full(len(track.stamps_ns), ALONE))

    def __iter__(self) -> Iterator[StampedImage]:
        """Read the images in the order of their stamps, without those of a video that cannot be made.

        Raises:
            RecordingError: an image is damaged, of unknown encoding, or of another size than its camera.
        """
        color, depth = self.topics
        wanted = {color: set(self.stamps_ns.tolist()), depth: set(self.depth_stamps.tolist()) - {ALONE}}
        video = PacketDecoder()
        pairs = zip(self.stamps_ns.tolist(), self.depth_stamps.tolist(), strict=True)
        waiting: dict[tuple[str, int], Any] = {}
        pair = next(pairs, None)
        with open_bag(self.source, self.name) as bag:
            for raw in bag.raw(tuple(filter(None, self.topics))):
                stamp = read_stamp(raw.data)
                is_wanted = stamp in wanted[raw.topic]
                if is_wanted or (self.is_video and raw.topic == color):  # a packet needs those before it
                    message = bag.decode(raw)
                    read = message if raw.topic == depth else self._read_color(message, stamp, video)
                    waiting |= {(raw.topic, stamp): read} if is_wanted else {}
                while pair and (color, pair[0]) in waiting and (pair[1] == ALONE or (depth, pair[1]) in waiting):
                    pixels = waiting.pop((color, pair[0]))
                    if pixels is not None:
                        yield self._image(pair[0], pixels, waiting.get((depth, pair[1])))
                    waiting = {key: kept for key, kept in waiting.items() if key[0] == color or key[1] >= pair[1]}
                    pair = next(pairs, None)
                if pair is None:
                    return

    def _read_color(self, message: Any, stamp: int, video: PacketDecoder) -> NDArray[np.uint8] | None:
        """Return the colours of an image; None of a packet whose picture cannot be made."""
        with self._named(stamp), suppress(MissingFrameError):
            return color_from_message(message, video)
        return None

    @contextmanager
    def _named(self, stamp: int) -> Iterator[None]:
        """Name the image [ns] that is damaged."""
        try:
            yield
        except ImageError as error:
            raise RecordingError(f"{self.name}: image at {stamp * 1e-9:.3f} s: {error}") from error

    def _image(self, stamp: int, color: NDArray[np.uint8], depth: Any) -> StampedImage:
        late = 0 if depth is None else stamp_of(depth) - stamp
        with self._named(stamp):
            image = RgbdImage(
                stamp=stamp * 1e-9,
                depth_delay=late * 1e-9,
                color=color,
                depth=None if depth is None else depth_from_message(depth, self.depth_scale),
                camera=self.camera,
                is_video=self.is_video,
            )
            check_image(image)
        return StampedImage(stamp, image)


def find_images(bag: BagReader, source: Path, choice: ImageChoice | None = None) -> ImageTrack | None:
    """Return the images of an open bag; None without colour images.

    Args:
        bag: where they lie.
        source: of the bag.
        choice: topics and images to read.

    Raises:
        RecordingError: there are colour images, but no camera_info; there are several cameras; there is depth, but
            nothing that belongs together; a topic is not there or of another type; stamps go back; the camera changes.
        OptionError: the intrinsics that were given cannot be used.
    """
    choice = choice or ImageChoice()
    seen = _look_at_images(bag)
    missing = sorted({choice.color, choice.depth, choice.info} - bag.types.keys() - {""})
    if missing:
        there = ", ".join(topic for topic, kind in bag.types.items() if kind in (*IMAGES, CAMERA_INFO)) or "none"
        raise RecordingError(f"{bag.name}: nothing on {', '.join(missing)}; the topics of its cameras are {there}")
    color = choice.color or _find_topic(bag, COLOR_ENDS) or _only_color(bag, seen)
    if not color:
        return None
    if color not in seen:
        raise RecordingError(f"{bag.name}: {color} is {bag.types[color]}; expected {' or '.join(IMAGES)}")
    aligned = _plain([topic for topic, each in seen.items() if each.is_depth and each.frame == seen[color].frame])
    depth = choice.depth or _find_topic(bag, DEPTH_ENDS) or (aligned[0] if len(aligned) == 1 else "")
    info = "" if choice.intrinsics else choice.info or _find_info(bag, color, seen[color].frame)
    topics = (color, depth) if depth else (color,)
    check_types(bag.connections, dict.fromkeys(topics, IMAGES) | {info: (CAMERA_INFO,)}, bag.name)
    camera, frame_id = _choose_camera(bag, info, choice, color, seen[color].frame)
    found: dict[str, list[int]] = {topic: [] for topic in topics}
    for raw in bag.raw(topics):
        found[raw.topic].append(read_stamp(raw.data))
    stamps = {topic: check_stamps(times, topic, bag.name) for topic, times in found.items()}
    depth_stamps, paired = np.full(len(stamps[color]), ALONE), np.ones(len(stamps[color]), dtype=bool)
    if depth:
        pairing = pairing_tolerance(stamps[color]) if choice.pairing is None else choice.pairing
        depth_stamps = stamps[depth][find_nearest(stamps[depth], stamps[color])]
        paired = _pair(stamps[color], depth_stamps, pairing, topics, bag.name)
    return ImageTrack(
        source=source,
        name=bag.name,
        topics=(color, depth),
        stamps_ns=stamps[color][paired],
        depth_stamps=depth_stamps[paired],
        camera=camera,
        frame_id=frame_id,
        unpaired=stamps[color][~paired],
        info=info,
        is_video=seen[color].is_video,
        notes=() if depth else _note_depth(bag, seen, seen[color].frame),
    )


def _note_depth(bag: BagReader, seen: Mapping[str, _FirstImage], frame: str) -> tuple[str, ...]:
    """Return why recorded depth is not used: several topics have it, or it is of another frame, or never came."""
    images = [topic for topic, kind in bag.types.items() if kind in IMAGES]
    depth = _plain([topic for topic in images if (seen[topic].is_depth if topic in seen else "depth" in topic)])
    came = {topic for topic in depth if topic in seen}
    other = f"the colour images are in '{frame}': record aligned depth (RealSense: align_depth.enable:=true)"
    several = "is not the only one: choose with --depth"
    why = {topic: several if seen[topic].frame == frame else f"is in '{seen[topic].frame}', {other}" for topic in came}
    return tuple(f"depth is not used: {topic} {why.get(topic, 'has no messages')}" for topic in sorted(came or depth))


def _pair(
    stamps: NDArray[np.int64], depth_stamps: NDArray[np.int64], pairing: int, topics: Sequence[str], name: str
) -> NDArray[np.bool_]:
    """Return for each colour image whether a depth image is of its time.

    Args:
        stamps: of the colour images (n,) [ns].
        depth_stamps: of the depth image that is nearest to each (n,) [ns].
        pairing: difference of the two, at most [ns].
        topics: of colour and depth.
        name: of the recording.

    Raises:
        RecordingError: there is no such depth image.
    """
    apart = np.abs(depth_stamps - stamps)
    if not (apart <= pairing).any():
        raise RecordingError(
            f"{name}: no depth image on {topics[1]} within {pairing / 10**6:g} ms of one on {topics[0]}; the nearest "
            f"two are {apart.min() / 10**9:.3f} s apart: stamps of two clocks?"
        )
    return apart <= pairing


def _choose_camera(
    bag: BagReader, info: str, choice: ImageChoice, color: str, frame: str
) -> tuple[CameraIntrinsics, str]:
    """Return the camera of the images, by a topic or as given, and its frame.

    Raises:
        RecordingError: it changes, or is not that of the rig; no image can be decoded.
        OptionError: the intrinsics that were given cannot be used.
    """
    if not info:
        return read_intrinsics(choice.intrinsics, _find_size(bag, color)), frame
    camera, frame_id = _read_camera(bag, info, color)
    if choice.camera is not None and not same_camera(choice.camera, camera):
        raise RecordingError(
            f"{bag.name}: the rig is of another camera than {info}: {choice.camera.width} x {choice.camera.height}, "
            f"focal length {choice.camera.fx:.1f}; found {camera.width} x {camera.height}, {camera.fx:.1f}"
        )
    return camera, frame_id


def _find_topic(bag: BagReader, ends: Sequence[str]) -> str:
    """Return the topic with the first of some ends, "" without; one without messages does not count."""
    counts: dict[str, int] = {}
    for connection in bag.connections:
        counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    for end in ends:
        topics = sorted(topic for topic, count in counts.items() if topic.endswith(f"/{end}") and count)
        if len(topics) > 1:
            raise RecordingError(f"{bag.name}: several cameras: {', '.join(topics)}; name one by --color or --depth")
        if topics:
            return topics[0]
    return ""


class _FirstImage(NamedTuple):
    """Properties of all images of a topic, by the first: frame and content."""

    frame: str
    is_depth: bool
    is_grey: bool
    is_video: bool


def _look_at_images(bag: BagReader) -> dict[str, _FirstImage]:
    """Return what the topics with images show."""
    topics = {each.topic for each in bag.connections if each.msgtype in IMAGES and each.msgcount}
    seen: dict[str, _FirstImage] = {}
    for raw in bag.raw(topics):
        if raw.topic not in seen:
            message = bag.decode(raw)
            words = getattr(message, "encoding", None) or message.format
            is_depth = words.partition(";")[0].strip() in DEPTH_TYPES or "compressedDepth" in words
            is_grey = words.startswith("mono")
            seen[raw.topic] = _FirstImage(message.header.frame_id, is_depth, is_grey, is_packet(message))
        if len(seen) == len(topics):
            break
    return seen


def _find_size(bag: BagReader, color: str) -> tuple[int, int]:
    """Return height and width of the first colour image that can be decoded; raises RecordingError where none can."""
    video, why = PacketDecoder(), ""
    for raw in bag.raw((color,)):
        try:
            return color_from_message(bag.decode(raw), video).shape[:2]
        except ImageError as error:
            why = str(error)
    raise RecordingError(f"{bag.name}: no image on {color} can be decoded: {why}")


def _plain(topics: Collection[str]) -> list[str]:
    """Return topics without those that bring the same images compressed."""
    return sorted(set(topics) - {topic + end for topic in topics for end in ENDS})


def _only_color(bag: BagReader, seen: Mapping[str, _FirstImage]) -> str:
    """Return the only topic with colour images, or else with grey ones; "" where there are none.

    Raises:
        RecordingError: there are several.
    """
    grey = _plain([topic for topic, each in seen.items() if not each.is_depth])
    colors = [topic for topic in grey if not seen[topic].is_grey] or grey
    if len(colors) > 1:
        raise RecordingError(f"{bag.name}: several cameras; expected --color with one of {', '.join(colors)}")
    return colors[0] if colors else ""


def _find_info(bag: BagReader, color: str, frame: str) -> str:
    """Return the camera_info next to the colour images, or the only one that is in their frame.

    Raises:
        RecordingError: there is none.
    """
    beside = color.removesuffix(COMPRESSED_COLOR).rpartition("/")[0] + "/camera_info"
    topics = {each.topic for each in bag.connections if each.msgtype == CAMERA_INFO and each.msgcount}
    if beside in topics:
        return beside
    same = [topic for topic in topics if bag.decode(next(bag.raw((topic,)))).header.frame_id == frame]
    if len(same) != 1:
        raise RecordingError(
            f"{bag.name}: there are images on {color}, but nothing on {beside}; expected --camera-info with a topic "
            f"({', '.join(sorted(topics)) or 'there is none'}), or --intrinsics"
        )
    return same[0]


def _read_camera(bag: BagReader, topic: str, color: str) -> tuple[CameraIntrinsics, str]:
    """Return the camera of all colour images, and its frame."""
    camera, frame = None, ""
    for raw in bag.raw((topic,)):
        info = bag.decode(raw)
        try:
            seen = camera_from_info(info, info.header.frame_id, color)
        except (ObservationError, IntrinsicsError) as error:
            raise RecordingError(f"{bag.name}: {topic}: {error}; --intrinsics replaces it") from error
        if camera is not None and not (same_camera(camera, seen) and info.header.frame_id == frame):
            raise RecordingError(f"{bag.name}: the camera on {topic} changes; expected one in a recording")
        camera, frame = seen, info.header.frame_id
    return camera, frame


IMAGE = "sensor_msgs/msg/Image"
PACKED = (COMPRESSED, *PACKETS)
IMAGES = (IMAGE, *PACKED)
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
QUALITY = 90  # of a jpeg, the key points' pixels stay within a few hundredths
LEVEL = 1  # of png: the highest makes a noisy depth image a quarter smaller, and takes eighty times as long


def encode_color(color: NDArray[np.uint8]) -> bytes:
    """Return a colour image (h, w, 3) RGB as the bytes of a jpeg."""
    buffer = io.BytesIO()
    Image.fromarray(color).save(buffer, format="jpeg", quality=QUALITY)
    return buffer.getvalue()


def compress_depth(steps: NDArray[np.uint16]) -> bytes:
    """Return a 16-bit depth image (h, w) as `compressedDepth` has it: a header of zeros and a png."""
    buffer = io.BytesIO()
    Image.fromarray(steps).save(buffer, format="png", compress_level=LEVEL)
    return bytes(DEPTH_HEADER) + buffer.getvalue()
