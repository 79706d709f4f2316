"""Claims about forces in LeRobot datasets: every frame has its own or says why not, and nothing else changes."""

import json
import shutil
from itertools import islice

import numpy as np
import pandas
import pytest

pytest.importorskip("av")
parquet = pytest.importorskip("pyarrow.parquet")

from eval_fakes import QUICK_GRASP, change_info  # noqa: E402
from lerobot_fakes import CAMERA, FPS, write_dataset  # noqa: E402

from finforce_eval.cli.main import main  # noqa: E402
from finforce_eval.policy import ForceInput, PolicyForces  # noqa: E402
from finforce_eval.recordings.dataset import open_dataset  # noqa: E402
from finforce_eval.recordings.frames import decode_video  # noqa: E402
from finforce_eval.recordings.recording import read_recording  # noqa: E402
from finforce_eval.sensor import ForceSensor  # noqa: E402
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
    grasp = np.array([row["force.grasp"][0] for row in rows])
    valid = np.array([row["force.valid"] for row in rows])
    left = np.array([row["force.left"] for row in rows])
    assert not grasp[~valid].any() and not left[~valid].any()
    assert not valid[:40].any() and valid[50:].all()
    truth = true_grasp(recording).at(recording.images.colors_alone().stamps_ns[:IMAGES])
    assert truth.max() > 1.0
    assert np.sqrt(np.mean((grasp - truth)[valid] ** 2)) < 0.15
    assert np.isfinite(left[valid]).all()
    stddev = np.array([row["force.left.stddev"] for row in rows])
    assert (stddev[valid][:, 0] > 0).all() and (stddev[valid] >= 0).all()


@pytest.mark.parametrize("version", VERSIONS)
def test_a_frame_without_a_force_says_so_and_why(version, annotated):
    for row in rows_of(annotated / version):
        assert row["force.valid"] == (row["force.left.valid"] and row["force.right.valid"])
        assert row["force.valid"] == (row["force.reason"] == "")
        if not row["force.valid"]:
            assert "tare" in row["force.reason"]
    short = [row for row in rows_of(annotated / version) if row["episode_index"] == 0]
    assert len(short) == SHORT and not any(row["force.valid"] for row in short)


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
    told = {f"force.{side}{ending}" for side in ("left", "right") for ending in ("", ".stddev", ".valid")}
    assert added == told | {"force.grasp", "force.valid", "force.reason", "observation.force"}
    assert new | {"features": {}} == old | {"features": {}}


NAMES = [f"force.{side}.{name}" for side in ("left", "right") for name in (*"xyz", "valid")]


def taken_by_policies(folder):
    """Rows (n, k) by feature of what `dataset_to_policy_features` of LeRobot takes besides pictures, by its rule."""
    info = json.loads((folder / "meta/info.json").read_text())
    rows, found = rows_of(folder), {}
    for name, entry in info["features"].items():
        if entry["dtype"] not in ("image", "video") and name.startswith(("observation", "action")):
            assert entry["dtype"] in ("float32", "float64", "int64", "bool") and len(entry["shape"]) == 1
            assert entry["names"] is None or len(entry["names"]) == entry["shape"][0]
            found[name] = np.array([row[name] for row in rows], float)
            assert found[name].shape == (len(rows), *entry["shape"])
    return found


def stats_of(folder, episode=None):
    """Statistics of a dataset, or of an episode, by feature."""
    if (folder / "meta/stats.json").is_file() and episode is None:
        return json.loads((folder / "meta/stats.json").read_text())
    if (folder / "meta/episodes_stats.jsonl").is_file():
        return json.loads((folder / "meta/episodes_stats.jsonl").read_text().splitlines()[episode or 0])["stats"]
    entry, found = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()[episode], {}
    for name, values in entry.items():
        if name.startswith("stats/"):
            found.setdefault(name.split("/")[1], {})[name.split("/")[2]] = values
    return found


@pytest.fixture(scope="module")
def extended(datasets, scene, tmp_path_factory):
    """Datasets whose states hold the forces, of both layouts."""
    out = tmp_path_factory.mktemp("extended")
    for version in VERSIONS:
        assert annotate(out, datasets / version, scene, "--into", "state") == 0
    return out


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("into", ["feature", "state"])
def test_what_policies_take_is_finite_of_one_shape_and_has_statistics(version, into, annotated, extended):
    folder = (annotated if into == "feature" else extended) / version
    taken = taken_by_policies(folder)
    assert taken.keys() == {"observation.state"} | ({"observation.force"} if into == "feature" else set())
    episodes = np.array([row["episode_index"] for row in rows_of(folder)])
    for name, rows in taken.items():
        assert np.isfinite(rows).all()
        for episode in (0, 1, *([None] if version == "v3.0" else [])):
            own, stats = rows if episode is None else rows[episodes == episode], stats_of(folder, episode)[name]
            assert stats["count"] == [len(own)]
            assert all(np.isfinite(values).all() for values in stats.values())
            for kind in ("mean", "min"):
                np.testing.assert_allclose(stats[kind], getattr(own, kind)(axis=0), rtol=1e-5, atol=1e-7)
            moves = np.ptp(rows, axis=0) > 0.0
            np.testing.assert_allclose(np.array(stats["std"])[moves], own.std(axis=0)[moves], rtol=1e-5, atol=1e-7)
            assert np.all(np.array(stats["std"])[~moves] == 1.0)  # what never changed is not divided by 1e-8


@pytest.mark.parametrize("version", VERSIONS)
def test_nothing_is_missing_once_pandas_has_written_it_anew(version, annotated, tmp_path):
    # as LeRobot does when it converts v2.1, merges, or deletes episodes; it cannot read what is missing
    for number, path in enumerate((annotated / version / "data").rglob("*.parquet")):
        pandas.read_parquet(path).to_parquet(tmp_path / f"{number}.parquet")
        for row in parquet.read_table(tmp_path / f"{number}.parquet").to_pylist():
            assert not any(value is None or (isinstance(value, list) and None in value) for value in row.values())


@pytest.mark.parametrize("version", VERSIONS)
def test_the_state_has_the_forces_at_its_end_under_their_names(version, datasets, extended):
    before, rows = rows_of(datasets / version), rows_of(extended / version)
    info = json.loads((extended / version / "meta/info.json").read_text())["features"]["observation.state"]
    assert info["names"] == ["a", "b", *NAMES] and info["shape"] == [10]
    state = np.array([row["observation.state"] for row in rows], np.float32)
    np.testing.assert_array_equal(state[:, :2], np.float32([row["observation.state"] for row in before]))
    for offset, side in ((2, "left"), (6, "right")):
        told = np.array([row[f"force.{side}"] for row in rows], np.float32)
        valid = np.array([row[f"force.{side}.valid"] for row in rows])
        np.testing.assert_array_equal(state[:, offset + 3], valid)
        np.testing.assert_array_equal(state[valid, offset : offset + 3], told[valid])
    assert not state[:40, 2:].any() and state[-1, 5] == 1.0  # nothing is told before the tare
    schema = parquet.read_schema(next((extended / version / "data").rglob("*.parquet")))
    known = json.loads(schema.metadata[b"huggingface"])["info"]["features"]
    assert known["observation.state"]["length"] == 10 and schema.names[0] == "observation.state"


@pytest.mark.parametrize("warm", [False, True])
def test_the_same_images_give_the_numbers_of_the_dataset_one_by_one(warm, extended, scene):
    camera = scene[0].images.camera
    sensor = ForceSensor(
        "bench",
        camera=[camera.fx, camera.fy, camera.cx, camera.cy],
        extrinsics=scene[0].case["T_gripper_camera"],
        contact_height=1e-3 * HEIGHT,
        calibration="twin",
        detector={"threads": 1, "depth": "none"},
        is_video=True,
    )
    if warm:
        sensor.warm_up()
    source, dataset = ForceInput(sensor, PolicyForces(), FPS), open_dataset(extended / "v2.1", CAMERA)
    for episode in dataset.episodes:
        source.reset()
        rows = parquet.read_table(episode.data)["observation.state"].to_pylist()
        for row, picture in zip(rows, decode_video(episode.video, "one"), strict=True):
            np.testing.assert_allclose(source.update(picture), row[2:], rtol=0.0, atol=1e-6)  # N
    assert source.last.status == "ok"


def same_content(one, other):
    assert (one / "meta/info.json").read_text() and rows_of(one) == rows_of(other)
    first, second = (json.loads((each / "meta/info.json").read_text()) for each in (one, other))
    assert first == second
    for episode in (0, 1):
        assert stats_of(one, episode) == stats_of(other, episode)
    for path in (one / "data").rglob("*.parquet"):
        assert parquet.read_schema(path).equals(parquet.read_schema(other / path.relative_to(one)), True)


@pytest.mark.parametrize("version", VERSIONS)
def test_forces_are_taken_off_again(version, datasets, annotated, extended, tmp_path, capsys):
    for folder in (annotated, extended):
        out = tmp_path / folder.name
        assert main(["annotate", str(folder / version), "--out", str(out), "--remove"]) == 0
        assert "without force.left, " in capsys.readouterr().out or folder is extended
        same_content(out / version, datasets / version)
    assert main(["annotate", str(tmp_path), "--out", str(tmp_path / "none"), "--remove"]) == 2


FROM_THE_FIRST = ("--set", "automatic_tare=no")  # a force in every image


@pytest.fixture(scope="module")
def small(scene, tmp_path_factory):
    """Two episodes of a few images."""
    folder = tmp_path_factory.mktemp("small") / "small"
    write_dataset(folder, [scene[1][:3], scene[1][:5]], "v2.1")
    return folder


def test_forces_that_are_there_are_replaced_and_never_appended_twice(small, scene, tmp_path):
    once, again, other = tmp_path / "once", tmp_path / "again", tmp_path / "other"
    assert annotate(once, small, scene, *FROM_THE_FIRST, "--into", "state") == 0
    assert annotate(again, once / "small", scene, *FROM_THE_FIRST, "--into", "state") == 0
    same_rows = [(row["observation.state"], row["force.reason"]) for row in rows_of(once / "small")]
    assert [(row["observation.state"], row["force.reason"]) for row in rows_of(again / "small")] == same_rows
    info = [json.loads((each / "small/meta/info.json").read_text()) for each in (once, again)]
    assert info[0] == info[1]
    words = ("--columns", "force", "stddev", "grasp", "--jaws", "left")
    assert annotate(other, once / "small", scene, *FROM_THE_FIRST, *words) == 0
    features = json.loads((other / "small/meta/info.json").read_text())["features"]
    assert (
        features["observation.state"]
        == json.loads((small / "meta/info.json").read_text())["features"]["observation.state"]
    )
    names = [f"force.left.{name}" for name in (*"xyz", "stddev.x", "stddev.y", "stddev.z", "valid")]
    assert features["observation.force"]["names"] == [*names, "force.grasp", "force.grasp.stddev", "force.grasp.valid"]
    assert "force.right" not in features


def test_names_of_others_are_kept_and_those_of_policies_refused(small, scene, tmp_path, capsys):
    own = shutil.copytree(small, tmp_path / "own")
    info = json.loads((own / "meta/info.json").read_text())
    info["features"]["force.sensor"] = {"dtype": "float32", "shape": [1], "names": None}
    (own / "meta/info.json").write_text(json.dumps(info))
    for words, said in (
        ((), "has force.sensor already; expected another --prefix"),
        (("--prefix", "observation.finforce"), "begins neither with observation nor with action"),
        (("--prefix", "action"), "begins neither"),
    ):
        assert annotate(tmp_path / "out", own, scene, *FROM_THE_FIRST, *words) == 2
        assert said in capsys.readouterr().err
        assert not (tmp_path / "out" / "own").exists()
    del info["features"]["force.sensor"], info["features"]["observation.state"]
    (own / "meta/info.json").write_text(json.dumps(info))
    assert annotate(tmp_path / "out", own, scene, *FROM_THE_FIRST, "--into", "state") == 2
    assert "observation.state: none; expected a row of floats, or --into feature" in capsys.readouterr().err


def test_an_episode_has_forces_from_its_first_frame_with_the_tare_of_another(datasets, scene, tmp_path, capsys):
    assert annotate(tmp_path, datasets / "v2.1", scene, "--tare-from", "1", "--into", "none") == 0
    assert "left jaw: tare of episode 1, offsets up to" in capsys.readouterr().err
    short = [row for row in rows_of(tmp_path / "v2.1") if row["episode_index"] == 0]
    assert len(short) == SHORT and all(row["force.valid"] for row in short)
    assert max(abs(row["force.left"][0]) for row in short) < 0.15  # N; nothing is held yet
    assert not any(name.startswith("observation.force") for name in short[0])
    assert annotate(tmp_path / "out", datasets / "v2.1", scene, "--tare-from", "7") == 2
    assert "--tare-from 7: v2.1 has no such episode" in capsys.readouterr().err


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


def mark_state(mark):
    """Return what damages the mark that annotate leaves at the state."""

    def change(folder):
        entry = {"dtype": "float32", "shape": [2], "names": None, "info": {"finforce": mark}}
        features = json.loads((folder / "meta/info.json").read_text())["features"]
        change_info(features=features | {"observation.state": entry})(folder)

    return change


def cut_video(folder):
    path = next((folder / "videos").rglob("episode_000000.mp4"))
    path.write_bytes(path.read_bytes()[:500])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lengthen, "3 rows; expected 4"),
        (change_info(total_frames=7), "expected the 7 of"),
        (change_info(codebase_version="v1.6"), "layout v1.6; expected v2.0, v2.1, v3.0"),
        (change_info(fps=0), "fps: got 0, expected"),
        (change_info(features={"a": {"dtype": "float32", "info": []}}), "features.a.info: got none, expected"),
        (change_info(features={"a": {"dtype": "float32", "shape": [0.5]}}), "features.a.shape[0]: got 0.5, expected"),
        (change_info(features={CAMERA: {"dtype": 3}}), f"features.{CAMERA}.dtype: got 3, expected"),
        (mark_state({"kept": "x"}), "kept: got the text 'x', expected"),
        (mark_state([]), "expected a mapping of kept"),
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
