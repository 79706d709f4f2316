"""How a held object moves over a jaw: speed, alarm, and what must not alarm."""

import numpy as np
import pytest

from finforce_contact.parameters import ContactSettings
from finforce_contact.slip import SlipWatch, TouchedFace, face_at

SETTINGS = ContactSettings()
FACE = TouchedFace(point=np.array([0.012, 0.0, 0.040]), tangent=np.array([0.0, 0.0, 1.0]))


def watch(way, rate=30.0, noise=0.15e-3, seed=0, closing=lambda t: 0.0):
    """What a watch says of an object that has moved by way(t) (3,) [m], seen with noise [m] at a rate [Hz]."""
    random, eyes, said = np.random.default_rng(seed), SlipWatch(SETTINGS), []
    eyes.follow(0.040)
    for number in range(int(6.0 * rate)):
        t, T = number / rate, np.eye(4)
        T[:3, 3] = np.array([0.03, 0.0, 0.04]) + way(t) + noise * random.standard_normal(3)
        said.append(eyes.update(t, T, FACE, closing=closing(t)))
    return said


def sliding(speed, start=3.0, axis=2):
    return lambda t: np.eye(3)[axis] * speed * max(0.0, t - start)


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("speed", [5e-3, -5e-3, 20e-3])
def test_speed_is_along_the_face_and_right(speed, axis):
    last = watch(sliding(speed, axis=axis))[-1]
    assert last.sliding
    assert last.velocity[axis] == pytest.approx(speed, abs=4.0 * last.stddev)
    assert np.abs(np.delete(last.velocity, axis)).max() < 4.0 * last.stddev


def test_a_slip_of_5_mm_per_s_is_seen_within_six_images():
    """The median over seeds at 30 Hz and 0.15 mm: images from its start to the alarm."""
    delays = []
    for seed in range(21):
        said = watch(sliding(5e-3), seed=seed)
        delays.append(next(s.stamp for s in said if s.sliding and s.stamp > 3.0) - 3.0)
    assert np.median(delays) * 30.0 <= 6.0


def test_noise_alone_hardly_ever_alarms():
    """Two minutes of rest, twice the noise that was expected: at most one alarm."""
    alarms = 0
    for seed in range(20):
        said = [s.sliding for s in watch(lambda t: np.zeros(3), noise=0.6e-3, seed=seed)]
        alarms += sum(now and not before for before, now in zip(said, said[1:], strict=False))
    assert alarms <= 1


def test_outliers_are_no_slip():
    said = watch(lambda t: np.array([0.0, 0.0, 0.02]) if 3.0 < t < 3.02 else np.zeros(3))
    assert not any(s.sliding for s in said)


def test_a_closing_jaw_is_no_slip():
    """The object goes deeper by 6 mm/s, and the other jaw moves it along the face by 2 mm/s."""
    moves = np.array([-6e-3, 0.0, -2e-3])
    said = watch(lambda t: moves * max(0.0, t - 3.0), closing=lambda t: moves[0] * (t > 3.0))
    assert not any(s.sliding for s in said)


def test_a_slip_along_a_bent_face_is_no_closing_jaw():
    """The face leans by 20 degrees where the object slides at 20 mm/s."""
    moves = 20e-3 * np.array([-np.sin(np.radians(20.0)), 0.0, np.cos(np.radians(20.0))])
    said = watch(lambda t: moves * max(0.0, t - 3.0), closing=lambda t: moves[0] * (t > 3.0))
    assert said[-1].sliding
    assert said[-1].velocity[2] == pytest.approx(moves[2], abs=4.0 * said[-1].stddev)


def test_an_object_that_came_to_rest_slides_no_more():
    said = watch(lambda t: np.array([0.0, 0.0, 10e-3 * np.clip(t - 2.0, 0.0, 0.5)]))
    assert any(s.sliding for s in said)
    assert not any(s.sliding for s in said if s.stamp > 3.5)


def test_gaps_and_release_begin_anew():
    eyes, T = SlipWatch(SETTINGS), np.eye(4)
    eyes.follow(0.04)
    for stamp in (0.0, 0.03, 0.06):
        eyes.update(stamp, T, FACE)
    T[2, 3] = 0.01
    assert not eyes.update(2.0, T, FACE).sliding
    eyes.release()
    assert eyes.slip is None


def test_the_face_is_found_at_a_height():
    heights = np.linspace(0.0, 0.08, 81)
    face = face_at(np.stack([0.014 - 0.1 * heights, heights], axis=1), 0.0405)
    np.testing.assert_allclose(face.point, [0.014 - 0.00405, 0.0, 0.0405])
    np.testing.assert_allclose(face.tangent, np.array([-0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0))


def test_contact_follows_its_height_until_it_has_gone_elsewhere():
    eyes = SlipWatch(SETTINGS)
    assert eyes.follow(0.040) == 0.040
    assert eyes.follow(0.044) == 0.040
    assert eyes.follow(0.050) == 0.050


def test_odd_poses_count_unless_they_are_far_away():
    eyes, T = SlipWatch(SETTINGS), np.eye(4)
    eyes.follow(0.040)
    for number in range(60):
        T[:3, 3] = [0.03, 0.0, 0.04 + 1e-5 * (number % 3)]
        eyes.update(number / 30.0, T.copy(), FACE)
    T[2, 3] = 0.06
    assert not eyes.update(2.0, T.copy(), FACE, odd=True).sliding
    for number in range(1, 6):
        T[2, 3] = 0.04 + 5e-3 * number / 30.0
        slip = eyes.update(2.0 + number / 30.0, T.copy(), FACE, odd=True)
    assert slip.sliding
