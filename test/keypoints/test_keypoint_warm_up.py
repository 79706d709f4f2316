"""Claims about a detector that does everything once before the first image."""

import numpy as np
import pytest
from keypoint_scene_fakes import bare_image, build, lost_sides

from finforce.gripper_frames import jaw_in_camera
from finforce_keypoints.errors import DetectionError
from finforce_keypoints.geometry import jaw_localizer as jaw_localizer
from finforce_keypoints.geometry.jaw_localizer import ReferencePatch


def test_a_detector_that_was_warmed_up_has_done_everything_once_and_knows_nothing():
    scene, depth, pixel_detector, detector = build()
    image = bare_image(5.0, depth.astype(np.float32))
    before = detector.detect(image)
    detector.warm_up()
    lost, known = pixel_detector.expected[-2:]
    assert lost == {"left": None, "right": None}
    assert np.allclose(known["left"], jaw_in_camera(scene.T_gripper_camera, "left", -0.045))  # of 10 to 80 mm
    assert lost_sides(detector) == ("left", "right") and not detector.counts and not detector.warnings
    after = detector.detect(image)
    for side in before:
        np.testing.assert_array_equal(after[side].points, before[side].points)
    assert detector.depth_scale.error == pytest.approx(0.0, abs=1e-3)


def test_warming_up_comes_as_far_as_registering_and_as_depth(monkeypatch):
    calls = []
    for name in ("_register", "_learn"):
        kept = getattr(ReferencePatch, name)
        monkeypatch.setattr(
            ReferencePatch, name, lambda *given, kept=kept, name=name: calls.append(name) or kept(*given)
        )
    kept_fit = jaw_localizer.fit_side
    monkeypatch.setattr(jaw_localizer, "fit_side", lambda *given: calls.append(len(given)) or kept_fit(*given))
    *_, detector = build()
    detector.warm_up()
    assert set(calls) == {"_register", "_learn", 5}


def test_a_finder_that_wants_other_images_is_not_in_the_way_of_warming_up():
    scene, _, pixel_detector, detector = build()

    def refuse(image, expected):
        raise DetectionError("640x480 is not what the network was trained on")

    pixel_detector.find = refuse
    detector.warm_up()
