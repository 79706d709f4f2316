"""Claims about key points at rest that do not lie where the jaw file says: the camera's place is wrong."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from keypoint_scene_fakes import Bend, FakePixelDetector, scene_of
from scipy.spatial.transform import Rotation

from finforce_keypoints.detector import KeypointDetector

RATE = 30.0


@lru_cache(maxsize=16)
def noisy_images(view, bend):
    """Two images of a scene; more of them cost time and show the same."""
    scene, depth = scene_of(view, bend)
    return [scene.image(0.0, np.random.default_rng(seed), depth=depth) for seed in range(2)]


def warn(shift=(0, 0, 0), turn=(0, 0, 0), view="robot", bend=None, count=15):
    """What a detector warns of whose camera is said to be `shift` [mm] and `turn` [deg] from where it is."""
    scene, _ = scene_of(view, bend)
    T = scene.T_gripper_camera.copy()
    T[:3, 3] += 1e-3 * np.array(shift)
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(np.radians(turn)).as_matrix()
    pixel_detector = FakePixelDetector(scene.pixels(), np.random.default_rng(0), stddev=0.4)
    detector = KeypointDetector(pixel_detector, scene.jaws, T)
    for n in range(count):
        detector.detect(replace(noisy_images(view, bend)[n % 2], stamp=n / RATE))
    return detector.warnings


@pytest.mark.parametrize("view", ["robot", "bench"])
@pytest.mark.parametrize(
    ("shift", "turn"),
    [((0, 5, 0), (0, 0, 0)), ((0, -5, 0), (0, 0, 0)), ((0, 0, 5), (0, 0, 0)), ((0, 0, -5), (0, 0, 0))]
    + [((0, 0, 0), (0, 3, 0)), ((0, 0, 0), (0, 0, 3)), ((0, 0, 0), (0, 0, -3)), ((0, 0, 0), (1.5, 0, 0))],
)
def test_wrong_extrinsics_are_warned_of_when_the_jaw_is_at_rest(view, shift, turn):
    warnings = warn(shift, turn, view)
    assert warnings and all("are the camera's extrinsics right?" in text for text in warnings.values())
    if shift[2]:
        # across the view a shift is what it is; the sentence rounds to 0.1 mm
        (distance,) = {float(text.split(" lie ")[1].split(" mm ")[0]) for text in warnings.values()}
        assert distance == pytest.approx(5.0, abs=0.15)


@pytest.mark.parametrize("view", ["robot", "bench"])
@pytest.mark.parametrize("bend", [None, Bend(push=0.008), Bend(push=0.012, lean=0.0015)])
def test_a_jaw_under_load_is_not_taken_for_wrong_extrinsics(view, bend):
    # well calibrated; along the closing axis the jaw is where it is found
    assert not warn(view=view, bend=bend, shift=(3, 0.5, 0), turn=(0, 0.3, 0))


def test_too_few_images_say_nothing_of_the_extrinsics():
    assert not warn((0, 0, 5), count=14) and warn((0, 0, 5), count=15)
