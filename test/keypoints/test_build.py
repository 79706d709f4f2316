"""Claims about the detector that parameters ask for: how it finds pixels, and which are refused before any image."""

from dataclasses import replace
from hashlib import sha256

import pytest
from keypoint_scene_fakes import Fake, lost_sides, small_jaws, write_model

from finforce_keypoints.build import build_detector, build_pixel_detector, choose_network
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.detectors.dots import DotDetector
from finforce_keypoints.detectors.side_plane import SidePlaneDetector
from finforce_keypoints.detectors.whole_image import WholeImageDetector
from finforce_keypoints.errors import GeometryError, ModelError, NamingError
from finforce_keypoints.parameters import DetectorParameters, DetectorSettings, load_jaws

PLANE = {"scale": 0.45e-3, "x": -0.036, "z": -0.012, "width": 176, "height": 224, "side_y": 0.010}
ONE_JAW = Fake(names=("inner_7", "tip", "reference"), colours=("red", "green", "blue"))


def detector_of(**given):
    return build_pixel_detector(small_jaws(), DetectorParameters(**given), DetectorSettings())


def test_a_network_of_side_planes_is_used_by_the_plane_finder(tmp_path):
    folder = write_model(tmp_path / "net", ONE_JAW, finforce__plane=PLANE)
    built = detector_of(model=str(folder))
    assert isinstance(built, SidePlaneDetector)
    assert built.sha256 == sha256((folder / "network.onnx").read_bytes()).hexdigest()
    assert built.name == "network net"


def test_the_finger_chooses_among_the_shipped_networks():
    for name, folder in (("bench", "plane"), ("umi", "side_plane"), ("ssg48_fin_ray_1", "side_plane")):
        assert choose_network(load_jaws(DetectorParameters(jaw_file=name))).name == folder
    parameters = DetectorParameters(threads=1)
    built = build_pixel_detector(load_jaws(parameters), parameters, DetectorSettings())
    assert isinstance(built, SidePlaneDetector) and built.name == "network plane"


def test_any_network_is_used_by_the_frame_finder(tmp_path):
    folder = write_model(tmp_path / "net", ONE_JAW)
    assert isinstance(detector_of(detection_method="frame", model=str(folder)), WholeImageDetector)


def test_dots_need_no_network():
    built = detector_of(detection_method="dots", model="no_such_folder")
    assert isinstance(built, DotDetector) and built.sha256 == ""


def test_body_parts_get_other_names_by_parameter(tmp_path):
    folder = write_model(tmp_path / "net", replace(ONE_JAW, names=("nail", "tip", "reference")))
    with pytest.raises(NamingError, match="nail"):
        detector_of(detection_method="frame", model=str(folder))
    detector_of(detection_method="frame", model=str(folder), names=("nail=inner_7",))


@pytest.mark.parametrize(
    ("fake", "given", "error", "word"),
    [
        (ONE_JAW, {}, ModelError, "finforce.plane"),
        (replace(ONE_JAW, names=("a", "b", "c")), {"detection_method": "frame"}, NamingError, "missing"),
        (
            replace(ONE_JAW, outputs="three", output_names=("a", "b")),
            {"detection_method": "frame"},
            ModelError,
            "outputs",
        ),
        (replace(ONE_JAW, outputs="simcc"), {"detection_method": "frame"}, ModelError, "simcc"),
        (
            replace(ONE_JAW, size=(224, 176)),
            {"detection_method": "frame", "plane": PLANE},
            ModelError,
            "rectified side planes",
        ),
        (
            replace(ONE_JAW, size=(64, 64)),
            {"detection_method": "frame", "training_size": {"height": 480, "width": 640}},
            ModelError,
            "frozen",
        ),
    ],
)
def test_a_network_that_does_not_fit_is_refused_at_the_start(tmp_path, fake, given, error, word):
    own = {f"finforce__{key}": given[key] for key in ("plane", "training_size") if key in given}
    given = {key: value for key, value in given.items() if f"finforce__{key}" not in own}
    folder = write_model(tmp_path / "net", fake, **own)
    with pytest.raises(error, match=word):
        detector_of(model=str(folder), **given)


def test_a_frame_finder_without_a_network_is_refused_and_not_given_the_shipped_one():
    with pytest.raises(ModelError, match="detection_method frame: got no model.*expected the folder"):
        detector_of(detection_method="frame")


def test_the_detector_has_the_jaws_and_the_camera_of_the_parameters():
    parameters = DetectorParameters(
        detection_method="dots", jaws="right", T_gripper_camera=(0.0, 0.0, -0.1, 0.0, 0.0, 0.0, 1.0)
    )
    built = build_detector(load_jaws(parameters), parameters)
    assert isinstance(built, KeypointDetector) and lost_sides(built) == ("right",)
    with pytest.raises(GeometryError):
        build_detector({"left": load_jaws(parameters)["right"]}, parameters)
