"""Claims about a camera above a table with holes: lens, focal length and place come out of one picture."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics, compute_rays, project
from finforce_keypoints.errors import GeometryError
from finforce_keypoints.geometry.extrinsics import find_grid_camera, fit_grid_camera

PITCH, RADIUS = 0.025, 0.003
SIZE = {"width": 960, "height": 540}


def make_camera(fx=760.0, distortion=(-0.19, 0.04, 0.0, 0.0, 0.0)):
    return CameraIntrinsics(**SIZE, fx=fx, fy=fx, cx=479.5, cy=269.5, distortion=np.array(distortion))


def make_pose(turn=(2.0, -1.5, 4.0), away=0.42):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    T[:3, 3] = 0.004, -0.011, away
    return T


def draw_table(camera, T, noise=3.0):
    """A grey table with holes, something white on it and a cable."""
    rays = compute_rays(camera)
    depth = (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2])
    on_table = (rays * depth[..., None] - T[:3, 3]) @ T[:3, :3]
    beside = on_table[..., :2] - PITCH * np.round(on_table[..., :2] / PITCH)
    grey = np.where(np.hypot(*np.moveaxis(beside, 2, 0)) < RADIUS, 25.0, 150.0)
    grey[np.hypot(on_table[..., 0], on_table[..., 1]) < 0.06] = 220.0
    image = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)
    cv2.line(image, (200, 539), (330, 300), (20, 20, 20), 9)
    image = cv2.GaussianBlur(image, (0, 0), 1.0).astype(float)
    return np.clip(image + np.random.default_rng(0).normal(0.0, noise, image.shape), 0, 255).astype(np.uint8)


def test_places_on_the_table_are_right_to_a_quarter_of_a_millimetre():
    camera, T = make_camera(), make_pose()
    found = find_grid_camera(draw_table(camera, T), PITCH)
    assert len(found.holes) > 100 and found.residual < 0.3
    # the grid has no origin of its own: the true places of two holes tell where it was put
    corners = np.array([[-0.2, -0.1, 0.0], [0.2, -0.1, 0.0], [0.2, 0.1, 0.0], [-0.2, 0.1, 0.0]])
    pixels = project(corners @ T[:3, :3].T + T[:3, 3], camera)
    rays = np.column_stack((cv2_undistort(pixels, found.camera), np.ones(4)))
    R, t = found.T_camera_table[:3, :3], found.T_camera_table[:3, 3]
    depth = (R[:, 2] @ t) / (rays @ R[:, 2])
    back = ((rays * depth[:, None] - t) @ R)[:, :2]
    sides = np.linalg.norm(np.roll(back, -1, axis=0) - back, axis=1)
    np.testing.assert_allclose(sides, [0.4, 0.2, 0.4, 0.2], atol=0.25e-3)


def cv2_undistort(pixels, camera):
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    return cv2.undistortPoints(pixels[:, None], matrix, camera.distortion)[:, 0]


def test_a_slanted_view_tells_the_focal_length():
    camera, T = make_camera(fx=1000.0), make_pose(turn=(25.0, -10.0, 3.0), away=0.5)
    found = find_grid_camera(draw_table(camera, T), PITCH)
    assert found.camera.fx == pytest.approx(1000.0, rel=0.02)
    assert found.T_camera_table[2, 3] == pytest.approx(0.5, rel=0.05)


def test_a_picture_without_a_grid_is_refused():
    rng = np.random.default_rng(1)
    with pytest.raises(GeometryError, match=r"expected at least 20 holes"):
        find_grid_camera(rng.integers(90, 160, (540, 960, 3), dtype=np.uint8), PITCH)
    with pytest.raises(GeometryError, match="a grid of"):
        fit_grid_camera(rng.uniform(0, 500, (60, 2)), (540, 960), PITCH)
    with pytest.raises(GeometryError, match="pitch"):
        fit_grid_camera(rng.uniform(0, 500, (60, 2)), (540, 960), 25.0)


def test_the_command_prints_the_camera_of_a_picture(tmp_path, capsys):
    import yaml

    from finforce_eval.cli.main import main

    camera, T = make_camera(), make_pose()
    path = tmp_path / "table.png"
    cv2.imwrite(str(path), draw_table(camera, T)[..., ::-1])
    assert main(["extrinsics", "--grid", "25", str(path)]) == 0
    said = yaml.safe_load(capsys.readouterr().out)
    assert (said["width"], said["height"], len(said["T_camera_table"])) == (960, 540, 7)
    with pytest.raises(SystemExit, match="2"):
        main(["extrinsics", "--grid", "0.025", str(path)])
    assert "--grid: 0.025: expected millimetres, such as 25" in capsys.readouterr().err
    assert main(["extrinsics", "--grid", "25", str(tmp_path)]) == 2
    assert "expected a picture" in capsys.readouterr().err
