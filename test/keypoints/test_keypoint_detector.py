from dataclasses import replace

import numpy as np
import pytest
from keypoint_scene_fakes import CAMERA, Bend, FakePixelDetector, bare_image, build, lost_sides, scene_of

from finforce.camera import ImageError, compute_rays
from finforce.gripper_frames import jaw_in_camera
from finforce_keypoints.detector import KeypointDetector, check_reference
from finforce_keypoints.errors import DetectionError, EmptyDepthError, GeometryError, ImageOrderError
from finforce_keypoints.images import PixelDetection

RATE = 30.0
PUSHED = Bend(push=0.012, lean=0.0015)


def run(view, bend=None, scale=0.0, count=5):
    """Errors (n, 3) [m] and stated standard deviations of the accepted points, and how many of all were accepted."""
    rng = np.random.default_rng(3)
    scene, depth, _, detector = build(view, bend, rng)
    errors, stated, accepted = [], [], []
    for n in range(count):
        found = detector.detect(scene.image(n / RATE, rng, scale=scale, depth=depth))
        for side, keypoints in found.items():
            wrong = keypoints.points - scene.keypoints(side)[:-1]
            errors.append(wrong[keypoints.valid])
            stated.append(keypoints.stddev[keypoints.valid])
            accepted.append(keypoints.valid.mean())
    return np.vstack(errors), np.vstack(stated), np.mean(accepted)


@pytest.mark.parametrize("view", ["robot", "bench"])
@pytest.mark.parametrize("bend", [None, PUSHED], ids=["rest", "pushed"])
@pytest.mark.parametrize("scale", [0.015, -0.02])
def test_points_are_found_to_a_fraction_of_a_millimetre_whatever_the_depth_scale(view, bend, scale):
    errors, stated, accepted = run(view, bend, scale)
    distance = np.linalg.norm(errors, axis=1)
    assert np.median(distance) < 0.3e-3 and np.percentile(distance, 95) < 0.8e-3  # 0.4 px are 0.15 mm
    assert accepted > 0.97
    assert 0.6 < np.sqrt(((errors / stated) ** 2).mean()) < 1.4


def test_the_jaws_are_where_they_are_and_their_names_are_sides():
    scene, depth, _, detector = build()
    found = detector.detect(scene.image(0.0, np.random.default_rng(0), depth=depth))
    assert set(found) == {"left", "right"} and lost_sides(detector) == ()
    for side, T in scene.poses().items():
        np.testing.assert_allclose(found[side].T_camera_jaw, T, atol=1e-6)
        assert found[side].stamp == 0.0 and found[side].likelihood[found[side].valid].min() == 0.95


def cover(scene, depth, side, rows, shift):
    """The depth with boards parallel to the jaw's side, before (shift < 0) or behind places where key points are."""
    T, height = scene.poses()[side], scene.jaws[side].keypoints[0, 1]
    plane = (height + T[:3, 1] @ T[:3, 3]) / (compute_rays(CAMERA) @ T[:3, 1])
    covered = depth.copy()
    for column, row in np.rint(scene.pixels()[side][rows]).astype(int):
        window = np.s_[row - 9 : row + 10, column - 9 : column + 10]
        covered[window] = plane[window] + shift
    return covered


@pytest.mark.parametrize("shift", [-0.004, -0.012, 0.02])
@pytest.mark.parametrize("plane_depth", [False, True])
def test_hidden_points_whose_pixels_lie_on_something_else_are_refused(shift, plane_depth):
    rng = np.random.default_rng(0)
    scene, depth, _, detector = build(rng=rng, plane_depth=plane_depth)
    hidden = [3, 4, 5]
    covered = cover(scene, depth, "left", hidden, shift)
    for n in range(3):
        found = detector.detect(scene.image(n / RATE, rng, depth=covered))["left"]
        assert not found.valid[hidden].any() and set(found.reasons[hidden]) == {"depth"}
        assert (found.likelihood[hidden] == 0.0).all()
        assert np.delete(found.valid, hidden).sum() >= 10
        wrong = (found.points - scene.keypoints("left")[:-1])[found.valid]
        assert np.linalg.norm(wrong, axis=1).max() < 1e-3
    assert detector.counts["left/depth"] >= 9 and detector.counts["images"] == detector.counts["left"] == 3


def test_a_point_that_the_plane_of_the_others_does_not_explain_is_refused():
    rng = np.random.default_rng(0)
    scene, depth, _, detector = build(rng=rng)
    covered = cover(scene, depth, "left", [4], -0.0018)  # nearer than the gate, ten standard deviations off
    for n in range(3):
        found = detector.detect(scene.image(n / RATE, rng, depth=covered))["left"]
        assert found.reasons[4] == "depth" and found.valid.sum() >= 13


def test_unlikely_points_are_refused_and_keep_their_coordinates():
    scene, depth, pixel_detector, detector = build()
    pixel_detector.likelihood["left"][2] = 0.5
    found = detector.detect(scene.image(0.0, np.random.default_rng(0), depth=depth))["left"]
    assert not found.valid[2] and found.reasons[2] == "likelihood" and found.likelihood[2] == 0.0
    np.testing.assert_allclose(found.points[2], scene.keypoints("left")[2], atol=0.3e-3)
    assert found.valid.sum() == 14


def test_unlikely_points_say_nothing_about_the_plane_of_the_others():
    rng = np.random.default_rng(0)
    scene, depth, pixel_detector, detector = build()
    pixel_detector.likelihood["left"][:10] = 0.3
    covered = cover(scene, depth, "left", list(range(10)), -0.0015)
    found = detector.detect(scene.image(0.0, rng, depth=covered))["left"]
    assert found.valid[10:].sum() >= 4
    wrong = (found.points - scene.keypoints("left")[:-1])[found.valid]
    assert np.abs(wrong[:, 1]).max() < 0.25e-3


def test_an_unsure_reference_point_makes_all_points_unsure_along_x():
    stated, shared = [], []
    for stddev in (0.4, 2.0):
        _, depth, pixel_detector, detector = build()
        pixel_detector.stddev = np.append(np.full(15, 0.4), stddev)
        found = detector.detect(bare_image(0.0, depth.astype(np.float32)))["left"]
        stated.append(found.stddev)
        shared.append(found.shared.closing)
    # five times the share of the reference point
    assert (np.hypot(stated[1][:, 0], shared[1]) > 2.0 * np.hypot(stated[0][:, 0], shared[0])).all()
    assert shared[1] == pytest.approx(5.0 * shared[0], rel=0.01)
    np.testing.assert_allclose(stated[1][:, 1:], stated[0][:, 1:], rtol=0.05)


def test_points_without_pixels_or_outside_the_picture_are_refused():
    scene, depth, pixel_detector, detector = build()
    pixel_detector.pixels["left"][1] = np.nan
    pixel_detector.pixels["left"][2] = 1e5
    found = detector.detect(scene.image(0.0, np.random.default_rng(0), depth=depth))["left"]
    assert set(found.reasons[[1, 2]]) == {"image"} and np.isnan(found.points[[1, 2]]).all()
    assert found.valid.sum() == 13


def test_points_outside_the_workspace_are_refused():
    scene, depth, pixel_detector, detector = build(workspace_length=2e-3)
    pixel_detector.pixels["left"][[0, 1]] = pixel_detector.pixels["left"][[1, 0]]  # swapped: on the finger, 9.5 mm off
    found = detector.detect(scene.image(0.0, np.random.default_rng(0), depth=depth))["left"]
    assert list(found.reasons[:2]) == ["workspace"] * 2 and found.valid.sum() == 13


def test_without_a_depth_image_points_are_refused_unless_the_known_plane_is_allowed():
    for allowed in (False, True):
        scene, _, _, detector = build(plane_depth=allowed)
        found = detector.detect(bare_image(0.0, None))["left"]
        assert found.valid.all() == allowed and found.valid.any() == allowed
        assert set(found.reasons) == ({""} if allowed else {"depth"})
    np.testing.assert_allclose(found.points, scene.keypoints("left")[:-1], atol=1e-5)
    with_depth = run("robot", count=1)[1]
    assert found.stddev[14, 1] > 5.0 * np.median(with_depth[:, 1])


def test_a_hole_in_the_depth_is_bridged_by_the_shared_plane_only_if_that_is_allowed():
    for allowed in (False, True):
        rng = np.random.default_rng(0)
        scene, depth, _, detector = build(bend=PUSHED, plane_depth=allowed)
        holed = cover(scene, depth, "left", [3], np.nan)
        found = detector.detect(scene.image(0.0, rng, depth=holed))["left"]
        assert found.valid[3] == allowed
    assert np.linalg.norm(found.points[3] - scene.keypoints("left")[3]) < 0.3e-3


def test_a_depth_image_without_any_depth_is_an_error_and_one_with_a_little_is_not():
    _, _, _, detector = build()
    depth = np.full((480, 640), np.nan, np.float32)
    with pytest.raises(EmptyDepthError, match="the depth image is empty"):
        detector.detect(bare_image(0.0, depth))
    depth[0, 0] = 0.3
    found = detector.detect(bare_image(0.0, depth))
    assert set(found) == {"left", "right"} and not any(keypoints.valid.any() for keypoints in found.values())


def test_a_closing_jaw_is_expected_where_it_will_be():
    scene, depth, pixel_detector, detector = build()
    for n in range(12):
        x = 0.05 - 0.03 * n / RATE
        pixel_detector.pixels = scene.pixels({"left": -x, "right": x})
        found = detector.detect(bare_image(n / RATE, depth.astype(np.float32)))
    assert pixel_detector.expected[0] == {"left": None, "right": None}
    truth = jaw_in_camera(scene.T_gripper_camera, "left", -x)
    np.testing.assert_allclose(found["left"].T_camera_jaw, truth, atol=2e-5)
    np.testing.assert_allclose(pixel_detector.expected[-1]["left"], truth, atol=0.1e-3)  # a frame at 30 mm/s is 1 mm


@pytest.mark.parametrize("readout", [0.0, 0.020])
def test_rows_that_were_exposed_one_after_the_other_do_not_bend_a_closing_jaw(readout):
    speed, rolled = 0.06, 0.020
    scene, _, pixel_detector, detector = build(plane_depth=True, readout=readout)
    late = {side: rolled * (rows[:, 1] / CAMERA.height - 1.0) for side, rows in scene.pixels().items()}
    for n in range(12):
        for side, delays in late.items():
            x = [0.05 - speed * (n / RATE + delay) for delay in delays]
            places = [scene.pixels({"left": -at, "right": at})[side][row] for row, at in enumerate(x)]
            pixel_detector.pixels[side] = np.array(places)
        found = detector.detect(bare_image(n / RATE, None))
    off = {side: np.abs(found[side].points - scene.keypoints(side)[:-1])[:, 0].max() for side in found}
    x = 0.05 - speed * n / RATE
    truth = {side: jaw_in_camera(scene.T_gripper_camera, side, -x if side == "left" else x) for side in found}
    away = max(np.abs(found[side].T_camera_jaw - truth[side]).max() for side in found)
    if readout:
        assert max(off.values()) < 0.03e-3 and away < 0.05e-3
    else:  # a tip is a third of the picture below the reference point: 60 mm/s for some 8 ms
        assert min(off.values()) > 0.3e-3 and away > 0.5e-3


@pytest.mark.parametrize(("cut", "is_said"), [(0.0, False), (30.0, True), (-30.0, True)])
def test_a_picture_that_was_cut_and_its_intrinsics_not_is_noticed_by_the_jaws_middle(cut, is_said):
    scene, _, pixel_detector, detector = build(plane_depth=True)
    pixel_detector.pixels = {side: rows + (cut, 0.0) for side, rows in pixel_detector.pixels.items()}
    found = detector.detect(bare_image(0.0, None))
    assert set(found) == {"left", "right"}
    said = detector.warnings
    assert set(said) == (set(found) if is_said else set())
    assert all("mm off the gripper's" in text for text in said.values())


@pytest.mark.parametrize("cut", [80.0, -80.0])
def test_a_picture_that_was_cut_by_an_eighth_tells_of_no_jaw(cut):
    scene, _, pixel_detector, detector = build(plane_depth=True)
    pixel_detector.pixels = {side: rows + (cut, 0.0) for side, rows in pixel_detector.pixels.items()}
    for number in range(5):
        assert not detector.detect(bare_image(number / RATE, None))
    assert detector.counts["off centre"] == 5
    assert all("mm off the gripper's" in text for text in detector.warnings.values())
    pixel_detector.pixels = scene.pixels()
    found = [set(detector.detect(bare_image((5 + number) / RATE, None))) for number in range(30)]
    assert found[-1] == {"left", "right"}


@pytest.mark.parametrize(("hidden", "is_said"), [(0, False), (6, False), (11, True)])
def test_a_finger_of_which_hardly_a_point_is_seen_is_said_within_two_seconds(hidden, is_said):
    _, _, pixel_detector, detector = build(plane_depth=True)
    pixel_detector.likelihood["left"][2 : 2 + hidden] = 0.1
    for n in range(60):
        detector.detect(bare_image(n / RATE, None))
        if n < 30:  # a hand before the camera for a moment is nothing to say
            assert not detector.warnings
    assert set(detector.warnings) == ({"left"} if is_said else set())
    assert not is_said or "are the extrinsics right, is it the finger of the jaw file" in detector.warnings["left"]


def test_a_lost_jaw_is_absent_looked_for_everywhere_and_found_again():
    scene, depth, pixel_detector, detector = build()
    image = bare_image(0.0, depth.astype(np.float32))
    detector.detect(image)
    seen = pixel_detector.pixels.pop("left")
    for n in range(1, 8):
        found = detector.detect(replace(image, stamp=n / RATE))
        assert set(found) == {"right"}
    assert lost_sides(detector) == ("left",) and pixel_detector.expected[-1]["left"] is None
    assert pixel_detector.expected[2]["left"] is not None
    pixel_detector.pixels = {"left": seen, **pixel_detector.pixels}
    pixel_detector.likelihood["left"] = np.full(16, 0.95)
    assert "left" in detector.detect(replace(image, stamp=1.0))


def test_a_jaw_that_stays_away_is_looked_for_at_intervals_and_found_again():
    scene, depth, pixel_detector, detector = build()
    image, seen = bare_image(0.0, depth.astype(np.float32)), pixel_detector.pixels.pop("left")
    for n in range(90):
        assert set(detector.detect(replace(image, stamp=n / RATE))) == {"right"}
    searches = [n for n, expected in enumerate(pixel_detector.expected) if "left" in expected]
    assert searches[:30] == list(range(30)) and 4 <= len(searches[30:]) <= 8
    assert all("right" in expected for expected in pixel_detector.expected)
    pixel_detector.pixels = {"left": seen, **pixel_detector.pixels}
    pixel_detector.likelihood["left"] = np.full(16, 0.95)
    found = [n for n in range(90, 110) if "left" in detector.detect(replace(image, stamp=n / RATE))]
    assert len(found) > 10 and found == list(range(found[0], 110))  # as soon as it is looked for, and from then on


def test_a_jaw_that_no_depth_confirms_is_lost_and_found_again_by_one_that_does():
    scene, depth, pixel_detector, detector = build(lost_images=4)
    whole = bare_image(0.0, depth.astype(np.float32))
    flat = replace(whole, depth=np.full_like(whole.depth, 0.35))  # a picture of jaws on a wall
    assert set(detector.detect(whole)) == {"left", "right"}
    for n in range(1, 12):
        found = detector.detect(replace(flat, stamp=n / RATE))
        assert set(found) == ({"left", "right"} if n < 4 else set())
        assert not any(keypoints.valid.any() for keypoints in found.values())
    assert set(lost_sides(detector)) == {"left", "right"} and pixel_detector.expected[-1] == {
        "left": None,
        "right": None,
    }
    found = detector.detect(replace(whole, stamp=0.5))
    assert set(found) == {"left", "right"} and found["left"].valid.all() and not lost_sides(detector)
    assert set(detector.detect(replace(flat, stamp=0.53))) == {"left", "right"}  # counted anew


def test_depth_of_another_unit_is_warned_of():
    scene, depth, pixel_detector, detector = build()
    image = bare_image(0.0, depth.astype(np.float32))
    for n in range(10):
        detector.detect(replace(image, stamp=n / RATE))
    assert not detector.warnings and detector.depth_ratio == pytest.approx(1.0, abs=0.02)
    detector.reset()
    for n in range(10):
        detector.detect(replace(image, stamp=n / RATE, depth=1e3 * image.depth))
    assert "times that of its place" in detector.warnings["left"] and 900.0 < detector.depth_ratio < 1100.0
    assert "nearer than the camera can measure" in detector.warnings["left"]


def test_a_jaw_whose_reference_point_is_hidden_for_a_moment_goes_on():
    scene, depth, pixel_detector, detector = build()
    image = bare_image(0.0, depth.astype(np.float32))
    for n in range(15):
        pixel_detector.likelihood["left"][15] = 0.0 if n in (10, 11) else 0.95
        found = detector.detect(replace(image, stamp=n / RATE))["left"]
        assert found.valid.sum() >= 14
        np.testing.assert_allclose(found.T_camera_jaw, scene.poses()["left"], atol=0.1e-3)


def test_reset_starts_anew():
    scene, depth, pixel_detector, detector = build()
    image = bare_image(5.0, depth.astype(np.float32))
    first = detector.detect(image)
    with pytest.raises(ImageOrderError, match="reset"):
        detector.detect(image)
    detector.reset()
    assert lost_sides(detector) == ("left", "right") and not detector.counts
    again = detector.detect(image)
    assert pixel_detector.expected[-1]["left"] is None
    np.testing.assert_array_equal(again["left"].points, first["left"].points)


def test_the_depth_scale_is_learnt():
    rng = np.random.default_rng(0)
    scene, depth, _, detector = build(rng=rng)
    for n in range(4):
        detector.detect(scene.image(n / RATE, rng, scale=0.02, depth=depth))
    assert detector.depth_scale.error == pytest.approx(0.02, abs=1.5e-3)
    assert detector.depth_scale.stddev < 2e-3


def test_wrong_images_and_findings_are_refused():
    scene, depth, pixel_detector, detector = build()
    image = bare_image(0.0, depth.astype(np.float32))
    with pytest.raises(ImageError, match="depth image"):
        detector.detect(replace(image, depth=image.depth[:-1]))
    pixel_detector.pixels["left"] = pixel_detector.pixels["left"][:-1]
    pixel_detector.likelihood["left"] = pixel_detector.likelihood["left"][:-1]
    with pytest.raises(DetectionError, match="left jaw.*16 rows"):
        detector.detect(image)


def test_jaws_on_the_wrong_side_are_refused():
    scene, _, pixel_detector, _ = build()
    for jaws in ({}, {"left": scene.jaws["right"]}):
        with pytest.raises(GeometryError, match="left, right or both"):
            KeypointDetector(pixel_detector, jaws, scene.T_gripper_camera)


def test_random_findings_never_give_a_valid_point_that_is_no_number():
    rng = np.random.default_rng(0)
    scene, depth, pixel_detector, detector = build()
    image = bare_image(0.0, depth.astype(np.float32))

    class Wild:
        def detect(self, image, expected):
            pixels = rng.uniform(-200, 900, (16, 2))
            pixels[rng.random(16) < 0.1] = np.nan
            stddev = rng.choice([0.0, 0.5, 30.0, np.inf], 16)
            return {"left": PixelDetection(pixels=pixels, likelihood=rng.random(16), stddev=stddev)}

    wild = KeypointDetector(Wild(), {"left": scene.jaws["left"]}, scene.T_gripper_camera)
    for n in range(150):
        for keypoints in wild.detect(replace(image, stamp=n / RATE)).values():
            valid = keypoints.valid
            assert np.isfinite(keypoints.points[valid]).all() and np.isfinite(keypoints.stddev[valid]).all()
            assert (np.abs(keypoints.points[valid]) < 0.15).all() and valid.sum() <= 5


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_reference_point_off_the_side_of_the_key_points_is_refused_with_its_place(side):
    scene, _ = scene_of("robot")
    jaw = scene.jaws[side]
    inside = replace(jaw, reference_point=np.zeros(3))
    with pytest.raises(GeometryError, match=r"reference point \[0, 0, 0\] m.*y = 0.01 m.*set reference_point"):
        KeypointDetector(FakePixelDetector(scene.pixels()), {side: inside}, scene.T_gripper_camera)
    for share, error in ((0.81, False), (0.79, True)):  # 1.9 and 2.1 mm off
        moved = replace(jaw, reference_point=jaw.reference_point * (1.0, share, 1.0))
        if error:
            with pytest.raises(GeometryError):
                check_reference(moved)
        else:
            check_reference(moved)
