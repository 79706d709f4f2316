"""Claims about the weight of what two jaws hold, on forces with the errors that are stated of them."""

import numpy as np
import pytest

from finforce_ifea.grasp_force import Grasp
from finforce_ifea.payload import Payload
from finforce_ifea.posture import WristPosture

RATE, HELD, WEIGHT = 30.0, 3.0, 0.98  # [Hz], [N], [N]
DOWN = WristPosture(np.array([0.0, 0.0, 1.0]))
STDDEV = np.array([0.1, 0.35, 0.6])  # [N], as of grasps of the twin


def grasp_of(force, held=HELD, stddev=STDDEV):
    return Grasp(grasp=np.array([held, 0.0, 0.0]), manipulation=np.asarray(force, float), torque=None, stddev=stddev)


def turn_gravity(axis, angles):
    """Directions (n, 3) of gravity for a gripper that looks down and turns about its x or y."""
    across = np.array([0.0, 1.0, 0.0]) if axis == "x" else np.array([1.0, 0.0, 0.0])
    return np.sin(angles)[:, None] * across + np.cos(angles)[:, None] * np.array([0.0, 0.0, 1.0])


def disturb(forces, seed):
    """Forces with a lasting error and white noise; nothing is seen along the fingers."""
    random = np.random.default_rng(seed)
    found = forces + STDDEV * np.sqrt(0.5) * (random.normal(size=3) + random.normal(size=forces.shape))
    found[:, 2] = STDDEV[2] * random.normal()
    return found


def follow(payload, found, gravity, elevation=()):
    postures = [
        WristPosture(*each) for each in (zip(gravity, elevation, strict=True) if len(elevation) else zip(gravity))
    ]
    told = [
        payload.update(grasp_of(force), k / RATE, posture)
        for k, (force, posture) in enumerate(zip(found, postures, strict=True))
    ]
    return np.array([each.manipulation for each in told]), np.array([each.stddev for each in told])


def lift_and_turn(axis, seed):
    """Gravity and true forces (n, 3) of a second at rest on a support, half of one lifted, and a turn and back."""
    angles = np.concatenate([np.zeros(45), np.linspace(0.0, 2.0 * np.pi, 150), np.linspace(2.0 * np.pi, 0.0, 150)])
    gravity = turn_gravity(axis, angles)
    carried = np.where(np.arange(len(angles)) < 30, 0.0, WEIGHT)
    return gravity, carried[:, None] * gravity


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_turn_tells_the_weight_and_the_force_along_the_fingers(axis):
    errors, within, weights = [], [], []
    for seed in range(20):
        gravity, true = lift_and_turn(axis, seed)
        payload = Payload()
        told, stddev = follow(payload, disturb(true, seed), gravity)
        within.append((np.abs(told - true) <= 3.0 * stddev).mean())
        errors.append((told - true)[200:])
        weights.append(payload.weight)
    rms = np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
    assert (rms < [0.06, 0.12, 0.12]).all(), rms
    assert np.mean(within) > 0.98 and min(within) > 0.9
    assert np.abs(np.array(weights) - WEIGHT).max() < 0.3


def test_of_what_was_only_lifted_the_force_along_the_fingers_is_not_known():
    gravity = np.tile([0.0, 0.0, 1.0], (60, 1))
    told, stddev = follow(Payload(), np.zeros((60, 3)), gravity)
    assert np.abs(told[:, 2]).max() < 0.1
    assert stddev[:, 2].min() > WEIGHT / 3.0


def test_what_is_set_down_after_a_turn_is_within_what_is_stated():
    gravity, true = lift_and_turn("y", 0)
    rest = np.tile(gravity[-1], (90, 1))
    payload = Payload()
    told, stddev = follow(payload, disturb(np.vstack([true, 0.0 * rest]), 1), np.vstack([gravity, rest]))
    assert (np.abs(told[-30:]) <= 3.0 * stddev[-30:]).all()
    assert stddev[-1, 2] > stddev[len(true) - 1, 2] + 0.1


def test_a_push_in_the_closing_direction_is_no_weight():
    gravity, true = lift_and_turn("y", 0)
    pushed = true + 0.0
    pushed[250:, 0] += 2.0
    told, stddev = follow(Payload(), disturb(pushed, 2), gravity)
    assert np.abs(told[-20:, 0] - pushed[-20:, 0]).max() < 0.4
    assert (np.abs(told - pushed) <= 3.0 * stddev)[250:, 0].mean() > 0.9


def test_a_handle_that_turns_with_the_jaws_is_no_weight():
    gravity, _ = lift_and_turn("y", 0)
    true = np.tile([1.5, 0.0, 0.0], (len(gravity), 1))  # along the closing axis, however the gripper is turned
    told, stddev = follow(Payload(), disturb(true, 3), gravity)
    assert np.abs(told - true)[:, 0].mean() < 0.3
    assert (np.abs(told - true)[:, 0] <= 3.0 * stddev[:, 0]).mean() > 0.9


def test_a_lift_tells_a_weight_that_does_not_pull_along_the_fingers():
    gravity, weights = np.tile([0.0, 1.0, 0.0], (120, 1)), {}
    lift = np.clip(np.arange(120) / 30.0 - 1.0, 0.0, 0.5)
    true = WEIGHT * np.clip(lift / 0.01, 0.0, 1.0)[:, None] * gravity
    for elevation in ((), lift):
        payloads = [Payload() for _ in range(20)]
        for seed, payload in enumerate(payloads):
            follow(payload, disturb(true, seed), gravity, elevation)
        weights[len(elevation)] = np.array([(each.weight, each.stddev) for each in payloads])
    (untold, _), (told, stddev) = weights[0].T, weights[120].T
    assert abs(told - WEIGHT).mean() < 0.7 * abs(untold - WEIGHT).mean()
    assert (abs(told - WEIGHT) < 3.0 * stddev).all()


@pytest.mark.parametrize(
    ("grasp", "posture"),
    [
        (grasp_of([0.1, 0.2, 0.3]), None),
        (grasp_of([0.1, 0.2, 0.3], stddev=None), DOWN),
        (grasp_of([0.1, 0.2, 0.3], stddev=np.full(3, np.nan)), DOWN),
        (grasp_of([0.1, 0.2, 0.3], held=0.1), DOWN),
    ],
)
def test_without_posture_deviations_or_a_held_object_forces_stay_as_they_are(grasp, posture):
    assert Payload().update(grasp, 0.0, posture) is grasp


def test_an_image_of_before_stays_as_it_is_and_a_release_forgets():
    payload = Payload()
    payload.update(grasp_of([0.0, 0.0, 0.0]), 1.0, DOWN)
    late = grasp_of([0.5, 0.0, 0.0])
    assert payload.update(late, 1.0, DOWN) is late
    assert np.isfinite(payload.stddev)
    payload.update(grasp_of([0.0, 0.0, 0.0], held=0.0), 2.0, DOWN)
    assert payload.stddev == np.inf


def test_hours_of_images_with_deviations_from_next_to_nothing_to_large_stay_finite():
    payload, random = Payload(), np.random.default_rng(0)
    for k in range(3000):
        gravity = random.normal(size=3)
        stddev = 10.0 ** random.uniform(-9.0, 2.0, size=3)
        grasp = grasp_of(random.normal(size=3), held=random.uniform(0.3, 50.0), stddev=stddev)
        told = payload.update(
            grasp, k * 10.0 ** random.uniform(0.0, 0.5), WristPosture(gravity / np.linalg.norm(gravity))
        )
        assert np.isfinite(told.manipulation).all() and np.isfinite(told.stddev).all() and (told.stddev > 0.0).all()
