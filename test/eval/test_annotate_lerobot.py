"""Claims about forces in LeRobot datasets: every frame has its own or says why not, and nothing else changes."""

import json
import shutil
from itertools import islice

import numpy as np
import pytest

pytest.importorskip("av")
parquet = pytest.importorskip("pyarrow.parquet")

from eval_fakes import QUICK_GRASP  # noqa: E402
from lerobot_fakes import CAMERA, write_dataset  # noqa: E402

from finforce_eval.cli.main import main  # noqa: E402
from finforce_eval.recordings.recording import read_recording  # noqa: E402
from lab.bench.chain import true_grasp  # noqa: E402
from lab.scenes import find_scene  # noqa: E402

VERSIONS = ("v2.1", "v3.0")
HEIGHT = 41.7  # mm, of the rod
IMAGES = 72  # until the rod has been held for half a second
SHORT = 12  # fewer than a tare needs


@pytest.fixture(scope="module")
def scene():
    """A rendered grasp of a rod until it is held: the recording and its pictures."""
    recording = read_recording(find_scene(QUICK_GRASP))
    return recording, [item.image.color for item in islice(recording.images.colors_alone(), IMAGES)]


@pytest.fixture(scope="module")
def datasets(scene, tmp_path_factory):
    """The grasp as an episode, and its first images as another, in both layouts."""
    folder = tmp_path_factory.mktemp("datasets")
    _, pictures = scene
    for version in VERSIONS:
        write_dataset(folder / version, [pictures[:SHORT], pictures], version)
    return folder


def words_of(scene):
    recording, _ = scene
    camera = recording.images.camera
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy]
    pose = ",".join(str(number) for number in recording.case["T_gripper_camera"])
    return [
        f"--extrinsics={pose}",
        "--contact",
        f"fixed:{HEIGHT}",
        "--calibration",
        "twin",
        "--intrinsics",
        *map(str, numbers),
    ]


def annotate(out, dataset, scene, *words):
    return main(["annotate", str(dataset), "--out", str(out), *words, *words_of(scene)])


@pytest.fixture(scope="module")
def annotated(datasets, scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("annotated")
    for version in VERSIONS:
        assert annotate(out, datasets / version, scene) == 0
    return out


def rows_of(folder):
    tables = [parquet.read_table(path) for path in sorted((folder / "data").rglob("*.parquet"))]
    return [row for table in tables for row in table.to_pylist()]


@pytest.mark.parametrize("version", VERSIONS)
def test_forces_are_in_their_frames_and_near_the_truth(version, annotated, scene):
    rows = [row for row in rows_of(annotated / version) if row["episode_index"] == 1]
    recording, pictures = scene
    assert len(rows) == len(pictures) == IMAGES
    grasp = np.array([row["observation.grasp_force"] for row in rows])
    valid = np.array([row["observation.force.valid"] for row in rows])
    left = np.array([row["observation.force.left"] for row in rows])
    np.testing.assert_array_equal(valid, np.isfinite(grasp))
    assert not valid[:40].any() and valid[50:].all()
    truth = true_grasp(recording).at(recording.images.colors_alone().stamps[:IMAGES])
    assert truth.max() > 1.0
    assert np.sqrt(np.mean((grasp - truth)[valid] ** 2)) < 0.15
    assert np.isfinite(left[valid]).all()
    stddev = np.array([row["observation.force.left.stddev"] for row in rows])
    assert (stddev[valid][:, 0] > 0).all() and (stddev[valid] >= 0).all()


@pytest.mark.parametrize("version", VERSIONS)
def test_a_frame_without_a_force_is_nan_and_says_why(version, annotated):
    for row in rows_of(annotated / version):
        missing = np.isnan(row["observation.grasp_force"])
        assert missing == (not row["observation.force.valid"]) == bool(row["observation.force.reason"])
        if missing:
            assert "tare" in row["observation.force.reason"]
    short = [row for row in rows_of(annotated / version) if row["episode_index"] == 0]
    assert len(short) == SHORT and not any(row["observation.force.valid"] for row in short)


@pytest.mark.parametrize("version", VERSIONS)
def test_all_else_is_as_it_was(version, datasets, annotated):
    source, target = datasets / version, annotated / version
    before = {path.relative_to(source) for path in source.rglob("*") if path.is_file()}
    assert {path.relative_to(target) for path in target.rglob("*") if path.is_file()} == before
    for path in before:
        if path.suffix in (".mp4", ".md") or path.name in ("tasks.jsonl", "tasks.parquet", "episodes.jsonl"):
            assert (source / path).read_bytes() == (target / path).read_bytes()
        if path.suffix == ".parquet":
            old, new = parquet.read_table(source / path), parquet.read_table(target / path)
            assert new.select(old.column_names).equals(old)
            assert new.select(old.column_names).schema == old.schema
    old, new = (json.loads((each / "meta/info.json").read_text()) for each in (source, target))
    added = new["features"].keys() - old["features"].keys()
    assert {name: new["features"][name] for name in old["features"]} == old["features"]
    assert added == {
        "observation.force.left",
        "observation.force.left.stddev",
        "observation.force.right",
        "observation.force.right.stddev",
        "observation.grasp_force",
        "observation.force.valid",
        "observation.force.reason",
    }
    assert new | {"features": {}} == old | {"features": {}}


@pytest.mark.parametrize("version", VERSIONS)
def test_statistics_are_of_the_frames_that_have_a_force(version, annotated):
    folder = annotated / version
    rows = [row for row in rows_of(folder) if row["episode_index"] == 1 and row["observation.force.valid"]]
    grasp = np.array([row["observation.grasp_force"] for row in rows])
    if version == "v3.0":
        stats = json.loads((folder / "meta/stats.json").read_text())["observation.grasp_force"]
        entry = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()[1]
        episode = {kind: entry[f"stats/observation.grasp_force/{kind}"] for kind in ("count", "max", "mean", "std")}
    else:
        lines = [json.loads(line) for line in (folder / "meta/episodes_stats.jsonl").read_text().splitlines()]
        stats = episode = lines[1]["stats"]["observation.grasp_force"]
        assert lines[0]["stats"]["observation.grasp_force"]["count"] == [0]
    for found in (stats, episode):
        assert found["count"] == [len(grasp)]
        for kind in ("max", "mean", "std"):
            assert found[kind] == pytest.approx([getattr(grasp, kind)()], rel=1e-4)


FROM_THE_FIRST = ("--set", "automatic_tare=no")  # a force in every image


@pytest.fixture(scope="module")
def small(scene, tmp_path_factory):
    """Two episodes of a few images."""
    folder = tmp_path_factory.mktemp("small") / "small"
    write_dataset(folder, [scene[1][:3], scene[1][:5]], "v2.1")
    return folder


def test_a_dataset_that_has_forces_is_refused_but_for_other_names(small, scene, tmp_path, capsys):
    assert annotate(tmp_path / "once", small, scene, *FROM_THE_FIRST) == 0
    assert annotate(tmp_path / "again", tmp_path / "once" / "small", scene, *FROM_THE_FIRST) == 2
    assert "already; expected another --prefix" in capsys.readouterr().err
    assert not (tmp_path / "again" / "small").exists()
    words = (*FROM_THE_FIRST, "--prefix", "observation.finforce")
    assert annotate(tmp_path / "again", tmp_path / "once" / "small", scene, *words) == 0
    row = rows_of(tmp_path / "again" / "small")[-1]
    assert row["observation.finforce.grasp_force"] == row["observation.grasp_force"]


@pytest.fixture
def broken(small, tmp_path):
    return shutil.copytree(small, tmp_path / "broken")


def test_a_missing_video_is_named_and_nothing_is_written_until_it_is_there(broken, scene, tmp_path, capsys):
    video = next((broken / "videos").rglob("episode_000001.mp4"))
    content = video.read_bytes()
    video.unlink()
    assert annotate(tmp_path / "out", broken, scene) == 2
    said = capsys.readouterr().err
    assert "1 of 4 files cannot be read; videos/" in said and "episode_000001.mp4" in said
    assert not (tmp_path / "out" / "broken").exists()
    video.write_bytes(content)
    assert annotate(tmp_path / "out", broken, scene, *FROM_THE_FIRST) == 0
    assert rows_of(tmp_path / "out" / "broken")


def lengthen(folder):
    path = folder / "meta/episodes.jsonl"
    path.write_text(path.read_text().replace('"length": 3', '"length": 4'))
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps(info | {"total_frames": info["total_frames"] + 1}))


def change_info(**changes):
    def change(folder):
        info = json.loads((folder / "meta/info.json").read_text())
        (folder / "meta/info.json").write_text(json.dumps(info | changes))

    return change


def cut_video(folder):
    path = next((folder / "videos").rglob("episode_000000.mp4"))
    path.write_bytes(path.read_bytes()[:500])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lengthen, "3 pictures; expected 4"),
        (change_info(total_frames=7), "expected the 7 of"),
        (change_info(codebase_version="v1.6"), "layout v1.6; expected v2.0, v2.1, v3.0"),
        (change_info(fps=0), "expected features, fps"),
        (lambda folder: (folder / "meta/info.json").write_text("{"), "info.json"),
        (lambda folder: (folder / "meta/episodes.jsonl").unlink(), "episodes.jsonl"),
        (cut_video, "episode_000000"),
    ],
)
def test_a_dataset_that_does_not_fit_itself_is_refused(damage, words, broken, scene, tmp_path, capsys):
    damage(broken)
    assert annotate(tmp_path / "out", broken, scene) == 2
    said = capsys.readouterr().err
    assert words in said
    assert "Traceback" not in said
    assert not (tmp_path / "out" / "broken").exists()


def test_a_camera_has_to_be_described_and_chosen(small, scene, tmp_path, capsys):
    assert main(["annotate", str(small), "--out", str(tmp_path)]) == 2
    assert "--intrinsics" in capsys.readouterr().err
    assert annotate(tmp_path, small, scene, "--images", "observation.images.front") == 2
    assert CAMERA in capsys.readouterr().err


def test_lerobot_reads_what_was_written(annotated):
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    found = datasets.LeRobotDataset("somebody/grasps", root=annotated / "v3.0")
    rows = rows_of(annotated / "v3.0")
    assert len(found.hf_dataset) == len(rows)
    for row, expected in zip(found.hf_dataset, rows, strict=True):
        np.testing.assert_array_equal(row["observation.force.left"], np.float32(expected["observation.force.left"]))
        assert row["observation.force.reason"] == expected["observation.force.reason"]
        np.testing.assert_array_equal(row["observation.state"], np.float32(expected["observation.state"]))
