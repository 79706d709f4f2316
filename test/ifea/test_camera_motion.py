"""Claims about a camera that moves against the jaw after the tare."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_fakes import REST, make_estimator, pressed, statuses
from mechanics_fakes import BENCH

START = 120
TURN = np.radians(1.0)


def turned(points, axis):
    """Return key points that a camera 0.11 m beside the jaw has after it was turned by a degree."""
    return points + np.cross(TURN * np.asarray(axis), points - BENCH.keypoints.mean(0) - [0.0, 0.11, 0.0])


MOTIONS = {
    "1.5 mm along x": lambda points: points + [1.5e-3, 0.0, 0.0],
    "1.5 mm along y": lambda points: points + [0.0, 1.5e-3, 0.0],
    "1.5 mm along z": lambda points: points + [0.0, 0.0, -1.5e-3],
    "1 degree about x": lambda points: turned(points, [1.0, 0.0, 0.0]),
    "1 degree about z": lambda points: turned(points, [0.0, 0.0, 1.0]),
}


def play(motion, back=10**6, contact=None):
    """Return what is said of a press after whose 120th image all key points move, for some images."""
    recording, estimator = pressed(40), make_estimator(solver="frame")
    solutions = []
    for i, observation in enumerate(recording.observations):
        if START <= i < back:
            observation = replace(observation, points=motion(observation.points))
        solutions.append(estimator.update(observation, contact or recording.contact))
    return solutions


@pytest.mark.parametrize("motion", MOTIONS)
def test_force_is_refused_soon_after_the_camera_has_moved(motion):
    solutions = play(MOTIONS[motion])
    assert statuses(solutions[REST:START]) <= {"ok", "unloaded"}
    late = solutions[START + 12 :]
    assert statuses(late) == {"unobservable"}
    assert "has the camera moved" in late[-1].message


def test_camera_that_is_back_gives_forces_again():
    solutions = play(MOTIONS["1.5 mm along x"], back=START + 20)
    assert statuses(solutions[START + 12 : START + 20]) == {"unobservable"}
    assert "ok" in statuses(solutions[START + 30 :])


def test_press_moves_no_camera():
    assert not any("camera" in solution.message for solution in play(lambda points: points))


def test_jaw_is_tared_anew_once_the_object_is_apart():
    recording, estimator = pressed(40), make_estimator(solver="frame")
    apart = replace(recording.contact, touching=False)
    shift, said = np.array([1.5e-3, 0.0, 0.0]), []
    rest = [recording.observations[i % REST] for i in range(200)]
    for i, observation in enumerate(rest):
        moved = observation.points + 1e-9 * i + (shift if i >= 100 else 0.0)
        said.append(estimator.update(replace(observation, stamp=i / 30.0, points=moved), apart))
    assert "unobservable" in statuses(said[100:120])
    assert all(solution.trusted and np.linalg.norm(solution.force) < 0.1 for solution in said[170:])
