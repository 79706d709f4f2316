"""Key points of whole images and cut-outs, by networks that find coloured squares."""

import numpy as np
import onnx
import pytest
from keypoint_scene_fakes import COLOURS, Fake, build_network, paint, small_jaws, write_model
from onnx import helper, numpy_helper

from finforce.camera import CameraIntrinsics
from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce_keypoints.detectors.whole_image import WholeImageDetector, check_offsets
from finforce_keypoints.errors import DetectionError
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.networks.metadata import build_name_map
from finforce_keypoints.networks.model import KeypointModel, Peaks

CAMERA = CameraIntrinsics(width=640, height=480, fx=431.2, fy=430.0, cx=319.6, cy=241.3)
LEFT, RIGHT = ("left_inner_7", "left_tip", "left_reference"), ("right_inner_7", "right_tip", "right_reference")
SQUARES = {"red": (236, 196), "green": (260, 156), "blue": (180, 396)}
OTHERS = {"yellow": (404, 196), "magenta": (380, 156), "cyan": (460, 396)}
CELL = 8.01  # px: a square in a cut-out lies anywhere in a cell, and is found to a cell's size


def both_jaws(**changes):
    return Fake(names=LEFT + RIGHT, colours=tuple(SQUARES) + tuple(OTHERS), **changes)


def one_jaw(**changes):
    return Fake(names=("inner_7", "tip", "reference"), colours=tuple(SQUARES), **changes)


def image_of(squares, size=(480, 640)):
    camera = (
        CAMERA
        if size == (480, 640)
        else CameraIntrinsics(width=size[1], height=size[0], fx=500.0, fy=500.0, cx=size[1] / 2, cy=size[0] / 2)
    )
    return RgbdImage(stamp=0.0, color=paint(squares, size), depth=None, camera=camera)


def detector_of(folder, fake, sides=("left", "right"), changes=None, **options):
    jaws = small_jaws(sides)
    model = KeypointModel(write_model(folder, fake, **(changes or {})), threads=1)
    return WholeImageDetector(model, build_name_map(model.names, jaws), jaws, **options)


def expected_poses(origin_x=0.045):
    return {side: jaw_in_camera(ROBOT_CAMERA, side, sign * origin_x) for side, sign in (("left", -1.0), ("right", 1.0))}


LOST = {"left": None, "right": None}


def shown_shapes(pixel_detector, monkeypatch):
    """The shapes of the batches that the network is given."""
    shapes, locate = [], pixel_detector._model.locate
    monkeypatch.setattr(pixel_detector._model, "locate", lambda batch: (shapes.append(batch.shape), locate(batch))[1])
    return shapes


def test_both_jaws_are_found_in_one_pass_in_the_order_of_the_jaw_file(tmp_path, monkeypatch):
    pixel_detector = detector_of(tmp_path, both_jaws())
    shapes = shown_shapes(pixel_detector, monkeypatch)
    found = pixel_detector.detect(image_of(SQUARES | OTHERS), LOST)
    assert shapes == [(1, 480, 640, 3)]
    for side, squares in (("left", SQUARES), ("right", OTHERS)):
        assert np.abs(found[side].pixels - list(squares.values())).max() <= CELL
        assert found[side].likelihood.min() > 0.99 and np.isfinite(found[side].stddev).all()


def test_while_tracked_only_the_jaws_are_cut_out(tmp_path, monkeypatch):
    pixel_detector = detector_of(tmp_path, both_jaws())
    shapes = shown_shapes(pixel_detector, monkeypatch)
    image = image_of(SQUARES | OTHERS)
    found = pixel_detector.detect(image, expected_poses())
    assert shapes[0][1] < 480 and shapes[0][1] % 64 == 0 and shapes[0][2] % 64 == 0
    for side, squares in (("left", SQUARES), ("right", OTHERS)):
        assert np.abs(found[side].pixels - list(squares.values())).max() <= CELL
    pixel_detector.detect(image, expected_poses() | {"left": None})
    assert shapes[1] == (1, 480, 640, 3)


def test_a_network_with_group_normalisation_always_sees_the_whole_image(tmp_path, monkeypatch):
    model = build_network(both_jaws())
    statistics = helper.make_node("InstanceNormalization", ["pooled", "gain", "shift_of_mean"], ["normal"])
    model.graph.node.append(statistics)
    for name, value in (("gain", 1.0), ("shift_of_mean", 0.0)):
        model.graph.initializer.append(numpy_helper.from_array(np.full(3, value, np.float32), name))
    onnx.save(model, write_model(tmp_path, both_jaws()) / "network.onnx")
    jaws = small_jaws(("left", "right"))
    network = KeypointModel(tmp_path, threads=1)
    pixel_detector = WholeImageDetector(network, build_name_map(network.names, jaws), jaws)
    shapes = shown_shapes(pixel_detector, monkeypatch)
    pixel_detector.detect(image_of(SQUARES | OTHERS), expected_poses())
    assert shapes == [(1, 480, 640, 3)]


def test_no_jaw_that_is_asked_for_is_none_that_is_found(tmp_path, monkeypatch):
    for number, fake in enumerate((both_jaws(), one_jaw())):
        pixel_detector = detector_of(tmp_path / str(number), fake)
        shapes = shown_shapes(pixel_detector, monkeypatch)
        assert pixel_detector.detect(image_of(SQUARES | OTHERS), {}) == {} and shapes == []


def test_a_pose_behind_the_camera_or_beside_the_image_counts_as_lost(tmp_path, monkeypatch):
    pixel_detector = detector_of(tmp_path, both_jaws())
    shapes = shown_shapes(pixel_detector, monkeypatch)
    for place in ((0.0, 0.0, -1.0), (5.0, 0.0, 0.1)):
        pose = np.eye(4)
        pose[:3, 3] = place
        pixel_detector.detect(image_of(SQUARES | OTHERS), {"left": pose, "right": pose})
    assert shapes == [(1, 480, 640, 3)] * 2


@pytest.mark.parametrize("size", [(None, None), (480, 640)])
@pytest.mark.parametrize("poses", [LOST, expected_poses()])
def test_a_network_of_one_jaw_finds_each_jaw_on_its_side(tmp_path, size, poses):
    pixel_detector = detector_of(tmp_path, one_jaw(size=size))
    right = {colour: (639 - x, y) for colour, (x, y) in SQUARES.items()}
    image = image_of(SQUARES)
    image.color[:] = np.maximum(image.color, paint(right))
    found = pixel_detector.detect(image, poses)
    assert np.abs(found["left"].pixels - list(SQUARES.values())).max() <= CELL
    assert np.abs(found["right"].pixels - list(right.values())).max() <= CELL


def test_a_network_of_one_jaw_with_one_jaw_sees_the_whole_image(tmp_path, monkeypatch):
    pixel_detector = detector_of(tmp_path, one_jaw(), sides=("left",))
    shapes = shown_shapes(pixel_detector, monkeypatch)
    far = {"red": (600, 204)}
    found = pixel_detector.detect(image_of(far), {"left": None})
    assert shapes == [(1, 480, 640, 3)] and np.abs(found["left"].pixels[0] - far["red"]).max() <= CELL


def test_jaws_that_are_not_in_the_image_are_unlikely(tmp_path):
    pixel_detector = detector_of(tmp_path, both_jaws())
    detection = pixel_detector.detect(image_of({}), LOST)
    assert all(found.likelihood.max() < 1e-3 for found in detection.values())


@pytest.mark.parametrize("size", [(480, 640), (None, None)])
def test_another_size_than_the_trainings_is_refused_or_letterboxed(tmp_path, size):
    kept = {"finforce__training_size": {"height": 480, "width": 640}}
    squares = {colour: (2 * x, 2 * y) for colour, (x, y) in (SQUARES | OTHERS).items()}
    image = image_of({}, (800, 1280))
    image.color[:] = paint(squares, (800, 1280), half=12)
    fake = both_jaws(size=size)
    with pytest.raises(DetectionError, match="trained on"):
        detector_of(tmp_path / "a", fake, changes=kept).detect(image, LOST)
    pixel_detector = detector_of(tmp_path / "b", fake, changes=kept, allow_resize=True)
    found = pixel_detector.detect(image, LOST)
    places = np.array([squares[colour] for colour in SQUARES])
    assert np.abs(found["left"].pixels - places).max() <= 2 * CELL
    half = image.color[::2, ::2][:400]  # 12 px squares on the same places as INTER_AREA gives
    framed = np.full((480, 640, 3) if size[0] else half.shape, (124, 116, 104), np.uint8)
    framed[:400] = half
    small = pixel_detector._model.locate(framed[None])
    assert found["left"].stddev == pytest.approx(2.0 * small.stddev[0, :3], rel=1e-3)


def test_nothing_is_found_in_the_border_of_a_letterbox(tmp_path, monkeypatch):
    kept = {"finforce__training_size": {"height": 480, "width": 640}}
    pixel_detector = detector_of(tmp_path, both_jaws(size=(480, 640)), changes=kept, allow_resize=True)
    monkeypatch.setattr(
        "finforce_keypoints.detectors.whole_image._BLANK", COLOURS["green"]
    )  # as if a point were seen there
    found = pixel_detector.detect(image_of({"red": (100, 100)}, (320, 640)), LOST)["left"]
    assert np.abs(found.pixels[0] - (100, 100)).max() <= CELL
    assert np.isnan(found.pixels[1]).all() and found.likelihood[1] == 0.0 and np.isinf(found.stddev[1])


@pytest.mark.parametrize("size", [(None, None), (480, 640)])
def test_a_network_of_one_jaw_does_not_take_the_other_jaw_for_it(tmp_path, size):
    pixel_detector = detector_of(tmp_path, one_jaw(size=size))
    right = {colour: (639 - x, y) for colour, (x, y) in SQUARES.items()}
    for poses in (LOST, expected_poses()):
        found = pixel_detector.detect(image_of(right), poses)
        assert found["right"].likelihood.min() > 0.5
        assert "left" not in found or found["left"].likelihood.max() < 1e-3


def test_offsets_that_no_training_gives_are_refused(tmp_path):
    pixel_detector = detector_of(tmp_path, both_jaws(offset=(30.0, 0.0)))
    with pytest.raises(DetectionError, match="locref_std"):
        pixel_detector.detect(image_of(SQUARES | OTHERS), LOST)
    score = np.array([[0.9, 0.0, 0.0]])
    peaks = Peaks(
        pixels=np.zeros((1, 3, 2)), likelihood=np.array([[0.0, 0.9, 0.9]]), spread=score, stddev=score, astray=score
    )
    check_offsets(peaks)  # one among three is a bad point, no bad network


def test_every_colour_is_used_by_the_doubles():
    assert set(SQUARES) | set(OTHERS) == set(COLOURS)
