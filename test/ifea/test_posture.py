"""Postures of the gripper, image after image."""

import numpy as np
import pytest

from finforce_ifea.posture import PostureTrack, WristPosture

DOWN = np.array([0.0, 0.0, 1.0])


def test_a_slow_turn_is_counted_whole_and_noise_is_none():
    random, track = np.random.default_rng(0), PostureTrack()
    turns = [np.array([np.sin(one), 0.0, np.cos(one)]) for one in np.linspace(0.0, 0.9, 200)]
    assert sum(track.update(WristPosture(one)).parting for one in turns) == pytest.approx(6.0, abs=0.4)
    track.reset()
    for _ in range(1000):
        noisy = DOWN + 0.005 * random.normal(size=3)
        move = track.update(WristPosture(noisy / np.linalg.norm(noisy), 1e-4 * random.normal()))
        assert move.parting == 0.0 and move.before is move.now and move.shows_lifts


def test_lifts_count_and_lowering_and_what_was_not_known_do_not():
    track = PostureTrack()
    parts = [track.update(WristPosture(DOWN, one)).parting for one in np.r_[0.30, np.linspace(0.2, 0.1, 50), 0.1]]
    assert not any(parts)
    assert sum(track.update(WristPosture(DOWN, one)).parting for one in np.linspace(0.1, 0.11, 60)) == pytest.approx(
        5, abs=0.6
    )
    assert not track.update(WristPosture(DOWN)).shows_lifts
    assert track.update(WristPosture(DOWN, 0.5)).parting == 0.0


def test_what_turned_unseen_is_counted_once_it_is_seen():
    track = PostureTrack()
    assert track.update(None) is None
    assert track.update(WristPosture(DOWN)).parting == 0.0
    assert track.update(None) is None
    assert track.update(WristPosture(np.array([0.0, 1.0, 0.0]))).parting == pytest.approx(np.pi / 0.3)
