"""Dots on jaws: found, told apart, and missed where they are hidden."""

from dataclasses import replace

import numpy as np
import pytest
from keypoint_scene_fakes import bend, draw_dots

from finforce.camera import CameraIntrinsics
from finforce.errors import MissingDependencyError
from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.detectors.dots import DotDetector, DotSettings, find_dots
from finforce_keypoints.errors import DetectorSettingsError
from finforce_keypoints.images import RgbdImage

CAMERA = CameraIntrinsics(
    width=640, height=480, fx=431.2, fy=430.0, cx=319.6, cy=241.3, distortion=[-0.0545, 0.0568, 0.001, 0.00034, -0.0185]
)
JAWS = {side: load_jaw("bench", side) for side in ("left", "right")}
POINTS = {side: np.vstack((jaw.keypoints, jaw.reference_point)) for side, jaw in JAWS.items()}
LOOKS = {
    "colored": ((40, 200, 60), 60, DotSettings()),
    "red": ((210, 30, 45), 60, DotSettings(hue=5.0)),
    "light": ((230, 230, 230), 50, DotSettings(kind="light")),
    "dark": ((20, 20, 20), 190, DotSettings(kind="dark")),
}
CLOSE = 0.3  # px: noise of 4 grey levels on dots of 8 px, and the centre of a disc seen in perspective
ORIGINS = {"left": -0.045, "right": 0.045}


def poses_at(origins):
    return {side: jaw_in_camera(ROBOT_CAMERA, side, x) for side, x in origins.items()}


def picture_of(poses, tip=(0.0, 0.0), look="colored", hidden=None, noise=4.0, bright=1.0):
    """A noisy image of both jaws and the true pixels by side; hidden points (side -> rows) have no dot."""
    color, ground, _ = LOOKS[look]
    picture, truth = np.full((480, 640, 3), ground, np.uint8), {}
    for side, T in poses.items():
        points = bend(POINTS[side], tip)
        shown = np.setdiff1d(np.arange(len(points)), (hidden or {}).get(side, []))
        truth[side] = draw_dots(np.zeros_like(picture), points, T, CAMERA, color)
        draw_dots(picture, points[shown], T, CAMERA, color)
    noisy = bright * picture + np.random.default_rng(3).normal(0.0, noise, picture.shape)
    image = RgbdImage(stamp=0.0, color=np.clip(noisy, 0, 255).astype(np.uint8), depth=None, camera=CAMERA)
    return image, truth


def errors_of(detection, truth):
    return np.hypot(*(detection.pixels - truth).T)


@pytest.mark.parametrize("look", LOOKS)
def test_dots_of_every_look_are_found_to_a_third_of_a_pixel(look):
    poses = poses_at(ORIGINS)
    image, truth = picture_of(poses, (0.004, 0.0), look)
    found = DotDetector(JAWS, LOOKS[look][2]).detect(image, poses)
    for side in JAWS:
        assert errors_of(found[side], truth[side]).max() < CLOSE
        assert found[side].likelihood.min() > 0.6 and found[side].stddev.max() < 1.5


@pytest.mark.parametrize("tip", [(0.0, 0.0), (-0.020, -0.003), (0.010, 0.001)])
def test_a_bent_jaw_is_followed_from_the_base_in_the_first_image(tip):
    poses = poses_at(ORIGINS)
    image, truth = picture_of(poses, tip)
    found = DotDetector(JAWS).detect(image, poses)
    assert max(errors_of(found[side], truth[side]).max() for side in JAWS) < CLOSE


@pytest.mark.parametrize("seed", range(6))
def test_hidden_dots_are_missing_and_their_neighbours_keep_their_names(seed):
    rng = np.random.default_rng(seed)
    hidden = {side: rng.choice(15, 5, replace=False) for side in JAWS}
    poses = poses_at(ORIGINS)
    image, truth = picture_of(poses, (-0.012, 0.0), hidden=hidden)
    found = DotDetector(JAWS).detect(image, poses)
    for side in JAWS:
        gone = np.isin(np.arange(16), hidden[side])
        assert np.isnan(found[side].pixels[gone]).all() and not found[side].likelihood[gone].any()
        assert np.isinf(found[side].stddev[gone]).all()
        assert errors_of(found[side], truth[side])[~gone].max() < CLOSE


@pytest.mark.parametrize("origin", [0.022, 0.0415, 0.061])
def test_lost_jaws_are_found_along_the_closing_axis(origin):
    image, truth = picture_of(poses_at({"left": -origin, "right": origin}), (-0.004, 0.0))
    found = DotDetector(JAWS).detect(image, {"left": None, "right": None})
    assert max(errors_of(found[side], truth[side]).max() for side in JAWS) < CLOSE


def test_a_sequence_is_followed_while_the_jaw_bends_and_the_gripper_closes():
    pixel_detector, expected = DotDetector(JAWS), {"left": None, "right": None}
    for step in range(8):
        poses = poses_at({"left": -0.05 + 0.001 * step, "right": 0.05 - 0.001 * step})
        image, truth = picture_of(poses, (-0.0025 * step, 0.0), hidden={"left": [2, 3]} if step > 4 else None)
        found = pixel_detector.detect(image, expected)
        assert np.nanmax([errors_of(found[side], truth[side]) for side in JAWS]) < CLOSE
        expected = poses


def test_a_dot_that_is_half_hidden_is_unlikely():
    poses = poses_at(ORIGINS)
    image, truth = picture_of(poses)
    x, y = np.round(truth["left"][14]).astype(int)
    image.color[y - 10 : y + 10, x : x + 10] = LOOKS["colored"][1]
    found = DotDetector(JAWS).detect(image, poses)["left"]
    assert found.likelihood[14] < 0.6 < found.likelihood[:14].min()
    assert found.stddev[14] > 2.0 * found.stddev[:14].max()


def test_dim_light_does_not_hide_coloured_dots():
    poses = poses_at(ORIGINS)
    image, truth = picture_of(poses, bright=0.2, noise=2.0)
    found = DotDetector(JAWS).detect(image, poses)
    assert max(errors_of(found[side], truth[side]).max() for side in JAWS) < 2.0 * CLOSE


def test_other_things_of_the_dots_colour_are_not_dots():
    poses = poses_at(ORIGINS)
    image, truth = picture_of(poses, hidden={"left": [5]})
    image.color[420:470, 20:120] = LOOKS["colored"][0]  # a large one
    image.color[int(truth["left"][5, 1]) - 40 :, 318:321] = LOOKS["colored"][0]  # a long one
    found = DotDetector(JAWS).detect(image, poses)
    assert np.nanmax([errors_of(found[side], truth[side]) for side in JAWS]) < CLOSE
    assert np.isnan(found["left"].pixels[5]).all()


def test_a_side_without_dots_is_absent():
    poses = poses_at(ORIGINS)
    image, _ = picture_of({"left": poses["left"]})
    assert set(DotDetector(JAWS).detect(image, poses)) == {"left"}
    assert set(DotDetector(JAWS).detect(image, {"left": None, "right": None})) == {"left"}
    black = replace(image, color=np.zeros_like(image.color))
    assert DotDetector(JAWS).detect(black, poses) == {}


def test_a_jaw_outside_the_image_or_behind_the_camera_is_absent():
    image, _ = picture_of(poses_at(ORIGINS))
    for place in ((0.0, 0.0, -1.0), (3.0, 0.0, 0.2)):
        pose = np.eye(4)
        pose[:3, 3] = place
        assert DotDetector(JAWS).detect(image, {"left": pose, "right": pose}) == {}


def test_a_dot_belongs_to_one_jaw_only():
    poses = poses_at({"left": -0.014, "right": 0.014})  # the inner faces are 1.6 mm apart
    image, truth = picture_of(poses, hidden={"left": range(7)})
    found = DotDetector(JAWS).detect(image, poses)
    assert np.isnan(found["left"].pixels[:7]).all()
    assert errors_of(found["right"], truth["right"]).max() < CLOSE


def test_a_short_bar_is_no_dot():
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[10:12, 10:34] = (0, 255, 0)  # the area of a dot of 8 px
    assert len(find_dots(picture, DotSettings(), 8.0).pixels) == 0
    picture[20:27, 20:27] = (0, 255, 0)
    assert find_dots(picture, DotSettings(), 8.0).pixels == pytest.approx(np.array([[23.0, 23.0]]))


def test_touching_dots_are_no_ellipse():
    picture = np.zeros((40, 60, 3), np.uint8)
    rows, columns = np.indices((40, 60))
    for x in (15, 40, 46):
        picture[np.hypot(columns - x, rows - 20) < 4.0] = (0, 255, 0)
    dots = find_dots(picture, DotSettings(), 8.0)
    order = np.argsort(dots.pixels[:, 0])
    single, double = dots.fills[order]
    assert single == pytest.approx(1.0, abs=0.05) and double < 0.97
    assert dots.areas[order[1]] > 1.5 * dots.areas[order[0]]


def test_settings_out_of_bounds_and_a_missing_library_are_named(monkeypatch):
    with pytest.raises(DetectorSettingsError, match="hue"):
        DotSettings(hue=400.0)
    with pytest.raises(DetectorSettingsError, match="kind"):
        DotSettings(kind="square")

    def refuse(name):
        raise ImportError(f"no {name}")

    monkeypatch.setattr("finforce.optional.import_module", refuse)
    with pytest.raises(MissingDependencyError, match="opencv-contrib-python-headless"):
        DotDetector(JAWS)
