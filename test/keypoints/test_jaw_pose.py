import numpy as np
import pytest
from keypoint_scene_fakes import CAMERA, FakeScene

from finforce.camera import project, rays_from_pixels
from finforce.gripper_frames import jaw_in_camera
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.geometry.jaw_pose import Origin, OriginEstimator, OriginTrack
from finforce_keypoints.geometry.template import BENDS, PAIRS, find_motions
from finforce_keypoints.parameters import DetectorSettings

SETTINGS = DetectorSettings()
STDDEV = np.full(16, 0.4 / 430.6)
RATE = 30.0


@pytest.fixture(scope="module", params=["left", "right"])
def seen(request):
    """A estimator of one jaw's origin, and the pixels of its points for an origin."""
    scene, side = FakeScene("robot"), request.param

    def look(x, bent=0.0):
        T = jaw_in_camera(scene.T_gripper_camera, side, x)
        points = scene.keypoints(side).copy()
        points[:15] += bent
        return project(points @ T[:3, :3].T + T[:3, 3], CAMERA)

    sign = -1.0 if side == "left" else 1.0
    return OriginEstimator(scene.jaws[side], scene.T_gripper_camera, SETTINGS), look, sign


def measure(estimator, pixels):
    return estimator.measure(rays_from_pixels(pixels, CAMERA), STDDEV)


def only(rows, pixels):
    kept = np.full_like(pixels, np.nan)
    kept[rows] = pixels[rows]
    return kept


@pytest.mark.parametrize("opening", [0.012, 0.04, 0.075])
def test_the_reference_point_alone_gives_the_origin(seen, opening):
    estimator, look, sign = seen
    origin = measure(estimator, only([15], look(sign * opening)))
    assert origin.x == pytest.approx(sign * opening, abs=1e-9)


def test_its_standard_deviation_is_that_of_the_errors(seen):
    estimator, look, sign = seen
    rng, pixels = np.random.default_rng(0), only([15], look(sign * 0.04))
    found = [measure(estimator, pixels + 0.4 * rng.standard_normal((16, 2))) for _ in range(400)]
    assert np.std([origin.x for origin in found]) == pytest.approx(found[0].stddev, rel=0.12)  # 400 samples: 3.5 %


def test_without_the_reference_point_all_points_say_less_exactly_where_the_jaw_is_however_it_bends(seen):
    estimator, look, sign = seen
    motions, rng, off = find_motions(load_jaw("bench")), np.random.default_rng(0), []
    for _ in range(100):
        sizes = 0.6 * rng.standard_normal(BENDS)
        bent = np.tensordot([*sizes, *(sizes[i] * sizes[j] for i, j in PAIRS)], motions, axes=1)
        pixels = only(range(15), look(sign * 0.04, np.insert(bent, 1, 0.0, axis=1)))
        origin = measure(estimator, pixels + 0.4 * rng.standard_normal((16, 2)))
        off.append((origin.x - sign * 0.04) / origin.stddev)
        assert origin.shared == origin.stddev > measure(estimator, look(sign * 0.04)).stddev
    assert 0.5 < np.std(off) < 1.5 and abs(np.mean(off)) < 0.6 and np.abs(off).max() < 4.0


def test_points_without_the_shape_of_a_jaw_say_nothing(seen):
    estimator, look, sign = seen
    rng, found = np.random.default_rng(0), []
    for _ in range(50):
        found.append(measure(estimator, only(range(15), look(sign * 0.04) + 8.0 * rng.standard_normal((16, 2)))))
    assert sum(origin is not None for origin in found) <= 5


def test_the_tip_alone_says_nothing(seen):
    estimator, look, sign = seen
    assert measure(estimator, only([6, 13, 14], look(sign * 0.04))) is None
    assert measure(estimator, np.full((16, 2), np.nan)) is None


def test_a_reference_point_out_of_the_opening_range_or_off_its_line_is_refused(seen):
    estimator, look, sign = seen
    assert measure(estimator, only([15], look(sign * 0.09))) is None
    aside = look(sign * 0.04) + [0.0, 40.0]
    assert measure(estimator, only([15], aside)) is None
    assert measure(estimator, only([15], aside - [0.0, 35.0])) is not None


def follow(speeds, seed=0, noise=0.08e-3):
    """Errors [m] of a tracked place and the true speeds [m/s]."""
    rng, track, speeds = np.random.default_rng(seed), OriginTrack(SETTINGS), np.asarray(speeds)
    places = -0.06 + np.cumsum(speeds) / RATE
    found = [
        track.update(n / RATE, Origin(x=x + noise * rng.standard_normal(), stddev=noise)) for n, x in enumerate(places)
    ]
    return np.array([origin.x for origin in found]) - places


CLOSING = np.repeat([0.0, 0.03, 0.01, 0.0, -0.02, 0.0], 20)


def test_a_closing_gripper_is_followed_without_lag_though_its_speed_changes():
    errors = np.array([follow(CLOSING, seed) for seed in range(20)])
    moving = CLOSING != 0.0
    lag = (errors[:, moving] * np.sign(CLOSING[moving])).mean()
    assert abs(lag) < 0.02e-3  # 0.7 ms at 30 mm/s
    assert np.abs(errors).max() < 0.4e-3  # five standard deviations of one image
    assert np.abs(errors.mean(axis=0)).max() < 0.12e-3  # no image after a change of speed stands out


BENT = {
    "stddev": 0.58e-3,
    "shared": 0.41e-3,
    "noise": 0.05e-3,
    "is_bent": True,
}  # by points near the base that may be bent


@pytest.mark.parametrize("speed", [0.01, 0.035, 0.08])
def test_a_jaw_without_its_reference_point_is_followed_as_well(speed):
    """What points that bend are off by in all images alike does not hold the place back."""
    speeds = np.repeat([0.0, -speed, 0.0, speed, 0.0], 20)
    track, places = OriginTrack(SETTINGS), 0.06 + np.cumsum(speeds) / RATE
    found = [track.update(n / RATE, Origin(x=x + 0.4e-3, **BENT)) for n, x in enumerate(places)]
    errors = np.array([origin.x for origin in found]) - places - 0.4e-3
    assert np.abs(errors).max() < 0.3e-3
    assert all(0.41e-3 <= origin.stddev < 0.6e-3 for origin in found)


def test_a_worse_image_of_points_that_bend_moves_the_jaw_little():
    track = OriginTrack(SETTINGS)
    for n in range(20):
        track.update(n / RATE, Origin(x=0.05, **BENT))
    assert track.update(20 / RATE, Origin(x=0.052, **{**BENT, "stddev": 3e-3})).x == pytest.approx(0.05, abs=0.1e-3)
    assert track.update(21 / RATE, Origin(x=0.05, **BENT)).x == pytest.approx(0.05, abs=0.1e-3)


def test_what_the_reference_point_told_stays_while_it_is_hidden():
    track = OriginTrack(SETTINGS)
    for n in range(60):
        told = Origin(x=0.0504, **BENT) if 20 <= n < 40 else Origin(x=0.05, stddev=1e-4)
        assert track.update(n / RATE, told).x == pytest.approx(0.05, abs=0.05e-3)


def test_a_jaw_at_rest_is_better_known_than_from_one_image():
    errors = np.array([follow(np.zeros(60), seed) for seed in range(20)])[:, 20:]
    assert errors.std() < 0.7 * 0.08e-3


def test_one_impossible_origin_is_not_believed_and_three_that_agree_are():
    track = OriginTrack(SETTINGS)
    for n in range(10):
        track.update(n / RATE, Origin(x=-0.05, stddev=1e-4))
    found = [track.update((10 + n) / RATE, Origin(x=-0.03, stddev=1e-4)).x for n in range(3)]
    np.testing.assert_allclose(found, [-0.05, -0.05, -0.03], atol=1e-3)


def test_a_finger_that_stays_bent_tells_no_better_where_its_base_is_the_longer_it_is_seen():
    bent = {"stddev": 1.0e-3, "shared": 0.9e-3}
    for told, is_known in (({"stddev": 4.0e-3, "shared": 3.6e-3}, False), ({"stddev": 4.0e-3}, True)):
        track = OriginTrack(SETTINGS)
        found = [track.update(n / RATE, Origin(x=-0.05, **told)) for n in range(60)]
        assert found[0] is None and (found[-1] is not None) == is_known
    # what the reference point told before it was hidden is not forgotten at once
    track = OriginTrack(SETTINGS)
    for n in range(30):
        track.update(n / RATE, Origin(x=-0.05, stddev=1e-4))
    found = [track.update((30 + n) / RATE, Origin(x=-0.0507, **bent)) for n in range(10)]
    assert all(origin is not None and abs(origin.x + 0.05) < 3.0 * origin.stddev for origin in found)


def test_a_jaw_is_lost_after_some_images_without_it_and_found_again_at_once():
    track = OriginTrack(SETTINGS)
    for n in range(30):
        track.update(n / RATE, Origin(x=-0.05, stddev=1e-4))
    places = [track.update((30 + n) / RATE, None) for n in range(SETTINGS.lost_images)]
    assert places[0] is not None and places[-1] is None and track.is_lost
    assert track.forecast(40 / RATE) is None
    assert track.update(40 / RATE, Origin(x=-0.02, stddev=1e-4)).x == -0.02


def test_a_forecast_goes_on_at_the_speed_and_ends_with_a_long_gap():
    track = OriginTrack(SETTINGS)
    for n in range(20):
        track.update(n / RATE, Origin(x=-0.05 + 0.03 * n / RATE, stddev=1e-5))
    stops = 0.03 / RATE / RATE  # less the chance that it stops in this image: it moves for a second in the mean
    assert track.forecast(20 / RATE).x == pytest.approx(-0.05 + 0.03 * 20 / RATE - stops, abs=1e-5)
    assert track.forecast(19 / RATE + 2.0) is None


def test_a_slow_jaw_that_stops_is_not_seen_farther_on():
    speeds = np.repeat([0.0, 0.004, 0.0], 30)
    errors = np.array([follow(speeds, seed, 0.02e-3) for seed in range(20)])[:, 60:]
    assert np.abs(errors.mean(axis=0)).max() < 0.05e-3  # of the 0.13 mm that it moved between two images


def test_a_jaw_that_is_known_to_rest_stays_where_it_was():
    track = OriginTrack(SETTINGS)
    for n in range(20):
        place = track.update(n / RATE, Origin(x=-0.05 + 0.002 * max(n - 16, 0) / RATE, stddev=4e-5)).x
    track.rest(20 / RATE)
    assert track.place == pytest.approx(place, abs=1e-9) and track.speed == 0.0


def test_reset_forgets_the_jaw():
    track = OriginTrack(SETTINGS)
    track.update(0.0, Origin(x=-0.05, stddev=1e-4))
    track.reset()
    assert track.is_lost and track.forecast(0.1) is None
