"""Claims about files from anywhere: damaged ones are read or refused, harmful ones are refused."""

import functools
import os
import pickle
import shutil
import sqlite3
import struct
import zlib
from contextlib import closing
from pathlib import Path

import meshio
import numpy as np
import pyarrow
import pytest
import trimesh
from eval_fakes import make_recording, pack_mcap
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from keypoint_scene_fakes import Fake, write_model
from PIL import Image
from pyarrow import parquet
from zstandard import ZstdCompressor

import finforce_ifea
import finforce_keypoints
from finforce.errors import FinforceError
from finforce_contact.mesh.object_mesh import load_object_mesh
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.dataset import read_parquet
from finforce_eval.recordings.frames import decode_video
from finforce_eval.recordings.image_files import read_depth, read_image, read_intrinsics
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.jaw.mesh_file import ClampRule, read_volume_mesh
from finforce_keypoints.networks.metadata import read_metadata
from finforce_keypoints.networks.runtime import try_network

JAWS, MODELS = Path(finforce_ifea.__file__).parent / "jaw", Path(finforce_keypoints.__file__).parent / "models"
BOX = trimesh.creation.box((0.03, 0.04, 0.05))


def make_image(path):
    Image.effect_noise((64, 48), 40).convert("RGB").save(path)


def make_bag(path, compression):
    pack_mcap(write_recording(make_recording(frames=80), path.parent / "plain"), path, compression)


def make_database(path):
    plain = write_recording(make_recording(frames=80), path.parent / "plain", storage="sqlite3")
    shutil.copyfile(next(plain.glob("*.db3")), path)


def make_depth(path):
    np.save(path, np.full((12, 16), 0.3, np.float32))


def make_volume(path):
    mesh = load_jaw("bench").build_mesh("coarse")
    meshio.write(path, meshio.Mesh(mesh.nodes, [("hexahedron", mesh.elements)]))


def make_network(path):
    write_model(path.parent / "made", Fake())
    shutil.copyfile(path.parent / "made" / "network.onnx", path)


def copy_of(source):
    return functools.partial(shutil.copyfile, source)


# name of the file: what makes a good one, what reads it
FILES = {
    "jaw.yaml": (copy_of(JAWS / "jaws" / "bench.yaml"), load_jaw),
    "calibration.yaml": (copy_of(JAWS / "calibrations" / "bench.yaml"), load_calibration),
    "pytorch_config.yaml": (copy_of(MODELS / "plane" / "pytorch_config.yaml"), read_metadata),
    "box.stl": (BOX.export, load_object_mesh),
    "box.ply": (BOX.export, load_object_mesh),
    "box.obj": (BOX.export, load_object_mesh),
    "image.png": (make_image, read_image),
    "image.jpg": (make_image, read_image),
    "depth.npy": (make_depth, read_depth),
    "k.json": (
        lambda path: path.write_text('{"fx": 430.0, "fy": 430.0, "cx": 320.0, "cy": 240.0, "D": [0, 0, 0, 0, 0]}'),
        lambda path: read_intrinsics([str(path)], (480, 640)),
    ),
}
# read in a process of their own, a second for each
SLOW = {
    "plain.mcap": (functools.partial(make_bag, compression=""), read_recording),
    "zstd.mcap": (functools.partial(make_bag, compression="zstd"), read_recording),
    "bag.db3": (make_database, read_recording),
    "box.glb": (BOX.export, load_object_mesh),
    "finger.vtu": (make_volume, lambda path: read_volume_mesh(path, clamp=ClampRule(z_below=0.001))),
    "network.onnx": (make_network, lambda path: try_network(path, "test")),
}
PLACE = st.floats(0.0, 1.0, exclude_max=True)
CHANGES = st.lists(
    st.one_of(
        st.tuples(st.just("set"), PLACE, st.binary(min_size=1, max_size=8)),
        st.tuples(st.just("insert"), PLACE, st.binary(min_size=1, max_size=40)),
        st.tuples(st.sampled_from(("cut", "drop", "double")), PLACE, st.just(b"")),
    ),
    min_size=1,
    max_size=3,
)


def damage(content, changes):
    """Return bytes with changes, each at its share of the length."""
    for kind, share, data in changes:
        at = int(share * len(content))
        part = content[at : at + max(1, len(content) // 20)]
        rest = {
            "set": data + content[at + len(data) :],
            "insert": data + content[at:],
            "cut": b"",
            "drop": content[at + len(part) :],
            "double": part + content[at:],
        }[kind]
        content = content[:at] + rest
    return content


@pytest.fixture(scope="module", params=FILES)
def good(request, tmp_path_factory):
    """A good file that can be read, its content, and what reads it."""
    make, read = FILES[request.param]
    path = tmp_path_factory.mktemp("good") / request.param
    make(path)
    read(path)
    return path, path.read_bytes(), read


def read_or_refuse(path, content, read):
    path.write_bytes(content)
    try:
        read(path)
    except FinforceError as error:
        assert str(error)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=CHANGES)
def test_a_damaged_file_is_read_or_refused(good, changes):
    path, content, read = good
    read_or_refuse(path, damage(content, changes), read)


@pytest.mark.parametrize("name", SLOW)
def test_a_damaged_file_that_is_read_aside_is_read_or_refused(tmp_path, monkeypatch, name):
    monkeypatch.setenv("FINFORCE_CACHE", str(tmp_path / "cache"))
    make, read = SLOW[name]
    make(tmp_path / name)
    read(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    for changes in ([("cut", 0.7, b"")], [("set", 0.3, b"\xff" * 8)]):
        read_or_refuse(tmp_path / name, damage(content, changes), read)


def make_endless_view(path, table):
    """Write a database whose messages never end, or hold a gigabyte."""
    endless = (
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM n) SELECT i id, 1 topic_id, i timestamp FROM n"
    )
    with closing(sqlite3.connect(path)) as base:
        base.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
            " offered_qos_profiles TEXT, type_description_hash TEXT);"
            "INSERT INTO topics VALUES (1, '/left/keypoints', 'x', 'cdr', '', '');" + table.format(endless=endless)
        )


def make_png(path, side):
    """Write a picture that announces more pixels than it holds."""

    def part(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = part(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
    data = part(b"IDAT", zlib.compress(bytes(1 << 20), 9))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + data + part(b"IEND", b""))


def make_bomb(path):
    """Write a recording whose chunk unpacks to a gigabyte, and announces a hundred bytes."""
    records = ZstdCompressor().compress(bytes(1 << 30))
    chunk = struct.pack("<QQQII", 0, 1, 100, 0, 4) + b"zstd" + struct.pack("<Q", len(records)) + records
    path.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(chunk)) + chunk + b"\x89MCAP0\r\n")


def make_planted_code(path):
    """Write a pickle, as numba caches code, that would make a file."""

    class Planted:
        def __reduce__(self):
            return Path.touch, (path.with_suffix(".ran"),)

    path.write_bytes(pickle.dumps(Planted()))


def make_stored_pickle(path):
    np.savez(path, np.array([{"a": 1}], dtype=object))


def make_video_list(path):
    """Write a list of videos, which FFmpeg would follow, in place of one."""
    path.with_suffix(".ts").write_bytes(bytes(188))
    path.write_text(f"ffconcat version 1.0\nfile {path.with_suffix('.ts').name}\n")


def make_playlist(path):
    path.write_text("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:9/x.ts\n#EXT-X-ENDLIST\n")


def read_video(path):
    return list(decode_video(path, path.name))


def make_parquet_bomb(path):
    """Write a table of a few bytes that unpacks to some gigabytes."""
    column = pyarrow.DictionaryArray.from_arrays(np.zeros(1 << 24, np.int32), pyarrow.array(["x" * 256]))
    parquet.write_table(pyarrow.table({f"c{number}": column for number in range(16)}), path)


def make_pickle(path):
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)


ALIASES = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{','.join(['*' + before] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
HARMFUL = {
    "aliases.yaml": (lambda path: path.write_text(ALIASES), load_jaw),
    "nested.yaml": (lambda path: path.write_text("a: " + "[" * 5000 + "]" * 5000), load_calibration),
    "object.yaml": (lambda path: path.write_text("!!python/object/apply:os.system ['true']"), load_calibration),
    "nested.json": (lambda path: path.write_text('{"fx":' * 100_000 + "1" + "}" * 100_000), FILES["k.json"][1]),
    "view.db3": (lambda path: make_endless_view(path, "CREATE VIEW messages AS {endless}"), read_recording),
    "computed.db3": (
        lambda path: make_endless_view(
            path,
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
            " data BLOB AS (zeroblob(1000000000))); INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)",
        ),
        read_recording,
    ),
    "length.mcap": (
        lambda path: path.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, 1 << 63) + bytes(100)),
        read_recording,
    ),
    "bomb.mcap": (make_bomb, read_recording),
    "huge.png": (functools.partial(make_png, side=100_000), read_image),
    "pickle.npy": (make_pickle, read_depth),
    "pickle.npz": (make_stored_pickle, read_depth),
    "planted.npy": (make_planted_code, read_depth),
    "list.mp4": (make_video_list, read_video),
    "playlist.mp4": (make_playlist, read_video),
    "bomb.parquet": (make_parquet_bomb, read_parquet),
}


@pytest.mark.parametrize("name", HARMFUL)
def test_a_harmful_file_is_refused(tmp_path, name):
    make, read = HARMFUL[name]
    make(tmp_path / name)
    with pytest.raises(FinforceError):
        read(tmp_path / name)
    assert not list(tmp_path.glob("*.ran"))


def test_a_list_of_videos_opens_none_of_them(tmp_path):
    from lerobot_fakes import write_video

    write_video(tmp_path / "real.mp4", [np.full((48, 64, 3), 90, np.uint8)] * 3)
    assert len(read_video(tmp_path / "real.mp4")) == 3
    (tmp_path / "list.mp4").write_text("ffconcat version 1.0\nfile real.mp4\n")
    with pytest.raises(RecordingError, match="expected a video"):
        read_video(tmp_path / "list.mp4")


@pytest.mark.parametrize(
    ("name", "read"),
    [("jaw.yaml", load_jaw), ("depth.npz", read_depth), ("depth.npy", read_depth), ("video.mp4", read_video)],
)
def test_a_pipe_is_not_waited_for(tmp_path, name, read):
    os.mkfifo(tmp_path / name)
    with pytest.raises(FinforceError):
        read(tmp_path / name)
