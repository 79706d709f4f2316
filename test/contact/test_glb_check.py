"""Claims about GLB files: what they announce has to be in them."""

import json
import struct

import numpy as np
import pytest

from finforce.optional import import_trimesh
from finforce_contact.errors import ObjectMeshError
from finforce_contact.mesh.glb_check import check_glb
from finforce_contact.mesh.object_mesh import read_triangles


def pack(described, numbers=b"", **sizes):
    text = described if isinstance(described, bytes) else json.dumps(described).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", sizes.get("text", len(text)), 0x4E4F534A) + text
    body += struct.pack("<II", sizes.get("binary", len(numbers)), 0x004E4942) + numbers
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


TRIANGLE = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], np.float32).tobytes()


def sound():
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }


def changed(**parts):
    return pack(sound() | parts, TRIANGLE)


BAD = {
    "count": changed(accessors=[{"bufferView": 0, "componentType": 5126, "count": 10**8, "type": "VEC3"}]),
    "no data": changed(accessors=[{"componentType": 5126, "count": 10**8, "type": "VEC3"}]),
    "many without": changed(accessors=[{"componentType": 5126, "count": 10**7, "type": "VEC3"}] * 100),
    "negative": changed(accessors=[{"bufferView": 0, "componentType": 5126, "count": -1, "type": "VEC3"}]),
    "huge": changed(accessors=[{"bufferView": 0, "componentType": 5126, "count": 10**30, "type": "VEC3"}]),
    "text": changed(accessors=[{"bufferView": 0, "componentType": 5126, "count": "3", "type": "VEC3"}]),
    "type": changed(accessors=[{"bufferView": 0, "componentType": 1, "count": 3, "type": "VEC9"}]),
    "sparse": changed(
        accessors=[{"componentType": 5126, "count": 3, "type": "VEC3", "sparse": {"count": 10**9}}],
    ),
    "stride": changed(bufferViews=[{"buffer": 0, "byteLength": 36, "byteStride": 2**31}]),
    "view": changed(bufferViews=[{"buffer": 0, "byteLength": 36, "byteOffset": 2**31}]),
    "no buffer": changed(bufferViews=[{"buffer": 7, "byteLength": 36}]),
    "buffer": changed(buffers=[{"byteLength": 2**33}]),
    "pipe": changed(buffers=[{"byteLength": 36, "uri": "pipe"}]),
    "instances": changed(nodes=[{"mesh": 0}] * 200_000),
    "drawn": changed(nodes=[{"mesh": 0}] * 90_000, meshes=[{"primitives": [{"attributes": {"POSITION": 0}}] * 60}]),
    "shared": changed(nodes=[{"children": [1, 1]}, {"mesh": 0}]),
    "instancing": changed(extensionsUsed=["EXT_mesh_gpu_instancing"]),
    "nested": pack(b"[" * 100_000),
    "no object": pack([1, 2]),
    "no json": pack(b"{"),
    "long text": pack(sound(), TRIANGLE, text=2**31),
    "long binary": pack(sound(), TRIANGLE, binary=2**31),
    "short": b"glTF\x02",
    "other": b"solid x\nendsolid x\n" * 3,
    "list": changed(accessors=3),
    "nodes": changed(nodes=[3]),
}


@pytest.mark.parametrize("name", BAD)
def test_what_a_file_announces_has_to_be_in_it(name, tmp_path):
    path = tmp_path / "object.glb"
    path.write_bytes(BAD[name])
    with pytest.raises(ObjectMeshError, match="object.glb: "):
        read_triangles(path)


def test_sound_files_are_read(tmp_path):
    path = tmp_path / "object.glb"
    path.write_bytes(pack(sound(), TRIANGLE))
    check_glb(path)
    assert len(read_triangles(path)[1]) == 1
    trimesh = import_trimesh()
    for shape in (trimesh.creation.icosphere(radius=0.02), trimesh.creation.box((0.01, 0.02, 0.03))):
        scene = trimesh.Scene([shape, shape.copy().apply_translation([0.1, 0, 0])])
        scene.export(path)
        check_glb(path)
        assert len(read_triangles(path)[1]) == 2 * len(shape.faces)
