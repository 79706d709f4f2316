"""Claims about the pattern of the ribs, which says where a camera is, and about known sizes, which help it."""

import numpy as np
import pytest

from finforce.gripper_frames import ROBOT_CAMERA, OpeningRange, jaw_in_camera
from finforce.optional import import_cv2
from finforce.transforms import move_pose
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.geometry.rib_pattern import RibPattern, correlate, weigh_evidence
from finforce_keypoints.geometry.side_picture import find_side, project_plane
from finforce_keypoints.geometry.template import find_shape
from finforce_keypoints.parameters import JawMount
from finforce_keypoints.placement import CameraPlacement, KnownSizes, _Scene, compare_placement, find_pitch
from finforce_sim.sensor import build_d405_vga

CAMERA = build_d405_vga()
JAWS = {side: load_jaw("bench", side) for side in ("left", "right")}
PITCH = find_pitch(JAWS["left"].keypoints[:, ::2])
OPENING = OpeningRange(nearest=0.02, farthest=0.06)


def paint(T_gripper_camera=ROBOT_CAMERA, x=0.04, ground=(180, 170, 160)):
    """Return a picture of both jaws, cells darker than ribs."""
    cv2, color = import_cv2(), np.full((480, 640, 3), ground, np.uint8)
    for side, jaw in JAWS.items():
        T = jaw_in_camera(T_gripper_camera, side, -x if side == "left" else x)
        rings = [project_plane(ring, find_side(jaw), T, CAMERA) for ring in find_shape(jaw).rings]
        lines = [np.round(ring).astype(np.int32) for ring in rings]
        for line in lines:
            cv2.fillPoly(color, [line], (150, 70, 10))
        cv2.fillPoly(color, lines, (240, 120, 20))
    return cv2.GaussianBlur(color, (0, 0), 1.0)


def measure(color, T, pattern):
    return pattern.compare(color, T, CAMERA, 0)


@pytest.fixture(scope="module")
def pattern():
    return RibPattern(JAWS["left"], [(np.array([0.0, 1.0]), -1.0)])


def test_ribs_show_where_they_are_and_not_one_rib_further(pattern):
    T, color = jaw_in_camera(ROBOT_CAMERA, "left", -0.04), paint()
    there = correlate([measure(color, T, pattern)])
    assert there > 0.7
    for ribs in (-2, -1, 1, 2):
        shifted = T.copy()
        shifted[:3, 3] += ribs * PITCH * T[:3, 2]
        assert correlate([measure(color, shifted, pattern)]) < 0.8 * there
    flat = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    assert correlate([measure(flat, T, pattern)]) < 0.15


def test_what_the_picture_does_not_show_of_the_ribs_is_no_evidence(pattern):
    T, color = jaw_in_camera(ROBOT_CAMERA, "left", -0.04), paint()
    whole, part = (measure(np.ascontiguousarray(color[:rows]), T, pattern) for rows in (480, 200))
    samples = len(pattern.opens[0].places)
    assert part.share < 0.9 * whole.share and whole.share > 0.95
    assert weigh_evidence([part], samples) < weigh_evidence([whole], samples)


def test_pictures_without_any_sample_correlate_with_nothing(pattern):
    away = jaw_in_camera(ROBOT_CAMERA, "left", -0.9)
    nothing = measure(paint(), away, pattern)
    assert nothing.share == 0.0 and correlate([nothing]) == 0.0


@pytest.mark.parametrize(
    ("correlation", "rival", "sure"), [(0.7, 0.4, True), (0.7, 0.95, False), (0.3, 0.0, False), (0.5, 0.0, True)]
)
def test_a_place_is_sure_only_where_the_next_best_is_clearly_worse(correlation, rival, sure):
    found = CameraPlacement(
        T_gripper_camera=ROBOT_CAMERA,
        mounts={},
        origins={},
        correlation=correlation,
        residual=0.5,
        seen={},
        rival=rival,
    )
    assert found.is_sure == sure


@pytest.mark.parametrize(("off", "right"), [(0.0, True), (1.0, False)])
def test_a_rig_is_judged_by_other_pictures(off, right):
    colors = [paint(x=0.04), paint(x=0.045)]
    T = move_pose(ROBOT_CAMERA, np.zeros(6))
    T[2, 3] += off * PITCH  # one rib along the jaws
    found = compare_placement(colors, CAMERA, JAWS, T, {side: JawMount() for side in JAWS}, OPENING)
    assert found.is_right == right
    assert found.correlation > 0.6 if right else found.rival > 1.0


@pytest.mark.parametrize("larger", [1.0, 1.1])
def test_a_stated_stroke_and_the_size_of_tags_tell_a_wrong_scale(larger):
    scene = _Scene([paint()], CAMERA, JAWS, None, KnownSizes())
    true = {side: [jaw_in_camera(ROBOT_CAMERA, side, x)] for side, x in (("left", -0.04), ("right", 0.04))}
    plane, square = find_side(JAWS["left"]), 0.008 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) + (0.0, 0.02)
    tags = [{7: project_plane(square, plane, true["left"][0], CAMERA)}]
    stroke = 0.08 - 2.0 * JAWS["left"].inner_face_x
    known = KnownSizes(stroke=stroke, tags=tags, tag_size=0.016)
    origins = {"left": np.array([-0.04 * larger]), "right": np.array([0.04 * larger])}
    poses = {side: [T[0].copy()] for side, T in true.items()}
    for each in poses.values():
        each[0][:3, 3] *= larger  # farther away, everything looks larger on the jaws' sides
    missed = known.misses(origins, poses, scene)
    assert (np.abs(missed[:2]).max() < 0.1) == (larger == 1.0)
    assert larger == 1.0 or (missed[0] > 5.0 and missed[1] > 1.0)
    assert KnownSizes().misses(origins, poses, scene) == []
