"""Claims about the ribs that tell a right rig from one that is a rib or two off."""

from argparse import Namespace
from dataclasses import replace

import cv2
import numpy as np
import pytest

from finforce.gripper_frames import ROBOT_CAMERA, OpeningRange, jaw_in_camera
from finforce_eval.cli.camera import refuse_doubts
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints import rib_check
from finforce_keypoints.errors import GeometryError
from finforce_keypoints.geometry.rib_pattern import RibPattern
from finforce_keypoints.geometry.side_picture import find_side, project_plane
from finforce_keypoints.geometry.template import find_shape
from finforce_keypoints.parameters import JawMount
from finforce_keypoints.rib_check import LEAST_MARGIN, RibComparison, RibPlace, compare_ribs, compare_rig, describe_ribs
from finforce_sim.sensor import build_d405_vga

CAMERA = build_d405_vga()


def shift_along(T, distance):
    """Return a pose moved along the finger [m]."""
    moved = T.copy()
    moved[:3, 3] += distance * T[:3, 2]
    return moved


def paint(poses, jaws, finger=(240, 120, 20), cells=(120, 55, 8), blur=0.7, slant=0.0):
    color = np.random.default_rng(1).normal((150, 150, 145), 4.0, (480, 640, 3)).clip(0, 255).astype(np.uint8)
    for side, T in poses.items():
        rings, plane = find_shape(jaws[side]).rings, find_side(jaws[side])
        face = max(ring[:, 0].max() for ring in rings)
        rings = [ring + slant * (ring[:, :1] - face) * (0.0, 1.0) for ring in rings]
        lines = [np.round(project_plane(ring, plane, T, CAMERA)).astype(np.int32) for ring in rings]
        for line in lines:
            cv2.fillPoly(color, [line], cells)
        cv2.fillPoly(color, lines, finger)
    return cv2.GaussianBlur(color, (0, 0), blur)


@pytest.mark.parametrize("cells", [(120, 55, 8), (255, 190, 80)])
@pytest.mark.parametrize("name", ["bench", "umi"])
@pytest.mark.parametrize("ribs", [0, 1, -1, 2, -2])
def test_ribs_tell_a_rig_that_is_some_ribs_off_from_one_that_is_right(name, ribs, cells):
    jaws = {side: load_jaw(name, side) for side in ("left", "right")}
    poses = {side: jaw_in_camera(ROBOT_CAMERA, side, x) for side, x in (("left", -0.045), ("right", 0.045))}
    color, pitch = paint(poses, jaws, cells=cells), RibPattern(jaws["left"]).pitch
    moved = {side: [shift_along(T, ribs * pitch)] for side, T in poses.items()}
    compared = compare_ribs({side: RibPattern(jaw) for side, jaw in jaws.items()}, [color], moved, CAMERA)
    said = describe_ribs(compared)
    if ribs == 0:
        assert not said and all(each.margin > LEAST_MARGIN for each in compared.values())
        return
    assert said
    for each in compared.values():
        if abs(ribs) == 1:  # the ribs are told to be where they are
            assert len(said) == 2 and each.margin < LEAST_MARGIN
            assert each.other.shift == pytest.approx(-ribs * pitch, abs=0.4 * pitch)


def test_ribs_that_cannot_be_seen_are_no_reason_to_trust_a_rig():
    jaw, T = load_jaw("umi", "left"), jaw_in_camera(ROBOT_CAMERA, "left", -0.045)
    plain = paint({"left": T}, {"left": jaw}, cells=(240, 120, 20))
    pattern = {"left": RibPattern(jaw)}
    assert describe_ribs(compare_ribs(pattern, [plain], {"left": [T]}, CAMERA))
    empty = compare_ribs(pattern, [np.zeros_like(plain)], {"left": [T]}, CAMERA)
    assert "neither ribs nor tips show" in describe_ribs(empty)[0]


@pytest.mark.parametrize("slant", [-0.4, 0.4])
def test_ribs_that_slant_otherwise_than_in_the_jaw_file_are_where_they_meet_the_face(slant):
    jaws = {side: load_jaw("umi", side) for side in ("left", "right")}
    poses = {side: jaw_in_camera(ROBOT_CAMERA, side, x) for side, x in (("left", -0.045), ("right", 0.045))}
    color, pitch = paint(poses, jaws, slant=slant), RibPattern(jaws["left"]).pitch
    patterns = {side: RibPattern(jaw) for side, jaw in jaws.items()}
    compared = compare_ribs(patterns, [color], {side: [T] for side, T in poses.items()}, CAMERA)
    assert not describe_ribs(compared)
    assert all(abs(each.here.shift) < 0.2 * pitch for each in compared.values())
    moved = {side: [shift_along(T, pitch)] for side, T in poses.items()}
    assert describe_ribs(compare_ribs(patterns, [color], moved, CAMERA))


def place_of(evidence, shift=0.0):
    return RibPlace(evidence=evidence, ribs=0.6, shift=shift, distance=abs(shift) / 6e-3, warps=np.zeros((1, 2, 3)))


def test_a_jaw_that_hardly_shows_is_where_its_mate_says(monkeypatch):
    jaws = {side: load_jaw("umi", side) for side in ("left", "right")}
    patterns = {side: RibPattern(jaw) for side, jaw in jaws.items()}
    poses = {side: [jaw_in_camera(ROBOT_CAMERA, side, x)] for side, x in (("left", -0.045), ("right", 0.045))}
    pitch = patterns["left"].pitch
    places = {"left": [place_of(2.5), place_of(1.0, -pitch)], "right": [place_of(0.5), place_of(0.55, -pitch)]}
    monkeypatch.setattr(rib_check, "find_places", lambda *arguments: places)
    assert not describe_ribs(compare_ribs(patterns, [], poses, CAMERA))
    places["left"][1] = place_of(2.48, -pitch)  # both jaws may be a rib further
    assert len(describe_ribs(compare_ribs(patterns, [], poses, CAMERA))) == 2
    places.pop("left")
    alone = compare_ribs(patterns, [], {"right": poses["right"]}, CAMERA)["right"]
    assert alone.margin < 0.0 and alone.other.shift == -pitch


def test_the_flank_of_a_place_is_no_other_place(monkeypatch):
    jaw, T = load_jaw("umi", "left"), jaw_in_camera(ROBOT_CAMERA, "left", -0.045)
    patterns = {"left": RibPattern(jaw)}
    found = [place_of(1.5, -0.4 * 6e-3), place_of(1.45, -0.55 * 6e-3), place_of(1.0, 6e-3)]
    monkeypatch.setattr(rib_check, "find_places", lambda *arguments: {"left": found})
    assert not describe_ribs(compare_ribs(patterns, [], {"left": [T]}, CAMERA))
    found[1] = place_of(1.7, -0.55 * 6e-3)
    assert describe_ribs(compare_ribs(patterns, [], {"left": [T]}, CAMERA))


def test_a_rig_is_judged_by_pictures_at_openings_that_nobody_states():
    jaws = {side: load_jaw("umi", side) for side in ("left", "right")}
    colors = [
        paint({side: jaw_in_camera(ROBOT_CAMERA, side, s * x) for side, s in (("left", -1), ("right", 1))}, jaws)
        for x in (0.047, 0.038)
    ]
    mounts, opening = {side: JawMount() for side in jaws}, OpeningRange(nearest=0.015, farthest=0.06)
    assert not describe_ribs(compare_rig(jaws, colors, CAMERA, ROBOT_CAMERA, mounts, opening))
    farther = ROBOT_CAMERA.copy()
    farther[2, 3] += RibPattern(jaws["left"]).pitch
    assert describe_ribs(compare_rig(jaws, colors, CAMERA, farther, mounts, opening))


@pytest.mark.parametrize(
    ("margin", "words"), [(0.05, "two places explain the pictures alike"), (-0.3, "the ribs are rather 9.5 mm towards")]
)
def test_a_doubtful_place_writes_no_rig_unless_forced(margin, words, tmp_path):
    place = RibPlace(evidence=2.0, ribs=0.7, shift=0.0, distance=0.0, warps=np.zeros((1, 2, 3)))
    other = replace(place, evidence=2.0 - margin, shift=9.5e-3, distance=1.0)
    doubts = describe_ribs({"left": RibComparison(here=place, other=other)})
    assert words in doubts[0]
    with pytest.raises(GeometryError, match=f"{words}.* No rig is written"):
        refuse_doubts(doubts, Namespace(force=False), tmp_path / "rig.png")
    refuse_doubts(doubts, Namespace(force=True), tmp_path / "rig.png")
    sure = describe_ribs({"left": RibComparison(here=place, other=replace(other, evidence=1.5))})
    assert not sure
    refuse_doubts(sure, Namespace(force=False), tmp_path / "rig.png")
