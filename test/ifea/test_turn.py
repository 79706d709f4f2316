"""Turns of the gripper by the direction of gravity."""

import numpy as np
import pytest

from finforce_ifea.turn import TurnTrack


def test_a_slow_turn_is_counted_whole_and_noise_is_none():
    random, turns = np.random.default_rng(0), TurnTrack()
    angles = np.linspace(0.0, 1.0, 200)
    found = [turns.update(np.array([np.sin(one), 0.0, np.cos(one)])) for one in angles]
    assert sum(one.angle for one in found) == pytest.approx(1.0, abs=0.06)
    assert all(one.angle == 0.0 or one.before @ one.now < 1.0 for one in found)
    turns.reset()
    for _ in range(1000):
        noisy = np.array([0.0, 0.0, 1.0]) + 0.005 * random.normal(size=3)
        assert turns.update(noisy / np.linalg.norm(noisy)).angle == 0.0


def test_what_turned_unseen_is_counted_once_it_is_seen():
    turns = TurnTrack()
    assert turns.update(None) is None
    assert turns.update(np.array([0.0, 0.0, 1.0])).angle == 0.0
    assert turns.update(None) is None
    assert turns.update(np.array([0.0, 1.0, 0.0])).angle == pytest.approx(0.5 * np.pi)
