"""Claims about key points from the images of a recording, and how well they were seen."""

import argparse
from dataclasses import replace

import numpy as np
import pytest
from rgbd_fakes import FakeCamera, FakeDetector, FakeGripper, make_fake_recording

from finforce.errors import PoseError
from finforce_eval.cli.main import main
from finforce_eval.cli.twin import write_simulated_recording
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.keypoint_source import KeypointSource, awaiting_keypoints, detect_keypoints, parse_source
from finforce_eval.evaluation.scoring import compare_detection, detection_stats
from finforce_eval.evaluation.setup import make_setup
from finforce_eval.recordings.objects import track_object
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_keypoints.images import check_image
from finforce_keypoints.parameters import DetectorParameters


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return read_recording(write_simulated_recording(make_fake_recording(), tmp_path_factory.mktemp("bags") / "twin"))


def is_found(track):
    """In which images the jaw was found."""
    return np.isfinite(track.detection.pixels).any(axis=(1, 2))


def detect(recording, **options):
    detector = FakeDetector(recording, **options)
    return detect_keypoints(recording, detector), detector


def test_every_image_is_seen_once_in_order_and_its_key_points_take_their_place(recording):
    found, detector = detect(recording)
    assert np.round(np.array(detector.stamps) * 1e9).astype(int).tolist() == recording.images.stamps_ns.tolist()
    track = found.jaws["left"]
    np.testing.assert_array_equal(track.keypoints.stamps_ns, recording.images.stamps_ns)
    expected = track.sight.points[:, :2] + [3e-4, 0, 0]
    np.testing.assert_allclose(track.keypoints.points[:, :2], expected, atol=1e-8)  # single precision, as by topic
    assert np.isnan(track.keypoints.points[:, 2:]).all()  # not valid: the solver gets no place
    np.testing.assert_array_equal(track.keypoints.stddev[:, 0], np.full((12, 3), 2e-4))
    assert track.detection.accepted.tolist() == [[True, True, False, False]] * 12


def test_why_a_key_point_was_refused_is_kept(recording):
    detection = detect(recording, lost=(4,))[0].jaws["left"].detection
    assert detection.reasons[3].tolist() == ["", "", "likelihood", "likelihood"]
    assert detection.reasons[4].tolist() == [""] * 4


def test_an_image_without_the_jaw_has_no_key_points_and_no_pose(recording):
    found, _ = detect(recording, lost=(0, 4))
    track = found.jaws["left"]
    assert np.isnan(track.keypoints.points[[0, 4]]).all() and (track.keypoints.likelihood[[0, 4]] == 0).all()
    assert is_found(track).tolist() == [index not in (0, 4) for index in range(12)]
    assert len(track.pose.stamps_ns) == 10 and recording.images.stamps_ns[4] not in track.pose.stamps_ns


def test_what_a_detector_refuses_is_counted_and_the_rest_goes_on(recording):
    found, _ = detect(recording, refused=(2, 3))
    assert found.notes[-1] == "2 images rejected: no picture for this detector"
    assert is_found(found.jaws["left"]).sum() == 10


def test_what_a_detector_warns_of_is_a_note_once(recording):
    found, _ = detect(recording, warnings={"left": "it lies 3.1 mm off"})
    assert [note for note in found.notes if "3.1" in note] == ["left jaw: it lies 3.1 mm off"]
    with pytest.raises(RecordingError, match="left jaw: it lies 3.1 mm off"):
        detect(recording, warnings={"left": "it lies 3.1 mm off"}, lost=range(12))


class WithoutDepth(FakeDetector):
    """Sees no depth in two images."""

    def detect(self, image):
        if len(self.stamps) < 2:
            image = replace(image, depth=np.full_like(image.depth, np.nan))
        self.stamps.append(image.stamp)
        check_image(image)
        return super().detect(image)


def test_images_without_depth_are_a_note(recording):
    found = detect_keypoints(recording, WithoutDepth(recording))
    assert found.notes[-1].startswith("2 images rejected: the depth image is empty")
    assert is_found(found.jaws["left"]).tolist() == [False, False] + [True] * 10


def test_a_black_picture_gives_no_key_points(tmp_path):
    folder = write_simulated_recording(make_fake_recording(simulated_camera=FakeCamera(black=(5,))), tmp_path / "twin")
    found, detector = detect(read_recording(folder))
    assert not is_found(found.jaws["left"])[5] and len(detector.stamps) == 11
    assert any("black" in note for note in found.notes)


def test_a_recording_in_which_nothing_is_found_is_refused(recording):
    with pytest.raises(RecordingError, match="no key points in 12 images: no picture for this detector"):
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
    stats = detection_stats([compare_detection(track.detection, track.sight)])
    assert (stats["n_visible"], stats["n_hidden"]) == (36, 12)
    assert stats["pixel_median_px"] == pytest.approx(1.0, abs=1e-4)  # of 0.6 and 0.8, in single precision
    assert stats["point_median_mm"] == pytest.approx(0.3, abs=1e-4)
    assert stats["hidden_accepted_pct"] == 100.0  # the fourth point is hidden and accepted
    assert stats["visible_lost_pct"] == pytest.approx(100 / 3)  # the third is visible and is not


def test_a_jaw_that_is_not_found_has_lost_all_its_points(recording):
    found, _ = detect(recording, lost=(0, 1, 2), accepted=(True,) * 3 + (False,))
    track = found.jaws["left"]
    stats = detection_stats([compare_detection(track.detection, track.sight)])
    assert stats["visible_lost_pct"] == pytest.approx(25.0) and stats["hidden_accepted_pct"] == 0.0


def test_no_detection_has_no_numbers():
    stats = detection_stats([])
    assert stats["n_visible"] == 0 and stats["pixel_median_px"] is None and stats["visible_lost_pct"] is None


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


def test_the_depth_step_of_the_recording_is_that_of_the_detector(recording):
    assert KeypointSource().node_parameters(recording)["depth_scale"] == 1e-3
    fine = replace(recording, case={**recording.case, "depth_scale": 1e-4})
    own = KeypointSource().node_parameters(fine)
    assert (own["depth_scale"], own["detector.quantum"]) == (1e-4, 1e-4)
    assert KeypointSource(parameters={"depth_scale": 0.002}).node_parameters(fine)["depth_scale"] == 0.002


def options(**given):
    return argparse.Namespace(**{"jaw": "bench", "source": None, "detector": [], "extrinsics": None, **given})


def test_extrinsics_are_a_name_or_seven_numbers():
    assert len(parse_source(options(extrinsics="bench")).parameters["T_gripper_camera"]) == 7
    given = parse_source(options(extrinsics="0,0,0.1,0,0,0,1")).parameters["T_gripper_camera"]
    assert given == [0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]
    with pytest.raises(OptionError, match="--extrinsics: T_gripper_camera is 105 m from .* in millimetres?"):
        parse_source(options(extrinsics="0,95,-45,0,0,0,1"))
    with pytest.raises(PoseError, match="in millimetres?"):
        _ = DetectorParameters(T_gripper_camera=(0.0, 95.0, -45.0, 0.0, 0.0, 0.0, 1.0)).camera_pose
    with pytest.raises(OptionError, match=r"--extrinsics: \['here'\]: expected robot, bench"):
        parse_source(options(extrinsics="here"))
    with pytest.raises(OptionError, match="--extrinsics: .*a quaternion of norm 0"):
        parse_source(options(extrinsics="0,0,0.1,0,0,0,0"))


def test_key_points_of_two_jaws_come_in_one_pass(tmp_path):
    folder = write_simulated_recording(make_fake_recording(FakeGripper(sides=("left", "right"))), tmp_path / "both")
    recording = read_recording(folder)
    found, detector = detect(recording)
    assert len(detector.stamps) == 12 and found.jaws.keys() == {"left", "right"}
    assert KeypointSource().node_parameters(recording)["jaws"] == "both"


def test_the_set_up_needs_no_source():
    names = argparse.Namespace(jaw="bench", solver="default", mesh="default", contact=[], calibration=None)
    assert "images" in make_setup(names).about["keypoints"]


class Watching(FakeDetector):
    """Keeps the depth images that it is shown."""

    def detect(self, image):
        self.__dict__.setdefault("depths", []).append(image.depth)
        return super().detect(image)


def detect_with(recording, monkeypatch, *changes):
    """The recording with its key points, and the detector that found them, as `--detector` CHANGES would have it."""
    detector = Watching(recording)
    monkeypatch.setattr(KeypointSource, "build", lambda source, recording: detector)
    return parse_source(options(source="images", detector=list(changes))).apply(recording), detector


def test_a_camera_is_frozen_offline_when_it_is_in_the_node(tmp_path, monkeypatch):
    simulated_camera = FakeCamera(frozen=(3, 4, 5, 6, 7))
    recording = read_recording(
        write_simulated_recording(make_fake_recording(simulated_camera=simulated_camera), tmp_path / "twin")
    )
    found, detector = detect_with(recording, monkeypatch)
    assert len(detector.stamps) == 12 - 3
    assert any("frozen" in note for note in found.notes)


def test_the_step_of_the_depth_image_is_that_of_the_parameter(recording, monkeypatch):
    _, fine = detect_with(recording, monkeypatch, "depth_scale=0.0001")
    _, plain = detect_with(recording, monkeypatch)
    np.testing.assert_allclose(fine.depths, 0.1 * np.array(plain.depths), rtol=1e-6)


def test_colour_and_depth_belong_together_as_the_parameter_says():
    assert parse_source(options()).choice.pairing is None
    assert parse_source(options(detector=["sync_tolerance=0.012"])).choice.pairing == 12_000_000


@pytest.mark.parametrize("source", ["truth", "keypoints"])
@pytest.mark.parametrize("given", [{"detector": ["threads=1"]}, {"extrinsics": "bench"}])
def test_options_of_the_detector_are_refused_where_it_finds_nothing(source, given):
    (name,) = given
    with pytest.raises(OptionError, match=f"--{name}: --from {source} needs no detector; leave it out"):
        parse_source(options(source=source, **given))


DECIDED = ("jaws=left", "jaw_file=steel", "camera_frame=cam", "color_topics=/a", "depth_topic=/b", "info_topic=/c")


@pytest.mark.parametrize("change", DECIDED)
def test_what_something_else_decides_is_refused_by_name(change):
    with pytest.raises(OptionError, match=f"--detector {change.split('=')[0]}: cannot be set here"):
        parse_source(options(detector=[change]))


@pytest.mark.parametrize("name", ["max_age", "diagnostics_period"])
def test_what_needs_a_clock_is_refused_offline_and_reaches_the_node_of_a_replay(recording, name):
    source = parse_source(options(source="images", detector=[f"{name}=0.5"]))
    with pytest.raises(OptionError, match=f"--detector {name}: means nothing offline"):
        source.apply(recording)
    assert source.node_parameters(recording)[name] == 0.5


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("detection_method=foo", "detection_method: got 'foo', expected one of network, frame, dots"),
        ("depth=maybe", "depth: got 'maybe', expected one of aligned, auto, none"),
        ("threads=0", "threads: got 0, expected 1 to 64"),
        ("detector.readout=9", "readout: got 9.0, expected"),
        ("dots.kind=green", "kind: got 'green', expected"),
        ("threads=many", "'many' is not of type int"),
        ("treads=2", "unknown parameter; did you mean threads?"),
    ],
)
def test_a_parameter_of_the_detector_that_cannot_be_is_one_line_and_two(capsys, change, reason):
    for command in ("evaluate", "replay"):
        assert main([command, "no_such_bag", "--from", "images", "--detector", change]) == 2
        said = capsys.readouterr().err.strip().splitlines()
        assert len(said) == 1 and "--detector" in said[0] and reason in said[0]


def test_a_track_with_standard_deviations_comes_back_from_a_bag(recording, tmp_path):
    found, _ = detect(recording)
    plain = replace(found, images=None, case={})
    track = read_recording(write_recording(plain, tmp_path / "bag")).jaws["left"].keypoints
    for name in ("stamps_ns", "points", "stddev"):
        expected = getattr(found.jaws["left"].keypoints, name)
        np.testing.assert_allclose(getattr(track, name), expected, rtol=1e-6)  # single precision
