import numpy as np
import pytest

from finforce.camera import project
from finforce.gripper_frames import BENCH_CAMERA, BENCH_ORIGIN_X, ROBOT_CAMERA, jaw_in_camera
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.geometry.side_picture import (
    PlaneGrid,
    SidePlane,
    find_side,
    intersect_plane,
    map_picture,
    project_plane,
    take_picture,
)
from finforce_sim.sensor import build_d405_vga

CAMERA = build_d405_vga()
POSES = {
    "left": jaw_in_camera(ROBOT_CAMERA, "left", -0.035),
    "right": jaw_in_camera(ROBOT_CAMERA, "right", 0.035),
    "bench": jaw_in_camera(BENCH_CAMERA, "left", BENCH_ORIGIN_X),
}


def side_of(name):
    return SidePlane(level=-0.010 if name == "right" else 0.010)


@pytest.mark.parametrize("name", POSES)
def test_a_place_on_the_side_plane_comes_back_through_the_lens(name):
    places = np.array([[0.0132, 0.009], [-0.0105, 0.009], [0.012, 0.080]])
    pixels = project_plane(places, side_of(name), POSES[name], CAMERA)
    again = intersect_plane(pixels, side_of(name), POSES[name], CAMERA)
    np.testing.assert_allclose(again, places, atol=1e-8)  # the distortion is inverted to 1e-10 of a ray
    assert (
        np.abs(intersect_plane(pixels, SidePlane(level=-side_of(name).level), POSES[name], CAMERA) - places).max()
        > 1e-3
    )


@pytest.mark.parametrize("name", ["left", "right"])
def test_the_key_points_of_a_tapered_finger_are_where_its_slanted_side_is(name):
    jaw = load_jaw("xlerobot", name)
    side, places = find_side(jaw), jaw.keypoints[:, [0, 2]]
    np.testing.assert_allclose(side.points(places), jaw.keypoints, atol=0.02e-3)
    pixels = project(jaw.keypoints @ POSES[name][:3, :3].T + POSES[name][:3, 3], CAMERA)
    assert np.abs(intersect_plane(pixels, side, POSES[name], CAMERA) - places).max() < 0.02e-3
    flat = SidePlane(level=float(jaw.keypoints[:, 1].mean()))
    assert np.abs(intersect_plane(pixels, flat, POSES[name], CAMERA) - places).max() > 1e-3


def test_pixels_of_a_grid_invert_its_places():
    grid = PlaneGrid()
    pixels = np.array([[0.0, 0.0], [175.0, 223.0], [10.5, 3.25]])
    np.testing.assert_allclose(grid.pixels(grid.places(pixels)), pixels, atol=1e-9)


def test_a_padded_grid_shows_the_same_places():
    grid, margin = PlaneGrid(), 28
    wide = grid.padded(margin)
    np.testing.assert_allclose(wide.places([[margin, margin]]), grid.places([[0, 0]]), atol=1e-12)
    assert (wide.width, wide.height) == (grid.width + 56, grid.height + 56)


@pytest.mark.parametrize("name", POSES)
def test_the_interpolated_map_is_the_projection_within_a_twentieth_of_a_pixel(name):
    grid = PlaneGrid()
    mapping = map_picture(grid, side_of(name), POSES[name], CAMERA)
    rng = np.random.default_rng(1)
    pixels = np.column_stack((rng.integers(0, grid.width, 200), rng.integers(0, grid.height, 200)))
    exact = project_plane(grid.places(pixels), side_of(name), POSES[name], CAMERA)
    inside = ((exact >= 0) & (exact < (CAMERA.width, CAMERA.height))).all(axis=1)
    assert inside.sum() > 100
    error = np.abs(mapping[pixels[:, 1], pixels[:, 0]] - exact)[inside]
    assert error.max() < 0.05  # a twentieth of a pixel is a tenth of what the network can see


def test_left_and_right_jaw_give_the_same_picture_of_the_same_marks():
    pictures = []
    for side, pose in (("left", POSES["left"]), ("right", POSES["right"])):
        jaw = load_jaw("bench", side)
        image = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
        pixels = project(jaw.keypoints @ pose[:3, :3].T + pose[:3, 3], CAMERA)
        rows, columns = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
        for column, row in pixels:
            image[np.hypot(rows - row, columns - column) < 4.0] = 255
        pictures.append(take_picture(image, map_picture(PlaneGrid(), side_of(side), pose, CAMERA)))
    grid = PlaneGrid()
    for picture in pictures:
        at = np.round(grid.pixels(load_jaw("bench").keypoints[:, [0, 2]])).astype(int)
        assert (picture[at[:, 1], at[:, 0]] > 128).all()
    overlap = np.minimum(*pictures).sum() / np.maximum(*pictures).sum()
    assert overlap > 0.8  # the lens is not quite symmetric


def test_what_the_camera_does_not_see_is_black():
    image = np.full((CAMERA.height, CAMERA.width, 3), 200, dtype=np.uint8)
    aside = jaw_in_camera(ROBOT_CAMERA, "left", -0.5)
    assert not take_picture(image, map_picture(PlaneGrid(), side_of("left"), aside, CAMERA)).any()
    assert take_picture(image, map_picture(PlaneGrid(), side_of("left"), POSES["left"], CAMERA)).mean() > 100
