"""Claims about files of surfaces: what they announce has to be in them, and what crashes a reader costs a sentence."""

import io
import json
import struct
import zipfile

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


CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
PRODUCTION = "http://schemas.microsoft.com/3dmanufacturing/production/2015/06"


def zip_models(encoding="utf-8", **models):
    """A 3MF file of models by name: the XML between the tags of each."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in models.items():
            root = f'<model xmlns="{CORE}" xmlns:p="{PRODUCTION}">{text}</model>'
            archive.writestr(f"3D/{name}.model", (text if text.startswith("<!") else root).encode(encoding))
    return packed.getvalue()


def describe_object(number, inside):
    return f'<object id="{number}">{inside}</object>'


MESH = (
    '<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="2" z="0"/></vertices>'
    '<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh>'
)
AXES = "".join(f"property float {axis}\n" for axis in "xyz")
PLY = (
    f"ply\nformat ascii 1.0\nelement vertex 3\n{AXES}element face 1\nproperty list uchar int vertex_indices\n"
    "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n"
).encode()
BUILD = '<resources><object id="1">{}</object></resources><build><item objectid="1"/></build>'
ITSELF = describe_object(1, '<components><component objectid="1"/></components>')
ENTITIES = f'<!DOCTYPE m [<!ENTITY a "aaaaaaaa">]><model xmlns="{CORE}"><build>&a;</build></model>'

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
    "long.glb": (pack(sound(), TRIANGLE, binary=2**31), "MB of memory|reader fail|took more than"),
    "many.glb": (scattered(20_000), "more than"),
    "loop.step": (b"ISO-10303-21;\nDATA;\n#1=SHELL_BASED_SURFACE_MODEL('',(#1));\nENDSEC;\n", "reader fail|crash"),
    "empty.ply": (b"", "got 0 bytes"),
    "loop.3mf": (
        zip_models(a=f'<resources>{ITSELF}</resources><build><item objectid="1"/></build>'),
        "made its reader fail",
    ),
    "entities.3mf": (zip_models(a=ENTITIES), "declares entities"),
    "wide_entities.3mf": (zip_models(a=ENTITIES, encoding="utf-16"), "declares entities"),
    "nothing.3mf": (zip_models(a=f"<resources>{describe_object(1, MESH)}</resources><build/>"), "builds no object"),
    "far.3mf": (zip_models(a=BUILD.format(MESH.replace('v1="0"', 'v1="3"'))), "name no vertex"),
    "before.3mf": (zip_models(a=BUILD.format(MESH.replace('v1="0"', 'v1="-1"'))), "name no vertex"),
    "far.ply": (PLY, "name no vertex"),
    "no_zip.3mf": (b"PK\3\4 no more", "made its reader fail"),
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


def test_parts_of_a_3mf_file_stand_where_their_transforms_put_them(monkeypatch):
    whole = describe_object(7, '<components><component p:path="/3D/b.model" objectid="1" transform="{}"/></components>')
    turned, moved = "0 1 0 -1 0 0 0 0 1 10 0 0", "1 0 0 0 1 0 0 0 1 0 0 5"
    content = zip_models(
        a=f'<resources>{whole.format(turned)}</resources><build><item objectid="7" transform="{moved}"/></build>',
        b=f"<resources>{describe_object(1, MESH)}</resources>",
    )
    vertices, triangles = surfaces._read_3mf(content)
    # x to y, y to -x, then 10 along x, then 5 along z
    np.testing.assert_allclose(vertices[triangles[0]], [[10, 0, 5], [10, 1, 5], [8, 0, 5]])
    assert len(triangles) == 1
    monkeypatch.setattr(surfaces, "LARGEST", 100)
    with pytest.raises(FileError, match="unzips to 0 MB, expected at most 0"):
        surfaces._read_3mf(content)


def test_sound_files_are_read(tmp_path):
    path = tmp_path / "object.glb"
    path.write_bytes(pack(sound(), TRIANGLE))
    assert len(read_surface(path)[1]) == 1
    trimesh = import_trimesh()
    sphere = trimesh.creation.icosphere(radius=0.02)
    trimesh.Scene([sphere, sphere.copy().apply_translation([0.1, 0, 0])]).export(path)
    assert len(read_surface(path)[1]) == 2 * len(sphere.faces)


def test_a_binary_stl_is_read_as_trimesh_reads_it_and_without_it_and_text_with_decimal_commas(tmp_path, monkeypatch):
    sphere = import_trimesh().creation.icosphere(radius=0.02, subdivisions=1)
    (tmp_path / "binary.stl").write_bytes(sphere.export(file_type="stl"))
    (tmp_path / "text.stl").write_text(sphere.export(file_type="stl_ascii"))
    by_trimesh, triangles = read_surface(tmp_path / "text.stl")
    for kind in ("stl_ascii", "obj"):  # as a German MeshLab writes numbers
        path = tmp_path / f"commas.{kind[:3]}"
        path.write_text(sphere.export(file_type=kind).replace(".", ","))
        commas, own = read_surface(path)
        np.testing.assert_allclose(commas[own], by_trimesh[triangles], rtol=1e-6, atol=1e-8)
    monkeypatch.setattr(surfaces, "import_trimesh", lambda: pytest.fail("trimesh was loaded"))
    vertices, own = read_surface(tmp_path / "binary.stl")
    np.testing.assert_allclose(vertices[own], by_trimesh[triangles], rtol=1e-6, atol=1e-9)  # single precision
