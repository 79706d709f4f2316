"""Claims about UMI's replay buffers and UMI-FT's episodes, which are written here as they are laid out."""

import json
import sys
import zipfile

import numpy as np
import pytest

from finforce.errors import MissingDependencyError
from finforce.gripper_frames import ROBOT_CAMERA
from finforce.messages import NANOSECONDS
from finforce.rig import Rig, RigCamera
from finforce_eval.annotation import buffer_copy
from finforce_eval.cli.main import main
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.scoring import match_truth
from finforce_eval.recordings.images import ImageChoice
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.zarr_store import ZarrStore
from finforce_eval.table import ForceSeries, write_table

CAMERA = RigCamera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0, model="plumb_bob")
UPRIGHT = np.diag([-1.0, -1.0, 1.0, 1.0])  # a camera above the gripper, which sees its x run to the left
CHOICE = ImageChoice(
    camera=Rig(jaw="umi", camera=CAMERA, T_gripper_camera=(0, 0, 0, 0, 0, 0, 1)).intrinsics, T_gripper_camera=UPRIGHT
)
START = 1.7e9  # s, as clocks have them
PRESSING = np.array([-3.0, 1.0, 0.5])  # N, of an object on the left jaw, as the picture has its axes


def write_array(root, key, values, rows=7, columns=None, compressor=None):
    """Write an array of format 2 in chunks of some rows and columns."""
    chunks = [min(rows, len(values)), *values.shape[1:]]
    if columns:
        chunks[-1] = columns
    folder = root / key
    folder.mkdir(parents=True)
    about = {"zarr_format": 2, "shape": values.shape, "chunks": chunks, "dtype": values.dtype.str}
    about |= {"compressor": compressor, "fill_value": 0, "order": "C", "filters": None}
    (folder / ".zarray").write_text(json.dumps(about))
    for place in np.ndindex(*(-(-side // part) for side, part in zip(values.shape, chunks, strict=True))):
        part = values[tuple(slice(n * size, (n + 1) * size) for n, size in zip(place, chunks, strict=True))]
        chunk = np.zeros(chunks, values.dtype)
        chunk[tuple(map(slice, part.shape))] = part
        (folder / ".".join(map(str, place))).write_bytes(chunk.tobytes())


def make_group(root):
    root.mkdir(parents=True)
    (root / ".zgroup").write_text('{"zarr_format": 2}')
    return root


def make_pictures(count):
    return np.tile((10 * np.arange(1, count + 1, dtype=np.uint8))[:, None, None, None], (1, 48, 64, 3))


def write_buffer(root, ends=(4, 10)):
    make_group(root)
    write_array(root, "meta/episode_ends", np.array(ends, np.int64))
    write_array(root, "data/camera0_rgb", make_pictures(ends[-1]), rows=1)
    write_array(root, "data/robot0_gripper_width", np.full((ends[-1], 1), 0.05, np.float32))
    return root


def write_episode(root, sign=1.0, count=12, changes=()):
    make_group(root)
    times, fine = START + np.arange(count)[:, None] / 60.0, START - 0.02 + np.arange(100)[:, None] / 360.0
    share = 3.0 * (fine - START + 0.1)
    right = PRESSING * [-1.0, 1.0, 1.0]
    arrays = {"rgb_0": make_pictures(count), "rgb_time_stamps_0": times, "gripper_0": np.full((count, 1), 0.05)}
    for side, force in (("left", PRESSING), ("right", right)):
        arrays[f"wrench_{side}_0"] = sign * share * np.r_[force, 0.1, 0.2, 0.3]
        arrays[f"wrench_time_stamps_{side}_0"] = fine
    for name, values in (arrays | dict(changes)).items():
        if values is not None:
            write_array(root, f"data/episode_0/{name}", values)
    return root


@pytest.mark.parametrize("zipped", [False, True])
def test_an_episode_of_a_replay_buffer_has_its_pictures(zipped, tmp_path):
    path = write_buffer(tmp_path / "dataset.zarr")
    if zipped:
        with zipfile.ZipFile(tmp_path / "dataset.zarr.zip", "w") as file:
            for each in path.rglob("*"):
                file.write(each, each.relative_to(path))
        path = tmp_path / "dataset.zarr.zip"
    recording = read_recording(path, ImageChoice(camera=CHOICE.camera, episode=1), ("left",))
    assert [int(image.color[0, 0, 0]) for _, image in recording.images] == [50, 60, 70, 80, 90, 100]
    assert recording.images.stamps_ns[1] == round(NANOSECONDS * 1001 / 60000)
    assert recording.name == "dataset/episode_000001" and set(recording.jaws) == {"left"}
    late = recording.images.at(recording.images.stamps_ns[4:])
    assert [int(image.color[0, 0, 0]) for _, image in late] == [90, 100]
    with pytest.raises(RecordingError, match="no episode 2; expected 0 to 1"):
        read_recording(path, ImageChoice(camera=CHOICE.camera, episode=2))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_wrenches_are_those_of_the_object_on_the_jaw_at_the_times_of_the_pictures(sign, tmp_path):
    recording = read_recording(write_episode(tmp_path / "ft.zarr", sign), CHOICE)
    share = 3.0 * (np.arange(12)[:, None] / 60.0 + 0.1)
    assert recording.images.stamps_ns[1] == pytest.approx(NANOSECONDS / 60, abs=300)  # ns; 1.7e9 s have steps of 240
    for side in ("left", "right"):  # both jaws are pushed away, along x of their own frames
        force = match_truth(recording.truth(side), recording.images.stamps_ns)
        np.testing.assert_allclose(force, share * (PRESSING if side == "right" else [-3.0, -1.0, 0.5]), atol=1e-4)
    assert sum("other sign" in note for note in recording.notes) == (sign < 0.0)
    assert sum("here called right" in note for note in recording.notes) == 1


def test_left_is_left_where_the_gripper_runs_to_the_right_of_the_picture(tmp_path):
    path = write_episode(tmp_path / "ft.zarr")
    recording = read_recording(path, ImageChoice(camera=CHOICE.camera, T_gripper_camera=ROBOT_CAMERA))
    np.testing.assert_allclose(
        recording.truth("left").force[-1] * -3.0 / recording.truth("left").force[-1, 0], PRESSING
    )
    assert not recording.notes
    blind = read_recording(path, ImageChoice(camera=CHOICE.camera))  # as finforce camera reads it
    assert blind.jaws["left"].truth is None and "--rig" in blind.notes[0]


NEVER = np.full((100, 1), np.nan)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"wrench_left_0": None}, "no array data/episode_0/wrench_left_0; data/episode_0 has gripper_0, rgb_0"),
        ({"wrench_left_0": np.zeros((100, 3))}, r"wrench_left_0 is float64 of shape \(100, 3\).*expected 100 x 6"),
        ({"wrench_left_0": np.zeros((90, 6))}, r"wrench_left_0 .*\(90, 6\).*expected 100 x 6"),
        ({"wrench_left_0": np.zeros((100, 6), int)}, "wrench_left_0 is int64"),
        ({"wrench_right_0": np.full((100, 6), np.nan)}, "wrench_right_0: up to nan; expected newtons"),
        ({"wrench_right_0": np.full((100, 6), 2e4)}, "wrench_right_0: up to 20000"),
        ({"wrench_time_stamps_left_0": NEVER}, "wrench_time_stamps_left_0.*expected rising seconds"),
        ({"wrench_time_stamps_left_0": np.arange(100.0)[:, None] * 2.8}, "steps of 2.8"),  # ms
        ({"wrench_time_stamps_left_0": np.arange(100.0)[:, None] / 360}, "wrench_left_0 lies -17.* one clock"),
        ({"rgb_time_stamps_0": START + np.arange(11)[:, None] / 60}, r"rgb_time_stamps_0 .*\(11, 1\).*expected 12 x 1"),
        ({"rgb_0": make_pictures(12).astype(np.uint16)}, "rgb_0 has 12 pictures of uint16"),
        ({"rgb_0": make_pictures(12).transpose(0, 3, 1, 2)}, r"rgb_0 is uint8 of shape \(12, 3, 48, 64\)"),
    ],
)
def test_arrays_that_are_missing_or_foreign_are_refused_by_name(changes, words, tmp_path):
    with pytest.raises(RecordingError, match=words):
        read_recording(write_episode(tmp_path / "ft.zarr", changes=changes), CHOICE)


def test_a_chunk_that_is_missing_or_cut_off_is_no_force_of_zero(tmp_path):
    path = write_episode(tmp_path / "ft.zarr")
    chunk = path / "data/episode_0/wrench_left_0/3.0"
    whole = chunk.read_bytes()
    chunk.write_bytes(whole[:-8])
    with pytest.raises(RecordingError, match=r"wrench_left_0/3\.0 is damaged"):
        read_recording(path, CHOICE)
    chunk.unlink()
    with pytest.raises(RecordingError, match=r"wrench_left_0/3\.0 is missing"):
        read_recording(path, CHOICE)
    chunk.write_bytes(whole)
    (path / "data/episode_0/rgb_0/1.0.0.0").unlink()
    with pytest.raises(RecordingError, match=r"rgb_0/1\.0\.0\.0 is missing"):
        list(read_recording(path, CHOICE).images)


def test_other_groups_and_codecs_are_refused_by_name(tmp_path):
    with pytest.raises(RecordingError, match=r"no array meta/episode_ends; meta has nothing"):
        read_recording(make_group(tmp_path / "empty.zarr"), CHOICE)
    newer = tmp_path / "newer.zarr"
    newer.mkdir()
    (newer / "zarr.json").write_text("{}")
    with pytest.raises(RecordingError, match="Zarr format 3; expected a group of Zarr format 2"):
        read_recording(newer, CHOICE)
    for name, codec in (("a", "pickle"), ("b", "imagecodecs_webp")):
        group = make_group(tmp_path / f"{name}.zarr")
        write_array(group, "meta/episode_ends", np.array([4]), compressor={"id": codec})
        with pytest.raises(RecordingError, match=f"compressor {codec}; expected blosc"):
            read_recording(group, CHOICE)


def test_every_episode_is_annotated_by_itself(tmp_path, capsys):
    path = write_buffer(tmp_path / "dataset.zarr")
    assert main(["annotate", str(path), "--contact", "fixed:40", "--out", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.splitlines()
    for number in (0, 1):
        assert sum(f"dataset_{number:06d}: " in line and "expected --rig" in line for line in lines) == 1


def test_compressed_chunks_are_decoded_and_a_missing_library_is_named(tmp_path, monkeypatch):
    numcodecs = pytest.importorskip("numcodecs")
    path, codec = write_buffer(tmp_path / "dataset.zarr"), numcodecs.Blosc(cname="zstd")
    folder = path / "data/camera0_rgb"
    about = json.loads((folder / ".zarray").read_text()) | {"compressor": codec.get_config()}
    for chunk in folder.glob("*.0"):
        chunk.write_bytes(codec.encode(chunk.read_bytes()))
    (folder / ".zarray").write_text(json.dumps(about))
    recording = read_recording(path, CHOICE)
    assert [int(image.color[0, 0, 0]) for _, image in recording.images] == [10, 20, 30, 40]
    (folder / "1.0.0.0").write_bytes(b"\x02" + bytes(40))
    with pytest.raises(RecordingError, match=r"camera0_rgb/1\.0\.0\.0 is damaged"):
        list(recording.images)
    (folder / ".zarray").write_text(json.dumps(about | {"compressor": {"id": "imagecodecs_jpegxl"}}))
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    with pytest.raises(MissingDependencyError, match="JPEG XL, needs imagecodecs: pip install imagecodecs"):
        list(read_recording(path, CHOICE).images)


def write_forces(folder, sides, count, begin):
    """A table of forces as `annotate` writes it, of an episode whose first images have none."""
    force = np.tile([-1.0, 0.0, 0.5], (count, 1)) * np.arange(begin, begin + count)[:, None]
    force[:2] = np.nan
    columns = {"force": force, "force_stddev": np.abs(force), "torque": force, "scored": True, "magnitude_stddev": 0.1}
    series = [ForceSeries.build("case", side, np.arange(count), **columns) for side in sides]
    folder.mkdir(parents=True)
    write_table(folder / "forces.parquet", series, {"key": "1"})
    return folder


@pytest.fixture(params=["folder", "zip"])
def buffer(request, tmp_path):
    path = write_buffer(tmp_path / "dataset.zarr")
    if request.param == "folder":
        return path
    with zipfile.ZipFile(tmp_path / "dataset.zarr.zip", "w") as file:
        for each in path.rglob("*"):
            file.write(each, each.relative_to(path))
    return tmp_path / "dataset.zarr.zip"


def files_of(path):
    if path.is_file():
        with zipfile.ZipFile(path) as file:
            return {name: file.read(name) for name in file.namelist() if not name.endswith("/")}
    return {str(each.relative_to(path)): each.read_bytes() for each in path.rglob("*") if each.is_file()}


def test_a_copy_of_a_buffer_has_the_forces_of_every_picture_and_is_else_the_same(buffer, tmp_path):
    parts = [
        write_forces(tmp_path / "0", ("left", "right"), 4, 1),
        write_forces(tmp_path / "1", ("left", "right"), 6, 5),
    ]
    target = tmp_path / f"copy{buffer.name.removeprefix('dataset')}"
    assert buffer_copy.write_buffer(buffer, target, parts, ("force", "grasp"), "force") == 2
    before, after = files_of(buffer), files_of(target)
    assert {name: after[name] for name in before} == before
    added = {f"data/robot0_force_{name}" for name in ("left", "right", "grasp")}
    added |= {f"{name}_valid" for name in added}
    assert {name.rpartition("/")[0] for name in after.keys() - before.keys()} == added
    about = json.loads(after["data/robot0_force_left/.zarray"])
    assert about["shape"] == [10, 3] and about["dtype"] == "<f4" and about["compressor"] is None
    left = np.frombuffer(after["data/robot0_force_left/0.0"], "<f4").reshape(10, 3)
    np.testing.assert_array_equal(left[:, 0], [0, 0, -3, -4, 0, 0, -7, -8, -9, -10])  # none of the episode before
    valid = np.frombuffer(after["data/robot0_force_left_valid/0"], "<f4")
    np.testing.assert_array_equal(valid, [0, 0, 1, 1, 0, 0, 1, 1, 1, 1])
    grasp = ZarrStore(target).open_array("data/robot0_force_grasp", (10, 1), "f").read()
    np.testing.assert_allclose(grasp[valid > 0, 0], np.linalg.norm(left[valid > 0], axis=1), rtol=1e-6)
    with pytest.raises(RecordingError, match="has data/robot0_force_grasp already; expected another --prefix"):
        buffer_copy.write_buffer(target, tmp_path / "again", parts, ("grasp",), "force")


def test_episodes_without_forces_have_no_answer_and_of_another_length_are_refused(buffer, tmp_path):
    target = tmp_path / f"copy{buffer.name.removeprefix('dataset')}"
    parts = [tmp_path / "none", write_forces(tmp_path / "1", ("left",), 6, 5)]
    assert buffer_copy.write_buffer(buffer, target, parts, ("force",), "force") == 1
    valid = ZarrStore(target).open_array("data/robot0_force_left_valid", (10,), "f").read()
    np.testing.assert_array_equal(valid, [0, 0, 0, 0, 0, 0, 1, 1, 1, 1])
    with pytest.raises(RecordingError, match="6 forces for 4 pictures"):
        buffer_copy.write_buffer(buffer, tmp_path / "wrong", parts[::-1], ("force",), "force")


def test_metadata_of_all_arrays_at_once_know_the_new_ones(buffer, tmp_path):
    if buffer.is_dir():
        (buffer / ".zmetadata").write_text('{"metadata": {".zgroup": {"zarr_format": 2}, "meta": {}}}')
    else:
        with zipfile.ZipFile(buffer, "a") as file:
            file.writestr(".zmetadata", '{"metadata": {".zgroup": {"zarr_format": 2}, "meta": {}}}')
    target = tmp_path / f"copy{buffer.name.removeprefix('dataset')}"
    parts = [tmp_path / "none", write_forces(tmp_path / "1", ("left",), 6, 5)]
    buffer_copy.write_buffer(buffer, target, parts, ("force",), "force")
    known = json.loads(ZarrStore(target).find(".zmetadata"))["metadata"]
    assert known["data/robot0_force_left/.zarray"]["shape"] == [10, 3] and ".zgroup" in known
    assert list(known) == sorted(known)
    assert "robot0_force" not in ZarrStore(buffer).find(".zmetadata").decode()
