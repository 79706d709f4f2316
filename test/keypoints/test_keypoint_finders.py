"""Claims about the detector that parameters ask for: which finder it gets, and which are refused before any image."""

from dataclasses import replace
from hashlib import sha256

import pytest
from keypoint_scene_fakes import Fake, small_jaws, write_model

from finforce_keypoints.build import build_detector, build_finder, load_model
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.detectors.dots import DotFinder
from finforce_keypoints.detectors.side_plane import PlaneFinder
from finforce_keypoints.detectors.whole_image import FrameFinder
from finforce_keypoints.errors import GeometryError, ModelError, NamingError
from finforce_keypoints.parameters import DetectorParameters, load_jaws
from finforce_keypoints.settings import DetectorSettings

PLANE = {"scale": 0.45e-3, "x": -0.036, "z": -0.012, "width": 176, "height": 224, "side_y": 0.010}
ONE_JAW = Fake(names=("inner_7", "tip", "reference"), colours=("red", "green", "blue"))


def finder_of(**given):
    return build_finder(small_jaws(), DetectorParameters(**given), DetectorSettings())


def test_a_network_of_side_planes_is_used_by_the_plane_finder(tmp_path):
    folder = write_model(tmp_path / "net", ONE_JAW, finforce__plane=PLANE)
    built = finder_of(model=str(folder))
    assert isinstance(built.finder, PlaneFinder)
    assert built.card.sha256 == sha256((folder / "network.onnx").read_bytes()).hexdigest()
    assert built.card.name == "network net"


def test_the_finger_chooses_among_the_shipped_networks():
    for name, folder in (("bench", "plane"), ("umi", "side_plane"), ("ssg48_fin_ray_1", "side_plane")):
        parameters = DetectorParameters(jaw_file=name)
        built = build_finder(load_jaws(parameters), parameters, DetectorSettings())
        assert isinstance(built.finder, PlaneFinder) and built.card.name == f"network {folder}"


def test_any_network_is_used_by_the_frame_finder(tmp_path):
    folder = write_model(tmp_path / "net", ONE_JAW)
    assert isinstance(finder_of(finder="frame", model=str(folder)).finder, FrameFinder)


def test_dots_need_no_network():
    built = finder_of(finder="dots", model="no_such_folder")
    assert isinstance(built.finder, DotFinder) and built.card.sha256 == ""


def test_body_parts_get_other_names_by_parameter(tmp_path):
    folder = write_model(tmp_path / "net", replace(ONE_JAW, names=("nail", "tip", "reference")))
    with pytest.raises(NamingError, match="nail"):
        finder_of(finder="frame", model=str(folder))
    finder_of(finder="frame", model=str(folder), names=("nail=inner_7",))


@pytest.mark.parametrize(
    ("fake", "given", "error", "word"),
    [
        (ONE_JAW, {}, ModelError, "finforce.plane"),
        (replace(ONE_JAW, names=("a", "b", "c")), {"finder": "frame"}, NamingError, "missing"),
        (replace(ONE_JAW, outputs="three", output_names=("a", "b")), {"finder": "frame"}, ModelError, "outputs"),
        (replace(ONE_JAW, outputs="simcc"), {"finder": "frame"}, ModelError, "simcc"),
        (replace(ONE_JAW, size=(224, 176)), {"finder": "frame", "plane": PLANE}, ModelError, "rectified side planes"),
        (replace(ONE_JAW, size=(64, 64)), {"finder": "frame", "input_size": (480, 640)}, ModelError, "frozen"),
        (ONE_JAW, {"finder": "frame", "stride": 32}, ModelError, "stride"),
    ],
)
def test_a_network_that_does_not_fit_is_refused_at_the_start(tmp_path, fake, given, error, word):
    plane = {"finforce__plane": given.pop("plane")} if "plane" in given else {}
    folder = write_model(tmp_path / "net", fake, **plane)
    with pytest.raises(error, match=word):
        finder_of(model=str(folder), **given)


def test_a_frame_finder_without_a_network_is_refused_and_not_given_the_shipped_one():
    with pytest.raises(ModelError, match="finder frame: got no model.*expected the folder"):
        finder_of(finder="frame")


def test_overrides_reach_the_network(tmp_path, monkeypatch):
    from finforce_keypoints.networks import model as model

    seen = []
    monkeypatch.setattr(
        model, "KeypointModel", lambda path, overrides, threads: seen.append((path, overrides, threads))
    )
    load_model(
        DetectorParameters(
            model="m", stride=4, locref_std=7.0, apply_sigmoid="yes", normalize="no", input_size=(4, 6), threads=3
        )
    )
    load_model(DetectorParameters(model="m"))
    (path, given, threads), (_, none, _) = seen
    assert (path, threads) == ("m", 3)
    assert (given.stride, given.locref_std, given.apply_sigmoid, given.normalize) == (4, 7.0, True, False)
    assert given.input_size == (4, 6)
    assert set(vars(none).values()) == {None}


def test_the_detector_has_the_jaws_and_the_camera_of_the_parameters():
    parameters = DetectorParameters(finder="dots", jaws="right", T_gripper_camera=(0.0, 0.0, -0.1, 0.0, 0.0, 0.0, 1.0))
    built = build_detector(load_jaws(parameters), parameters)
    assert isinstance(built.detector, KeypointDetector) and built.detector.lost_sides == ("right",)
    with pytest.raises(GeometryError):
        build_detector({"left": load_jaws(parameters)["right"]}, parameters)
