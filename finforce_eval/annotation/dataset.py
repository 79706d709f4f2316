"""LeRobot datasets on disk, layouts v2.0, v2.1 and v3.0: their episodes, and the pictures of one.

v2: a Parquet file and a video per episode and camera, episodes and their statistics in JSON lines. v3: files of many
episodes, whose rows and times stand in a Parquet table of episodes.

Source: the formats as LeRobot 0.1 to 0.4 writes and reads them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from finforce.camera import MILLIMETRE, CameraIntrinsics, ImageError, decode_picture
from finforce.errors import one_line
from finforce.files import FileError, parse_json, read_json, read_text
from finforce.messages import NANOSECONDS
from finforce.optional import import_library
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.recordings.images import StampedImage
from finforce_keypoints.images import RgbdImage, check_image

INFO, STATS = Path("meta/info.json"), Path("meta/stats.json")
EPISODES_V2, EPISODE_STATS_V2 = Path("meta/episodes.jsonl"), Path("meta/episodes_stats.jsonl")
EPISODES_V3 = Path("meta/episodes")
_LARGEST_LINES = 1 << 28  # bytes; a line per episode
_VERSIONS = ("v2.0", "v2.1", "v3.0")


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode.

    Attributes:
        index: its number.
        length: frames.
        data: its Parquet file.
        video: of the camera, None where pictures stand in the Parquet file.
        begin: time of its first frame in the video [s].
    """

    index: int
    length: int
    data: Path
    video: Path | None
    begin: float


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """A dataset as its `meta/info.json` describes it.

    Attributes:
        folder: of the dataset.
        info: content of `meta/info.json`.
        camera: the feature with the pictures of the wrist camera.
        episodes: in their order.
    """

    folder: Path
    info: Mapping[str, Any]
    camera: str
    episodes: tuple[Episode, ...]

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the pictures; raises RecordingError where the dataset does not say."""
        shape = list(self.info["features"][self.camera].get("shape") or ())
        if len(shape) != 3 or 3 not in shape or not all(isinstance(side, int) and side > 0 for side in shape):
            raise RecordingError(f"{self.folder.name}: {self.camera} has the shape {shape}; expected height, width, 3")
        return (shape[1], shape[2]) if shape[0] == 3 else (shape[0], shape[1])


def is_dataset(path: Path) -> bool:
    """Say whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file()


def open_dataset(folder: Path, camera: str = "") -> Dataset:
    """Return a dataset of which nothing but its descriptions is read.

    Args:
        folder: with `meta/info.json`.
        camera: the feature with the pictures; "" for the only one, or the only one with "wrist" in its name.

    Raises:
        RecordingError: its layout is another one, or a file is missing or damaged.
        OptionError: the camera is not known, or there are several.
    """
    info = _read_info(folder)
    camera = _choose_camera(info, camera, folder.name)
    entries = _read_entries_v3(folder) if info["codebase_version"] == "v3.0" else _read_entries_v2(folder)
    try:
        episodes = tuple(_make_episode(folder, info, camera, entry) for entry in entries)
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        raise RecordingError(
            f"{folder.name}: an episode lacks what its layout has: {type(error).__name__}: {error}"
        ) from error
    total = sum(episode.length for episode in episodes)
    if total != info["total_frames"]:
        raise RecordingError(
            f"{folder.name}: its {len(episodes)} episodes have {total} frames; expected the {info['total_frames']} of "
            f"{INFO}"
        )
    return Dataset(folder=folder, info=info, camera=camera, episodes=episodes)


def _read_info(folder: Path) -> dict[str, Any]:
    """Return `meta/info.json` of a layout that is known."""
    try:
        info = read_json(folder / INFO)
        version, paths = info["codebase_version"], [info["data_path"], info.get("video_path") or ""]
        is_sound = isinstance(info["features"], dict) and all(isinstance(path, str) for path in paths)
        is_sound = is_sound and 0 < float(info["fps"]) < 1e4 and int(info["total_frames"]) >= 0
    except (FileError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{folder.name}: {INFO}: {type(error).__name__}: {error}") from error
    if version not in _VERSIONS:
        raise RecordingError(f"{folder.name}: layout {version}; expected {', '.join(_VERSIONS)}")
    if not is_sound:
        raise RecordingError(f"{folder.name}: {INFO}: expected features, fps, total_frames and paths of the files")
    return info


def _choose_camera(info: Mapping[str, Any], camera: str, name: str) -> str:
    """Return the feature with the pictures."""
    kinds = {key: feature.get("dtype") for key, feature in info["features"].items() if isinstance(feature, dict)}
    there = [key for key, kind in kinds.items() if kind in ("video", "image")]
    wrist = [key for key in there if "wrist" in key]
    found = [camera] if camera else (wrist if len(wrist) == 1 else there)
    if len(found) != 1 or found[0] not in there:
        words = f"--images {camera}: " if camera else "which camera sees the jaws? "
        raise OptionError(f"{name}: {words}expected --images with one of {', '.join(there) or 'none, it has none'}")
    return found[0]


def _read_entries_v2(folder: Path) -> list[dict[str, Any]]:
    """Return what a dataset of layout v2 says of each episode."""
    try:
        lines = read_text(folder / EPISODES_V2, _LARGEST_LINES).splitlines()
        return [parse_json(line) for line in lines if line.strip()]
    except FileError as error:
        raise RecordingError(f"{folder.name}: {EPISODES_V2}: {error}") from error


def _read_entries_v3(folder: Path) -> list[dict[str, Any]]:
    """Return what a dataset of layout v3 says of each episode, but for its statistics."""
    entries = []
    for path in sorted((folder / EPISODES_V3).glob("*/*.parquet")):
        table = read_parquet(path)
        entries += table.select([name for name in table.column_names if not name.startswith("stats/")]).to_pylist()
    if not entries:
        raise RecordingError(f"{folder.name}: no episodes in {EPISODES_V3}")
    return sorted(entries, key=lambda entry: entry["episode_index"])


def _make_episode(folder: Path, info: Mapping[str, Any], camera: str, entry: Mapping[str, Any]) -> Episode:
    """Return one episode; its files need not be there."""
    index, is_video = int(entry["episode_index"]), info["features"][camera]["dtype"] == "video"
    head, begin = f"videos/{camera}/", 0.0
    data = {"episode_chunk": index // int(info.get("chunks_size") or 1000), "episode_index": index}
    video = {**data, "video_key": camera}
    if info["codebase_version"] == "v3.0":
        data |= {name: entry[f"data/{name}"] for name in ("chunk_index", "file_index")}
        if is_video:
            video |= {name: entry[f"{head}{name}"] for name in ("chunk_index", "file_index")}
            begin = float(entry[f"{head}from_timestamp"])
    return Episode(
        index=index,
        length=int(entry["length"]),
        data=folder / info["data_path"].format(**data),
        video=folder / info["video_path"].format(**video) if is_video else None,
        begin=begin,
    )


def read_parquet(path: Path) -> pa.Table:
    """Return a Parquet file, rows in the groups that it has; raises RecordingError where it is missing or damaged."""
    try:
        return pq.ParquetFile(path).read()
    except (OSError, pa.ArrowException) as error:
        raise RecordingError(f"{path.parent.name}/{path.name}: {one_line(error)}") from error


def rows_of(table: pa.Table, episode: Episode, name: str) -> pa.Table:
    """Return the rows of an episode in a table of its file.

    Raises:
        RecordingError: they are not as many as the episode is long.
    """
    if "episode_index" in table.column_names:
        table = table.filter(pc.equal(table["episode_index"], episode.index))
    if len(table) != episode.length:
        raise RecordingError(f"{name}: {len(table)} rows; expected {episode.length}, the length of the episode")
    return table


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
    frame_id: str = "camera_color_optical_frame"
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

    colors_alone = all_colors

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
        rows = rows_of(read_parquet(self.episode.data), self.episode, self.name)
        for number, cell in enumerate(rows[self.feature]):
            stored: Any = cell.as_py()
            data, what = stored, f"{self.name}: frame {number} of {self.feature}"
            if isinstance(stored, dict):
                data = stored.get("bytes")
            if not isinstance(data, bytes):
                raise RecordingError(f"{what} is no picture")
            try:
                picture = decode_picture(data, what, formats=None)
            except ImageError as error:
                raise RecordingError(str(error)) from error
            yield picture
