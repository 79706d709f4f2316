"""The pictures of one episode of a LeRobot dataset as the images of a recording, without depth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import MILLIMETRE, CameraIntrinsics, ImageError
from finforce.optional import import_library
from finforce.stamps import NANOSECONDS
from finforce_eval.annotation.lerobot.layout import Episode, import_arrow, read_table
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.images import StampedImage
from finforce_keypoints.images import RgbdImage, check_image

FRAME = "camera_color_optical_frame"


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeImages:
    """Pictures of an episode; iterating decodes them. See `ImageTrack`, whose part it takes.

    Attributes:
        episode: whose pictures they are.
        name: of the episode, for messages.
        feature: the column with the pictures, where there is no video.
        fps: frames per second.
        camera: intrinsics.
        depth_scale: without meaning.
    """

    episode: Episode
    name: str
    feature: str
    fps: float
    camera: CameraIntrinsics
    depth_scale: float = MILLIMETRE
    frame_id: str = FRAME
    topics: tuple[str, str] = ("", "")
    has_depth: bool = False

    def __len__(self) -> int:
        return self.episode.length

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Stamps of the frames (n,) [ns], from zero."""
        return np.rint(np.arange(len(self)) * (NANOSECONDS / self.fps)).astype(np.int64)

    def all_colors(self) -> EpisodeImages:
        """Return them all."""
        return self

    def colors_alone(self) -> EpisodeImages:
        """Return them all."""
        return replace(self)

    def __iter__(self) -> Iterator[StampedImage]:
        """Decode the frames in their order.

        Raises:
            RecordingError: a frame is missing or damaged, or of another size than its camera.
        """
        count = 0
        pictures = self._read_video() if self.episode.video is not None else self._read_column()
        for stamp, color in zip(self.stamps.tolist(), pictures, strict=False):
            image = RgbdImage(stamp=stamp / NANOSECONDS, color=color, depth=None, camera=self.camera)
            try:
                check_image(image)
            except ImageError as error:
                raise RecordingError(f"{self.name}: frame {count}: {error}") from error
            yield StampedImage(stamp, image)
            count += 1
        if count < len(self):
            raise RecordingError(f"{self.name}: {count} pictures; expected {len(self)}, the length of the episode")

    def _read_video(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the frames of the video from the beginning of the episode."""
        av = import_library("av", "reading videos", "'finforce[lerobot]'")
        video = self.episode.video
        if not video.is_file():
            raise RecordingError(f"{self.name}: no video {video.parent.name}/{video.name}")
        try:
            with av.open(str(video)) as container:
                stream = container.streams.video[0]
                early = self.episode.begin - 0.5 / self.fps
                if early > 0.0:
                    container.seek(int(early / stream.time_base), stream=stream)
                for frame in container.decode(stream):
                    if frame.time is None or frame.time >= early:
                        yield frame.to_ndarray(format="rgb24")
        except (av.FFmpegError, IndexError) as error:
            raise RecordingError(f"{self.name}: {video.parent.name}/{video.name}: {error}") from error

    def _read_column(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the pictures that stand in the episode's rows."""
        import cv2

        for number, cell in enumerate(rows_of(read_table(self.episode.data), self.episode, self.name)[self.feature]):
            stored: Any = cell.as_py()
            data = stored.get("bytes") if isinstance(stored, dict) else stored
            picture = None
            if isinstance(data, bytes) and data:
                picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            if picture is None:
                raise RecordingError(f"{self.name}: frame {number} of {self.feature} is no picture")
            yield cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def rows_of(table: Any, episode: Episode, name: str) -> Any:
    """Return the rows of an episode in a table of its file.

    Raises:
        RecordingError: they are not as many as the episode is long.
    """
    chosen = (
        table.filter(import_arrow("pyarrow.compute").equal(table["episode_index"], episode.index))
        if "episode_index" in table.column_names
        else table
    )
    if len(chosen) != episode.length:
        raise RecordingError(f"{name}: {len(chosen)} rows; expected {episode.length}, the length of the episode")
    return chosen
