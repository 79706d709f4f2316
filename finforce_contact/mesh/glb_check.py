"""What a GLB file says of itself, checked against its size before a reader makes room for it.

A few hundred bytes can announce billions of numbers, a million instances, or another file: a reader would believe them.

Source: glTF 2.0 specification, sections 3 and 4 (chunks, buffers, accessors, nodes).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from finforce.files import FileError, parse_json
from finforce_contact.errors import ObjectMeshError

_HEAD, _CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
# Bytes of the description; elements of all accessors together; of all that the nodes draw; nodes.
_LARGEST_TEXT, _MOST_ELEMENTS, _MOST_DRAWN, _MOST_NODES = 16 << 20, 40_000_000, 12_000_000, 100_000
_UNKNOWN = ("EXT_mesh_gpu_instancing", "KHR_draco_mesh_compression", "EXT_meshopt_compression")


class _GlbError(Exception):
    """What is wrong with a file."""


def check_glb(path: Path) -> None:
    """Refuse a GLB file that announces more than it holds, or draws more than an object has.

    Raises:
        ObjectMeshError: it does, or it is none.
        OSError: it cannot be read.
    """
    try:
        described, binary = _read_chunks(path)
        _check_content(described, binary)
    except (_GlbError, FileError) as error:
        raise ObjectMeshError(f"{path.name}: {error}; export it again") from error
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise ObjectMeshError(f"{path.name}: is no GLB that can be read ({error!r}); export it again") from error


def _read_chunks(path: Path) -> tuple[Mapping[str, Any], int]:
    """Return the description and the size of the binary chunk [bytes]."""
    with path.open("rb") as file:
        head = file.read(_HEAD.size + _CHUNK.size)
        if len(head) < _HEAD.size + _CHUNK.size or head[:4] != b"glTF":
            raise _GlbError("is no GLB file")
        length, kind = _CHUNK.unpack(head[_HEAD.size :])
        if kind != _JSON or length > _LARGEST_TEXT:
            raise _GlbError(f"a description of {length} bytes, expected at most {_LARGEST_TEXT}")
        text = file.read(length)
        if len(text) < length:
            raise _GlbError(f"a description of {length} bytes in a file that has {len(text)} of it")
        following = file.read(_CHUNK.size)
        _walk_chunks(file, _HEAD.size + _CHUNK.size + length, path.stat().st_size)
    described = parse_json(text.decode("utf-8", errors="replace"))
    if not isinstance(described, dict):
        raise _GlbError("a description that is no object")
    announced, kind = _CHUNK.unpack(following) if len(following) == _CHUNK.size else (0, _BIN)
    there = path.stat().st_size - _HEAD.size - 2 * _CHUNK.size - length
    if kind == _BIN and announced > max(there, 0):
        raise _GlbError(f"{announced} bytes of numbers are announced, {max(there, 0)} are there")
    return described, announced if kind == _BIN else 0


def _walk_chunks(file: BinaryIO, place: int, size: int) -> None:
    """Refuse a chunk, from a place of a file [bytes] on, that says to be longer than what is left."""
    while place + _CHUNK.size <= size:
        file.seek(place)
        announced, _ = _CHUNK.unpack(file.read(_CHUNK.size))
        place += _CHUNK.size + announced
        if place > size:
            raise _GlbError(f"{announced} bytes are announced, {size - place + announced} are there")


def _check_content(described: Mapping[str, Any], binary: int) -> None:
    """Refuse sizes that do not fit each other."""
    strange = [name for name in _UNKNOWN if name in (described.get("extensionsUsed") or ())]
    if strange:
        raise _GlbError(f"uses {strange[0]}, which is not read")
    buffers = [_buffer_size(buffer, binary) for buffer in described.get("buffers") or ()]
    views = [_view_size(view, buffers) for view in described.get("bufferViews") or ()]
    counts = [_accessor_count(accessor, views) for accessor in described.get("accessors") or ()]
    if sum(counts) > _MOST_ELEMENTS:
        raise _GlbError(f"{sum(counts)} elements, expected at most {_MOST_ELEMENTS}")
    _check_nodes(described, counts)


def _size(value: Any) -> int:
    """Return a number of bytes or elements."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 1 << 40:
        raise _GlbError(f"a size of {str(value)[:30]}")
    return value


def _buffer_size(buffer: Mapping[str, Any], binary: int) -> int:
    """Return the size of a buffer [bytes]."""
    uri, size = buffer.get("uri"), _size(buffer["byteLength"])
    if uri is None:
        there = binary
    elif isinstance(uri, str) and uri.startswith("data:"):
        there = len(uri)
    else:
        raise _GlbError("refers to another file, expected all in one")
    if size > there:
        raise _GlbError(f"a buffer of {size} bytes, {there} are there")
    return size


def _view_size(view: Mapping[str, Any], buffers: list[int]) -> tuple[int, int]:
    """Return size and stride of a part of a buffer [bytes]; a stride of 0 is that of its elements."""
    size, stride = _size(view["byteLength"]), _size(view.get("byteStride", 0))
    if _size(view.get("byteOffset", 0)) + size > buffers[_size(view["buffer"])]:
        raise _GlbError("a part of a buffer that leaves it")
    return size, stride


def _accessor_count(accessor: Mapping[str, Any], views: list[tuple[int, int]]) -> int:
    """Return the number of elements of an accessor, which its bytes have to hold."""
    count = _size(accessor["count"])
    if "sparse" in accessor:
        raise _GlbError("sparse accessors, which are not read")
    if "bufferView" not in accessor:
        return count
    size, stride = views[_size(accessor["bufferView"])]
    element = _SIZES[accessor["componentType"]] * _NUMBERS[accessor["type"]]
    needed = _size(accessor.get("byteOffset", 0)) + (stride or element) * max(count - 1, 0) + element * min(count, 1)
    if needed > size:
        raise _GlbError(f"{count} elements of {element} bytes in {size} bytes")
    return count


def _check_nodes(described: Mapping[str, Any], counts: list[int]) -> None:
    """Refuse nodes that are no trees, or that draw more than an object has."""
    nodes, meshes = described.get("nodes") or [], described.get("meshes") or []
    if len(nodes) > _MOST_NODES:
        raise _GlbError(f"{len(nodes)} nodes, expected at most {_MOST_NODES}")
    children = [_size(child) for node in nodes for child in node.get("children") or ()]
    if len(set(children)) < len(children):
        raise _GlbError("a node that is part of two others")
    sizes = [sum(_primitive_count(each, counts) for each in mesh.get("primitives") or ()) for mesh in meshes]
    drawn = sum(sizes[_size(node["mesh"])] for node in nodes if node.get("mesh") is not None)
    if drawn > _MOST_DRAWN:
        raise _GlbError(f"its nodes draw {drawn} corners, expected at most {_MOST_DRAWN}")


def _primitive_count(primitive: Mapping[str, Any], counts: list[int]) -> int:
    """Return the number of corners that a primitive draws."""
    index = primitive.get("indices")
    return counts[_size(primitive["attributes"]["POSITION"] if index is None else index)]
