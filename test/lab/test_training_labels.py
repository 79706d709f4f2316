"""Label files of DeepLabCut come in whole, and their points land on the right place of the jaw's picture."""

import subprocess
import sys

import numpy as np
import pytest

from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.errors import NamingError
from finforce_keypoints.geometry.side_picture import find_side, project_plane
from finforce_keypoints.geometry.template import find_shape, fit_grid
from finforce_sim.sensor import build_d405_vga
from lab.training.commands import TrainingError
from lab.training.finetune import (
    CameraView,
    find_origin,
    load_project,
    read_labels,
    rectify,
)
from lab.training.pictures import MARGIN

OLD = """scorer,me,me,me,me
bodyparts,tip,tip,inner_1,inner_1
coords,x,y,x,y
labeled-data/robot/img01.png,10.5,20.25,,
labeled-data/robot/img02.png,1,2,3,4
"""
NEW = """scorer,,,me,me,me,me
bodyparts,,,tip,tip,inner_1,inner_1
coords,,,x,y,x,y
labeled-data,robot,img01.png,10.5,20.25,,
labeled-data,robot,img02.png,1,2,3,4
"""
SEVERAL = """scorer,,,me,me,me,me,me,me
individuals,,,left,left,right,right,single,single
bodyparts,,,tip,tip,tip,tip,object,object
coords,,,x,y,x,y,x,y
labeled-data,robot,img01.png,1,2,3,4,5,6
"""


def read(text, tmp_path):
    path = tmp_path / "CollectedData_me.csv"
    path.write_text(text, encoding="utf-8")
    return read_labels(path)


def view_of_robot():
    return CameraView(camera=build_d405_vga(), T_gripper_camera=ROBOT_CAMERA)


def mark(jaw, side, origin_x, view):
    """The pixels (K + 1, 2) at which somebody would mark the points of an unloaded jaw."""
    points = np.vstack((jaw.keypoints, jaw.reference_point))
    T = jaw_in_camera(view.T_gripper_camera, side, origin_x)
    return project_plane(points[:, [0, 2]], find_side(jaw), T, view.camera)


@pytest.mark.parametrize("text", [OLD, NEW, OLD.replace("/", "\\")], ids=["one column", "three columns", "Windows"])
def test_both_index_styles_give_the_same_labels(text, tmp_path):
    labels = read(text, tmp_path)
    assert labels.images == ("labeled-data/robot/img01.png", "labeled-data/robot/img02.png")
    assert labels.names == ("tip", "inner_1")
    np.testing.assert_array_equal(labels.points[0], [[10.5, 20.25], [np.nan, np.nan]])
    np.testing.assert_array_equal(labels.points[1], [[1, 2], [3, 4]])


def test_individuals_become_a_part_of_the_names(tmp_path):
    labels = read(SEVERAL, tmp_path)
    assert labels.names == ("left_tip", "right_tip", "object")
    np.testing.assert_array_equal(labels.points[0], [[1, 2], [3, 4], [5, 6]])


def test_a_single_individual_leaves_the_names(tmp_path):
    labels = read(
        SEVERAL.replace("left,left,right,right", "jaw,jaw,jaw,jaw").replace("tip,tip,tip,tip", "tip,tip,a,a"), tmp_path
    )
    assert labels.names == ("tip", "a", "object")


def test_half_a_point_is_no_point(tmp_path):
    labels = read(OLD.replace("10.5,20.25", "10.5,"), tmp_path)
    assert np.isnan(labels.points[0]).all()


@pytest.mark.parametrize(
    "text, message",
    [
        (OLD.replace("bodyparts", "parts"), "no row 'bodyparts'"),
        (OLD.split("labeled")[0], "no frame after the header"),
        (OLD.replace("20.25", "twenty"), "'twenty'; expected numbers of pixels"),
        (OLD.replace(",3,4", ",3"), "rows of different lengths"),
        (OLD.replace("x,y,x,y", "x,y,x"), "rows of different lengths"),
        (OLD.replace(",3,4", ",3,4,5"), "rows of different lengths"),
        (OLD.replace("x,y,x,y", "x,x,x,y"), "not one x and one y"),
        (OLD.replace("img02", "img01"), "stands in 2 rows"),
    ],
)
def test_what_is_no_label_file_is_refused(text, message, tmp_path):
    with pytest.raises(TrainingError, match=message):
        read(text, tmp_path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(TrainingError, match=r"CollectedData_SCORER.csv"):
        read_labels(tmp_path / "none.csv")


@pytest.mark.parametrize("side, origin_x", [("left", -0.031), ("right", 0.024)])
def test_the_origin_follows_from_the_reference_point(side, origin_x):
    left, view = load_jaw("bench"), view_of_robot()
    jaw = left if side == "left" else left.mirrored()
    points = mark(jaw, side, origin_x, view)
    # the camera's distortion is inverted to 1e-10 of a ray; a wrong sign would be off by twice the shift
    assert find_origin(points, jaw, side, view) == pytest.approx(origin_x, abs=1e-8)
    points[-1] = np.nan
    assert find_origin(points, jaw, side, view) == pytest.approx(origin_x, abs=1e-8)
    base = jaw.keypoints[:, 2] < 0.03
    points[:-1][base] = np.nan
    assert find_origin(points, jaw, side, view) is None


@pytest.mark.parametrize("side, origin_x", [("left", -0.031), ("right", 0.024)])
def test_labels_land_where_the_points_are_in_the_picture(side, origin_x):
    cv2 = pytest.importorskip("cv2", reason="rectified pictures need OpenCV")
    left, view = load_jaw("bench"), view_of_robot()
    jaw = left if side == "left" else left.mirrored()
    points = mark(jaw, side, origin_x, view)
    hidden = 4
    image = np.zeros((480, 640, 3), np.uint8)
    for k, (column, row) in enumerate(points):
        if k != hidden:
            cv2.circle(image, (round(column * 16), round(row * 16)), 24, (255, 255, 255), -1, shift=4)
    points[hidden] = np.nan
    found = rectify(image, points, jaw, side, view)
    np.testing.assert_array_equal(np.flatnonzero(~found.visible[0]), [hidden + 1])  # the mark is the first
    rest = np.vstack((jaw.reference_point, jaw.keypoints))[:, [0, 2]]
    grid = fit_grid(find_shape(jaw))
    np.testing.assert_allclose(found.rest[0], grid.pixels(rest), atol=1e-4)
    expected = grid.padded(MARGIN).pixels(rest)
    np.testing.assert_allclose(found.place[0][found.visible[0]], expected[found.visible[0]], atol=1e-3)
    for column, row in np.round(found.place[0][found.visible[0]]).astype(int):
        assert found.picture[0, row, column].min() > 100  # in a white dot of 3 px; black would be 0


def test_a_point_that_is_marked_nowhere_is_refused(tmp_path):
    with pytest.raises(NamingError, match="missing inner_2"):
        load_project(read(OLD, tmp_path), tmp_path, view_of_robot(), "bench", ("left",), {})


def test_labels_need_no_torch():
    code = "import lab.training.finetune, lab.training.evaluate, sys; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_absent_torch_is_told_with_the_command_that_installs_it():
    code = "import sys; sys.modules['torch'] = None; import lab.training.network"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode != 0
    assert "MissingDependencyError: training of key point networks needs torch: pip install torch" in done.stderr
