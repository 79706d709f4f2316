"""Files that do harm, and good ones that were damaged, by kind: how each is made, and how each is read.

A kind gives its good files, crafted ones, and what reads them. `mutate` damages any file by bytes, fields and lengths.
"""

from __future__ import annotations

import io
import json
import random
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ABSURD = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 31, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)
WORDS = (
    "-1",
    "0",
    "1e300",
    "-1e300",
    ".nan",
    ".inf",
    "9" * 5000,
    "null",
    "true",
    "[]",
    "{}",
    "abc",
    "13",
    "2019-13-41",
    "[[[[[[[[[[1]]]]]]]]]]",
    "0x7fffffffffffffff",
    "1e-320",
    "~",
    "''",
    "&a [*a]",
    "!!python/object:os.system x",
)
MEGABYTE = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of file.

    Attributes:
        name: of the kind.
        make: writes good files into a folder and returns them.
        read: reads a file as the product does, and returns what was found, where it can be compared.
        craft: writes harmful files into a folder and yields what each is, and its place.
        cost: tries of others for which one of this is tried.
    """

    name: str
    make: Callable[[Path], list[Path]]
    read: Callable[[Path], Any]
    craft: Callable[[Path], Iterator[tuple[str, Path]]] = lambda folder: iter(())
    cost: int = 1


def mutate(content: bytes, rng: random.Random, *, text: bool) -> bytes:
    """Return damaged content: bits, lengths, words, parts that are missing, doubled or strange."""
    data = bytearray(content)
    changes = (*_CHANGES, *_TEXT_CHANGES) if text else _CHANGES
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if data:
            data = rng.choice(changes)(data, rng.randrange(len(data)), rng)
    return bytes(data)


def _flip(data: bytearray, place: int, rng: random.Random) -> bytearray:
    data[place] ^= 1 << rng.randrange(8)
    return data


def _change_byte(data: bytearray, place: int, rng: random.Random) -> bytearray:
    data[place] = rng.randrange(256)
    return data


def _cut(data: bytearray, place: int, rng: random.Random) -> bytearray:
    return data[:place]


def _change_length(data: bytearray, place: int, rng: random.Random) -> bytearray:
    size, form = rng.choice(((4, "<I"), (8, "<Q"), (2, "<H"), (4, ">I")))
    data[place : place + size] = struct.pack(form, rng.choice(ABSURD) % (1 << 8 * size))
    return data


def _take_out(data: bytearray, place: int, rng: random.Random) -> bytearray:
    del data[place : place + rng.choice((1, 4, 16, 256))]
    return data


def _double(data: bytearray, place: int, rng: random.Random) -> bytearray:
    data[place:place] = data[place : place + rng.choice((1, 8, 64, 1024))]
    return data


def _put_noise(data: bytearray, place: int, rng: random.Random) -> bytearray:
    data[place : place + 64] = rng.randbytes(rng.randrange(64))
    return data


def _put_word(data: bytearray, place: int, rng: random.Random) -> bytearray:
    return bytearray(_change_word(bytes(data), rng))


def _change_line(data: bytearray, place: int, rng: random.Random) -> bytearray:
    lines = bytes(data).splitlines(keepends=True)
    line = rng.randrange(len(lines))
    lines[line : line + 1] = rng.choice(([], [lines[line]] * 2, [b"  " + lines[line]], [lines[line].lstrip()]))
    return bytearray(b"".join(lines))


_CHANGES = (_flip, _change_byte, _cut, _change_length, _take_out, _double, _put_noise)
_TEXT_CHANGES = (_put_word, _change_line)


def _change_word(content: bytes, rng: random.Random) -> bytes:
    """Return a text of which one value is another."""
    lines = content.decode(errors="replace").splitlines(keepends=True)
    places = [number for number, line in enumerate(lines) if ":" in line or "," in line]
    if places:
        number = rng.choice(places)
        head, mark, _ = lines[number].rpartition(rng.choice((":", ",")))
        lines[number] = f"{head}{mark} {rng.choice(WORDS)}\n"
    return "".join(lines).encode()


def _write(path: Path, content: bytes | str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


# Recordings


def _read_bag(path: Path) -> Any:
    from finforce_eval.recordings.recording import read_recording

    recording = read_recording(path)
    found = {side: (track.keypoints.stamps, track.keypoints.points) for side, track in recording.jaws.items()}
    if recording.images is not None:
        for number, _ in enumerate(recording.images):
            if number >= 3:
                break
    return found, recording.notes


def _demo_part() -> Any:
    from finforce_eval.recordings.recording import DEMO, read_recording

    whole = read_recording(DEMO)
    begin = int(whole.jaws["left"].keypoints.stamps[0])
    return whole.between(begin, begin + 3 * 10**9)


def _make_mcap(compression: str) -> Callable[[Path], list[Path]]:
    def make(folder: Path) -> list[Path]:
        bag = _write_plain(folder)
        return [pack_mcap(bag, folder / "bag.mcap", compression)]

    return make


def _write_plain(folder: Path, storage: str = "mcap") -> Path:
    from finforce_eval.recordings.writer import write_recording

    target = folder / f"plain_{storage}"
    if not target.exists():
        write_recording(_demo_part(), target, storage=storage)
    return target


def pack_mcap(bag: Path, path: Path, compression: str) -> Path:
    """Write the messages of a bag as rosbag2 does: chunks with checksums."""
    from mcap.writer import CompressionType, Writer
    from rosbags.rosbag2 import Reader

    kinds = {"": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}
    with Reader(bag) as reader, path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 16, compression=kinds[compression])
        writer.start("ros2", "fuzz")
        channels = {}
        for each in reader.connections:
            schema = writer.register_schema(each.msgtype, "ros2msg", each.msgdef.data.encode())
            channels[each.id] = writer.register_channel(each.topic, "cdr", schema)
        for each, time, data in reader.messages():
            writer.add_message(channels[each.id], time, bytes(data), time)
        writer.finish()
    return path


def _make_sqlite(folder: Path) -> list[Path]:
    return [next(_write_plain(folder, "sqlite3").glob("*.db3"))]


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def _bomb_chunk(compression: str, content: bytes, size: int) -> bytes:
    return _record(
        6, struct.pack("<QQQI", 0, 1, size, 0) + _text(compression) + struct.pack("<Q", len(content)) + content
    )


def _compress(compression: str, size: int) -> bytes:
    """Return the compressed form of many zeros."""
    if compression == "lz4":
        import lz4.frame

        packer = lz4.frame.LZ4FrameCompressor()
        parts = [packer.begin()]
        parts += [packer.compress(bytes(MEGABYTE)) for _ in range(size // MEGABYTE)]
        return b"".join([*parts, packer.flush()])
    from rosbags.rosbag2 import storage_mcap

    packer = storage_mcap.zstd.ZstdCompressor(level=19)
    parts = [packer.compress(bytes(MEGABYTE)) for _ in range(size // MEGABYTE)]
    return b"".join([*parts, packer.flush()])


def _craft_mcap(folder: Path) -> Iterator[tuple[str, Path]]:
    magic = b"\x89MCAP0\r\n"
    header = _record(1, _text("ros2") + _text("bomb"))
    schema = _record(3, struct.pack("<H", 1) + _text("std_msgs/msg/String") + _text("ros2msg") + _text("string data"))
    qos = _text("offered_qos_profiles") + _text(
        "a: &a [x,x,x,x,x,x,x,x,x]\n"
        + "".join(f"{chr(98 + n)}: &{chr(98 + n)} [{','.join(['*' + chr(97 + n)] * 9)}]\n" for n in range(9))
    )
    plain = _record(4, struct.pack("<HH", 1, 1) + _text("/bench/phase") + _text("cdr") + struct.pack("<I", 0))
    bomb = _record(4, struct.pack("<HH", 2, 1) + _text("/x") + _text("cdr") + struct.pack("<I", len(qos)) + qos)
    foot = _record(2, bytes(20)) + magic
    start = magic + header + schema + plain
    for compression in ("zstd", "lz4"):
        packed = _compress(compression, 3 << 30)
        yield (
            f"a chunk of 3 GB, {compression}",
            _write(folder / f"big_{compression}.mcap", start + _bomb_chunk(compression, packed, 3 << 30) + foot),
        )
        yield (
            f"a chunk of 3 GB that says 1 kB, {compression}",
            _write(folder / f"lie_{compression}.mcap", start + _bomb_chunk(compression, packed, 1000) + foot),
        )
        yield (
            f"a torn chunk of 3 GB, {compression}",
            _write(folder / f"torn_{compression}.mcap", start + _bomb_chunk(compression, packed, 3 << 30)[:-500]),
        )
        many = _bomb_chunk(compression, _compress(compression, 64 * MEGABYTE), 64 * MEGABYTE)
        yield (
            f"200 chunks of 64 MB, {compression}",
            _write(folder / f"many_{compression}.mcap", start + 200 * many + foot),
        )
    for power in (31, 32, 40, 63):
        head = struct.pack("<BQ", 6, 1 << power)
        yield f"a chunk length of 2^{power}", _write(folder / f"length{power}.mcap", start + head + bytes(100) + foot)
        head = struct.pack("<BQ", 5, 1 << power)
        yield (
            f"a message length of 2^{power}",
            _write(folder / f"message{power}.mcap", start + head + bytes(100) + foot),
        )
        head = struct.pack("<BQ", 1, 1 << power)
        yield f"a header length of 2^{power}", _write(folder / f"header{power}.mcap", magic + head + bytes(100) + foot)
    yield "a QoS bomb in a channel", _write(folder / "qos.mcap", start + bomb + foot)
    yield "a million schemas", _write(folder / "schemas.mcap", start + 1_000_000 * schema + foot)
    yield "an index of chunks that are not there", _write(folder / "index.mcap", _lying_index(start, 1 << 40))
    yield "an index of a chunk of 3 GB", _write(folder / "index2.mcap", _lying_index(start, 3 << 30))
    words = _text("/left/keypoints")
    tiny = _record(5, struct.pack("<HIQQ", 1, 0, 0, 0) + b"\x00\x01\x00\x00\x01\x00\x00\x00\x00")
    content = tiny * (90 * MEGABYTE // len(tiny))
    packed = _pack_zstd(content)
    yield (
        "two million messages in a few kB",
        _write(folder / "messages.mcap", start + _bomb_chunk("zstd", packed, len(content)) + foot),
    )
    yield "nothing", _write(folder / "empty.mcap", b"")
    yield "magic alone", _write(folder / "magic.mcap", magic + words)


def _pack_zstd(content: bytes) -> bytes:
    from rosbags.rosbag2 import storage_mcap

    return storage_mcap.zstd.compress(content)


def _lying_index(start: bytes, size: int) -> bytes:
    chunk = _bomb_chunk("", b"", 0)
    index = struct.pack("<QQQQ", 0, 1, len(start), len(chunk)) + struct.pack("<I", 10) + struct.pack("<HQ", 1, 1 << 50)
    index += struct.pack("<Q", 1 << 50) + _text("") + struct.pack("<QQ", size, size)
    summary = len(start) + len(chunk)
    foot = _record(2, struct.pack("<QQI", summary, 0, 0)) + b"\x89MCAP0\r\n"
    return start + chunk + _record(8, index) + foot


def _craft_sqlite(folder: Path) -> Iterator[tuple[str, Path]]:
    columns = "serialization_format TEXT, offered_qos_profiles TEXT, type_description_hash TEXT"
    topics = f"CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, {columns})"
    numbers = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM n)"
    endless = f"{numbers} SELECT i id, 1 topic_id, i timestamp, zeroblob(1000) data FROM n"
    stamped = "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER"
    for name, script in {
        "a view without end": f"CREATE VIEW messages AS {endless}",
        "a computed column of a GB": f"CREATE TABLE messages({stamped}, data BLOB AS (zeroblob(1000000000)))",
        "a view beside the table": f"CREATE TABLE messages({stamped}, data BLOB); CREATE VIEW schema AS {endless}",
        "no rows": f"CREATE TABLE messages({stamped}, data BLOB)",
    }.items():
        path = folder / f"{name.replace(' ', '_')}.db3"
        with closing(sqlite3.connect(path)) as base:
            base.executescript(
                f"{topics}; INSERT INTO topics VALUES (1, '/left/keypoints', 'x', 'cdr', '', ''); {script}"
            )
            if "computed" in name:
                base.execute("INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)")
            base.commit()
        yield name, path
    path = folder / "sparse.db3"
    with path.open("wb") as file:
        file.write(b"SQLite format 3\0" + struct.pack(">H", 4096) + bytes(10) + struct.pack(">I", 1 << 31))
        file.truncate(1 << 40)
    yield "a sparse file of a TB", path


def _make_folder(folder: Path) -> list[Path]:
    return [_write_plain(folder) / "metadata.yaml"]


def _read_folder(path: Path) -> Any:
    bag = path.parent / f"{path.name}_bag"
    if not bag.exists():
        plain = next(each for each in path.parent.parent.rglob("plain_mcap") if each.is_dir())
        shutil.copytree(plain, bag)
    shutil.copyfile(path, bag / "metadata.yaml")
    try:
        return _read_bag(bag)
    finally:
        shutil.rmtree(bag, ignore_errors=True)


def _craft_yaml(start: str) -> Callable[[Path], Iterator[tuple[str, Path]]]:
    """Return what writes YAML bombs where a file of a kind has a known key."""

    def craft(folder: Path) -> Iterator[tuple[str, Path]]:
        nine = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
            f"{chr(98 + n)}: &{chr(98 + n)} [{','.join(['*' + chr(97 + n)] * 9)}]\n" for n in range(9)
        )
        yield "a thousand million laughs", _write(folder / "laughs.yaml", f"{nine}{start}: *j\n")
        yield "nested lists", _write(folder / "lists.yaml", f"{start}: {'[' * 1000}{']' * 1000}\n")
        yield "nested maps", _write(folder / "maps.yaml", f"{start}: {'{a: ' * 1000}1{'}' * 1000}\n")
        yield "5,000 digits", _write(folder / "digits.yaml", f"{start}: {'9' * 5000}\n")
        yield "keys of several types", _write(folder / "keys.yaml", f"{start}: {{1: a, b: c, null: d, [1, 2]: e}}\n")
        yield "month 13", _write(folder / "month.yaml", f"{start}: 2020-13-41\n")
        yield "an object", _write(folder / "object.yaml", f"{start}: !!python/object/apply:os.system ['true']\n")
        yield "a merge of itself", _write(folder / "merge.yaml", f"{start}: &a\n  <<: *a\n")
        yield "20 MB", _write(folder / "large.yaml", f"{start}: [{'1, ' * 7_000_000}1]\n")
        yield "no text", _write(folder / "bytes.yaml", b"\xff\xfe\x00\x01" * 100)
        yield "a tab", _write(folder / "tab.yaml", f"{start}:\t\t- 1\n")

    return craft


def _shipped(*names: str) -> Callable[[Path], list[Path]]:
    """Return what copies shipped files, and all beside them."""

    def make(folder: Path) -> list[Path]:
        root, found = Path(__file__).resolve().parents[2], []
        for name in names:
            source = root / name
            for other in source.parent.iterdir():
                if other.is_file() and other.stat().st_size < 3 * MEGABYTE:
                    shutil.copyfile(other, folder / other.name)
            found.append(folder / source.name)
        return found

    return make


def _read_jaw(path: Path) -> Any:
    from finforce_ifea.jaw.jaw import load_jaw

    jaw = load_jaw(path)
    return jaw.name


def _read_calibration(path: Path) -> Any:
    from finforce_ifea.jaw.calibration import load_calibration

    return load_calibration(path)


def _read_metadata(path: Path) -> Any:
    from finforce_keypoints.networks.metadata import read_metadata

    return read_metadata(path)


def _read_case(path: Path) -> Any:
    from finforce_eval.recordings.recording import _read_case

    return _read_case(path)


def _read_mesh(path: Path) -> Any:
    from finforce_contact.mesh.object_mesh import load_object_mesh

    return len(load_object_mesh(path).triangles)


def _make_glb(folder: Path) -> list[Path]:
    import trimesh

    box = trimesh.creation.box((0.03, 0.04, 0.05))
    return [_write(folder / "box.glb", box.export(file_type="glb"))]


def _make_meshes(folder: Path) -> list[Path]:
    import trimesh

    box = trimesh.creation.box((0.03, 0.04, 0.05))
    return [_write(folder / f"box.{kind}", box.export(file_type=kind)) for kind in ("stl", "ply", "obj")]


def _craft_glb(folder: Path) -> Iterator[tuple[str, Path]]:
    def glb(tree: Mapping[str, Any], binary: bytes = b"") -> bytes:
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        binary += bytes(-len(binary) % 4)
        body = struct.pack("<II", len(text), 0x4E4F534A) + text
        body += struct.pack("<II", len(binary), 0x004E4942) + binary if binary else b""
        return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body

    def tree(**changes: Any) -> dict[str, Any]:
        base = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
            "accessors": [
                {"componentType": 5126, "count": 4, "type": "VEC3", "bufferView": 0},
                {"componentType": 5125, "count": 12, "type": "SCALAR", "bufferView": 1},
            ],
            "bufferViews": [
                {"buffer": 0, "byteOffset": 0, "byteLength": 48},
                {"buffer": 0, "byteOffset": 48, "byteLength": 48},
            ],
            "buffers": [{"byteLength": 96}],
        }
        return base | changes

    data = np.array([[0, 0, 0], [0.03, 0, 0], [0, 0.03, 0], [0, 0, 0.03]], "<f4").tobytes()
    data += np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], "<u4").tobytes()
    accessors = tree()["accessors"]
    crafted = {
        "as it should be": tree(),
        "a count of 1e8 without data": tree(
            accessors=[{"componentType": 5126, "count": 10**8, "type": "VEC3"}, accessors[1]]
        ),
        "a count of 1e18": tree(accessors=[accessors[0] | {"count": 10**18}, accessors[1]]),
        "a count of -1": tree(accessors=[accessors[0] | {"count": -1}, accessors[1]]),
        "a sparse accessor": tree(
            accessors=[
                {
                    "componentType": 5126,
                    "count": 10**8,
                    "type": "VEC3",
                    "sparse": {
                        "count": 1,
                        "indices": {"bufferView": 1, "componentType": 5125},
                        "values": {"bufferView": 0},
                    },
                },
                accessors[1],
            ]
        ),
        "a million instances": tree(
            nodes=[{"mesh": 0}] + [{"mesh": 0}] * 10**6, scenes=[{"nodes": list(range(10**6))}]
        ),
        "nodes in a circle": tree(nodes=[{"children": [1]}, {"children": [0]}]),
        "a tower of nodes": tree(nodes=[{"children": [n + 1]} for n in range(5000)] + [{"mesh": 0}]),
        "a URI that is a pipe": tree(buffers=[{"byteLength": 96, "uri": "pipe"}]),
        "a URI of the system": tree(buffers=[{"byteLength": 96, "uri": "../../../../../../etc/passwd"}]),
        "a device": tree(buffers=[{"byteLength": 96, "uri": "/dev/zero"}]),
        "a buffer that says 2^40": tree(buffers=[{"byteLength": 1 << 40}]),
        "a view beyond the buffer": tree(bufferViews=[{"buffer": 0, "byteOffset": 1 << 33, "byteLength": 48}] * 2),
        "text where a number is": tree(accessors=[accessors[0] | {"count": "many"}, accessors[1]]),
        "no meshes": tree(meshes=[]),
        "indices that are not there": tree(accessors=[accessors[0] | {"count": 1}, accessors[1]]),
    }
    import os

    pipe = folder / "pipe"
    if not pipe.exists():
        os.mkfifo(pipe)
    for number, (name, content) in enumerate(crafted.items()):
        yield name, _write(folder / f"crafted{number}.glb", glb(content, data))
    yield "nested JSON", _write(folder / "nested.glb", _raw_glb(b"[" * 100_000))
    yield (
        "a JSON length of 2^32",
        _write(folder / "length.glb", struct.pack("<IIIII", 0x46546C67, 2, 100, 0xFFFFFFFF, 0x4E4F534A)),
    )


def _raw_glb(text: bytes) -> bytes:
    return struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A) + text


# Networks


def _make_onnx(folder: Path) -> list[Path]:
    import onnx
    from onnx import TensorProto, helper

    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, "h", "w"])
    maps = helper.make_tensor_value_info("heatmap", TensorProto.FLOAT, None)
    weight = helper.make_tensor("w", TensorProto.FLOAT, [4, 3, 3, 3], np.zeros(108, np.float32))
    conv = helper.make_node("Conv", ["image", "w"], ["x"], pads=[1, 1, 1, 1])
    graph = helper.make_graph([conv, helper.make_node("Sigmoid", ["x"], ["heatmap"])], "g", [image], [maps], [weight])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return [
        _write(
            folder / "net.onnx", onnx._serialize(model) if hasattr(onnx, "_serialize") else model.SerializeToString()
        )
    ]


def _craft_onnx(folder: Path) -> Iterator[tuple[str, Path]]:
    from onnx import TensorProto, helper

    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, "h", "w"])
    out = helper.make_tensor_value_info("heatmap", TensorProto.FLOAT, None)

    def save(name: str, nodes: list, initializers: list = (), inputs: list = (image,), **changes: Any) -> Path:
        graph = helper.make_graph(nodes, "g", list(inputs), [out], list(initializers))
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8, **changes)
        return _write(folder / f"{name}.onnx", model.SerializeToString())

    one = helper.make_tensor("one", TensorProto.FLOAT, [1], [1.0])
    many = helper.make_tensor("many", TensorProto.INT64, [], [1 << 62])
    true = helper.make_tensor("true", TensorProto.BOOL, [], [True])
    turn = helper.make_tensor_value_info("turn", TensorProto.INT64, [])
    on = helper.make_tensor_value_info("on", TensorProto.BOOL, [])
    body = helper.make_graph(
        [helper.make_node("Identity", ["on"], ["go"])],
        "b",
        [turn, on],
        [helper.make_tensor_value_info("go", TensorProto.BOOL, [])],
    )
    loop = helper.make_node("Loop", ["many", "true"], [], body=body)
    yield "a loop for ever", save("loop", [loop, helper.make_node("Identity", ["image"], ["heatmap"])], [many, true])
    shape = helper.make_tensor("shape", TensorProto.INT64, [2], [1 << 16, 1 << 16])
    yield (
        "a constant of 16 GB",
        save("expand", [helper.make_node("Expand", ["one", "shape"], ["heatmap"])], [one, shape]),
    )
    yield "zeros of 16 GB", save("zeros", [helper.make_node("ConstantOfShape", ["shape"], ["heatmap"])], [shape])
    limits = [
        helper.make_tensor(name, TensorProto.INT64, [], [value]) for name, value in (("a", 0), ("b", 1 << 40), ("c", 1))
    ]
    yield "a range of 2^40", save("range", [helper.make_node("Range", ["a", "b", "c"], ["heatmap"])], limits)
    doubling = [helper.make_node("Concat", [f"x{n}", f"x{n}"], [f"x{n + 1}"], axis=1) for n in range(40)]
    first, last = helper.make_node("Identity", ["image"], ["x0"]), helper.make_node("Identity", ["x40"], ["heatmap"])
    yield "forty doublings", save("double", [first, *doubling, last])
    yield "a foreign operator", save("foreign", [helper.make_node("Evil", ["image"], ["heatmap"], domain="com.evil")])
    outside = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[4], data_location=TensorProto.EXTERNAL)
    outside.external_data.add(key="location", value="../../../../../../../etc/passwd")
    yield "data of the system", save("outside", [helper.make_node("Add", ["image", "w"], ["heatmap"])], [outside])
    giant = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1 << 40])
    yield "a tensor of 2^40", save("giant", [helper.make_node("Add", ["image", "w"], ["heatmap"])], [giant])
    large = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 100_000, 100_000])
    yield (
        "an input of 100,000 px",
        save("input", [helper.make_node("Identity", ["image"], ["heatmap"])], inputs=[large]),
    )
    nested = helper.make_graph([helper.make_node("Identity", ["image"], ["y"])], "n", [], [out])
    for _ in range(50):
        choice = helper.make_node("If", ["true"], ["y"], then_branch=nested, else_branch=nested)
        nested = helper.make_graph([choice], "n", [], [out]) if len(nested.SerializeToString()) < 10**6 else nested
    yield (
        "graphs in graphs",
        save("nested", [helper.make_node("If", ["true"], ["heatmap"], then_branch=nested, else_branch=nested)], [true]),
    )
    yield "a hundred thousand nodes", save("nodes", [helper.make_node("Identity", ["image"], ["heatmap"])] * 100_000)
    yield "nothing", _write(folder / "empty.onnx", b"")
    yield "no network", _write(folder / "text.onnx", b"hello" * 1000)


def _read_onnx(path: Path) -> Any:
    from finforce_keypoints.networks.network import Network

    network = Network(path, threads=1)
    return network.output_names


# Messages, pictures, arrays


def _make_cloud(folder: Path) -> list[Path]:
    fields = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("likelihood", 12, 7, 1)]
    content = {"fields": fields, "height": 1, "width": 15, "point_step": 16, "row_step": 240, "size": 240}
    return [_write(folder / "cloud.json", json.dumps(content, indent=1))]


def _read_cloud(path: Path) -> Any:
    from types import SimpleNamespace

    from finforce.errors import ObservationError
    from finforce.messages import decode_keypoints

    try:
        content = json.loads(path.read_text(encoding="utf-8", errors="replace"))
        fields = [
            SimpleNamespace(name=str(f[0]), offset=_u32(f[1]), datatype=_u32(f[2]) % 256, count=_u32(f[3]))
            for f in content["fields"]
        ]
        sizes = {name: _u32(content[name]) for name in ("height", "width", "point_step", "row_step")}
        data = np.zeros(min(_u32(content["size"]), MEGABYTE), np.uint8)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise ObservationError("no message: what carries it in this trial is damaged") from error
    return decode_keypoints(SimpleNamespace(fields=fields, data=data, is_bigendian=False, **sizes)).points.shape


def _u32(value: Any) -> int:
    return int(value) % (1 << 32)


def _craft_cloud(folder: Path) -> Iterator[tuple[str, Path]]:
    good = json.loads(_make_cloud(folder)[0].read_text())
    for number, name in enumerate(("x", "y", "z", "likelihood")):
        for field, limits in ((1, ABSURD[:6]), (2, range(12)), (3, (0, 2, 1 << 31))):
            for limit in limits:
                changed = json.loads(json.dumps(good))
                changed["fields"][number][field] = limit
                yield (
                    f"{name}: field {field} is {limit}",
                    _write(folder / f"c{number}_{field}_{limit}.json", json.dumps(changed)),
                )
    for name in ("height", "width", "point_step", "row_step"):
        for limit in ABSURD[:6]:
            yield f"{name} {limit}", _write(folder / f"{name}_{limit}.json", json.dumps(good | {name: limit}))


def _make_array(folder: Path) -> list[Path]:
    buffer = io.BytesIO()
    np.save(buffer, np.full((48, 64), 0.2, np.float32))
    return [_write(folder / "depth.npy", buffer.getvalue())]


def _craft_array(folder: Path) -> Iterator[tuple[str, Path]]:
    def npy(header: str, data: bytes = b"") -> bytes:
        text = header.encode() + b" " * (63 - len(header) % 64) + b"\n"
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) % 65536) + text + data

    for number, header in enumerate(
        (
            "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }",
            "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
            "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
            "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (3,), }",
            "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "1," * 100 + "), }",
            "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 2), }",
            "__import__('os').system('true')",
            "(" * 5000,
        )
    ):
        yield f"header {header[:50]}", _write(folder / f"h{number}.npy", npy(header, bytes(32)))
    yield "nothing", _write(folder / "empty.npy", b"")
    buffer = io.BytesIO()
    np.savez(buffer, a=np.zeros(3))
    yield "npz named npy", _write(folder / "zip.npy", buffer.getvalue())
    buffer = io.BytesIO()
    np.save(buffer, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    yield "a pickle", _write(folder / "pickle.npy", buffer.getvalue())


def _read_array(path: Path) -> Any:
    from finforce_eval.recordings.image_files import read_depth

    return read_depth(path).shape


def _make_picture(folder: Path) -> list[Path]:
    from PIL import Image

    found = []
    for kind in ("png", "jpg"):
        buffer = io.BytesIO()
        Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(buffer, format={"jpg": "jpeg"}.get(kind, kind))
        found.append(_write(folder / f"image.{kind}", buffer.getvalue()))
    return found


def _craft_picture(folder: Path) -> Iterator[tuple[str, Path]]:
    import zlib

    def png(width: int, height: int, data: bytes) -> bytes:
        def part(kind: bytes, content: bytes) -> bytes:
            return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

        head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
        return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", data) + part(b"IEND", b"")

    zeros = zlib.compress(bytes(50 * MEGABYTE), 9)
    for side in (100_000, 20_000, 2**31 - 1):
        yield f"a PNG of {side} px", _write(folder / f"{side}.png", png(side, side, zeros))
    yield "a PNG without rows", _write(folder / "none.png", png(0, 0, b""))
    yield "nothing", _write(folder / "empty.png", b"")
    yield "another ending", _write(folder / "image.xyz", b"hello")


def _read_picture(path: Path) -> Any:
    from finforce_eval.recordings.image_files import read_image

    return read_image(path).shape


def _make_intrinsics(folder: Path) -> list[Path]:
    words = {"fx": 430.0, "fy": 430.0, "cx": 320.0, "cy": 240.0, "D": [0, 0, 0, 0, 0]}
    return [
        _write(folder / "k.json", json.dumps(words, indent=1)),
        _write(folder / "k.yaml", "fx: 430\nfy: 430\ncx: 320\ncy: 240\n"),
    ]


def _read_intrinsics(path: Path) -> Any:
    from finforce_eval.recordings.image_files import read_intrinsics

    return read_intrinsics([str(path)], (480, 640))


def _craft_json(folder: Path) -> Iterator[tuple[str, Path]]:
    for depth in (60, 1000, 100_000):
        yield f"nested {depth} deep", _write(folder / f"deep{depth}.json", "[" * depth + "]" * depth)
        yield f"objects {depth} deep", _write(folder / f"map{depth}.json", '{"a":' * depth + "1" + "}" * depth)
    yield "no text", _write(folder / "bytes.json", b"\xff\xfe")
    yield "5,000 digits", _write(folder / "digits.json", '{"fx": ' + "9" * 5000 + "}")
    yield "NaN and infinity", _write(folder / "nan.json", '{"fx": NaN, "fy": Infinity, "cx": -1e999, "cy": 1}')
    yield "text for numbers", _write(folder / "text.json", '{"fx": "a", "fy": [1], "cx": {}, "cy": null}')
    yield "ragged rows", _write(folder / "ragged.json", '{"K": [[1, 2], [3], "x"]}')
    yield "40 MB", _write(folder / "large.json", "[" + "1," * 20_000_000 + "1]")


KINDS = {
    kind.name: kind
    for kind in (
        Kind(name="mcap", make=_make_mcap(""), read=_read_bag, craft=_craft_mcap, cost=4),
        Kind(name="mcap-lz4", make=_make_mcap("lz4"), read=_read_bag, cost=4),
        Kind(name="mcap-zstd", make=_make_mcap("zstd"), read=_read_bag, cost=4),
        Kind(name="sqlite", make=_make_sqlite, read=_read_bag, craft=_craft_sqlite, cost=4),
        Kind(
            name="metadata",
            make=_make_folder,
            read=_read_folder,
            craft=_craft_yaml("rosbag2_bagfile_information"),
            cost=4,
        ),
        Kind(
            name="jaw",
            make=_shipped("finforce_ifea/jaw/jaws/bench.yaml", "finforce_ifea/jaw/jaws/steel.yaml"),
            read=_read_jaw,
            craft=_craft_yaml("material"),
            cost=4,
        ),
        Kind(
            name="calibration",
            make=_shipped("finforce_ifea/jaw/calibrations/bench.yaml"),
            read=_read_calibration,
            craft=_craft_yaml("material"),
        ),
        Kind(
            name="network-config",
            make=_shipped("finforce_keypoints/models/plane/pytorch_config.yaml"),
            read=_read_metadata,
            craft=_craft_yaml("metadata"),
        ),
        Kind(
            name="case",
            make=_shipped("finforce_eval/data/bench_cyl25_middle/case.json"),
            read=_read_case,
            craft=_craft_json,
        ),
        Kind(name="glb", make=_make_glb, read=_read_mesh, craft=_craft_glb, cost=8),
        Kind(name="mesh", make=_make_meshes, read=_read_mesh),
        Kind(name="onnx", make=_make_onnx, read=_read_onnx, craft=_craft_onnx, cost=20),
        Kind(name="cloud", make=_make_cloud, read=_read_cloud, craft=_craft_cloud),
        Kind(name="array", make=_make_array, read=_read_array, craft=_craft_array),
        Kind(name="picture", make=_make_picture, read=_read_picture, craft=_craft_picture),
        Kind(name="intrinsics", make=_make_intrinsics, read=_read_intrinsics, craft=_craft_json),
    )
}
TEXTS = frozenset((".json", ".yaml", ".obj"))
