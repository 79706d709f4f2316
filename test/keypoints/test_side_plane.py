from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from finforce.camera import project
from finforce.gripper_frames import FRONT_CAMERA, HALF_TURN, ROBOT_CAMERA, jaw_in_camera
from finforce.transforms import pose_from_quaternion
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.detectors.side_plane import SHIFTS, AnyFinger, OneFinger, SidePlaneDetector, grid_from_metadata
from finforce_keypoints.errors import GeometryError, ModelError
from finforce_keypoints.geometry.side_picture import PlaneGrid
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.networks.model import Peaks
from finforce_keypoints.networks.side_network import Places, Template
from finforce_sim.sensor import build_d405_vga

CAMERA = build_d405_vga()


def load_jaws(name):
    return {side: load_jaw(name, side) for side in ("left", "right")}


class ShadeNetwork:
    """Sees each point by the grey level of its disc; its templates hold nothing but the points."""

    height, width = 224, 176
    path, sha256 = Path("shades"), ""

    def __init__(self, hidden=()):
        self.batches, self.hidden = [], hidden

    def prepare(self, template, points, shapes, wanted=None):
        assert template.shape == (self.height, self.width, 3) and template[..., 0].any()
        return Template(half=template, points=points, pieces=template[None])

    def locate(self, pictures, templates, starts=()):
        self.batches.append(len(pictures))
        count = len(templates[0].points)
        pixels = np.full((len(pictures), count, 2), np.nan)
        for number, picture in enumerate(pictures):
            for part in set(range(count)) - set(self.hidden):
                inside = picture[..., 1] == 255  # not on the rim, where shades mix
                rows, columns = np.nonzero(inside & (picture[..., 0] == shade_of(part)))
                if len(rows) > 3:
                    pixels[number, part] = columns.mean(), rows.mean()
        likelihood = np.isfinite(pixels[..., 0]).astype(float)
        return Places(pixels=pixels, likelihood=likelihood, stddev=np.where(likelihood > 0.0, 0.5, np.inf))


def shade_of(part):
    return 40 + 6 * part


def true_pixels(jaw, side, x):
    T = jaw_in_camera(ROBOT_CAMERA, side, x)
    points = np.vstack((jaw.keypoints, jaw.reference_point))
    return project(points @ T[:3, :3].T + T[:3, 3], CAMERA)


def paint(jaws, places, radius=4.5):
    color = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    rows, columns = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    for side, x in places.items():
        for part, (column, row) in enumerate(true_pixels(jaws[side], side, x)):
            color[np.hypot(columns - column, rows - row) < radius] = (shade_of(part), 255, 0)
    return RgbdImage(stamp=1.0, color=color, depth=None, camera=CAMERA)


@pytest.mark.parametrize("off", [0.0, 4e-3, -4e-3])
def test_pixels_are_those_of_the_image_wherever_the_jaw_was_expected(off):
    jaws, network, places = load_jaws("bench"), ShadeNetwork(), {"left": -0.035, "right": 0.037}
    pixel_detector = SidePlaneDetector(AnyFinger(network, jaws), jaws, ROBOT_CAMERA)
    expected = {side: jaw_in_camera(ROBOT_CAMERA, side, x + off) for side, x in places.items()}
    found = pixel_detector.detect(paint(jaws, places), expected)
    for side, x in places.items():
        error = np.linalg.norm(found[side].pixels - true_pixels(jaws[side], side, x), axis=1)
        assert error.max() < 0.6  # of a disc's interior, resampled
        assert (found[side].likelihood == 1.0).all()
        # half a pixel of 0.45 mm is about 0.6 px of the image here, more or less with the distance
        assert ((found[side].stddev > 0.3) & (found[side].stddev < 1.2)).all()
    assert network.batches == [2]


def test_successive_pictures_are_shifted_and_what_is_found_in_them_is_not():
    jaws, network = load_jaws("bench"), ShadeNetwork()
    locator, locate, seen = AnyFinger(network, jaws), network.locate, []
    locator.shifts = SHIFTS
    pixel_detector = SidePlaneDetector(locator, jaws, ROBOT_CAMERA)

    def watch(pictures, templates, starts=()):
        places = locate(pictures, templates, starts)
        moves = places.pixels - templates[0].points
        seen.append((moves[0], None if starts[0] is None else starts[0]))
        return replace(places, moves=moves)

    network.locate = watch
    image, expected = paint(jaws, {"left": -0.035}), {"left": jaw_in_camera(ROBOT_CAMERA, "left", -0.035)}
    errors = [
        pixel_detector.detect(image, expected)["left"].pixels - true_pixels(jaws["left"], "left", -0.035)
        for _ in range(len(SHIFTS) + 1)
    ]
    assert np.linalg.norm(errors, axis=2).max() < 0.6
    in_pictures = np.array([moves.mean(axis=0) for moves, _ in seen])
    assert (np.ptp(in_pictures, axis=0) > 4.0).all()
    np.testing.assert_allclose(in_pictures[-1], in_pictures[0])  # from then on again
    # each search begins where the points of the last picture are in this one
    for moves, start in seen[1:]:
        assert np.abs(start - moves).max() < 1.0


def test_another_finger_is_looked_at_on_a_grid_of_its_own():
    jaws, places = load_jaws("ssg48_fin_ray_1"), {"left": -0.035, "right": 0.035}
    expected = {side: jaw_in_camera(ROBOT_CAMERA, side, x) for side, x in places.items()}
    found = SidePlaneDetector(AnyFinger(ShadeNetwork(), jaws), jaws, ROBOT_CAMERA).detect(paint(jaws, places), expected)
    for side, x in places.items():
        assert found[side].pixels.shape == (len(jaws[side].keypoints) + 1, 2)
        assert np.linalg.norm(found[side].pixels - true_pixels(jaws[side], side, x), axis=1).max() < 0.6


@pytest.mark.parametrize("x", [-0.020, -0.031, -0.044])
def test_a_lost_jaw_is_found_along_the_closing_axis(x):
    jaws = load_jaws("bench")
    found = SidePlaneDetector(AnyFinger(ShadeNetwork(), jaws), jaws, ROBOT_CAMERA).detect(
        paint(jaws, {"left": x}), {"left": None}
    )
    error = np.linalg.norm(found["left"].pixels - true_pixels(jaws["left"], "left", x), axis=1)
    assert np.nanmax(error) < 0.9  # near the edge of the picture it was found in, discs are cut
    assert np.isfinite(error).sum() >= len(error) - 1


def test_a_lost_jaw_that_is_nowhere_is_absent():
    jaws = load_jaws("bench")
    pixel_detector = SidePlaneDetector(AnyFinger(ShadeNetwork(), jaws), jaws, ROBOT_CAMERA)
    assert not pixel_detector.detect(paint(jaws, {}), {"left": None, "right": None})


def test_what_is_not_seen_has_no_pixel_and_no_likelihood():
    jaws = load_jaws("bench")
    found = SidePlaneDetector(AnyFinger(ShadeNetwork(hidden=(3,)), jaws), jaws, ROBOT_CAMERA).detect(
        paint(jaws, {"left": -0.035}), {"left": jaw_in_camera(ROBOT_CAMERA, "left", -0.035)}
    )["left"]
    assert np.isnan(found.pixels[3]).all() and found.likelihood[3] == 0.0 and found.stddev[3] == np.inf
    assert np.isfinite(np.delete(found.pixels, 3, axis=0)).all()


NAMES = (*load_jaw("bench").keypoint_names, "reference")
PLANE = {"scale": 0.45e-3, "x": -0.036, "z": -0.012, "width": 176, "height": 224}


class ShadeModel:
    """The same as a network of one finger, whose body parts have an order of their own."""

    def __init__(self, names=NAMES, plane=PLANE):
        self.names, self.path, self.sha256 = tuple(names), Path("shades/shades.onnx"), ""
        self.metadata = SimpleNamespace(finforce=SimpleNamespace(plane=plane))

    def locate(self, pictures):
        template = Template(half=None, points=np.zeros((len(NAMES), 2)), pieces=None)
        found, order = ShadeNetwork().locate(pictures, [template]), [NAMES.index(name) for name in self.names]
        pixels, likelihood, stddev = found.pixels[:, order], found.likelihood[:, order], found.stddev[:, order]
        return Peaks(pixels=pixels, likelihood=likelihood, spread=stddev, stddev=stddev, astray=0.0 * likelihood)


def test_the_order_of_the_body_parts_does_not_matter():
    jaws = load_jaws("bench")
    pixel_detector = SidePlaneDetector(OneFinger(ShadeModel(tuple(reversed(NAMES))), jaws), jaws, ROBOT_CAMERA)
    found = pixel_detector.detect(paint(jaws, {"left": -0.035}), {"left": jaw_in_camera(ROBOT_CAMERA, "left", -0.035)})
    assert np.linalg.norm(found["left"].pixels - true_pixels(jaws["left"], "left", -0.035), axis=1).max() < 0.6


def test_a_network_of_another_jaw_is_refused_by_the_names():
    names = [name if name != "inner_7" else "thumb" for name in NAMES]
    with pytest.raises(ModelError, match=r"missing: inner_7; not of the jaw 'bench': thumb"):
        OneFinger(ShadeModel(names), load_jaws("bench"))


@pytest.mark.parametrize("plane", [None, {}, {**PLANE, "scale": "small"}])
def test_a_network_without_its_plane_is_refused(plane):
    with pytest.raises(ModelError, match=r"finforce\.plane"):
        OneFinger(ShadeModel(plane=plane), load_jaws("bench"))


def test_the_plane_of_the_metadata_is_the_grid():
    assert grid_from_metadata(PLANE) == PlaneGrid()


def test_a_camera_that_does_not_see_the_sides_is_refused_with_what_to_give():
    jaws = load_jaws("bench")
    other = HALF_TURN @ ROBOT_CAMERA
    with pytest.raises(GeometryError, match=r"y = -0\.0.*other side of the gripper") as found:
        SidePlaneDetector(AnyFinger(ShadeNetwork(), jaws), jaws, other)
    numbers = str(found.value).split("T_gripper_camera is [")[1].rstrip("]").split(",")
    turned = pose_from_quaternion([float(n) for n in numbers[:3]], [float(n) for n in numbers[3:]])
    np.testing.assert_allclose(turned, ROBOT_CAMERA, atol=1e-3)


BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # REP 103: in the optical frame


@pytest.mark.parametrize("camera", [ROBOT_CAMERA, FRONT_CAMERA])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.linalg.inv, "pose of the gripper in the camera frame"),
        (lambda T: T @ BODY, r"body, x forward \(camera_link\)"),
    ],
)
def test_the_pose_of_another_frame_is_refused_with_the_one_to_give(change, words, camera):
    jaws = load_jaws("bench")
    with pytest.raises(GeometryError, match=words) as found:
        SidePlaneDetector(AnyFinger(ShadeNetwork(), jaws), jaws, change(camera))
    numbers = str(found.value).split("T_gripper_camera is [")[1].rstrip("]").split(",")
    meant = pose_from_quaternion([float(n) for n in numbers[:3]], [float(n) for n in numbers[3:]])
    np.testing.assert_allclose(meant, camera, atol=1e-3)
