"""LeRobot datasets on disk, layouts v2.0, v2.1 and v3.0: their episodes, and the pictures of one.

v2: a Parquet file and a video per episode and camera, episodes and their statistics in JSON lines. v3: files of many
episodes, whose rows and times stand in a Parquet table of episodes.

Source: the formats as LeRobot 0.1 to 0.4 writes and reads them.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, Field

from finforce.camera import CameraIntrinsics, ImageError, decode_picture
from finforce.errors import one_line
from finforce.files import FileError, check_inside, check_plain, parse_json, raise_budget, read_json, read_text
from finforce.sandbox import MEMORY, limit_growth
from finforce.typed_yaml import FileModel, parse_model
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.recordings.bags import allowed_bytes
from finforce_eval.recordings.frames import FrameImages, Rate, choose_camera, decode_video
from finforce_eval.recordings.images import ImageChoice
from finforce_eval.recordings.tracks import Recording

pa.set_memory_pool(pa.system_memory_pool())  # the default one takes a gigabyte at once, which no limit tells from use
INFO, STATS = Path("meta/info.json"), Path("meta/stats.json")
EPISODES_V2, EPISODE_STATS_V2 = Path("meta/episodes.jsonl"), Path("meta/episodes_stats.jsonl")
EPISODES_V3 = Path("meta/episodes")
_LARGEST_LINES = 1 << 26  # bytes; a line per episode
_VERSIONS = ("v2.0", "v2.1", "v3.0")
_BYTES_PER_CELL = 8  # of a table, once it is read
_MOST_FRAMES = 1_000_000  # of an episode: nine hours at 30 Hz
# what stands for the numbers of an episode and its files in the paths of `info.json`
_NUMBER = re.compile(r"\{(episode_chunk|episode_index|chunk_index|file_index|video_key)(:0?[1-9]d)?\}")


class _Feature(FileModel):
    """An entry of `features`."""

    model_config = ConfigDict(extra="ignore")
    dtype: str = Field(description="Type of its values")
    shape: list[Annotated[int, Field(strict=True, ge=0)]] | None = Field(None, description="Sides of one value")
    info: dict[str, Any] | None = Field(None, description="What programs keep there")


class _Info(FileModel):
    """Required entries of `meta/info.json`; an empty number stands for its default."""

    model_config = ConfigDict(extra="ignore")
    features: dict[str, _Feature] = Field(description="By name")
    fps: Rate = Field(description="Frames per second [Hz]")
    total_frames: int = Field(strict=True, ge=0, description="Of all episodes")
    chunks_size: Annotated[int, Field(strict=True, ge=1), BeforeValidator(lambda size: size or 1000)] = Field(
        1000, description="Episodes in a folder"
    )


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


def read_episode(folder: Path, choice: ImageChoice, sides: Sequence[str] = ()) -> Recording:
    """Return one episode of a dataset as a recording of two jaws, or of those that are named.

    Raises:
        RecordingError: the dataset cannot be read, or has no such episode.
        OptionError: its camera is not described.
    """
    dataset = open_dataset(folder, choice.color)
    episode = next((each for each in dataset.episodes if each.index == choice.episode), None)
    if episode is None:
        numbers = [each.index for each in dataset.episodes]
        raise RecordingError(f"{folder.name}: no episode {choice.episode}; expected {min(numbers)} to {max(numbers)}")
    return recording_of(dataset, episode, choose_camera(choice, dataset.image_size, folder.name), sides)


def recording_of(dataset: Dataset, episode: Episode, camera: CameraIntrinsics, sides: Sequence[str] = ()) -> Recording:
    """Return an episode as a recording whose jaws are still to be found."""
    name, fps = f"{dataset.folder.name}/episode_{episode.index:06d}", float(dataset.info["fps"])
    _check_times(episode, fps, name)
    if episode.video is not None:
        own = episode.length if dataset.info["codebase_version"] != "v3.0" else None  # else a file of many episodes
        read = partial(decode_video, episode.video, name, episode.begin - 0.5 / fps, own, fps=fps)
    else:
        read = partial(_read_column, episode, dataset.camera, name)
    images = FrameImages(
        name=name, fps=fps, camera=camera, count=episode.length, read=read, is_video=episode.video is not None
    )
    return images.make_recording(episode.data, sides)


def _check_times(episode: Episode, fps: float, name: str) -> None:
    """Refuse rows whose times are not those of the pictures; raises RecordingError.

    LeRobot pairs both by time, and forces go by their numbers.
    """
    if not episode.data.exists():
        return
    rows = read_parquet(episode.data, ("timestamp", "episode_index"))
    if "timestamp" not in rows.column_names:
        return
    times = rows_of(rows, episode, name)["timestamp"]
    try:
        late = times.to_numpy().astype(float) - np.arange(len(times)) / fps
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{name}: its column timestamp: {one_line(error)}; expected seconds") from error
    off = np.flatnonzero(~(np.abs(late - late[0]) < 0.5 / fps))
    if len(off):
        raise RecordingError(
            f"{name}: the times of its rows and those of its pictures, at {fps:g} Hz, differ by "
            f"{late[off[0]] - late[0]:.3f} s from row {off[0]} on"
        )


def is_dataset(path: Path) -> bool:
    """Say whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file()


def open_dataset(folder: Path, camera: str | None = "") -> Dataset:
    """Return a dataset of which nothing but its descriptions is read.

    Args:
        folder: with `meta/info.json`.
        camera: the feature with the pictures; "" for the only one, or the only one with "wrist" in its name; None where
            pictures are not needed.

    Raises:
        RecordingError: its layout is another one, or a file is missing or damaged.
        OptionError: the camera is not known, or there are several.
    """
    info = _read_info(folder)
    camera = "" if camera is None else _choose_camera(info, camera, folder.name)
    try:
        entries = _read_entries_v3(folder) if info["codebase_version"] == "v3.0" else _read_entries_v2(folder)
        episodes = tuple(_make_episode(folder, info, camera, entry) for entry in entries)
    except FileError as error:
        raise RecordingError(f"{folder.name}: {error}") from error
    except MemoryError as error:
        raise RecordingError(f"{folder.name}: its list of episodes takes more memory than one of its size") from error
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
        info = read_json(check_inside(folder / INFO, folder))
        version, paths = info["codebase_version"], [info["data_path"], info.get("video_path") or ""]
        is_sound = all(isinstance(path, str) for path in paths)
    except (FileError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{folder.name}: {INFO}: {type(error).__name__}: {error}") from error
    try:
        info |= parse_model(info, _Info, RecordingError).model_dump(exclude={"features"})
    except RecordingError as error:
        raise RecordingError(f"{folder.name}: {INFO}: {error}") from error
    if version not in _VERSIONS:
        raise RecordingError(f"{folder.name}: layout {version}; expected {', '.join(_VERSIONS)}")
    if not is_sound:
        raise RecordingError(f"{folder.name}: {INFO}: expected texts as the paths of its files")
    for path in paths:
        if Path(path).is_absolute() or ".." in Path(path).parts or set("{}") & set(_NUMBER.sub("", path)):
            raise RecordingError(
                f"{folder.name}: {INFO}: path {path[:80]!r}; expected one within the dataset, as "
                "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
            )
    return info


def _choose_camera(info: Mapping[str, Any], camera: str, name: str) -> str:
    """Return the feature with the pictures."""
    pictures = {key: feature for key, feature in info["features"].items() if feature["dtype"] in ("video", "image")}
    there = [key for key, feature in pictures.items() if 3 in (feature.get("shape") or (3,))]  # no depth maps
    there = there or list(pictures)
    wrist = [key for key in there if "wrist" in key]
    found = [camera] if camera else (wrist if len(wrist) == 1 else there)
    if len(found) != 1 or found[0] not in there:
        words = f"--color {camera}: " if camera else "which camera sees the jaws? "
        raise OptionError(f"{name}: {words}expected --color with one of {', '.join(there) or 'none, it has none'}")
    return found[0]


def _read_entries_v2(folder: Path) -> list[dict[str, Any]]:
    """Return what a dataset of layout v2 says of each episode."""
    try:
        lines = read_text(check_inside(folder / EPISODES_V2, folder), _LARGEST_LINES).splitlines()
        return [parse_json(line) for line in lines if line.strip()]
    except FileError as error:
        raise RecordingError(f"{folder.name}: {EPISODES_V2}: {error}") from error


def _read_entries_v3(folder: Path) -> list[dict[str, Any]]:
    """Return what a dataset of layout v3 says of each episode, but for its statistics."""
    entries = []
    for path in sorted((folder / EPISODES_V3).glob("*/*.parquet")):
        table = read_parquet(check_inside(path, folder))
        with limit_growth(raise_budget(MEMORY)):
            entries += table.select([name for name in table.column_names if not name.startswith("stats/")]).to_pylist()
    if not entries:
        raise RecordingError(f"{folder.name}: no episodes in {EPISODES_V3}")
    return sorted(entries, key=lambda entry: entry["episode_index"])


def _make_episode(folder: Path, info: Mapping[str, Any], camera: str, entry: Mapping[str, Any]) -> Episode:
    """Return one episode; its files need not be there."""
    index, is_video = int(entry["episode_index"]), bool(camera) and info["features"][camera]["dtype"] == "video"
    head, begin = f"videos/{camera}/", 0.0
    data = {"episode_chunk": index // info["chunks_size"], "episode_index": index}
    video = {**data, "video_key": camera}
    if info["codebase_version"] == "v3.0":
        data |= {name: entry[f"data/{name}"] for name in ("chunk_index", "file_index")}
        if is_video:
            video |= {name: entry[f"{head}{name}"] for name in ("chunk_index", "file_index")}
            begin = float(entry[f"{head}from_timestamp"])
    length = int(entry["length"])
    if not 0 < length <= _MOST_FRAMES:
        raise ValueError(f"{length} frames; expected 1 to {_MOST_FRAMES}")
    return Episode(
        index=index,
        length=length,
        data=check_inside(folder / info["data_path"].format(**data), folder),
        video=check_inside(folder / info["video_path"].format(**video), folder) if is_video else None,
        begin=begin,
    )


def read_parquet(path: Path, columns: Collection[str] = ()) -> pa.Table:
    """Return a Parquet file or some of its columns; raises RecordingError where it is missing or damaged.

    The rows are in the groups that the file has.
    """
    try:
        check_plain(path)
        file, allowed = pq.ParquetFile(path), allowed_bytes(path)
        groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
        parts = [each.column(number) for each in groups for number in range(each.num_columns)]
        cells = sum(part.num_values for part in parts if not columns or part.path_in_schema in columns)
        if _BYTES_PER_CELL * cells > allowed:
            raise MemoryError
        with limit_growth(allowed):
            wanted = [name for name in columns if name in file.schema_arrow.names] if columns else None
            return file.read(columns=wanted, use_threads=False)
    except MemoryError as error:
        what = f"takes more than {allowed_bytes(path) >> 20} MB of memory, far more than its size allows for"
        raise RecordingError(f"{path.parent.name}/{path.name}: {what}") from error
    except (FileError, OSError, pa.ArrowException) as error:
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


def _read_column(episode: Episode, feature: str, name: str) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures (h, w, 3) RGB that stand in a column of an episode's rows."""
    rows = rows_of(read_parquet(episode.data), episode, name)
    for number, cell in enumerate(rows[feature]):
        stored: Any = cell.as_py()
        data, what = stored, f"{name}: frame {number} of {feature}"
        if isinstance(stored, dict):
            data = stored.get("bytes")
        if not isinstance(data, bytes):
            raise RecordingError(f"{what} is not an image")
        try:
            picture = decode_picture(data, what, formats=None)
        except ImageError as error:
            raise RecordingError(str(error)) from error
        yield picture
