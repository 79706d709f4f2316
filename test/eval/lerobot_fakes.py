"""LeRobot datasets as small as they can be, in both layouts."""

import json

import av
import numpy as np
import pyarrow
from pyarrow import parquet

CAMERA = "observation.images.wrist"
FPS = 30


def write_video(path, pictures, rate=FPS):
    """An H.264 video of pictures (h, w, 3)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": "12", "g": "10"})
        stream.height, stream.width, stream.pix_fmt = *pictures[0].shape[:2], "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def write_dataset(folder, episodes, version="v2.1"):
    """A dataset of episodes, each a list of pictures; `version` is v2.1 or v3.0."""
    lengths = [len(pictures) for pictures in episodes]
    height, width = episodes[0][0].shape[:2]
    info = {
        "codebase_version": version,
        "robot_type": "gen3",
        "total_episodes": len(episodes),
        "total_frames": sum(lengths),
        "total_tasks": 1,
        "chunks_size": 1000,
        "fps": FPS,
        "splits": {"train": f"0:{len(episodes)}"},
        "features": {
            CAMERA: {
                "dtype": "video",
                "shape": [height, width, 3],
                "names": ["height", "width", "channels"],
                "info": {"video.fps": FPS, "video.codec": "h264", "video.pix_fmt": "yuv420p", "has_audio": False},
            },
            "observation.state": {"dtype": "float32", "shape": [2], "names": ["a", "b"]},
            **{name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _INDICES.items()},
        },
    }
    tables = [_rows(index, sum(lengths[:index]), length) for index, length in enumerate(lengths)]
    stats = [_stats(table) for table in tables]
    (_write_v3 if version == "v3.0" else _write_v2)(folder, info, episodes, tables, stats)
    (folder / "meta/info.json").write_text(json.dumps(info))
    (folder / "README.md").write_text("A dataset.\n")


_INDICES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def _rows(episode, begin, count):
    state = np.random.default_rng(episode).normal(size=2 * count).astype(np.float32)
    features = {name: {"dtype": kind, "_type": "Value"} for name, kind in _INDICES.items()}
    features["observation.state"] = {"feature": {"dtype": "float32", "_type": "Value"}, "length": 2, "_type": "List"}
    table = pyarrow.table(
        {
            "observation.state": pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(state), 2),
            "timestamp": pyarrow.array((np.arange(count) / FPS).astype(np.float32)),
            "frame_index": pyarrow.array(np.arange(count)),
            "episode_index": pyarrow.array(np.full(count, episode)),
            "index": pyarrow.array(begin + np.arange(count)),
            "task_index": pyarrow.array(np.zeros(count, np.int64)),
        }
    )
    return table.replace_schema_metadata({"huggingface": json.dumps({"info": {"features": features}})})


def _stats(table):
    state = np.array(table["observation.state"].to_pylist())
    own = {name: getattr(state, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    return {"observation.state": {**own, "count": [len(state)]}}


def _write_v2(folder, info, episodes, tables, stats):
    info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info["video_path"] = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    for part in ("meta", "data/chunk-000"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    lines = [json.dumps({"episode_index": n, "tasks": ["hold"], "length": len(t)}) for n, t in enumerate(tables)]
    (folder / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n")
    (folder / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "hold"}) + "\n")
    lines = [json.dumps({"episode_index": n, "stats": each}) for n, each in enumerate(stats)]
    (folder / "meta/episodes_stats.jsonl").write_text("\n".join(lines) + "\n")
    for number, (pictures, table) in enumerate(zip(episodes, tables, strict=True)):
        write_video(
            folder / info["video_path"].format(episode_chunk=0, video_key=CAMERA, episode_index=number), pictures
        )
        parquet.write_table(table, folder / info["data_path"].format(episode_chunk=0, episode_index=number))


def _write_v3(folder, info, episodes, tables, stats):
    info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    info |= {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
    for part in ("meta/episodes/chunk-000", "data/chunk-000"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    ends = np.cumsum([len(table) for table in tables])
    entries = []
    for number, (table, end) in enumerate(zip(tables, ends.tolist(), strict=True)):
        begin = end - len(table)
        own = {f"stats/observation.state/{kind}": values for kind, values in stats[number]["observation.state"].items()}
        entries.append(
            {
                "episode_index": number,
                "tasks": ["hold"],
                "length": len(table),
                "data/chunk_index": 0,
                "data/file_index": 0,
                "dataset_from_index": begin,
                "dataset_to_index": end,
                f"videos/{CAMERA}/chunk_index": 0,
                f"videos/{CAMERA}/file_index": 0,
                f"videos/{CAMERA}/from_timestamp": begin / FPS,
                f"videos/{CAMERA}/to_timestamp": end / FPS,
                **own,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
    parquet.write_table(pyarrow.Table.from_pylist(entries), folder / "meta/episodes/chunk-000/file-000.parquet")
    tasks = pyarrow.table({"task_index": [0], "__index_level_0__": ["hold"]})
    index = {"name": None, "field_name": "__index_level_0__", "pandas_type": "unicode", "numpy_type": "object"}
    pandas = {
        "index_columns": ["__index_level_0__"],
        "column_indexes": [],
        "columns": [index | {"metadata": None}],
        "pandas_version": "2.0.0",
    }
    parquet.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(pandas)}), folder / "meta/tasks.parquet")
    whole = pyarrow.concat_tables(tables)
    parquet.write_table(whole, folder / info["data_path"].format(chunk_index=0, file_index=0))
    write_video(folder / info["video_path"].format(video_key=CAMERA, chunk_index=0, file_index=0), sum(episodes, []))
    (folder / "meta/stats.json").write_text(json.dumps(_stats(whole)))
