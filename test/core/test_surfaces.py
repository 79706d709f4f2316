"""Claims about files of surfaces: what they announce has to be in them, and what crashes a reader costs a sentence."""

import json
import struct

import numpy as np
import pytest

from finforce import surfaces
from finforce.files import FileError
from finforce.optional import import_trimesh
from finforce.surfaces import read_surface


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


def scattered(count):
    """So many nodes that draw as many parts each."""
    part = {"primitives": [{"attributes": {"POSITION": 0}}] * 600}
    nodes = [{"mesh": 0, "translation": [float(number), 0.0, 0.0]} for number in range(count)]
    return changed(meshes=[part], nodes=nodes, scenes=[{"nodes": list(range(count))}])


BAD = {
    "count.glb": (
        changed(accessors=[{"bufferView": 0, "componentType": 5126, "count": 10**8, "type": "VEC3"}]),
        "made its reader fail",
    ),
    "no_data.glb": (changed(accessors=[{"componentType": 5126, "count": 10**8, "type": "VEC3"}]), "MB of memory"),
    "sparse.glb": (
        changed(accessors=[{"componentType": 5126, "count": 3, "type": "VEC3", "sparse": {"count": 1}}]),
        "in one place",
    ),
    "other.glb": (changed(buffers=[{"byteLength": 36, "uri": "secret"}]), "reader fail|cannot be read"),
    "nested.glb": (pack(b"[" * 100_000), "reader fail|cannot be read"),
    "long.glb": (pack(sound(), TRIANGLE, binary=2**31), "MB of memory|reader fail"),
    "many.glb": (scattered(20_000), "more than"),
    "loop.step": (b"ISO-10303-21;\nDATA;\n#1=SHELL_BASED_SURFACE_MODEL('',(#1));\nENDSEC;\n", "reader fail|crash"),
    "empty.ply": (b"", "got 0 bytes"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_a_file_announces_has_to_be_in_it(name, tmp_path, monkeypatch):
    monkeypatch.setattr(surfaces, "_MEMORY", 1 << 30)
    monkeypatch.setattr(surfaces, "_SECONDS", 2)
    content, words = BAD[name]
    (tmp_path / name).write_bytes(content)
    (tmp_path / "secret").write_bytes(TRIANGLE)
    with pytest.raises(FileError, match=words) as caught:
        read_surface(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_sound_files_are_read(tmp_path):
    path = tmp_path / "object.glb"
    path.write_bytes(pack(sound(), TRIANGLE))
    assert len(read_surface(path)[1]) == 1
    trimesh = import_trimesh()
    sphere = trimesh.creation.icosphere(radius=0.02)
    trimesh.Scene([sphere, sphere.copy().apply_translation([0.1, 0, 0])]).export(path)
    assert len(read_surface(path)[1]) == 2 * len(sphere.faces)


def test_a_binary_stl_is_read_as_trimesh_reads_it_and_without_it(tmp_path, monkeypatch):
    sphere = import_trimesh().creation.icosphere(radius=0.02, subdivisions=1)
    (tmp_path / "binary.stl").write_bytes(sphere.export(file_type="stl"))
    (tmp_path / "text.stl").write_text(sphere.export(file_type="stl_ascii"))
    by_trimesh, triangles = read_surface(tmp_path / "text.stl")
    monkeypatch.setattr(surfaces, "import_trimesh", lambda: pytest.fail("trimesh was loaded"))
    vertices, own = read_surface(tmp_path / "binary.stl")
    np.testing.assert_allclose(vertices[own], by_trimesh[triangles], rtol=1e-6, atol=1e-9)  # single precision
