"""Claims about the recording of the measured steel finger: it is what the pictures and the sensor say."""

import json

import numpy as np
import pytest

import finforce as ff
from finforce_eval.recordings.recording import DEMO, read_recording
from finforce_ifea.jaw.jaw import load_jaw

STEEL = DEMO.with_name("steel_r20")
FRAMES = 90  # of a level


@pytest.fixture(scope="module")
def measurement():
    return json.loads((STEEL / "finray_steel_r20.json").read_text())


@pytest.fixture(scope="module")
def recording():
    return read_recording(STEEL)


def test_pictures_show_the_key_points_of_the_steel_jaw_in_its_order(recording, measurement):
    points = recording.jaws["left"].keypoints.points
    assert points.shape == (540, 8, 3) and (points[..., 1] == 0.0).all()
    nodes = 1e-3 * np.array(measurement["nodes"])
    np.testing.assert_allclose(0.03662 - points[::FRAMES, :, 0], nodes[..., 0], atol=1e-8)
    np.testing.assert_allclose(points[::FRAMES, :, 2], nodes[..., 1], atol=1e-8)
    # 5 mm pressed in, and screws beside the strip: every hinge within 10 mm of where it is unloaded
    assert np.linalg.norm(points[0] - load_jaw("steel").keypoints, axis=1).max() < 0.010
    # pressed further, the loaded strip goes back
    assert (np.diff(points[::FRAMES, 2, 0]) < 0).all()


def test_truth_has_the_measured_magnitude_along_minus_x(recording, measurement):
    truth = recording.jaws["left"].truth
    np.testing.assert_allclose(-truth.force[::FRAMES, 0], np.linalg.norm(measurement["force"], axis=1))
    assert (truth.force[:, 1:] == 0).all()


def test_every_level_settles_and_is_recorded_as_long_as_the_others(recording, measurement):
    stamps = recording.jaws["left"].keypoints.stamps_ns
    rows = recording.phases.index_at(stamps)[recording.phases_at(stamps)["scored"]]
    assert recording.phases.displacement_mm[rows].tolist() == np.repeat(measurement["displacement_mm"], 30).tolist()


def test_forces_of_the_photographs_are_within_their_deviation_and_of_one_stiffness():
    found = ff.evaluate(STEEL, jaw="steel", stills=True)
    photographs = found.iloc[::FRAMES]
    told = np.linalg.norm(photographs[["force_x", "force_y", "force_z"]], axis=1)
    true = -photographs["true_force_x"].to_numpy()
    assert np.sqrt(np.mean((told - true) ** 2)) < 0.7
    assert (np.abs(told - true) < 1.5 * photographs["magnitude_stddev"]).all()
    kept = ~np.eye(len(true), dtype=bool)  # one factor from five of the photographs, tested on the sixth
    factors = [told[k] @ true[k] / (told[k] @ told[k]) for k in kept]
    assert np.sqrt(np.mean((factors * told - true) ** 2)) < 0.4
    repeated = found[["force_x", "force_z"]].to_numpy().reshape(-1, FRAMES, 2)  # of a photograph, seen again
    np.testing.assert_array_equal(repeated, np.broadcast_to(repeated[:, :1], repeated.shape))
