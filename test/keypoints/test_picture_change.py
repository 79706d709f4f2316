"""Claims about pictures that a rig does not fit: what was done to them is named, and nothing is said of good ones."""

from itertools import islice

import cv2
import numpy as np
import pytest

from finforce.gripper_frames import ROBOT_CAMERA, OpeningRange
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.build import ANY_FINGER
from finforce_keypoints.detectors.side_plane import AnyFinger
from finforce_keypoints.networks.side_network import SideNetwork
from finforce_keypoints.parameters import JawMount
from finforce_keypoints.picture_change import SURE, PictureChange, PictureChanges, describe_changes
from finforce_sim.scenarios import build_scenario
from finforce_sim.sensor import build_d405_vga
from finforce_sim.simulated_recording import build_simulated_recording

WIDTH = 640


@pytest.fixture(scope="module")
def picture():
    """The twin's left jaw, open; what is right of it is grey."""
    (frame,) = islice(build_simulated_recording(build_scenario("grasp_cylinder"), 712), 1)
    color = frame.color.copy()
    color[:, 320:] = 90
    return color


@pytest.fixture(scope="module")
def changes():
    jaws, mounts = {"left": load_jaw("bench")}, {"left": JawMount()}
    locator = AnyFinger(SideNetwork(ANY_FINGER, threads=1), jaws, mounts)
    return PictureChanges(build_d405_vga(), ROBOT_CAMERA, jaws, mounts, OpeningRange(), locator)


def changed(picture, zoom=1.0, shift=0.0, degrees=0.0):
    """A picture as a camera with a zoom takes it, that is turned clockwise, and moved down [px]."""
    camera = build_d405_vga()
    matrix = cv2.getRotationMatrix2D((camera.cx, camera.cy), -degrees, zoom)
    matrix[1, 2] += shift
    return cv2.warpAffine(picture, matrix, picture.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)


@pytest.mark.parametrize(("zoom", "shift", "degrees"), [(1.0, 0.0, 0.0), (1.3, 0.0, 0.0), (0.9, 8.0, 3.0)])
def test_how_a_picture_was_changed_is_found(changes, picture, zoom, shift, degrees):
    found = changes.find(changed(picture, zoom, shift, degrees))
    assert found.likelihood > SURE
    assert found.zoom == pytest.approx(zoom, abs=0.02) and found.shift == pytest.approx(shift, abs=2.0)
    assert np.degrees(found.turn) == pytest.approx(degrees, abs=0.5)


def test_pictures_that_are_turned_over_or_show_no_jaw_are_named_and_good_ones_are_not(changes, picture):
    assert changes.explain([picture]) == ""
    assert "upside down" in changes.explain([picture[::-1, ::-1]])
    assert "mirrored from left to right" in changes.explain([picture[:, ::-1]])
    assert "hidden" in changes.explain([np.full_like(picture, 90)])


def series(zooms=1.0, shifts=0.0, degrees=0.0, count=8):
    columns = (np.broadcast_to(each, count) for each in (zooms, shifts, np.radians(degrees)))
    return [PictureChange(zoom=z, shift=s, turn=t, likelihood=0.9) for z, s, t in zip(*columns, strict=True)]


def test_a_zoom_a_moved_camera_and_a_stabiliser_are_told_apart():
    for words, wrong in (
        ("1.15 times as large", series(1.15)),
        ("moved in its mount", series(shifts=9.0, degrees=-2.0)),
        ("moved in its mount", series(shifts=[0.0, 0.0, 0.0, 9.0, 9.0, 9.0, 9.0, 9.0])),  # bumped once
        ("image stabilisation", series(shifts=[0.0, 4.0, -3.0, 2.0, 6.0, 1.0, -5.0, 0.0])),
    ):
        assert words in describe_changes(wrong, WIDTH)
    both = describe_changes(series(1.1, shifts=[0.0, 4.0, -3.0, 2.0, 6.0, 1.0, -5.0, 0.0]), WIDTH)
    assert "image stabilisation" in both and "1.10 times" in both


def test_what_holders_and_loads_do_is_no_stabiliser():
    """A holder gives by 3 px under a load that comes and goes."""
    load = np.array([0.0, 0.0, 3.0, 3.0, 3.0, 0.0, 0.0, 3.0])
    for good in (
        series(),
        series(0.96, 2.0, 1.0),
        series(shifts=load, degrees=0.4 * load),
        series(shifts=load[:3], count=3),
    ):
        assert describe_changes(good, WIDTH) == ""
