import io
import json
import struct
import zlib

import numpy as np
import pytest
from contact_fakes import bare_mesh, distance_mm, make_case
from PIL import Image

from finforce.errors import FinforceError
from finforce.optional import import_trimesh
from finforce_contact.mesh.object_mesh import load_object_mesh, read_triangles
from finforce_eval.cli.main import main
from finforce_eval.cli.reconstruct import read_generated_pose
from finforce_eval.errors import OptionError
from finforce_eval.recordings.image_files import read_depth, read_intrinsics, read_mask

SHAPE = (240, 424)


@pytest.fixture
def files(tmp_path):
    """The files of an image of the cylinder, and of a mesh generated for it."""
    case = make_case("cylinder")
    scene, guess = case.scene, case.guess
    millimetres = np.nan_to_num(scene.depth * 1e3).round().astype(np.uint16)
    Image.fromarray(millimetres).save(tmp_path / "depth.png")
    Image.fromarray(np.where(scene.mask, 255, 0).astype(np.uint8)).save(tmp_path / "mask.png")
    import_trimesh().Trimesh(guess.vertices, guess.triangles, process=False).export(tmp_path / "generated.glb")
    (tmp_path / "pose.json").write_text(json.dumps({"matrix": guess.affine.tolist()}))
    camera = scene.camera
    numbers = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    (tmp_path / "camera.json").write_text(json.dumps(numbers))
    return tmp_path


def run(folder, *changes, without=()):
    """Run the command with the fixture's files, some options changed or left out."""
    options = {
        "--depth": folder / "depth.png",
        "--mask": folder / "mask.png",
        "--intrinsics": folder / "camera.json",
        "--mesh": folder / "generated.glb",
        "--pose": folder / "pose.json",
        "-o": folder / "out.stl",
    }
    options.update(zip(changes[::2], changes[1::2], strict=True))
    pairs = [(name, value) for name, value in options.items() if name not in without]
    return main(["reconstruct", *(str(word) for pair in pairs for word in pair)])


def complain(capsys, folder, *changes, without=()):
    """Return the one line of a run that has to fail."""
    assert run(folder, *changes, without=without) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = [line for line in captured.err.splitlines() if line.startswith("finforce: ")]
    assert len(lines) == 1 and "Traceback" not in captured.err
    return lines[0]


def test_mesh_pose_and_picture_are_written(files, capsys):
    color = files / "color.png"
    Image.fromarray(np.full((*SHAPE, 3), 90, dtype=np.uint8)).save(color)
    assert run(files, "--color", color, "--picture", files / "picture.png") == 0
    out = capsys.readouterr().out
    assert "robust:" in out and "watertight" in out
    mesh = load_object_mesh(files / "out.stl")
    pose = json.loads((files / "out.pose.json").read_text())
    assert mesh.watertight and pose["watertight"]
    assert distance_mm(make_case("cylinder"), mesh, np.array(pose["T_camera_object"])) < 0.6
    picture = np.array(Image.open(files / "picture.png"))
    # the outline of the mesh is drawn in orange
    orange = (picture[..., 0] > 150) & (picture[..., 2] < 100)
    assert orange.sum() > 500


def test_another_ending_holds_the_same_mesh(files):
    assert run(files, "-o", files / "out.glb") == 0
    vertices, _ = read_triangles(files / "out.glb")
    np.testing.assert_allclose(np.sort(np.ptp(vertices, axis=0)), [0.05, 0.05, 0.1], atol=2e-3)


def test_without_a_generated_mesh_a_primitive_is_found(files, capsys, monkeypatch):
    monkeypatch.setattr("finforce_contact.reconstruction.shape_search.HANDICAP", {"cylinder": 1.0})
    assert run(files, without=("--mesh", "--pose")) == 0
    assert "primitive: cylinder" in capsys.readouterr().out


def test_images_with_nothing_in_them_end_with_one_line(files, capsys):
    blank = files / "blank.png"
    Image.fromarray(np.zeros(SHAPE, dtype=np.uint16)).save(blank)
    assert "no pixel has a depth" in complain(capsys, files, "--depth", blank)
    assert "nothing in it" in complain(capsys, files, "--mask", blank)
    for depth in (np.full(SHAPE, 300, dtype=np.uint16), np.zeros(SHAPE, dtype=np.uint16)):
        depth[100, 150] = 300
        Image.fromarray(depth).save(files / "full.png")
        inverted = np.full(SHAPE, 255, dtype=np.uint8)
        inverted[90:120, 140:180] = 0
        Image.fromarray(inverted).save(files / "inverted.png")
        said = complain(capsys, files, "--mask", files / "inverted.png", "--depth", files / "full.png")
        assert "is it inverted?" in said
    small = files / "small.png"
    Image.fromarray(np.full((10, 10), 255, dtype=np.uint8)).save(small)
    assert "(10, 10)" in complain(capsys, files, "--mask", small)


def test_mesh_with_nothing_in_it_ends_with_one_line(files, capsys):
    empty = files / "empty.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\n"
    empty.write_text(head + "element face 0\nproperty list uchar int vertex_indices\nend_header\n")
    assert "empty.ply" in complain(capsys, files, "--mesh", empty)
    assert "missing.glb" in complain(capsys, files, "--mesh", files / "missing.glb")


@pytest.mark.parametrize(
    "changes, without, expected",
    [
        (("-o", "out.xyz"), (), ".stl, .ply, .glb"),
        ((), ("--pose",), "--mesh and --pose go together"),
        (("--method", "paper"), ("--mesh", "--pose"), "needs --mesh and --pose"),
        (("--method", "completion"), (), "uses no generated mesh"),
        (("--depth", "nowhere.png"), (), "nowhere.png"),
        (("--intrinsics", "431"), (), "431"),
    ],
)
def test_options_that_do_not_go_together_end_with_one_line(files, capsys, changes, without, expected):
    assert expected in complain(capsys, files, *changes, without=without)


def test_numbers_and_files_of_intrinsics_agree(tmp_path):
    numbers = read_intrinsics(["400", "401", "210", "120", "0.1", "0", "0", "0", "-0.01"], SHAPE)
    ros = tmp_path / "info.yaml"
    ros.write_text(
        "image_width: 424\nimage_height: 240\ncamera_matrix: {data: [400, 0, 210, 0, 401, 120, 0, 0, 1]}\n"
        "distortion_coefficients: {data: [0.1, 0, 0, 0, -0.01]}\n"
    )
    read = read_intrinsics([str(ros)], SHAPE)
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(read, name) == getattr(numbers, name)
    np.testing.assert_array_equal(read.distortion, numbers.distortion)
    assert (numbers.fx, numbers.fy, numbers.cx, numbers.cy) == (400.0, 401.0, 210.0, 120.0)
    with pytest.raises(OptionError, match="^intrinsics .*: intrinsics of 424 x 240; expected 240 x 424"):
        read_intrinsics([str(ros)], SHAPE[::-1])
    with pytest.raises(OptionError, match="expected fx fy cx cy"):
        read_intrinsics(["400", "401", "210"], SHAPE)


def test_depth_files_are_metres_or_sixteen_bit_millimetres(tmp_path):
    np.save(tmp_path / "metres.npy", np.array([[0.25, 0.0]]))
    np.save(tmp_path / "steps.npy", np.array([[250, 0]], dtype=np.uint16))
    Image.fromarray(np.array([[250, 0]], dtype=np.uint16)).save(tmp_path / "depth.png")
    for name in ("metres.npy", "steps.npy", "depth.png"):
        np.testing.assert_allclose(read_depth(tmp_path / name), [[0.25, np.nan]], rtol=1e-6)
    np.save(tmp_path / "wrong.npy", np.array([[250.0, 251.0]]))
    with pytest.raises(OptionError, match="--depth-scale .*, others metres"):
        read_depth(tmp_path / "wrong.npy")
    Image.fromarray(np.array([[250, 0]], dtype=np.uint8)).save(tmp_path / "grey.png")
    with pytest.raises(OptionError, match="16-bit"):
        read_depth(tmp_path / "grey.png")


def test_mask_is_alpha_or_what_is_bright(tmp_path):
    image = np.zeros((2, 3, 4), dtype=np.uint8)
    image[..., :3] = 200
    image[0, 1, 3] = 255
    Image.fromarray(image).save(tmp_path / "alpha.png")
    Image.fromarray(np.array([[0, 255, 30], [0, 0, 0]], dtype=np.uint8)).save(tmp_path / "grey.png")
    for name in ("alpha.png", "grey.png"):
        np.testing.assert_array_equal(read_mask(tmp_path / name), [[False, True, False], [False, False, False]])


def test_pose_of_the_generator_is_read_in_each_form(tmp_path):
    path = tmp_path / "pose.json"
    path.write_text(json.dumps({"rotation": [[1, 0, 0, 0]], "translation": [[0.1, 0.2, 0.3]], "scale": [[2, 2, 2]]}))
    expected = [[-2, 0, 0, -0.1], [0, 0, 2, -0.2], [0, 2, 0, 0.3], [0, 0, 0, 1]]
    np.testing.assert_allclose(read_generated_pose(path), expected, atol=1e-12)
    for content in (expected, {"matrix": expected}, {"T_camera_object": expected, "method": "robust"}):
        path.write_text(json.dumps(content))
        np.testing.assert_allclose(read_generated_pose(path), expected)
    lines = tmp_path / "0000.txt"  # of FoundationPose
    np.savetxt(lines, expected)
    np.testing.assert_allclose(read_generated_pose(lines), expected)
    lines.write_text("0.1 0.2 0.3\n")
    with pytest.raises(OptionError, match=r"0000\.txt: a matrix of shape \(3,\)"):
        read_generated_pose(lines)
    for content in ("{", "3", "[[1, 2], [3]]", '{"rotation": [1, 0, 0, 0]}'):
        path.write_text(content)
        with pytest.raises(OptionError, match="pose.json"):
            read_generated_pose(path)


def test_generated_mesh_may_be_in_any_unit(files):
    case = make_case("cylinder")
    mesh = bare_mesh(case.guess.vertices * 1e3, case.guess.triangles)
    import_trimesh().Trimesh(mesh.vertices, mesh.triangles, process=False).export(files / "generated.glb")
    affine = case.guess.affine @ np.diag([1e-3, 1e-3, 1e-3, 1.0])
    (files / "pose.json").write_text(json.dumps(affine.tolist()))
    assert run(files) == 0
    assert np.ptp(load_object_mesh(files / "out.stl").vertices, axis=0).max() == pytest.approx(0.1, abs=2e-3)


def header_of(shape, kind="<f4"):
    """An .npy file that says it holds an array, and holds eight bytes."""
    text = repr({"descr": kind, "fortran_order": False, "shape": shape}).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(8)


def zipped():
    file = io.BytesIO()
    np.savez(file, a=np.ones((4, 4)))
    return file.getvalue()


def png_of(width, height):
    """The head of a PNG of any size."""
    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    chunk = b"IHDR" + head
    data = struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return b"\x89PNG\r\n\x1a\n" + data + struct.pack(">I", 1000) + b"IDAT" + bytes(60)


FILES = {
    "depth.npy": [
        b"",
        b"\x93NUMPY",
        header_of((10**6, 10**6)),
        header_of((10**18, 10**18)),
        header_of((0, 5)),
        header_of((-1, 5)),
        header_of(("a", 5)),
        header_of((2, 1), "|O"),
        header_of((1,), "<U2"),
        zipped(),
        b"no array",
    ],
    "depth.png": [
        b"",
        b"\x89PNG\r\n\x1a\n",
        png_of(100_000, 100_000),
        png_of(0, 5),
        png_of(640, 480),
        b"GIF89a" + bytes(9),
    ],
    "camera.yaml": [
        b"fx: [1, [2]]\nfy: 1\ncx: 1\ncy: 1\n",
        b"fx: a\nfy: 1\ncx: 1\ncy: 1\n",
        b"fx: .inf\nfy: 1\ncx: 1\ncy: 1\n",
        b"fx: 1.0e+308\nfy: 1\ncx: 1\ncy: 1\nwidth: .inf\n",
        b"fx: 1\nfy: 1\ncx: 1\ncy: 1\nwidth: wide\n",
        b"K: [1, 2, [3], 4, 5, 6, 7, 8, 9]\n",
        b"K: [[1, 0], [0]]\n",
        b"fx: 1\nfy: 1\ncx: 1\ncy: 1\ndistortion: [1, [2, 3], x]\n",
        b"\xff\xfe",
        b"- 1\n",
    ],
    "pose.json": [
        b"",
        b"[[[[",
        b"[" * 100_000,
        b"3",
        b'"matrix"',
        b'{"matrix": [[1, 2], [3]]}',
        b'{"matrix": 1e999}',
        b'{"rotation": 1}',
    ],
}


@pytest.mark.parametrize(("name", "number"), [(name, n) for name, each in FILES.items() for n in range(len(each))])
def test_a_file_that_lies_or_is_damaged_ends_with_one_line(name, number, tmp_path):
    path = tmp_path / name
    path.write_bytes(FILES[name][number])
    readers = {
        "depth.npy": read_depth,
        "depth.png": read_depth,
        "camera.yaml": lambda path: read_intrinsics([str(path)], (480, 640)),
        "pose.json": read_generated_pose,
    }
    with pytest.raises(FinforceError):
        readers[name](path)
    if name.startswith("depth"):
        with pytest.raises(FinforceError):
            read_mask(path)


def test_a_picture_of_unknown_ending_is_refused_before_anything_is_read(files, capsys):
    with pytest.raises(SystemExit):
        run(files, "--picture", "x.foo")
    assert "expected a name that ends in .png" in capsys.readouterr().err
