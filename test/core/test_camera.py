from dataclasses import replace

import numpy as np
import pytest

from finforce.camera import (
    CameraIntrinsics,
    ImageError,
    ImageLayout,
    IntrinsicsError,
    check_depth,
    check_mask,
    compute_rays,
    decode_depth,
    project,
    rays_from_pixels,
)

D405 = np.array([-0.0545, 0.0568, 0.0010, 0.00034, -0.0185])


def make_camera(distortion=None, width=64, height=48):
    distortion = np.zeros(5) if distortion is None else distortion
    return CameraIntrinsics(width=width, height=height, fx=33.0, fy=32.0, cx=31.0, cy=24.5, distortion=distortion)


@pytest.mark.parametrize("distortion", [None, D405])
def test_projecting_a_ray_gives_its_pixel(distortion):
    camera = make_camera(distortion)
    pixels = np.array([[0.0, 0.0], [63.0, 0.0], [10.25, 40.5], [31.0, 24.5]])
    points = rays_from_pixels(pixels, camera) * np.array([[0.1], [0.3], [0.2], [1.0]])
    # the inversion stops at 1e-10 of a ray
    np.testing.assert_allclose(project(points, camera), pixels, atol=1e-6)


def test_distortion_is_that_of_opencv():
    cv2 = pytest.importorskip("cv2")
    camera = make_camera(D405)
    points = np.array([[0.1, -0.05, 0.3], [-0.2, 0.1, 0.25]])
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, D405)
    np.testing.assert_allclose(project(points, camera), expected[:, 0], atol=1e-9)


RATIONAL_LENS = np.array([0.28, -0.12, 0.0008, -0.0005, 0.011, 0.55, -0.09, 0.004])
FISHEYE_LENS = np.array([-0.012, 0.006, -0.004, 0.0007])


def make_fisheye():
    size = {"width": 640, "height": 480, "fx": 236.0, "fy": 235.0, "cx": 320.5, "cy": 238.0}  # 155 degrees across
    return CameraIntrinsics(**size, distortion=FISHEYE_LENS, model="equidistant")


def spread_points(widest):
    angles, turns = np.radians(np.linspace(0.0, widest, 9)), np.linspace(0.0, 6.0, 9)
    rays = np.stack((np.sin(angles) * np.cos(turns), np.sin(angles) * np.sin(turns), np.cos(angles)), axis=1)
    return 0.3 * rays


def test_a_rational_lens_is_that_of_opencv_and_can_be_inverted():
    cv2 = pytest.importorskip("cv2")
    camera = replace(make_camera(), distortion=RATIONAL_LENS, model="rational_polynomial")
    points = spread_points(35.0)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, RATIONAL_LENS)
    np.testing.assert_allclose(project(points, camera), expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(rays_from_pixels(expected[:, 0], camera), points / points[:, 2:], atol=1e-8)


def test_a_fisheye_is_that_of_opencv_and_can_be_inverted():
    cv2 = pytest.importorskip("cv2")
    camera, points = make_fisheye(), spread_points(77.5)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, FISHEYE_LENS)
    np.testing.assert_allclose(project(points, camera), expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(rays_from_pixels(expected[:, 0], camera), points / points[:, 2:], rtol=1e-7, atol=1e-9)


def test_a_fisheye_has_no_ray_beyond_its_side():
    camera = replace(make_fisheye(), fx=130.0, fy=130.0, distortion=np.zeros(4))
    rays = compute_rays(camera)
    assert np.isnan(rays[0, 0, 0]) and np.isfinite(rays[240, 320]).all()
    assert np.isnan(project(np.array([[1.0, 0.0, 0.001]]), camera)).all()


def test_a_lens_with_coefficients_of_another_model_is_refused():
    with pytest.raises(IntrinsicsError, match=r"expected 0 or 4 finite coefficients of the model equidistant"):
        replace(make_fisheye(), distortion=np.ones(5))
    with pytest.raises(IntrinsicsError, match=r"'mirror': expected one of plumb_bob, rational_polynomial, equidistant"):
        replace(make_camera(), model="mirror")


def test_distortion_follows_its_published_formula():
    # x y of the ray 0.4 0.2: r2 = 0.2, written out by hand
    x, y, r2 = 0.4, 0.2, 0.2
    k1, k2, p1, p2, k3 = D405
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = 33.0 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 31.0
    v = 32.0 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 24.5
    np.testing.assert_allclose(project(np.array([[0.2, 0.1, 0.5]]), make_camera(D405)), [[u, v]], rtol=1e-12)


@pytest.mark.parametrize("focal", [1e300, 1e6, 0.05])
@pytest.mark.parametrize("axis", ["fx", "fy"])
def test_a_focal_length_out_of_proportion_to_the_image_is_refused(axis, focal):
    with pytest.raises(IntrinsicsError, match="focal lengths in proportion to the image"):
        replace(make_camera(), **{axis: focal})
    replace(make_camera(), fx=300.0, fy=290.0)  # a part cut out of an image ten times as wide


def test_distortion_that_cannot_be_inverted_is_refused():
    with pytest.raises(IntrinsicsError, match="cannot be inverted"):
        compute_rays(make_camera(np.array([-5.0, 0.0, 0.0, 0.0, 0.0])))


def test_depth_is_along_the_axis_and_columns_are_x():
    point = 0.2 * compute_rays(make_camera())[40, 5]
    np.testing.assert_allclose(point, [(5 - 31.0) / 33.0 * 0.2, (40 - 24.5) / 32.0 * 0.2, 0.2], rtol=1e-12)


def test_point_behind_the_camera_has_no_pixel():
    assert np.isnan(project(np.array([[0.0, 0.0, -0.1], [0.0, 0.1, 0.0]]), make_camera())).all()


def test_millimetres_become_metres_and_zero_becomes_nan():
    depth = decode_depth(np.array([[0, 250], [65535, 1]], dtype=np.uint16), "16UC1")
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, [[np.nan, 0.25], [65.535, 0.001]], rtol=1e-6)


def test_float_depth_keeps_metres_and_loses_what_is_no_depth():
    depth = decode_depth(np.array([[0.25, -1.0], [np.inf, np.nan]], dtype=np.float32), "32FC1")
    np.testing.assert_allclose(depth, [[0.25, np.nan], [np.nan, np.nan]])


@pytest.mark.parametrize("big", [False, True])
def test_padded_rows_and_both_byte_orders_are_read(big):
    values = np.array([[100, 200, 300], [400, 500, 600]], dtype=">u2" if big else "<u2")
    data = np.full((2, 10), 77, dtype=np.uint8)
    data[:, :6] = values.view(np.uint8)
    layout = ImageLayout(height=2, width=3, step=10, is_bigendian=big)
    np.testing.assert_allclose(decode_depth(data.tobytes(), "16UC1", layout), values * 1e-3, rtol=1e-6)


def test_truncated_image_is_refused():
    with pytest.raises(ImageError, match="11 bytes"):
        decode_depth(b"\0" * 11, "16UC1", ImageLayout(height=2, width=3))


def test_unknown_encoding_is_refused():
    with pytest.raises(ImageError, match="rgb8"):
        decode_depth(np.zeros((2, 2)), "rgb8")


@pytest.mark.parametrize("value", [0.0, np.nan, -1.0])
def test_depth_with_nothing_in_it_is_refused(value):
    with pytest.raises(ImageError, match="no pixel has a depth"):
        check_depth(np.full((48, 64), value), make_camera())


def test_depth_of_another_size_is_refused():
    with pytest.raises(ImageError, match="48 rows and 64 columns"):
        check_depth(np.ones((64, 48)), make_camera())


def test_mask_is_refused_when_empty_of_another_size_or_without_depth():
    depth = np.full((4, 5), np.nan)
    depth[0, 0] = 0.2
    with pytest.raises(ImageError, match="nothing in it"):
        check_mask(np.zeros((4, 5)), depth)
    with pytest.raises(ImageError, match="expected that of the depth image"):
        check_mask(np.ones((5, 4)), depth)
    with pytest.raises(ImageError, match="1 of its 20 pixels"):
        check_mask(np.ones((4, 5)), depth, least=2)
    check_mask(np.ones((4, 5)), depth, least=1)


@pytest.mark.parametrize(
    "change", [{"fx": 0.0}, {"cy": np.nan}, {"width": 0}, {"distortion": np.ones(8)}, {"cx": 1e9}, {"cy": -50.0}]
)
def test_impossible_intrinsics_are_refused(change):
    good = {"width": 4, "height": 3, "fx": 2.0, "fy": 2.0, "cx": 2.0, "cy": 1.5}
    CameraIntrinsics(**good)
    with pytest.raises(IntrinsicsError):
        CameraIntrinsics(**{**good, **change})


def test_the_zeros_of_a_camera_that_was_never_calibrated_are_called_that():
    with pytest.raises(IntrinsicsError, match="calibrate the camera"):
        CameraIntrinsics(width=4, height=3, fx=0.0, fy=0.0, cx=0.0, cy=0.0)
