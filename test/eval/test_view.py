"""Claims about `finforce view`: the file holds pictures, jaws and forces as they were found, at their times."""

import numpy as np
import pytest

pytest.importorskip("rerun")
chunk = pytest.importorskip("rerun.chunk")

from finforce_eval.cli.main import main, parse  # noqa: E402
from finforce_eval.evaluation.forces import estimate_forces  # noqa: E402
from finforce_eval.evaluation.setup import make_setup  # noqa: E402
from finforce_eval.recordings.recording import read_recording  # noqa: E402
from lab.scenes import GRASP, find_scene  # noqa: E402


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A rendered grasp in Rerun: recording, and the rows of each entity."""
    source = find_scene(GRASP)
    file = tmp_path_factory.mktemp("view") / "grasp.rrd"
    words = ["--from", "images", "--calibration", "twin"]
    assert main(["view", str(source), "--save", str(file), *words]) == 0
    rows = {}
    for piece in chunk.RrdReader(str(file)).stream().to_chunks():
        rows.setdefault(piece.entity_path, []).append(piece.to_record_batch())
    return source, words, rows


def column(batches, ending):
    """The values of the first column whose name ends so, in the order of the recording's time."""
    times, values = [], []
    for batch in batches:
        names = batch.schema.names
        chosen = [name for name in names if name.endswith(ending)]
        if chosen and "recording" in names:
            times += batch.column("recording").cast("int64").to_pylist()
            values += batch.column(chosen[0]).to_pylist()
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], [values[index] for index in order]


def test_every_picture_is_there_at_its_time(scene):
    source, _, rows = scene
    times, pictures = column(rows["/camera"], "blob")
    np.testing.assert_allclose(times, read_recording(source).images.all_colors().stamps, atol=1000)
    assert all(bytes(picture[0])[:2] == b"\xff\xd8" for picture in pictures)
    for side in ("left", "right"):
        assert len(column(rows[f"/camera/{side}"], "positions")[0]) == len(times)


def test_jaws_bend_and_forces_are_those_that_were_found(scene):
    source, words, rows = scene
    options = parse(["view", str(source), "--save", "x.rrd", *words])
    from finforce_eval.evaluation.setup import read_keypoints

    (recording,) = read_keypoints(options)
    shapes = {"left": [], "right": []}

    def watch(side, stamp, estimator):
        shapes[side].append(np.array(estimator.surface()))

    forces = estimate_forces(recording, make_setup(options), watch=watch)
    for side in ("left", "right"):
        times, values = column(rows[f"/forces/{side}"], "scalars")
        expected = np.linalg.norm(forces[side].force, axis=1)
        np.testing.assert_allclose(times, forces[side].stamps, atol=1000)
        np.testing.assert_allclose([value[0] for value in values], expected)
        assert np.isnan(expected[:40]).all() and np.nanmax(expected) > 2.0
        _, meshes = column(rows[f"/jaws/{side}/surface"], "vertex_positions")
        assert len(meshes) == len(shapes[side])
        np.testing.assert_allclose(meshes[-40], shapes[side][-40], atol=1e-7)
        moved = np.abs(np.asarray(meshes[100]) - np.asarray(meshes[10])).max()
        assert moved > 1e-3


def test_an_arrow_stands_where_something_presses_and_only_there(scene):
    _, _, rows = scene
    _, values = column(rows["/forces/left"], "scalars")
    pressed = np.nan_to_num([value[0] for value in values]) > 0.0
    times, _ = column(rows["/jaws/left/force/arrow"], "vectors")
    assert len(times) == pressed.sum() > 20


def test_another_ending_or_a_folder_that_is_none_is_refused(scene, tmp_path, capsys):
    source, _, _ = scene
    assert main(["view", str(source), "--save", str(tmp_path / "x.mp4")]) == 2
    assert "ends in .rrd" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["view", str(source), "--save", str(tmp_path / "file" / "x.rrd"), "--calibration", "twin"]) == 2
    assert "Traceback" not in capsys.readouterr().err
