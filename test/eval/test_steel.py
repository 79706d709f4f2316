"""Claims about the recording made of the measured steel finger."""

import json

import numpy as np
import pytest

from finforce_eval.cli.convert_steel import SHIPPED, points_from_picture, recording_from_measurement
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_ifea.jaw.jaw import load_jaw


@pytest.fixture(scope="module")
def measurement():
    return json.loads(SHIPPED.read_text())


def test_loaded_strip_lies_towards_the_object_and_heights_stay():
    points = points_from_picture([[0.0, 27.0], [73.24, 0.0]])
    np.testing.assert_allclose(points, [[0.03662, 0, 0.027], [-0.03662, 0, 0]])


def test_pictures_show_the_key_points_of_the_steel_jaw_in_its_order(measurement):
    jaw = load_jaw("steel")
    points = recording_from_measurement(measurement).jaws["left"].keypoints.points
    assert points.shape == (540, 8, 3)
    # 5 mm pressed in, and screws beside the strip: every hinge within 10 mm of where it is unloaded
    assert np.linalg.norm(points[0] - jaw.keypoints, axis=1).max() < 0.010
    # pressed further, the loaded strip goes back
    assert (np.diff(points[::90, 2, 0]) < 0).all()


def test_truth_has_the_measured_magnitude_along_minus_x(measurement):
    truth = recording_from_measurement(measurement).jaws["left"].truth
    np.testing.assert_allclose(np.linalg.norm(truth.force, axis=1)[::90], np.linalg.norm(measurement["force"], axis=1))
    assert (truth.force[:, 0] < 0).all()
    assert (truth.force[:, 1:] == 0).all()


def test_every_level_settles_and_is_recorded_as_long_as_the_others(measurement):
    recording = recording_from_measurement(measurement)
    stamps = recording.jaws["left"].keypoints.stamps
    rows = recording.phases.index_at(stamps)[recording.phases_at(stamps)["scored"]]
    levels = recording.phases.displacement_mm[rows]
    assert levels.tolist() == np.repeat([5, 10, 15, 20, 25, 30], 30).tolist()


def test_recording_survives_a_bag(tmp_path, measurement):
    recording = recording_from_measurement(measurement)
    read = read_recording(write_recording(recording, tmp_path / "steel"))
    np.testing.assert_allclose(read.jaws["left"].keypoints.points, recording.jaws["left"].keypoints.points, atol=1e-8)
    assert read.case == recording.case


@pytest.mark.parametrize(
    "change",
    [{"nodes": []}, {"force": [[1, 2]]}, {"object": {}}, {"nodes": [[[1.0]]] * 6}, {"displacement_mm": "x"}],
)
def test_other_content_is_refused(measurement, change):
    with pytest.raises(RecordingError, match="steel_r20"):
        recording_from_measurement(measurement | change)
