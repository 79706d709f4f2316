"""Claims about `finforce view`: the file holds pictures, jaws and forces as they were found, at their times."""

import re
import socket
from dataclasses import replace
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
from eval_fakes import QUICK_GRASP

if find_spec("rerun") is None:
    pytest.skip("the viewer needs rerun-sdk", allow_module_level=True)

from finforce_eval.cli import view
from finforce_eval.cli.main import main
from finforce_eval.evaluation.forces import estimate_forces
from finforce_eval.recordings.recording import DEMO, read_recording
from lab.scenes import find_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A rendered grasp in Rerun: recording, and the rows of each entity."""
    source = find_scene(QUICK_GRASP)
    file = tmp_path_factory.mktemp("view") / "grasp.rrd"
    shapes, found = {"left": [], "right": []}, {}

    def estimate(recording, setup, *, run):
        def see(side, stamp, estimator):
            shapes[side].append(np.array(estimator.surface()))
            run.watch(side, stamp, estimator)

        found.update(estimate_forces(recording, setup, run=replace(run, watch=see)))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(view, "estimate_shown", estimate)
        assert main(["view", str(source), "--save", str(file), "--from", "images", "--calibration", "twin"]) == 0
    chunk, rows = pytest.importorskip("rerun.chunk"), {}
    for piece in chunk.RrdReader(str(file)).stream().to_chunks():
        rows.setdefault(piece.entity_path, []).append(piece.to_record_batch())
    return SimpleNamespace(source=source, rows=rows, forces=found, shapes=shapes)


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
    source, rows = scene.source, scene.rows
    times, pictures = column(rows["/camera"], "blob")
    np.testing.assert_allclose(times, read_recording(source).images.all_colors().stamps_ns, atol=1000)
    assert all(bytes(picture[0])[:2] == b"\xff\xd8" for picture in pictures)
    for side in ("left", "right"):
        assert len(column(rows[f"/camera/{side}"], "positions")[0]) == len(times)


def test_jaws_bend_and_forces_are_those_that_were_found(scene):
    forces, shapes, rows = scene.forces, scene.shapes, scene.rows
    for side in ("left", "right"):
        times, values = column(rows[f"/forces/{side}"], "scalars")
        expected = np.linalg.norm(forces[side].force, axis=1)
        np.testing.assert_allclose(times, forces[side].stamps_ns, atol=1000)
        np.testing.assert_allclose([value[0] for value in values], expected)
        assert np.isnan(expected[:40]).all() and np.nanmax(expected) > 2.0
        _, meshes = column(rows[f"/jaws/{side}/surface"], "vertex_positions")
        assert len(meshes) == len(shapes[side])
        pressed = int(np.nanargmax(expected))
        np.testing.assert_allclose(meshes[pressed], shapes[side][pressed], atol=1e-7)
        moved = np.abs(np.asarray(meshes[pressed]) - np.asarray(meshes[10])).max()
        assert moved > 1e-3


def test_an_arrow_stands_where_something_presses_and_only_there(scene):
    rows = scene.rows
    _, values = column(rows["/forces/left"], "scalars")
    pressed = np.nan_to_num([value[0] for value in values]) > 0.0
    times, _ = column(rows["/jaws/left/force/arrow"], "vectors")
    assert len(times) == pressed.sum() > 10


@pytest.mark.parametrize(
    ("display", "words"), [(None, "no screen.* --save FILE.rrd"), (":0", "does not start; --save")]
)
def test_without_a_screen_or_its_viewer_a_file_is_to_be_written(display, words, monkeypatch, capsys):
    for name in view.DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    if display:
        monkeypatch.setenv("DISPLAY", display)
    with socket.create_server(("127.0.0.1", 0)) as free:
        monkeypatch.setattr(view, "PORT", free.getsockname()[1])
    monkeypatch.setattr(view, "which", lambda program, path: "/nowhere/rerun")
    assert main(["view", str(DEMO), "--contact", "fixed:40", "--calibration", "bench"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(words, line)


def test_another_ending_or_a_folder_that_is_none_is_refused(tmp_path, capsys):
    assert main(["view", str(DEMO), "--save", str(tmp_path / "x.mp4")]) == 2
    assert "ends in .rrd" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    words = ["--contact", "fixed:40", "--calibration", "bench"]
    assert main(["view", str(DEMO), "--save", str(tmp_path / "file" / "x.rrd"), *words]) == 2
    assert "Traceback" not in capsys.readouterr().err
