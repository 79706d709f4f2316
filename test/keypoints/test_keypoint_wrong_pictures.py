"""Pictures and intrinsics of the twin that are not what they are said to be are not believed, or it is said."""

from dataclasses import replace
from itertools import islice

import cv2
import numpy as np
import pytest

from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.build import build_pixel_detector
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.parameters import DetectorParameters, DetectorSettings
from finforce_sim.scenarios import build_scenario
from finforce_sim.simulated_recording import build_simulated_recording

IMAGES = 16  # half a second: what is said by then is said within three


@pytest.fixture(scope="module")
def simulated():
    found = build_simulated_recording(build_scenario("grasp_cylinder"), 3)
    return found.camera, tuple(islice(found, IMAGES))


@pytest.fixture(scope="module")
def few(simulated):
    """A quarter of the images: in each the jaws are looked for everywhere."""
    return simulated[0], simulated[1][::4]


def build(jaw):
    jaws = {side: load_jaw(jaw, side) for side in ("left", "right")}
    parameters, settings = DetectorParameters(jaw_file=jaw), DetectorSettings()
    pixel_detector = build_pixel_detector(jaws, parameters, settings)
    return KeypointDetector(pixel_detector, jaws, parameters.camera_pose, settings)  # covered parts look frozen


@pytest.fixture(scope="module")
def detector():
    return build("bench")


def look(detector, simulated, picture=lambda layer: layer, lens=lambda camera: camera, depth=lambda layer: layer):
    """What the detector says of each image, of changed pictures, intrinsics and depth."""
    camera, frames = simulated
    detector.reset()
    for number, frame in enumerate(frames):
        color, away = (np.ascontiguousarray(layer) for layer in (picture(frame.color), depth(frame.depth)))
        yield frame, detector.detect(RgbdImage(stamp=number / 30.0, color=color, depth=away, camera=lens(camera)))


def turn(layer):
    return layer[::-1, ::-1]


def flip(layer):
    return layer[::-1]


def scale(camera, share):
    return replace(camera, fx=share * camera.fx, fy=share * camera.fy, cx=share * camera.cx, cy=share * camera.cy)


@pytest.mark.parametrize("change", [turn, flip])
def test_no_key_point_of_a_picture_that_is_turned_over_is_believed(detector, few, change):
    assert not any(found for _, found in look(detector, few, picture=change, depth=change))


@pytest.mark.parametrize(
    "lens",
    [
        lambda camera: scale(camera, 1.5),
        lambda camera: scale(camera, 1.0 / 1.5),
        lambda camera: replace(camera, cx=camera.cx - 100.0, cy=camera.cy - 70.0),
        lambda camera: replace(camera, fx=camera.fy, fy=camera.fx, cx=camera.cy, cy=camera.cx),
    ],
    ids=["of a larger picture", "of a smaller picture", "of a picture cut elsewhere", "axes swapped"],
)
def test_no_key_point_is_believed_with_intrinsics_of_another_picture(detector, few, lens):
    assert not any(found for _, found in look(detector, few, lens=lens))


def test_a_focal_length_slightly_off_is_said_at_rest(detector, simulated):
    for _ in look(detector, simulated, lens=lambda camera: replace(camera, fx=1.05 * camera.fx, fy=1.05 * camera.fy)):
        pass
    assert all("extrinsics right?" in words for words in detector.warnings.values()) and len(detector.warnings) == 2
    for _ in look(detector, simulated):
        pass
    assert not detector.warnings


def test_a_lens_that_is_half_covered_hides_one_jaw_and_spoils_nothing_of_the_other(detector, simulated):
    def cover(layer):
        return np.where(np.arange(layer.shape[1])[None, :, None] < 320, 20, layer).astype(np.uint8)

    pairs = [(found, frame.jaws) for frame, found in look(detector, simulated, picture=cover)]
    assert all(set(found) == {"right"} for found, _ in pairs)
    assert share_within_deviations(pairs) > 0.95


@pytest.mark.parametrize("blur", [0.0, 3.5])
def test_points_out_of_focus_lie_within_their_deviations(detector, simulated, blur):
    def soften(layer):
        return cv2.GaussianBlur(layer, (0, 0), blur) if blur else layer

    pairs = [(found, frame.jaws) for frame, found in look(detector, simulated, picture=soften)]
    assert share_within_deviations(pairs) > 0.95


def share_within_deviations(pairs):
    """The share of coordinates of valid points that lie within three standard deviations of the truth."""
    off = [
        (np.abs(keypoints.points - true[side].points) / keypoints.stddev)[keypoints.valid]
        for found, true in pairs
        for side, keypoints in found.items()
    ]
    return np.mean(np.concatenate(off) < 3.0)


def test_no_key_point_of_another_finger_than_in_the_jaw_file_is_believed(simulated):
    assert not any(keypoints.valid.any() for _, found in look(build("umi"), simulated) for keypoints in found.values())
