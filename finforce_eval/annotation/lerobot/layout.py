"""Where things lie in a LeRobot dataset on disk, layouts v2.0, v2.1 and v3.0.

v2: a Parquet file and a video per episode and camera, episodes and their statistics in JSON lines. v3: files of many
episodes, whose rows and times stand in a Parquet table of episodes.

Source: the formats as LeRobot 0.1 to 0.4 writes and reads them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from finforce.errors import one_line
from finforce.files import FileError, parse_json, read_json, read_text
from finforce.optional import import_library
from finforce_eval.errors import OptionError, RecordingError

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
    def name(self) -> str:
        """The folder's name."""
        return self.folder.name

    @property
    def is_v3(self) -> bool:
        """Whether files hold many episodes."""
        return self.info["codebase_version"].startswith("v3")

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.info["fps"])


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
    chosen = _choose_camera(info, camera, folder.name)
    described = _describe_v3(folder, info, chosen) if info["codebase_version"] == "v3.0" else _describe_v2(folder)
    episodes = tuple(_episode(folder, info, chosen, entry) for entry in described)
    total = sum(episode.length for episode in episodes)
    if total != info["total_frames"]:
        raise RecordingError(
            f"{folder.name}: its {len(episodes)} episodes have {total} frames; expected the {info['total_frames']} of "
            f"{INFO}"
        )
    return Dataset(folder=folder, info=info, camera=chosen, episodes=episodes)


def _read_info(folder: Path) -> dict[str, Any]:
    """Return `meta/info.json` of a layout that is known."""
    try:
        info = read_json(folder / INFO)
        version = info["codebase_version"]
        is_known = version in _VERSIONS
        sound = isinstance(info["features"], dict) and 0 < float(info["fps"]) < 1e4 and int(info["total_frames"]) >= 0
        paths = [info["data_path"], info.get("video_path") or ""]
        sound = sound and all(isinstance(path, str) for path in paths)
    except (FileError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{folder.name}: {INFO}: {type(error).__name__}: {error}") from error
    if not is_known:
        raise RecordingError(f"{folder.name}: layout {version}; expected {', '.join(_VERSIONS)}")
    if not sound:
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


def _describe_v2(folder: Path) -> list[dict[str, Any]]:
    """Return number and length of each episode."""
    try:
        lines = read_text(folder / EPISODES_V2, _LARGEST_LINES).splitlines()
        entries = [parse_json(line) for line in lines if line.strip()]
        return [{"episode_index": int(each["episode_index"]), "length": int(each["length"])} for each in entries]
    except (FileError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{folder.name}: {EPISODES_V2}: {type(error).__name__}: {error}") from error


def _describe_v3(folder: Path, info: Mapping[str, Any], camera: str) -> list[dict[str, Any]]:
    """Return number, length and place of each episode."""
    is_video = info["features"][camera]["dtype"] == "video"
    names = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    if is_video:
        names += [f"videos/{camera}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    entries = []
    for path in sorted((folder / EPISODES_V3).glob("*/*.parquet")):
        entries += read_table(path, names).to_pylist()
    if not entries:
        raise RecordingError(f"{folder.name}: no episodes in {EPISODES_V3}")
    return sorted(entries, key=lambda entry: entry["episode_index"])


def _episode(folder: Path, info: Mapping[str, Any], camera: str, entry: Mapping[str, Any]) -> Episode:
    """Return one episode; its files need not be there."""
    index, is_video = entry["episode_index"], info["features"][camera]["dtype"] == "video"
    chunk = index // int(info.get("chunks_size") or 1000)
    data = {"episode_chunk": chunk, "episode_index": index}
    video = {**data, "video_key": camera}
    if info["codebase_version"] == "v3.0":
        data |= {"chunk_index": entry["data/chunk_index"], "file_index": entry["data/file_index"]}
        if is_video:
            video |= {name: entry[f"videos/{camera}/{name}"] for name in ("chunk_index", "file_index")}
    try:
        paths = info["data_path"].format(**data), info["video_path"].format(**video) if is_video else ""
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise RecordingError(f"{folder.name}: {INFO}: a path cannot be filled in: {error}") from error
    return Episode(
        index=index,
        length=entry["length"],
        data=folder / paths[0],
        video=folder / paths[1] if is_video else None,
        begin=float(entry.get(f"videos/{camera}/from_timestamp", 0.0)),
    )


def read_table(path: Path, names: list[str] | None = None) -> Any:
    """Return a Parquet file as a table of pyarrow, some of its columns or all.

    Raises:
        RecordingError: it is missing or damaged, or a column is missing.
        MissingDependencyError: pyarrow is not installed.
    """
    pyarrow, parquet = import_arrow(), import_arrow("pyarrow.parquet")
    try:
        return parquet.ParquetFile(path).read(columns=names)
    except (OSError, pyarrow.ArrowException, KeyError) as error:
        raise RecordingError(f"{path.parent.name}/{path.name}: {one_line(error)}") from error


def import_arrow(module: str = "pyarrow") -> ModuleType:
    """Return pyarrow or one of its modules; raises MissingDependencyError where it is not installed."""
    return import_library(module, "reading and writing LeRobot datasets", "'finforce[lerobot]'")
