"""Claims about tags on the holders of jaws."""

from argparse import Namespace
from dataclasses import replace

import cv2
import numpy as np
import pytest

from finforce.camera import project, rays_from_pixels
from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce_eval.cli.camera import add_tags, describe_mount, find_tags
from finforce_eval.errors import OptionError
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.errors import DetectorSettingsError, GeometryError
from finforce_keypoints.geometry.jaw_localizer import TAGGED_STDDEV
from finforce_keypoints.geometry.jaw_pose import COVERED_STDDEV, OriginEstimator
from finforce_keypoints.geometry.template import find_motions
from finforce_keypoints.images import PixelDetection, RgbdImage
from finforce_keypoints.parameters import DetectorParameters, DetectorSettings, JawMount, find_mounts
from finforce_keypoints.placement import CameraPlacement
from finforce_keypoints.tags import Tag, TagFinder, find_tag, place_corners
from finforce_sim.sensor import build_d405_vga

CAMERA, SIZE, FAMILY = build_d405_vga(), 0.016, "4x4_50"
NAMES = load_jaw("bench").keypoint_names
LOW = frozenset(
    [*(name for name, z in zip(NAMES, load_jaw("bench").keypoints[:, 2], strict=True) if z < 0.02), "reference"]
)
X, PLACES = {"left": -0.04, "right": 0.04}, {"left": 0, "right": 1}


def tag_of(side):
    """A tag that faces the camera on the holder of a jaw."""
    square = 0.5 * SIZE * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    corners = np.column_stack((square[:, 0] + 0.01, np.full(4, -0.008), square[:, 1] - 0.004))
    return Tag(
        id=PLACES[side], corners=corners * [1.0 if side == "right" else -1.0, 1.0 if side == "right" else -1.0, 1.0]
    )


def see(points, T, camera=CAMERA):
    return project(points @ T[:3, :3].T + T[:3, 3], camera)


def pose(side, x=None, slip=0.0):
    T = jaw_in_camera(ROBOT_CAMERA, side, X[side] if x is None else x)
    T[:3, 3] += slip * T[:3, 2]
    return T


def picture(*corners):
    """An image with tags 0, 1, ... at corners (4, 2) [px]; the black square is six of eight cells wide."""
    color = np.full((CAMERA.height, CAMERA.width), 120, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, there in enumerate(corners):
        marker = np.full((80, 80), 255, np.uint8)
        marker[10:70, 10:70] = cv2.aruco.generateImageMarker(dictionary, number, 60)
        square = np.array([[9.5, 9.5], [69.5, 9.5], [69.5, 69.5], [9.5, 69.5]], np.float32)
        H = cv2.getPerspectiveTransform(square, np.asarray(there, np.float32))
        size = (CAMERA.width, CAMERA.height)
        paper = cv2.warpPerspective(np.full_like(marker, 255), H, size) > 127
        color[paper] = cv2.warpPerspective(marker, H, size, flags=cv2.INTER_AREA)[paper]
    return np.repeat(cv2.GaussianBlur(color, (0, 0), 0.7)[..., None], 3, 2)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_tag_tells_how_far_a_holder_has_given_under_a_bent_jaw(side):
    jaw, tag, rng = load_jaw("bench", side), tag_of(side), np.random.default_rng(0)
    ways = find_motions(jaw)
    points = np.vstack((jaw.keypoints, jaw.reference_point))
    points[:-1, ::2] += 0.3 * (ways[0] - ways[1])
    T = pose(side, X[side] + 0.002, slip=0.0015)
    pixels, corners = see(points, T), see(tag.corners, T)
    pixels = pixels + 0.5 * rng.standard_normal(pixels.shape)
    covered = JawMount(covered=LOW, tag=tag)
    pixels[~covered.seen_points(jaw)] = np.nan
    rays, stddev = rays_from_pixels(pixels, CAMERA), np.full(len(pixels), 0.5 / CAMERA.fx)
    tagged = OriginEstimator(jaw, ROBOT_CAMERA, DetectorSettings(), covered)
    found = tagged.measure(rays, stddev, rays_from_pixels(corners, CAMERA), 0.3 / CAMERA.fx)
    assert abs(found.x - X[side] - 0.002) < min(0.1e-3, 3.0 * found.stddev)
    assert found.slip == pytest.approx(0.0015, abs=0.2e-3)
    assert found.stddev < 0.5 * tagged.measure(rays, stddev).stddev  # as in an image that does not show the tag


def test_tags_are_found_by_number_again_near_where_they_were_and_mirrored_ones_are_named():
    corners = [see(tag_of(side).corners, pose(side)) for side in PLACES]
    finder = TagFinder(FAMILY, (0, 1))
    for shift in (0.0, 3.0):  # everywhere, then near the last ones
        found = finder.find(picture(*(there + shift for there in corners)))
        assert sorted(found) == [0, 1]
        for number, there in enumerate(corners):
            assert np.abs(found[number] - there - shift).max() < 0.5
    finder.reset()
    assert list(finder.find(picture(corners[0]))) == [0] and sorted(finder.find(picture(*corners))) == [0, 1]
    assert list(TagFinder(FAMILY, (1,)).find(picture(*corners))) == [1]
    assert not TagFinder("5x5_50", (0, 1)).find(picture(*corners))
    mirrored = np.ascontiguousarray(picture(*corners)[:, ::-1])
    assert not finder.find(mirrored) and sorted(finder.mirrored) == [0, 1]
    assert finder.find(picture(*corners)) and not finder.mirrored


def test_a_tag_is_put_on_the_jaw_that_carries_it():
    tag = tag_of("right")
    there = {side: [pose(side), pose(side, 1.2 * X[side])] for side in PLACES}
    seen = [see(tag.corners, T) for T in there["right"]]
    side, found = find_tag(1, seen, there, SIZE, CAMERA)
    assert side == "right" and np.abs(found.corners - tag.corners).max() < 0.1e-3
    with pytest.raises(GeometryError, match=r"tag 1 moves by 4\.0 mm against the right jaw"):
        find_tag(1, [seen[0], seen[0]], there, SIZE, CAMERA)
    with pytest.raises(GeometryError, match="tag 3 is in none of the pictures"):
        find_tag(3, [], {"left": [], "right": []}, SIZE, CAMERA)
    with pytest.raises(GeometryError, match="expected those of a square tag"):
        place_corners(seen[0] * [1.0, 1.5], SIZE, CAMERA)


def test_finforce_camera_writes_tags_into_the_rig():
    mounts, origins = {side: JawMount() for side in PLACES}, {side: np.array([X[side]] * 2) for side in PLACES}
    placement = CameraPlacement(
        T_gripper_camera=ROBOT_CAMERA, mounts=mounts, origins=origins, contrast=1.0, residual=0.0, seen={}
    )
    options = Namespace(tags=[0, 1], tag_family=FAMILY, tag_size=SIZE)
    color = picture(*(see(tag_of(side).corners, pose(side)) for side in PLACES))
    jaws = {side: load_jaw("bench", side) for side in PLACES}
    placed = add_tags(placement, find_tags([color] * 2, options), CAMERA, jaws, options)
    for side, number in PLACES.items():
        tag = describe_mount(placed.mounts[side], NAMES).tag
        assert tag.id == number and np.abs(np.array(tag.corners) - tag_of(side).corners).max() < 0.5e-3
    with pytest.raises(OptionError, match="the pictures are mirrored"):
        find_tags([np.ascontiguousarray(color[:, ::-1])], options)
    with pytest.raises(OptionError, match="tags 0 and 0 are both on the left jaw"):
        add_tags(placed, find_tags([color] * 2, options), CAMERA, jaws, options)
    options.tag_size *= 10 / 8  # with its white border
    with pytest.raises(GeometryError, match=r"tag 0 lies \d+ mm behind .*, as --tag-size says"):
        add_tags(placement, find_tags([color] * 2, options), CAMERA, jaws, options)


@pytest.fixture
def look():
    """Key points and warnings of a detector that knows the pixels, after pictures of tags at corners (4, 2) [px]."""
    jaws = {side: load_jaw("bench", side) for side in PLACES}

    class Knowing:
        name, sha256 = "knowing", ""

        def detect(self, image, expected):
            self.expected = expected
            return {
                side: PixelDetection(
                    pixels=see(np.vstack((jaw.keypoints, jaw.reference_point)), pose(side)),
                    likelihood=np.where(mounts[side].seen_points(jaw), 0.9, 0.0),
                    stddev=np.full(len(jaw.keypoints) + 1, 0.5),
                )
                for side, jaw in jaws.items()
            }

    knowing, mounts = Knowing(), {side: JawMount(covered=LOW, tag=tag_of(side)) for side in PLACES}

    def run(*colors):
        settings = replace(DetectorSettings(), plane_depth=True)
        finder = TagFinder(FAMILY, (0, 1))
        detector = KeypointDetector(knowing, jaws, ROBOT_CAMERA, settings, mounts=mounts, tags=finder)
        for number, color in enumerate(colors):
            found = detector.detect(RgbdImage(stamp=0.03 * number, color=color, depth=None, camera=CAMERA))
        return found, detector.warnings, knowing.expected

    return run


def test_beside_a_tag_the_jaw_is_looked_for_there_and_its_place_is_doubted_less(look):
    found, warnings, expected = look(picture(see(tag_of("left").corners, pose("left"))))
    assert found["left"].shared.shift == pytest.approx(TAGGED_STDDEV, rel=0.1) and not warnings
    assert found["right"].shared.shift == COVERED_STDDEV  # whose tag is not seen
    np.testing.assert_allclose(expected["left"], pose("left"), atol=0.3e-3)
    assert expected["right"] is None


def test_tags_on_the_wrong_sides_and_mirrored_images_are_named_and_give_no_key_points(look):
    corners = [see(tag_of(side).corners, pose(side)) for side in ("right", "left")]
    found, warnings, _ = look(picture(*corners))
    assert not found and all("is not where the rig has it" in warnings[side] for side in PLACES)
    mirrored = np.ascontiguousarray(picture(*corners[::-1])[:, ::-1])
    found, warnings, _ = look(mirrored)
    assert not found and all("mirrored" in warnings[side] for side in PLACES)
    beside = np.ascontiguousarray(picture(*(there + [0.0, 200.0] for there in corners[::-1]))[:, ::-1])
    found, warnings, _ = look(beside)  # as in a mirror beside the jaws
    assert len(found) == 2 and not warnings


@pytest.mark.parametrize("numbers", [(), (1.0,), (0.5, *[0.0] * 12), (-1.0, *[0.0] * 12), (0.0, *[np.nan] * 12)])
def test_a_parameter_that_is_no_tag_is_refused(numbers):
    with pytest.raises(DetectorSettingsError, match="left_tag: got .* expected a tag's number"):
        find_mounts(DetectorParameters(left_tag=numbers), {"left": load_jaw("bench")})


def test_small_tags_are_found_in_the_enlarged_picture_and_missing_ones_are_named():
    corners = [see(tag_of(side).corners, pose(side)) for side in PLACES]
    small = cv2.resize(picture(*corners), None, fx=0.27, fy=0.27, interpolation=cv2.INTER_AREA)
    edge = 0.27 * np.linalg.norm(corners[0][1] - corners[0][0])
    assert edge < 20.0 and sorted(TagFinder(FAMILY, (0, 1)).find(small)) == [0, 1]
    with pytest.raises(OptionError, match="tag 5 is in none of the 1 pictures; .*show 0, 1"):
        find_tags([small], Namespace(tags=[0, 5], tag_family=FAMILY))
