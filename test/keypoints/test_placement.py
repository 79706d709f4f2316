"""Claims about jaws whose holders hide them, and about a camera whose place nobody has measured."""

import re
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from finforce.camera import EQUIDISTANT, CameraIntrinsics, project, rays_from_pixels
from finforce.errors import RigError
from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce.rig import Rig, RigCamera, RigJaw, RigTag, read_rig, write_rig
from finforce.transforms import move_pose, pose_numbers
from finforce_eval.cli.camera import describe_placement, describe_unsure
from finforce_eval.evaluation.keypoint_source import build_records
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints import placement
from finforce_keypoints.detectors.side_plane import AROUND, AnyFinger, SidePlaneDetector
from finforce_keypoints.errors import DetectorSettingsError, GeometryError
from finforce_keypoints.geometry.depth import DepthScale
from finforce_keypoints.geometry.jaw_localizer import JawLocalizer
from finforce_keypoints.geometry.jaw_pose import COVERED_STDDEV, OriginEstimator
from finforce_keypoints.geometry.side_picture import PlaneGrid, find_side, project_plane
from finforce_keypoints.geometry.template import find_motions, find_shape
from finforce_keypoints.images import PixelDetection, RgbdImage
from finforce_keypoints.networks.side_network import Places, Template
from finforce_keypoints.parameters import DetectorParameters, DetectorSettings, JawMount, find_mounts
from finforce_keypoints.placement import (
    FINGER_STDDEV,
    GUESS_STDDEV,
    OUTLINE_STDDEV,
    CameraPlacement,
    OutlineContrast,
    PlacementTask,
    _Refinement,
    _widen_stddev,
    compare_poses,
    find_covered,
    find_placement,
)
from finforce_keypoints.rib_check import RibComparison, RibPlace
from finforce_sim.sensor import build_d405_vga

CAMERA = build_d405_vga()
NAMES = load_jaw("bench").keypoint_names
LOW = frozenset(
    [*(name for name, z in zip(NAMES, load_jaw("bench").keypoints[:, 2], strict=True) if z < 0.02), "reference"]
)
RIG = Rig(
    jaw="bench",
    camera=RigCamera(
        width=64, height=54, fx=21.0, fy=21.1, cx=32.0, cy=27.0, distortion=(-0.02,) * 4, model=EQUIDISTANT
    ),
    T_gripper_camera=tuple(pose_numbers(ROBOT_CAMERA)),
    half_opening=0.055,
    likelihood_odds=3.0,
    left=RigJaw(
        turn=(0.0, 0.05, 0.0),
        stddev=(0.8e-3, 0.006),
        covered=("reference",),
        tag=RigTag(id=3, corners=((0.0, 0.01, 0.0), (0.01, 0.01, 0.0), (0.01, 0.01, -0.01), (0.0, 0.01, -0.01))),
    ),
)


def points_of(jaw, T, moved=0.0):
    points = np.vstack((jaw.keypoints, jaw.reference_point)) + moved
    return project(points @ T[:3, :3].T + T[:3, 3], CAMERA)


@pytest.mark.parametrize("bent", [0.0, 0.3, -0.3])
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_jaw_whose_base_is_covered_is_where_its_upper_points_say_however_it_bends(side, bent):
    jaw, x, mount = (
        load_jaw("bench", side),
        -0.04 if side == "left" else 0.04,
        JawMount(turn=np.array([0, 0.06, 0.02]), covered=LOW),
    )
    ways = find_motions(jaw)
    moved = np.insert(np.append(bent * ways[0] - bent * ways[1], np.zeros((1, 2)), axis=0), 1, 0.0, axis=1)
    pixels = points_of(jaw, jaw_in_camera(ROBOT_CAMERA, side, x, mount.turn), moved)
    pixels[~mount.seen_points(jaw)] = np.nan
    rays, stddev = rays_from_pixels(pixels, CAMERA), np.full(len(pixels), 0.3 / CAMERA.fx)
    found = OriginEstimator(jaw, ROBOT_CAMERA, DetectorSettings(), mount).measure(rays, stddev)
    assert abs(found.x - x) < min(0.3e-3, 3.0 * found.stddev)
    assert found.shared == found.stddev < 3e-3  # what the bend hides is no better known in the next image
    straight = OriginEstimator(jaw, ROBOT_CAMERA, DetectorSettings()).measure(rays, stddev)
    assert straight is None or abs(straight.x - x) > 0.3e-3 or straight.stddev > found.stddev


def test_points_that_cannot_be_seen_do_not_count_against_a_jaw():
    jaws = {"left": load_jaw("bench")}
    hidden = frozenset([*NAMES[3:12], "reference"])

    class Half:
        height, width, sha256 = 224, 176, ""
        path = type("Path", (), {"name": "half"})

        def prepare(self, template, points, shapes, wanted=None):
            return Template(half=template, points=points, pieces=template[None])

        def locate(self, pictures, templates, starts=()):
            count, seen = len(templates[0].points), np.array([name not in hidden for name in (*NAMES, "reference")])
            likelihood = np.tile(np.where(seen, 0.7, 0.05), (len(pictures), 1))
            pixels = np.tile(np.asarray(templates[0].points, float), (len(pictures), 1, 1))
            return Places(pixels=pixels, likelihood=likelihood, stddev=np.full((len(pictures), count), 0.5))

    image = RgbdImage(stamp=1.0, color=np.zeros((480, 640, 3), np.uint8), depth=None, camera=CAMERA)
    for mounts, is_there in ((None, False), ({"left": JawMount(covered=hidden)}, True)):
        detector = SidePlaneDetector(AnyFinger(Half(), jaws), jaws, ROBOT_CAMERA, mounts=mounts)
        found = detector.detect(image, {"left": None})
        assert ("left" in found) == is_there
    assert not found["left"].likelihood[[name in hidden for name in (*NAMES, "reference")]].any()


class Sighted:
    """A locator that knows by a picture's brightness where it was taken, and how likely a jaw is there."""

    shifts, name, sha256 = np.zeros((1, 2)), "sighted", ""

    def __init__(self, jaws, likely):
        self.grids, self.likely, self.count = dict.fromkeys(jaws, PlaneGrid()), likely, 0
        self.rest = {s: np.vstack((jaw.keypoints, jaw.reference_point))[:, ::2] for s, jaw in jaws.items()}

    def locate(self, pictures, sides, starts=()):
        self.count += len(pictures)
        rest = [self.rest[side] for side in sides]
        levels = zip(sides, pictures[:, 112, 88, 0].astype(float), strict=True)
        likelihood = np.array([np.full(len(rest[0]), self.likely(*each)) for each in levels])
        pixels = np.array([PlaneGrid().pixels(each) for each in rest])
        return Places(pixels=pixels, likelihood=likelihood, stddev=np.full(likelihood.shape, 0.5))


@pytest.fixture(scope="module")
def slope():
    """An image that grows brighter to the right, and the level of a picture of a jaw taken at x."""
    color = np.repeat(np.repeat(np.linspace(0, 255, 640)[None, :, None], 480, 0), 3, 2).astype(np.uint8)
    image, middle = RgbdImage(stamp=1.0, color=color, depth=None, camera=CAMERA), PlaneGrid().places([[88, 112]])

    def level(side, x):
        place = project_plane(middle, find_side(load_jaw("bench", side)), jaw_in_camera(ROBOT_CAMERA, side, x), CAMERA)
        return 255.0 * place[0, 0] / 639.0

    return image, level


def test_jaws_in_holders_that_are_lost_are_looked_for_at_like_openings(slope):
    image, level = slope
    jaws = {side: load_jaw("bench", side) for side in ("left", "right")}

    def likely(side, seen):  # something beside the left jaw looks more like one than the jaw
        if side == "left" and seen < level("left", -0.065):
            return 0.95
        return 0.9 if abs(seen - level(side, -0.035 if side == "left" else 0.035)) < 12.0 else 0.1

    found = {}
    for covered in (frozenset(), LOW):
        mounts = {side: JawMount(covered=covered) for side in jaws}
        detector = SidePlaneDetector(Sighted(jaws, likely), jaws, ROBOT_CAMERA, mounts=mounts)
        found[covered] = detector.detect(image, dict.fromkeys(jaws))["left"].pixels[0]
    rest = points_of(jaws["left"], jaw_in_camera(ROBOT_CAMERA, "left", -0.035))[0]
    assert abs(found[LOW] - rest).max() < 30.0 < abs(found[frozenset()] - rest).max()


@pytest.mark.parametrize(
    ("likelihood", "mate", "is_there"), [(0.7, None, False), (0.9, None, True), (0.5, 0.06, False)]
)
@pytest.mark.parametrize("is_tracked", [False, True])
def test_of_two_jaws_in_holders_one_alone_has_to_be_likelier(slope, likelihood, mate, is_there, is_tracked):
    image, level = slope
    jaws = {side: load_jaw("bench", side) for side in ("left", "right")}

    def likely(side, seen):
        at = {"left": -0.035, "right": mate or 0.035}[side]
        there = abs(seen - level(side, at)) < 12.0 and (side == "left" or mate or is_tracked)
        return likelihood if there else 0.1

    mounts = {side: JawMount(covered=LOW) for side in jaws}
    detector = SidePlaneDetector(Sighted(jaws, likely), jaws, ROBOT_CAMERA, mounts=mounts)
    expected = {"left": None, "right": jaw_in_camera(ROBOT_CAMERA, "right", mate or 0.035) if is_tracked else None}
    found = detector.detect(image, expected)["left"].likelihood.max()
    assert found == pytest.approx(likelihood if is_there or (is_tracked and not mate) else 0.0)


def test_a_jaw_in_a_holder_is_looked_for_as_far_open_as_its_mate(slope):
    image, level = slope
    jaws = {side: load_jaw("bench", side) for side in ("left", "right")}

    def likely(side, seen):  # the right jaw shows little at first
        there = abs(seen - level(side, -0.035 if side == "left" else 0.035)) < 12.0
        return (0.9 if side == "left" or len(locator.counts) > 1 else 0.3) if there else 0.1

    class Counting(Sighted):
        counts = ()

        def locate(self, pictures, sides, starts=()):
            self.counts = (*self.counts, len(pictures))
            return super().locate(pictures, sides, starts)

    locator = Counting(jaws, likely)
    detector = SidePlaneDetector(locator, jaws, ROBOT_CAMERA, mounts={side: JawMount(covered=LOW) for side in jaws})
    found = detector.detect(image, dict.fromkeys(jaws))
    assert found["left"].likelihood.max() == found["right"].likelihood.max() == pytest.approx(0.9)


def test_a_jaw_in_a_holder_that_is_not_where_it_is_expected_is_looked_for_at_once(slope):
    image, level = slope
    jaws, there = {"left": load_jaw("bench")}, jaw_in_camera(ROBOT_CAMERA, "left", -0.035)

    def likely(side, seen):
        return 0.9 if abs(seen - level("left", -0.035)) < 12.0 else 0.1

    counts = []
    for x in (-0.035, -0.07):
        locator = Sighted(jaws, likely)
        detector = SidePlaneDetector(locator, jaws, ROBOT_CAMERA, mounts={"left": JawMount(covered=LOW)})
        found = detector.detect(image, {"left": jaw_in_camera(ROBOT_CAMERA, "left", x)})["left"]
        assert found.likelihood.max() == pytest.approx(0.9)
        assert abs(found.pixels[0] - points_of(jaws["left"], there)[0]).max() < 30.0
        counts.append(locator.count)
    assert counts[0] == 1 < counts[1]  # where it is likely, one picture is enough


@pytest.mark.parametrize("right", [0.8, 0.1])
def test_a_jaw_in_a_holder_is_not_taken_one_rib_along(slope, right):
    jaws, there = {"left": load_jaw("bench")}, jaw_in_camera(ROBOT_CAMERA, "left", -0.035)

    class Ribbed(Sighted):
        """Is a little surer of the place one rib on, 7 mm along, in one of the pictures beside the first."""

        def locate(self, pictures, sides, starts=()):
            places = super().locate(pictures, sides, starts)
            if len(pictures) == len(AROUND):
                places.likelihood[1], places.pixels[1, :, 1] = 0.9, places.pixels[1, :, 1] - 7e-3 / PlaneGrid().scale
            return places

    locator = Ribbed(jaws, lambda side, seen: right if locator.count > 1 else 0.1)
    detector = SidePlaneDetector(locator, jaws, ROBOT_CAMERA, mounts={"left": JawMount(covered=LOW)})
    found = detector.detect(slope[0], {"left": there})["left"]
    assert found.likelihood.max() == pytest.approx(right if right > 0.5 else 0.0)
    np.testing.assert_allclose(found.pixels[0], points_of(jaws["left"], there)[0], atol=30.0)


def test_covered_points_lie_beyond_a_straight_edge():
    places = np.array([[x, z] for z in range(10) for x in (0.0, 3.0)])
    likelihood = np.where(places @ (0.3, 1.0) < 3.4, 0.1, 0.85)
    likelihood[[2, 15]] = 0.6, 0.4  # one is taken for seen below it, and one is seldom seen above
    covered = find_covered(likelihood, places)
    assert (covered == (places @ (0.3, 1.0) < 3.4)).all()
    assert not find_covered(np.full(20, 0.8), places).any()
    likelihood[15] = 0.05
    assert find_covered(likelihood, places)[15]


def paint(poses, jaws, ground=(180, 170, 160)):
    from finforce.optional import import_cv2

    color = np.full((480, 640, 3), ground, np.uint8)
    for side, T in poses.items():
        for ring in find_shape(jaws[side]).rings:
            line = project_plane(ring, find_side(jaws[side]), T, CAMERA)
            import_cv2().fillPoly(color, [np.round(line).astype(np.int32)], (240, 120, 20))
    return color


def test_colours_tell_an_outline_where_it_is_and_nowhere_else():
    jaws = {"left": load_jaw("bench")}
    T, outline = jaw_in_camera(ROBOT_CAMERA, "left", -0.04), OutlineContrast(jaws["left"])
    color = paint({"left": T}, jaws)
    there = outline.contrasts(color, T, CAMERA)
    aside = jaw_in_camera(ROBOT_CAMERA, "left", -0.02)
    assert there[0] == there.max() > 0.8 > 2.0 * outline.contrasts(color, aside, CAMERA)[0]
    assert outline.contrasts(np.full_like(color, 90), T, CAMERA).max() < 0.01
    assert not outline.contrasts(color, jaw_in_camera(ROBOT_CAMERA, "left", -0.6), CAMERA).any()  # out of the picture


@pytest.mark.parametrize("back", [1.0, -1.0])
def test_an_outline_that_a_holder_covers_in_part_shows_beyond_the_edge_of_the_holder(back):
    from finforce.optional import import_cv2

    jaws = {"left": load_jaw("bench")}
    T, outline = jaw_in_camera(ROBOT_CAMERA, "left", -0.04), OutlineContrast(jaws["left"])
    color, held = paint({"left": T}, jaws), np.array([[0.0, 0.0], [0.0, 0.1], [-0.03 * back, 0.1], [-0.03 * back, 0.0]])
    covered = project_plane(held, find_side(jaws["left"]), T, CAMERA)
    import_cv2().fillPoly(color, [np.round(covered).astype(np.int32)], (245, 245, 240))
    contrasts = outline.contrasts(color, T, CAMERA)
    best = int(np.argmax(contrasts))
    assert contrasts[best] > 0.7 and contrasts[best] > contrasts[0] + 0.1
    assert back * outline.edges[best][1][0] > 0.8  # what is open lies on the other side
    np.testing.assert_allclose(outline.contrasts(color, T, CAMERA, best), contrasts[best], rtol=1e-5)


def test_the_odds_of_likelihoods_are_multiplied():
    likelihood = np.array([0.0, 0.1, 0.5, 1.0])
    np.testing.assert_allclose(JawMount(odds=9.0).believe(likelihood), [0.0, 0.5, 0.9, 1.0])
    np.testing.assert_allclose(JawMount().believe(likelihood), likelihood)


@pytest.mark.parametrize("slip", [-3e-3, 2e-3])
def test_a_holder_that_gives_along_the_finger_moves_no_jaw_along_the_closing_axis(slip):
    jaw, mount = load_jaw("bench"), JawMount(covered=LOW)
    T = jaw_in_camera(ROBOT_CAMERA, "left", -0.04)
    pixels = points_of(jaw, T, np.array([0.0, 0.0, slip]))
    pixels[~mount.seen_points(jaw)] = np.nan
    estimator = OriginEstimator(jaw, ROBOT_CAMERA, DetectorSettings(), mount)
    found = estimator.measure(rays_from_pixels(pixels, CAMERA), np.full(len(pixels), 0.3 / CAMERA.fx))
    assert abs(found.x + 0.04) < min(0.4e-3, 3.0 * found.stddev) and abs(found.slip - slip) < 0.3 * abs(slip)
    np.testing.assert_allclose(estimator.place(found)[:3, 3], T[:3, 3] + slip * T[:3, 2], atol=1e-3)


def test_the_place_of_a_jaw_in_a_holder_is_stated_apart_from_its_points():
    jaw = load_jaw("bench", "left")
    image = RgbdImage(stamp=1.0, color=np.zeros((480, 640, 3), np.uint8), depth=None, camera=CAMERA)
    found = []
    for mount in (JawMount(), JawMount(covered=LOW, stddev=(1e-3, 0.02))):
        localizer = JawLocalizer(jaw, ROBOT_CAMERA, DetectorSettings(plane_depth=True), mount)
        found.append(localizer.locate(image, localizer.predict_pixels(CAMERA), DepthScale(error=0.0, stddev=0.015)))
    straight, held = found
    used = held.valid & straight.valid
    assert held.shared[1:] == (1e-3, 0.02, 0.0) and straight.shared[1:3] == (0.0, 0.0)
    assert straight.shared.shift == 0.0 and held.shared.shift == COVERED_STDDEV and used.sum() >= 5
    # what the camera is off the side, and the place along the closing axis, move all points together
    assert (held.stddev[used][:, [0, 2]] < straight.stddev[used][:, [0, 2]]).all()


def test_a_stated_opening_is_kept_and_a_picture_without_jaws_refused(monkeypatch):
    monkeypatch.setattr(placement, "FARTHEST", (None,))
    monkeypatch.setattr(placement, "MOST_ROUNDS", 2)
    monkeypatch.setattr(placement, "POLISH", 2)
    jaws = {side: load_jaw("bench", side) for side in ("left", "right")}

    class Dreamer:
        """Sees every point wherever it is looked for, as networks do, and surer each time."""

        grids, likelihood = dict.fromkeys(jaws, PlaneGrid()), 0.9

        def locate(self, pictures, sides, starts=()):
            points = np.array([jaws[side].keypoints[:, ::2] for side in sides])
            points = np.concatenate((points, [[jaws[side].reference_point[::2]] for side in sides]), axis=1)
            pixels = np.array([PlaneGrid().pixels(each) for each in points])
            self.likelihood += 1e-4
            return Places(
                pixels=pixels,
                likelihood=np.full(pixels.shape[:2], self.likelihood),
                stddev=np.full(pixels.shape[:2], 0.5),
            )

    poses = {side: jaw_in_camera(ROBOT_CAMERA, side, x) for side, x in (("left", -0.045), ("right", 0.045))}
    seen = PlacementTask(images=[paint(poses, jaws)], camera=CAMERA, jaws=jaws, locator=Dreamer())
    found = find_placement(seen, ROBOT_CAMERA)
    assert found.contrast > 0.8 and not any(mount.covered for mount in found.mounts.values())
    told = find_placement(replace(seen, opening=0.0616), ROBOT_CAMERA)
    assert all(told.mounts[side].stddev[1] < found.mounts[side].stddev[1] for side in jaws)
    apart = told.origins["right"][0] - told.origins["left"][0]
    assert apart == pytest.approx(0.0616 + 2 * jaws["left"].inner_face_x, abs=1e-9)
    blank = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    with pytest.raises(GeometryError, match="do not show the finger .* finforce jaw PHOTO"):
        find_placement(replace(seen, images=[blank]), ROBOT_CAMERA)


def look_for(jaws, images):
    """Return the task of finding jaws in images without a network."""
    return PlacementTask(images=images, camera=CAMERA, jaws=jaws, locator=None)


@pytest.mark.parametrize(("off", "told"), [((40.0,), ""), ((5.0,) * (len(NAMES) + 1), "do not show the finger")])
def test_without_a_guess_jaws_are_found_unless_their_points_are_off(off, told, monkeypatch):
    for name, value in (("STARTS", 200), ("PULLED", 6), ("FARTHEST", (None,))):
        monkeypatch.setattr(placement, name, value)
    monkeypatch.setattr(_Refinement, "follow_ribs", lambda self, farthest, rounds: None)
    jaws = {side: load_jaw("bench", side) for side in ("left", "right")}
    poses = {side: jaw_in_camera(ROBOT_CAMERA, side, x) for side, x in (("left", -0.04), ("right", 0.04))}
    sideways = np.resize((1.0, -1.0), len(off)) * off

    def find(images, camera, locator, side, plane, looked):
        there = np.array([points_of(jaws[side], poses[side])] * len(looked))
        expected = np.array([points_of(jaws[side], pose) for pose in looked])
        is_near = np.linalg.norm(expected - there, axis=2).max(axis=1) < 150.0
        there[:, : len(off), 0] += sideways
        return there, np.where(is_near, 0.9, 0.05)[:, None] * np.ones(there.shape[:2])

    monkeypatch.setattr(placement, "find_points", find)
    with pytest.raises(GeometryError, match=told) if told else nullcontext():
        found = find_placement(look_for(jaws, [paint(poses, jaws)]))
        for side, jaw in jaws.items():
            off_place = np.abs(compare_poses(jaw, found.pose(side, 0), poses[side]))
            assert (off_place < (3e-3, 0.03)).all() and (off_place < 3.0 * np.array(found.mounts[side].stddev)).all()


def test_of_places_whose_points_are_alike_the_one_that_ribs_show_comes_first(monkeypatch):
    jaws, starts = {"left": load_jaw("bench")}, [(ROBOT_CAMERA, half) for half in (0.03, 0.04, 0.05)]
    place = RibPlace(evidence=1.0, ribs=0.5, shift=0.0, distance=0.0, warps=np.zeros((0, 2, 3)))

    def describe(fit):
        half = -float(fit._split(fit._x).origins["left"][0])
        if half == 0.03:
            raise GeometryError("nothing to be seen")
        here = replace(place, evidence=20.0 * half)
        return CameraPlacement(
            T_gripper_camera=ROBOT_CAMERA, mounts={}, origins={}, contrast=1.0, residual=1.0, seen={},
            ribs={"left": RibComparison(here=here, other=place)},
        )  # fmt: skip

    monkeypatch.setattr(placement, "search_camera", lambda *given: starts)
    monkeypatch.setattr(placement, "_add_ribs", lambda found, task: found)
    monkeypatch.setattr(_Refinement, "describe", describe)
    monkeypatch.setattr(_Refinement, "pull", lambda fit: 0.0 if fit._x[-1] == -0.03 else -1.0)
    fits = placement._pull_starts(look_for(jaws, [np.zeros((480, 640, 3), np.uint8)] * 2), lambda steps: None)
    assert [fit._x[-2:].tolist() for fit in fits] == [[-0.05] * 2, [-0.04] * 2, [-0.03] * 2]


def test_a_camera_comes_out_as_far_off_as_it_is_unsure(monkeypatch):
    jaws, rng = {side: load_jaw("bench", side) for side in ("left", "right")}, np.random.default_rng(3)
    origins, image = {"left": (-0.045, -0.03), "right": (0.045, 0.03)}, np.zeros((480, 640, 3), np.uint8)
    noise = placement.PIXEL * np.sqrt((len(NAMES) + 1) / placement.ALIKE)

    def find(images, camera, locator, side, plane, poses):
        there = [points_of(jaws[side], jaw_in_camera(ROBOT_CAMERA, side, x)) for x in origins[side]]
        return np.array(there) + rng.normal(scale=noise, size=np.shape(there)), np.ones((2, len(NAMES) + 1))

    monkeypatch.setattr(placement, "find_points", find)
    sigmas = []
    for _ in range(12):
        guess = move_pose(ROBOT_CAMERA, rng.normal(size=6) * GUESS_STDDEV)
        fit = _Refinement(look_for(jaws, [image, image]), guess, 0.045, GUESS_STDDEV)
        fit.improve()
        stddev = fit._find_stddev()
        for side, jaw in jaws.items():
            there = jaw_in_camera(ROBOT_CAMERA, side, origins[side][0])
            sigmas.append(compare_poses(jaw, fit._pose(side, fit._x), there) / stddev[side])
    assert np.abs(sigmas).max() < 4.0 and (np.abs(np.sqrt(np.mean(np.square(sigmas), axis=0)) - 1.0) < 0.5).all()


def test_a_guess_is_kept_as_closely_as_it_is_known(monkeypatch):
    monkeypatch.setattr(placement, "POLISH", 3)
    jaws = {"left": load_jaw("bench")}
    color = paint({"left": jaw_in_camera(ROBOT_CAMERA, "left", -0.045)}, jaws)
    beside = move_pose(ROBOT_CAMERA, np.array([0.0, 8e-3, 0.0, 0.0, 0.0, 0.0]))
    moved = []
    for stddev in (0.1e-3, 10e-3):
        known = np.repeat((stddev, 0.01 * stddev / 1e-3), 3)
        fit = _Refinement(look_for(jaws, [color]), beside, 0.045, known)
        fit.polish()
        moved.append(np.linalg.norm(fit._x[:3]))
    assert moved[0] < 0.3e-3 < moved[1]


def test_a_jaw_is_looked_for_aside_in_each_picture(monkeypatch):
    jaws, image = {"left": load_jaw("bench")}, np.zeros((480, 640, 3), np.uint8)
    there = np.array([-0.045, -0.030])

    def find(images, camera, locator, side, plane, poses):
        x = np.array([(ROBOT_CAMERA @ T)[0, 3] for T in poses])
        return np.full((2, 3, 2), 100.0), np.where(np.abs(x - there)[:, None] < 3e-3, 0.9, 0.1) * np.ones(3)

    monkeypatch.setattr(placement, "find_points", find)
    fit = _Refinement(look_for(jaws, [image, image]), ROBOT_CAMERA, 0.045, OUTLINE_STDDEV)
    fit.look_aside()
    origins = fit._split(fit._x)[2]["left"]
    assert origins[0] == -0.045 and abs(origins[1] - there[1]) < 3e-3


def test_a_rig_whose_size_or_place_is_unsure_is_doubted():
    mounts = {"left": JawMount(stddev=(1e-3, 0.02)), "right": JawMount(stddev=(1e-3, 0.08))}
    unsure = CameraPlacement(
        T_gripper_camera=ROBOT_CAMERA, mounts=mounts, origins={}, contrast=1.0, residual=1.0, seen={}
    )
    turned = {"left": JawMount(turn=np.array([0.0, 0.19, 0.0])), "right": JawMount(turn=np.array([0.0, 0.1, 0.0]))}
    assert describe_unsure(replace(unsure, mounts=turned)) == ["the left jaw comes out turned by 11 degrees"]
    assert describe_unsure(unsure) == [
        "the right jaw's place is only known to 1 mm and 8 % in size (one standard deviation)"
    ]


def test_a_place_that_is_nearly_as_likely_makes_a_rig_unsure():
    jaw, away = load_jaw("bench"), np.eye(4)
    away[2, 3] = 7e-3
    T = jaw_in_camera(ROBOT_CAMERA, "left", -0.04)
    assert compare_poses(jaw, T, T @ away)[0] == pytest.approx(7e-3)
    nothing = RibPlace(evidence=0.0, ribs=0.5, shift=0.0, distance=0.0, warps=np.zeros((0, 2, 3)))
    stddev = []
    for margin in (2.0, 0.2, 0.0, -2.0):
        ribs = RibComparison(here=nothing, other=replace(nothing, evidence=-margin, shift=7e-3))
        there = CameraPlacement(
            T_gripper_camera=ROBOT_CAMERA, mounts={"left": JawMount(stddev=(0.5e-3, 0.01))}, contrast=1.0, residual=1.0,
            origins={"left": np.array([-0.04])}, seen={}, ribs={"left": ribs},
        )  # fmt: skip
        stddev.append(_widen_stddev(there, [there], "left", jaw)[0])
    alone = np.hypot(0.5e-3, FINGER_STDDEV[0])
    assert stddev[0] == pytest.approx(alone, rel=0.01) and stddev == sorted(stddev)
    assert stddev[2:] == pytest.approx([np.hypot(alone, 7e-3 / np.sqrt(2)), np.hypot(alone, 7e-3)], rel=0.01)


def test_of_places_with_like_ribs_one_that_needs_no_askew_mount_is_likelier():
    place = RibPlace(evidence=1.0, ribs=0.5, shift=0.0, distance=0.0, warps=np.zeros((0, 2, 3)))
    straight = CameraPlacement(
        T_gripper_camera=ROBOT_CAMERA, mounts={"left": JawMount()}, contrast=1.0, residual=1.0,
        origins={"left": np.array([-0.04])}, seen={}, ribs={"left": RibComparison(here=place, other=place)},
    )  # fmt: skip
    askew = replace(straight, strain=25.0, ribs={"left": RibComparison(here=replace(place, evidence=2.0), other=place)})
    assert straight.evidence > askew.evidence


def test_a_rig_file_says_what_was_written(tmp_path):
    write_rig(RIG, tmp_path / "rig.yaml")
    again = read_rig(tmp_path / "rig.yaml")
    assert again == RIG and again.intrinsics.model == EQUIDISTANT
    records = build_records(again.detector_parameters())
    mount = find_mounts(records.parameters, {"left": load_jaw("bench")})["left"]
    assert mount.odds == 3.0 and 0.06 < records.settings.opening_max < 0.07
    np.testing.assert_allclose(mount.turn, [0.0, 0.05, 0.0])
    assert mount.stddev == (0.8e-3, 0.006)
    assert mount.covered == {"reference"} and not mount.seen_points(load_jaw("bench"))[-1]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("qx", "qx", ""),
        ("fx: 21.0", "fx: -1", "fx"),
        ("jaw: bench", "jam: bench", "did you mean 'jaw'"),
        ("turn:", "turns:", "turn"),
    ],
)
def test_what_is_no_rig_is_refused_by_name(tmp_path, old, new, told):
    write_rig(RIG, tmp_path / "rig.yaml")
    text = (tmp_path / "rig.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(text.replace(old, new))
    if told:
        with pytest.raises(RigError, match=told):
            read_rig(tmp_path / "rig.yaml")
    else:
        assert read_rig(tmp_path / "rig.yaml") == RIG


@pytest.mark.parametrize(
    "wrong",
    [
        {"covered": ("left/rib_99",)},
        {"left_turn": (0.0, 1.0, 0.0)},
        {"right_turn": (0.0, float("nan"), 0.0)},
        {"left_stddev": (-1e-3, 0.0)},
    ],
)
def test_a_mount_that_cannot_be_is_refused(wrong):
    jaws = {side: load_jaw("bench", side) for side in ("left", "right")}
    with pytest.raises(DetectorSettingsError, match=next(iter(wrong))):
        find_mounts(DetectorParameters(**wrong), jaws)


def test_a_turned_jaw_is_turned_in_its_own_frame():
    turn = [0.0, 0.1, 0.0]
    for side in ("left", "right"):
        straight, turned = (jaw_in_camera(ROBOT_CAMERA, side, 0.03, each) for each in (None, turn))
        # both lean the tip the same way along their own closing direction
        assert (straight[:3, :3].T @ turned[:3, 2])[0] == pytest.approx(np.sin(0.1))
        np.testing.assert_allclose(straight[:3, 3], turned[:3, 3])


def test_intrinsics_of_the_middle_of_an_image_show_the_same_rays():
    from finforce.camera_file import cut_camera

    camera = CameraIntrinsics(
        width=2704,
        height=2028,
        fx=796.9,
        fy=799.2,
        cx=1354.4,
        cy=1011.5,
        distortion=np.array([-0.02, -0.01, 0.0, 0.0]),
        model=EQUIDISTANT,
    )
    cut, points = cut_camera(camera, (540, 640)), np.array([[0.1, -0.2, 0.3], [0.0, 0.0, 1.0], [-0.2, 0.3, 0.4]])
    scale = 540 / 2028
    begin = np.array([(2704 - 640 / scale) / 2, 0.0])  # of the part that is left, in pixels' edges
    np.testing.assert_allclose(project(points, cut), (project(points, camera) + 0.5 - begin) * scale - 0.5, atol=1e-9)


@pytest.mark.parametrize(("slip", "told"), [(2e-3, ""), (-9e-3, "-9 mm along its z.*zoomed")])
def test_a_zoomed_picture_of_jaws_in_holders_is_named(slip, told):
    jaw, mount = load_jaw("bench"), JawMount(covered=LOW)
    localizer = JawLocalizer(jaw, ROBOT_CAMERA, DetectorSettings(plane_depth=True), mount)
    pixels = points_of(jaw, jaw_in_camera(ROBOT_CAMERA, "left", -0.04), np.array([0.0, 0.0, slip]))
    count = len(pixels)
    detection = PixelDetection(pixels=pixels, likelihood=np.full(count, 0.9), stddev=np.full(count, 0.3))
    image = RgbdImage(stamp=1.0, color=np.full((480, 640, 3), 99, np.uint8), depth=None, camera=CAMERA)
    found = localizer.locate(image, detection, DepthScale(error=0.0, stddev=0.01))
    assert (found is None) == bool(told)
    assert re.search(told, localizer.warning) if told else not localizer.warning


@pytest.mark.parametrize(("places", "told"), [([-0.04], True), ([-0.04, -0.03], False)])
def test_a_rig_from_one_picture_is_named(places, told):
    found = CameraPlacement(
        T_gripper_camera=ROBOT_CAMERA,
        mounts={"left": JawMount()},
        origins={"left": np.array(places)},
        contrast=0.9,
        residual=0.5,
        seen={},
    )
    assert ("one picture hardly tells" in describe_placement(found, {"left": load_jaw("bench")})) == told


@pytest.mark.parametrize(("degrees", "told"), [(6.7, True), (-6.7, True), (3.2, False)])
def test_a_jaw_that_is_mounted_far_askew_is_named(degrees, told):
    found = CameraPlacement(
        T_gripper_camera=ROBOT_CAMERA,
        mounts={"left": JawMount(turn=np.radians([0.0, 1.0, degrees]))},
        origins={"left": np.array([-0.04, -0.03])},
        contrast=0.9,
        residual=0.5,
        seen={},
    )
    text = describe_placement(found, {"left": load_jaw("bench")})
    assert ("WARNING: left jaw turned by more than 5.7 degrees" in text) == told
