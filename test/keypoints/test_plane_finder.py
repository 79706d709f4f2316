from types import SimpleNamespace

import numpy as np
import pytest

from finforce.camera import project
from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.detectors.side_plane import PlaneFinder, grid_from_metadata
from finforce_keypoints.errors import ModelError
from finforce_keypoints.geometry.side_picture import PlaneGrid
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.networks.model import Peaks
from finforce_twin.rendering.depth_camera import build_d405_vga

CAMERA = build_d405_vga()
JAWS = {side: load_jaw("bench", side) for side in ("left", "right")}
NAMES = (*JAWS["left"].keypoint_names, "reference")
SHADES = 60 + 10 * np.arange(len(NAMES))
PLANE = {"scale": 0.45e-3, "x": -0.036, "z": -0.012, "width": 176, "height": 224}


class ShadeModel:
    """Sees each point by the grey level of its disc."""

    def __init__(self, names=NAMES, plane=PLANE):
        self.names, self.path = tuple(names), SimpleNamespace(name="shades.onnx")
        self.metadata = SimpleNamespace(extra={"plane": plane})
        self.batches = []

    def locate(self, batch):
        self.batches.append(len(batch))
        pixels = np.full((len(batch), len(self.names), 2), np.nan)
        for number, picture in enumerate(batch):
            for part, name in enumerate(self.names):
                inside = picture[..., 1] == 255  # not on the rim, where shades mix
                rows, columns = np.nonzero(inside & (picture[..., 0] == SHADES[NAMES.index(name)]))
                if len(rows) > 3:
                    pixels[number, part] = columns.mean(), rows.mean()
        likelihood = np.isfinite(pixels[..., 0]).astype(float)
        stddev = np.where(likelihood > 0.0, 0.5, np.inf)
        return Peaks(pixels=pixels, likelihood=likelihood, spread=stddev, stddev=stddev, astray=0.0 * likelihood)


def true_pixels(side, x):
    T = jaw_in_camera(ROBOT_CAMERA, side, x)
    points = np.vstack((JAWS[side].keypoints, JAWS[side].reference_point))
    return project(points @ T[:3, :3].T + T[:3, 3], CAMERA)


def paint(places):
    color = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    rows, columns = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    for side, x in places.items():
        for shade, (column, row) in zip(SHADES, true_pixels(side, x), strict=True):
            color[np.hypot(columns - column, rows - row) < 4.5] = (shade, 255, 0)
    return RgbdImage(stamp=1.0, color=color, depth=None, camera=CAMERA)


@pytest.mark.parametrize("off", [0.0, 4e-3, -4e-3])
def test_pixels_are_those_of_the_image_wherever_the_jaw_was_expected(off):
    model, places = ShadeModel(), {"left": -0.035, "right": 0.037}
    finder = PlaneFinder(model, JAWS, ROBOT_CAMERA)
    expected = {side: jaw_in_camera(ROBOT_CAMERA, side, x + off) for side, x in places.items()}
    found = finder.find(paint(places), expected)
    for side, x in places.items():
        error = np.linalg.norm(found[side].pixels - true_pixels(side, x), axis=1)
        assert error.max() < 0.6  # of a disc's interior, resampled
        assert (found[side].likelihood == 1.0).all()
        # half a pixel of 0.45 mm is about 0.6 px of the image here, more or less with the distance
        assert ((found[side].stddev > 0.3) & (found[side].stddev < 1.2)).all()
    assert model.batches == [2]


def test_the_order_of_the_body_parts_does_not_matter():
    turned = tuple(reversed(NAMES))
    found = PlaneFinder(ShadeModel(turned), JAWS, ROBOT_CAMERA).find(
        paint({"left": -0.035}), {"left": jaw_in_camera(ROBOT_CAMERA, "left", -0.035)}
    )
    assert np.linalg.norm(found["left"].pixels - true_pixels("left", -0.035), axis=1).max() < 0.6


@pytest.mark.parametrize("x", [-0.020, -0.031, -0.044])
def test_a_lost_jaw_is_found_along_the_closing_axis(x):
    found = PlaneFinder(ShadeModel(), JAWS, ROBOT_CAMERA).find(paint({"left": x}), {"left": None})
    error = np.linalg.norm(found["left"].pixels - true_pixels("left", x), axis=1)
    assert np.nanmax(error) < 0.6
    assert np.isfinite(error).sum() >= len(NAMES) - 1


def test_a_lost_jaw_that_is_nowhere_is_absent():
    assert not PlaneFinder(ShadeModel(), JAWS, ROBOT_CAMERA).find(paint({}), {"left": None, "right": None})


def test_what_is_not_seen_has_no_pixel_and_no_likelihood():
    image = paint({"left": -0.035})
    image.color[image.color[..., 0] == SHADES[3]] = 0
    found = PlaneFinder(ShadeModel(), JAWS, ROBOT_CAMERA).find(
        image, {"left": jaw_in_camera(ROBOT_CAMERA, "left", -0.035)}
    )["left"]
    assert np.isnan(found.pixels[3]).all() and found.likelihood[3] == 0.0 and found.stddev[3] == np.inf
    assert np.isfinite(np.delete(found.pixels, 3, axis=0)).all()


def test_a_network_of_another_jaw_is_refused_by_the_names():
    with pytest.raises(ModelError, match=r"missing: inner_7; not of the jaw 'bench': thumb"):
        PlaneFinder(ShadeModel([name if name != "inner_7" else "thumb" for name in NAMES]), JAWS, ROBOT_CAMERA)


@pytest.mark.parametrize("plane", [None, {}, {**PLANE, "scale": "small"}])
def test_a_network_without_its_plane_is_refused(plane):
    with pytest.raises(ModelError, match=r"finforce\.plane"):
        PlaneFinder(ShadeModel(plane=plane), JAWS, ROBOT_CAMERA)


def test_the_plane_of_the_metadata_is_the_grid():
    assert grid_from_metadata({"plane": PLANE}) == PlaneGrid()
