"""Claims about key points from the images of a recording, and how well they were seen."""

import argparse

import numpy as np
import pytest
from rgbd_fakes import FakeDetector, FakeGripper, FakePhotographer, make_footage

from finforce_eval.commands import make_setup
from finforce_eval.detection import awaiting_keypoints, detect_keypoints
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.keypoint_source import KeypointSource, parse_source
from finforce_eval.objects import track_object
from finforce_eval.recording import read_recording
from finforce_eval.sight_scoring import compare_sight, sight_stats
from finforce_eval.twin_writer import write_footage
from finforce_keypoints.images import ImageWatch


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return read_recording(write_footage(make_footage(), tmp_path_factory.mktemp("bags") / "twin"))


def detect(recording, **options):
    detector = FakeDetector(recording, **options)
    return detect_keypoints(recording, detector, watch=ImageWatch()), detector


def test_every_image_is_seen_once_in_order_and_its_key_points_take_their_place(recording):
    found, detector = detect(recording)
    assert np.round(np.array(detector.stamps) * 1e9).astype(int).tolist() == recording.images.stamps.tolist()
    track = found.jaws["left"]
    np.testing.assert_array_equal(track.keypoints.stamps, recording.images.stamps)
    expected = track.sight.points[:, :2] + [3e-4, 0, 0]
    np.testing.assert_allclose(track.keypoints.points[:, :2], expected, atol=1e-8)  # single precision, as by topic
    assert np.isnan(track.keypoints.points[:, 2:]).all()  # not valid: the solver gets no place
    np.testing.assert_array_equal(track.keypoints.stddev[:, 0], np.full((12, 3), 2e-4))
    assert track.detection.accepted.tolist() == [[True, True, False, False]] * 12


def test_an_image_without_the_jaw_has_no_key_points_and_no_pose(recording):
    found, _ = detect(recording, lost=(0, 4))
    track = found.jaws["left"]
    assert np.isnan(track.keypoints.points[[0, 4]]).all() and (track.keypoints.likelihood[[0, 4]] == 0).all()
    assert track.detection.found.tolist() == [index not in (0, 4) for index in range(12)]
    assert len(track.pose.stamps) == 10 and recording.images.stamps[4] not in track.pose.stamps


def test_what_a_detector_refuses_is_counted_and_the_rest_goes_on(recording):
    found, _ = detect(recording, refused=(2, 3))
    assert found.notes[-1] == "2 images refused: no picture for this finder"
    assert found.jaws["left"].detection.found.sum() == 10


def test_a_black_picture_gives_no_key_points(tmp_path):
    folder = write_footage(make_footage(photographer=FakePhotographer(black=(5,))), tmp_path / "twin")
    found, detector = detect(read_recording(folder))
    assert not found.jaws["left"].detection.found[5] and len(detector.stamps) == 11
    assert any("black" in note for note in found.notes)


def test_a_recording_in_which_nothing_is_found_is_refused(recording):
    with pytest.raises(RecordingError, match="no key points in 12 images: no picture for this finder"):
        detect(recording, refused=range(12))
    with pytest.raises(RecordingError, match="no key points in 12 images: no jaw"):
        detect(recording, lost=range(12))


def test_object_poses_meet_the_jaw_poses_that_were_found(recording):
    found, _ = detect(recording)
    track = track_object(found, "left")
    # object at x = -20 mm, jaw at x = -55 mm on the closing axis; four of twelve images, 0.3 mm and 0.3 deg of noise
    np.testing.assert_allclose(track.poses[:, :3, 3].mean(axis=0), [0.035, 0.0, 0.040], atol=1e-3)


def test_scores_count_what_they_say(recording):
    found, _ = detect(recording, accepted=(True, True, False, True))
    track = found.jaws["left"]
    stats = sight_stats([compare_sight(track.detection, track.sight)])
    assert (stats.n_visible, stats.n_hidden) == (36, 12)
    assert stats.pixel_median_px == pytest.approx(1.0, abs=1e-4)  # of 0.6 and 0.8, in single precision
    assert stats.point_median_mm == pytest.approx(0.3, abs=1e-4)
    assert stats.hidden_accepted_pct == 100.0  # the fourth point is hidden and accepted
    assert stats.visible_lost_pct == pytest.approx(100 / 3)  # the third is visible and is not


def test_a_jaw_that_is_not_found_has_lost_all_its_points(recording):
    found, _ = detect(recording, lost=(0, 1, 2), accepted=(True,) * 3 + (False,))
    track = found.jaws["left"]
    stats = sight_stats([compare_sight(track.detection, track.sight)])
    assert stats.visible_lost_pct == pytest.approx(25.0) and stats.hidden_accepted_pct == 0.0


def test_no_detection_has_no_numbers():
    stats = sight_stats([])
    assert stats.n_visible == 0 and stats.pixel_median_px is None and stats.visible_lost_pct is None


def test_true_key_points_are_those_the_camera_could_see(recording):
    track = KeypointSource(source="truth").apply(recording).jaws["left"]
    np.testing.assert_array_equal(track.keypoints.points[:, :3], track.sight.points[:, :3])
    assert np.isnan(track.keypoints.points[:, 3]).all()
    assert track.keypoints.likelihood.tolist() == [[1.0, 1.0, 1.0, 0.0]] * 12
    assert track.pose is track.true_pose and track.detection is None


def test_key_points_come_from_where_they_are_and_from_where_they_are_wanted(recording):
    assert KeypointSource().source_of(recording) == "images"
    found, _ = detect(recording)
    assert KeypointSource().source_of(found) == "keypoints"
    assert KeypointSource(source="images").source_of(found) == "images"
    with pytest.raises(RecordingError, match="--from keypoints: not in this recording, which has images, truth"):
        KeypointSource(source="keypoints").source_of(recording)
    again = awaiting_keypoints(found).jaws["left"]
    assert again.is_awaited and again.pose is None


def test_the_camera_of_the_recording_is_the_one_of_the_node(recording):
    parameters = KeypointSource().node_parameters(recording)
    assert parameters["jaws"] == "left" and parameters["camera_frame"] == "camera_color_optical_frame"
    assert (
        parameters["T_gripper_camera"] == recording.case["T_gripper_camera"]
        and len(parameters["T_gripper_camera"]) == 7
    )
    other = KeypointSource(parameters={"T_gripper_camera": [0.0] * 6 + [1.0]}).node_parameters(recording)
    assert other["T_gripper_camera"] == [0.0] * 6 + [1.0]


def options(**given):
    return argparse.Namespace(**{"jaw": "bench", "source": None, "detector": [], "extrinsics": None, **given})


def test_extrinsics_are_a_name_or_seven_numbers():
    assert len(parse_source(options(extrinsics="bench")).parameters["T_gripper_camera"]) == 7
    given = parse_source(options(extrinsics="0,0,0.1,0,0,0,1")).parameters["T_gripper_camera"]
    assert given == [0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]
    with pytest.raises(OptionError, match="expected robot, bench"):
        parse_source(options(extrinsics="here"))


def test_key_points_of_two_jaws_come_in_one_pass(tmp_path):
    folder = write_footage(make_footage(FakeGripper(sides=("left", "right"))), tmp_path / "both")
    recording = read_recording(folder)
    found, detector = detect(recording)
    assert len(detector.stamps) == 12 and found.jaws.keys() == {"left", "right"}
    assert KeypointSource().node_parameters(recording)["jaws"] == "both"


def test_the_set_up_needs_no_source():
    names = argparse.Namespace(jaw="bench", solver="default", mesh="default", contact=[], calibration=None)
    assert "images" in make_setup(names).about["keypoints"]
