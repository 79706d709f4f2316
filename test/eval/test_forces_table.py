"""Claims about `finforce.evaluate`: the forces of the command as a table, of recordings, images and folders."""

import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow
import pytest
from eval_fakes import cut
from pyarrow import parquet
from rgbd_fakes import make_fake_recording

import finforce as ff
from finforce_eval.cli.main import main
from finforce_eval.cli.twin import write_simulated_recording
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.keypoint_source import KeypointSource
from finforce_eval.recordings.writer import write_recording
from finforce_eval.table import read_table

EXAMPLES = Path(__file__).parents[2] / "examples"
IMAGES, FEW = 90, 8
FORCE = ["force_x", "force_y", "force_z"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the first seconds of the included recording."""
    folder = tmp_path_factory.mktemp("bags")
    write_recording(cut_start(ff.read_recording(ff.DEMO), IMAGES), folder / "first")
    return folder


def cut_start(recording, images):
    """The first images of a recording of 30 Hz."""
    begin = int(recording.jaw("left").keypoints.stamps_ns[0])
    return cut(recording, begin, begin + images * 10**9 // 30)


def test_the_forces_are_those_of_the_command_with_stamps_in_seconds(folder, tmp_path):
    options = ["--contact", "fixed:40", "--calibration", "bench", "--set", "friction=0.1"]
    assert main(["evaluate", str(folder / "first"), *options, "--out", str(tmp_path), "-q"]) == 0
    kept = pd.read_parquet(tmp_path / "first.parquet")
    found = ff.evaluate(
        folder / "first", contact_height=0.040, calibration="bench", settings=ff.EstimatorSettings(friction=0.1)
    )
    np.testing.assert_array_equal(found[FORCE], kept[FORCE])
    assert np.isfinite(found[FORCE]).all(axis=1).any()
    np.testing.assert_allclose(found["stamp"], 1e-9 * kept["stamp"], rtol=1e-15)
    assert found.attrs["units"] | {"stamp": "s", "force_x": "N"} == found.attrs["units"]


def test_a_folder_of_recordings_gives_all_of_them(folder, tmp_path):
    for name in ("first", "second"):
        write_recording(cut_start(ff.read_recording(folder / "first"), FEW), tmp_path / name)
    (tmp_path / "notes.txt").write_text("none")
    found = ff.evaluate(str(tmp_path), contact_height=0.040, calibration="bench", stills=True)
    assert found.groupby("case").size().to_dict() == {"first": FEW, "second": FEW}
    assert not found.isna()["status"].any()


def test_forces_come_from_images(folder, tmp_path, monkeypatch):
    path, looked = write_simulated_recording(make_fake_recording(), tmp_path / "twin"), []
    keypoints = ff.read_recording(folder / "first").jaws

    def detect(source, recording):
        looked.append((len(recording.images), source.parameters))
        return replace(recording, jaws=keypoints)

    monkeypatch.setattr(KeypointSource, "_detect", detect)
    given = {"contact_height": 0.040, "calibration": "bench"}
    found = ff.evaluate(path, source="images", extrinsics="robot", detector={"depth": "none"}, **given)
    ((images, parameters),) = looked
    assert images == 12 and parameters["depth"] == "none" and len(parameters["T_gripper_camera"]) == 7
    assert len(found) == IMAGES and np.isfinite(found[FORCE]).all(axis=1).any()


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"contact_height": 0.04, "object_mesh": "can.stl"}, "expected one of the two"),
        ({"contact_height": 40.0}, "contact height 40000 mm, expected"),
        ({"jaw": "bnch"}, "did you mean bench"),
        ({"settings": {"frction": 0.1}}, "frction"),
    ],
)
def test_what_cannot_be_used_is_said(folder, given, reason):
    with pytest.raises((ValueError, TypeError), match=reason):
        ff.evaluate(folder / "first", **given)


def test_a_path_that_is_no_recording_is_named(tmp_path):
    with pytest.raises(ValueError, match="nowhere: no such recording"):
        ff.evaluate(tmp_path / "nowhere", contact_height=0.04)


def test_the_example_prints_the_largest_force_of_each_recording(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["evaluate_recordings.py"])
    runpy.run_path(str(EXAMPLES / "evaluate_recordings.py"))
    assert re.search(r"\nbench_cyl25_middle +left +4\.1 ", capsys.readouterr().out)
    assert len(pd.read_csv("forces.csv")) == len(ff.read_recording(ff.DEMO).jaw("left").keypoints.stamps)


def test_the_example_prints_a_line_per_image(tmp_path, monkeypatch, capsys):
    path, sensor = write_simulated_recording(make_fake_recording(), tmp_path / "twin"), ff.ForceSensor
    monkeypatch.setattr(ff, "ForceSensor", lambda *given, **more: sensor(*given, **more | {"calibration": "bench"}))
    monkeypatch.setattr(sys, "argv", ["images_to_forces.py", str(path)])
    runpy.run_path(str(EXAMPLES / "images_to_forces.py"))
    assert capsys.readouterr().out.count(" s  ") == 12


@pytest.mark.parametrize("metadata", [None, {b"pandas": b"{}"}])
def test_a_table_of_another_program_is_named_as_such(metadata, tmp_path):
    table = pyarrow.table({"a": [1.0]}).replace_schema_metadata(metadata)
    parquet.write_table(table, tmp_path / "a.parquet")
    with pytest.raises(RecordingError, match="a.parquet: a table of another program; expected what finforce evaluate"):
        read_table(tmp_path / "a.parquet")
