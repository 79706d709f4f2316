"""Claims about cameras from files: each program's file gives its camera, and no file one that it does not describe."""

import json

import numpy as np
import pytest

from finforce.camera import IntrinsicsError, project, rays_from_pixels
from finforce.camera_file import read_camera

OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 600., 0., 322., 0., 601., 243., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.1, -0.2, 1e-3, 2e-3, 0.05 ]
"""
COLMAP = "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {} 640 480 {}\n"
XML = """<?xml version="1.0"?>
<opencv_storage>
<calibration_time>"Mon 1 Jan"</calibration_time>
<image_Width>640</image_Width>
<image_Height>480</image_Height>
<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>600. 0. 322. 0. 601. 243. 0. 0. 1.</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt>
  <data>0.1 -0.2 1e-3 2e-3 0.05</data></Distortion_Coefficients>
</opencv_storage>
"""
ROS = """image_width: 640
image_height: 480
camera_name: wrist
camera_matrix: {rows: 3, cols: 3, data: [600, 0, 322, 0, 601, 243, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 1e-3, 2e-3, 0.05]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [590, 0, 320, 0, 0, 590, 240, 0, 0, 0, 1, 0]}
"""
KALIBR = """%YAML:1.0 # a remark
cam0:
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.02, 0.003, -0.004]
  distortion_model: {model}
  intrinsics: [300.0, 301.0, 320.0, 240.0]
  resolution: [640, 480]
  T_cam_imu:
    - [1.0, 0.0, 0.0, 0.0]
"""
GOPRO = {
    "image_width": 2704,
    "image_height": 2028,
    "intrinsic_type": "FISHEYE",
    "intrinsics": {
        "aspect_ratio": 1.01,
        "focal_length": 800.0,
        "principal_pt_x": 1350.0,
        "principal_pt_y": 1010.0,
        "radial_distortion_1": -0.02,
        "radial_distortion_2": -0.01,
        "radial_distortion_3": 0.002,
        "radial_distortion_4": -0.0001,
        "skew": 0.0,
    },
}


def write(tmp_path, content):
    path = tmp_path / "camera.txt"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def numbers_of(camera):
    return [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]


@pytest.mark.parametrize(
    "content",
    [
        "600,601,322,243",
        "600 601\n322 243\n",
        "600.0 0 322\n0 601 243\n0 0 1\n",
        {"0": {"cam_K": [600, 0, 322, 0, 601, 243, 0, 0, 1], "depth_scale": 0.1}},
        {str(image): {"cam_K": [600, 0, 322, 0, 601, 243, 0, 0, 1], "depth_scale": 0.1 * image} for image in (1, 2)},
        {"cx": 322, "cy": 243, "fx": 600, "fy": 601, "width": 640, "height": 480, "depth_scale": 1.0},
        {"intrinsic_matrix": [[600, 0, 322], [0, 601, 243], [0, 0, 1]]},
        {"intrinsic_matrix": [600, 0, 0, 0, 601, 0, 322, 243, 1], "width": 640, "height": 480},
        OPENCV.replace("0.1, -0.2, 1e-3, 2e-3, 0.05", "0., 0., 0., 0., 0."),
    ],
)
def test_every_way_to_write_a_pinhole_gives_the_same_camera(content, tmp_path):
    camera = read_camera(write(tmp_path, content), (480, 640))
    assert numbers_of(camera) == [640, 480, 600.0, 601.0, 322.0, 243.0]
    assert not camera.distortion.any()


@pytest.mark.parametrize("content", [OPENCV, XML, ROS])
def test_a_lens_keeps_its_coefficients_in_their_order(content, tmp_path):
    camera = read_camera(write(tmp_path, content))
    assert camera.model == "plumb_bob" and numbers_of(camera) == [640, 480, 600.0, 601.0, 322.0, 243.0]
    np.testing.assert_array_equal(camera.distortion, [0.1, -0.2, 1e-3, 2e-3, 0.05])


PINHOLE = {"width": 640, "height": 480, "fx": 600, "fy": 601, "cx": 322, "cy": 243}
BENT = [0.1, -0.2, 1e-3, 2e-3, 0.05]
BENT_BY_NAME = dict(zip(("k1", "k2", "p1", "p2", "k3"), BENT, strict=True))


@pytest.mark.parametrize(
    "lens",
    [
        {"dist": BENT},
        {"dist": [BENT]},
        {"dist_coeff": BENT},
        {"distCoeffs": BENT_BY_NAME},
        {"distortion_params": BENT},
        {"distortion_model": "plumb_bob", "distance": [0.3], "D": BENT},
        {"coeffs": BENT, "model": "distortion.inverse_brown_conrady"},
        BENT_BY_NAME,
    ],
)
def test_a_lens_is_found_whatever_its_entry_is_called(lens, tmp_path):
    camera = read_camera(write(tmp_path, PINHOLE | lens))
    assert camera.model == "plumb_bob"
    np.testing.assert_array_equal(camera.distortion, BENT)


def test_coefficients_by_name_are_those_of_their_lens(tmp_path):
    four = {"k1": -0.02, "k2": -0.01, "k3": 0.002, "k4": -1e-4}
    for name in ("fisheye", "KANNALA_BRANDT4", "OPENCV_FISHEYE"):
        camera = read_camera(write(tmp_path, PINHOLE | four | {"model": name}))
        assert camera.model == "equidistant"
        np.testing.assert_array_equal(camera.distortion, list(four.values()))
    with pytest.raises(IntrinsicsError, match="k4 without p1: of a fisheye.*model: equidistant"):
        read_camera(write(tmp_path, PINHOLE | four))
    camera = read_camera(write(tmp_path, PINHOLE | BENT_BY_NAME | {"k4": 0.01, "k5": 0.02, "k6": 0.03}))
    assert camera.model == "rational_polynomial"
    np.testing.assert_array_equal(camera.distortion, [*BENT, 0.01, 0.02, 0.03])


def test_the_radial_part_of_a_lens_alone_is_refused(tmp_path):
    with pytest.raises(IntrinsicsError, match="2 coefficients|2 distortion|distortion"):
        read_camera(write(tmp_path, PINHOLE | {"RadialDistortion": [0.1, -0.2], "TangentialDistortion": [0.0, 0.0]}))


ECHO = """header: {{stamp: {{sec: {second}}}}}
height: 480
width: 640
distortion_model: plumb_bob
d: [0.1, -0.2, 1e-3, 2e-3, 0.05]
k: [{focal}, 0.0, 322.0, 0.0, 601.0, 243.0, 0.0, 0.0, 1.0]
---
"""


def test_what_ros_topic_echo_prints_is_one_camera(tmp_path):
    for count in (1, 3):
        text = "".join(ECHO.format(second=number, focal=600.0) for number in range(count))
        assert numbers_of(read_camera(write(tmp_path, text))) == [640, 480, 600.0, 601.0, 322.0, 243.0]
    two = ECHO.format(second=1, focal=600.0) + ECHO.format(second=2, focal=500.0)
    with pytest.raises(IntrinsicsError, match="several cameras"):
        read_camera(write(tmp_path, two))


def test_opencv_tells_other_lenses_by_their_coefficients_or_a_flag(tmp_path):
    wide = OPENCV.replace("0.05 ]", "0.05, 0.01, 0.02, 0.03 ]")
    assert read_camera(write(tmp_path, wide)).model == "rational_polynomial"
    bent = XML.replace("1e-3 2e-3 0.05", "1e-3 2e-3").replace(
        "<Camera_M", "<fisheye_model>1</fisheye_model>\n<Camera_M", 1
    )
    assert read_camera(write(tmp_path, bent)).model == "equidistant"


@pytest.mark.parametrize(("model", "expected"), [("radtan", "plumb_bob"), ("equidistant", "equidistant")])
def test_kalibr_names_the_lens(model, expected, tmp_path):
    short = KALIBR.replace("  distortion_model: {model}\n", "")
    short = short.replace("pinhole", f"pinhole-{model.removesuffix('distant')}")
    assert read_camera(write(tmp_path, short)).model == expected
    camera = read_camera(write(tmp_path, KALIBR.format(model=model)))
    assert camera.model == expected and numbers_of(camera) == [640, 480, 300.0, 301.0, 320.0, 240.0]
    np.testing.assert_array_equal(camera.distortion[:4], [0.01, -0.02, 0.003, -0.004])


def test_a_fisheye_of_ros_is_known_by_its_camera_model(tmp_path):
    path = tmp_path / "ost.yaml"
    fisheye = ROS.replace("distortion_model: plumb_bob", "camera_model: fisheye")
    path.write_text(fisheye.replace("cols: 5, data: [0.1, -0.2, 1e-3, 2e-3, 0.05]", "cols: 4, data: [0.1, -0.2, 0, 0]"))
    assert read_camera(path).model == "equidistant"
    path.write_text(ROS.replace("distortion_model: plumb_bob", "camera_model: pinhole"))
    assert read_camera(path).model == "plumb_bob"


def test_a_fisheye_of_umi_is_the_equidistant_lens(tmp_path):
    camera = read_camera(write(tmp_path, GOPRO))
    assert camera.model == "equidistant" and camera.fy == pytest.approx(808.0)
    x, y = 1.0, 0.5
    angle = np.arctan(np.hypot(x, y))
    bent = angle * (1 - 0.02 * angle**2 - 0.01 * angle**4 + 0.002 * angle**6 - 0.0001 * angle**8)
    expected = np.array([1350.0, 1010.0]) + bent / np.hypot(x, y) * np.array([800.0 * x, 808.0 * y])
    pixel = project(np.array([[x, y, 1.0]]), camera)
    np.testing.assert_allclose(pixel[0], expected, atol=1e-9)
    np.testing.assert_allclose(rays_from_pixels(pixel, camera), [[x, y, 1.0]], atol=1e-8)


ORB_SLAM = """%YAML:1.0

Camera.type: "{kind}"
{name}.fx: 600.
{name}.fy: 601.
{name}.cx: 322.
{name}.cy: 243.
{name}.k1: 0.1
{name}.k2: -0.2
{lens}
Camera2.fx: 1.
Camera.width: 640
Camera.height: 480
Camera.fps: 30
"""


@pytest.mark.parametrize(
    ("kind", "name", "lens", "model", "expected"),
    [
        ("PinHole", "Camera", ("p1: 1e-3", "p2: 2e-3", "k3: 0.05"), "plumb_bob", [0.1, -0.2, 1e-3, 2e-3, 0.05]),
        ("KannalaBrandt8", "Camera1", ("k3: 0.3", "k4: 0.4"), "equidistant", [0.1, -0.2, 0.3, 0.4]),
    ],
)
def test_settings_of_orb_slam_are_those_of_its_first_camera(kind, name, lens, model, expected, tmp_path):
    lines = "\n".join(f"{name}.{line}" for line in lens)
    camera = read_camera(write(tmp_path, ORB_SLAM.format(kind=kind, name=name, lens=lines)))
    assert camera.model == model and (camera.width, camera.height) == (640, 480)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (600.0, 601.0, 322.0, 243.0)
    np.testing.assert_array_equal(camera.distortion, expected)


@pytest.mark.parametrize(
    ("model", "numbers", "lens", "expected"),
    [
        ("PINHOLE", "600 601 322.5 243.5", "plumb_bob", [0.0, 0.0, 0.0, 0.0, 0.0]),
        ("OPENCV", "600 601 322.5 243.5 0.1 -0.2 1e-3 2e-3", "plumb_bob", [0.1, -0.2, 1e-3, 2e-3, 0.0]),
        ("OPENCV_FISHEYE", "600 601 322.5 243.5 0.1 -0.2 0.3 0.4", "equidistant", [0.1, -0.2, 0.3, 0.4]),
    ],
)
def test_colmap_counts_pixels_from_their_corner(model, numbers, lens, expected, tmp_path):
    camera = read_camera(write(tmp_path, COLMAP.format(model, numbers)))
    assert numbers_of(camera) == [640, 480, 600.0, 601.0, 322.0, 243.0] and camera.model == lens
    np.testing.assert_array_equal(camera.distortion, expected)


def test_the_focal_length_of_a_simple_model_of_colmap_is_that_of_both_axes(tmp_path):
    camera = read_camera(write(tmp_path, COLMAP.format("SIMPLE_RADIAL", "600 322.5 243.5 0.1")))
    assert (camera.fx, camera.fy, camera.distortion[0]) == (600.0, 600.0, 0.1)


def test_of_several_cameras_one_has_to_be_named(tmp_path):
    both = KALIBR.format(model="radtan") + KALIBR.format(model="radtan").partition("\n")[2].replace(
        "cam0", "cam1"
    ).replace("300.0, 301.0", "400.0, 401.0")
    path = write(tmp_path, both)
    with pytest.raises(IntrinsicsError, match="several cameras: cam0, cam1"):
        read_camera(path)
    assert read_camera(path, name="cam1").fx == 400.0
    with pytest.raises(IntrinsicsError, match="no camera cam7, but cam0, cam1"):
        read_camera(path, name="cam7")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"aruco_dict": {"predefined": "DICT_4X4_50"}}, "'fx' is missing"),
        ({"intrinsic_type": "DOUBLE_SPHERE", "intrinsics": {}}, "DOUBLE_SPHERE"),
        (KALIBR.format(model="radtan").replace("pinhole", "omni"), "camera_model omni"),
        (KALIBR.format(model="radtan").replace("pinhole", "ds"), "camera_model ds: expected pinhole"),
        (XML.replace("</opencv_storage>", ""), "is no XML of OpenCV"),
        (XML.replace("<opencv_storage>", "<!DOCTYPE a []><opencv_storage>", 1), "declarations; expected none"),
        (XML.replace("601.", "six"), "'fx' is missing"),
        (KALIBR.format(model="fov"), "distortion model 'fov'"),
        ({"fx": 600, "fy": 600, "cx": 320, "cy": 240}, "intrinsics of no size; expected width and height"),
        (GOPRO | {"image_width": 640, "image_height": 480}, "principal point 1350, 1010 outside images of 640 x 480"),
        ("600 601 322", "3 numbers"),
        (COLMAP.format("THIN_PRISM_FISHEYE", "600 601 322 243"), "camera model THIN_PRISM_FISHEYE"),
        (COLMAP.format("PINHOLE", "600 601 322 243 1"), "camera model PINHOLE with 640 480"),
        (COLMAP.format("PINHOLE", "600 six 322 243"), "camera model PINHOLE with 640 480 600 six"),
        (COLMAP.format("PINHOLE", "6 6 3 2") + "2 PINHOLE 640 480 7 7 3 2\n", "describes 2 cameras"),
        ({"K": [600, 2, 322, 0, 601, 243, 0, 0, 1], "width": 640, "height": 480}, "no skew"),
        ("\x00", "camera.txt"),
    ],
)
def test_what_describes_no_camera_is_refused_by_name(content, words, tmp_path):
    with pytest.raises(IntrinsicsError, match=f"camera.txt: .*{words}" if words != "camera.txt" else words):
        read_camera(write(tmp_path, content))


def test_a_camera_of_another_picture_size_is_refused(tmp_path):
    with pytest.raises(IntrinsicsError, match="intrinsics of 640 x 480; expected 320 x 240"):
        read_camera(write(tmp_path, OPENCV), (240, 320))
