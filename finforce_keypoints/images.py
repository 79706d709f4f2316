"""Colour images with aligned depth: brought together as they come, what is found in them, and a camera that fails."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from statistics import median
from time import monotonic
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, ImageError
from finforce.messages import (
    SECOND,
    CameraStream,
    Stamped,
    Synchronizer,
    is_packet,
    median_period,
    pairing_tolerance,
    stamp_of,
)
from finforce_keypoints.arrivals import Arrivals
from finforce_keypoints.errors import BlackImageError, EmptyDepthError, FrozenImageError, SyncError
from finforce_keypoints.parameters import ALIGNED, AUTO, NO_DEPTH, DetectorParameters

FROZEN_AFTER = 2  # repetitions of a picture, to the bit, after which a camera counts as frozen
_WATCHED_STEP = 8  # every so many rows and columns are looked at
_DARKEST = 10  # of 255: a picture whose brightest hundredth is below this shows nothing
_BRIGHTEST_PERCENT = 99.0
_TILES = 4  # rows and columns of parts, each of which can stand still
_NEAR_BLACK, _NEAR_WHITE = 8, 247  # of 255: what is beyond may stay the same without a fault
SILENCE = 1.0  # s without an image, after which another colour topic may be the camera's
_WAITING = 2.5  # periods of the camera that a colour image waits for its depth, longer where depth has come later
_LONGEST_WAIT = 0.5  # [s] the same, at most
_WAITING_SHARE = {AUTO: 0.5, ALIGNED: 1.0}  # of the maximum age, at most: an image without depth is to be answered, too
_DELAYS = 15  # depth images over which their delay is learnt
_MOST_WAITING = 32  # colour images in memory
_FIRST_TOLERANCE = 8_000_000  # [ns] while the camera's period is not known
_KNOWN, _PERIODS = 2, 15  # periods from which on it is, and over which it is learnt
COLOR, DEPTH = "colour", "depth"
_LIVELY = 0.2  # share of a part's pixels between these, from which on it has to change


@dataclass(frozen=True, kw_only=True, eq=False)
class RgbdImage:
    """A colour image and the depth aligned to it.

    Attributes:
        stamp: image capture time [s].
        color: (h, w, 3) uint8 RGB, as the lens made it.
        depth: (h, w) float32 distance along the optical axis [m], NaN invalid; None when there is none.
        camera: intrinsics of both.
        depth_delay: from the stamp of the colours to that of the depth [s].
        is_video: True if the colours come from a video, where what stands still may repeat itself bit by bit.
    """

    stamp: float
    color: NDArray
    depth: NDArray | None
    camera: CameraIntrinsics
    depth_delay: float = 0.0
    is_video: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelDetection:
    """Pixels of one jaw's key points in an image; the K points of the jaw file first, the reference point last.

    Attributes:
        pixels: (K + 1, 2) column and row in the full raw, distorted image [px]; NaN where nothing was found.
        likelihood: (K + 1,) from 0 to 1, 0 where nothing was found.
        stddev: (K + 1,) one standard deviation of a point along a row or a column [px]; inf where nothing was found.
    """

    pixels: NDArray
    likelihood: NDArray
    stddev: NDArray


class PixelDetector(Protocol):
    """Anything that finds the key points of all jaws in one image, in one pass.

    Attributes:
        name: of the method and its network.
        sha256: of the network's files, empty without one.
    """

    name: str
    sha256: str

    def detect(self, image: RgbdImage, expected: Mapping[str, NDArray | None]) -> Mapping[str, PixelDetection]:
        """Return one detection per side.

        Args:
            image: colour, depth and camera.
            expected: side -> T_camera_jaw (4, 4) where the jaw should be; None where it was lost: look everywhere; a
                side that is absent is not looked for.

        Returns:
            side -> detection; a side that cannot be seen at all is absent.

        Raises:
            KeypointError: the image cannot be used with this method.
        """
        ...


def check_image(image: RgbdImage) -> None:
    """Refuse an image whose parts do not fit each other.

    Raises:
        ImageError: colour or depth has another size than the camera, another type, or the stamp is no time.
        EmptyDepthError: there is a depth image, without any depth.
    """
    size = (image.camera.height, image.camera.width)
    if not np.isfinite(image.stamp):
        raise ImageError(f"image: stamp {image.stamp}; expected seconds")
    if np.shape(image.color) != (*size, 3) or image.color.dtype != np.uint8:
        raise ImageError(
            f"colour image: {getattr(image.color, 'dtype', type(image.color).__name__)} of shape "
            f"{np.shape(image.color)}; expected uint8 {(*size, 3)}, the size in the camera_info"
        )
    if image.depth is not None and (np.shape(image.depth) != size or image.depth.dtype.kind != "f"):
        raise ImageError(
            f"depth image: {image.depth.dtype} of shape {np.shape(image.depth)}; expected metres of shape {size}, "
            "that of the colour image; use the depth that is aligned to colour, or none, by depth=none"
        )
    if image.depth is not None and not np.isfinite(image.depth).any():
        raise EmptyDepthError(
            "the depth image is empty: no pixel has a depth; expected some; is the camera covered, or its depth stream "
            "off?"
        )


def lie_inside(image: RgbdImage, pixels: NDArray) -> NDArray:
    """Return which pixels (n, 2), column and row, lie in the image, (n,) bool; those that are NaN do not."""
    with np.errstate(invalid="ignore"):
        size = (image.camera.width - 0.5, image.camera.height - 0.5)
        return (pixels >= -0.5).all(axis=1) & (pixels <= size).all(axis=1)


def _all_colors(values: NDArray) -> NDArray:
    """Return where all three of values (h, w, 3) bool hold; ten times as fast as `all`."""
    return values[..., 0] & values[..., 1] & values[..., 2]


def _brightest(seen: NDArray) -> float:
    """Return how bright the brightest hundredth of pixels (h, w, 3) is."""
    brightness = np.maximum(np.maximum(seen[..., 0], seen[..., 1]), seen[..., 2]).ravel()
    place = int(_BRIGHTEST_PERCENT / 100.0 * (brightness.size - 1))
    return float(np.partition(brightness, place)[place])


def _share_of_tiles(values: NDArray) -> NDArray:
    """Return the share (_TILES, _TILES) of the parts of values (h, w) bool that hold."""
    height, width = (size // _TILES for size in values.shape)
    parts = values[: _TILES * height, : _TILES * width].reshape(_TILES, height, _TILES, width)
    return parts.sum(axis=(1, 3)) / max(height * width, 1)


class ImageWatch:
    """Notices a camera that gives black pictures, or the same one, or the same part of one, again and again."""

    def __init__(self, frozen_after: int = FROZEN_AFTER) -> None:
        """Keeps after how many identical pictures in a row the camera counts as frozen."""
        self._frozen_after = frozen_after
        self.reset()

    def reset(self) -> None:
        """Forget the last picture."""
        self._color = self._depth = np.empty(0)
        self._same, self._same_tiles, self._same_depth = 0, np.zeros((_TILES, _TILES), dtype=int), 0

    def check(self, image: RgbdImage) -> None:
        """Refuse a picture that shows nothing, or nothing new.

        A real sensor has noise: two pictures are never alike, not even of a scene at rest. A part of a picture that is
        neither black nor white has some, too, and so has depth.

        Raises:
            BlackImageError: nearly all of the picture is black.
            FrozenImageError: it, a part of it, or the depth image is the same as the ones before.
        """
        seen = image.color[::_WATCHED_STEP, ::_WATCHED_STEP].copy()
        self._count_same(seen, image)
        if (brightest := _brightest(seen)) < _DARKEST:
            raise BlackImageError(
                f"black image: its brightest pixels are {brightest:.0f} of 255; expected at least {_DARKEST}; "
                "is the lens covered, or the exposure far too short?"
            )
        if self._same >= self._frozen_after:
            raise FrozenImageError(
                f"frozen camera: {self._same + 1} identical pictures; expected noise between them; restart the camera"
            )
        frozen = self._same_tiles >= self._frozen_after
        if frozen.any():
            row, column = np.argwhere(frozen)[0] + 1
            raise FrozenImageError(
                f"frozen camera: {frozen.sum()} of {frozen.size} parts of the picture (the first in row {row}, column "
                f"{column} of {_TILES}) are identical again and again; expected noise; restart the camera"
            )
        if self._same_depth >= self._frozen_after:
            raise FrozenImageError(
                f"frozen camera: {self._same_depth + 1} identical depth images, the colours change; expected noise "
                "between them; restart the camera"
            )

    def _count_same(self, seen: NDArray, image: RgbdImage) -> None:
        """Count how often in a row the picture, its parts and the depth were what they had been before."""
        depth = image.depth
        is_known = seen.shape == self._color.shape and not image.is_video
        same = _all_colors(seen == self._color) if is_known else np.zeros(seen.shape[:2], dtype=bool)
        lively = _all_colors((seen > _NEAR_BLACK) & (seen < _NEAR_WHITE))
        self._same = self._same + 1 if same.all() else 0
        still = (_share_of_tiles(same) == 1.0) & (_share_of_tiles(lively) >= _LIVELY)
        self._same_tiles = np.where(still, self._same_tiles + 1, 0)
        measured = np.empty(0) if depth is None else depth[::_WATCHED_STEP, ::_WATCHED_STEP].copy()
        # a plain depth image, or one without any depth, is no camera's: it is refused for what it is
        known = measured[np.isfinite(measured)]
        is_plain = known.size == 0 or known.min() == known.max()
        is_same = not is_plain and np.array_equal(measured, self._depth, equal_nan=True)
        self._same_depth = self._same_depth + 1 if is_same else 0
        self._color, self._depth = seen, measured


class RgbdFeed:
    """Brings the images of a camera together by their stamps, the newest first.

    A colour image takes the depth image nearest to it, at most half a period of the camera away, unless the parameters
    say how far. One whose depth has been lost, as a later one's shows, is taken alone where depth may be missing; where
    it must not, the image is passed over. When no depth comes at all, or always too late, the first image that waited
    in vain is taken alone, and so are those after it, until depth comes in time again. Of several colour topics the
    first that brings an image is listened to, until it is silent.

    Attributes:
        stream: of the camera, in whose frame all messages must be.
        passed: colour images that were overtaken while they waited.
        alone: colour images that were taken without depth.
        max_age: greatest age of an image that is answered [s], which bounds the wait.
        topic: the colour topic that is listened to, None before the first image.
        arrivals: of colour and depth images, by which of them got lost is known.

    Args:
        parameters: frame, topics, unit of depth and maximum difference of stamps.
        clock: the time [s] of an arrival.
    """

    def __init__(self, parameters: DetectorParameters, clock: Callable[[], float] = monotonic) -> None:
        self._parameters, self._clock = parameters, clock
        self.stream = CameraStream(parameters.camera_frame, parameters.depth_scale, parameters.color_topics[0])
        self.passed = self.alone = 0
        self.max_age = parameters.max_age
        self.arrivals = {COLOR: Arrivals(), DEPTH: Arrivals()}
        self.topic: str | None = None
        self._heard = clock()
        self.reset()

    @property
    def source(self) -> str:
        """The colour topic that is listened to, or those that may be."""
        return self.topic or " or ".join(self._parameters.color_topics)

    @property
    def waiting(self) -> Stamped | None:
        """The newest `RgbdImage` without depth that waits for it."""
        waiting = self._images.entries(COLOR)
        return waiting[-1] if waiting else None

    def reset(self) -> None:
        """Forget all images; intrinsics, frame and topic stay."""
        self.pause()
        given = self._parameters.sync_tolerance
        self._tolerance = _FIRST_TOLERANCE if math.isnan(given) else round(given / SECOND)
        self._images = Synchronizer({COLOR: None, DEPTH: _MOST_WAITING}, self._tolerance)
        self._stamps: deque[int] = deque(maxlen=_PERIODS + 1)
        self._delays: deque[int] = deque(maxlen=_DELAYS)
        self._alone = self._parameters.depth == NO_DEPTH

    def pause(self) -> None:
        """Note that nobody asks for images, which are none that got lost."""
        self.stream.video.reset()
        for arrivals in self.arrivals.values():
            arrivals.reset()

    def take_info(self, message: Any) -> None:
        """Take the camera's intrinsics, which tell of an image, too.

        Raises:
            ObservationError: the frame is another one.
            IntrinsicsError: the numbers are no camera's.
        """
        self.stream.take_info(message)
        for arrivals in self.arrivals.values():
            arrivals.announce(stamp_of(message))

    def listens(self, topic: str) -> bool:
        """Say whether an image that has come on a colour topic is to be taken; after a silence another topic may be."""
        now = self._clock()
        if self.topic != topic and (self.topic is None or now - self._heard > SILENCE):
            self.topic = topic
            self._images.reset(COLOR)
            self.stream.video.reset()
        if self.topic == topic:
            self._heard = now
        return self.topic == topic

    def take_color(self, topic: str, message: Any, spare: float = math.inf) -> list[Stamped]:
        """Take a colour image; return the whole ones, each an `RgbdImage`, none while its depth has not come.

        Args:
            topic: of the image.
            message: a sensor_msgs/Image or CompressedImage.
            spare: time for which the process had nothing to do before it took the message [s].

        Raises:
            SyncError: no depth image came for an earlier image, and every one needs its own.
            ObservationError: its frame is another one.
            ImageError: it cannot be used, or the intrinsics are not known yet.
        """
        if not self.listens(topic):
            return []
        stamp = stamp_of(message)
        self.arrivals[COLOR].take(stamp, spare)
        camera = self.stream.known_camera(self._parameters.info_topic)
        color = self.stream.read_color(message)
        image = RgbdImage(stamp=SECOND * stamp, color=color, depth=None, camera=camera, is_video=is_packet(message))
        taken = Stamped(stamp, image)
        self._learn_period(taken.stamp)
        if self._alone:
            self.alone += 1
            return [taken]
        self._images.add(COLOR, taken.stamp, taken.value)
        found, waiting = self._match(), self._images.entries(COLOR)
        if found or not self._has_waited(waiting[0].stamp, taken.stamp):
            return found
        if self._parameters.depth == ALIGNED:
            raise self._missing_depth(waiting.popleft().stamp)
        self._alone = True
        self.alone += 1
        self.passed += len(waiting) - 1
        self._images.reset(COLOR)
        return [taken]

    def take_depth(self, message: Any, spare: float = math.inf) -> list[Stamped]:
        """Take a depth image; return the images that are whole with it, as `take_color`.

        Raises:
            ObservationError: its frame is another one.
            ImageError: it cannot be used.
        """
        stamp = stamp_of(message)
        self.arrivals[DEPTH].take(stamp, spare)
        depth = self.stream.read_depth(message)
        is_empty = self._parameters.depth == AUTO and not np.isfinite(depth).any()
        self._delays.append(max(0, max(self._stamps, default=stamp) - stamp))
        self._alone &= self._is_late
        self._images.add(DEPTH, stamp, None if is_empty else depth)
        return self._match()

    def _learn_period(self, stamp: int) -> None:
        """Take the stamp of a colour image [ns] for the camera's period, of which depth may be half away."""
        if self._stamps and stamp <= self._stamps[-1]:
            return
        self._stamps.append(stamp)
        if math.isnan(self._parameters.sync_tolerance) and len(self._stamps) > _KNOWN:
            self._tolerance = pairing_tolerance(self._stamps)
            self._images.tolerance = self._tolerance

    def _has_waited(self, first: int, newest: int) -> bool:
        """Say whether the first colour image that waits has waited long enough, given the newest [ns]."""
        if len(self._images.entries(COLOR)) > _MOST_WAITING:
            return True
        own = _WAITING * median_period(self._stamps) if len(self._stamps) > _KNOWN else self._longest_wait
        return newest - first > min(own + max(self._delays, default=0), self._longest_wait)

    @property
    def _longest_wait(self) -> float:
        """Time that an image may wait for its depth [ns]."""
        return min(_WAITING_SHARE.get(self._parameters.depth, 1.0) * self.max_age, _LONGEST_WAIT) / SECOND

    @property
    def _is_late(self) -> bool:
        """True if most of the last depth images came later than their colour images may wait."""
        return bool(self._delays) and median(self._delays) > self._longest_wait

    @property
    def delay_of_depth(self) -> str:
        """Consequence of depth that comes too late, in words; empty while it comes in time."""
        if not self._is_late:
            return ""
        late, wait = (f"{1e3 * SECOND * time:.0f} ms" for time in (median(self._delays), self._longest_wait))
        used = "images are answered without depth" if self._parameters.depth == AUTO else "images are not answered"
        cause = f"which waits {wait} as max_age is {self.max_age:g} s"
        return f"depth images come {late} after their colour image, {cause}: {used}"

    def _match(self) -> list[Stamped]:
        """Return the newest colour image that has its depth, after the one before whose depth must have been lost."""
        pair = self._images.newest_pair(COLOR, DEPTH)
        if pair is None:
            return []
        color, depth = pair
        waiting, lost = self._images.entries(COLOR), []
        while (first := waiting.popleft()) is not color:
            lost.append(first)
        depths = self._images.entries(DEPTH)
        while depths[0] is not depth:  # its own one may belong to the next image, too
            depths.popleft()
        # more of them, and images come faster than they are looked at
        alone = lost[-1:] if self._parameters.depth == AUTO else []
        self.passed += len(lost) - len(alone)
        self.alone += len(alone) + (depth.value is None)
        delay = SECOND * (depth.stamp - color.stamp)
        return [*alone, Stamped(color.stamp, replace(color.value, depth=depth.value, depth_delay=delay))]

    def _missing_depth(self, stamp: int) -> SyncError:
        """Return the error of a colour image [ns] that has waited long enough."""
        if self._is_late:
            return SyncError(self.delay_of_depth)
        nearest = self._images.nearest(DEPTH, stamp)
        if nearest is None:
            return SyncError(
                f"colour images come, but no depth image on {self._parameters.depth_topic}; "
                "start the camera with align_depth.enable:=true, or the detector with depth:=none"
            )
        return SyncError(
            f"no depth image within {1e3 * SECOND * self._tolerance:.3g} ms of the colour image at "
            f"{SECOND * stamp:.3f} s, the nearest lies {1e3 * SECOND * abs(nearest.stamp - stamp):.1f} ms away; start "
            "the camera with enable_sync:=true or raise sync_tolerance"
        )
