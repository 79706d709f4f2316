import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.geometry import jaw_pose as reference_patch
from finforce_keypoints.geometry.jaw_pose import STDDEV, TEMPLATE_IMAGES, Origin, PatchMatcher, ReferencePatch
from finforce_keypoints.geometry.side_picture import find_side, intersect_plane
from finforce_sim.sensor import build_d405_vga

CAMERA = build_d405_vga()
RNG = np.random.default_rng(3)
TEXTURE = gaussian_filter(RNG.standard_normal((400, 400)), 6.0)  # 0.1 mm a cell: blotches of a millimetre
TEXTURE = 120.0 + 40.0 * TEXTURE / TEXTURE.std()
COLUMNS, ROWS = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
PIXELS = np.column_stack((COLUMNS.ravel(), ROWS.ravel()))


def place_of(side):
    return lambda origin: jaw_in_camera(ROBOT_CAMERA, side, origin.x)


def image_of(side, x, *, gain=1.0, offset=0.0, seed=0, covered=False, contrast=1.0):
    """The textured plane of a jaw's side at an origin [m], as the camera sees it, with noise."""
    jaw = load_jaw("bench", side)
    places = intersect_plane(PIXELS, find_side(jaw), place_of(side)(Origin(x=x, stddev=0.0)), CAMERA)
    index = np.clip(np.round(places / 1e-4).astype(int) + 200, 0, 399)
    grey = TEXTURE[index[:, 1], index[:, 0]].reshape(CAMERA.height, CAMERA.width)
    if covered:
        grey = np.random.default_rng(9).permutation(grey.ravel()).reshape(grey.shape)
    noise = np.random.default_rng(seed).normal(0.0, 4.0, grey.shape)
    grey = 120.0 + contrast * (gaussian_filter(grey, 0.7) - 120.0)
    grey = np.clip(gain * grey + offset + noise, 0, 255)
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_slide_is_found_where_the_network_is_wrong(side, monkeypatch):
    monkeypatch.setattr(reference_patch, "TEMPLATE_IMAGES", 3)
    patch, sign = ReferencePatch(load_jaw("bench", side)), -1.0 if side == "left" else 1.0
    start = 0.040 * sign
    for seed in range(3):
        patch.refine(image_of(side, start, seed=seed), CAMERA, Origin(x=start, stddev=3e-4), place_of(side))
    for number, way in enumerate((-2e-3, 0.37e-3, 5e-3)):
        measured = Origin(x=start + way + 0.4e-3, stddev=3e-4)
        found = patch.refine(image_of(side, start + way, seed=10 + number), CAMERA, measured, place_of(side))
        assert found.x == pytest.approx(start + way, abs=0.03e-3)  # a tenth of an image pixel
        assert found.stddev < measured.stddev


def test_another_brightness_and_contrast_change_nothing(monkeypatch):
    monkeypatch.setattr(reference_patch, "TEMPLATE_IMAGES", 1)
    patch = ReferencePatch(load_jaw("bench"))
    patch.refine(image_of("left", -0.04), CAMERA, Origin(x=-0.04, stddev=3e-4), place_of("left"))
    dark = image_of("left", -0.0405, gain=0.3, offset=10.0, seed=4)
    found = patch.refine(dark, CAMERA, Origin(x=-0.0402, stddev=3e-4), place_of("left"))
    assert found.x == pytest.approx(-0.0405, abs=0.04e-3)


def test_something_else_in_its_place_leaves_what_was_measured():
    patch = ReferencePatch(load_jaw("bench"))
    patch.refine(image_of("left", -0.04), CAMERA, Origin(x=-0.04, stddev=3e-4), place_of("left"))
    measured = Origin(x=-0.0397, stddev=3e-4)
    assert patch.refine(image_of("left", -0.04, covered=True), CAMERA, measured, place_of("left")) == measured


def test_a_holder_without_a_mark_leaves_what_was_measured_and_is_not_waited_for():
    patch = ReferencePatch(load_jaw("bench"))
    for seed in range(TEMPLATE_IMAGES + 5):
        measured = Origin(x=-0.04 + 1e-5 * seed, stddev=3e-4)
        bare = image_of("left", -0.04, contrast=0.01, seed=seed)
        assert patch.refine(bare, CAMERA, measured, place_of("left")) == measured
    assert patch.is_settled


@pytest.mark.parametrize("contrast", [0.06, 0.1])
def test_a_faint_mark_tells_a_slide_within_what_is_stated(contrast, monkeypatch):
    monkeypatch.setattr(reference_patch, "TEMPLATE_IMAGES", 1)
    patch = ReferencePatch(load_jaw("bench"))
    start, measured = Origin(x=-0.04, stddev=6e-4), Origin(x=-0.0398, stddev=6e-4)
    patch.refine(image_of("left", -0.04, contrast=contrast), CAMERA, start, place_of("left"))
    found = [
        patch.refine(image_of("left", -0.04, contrast=contrast, seed=seed), CAMERA, measured, place_of("left"))
        for seed in range(1, 21)
    ]
    told = [each for each in found if each != measured]
    errors, stated = np.array([each.x + 0.04 for each in told]), np.array([each.stddev for each in told])
    assert len(told) > 10 and (stated > 1.3 * STDDEV).all()
    assert 0.3 < np.sqrt(np.mean((errors / stated) ** 2)) < 2.0


def test_a_clear_mark_is_followed_however_sure_the_network_is(monkeypatch):
    monkeypatch.setattr(reference_patch, "TEMPLATE_IMAGES", 1)
    patch = ReferencePatch(load_jaw("bench"))
    patch.refine(image_of("left", -0.04), CAMERA, Origin(x=-0.04, stddev=3e-5), place_of("left"))
    measured = Origin(x=-0.0389, stddev=3e-5)
    found = patch.refine(image_of("left", -0.039, seed=1), CAMERA, measured, place_of("left"))
    assert found.x == pytest.approx(-0.039, abs=0.03e-3) and found != measured


def test_a_jaw_is_found_where_it_should_be_though_the_network_is_far_off(monkeypatch):
    monkeypatch.setattr(reference_patch, "TEMPLATE_IMAGES", 1)
    patch = ReferencePatch(load_jaw("bench"))
    patch.refine(image_of("left", -0.04), CAMERA, Origin(x=-0.04, stddev=3e-4), place_of("left"))
    image, forecast = image_of("left", -0.039, seed=1), Origin(x=-0.0392, stddev=1e-4)
    unsure = Origin(x=-0.0363, stddev=6e-4)
    assert patch.refine(image, CAMERA, unsure, place_of("left"), forecast).x == pytest.approx(-0.039, abs=0.03e-3)
    sure = Origin(x=-0.0363, stddev=1e-4)  # of another place, which a forecast does not overrule
    assert patch.refine(image, CAMERA, sure, place_of("left"), forecast) == sure


def test_the_place_of_the_first_images_is_the_mean_of_what_was_measured():
    patch, errors = ReferencePatch(load_jaw("bench")), np.random.default_rng(0).normal(0.0, 0.2e-3, TEMPLATE_IMAGES)
    errors -= errors.mean()
    for seed, error in enumerate(errors):
        found = patch.refine(
            image_of("left", -0.04, seed=seed), CAMERA, Origin(x=-0.04 + error, stddev=3e-4), place_of("left")
        )
    assert found.x == pytest.approx(-0.04, abs=0.03e-3)
    assert abs(errors[0]) > 0.02e-3  # where the first image alone would have put it


def test_after_a_reset_the_next_image_is_the_template():
    patch = ReferencePatch(load_jaw("bench"))
    patch.refine(image_of("left", -0.04), CAMERA, Origin(x=-0.04, stddev=3e-4), place_of("left"))
    patch.reset()
    measured = Origin(x=-0.0351, stddev=3e-4)
    assert patch.refine(image_of("left", -0.035), CAMERA, measured, place_of("left")) == measured


def test_a_slide_by_half_a_pixel_is_read_off_to_a_hundredth():
    rows, columns = np.mgrid[0:41, 0:41]

    def spot(x):
        return 200.0 * np.exp(-((columns - 20.0 - x) ** 2 + (rows - 20.0) ** 2) / 50.0)

    assert PatchMatcher(spot(0.0)).match(spot(0.5)).x == pytest.approx(0.5, abs=0.01)
    assert PatchMatcher(spot(0.0)).match(spot(-0.5)).x == pytest.approx(-0.5, abs=0.01)
    assert PatchMatcher(spot(0.0)).match(200.0 - spot(0.0)).likeness == 0.0
