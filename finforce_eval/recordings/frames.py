"""Pictures without messages: frames of videos, folders of pictures, and the recordings that they are."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from finforce.camera import MILLIMETRE, CameraIntrinsics, ImageError, decode_picture
from finforce.files import FileError, check_plain, read_bytes
from finforce.gripper_frames import SIDES
from finforce.messages import NANOSECONDS
from finforce.optional import import_library
from finforce.typed_yaml import Number
from finforce.video_packets import STRICT
from finforce_eval.errors import DamagedError, OptionError, RecordingError
from finforce_eval.recordings.bags import list_pictures
from finforce_eval.recordings.image_files import read_intrinsics
from finforce_eval.recordings.images import ImageChoice, StampedImage
from finforce_eval.recordings.tracks import JawTrack, KeypointTrack, Recording, Timed, WrenchTrack
from finforce_keypoints.images import RgbdImage, check_image

LEAST_RATE = 1e-2  # [Hz] of frames
MOST_RATE = 1e4  # [Hz] of frames
Rate = Annotated[Number, Field(ge=LEAST_RATE, le=MOST_RATE)]
DELAY = 16  # frames from one to those that it may be predicted from: codecs reorder no more
STILL_RATE = 1.0  # Hz of pictures that say nothing of their times
LARGEST_PICTURE = 1 << 27  # bytes
# What FFmpeg may take a file for: nothing that names other files, as its lists and playlists do.
_ALONE = {"format_whitelist": "mov,mp4,m4a,3gp,matroska,webm,avi", "protocol_whitelist": "file"}


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameImages(Timed):
    """Pictures that are decoded one by one when they are iterated over. See `ImageTrack`, whose part it takes.

    Attributes:
        name: of the recording, for messages.
        fps: frames per second.
        camera: intrinsics.
        count: of all frames.
        read: begins anew to yield all frames, (h, w, 3) RGB, None for those that are broken and left out.
        times: (count,) of the frames [ns]; None where they follow each other at `fps` from zero on.
        is_video: True if they are those of a camera that ran, compressed, whose still pictures are alike.
        ends_at_damage: True if the frames before the first damaged one are read, if there are any.
        frames: (n,) numbers of those to be read, rising; None for all.
        depth_scale: without meaning.
    """

    name: str
    fps: float
    camera: CameraIntrinsics
    count: int
    read: Callable[[], Iterable[NDArray[np.uint8] | None]]
    times: NDArray[np.int64] | None = None
    is_video: bool = True
    ends_at_damage: bool = False
    frames: NDArray[np.int64] | None = None
    depth_scale: float = MILLIMETRE
    frame_id: str = "camera_color_optical_frame"
    topics: tuple[str, str] = ("", "")
    info: str = ""
    has_depth: bool = False

    def __len__(self) -> int:
        return self.count if self.frames is None else len(self.frames)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the frames (n,) [ns]."""
        frames = np.arange(self.count) if self.frames is None else self.frames
        return np.rint(frames * (NANOSECONDS / self.fps)).astype(np.int64) if self.times is None else self.times[frames]

    def at(self, stamps: NDArray[np.int64]) -> FrameImages:
        """Return the frames at some stamps [ns]."""
        everything = np.arange(self.count) if self.frames is None else self.frames
        return replace(self, frames=everything[np.isin(self.stamps_ns, stamps)])

    def all_colors(self) -> FrameImages:
        """Return them all."""
        return self

    colors_alone = all_colors

    def make_recording(
        self,
        path: Path,
        sides: Sequence[str],
        truth: Mapping[str, WrenchTrack] | None = None,
        notes: Sequence[str] = (),
    ) -> Recording:
        """Return the pictures as a recording of two jaws, or of those that are named, which are still to be found."""
        truth = truth or {}
        jaws = {side: JawTrack(keypoints=KeypointTrack.empty(), truth=truth.get(side)) for side in sides or SIDES}
        return Recording(name=self.name, path=path, jaws=jaws, images=self, notes=tuple(notes))

    def __iter__(self) -> Iterator[StampedImage]:
        """Decode the frames in their order.

        Raises:
            RecordingError: a frame is missing or damaged, or of another size than its camera.
        """
        frames = range(len(self)) if self.frames is None else self.frames.tolist()
        wanted, count = dict(zip(frames, self.stamps_ns.tolist(), strict=True)), 0
        try:
            for frame, color in enumerate(self.read()):
                if frame in wanted:
                    stamp, count = wanted[frame], count + 1
                if frame in wanted and color is not None:
                    image = RgbdImage(
                        stamp=stamp / NANOSECONDS, color=color, depth=None, camera=self.camera, is_video=self.is_video
                    )
                    try:
                        check_image(image)
                    except ImageError as error:
                        raise RecordingError(f"{self.name}: frame {frame}: {error}") from error
                    yield StampedImage(stamp, image)
                if count == len(wanted):
                    return
        except DamagedError:
            if not (count and self.ends_at_damage):
                raise
            return
        raise RecordingError(f"{self.name}: {count} pictures; expected {len(wanted)}")


@contextmanager
def _open_video(path: Path, name: str) -> Iterator[tuple[Any, Any]]:
    """Open a video, container and stream of PyAV, for the length of a `with` block.

    Raises:
        RecordingError: it is no video.
        DamagedError: it is damaged.
        MissingDependencyError: PyAV is not installed.
    """
    av = import_library("av", "reading videos", "'finforce[video]'")
    where = f"{name}: {path.parent.name}/{path.name}"
    try:
        check_plain(path)
        container = av.open(str(path), options=_ALONE)
        stream = container.streams.video[0]
    except (FileError, av.FFmpegError, IndexError) as error:
        raise RecordingError(f"{where}: {error}; expected a video") from error
    with container:
        stream.codec_context.options = {"err_detect": STRICT}
        stream.codec_context.thread_count = 1
        try:
            yield container, stream
        except av.FFmpegError as error:
            raise DamagedError(f"{where}: damaged: {error}") from error


def decode_video(
    path: Path,
    name: str,
    begin: float = 0.0,
    count: int | None = None,
    shown: Sequence[int] = (),
    fps: float | None = None,
) -> Iterator[NDArray[np.uint8] | None]:
    """Yield the frames (h, w, 3) RGB of a video from a time [s] on, upright; see `_open_video`.

    In place of frames that are broken or that the decoder leaves out, of those to be `shown` (n,) [ticks], comes None.

    A video that says of itself that it has another number of frames than `count` is refused, too, and one with a frame
    that begins over a quarter of a period off its time at a rate `fps` [Hz]; `begin` is half a period before the first.
    """
    number = 0
    with _open_video(path, name) as (container, stream):
        if count is not None and stream.frames not in (0, count):
            raise RecordingError(f"{name}: {path.name} has {stream.frames} frames; expected {count}, one for each row")
        if begin > 0.0:
            container.seek(int(begin / stream.time_base), stream=stream)
        for frame, is_broken in _decode_checked(container, stream, shown, f"{name}: {path.name}"):
            time = frame.time if frame is not None else None
            if time is not None and time < begin:
                continue
            due = begin + (number + 0.5) / fps if fps else None
            if due is not None and time is not None and abs(time - due) > 0.25 / fps:
                raise RecordingError(
                    f"{name}: frame {number} of {path.name} is shown at {time:.3f} s; expected {due:.3f} s, the time "
                    "of its row, after from_timestamp where an episode has one"
                )
            number += 1
            if is_broken:
                yield None
            else:
                color = frame.to_ndarray(format="rgb24")
                turns = round(frame.rotation / 90.0) % 4
                yield np.ascontiguousarray(np.rot90(color, turns)) if turns else color
    if fps and not number:
        raise RecordingError(f"{name}: {path.name} ends before {begin + 0.5 / fps:.3f} s, its from_timestamp")


def _decode_checked(container: Any, stream: Any, shown: Sequence[int], where: str) -> Iterator[tuple[Any, bool]]:
    """Yield the frames of a video and whether each is broken: near one that is left out, up to the next key frame.

    A frame of those to be `shown` (n,) [ticks] that does not come is None, and broken. Frames are shown before others
    that they are predicted from, and show late that data is not what it was: those shortly before a broken one are
    taken for broken, too.

    Raises:
        DamagedError: the decoder finds a frame damaged.
    """
    waiting: deque[tuple[Any, bool]] = deque()
    is_broken, expected = False, deque(shown)
    for number, frame in enumerate(container.decode(stream)):
        is_key, left_out = bool(frame.key_frame), 0
        if frame.is_corrupt:
            raise DamagedError(f"{where}: damaged: a frame is made of what others left")
        while expected and expected.popleft() < frame.pts:
            left_out += 1
        if number and left_out:
            waiting = deque((each, True) for each, _ in waiting)
        is_broken = not is_key and (is_broken or (number > 0 and left_out > 0))
        waiting += [(None, True)] * left_out + [(frame, is_broken)]
        while len(waiting) > DELAY:
            yield waiting.popleft()
    yield from waiting
    yield from ((None, True) for _ in expected)


def _list_shown(container: Any, stream: Any) -> NDArray[np.int64] | None:
    """Return when the frames of a video are shown (n,) [ticks], rising; None where it does not say so."""
    packets = [each for each in container.demux(stream) if each.size and not each.is_discard and not each.is_corrupt]
    if not packets or any(each.pts is None for each in packets):
        return None
    shown = np.sort([each.pts for each in packets])
    return shown if (np.diff(shown) > 0).all() else None


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Return a jpeg or png file as (h, w, 3) RGB; raises RecordingError where it is none."""
    try:
        return decode_picture(read_bytes(path, LARGEST_PICTURE), path.name)
    except (FileError, ImageError) as error:
        raise RecordingError(f"{path.name}: {error}; expected a picture, jpeg or png") from error


def _read_pictures(paths: Sequence[Path]) -> Iterator[NDArray[np.uint8]]:
    """Yield pictures (h, w, 3); raises RecordingError where one has another size than the first."""
    size = None
    for path in paths:
        picture = read_picture(path)
        height, width = picture.shape[:2]
        size = size or (width, height)
        if (width, height) != size:
            raise RecordingError(
                f"{path.name}: {width} x {height}; expected {size[0]} x {size[1]} as {paths[0].name} has: turned, "
                "or of another camera? leave it out"
            )
        yield picture


def read_frames(path: Path, choice: ImageChoice, sides: Sequence[str] = ()) -> Recording:
    """Return a video or a folder of pictures as a recording whose jaws are still to be found.

    Raises:
        RecordingError: it cannot be read.
        OptionError: nothing says what its camera is.
        RigError: the rig is of another camera.
    """
    name, times = path.name if path.is_dir() else path.stem, None
    if path.is_dir():
        paths = list_pictures(path)
        fps, count, shape = STILL_RATE, len(paths), read_picture(paths[0]).shape[:2]
        read = partial(_read_pictures, paths)
    else:
        with _open_video(path, name) as (container, stream):
            fps, shown = float(stream.average_rate or 0.0), _list_shown(container, stream)
            tick = float(stream.time_base) * NANOSECONDS
            count = stream.frames if shown is None else len(shown)
        if not (count and LEAST_RATE <= fps <= MOST_RATE):
            raise RecordingError(f"{name}: {path.name}: {count} frames at {fps:g} Hz; expected a video")
        if shown is not None:
            times = np.rint((shown - shown[0]) * tick).astype(np.int64)
        read = partial(decode_video, path, name, shown=() if shown is None else shown.tolist())
        first = next((color for color in read() if color is not None), None)
        if first is None:
            raise RecordingError(f"{name}: {path.name}: no frame is whole; expected a video: convert it to an .mp4")
        shape = first.shape[:2]
    camera = choose_camera(choice, shape, name)
    images = FrameImages(
        name=name, fps=fps, camera=camera, count=count, read=read, times=times, ends_at_damage=not path.is_dir()
    )
    return images.make_recording(path, sides)


def choose_camera(choice: ImageChoice, shape: tuple[int, int], name: str) -> CameraIntrinsics:
    """Return the camera of images (h, w) that say nothing of it.

    Raises:
        OptionError: neither a rig nor intrinsics were given, or they are of other images; a topic was chosen.
    """
    for option, topic in (("--depth", choice.depth), ("--camera-info", choice.info)):
        if topic:
            raise OptionError(f"{name}: {option} {topic}: only bags have such topics")
    if choice.camera is not None and not choice.intrinsics:
        if (choice.camera.height, choice.camera.width) != shape:
            raise OptionError(
                f"{name}: pictures of {shape[1]} x {shape[0]}; expected {choice.camera.width} x {choice.camera.height} "
                "as the rig has: another camera, or cut or scaled? make a rig of these by finforce camera"
            )
        return choice.camera
    if not choice.intrinsics:
        raise OptionError(
            f"{name}: pictures do not describe their camera; expected --rig of finforce camera, or --intrinsics with "
            "fx fy cx cy or a file"
        )
    return read_intrinsics(choice.intrinsics, shape, is_cut=choice.is_cut)
