"""A weight that is lifted after the hold began shows in the force along the finger, and nothing else does."""

import numpy as np
import pytest

from finforce_ifea.tracking.contact_state import KEYPOINT, blank_contact_state
from finforce_ifea.tracking.held_weight import HeldWeight, find_upright_ratio

POINTS, NORMAL = 12, 3.0
PRIOR = np.array([0.02, 0.7e-3]) ** 2
MODES = np.random.default_rng(4).normal(0.0, [[[0.5, 5e-3, 0.3, 3e-3]]], (POINTS, 2, 4))
BY_FORCE = np.random.default_rng(5).normal(0.0, 0.3e-3, (POINTS, 3))  # [m/N]
BY_MOMENT = np.random.default_rng(6).normal(0.0, 0.1, (POINTS, 3))  # [m/(N m)]
DT = 1.0 / 30.0


def frame(weight=0.0, x=(3e-3, 0.0, 0.04), bias=0.0, noise=0.0, hidden=(), ratio=0.0, lateral=0.0, twist=0.0):
    """An image with a weight [N] along and one across, in which a traction ratio is counted.

    Bias and noise (POINTS, 2) are along x and z; a moment [N m] twists the finger.
    """
    seen = BY_FORCE * lateral + BY_MOMENT * twist
    points, state = np.zeros(POINTS, KEYPOINT), blank_contact_state()
    points["r"] = MODES[:, :, 3] * (weight / NORMAL - ratio) + seen[:, ::2] + bias + noise
    points["modes"], points["lateral"] = MODES, seen[:, 1]
    points["weight"] = 1.0
    points["weight"][list(hidden)] = 0.0
    points["noise"], points["lateral_noise"] = 0.1e-3**2 * np.eye(2), 0.1e-3**2
    # a face that is upright where the force has the ratio
    state["pressing"] = NORMAL * np.array([-1.0, 0.0, ratio]) / np.hypot(1.0, ratio)
    state["traction_ratio"], state["x_asked"] = ratio, x
    assert find_upright_ratio(state["pressing"], ratio) == pytest.approx(0.0)
    return points, state


def with_modes(image, modes):
    """The same image of key points that move otherwise."""
    points = image[0].copy()
    points["modes"] = modes
    return points, image[1]


def begin():
    return HeldWeight(10e-3)


def follow(held, images, gravity=None):
    """The forces along the finger [N], image by image, what is known of the lateral force taken off each."""
    forces = []
    for points, state in images:
        points = points.copy()
        points["r"] -= BY_FORCE[:, ::2] * held.lateral
        points["lateral"] -= BY_FORCE[:, 1] * held.lateral
        held.update(points, state, (BY_FORCE, BY_MOMENT), PRIOR, DT, gravity)
        forces.append(held.force)
    return np.array(forces)


def test_what_is_lifted_shows_and_what_was_wrong_before_does_not():
    held, random = begin(), np.random.default_rng(0)
    bias = random.normal(0.0, 0.2e-3, (POINTS, 2))
    noise = random.normal(0.0, 0.05e-3, (200, POINTS, 2))
    before = follow(held, [frame(bias=bias, noise=noise[i]) for i in range(60)])
    assert np.abs(before).max() < 0.1
    lifted = follow(held, [frame(0.8, bias=bias, noise=noise[60 + i]) for i in range(60)])
    assert lifted[-1] == pytest.approx(0.8, abs=0.1)
    assert 0.0 < held.stddev < 0.2


def test_a_lean_that_is_counted_already_is_not_counted_twice():
    held = begin()
    follow(held, [frame() for _ in range(30)])
    assert follow(held, [frame(0.6, ratio=0.15) for _ in range(60)])[-1] == pytest.approx(0.6, abs=0.03)


@pytest.mark.parametrize("gravity", [None, np.array([0.0, 0.0, -1.0])])
def test_what_shows_at_once_as_the_jaws_open_is_no_weight(gravity):
    held, weak = begin(), MODES * [1.0, 1.0, 1.0, 0.05]  # 0.05 mm a newton, as fingers have it
    follow(held, [with_modes(frame(), weak) for _ in range(24)], gravity)
    ways = np.linspace(0.5e-3, 2.4e-3, 4)
    # what moves the points as a weight of 2 N would
    opening = follow(held, [with_modes(frame(0.1, x=(3e-3 - way, 0.0, 0.04)), weak) for way in ways], gravity)
    assert np.abs(opening).max() < 0.2


def test_jaws_that_move_on_keep_the_weight():
    held = begin()
    follow(held, [frame() for _ in range(30)])
    follow(held, [frame(0.6) for _ in range(60)])
    deeper = follow(held, [frame(0.6, x=(7e-3, 0.0, 0.04), bias=0.3e-3) for _ in range(60)])
    assert deeper[-1] == pytest.approx(0.6, abs=0.05)
    set_down = follow(held, [frame(0.0, x=(7e-3, 0.0, 0.04), bias=0.3e-3) for _ in range(60)])
    assert set_down[-1] == pytest.approx(0.0, abs=0.05)


def test_a_weight_that_turns_is_followed_though_it_moves_the_object_from_one_jaw_to_the_other():
    held = begin()
    follow(held, [frame() for _ in range(30)])
    angles = np.linspace(0.0, 4.0 * np.pi, 480)
    depths = 3e-3 + 1e-3 * np.sin(angles)
    turned = follow(held, [frame(0.5 * np.cos(a), x=(d, 0.0, 0.04)) for a, d in zip(angles, depths, strict=True)])
    assert np.abs(turned - 0.5 * np.cos(angles))[30:].max() < 0.05


def test_a_force_across_shows_and_does_not_look_like_one_along():
    held, random = begin(), np.random.default_rng(1)
    noise = random.normal(0.0, 0.03e-3, (90, POINTS, 2))
    follow(held, [frame(noise=noise[i]) for i in range(30)])
    assert held.lateral_stddev == np.inf
    found = follow(held, [frame(0.2, noise=noise[20 + i], lateral=-0.6) for i in range(60)])
    assert held.lateral == pytest.approx(-0.6, abs=0.1)
    assert found[-1] == pytest.approx(0.2, abs=0.1)
    assert 0.0 < held.lateral_stddev < 0.2


def test_what_looks_like_a_weight_along_is_hardly_one_where_gravity_points_across():
    dim = MODES * [1.0, 1.0, 1.0, 0.05]  # a newton along the finger moves key points by hundredths of a millimetre
    blind, told = begin(), begin()
    for held, gravity in ((blind, None), (told, np.array([0.6, 0.8, 0.0]))):
        images = [frame() for _ in range(30)] + [frame(0.05, lateral=0.4) for _ in range(60)]
        follow(held, [with_modes(image, dim) for image in images], gravity)
    assert blind.force == pytest.approx(1.0, abs=0.2)
    assert abs(told.force) < 0.35 and told.stddev < 0.1 < blind.stddev
    assert told.lateral == pytest.approx(0.4, abs=0.05)


@pytest.mark.parametrize("along", [0.8, -0.8])
def test_a_weight_along_that_nobody_sees_follows_from_what_is_seen_across(along):
    held = begin()
    unseen = MODES * [1.0, 1.0, 1.0, 0.0]  # a lean moves nothing
    images = [frame() for _ in range(30)] + [frame(lateral=0.3) for _ in range(60)]
    follow(held, [with_modes(image, unseen) for image in images], np.array([0.0, 0.6, along]))
    assert held.lateral == pytest.approx(0.3, abs=0.05)
    assert held.force == pytest.approx(0.3 * along / 0.6, abs=0.05)
    assert 0.1 < held.stddev < 0.25  # what may act from outside


def test_what_twists_the_finger_is_no_force():
    held = begin()
    follow(held, [frame() for _ in range(30)])
    twisted = follow(held, [frame(0.5, lateral=0.4, twist=2e-3) for _ in range(60)])
    assert twisted[-1] == pytest.approx(0.5, abs=0.05)
    assert held.lateral == pytest.approx(0.4, abs=0.05)


def test_what_was_lifted_and_set_down_again_weighs_nothing():
    held = begin()
    follow(held, [frame() for _ in range(30)])
    follow(held, [frame(0.6, lateral=0.3) for _ in range(40)])
    assert follow(held, [frame() for _ in range(60)])[-1] == pytest.approx(0.0, abs=0.02)
    assert held.lateral == pytest.approx(0.0, abs=0.02)


def test_what_the_mechanics_errs_by_on_the_way_is_no_weight():
    held = begin()
    follow(held, [frame() for _ in range(30)])
    ways = np.linspace(0.0, 1e-3, 60)
    pressed = follow(held, [frame(x=(3e-3 + way, 0.0, 0.04), bias=0.04 * way) for way in ways])
    assert np.abs(pressed).max() < 0.1


def test_points_that_come_into_view_later_say_nothing():
    held = begin()
    new = np.zeros((POINTS, 2))
    new[:3] = 1e-3
    follow(held, [frame(hidden=(0, 1, 2)) for _ in range(30)])
    assert np.abs(follow(held, [frame(noise=new) for _ in range(30)])).max() < 1e-6


def test_too_few_points_leave_the_weight_as_it_was():
    held = begin()
    follow(held, [frame() for _ in range(24)])
    few = follow(held, [frame(0.9, hidden=range(7)) for _ in range(30)])
    assert few[-1] == 0.0
    assert held.stddev == np.inf


def test_an_object_that_slides_is_not_taken_for_a_force_along():
    modes = MODES.copy()
    modes[:, :, 2] = 700.0 * MODES[:, :, 3] / NORMAL  # a millimetre looks like 0.7 N
    rest, drawn = (with_modes(frame(bias=bias), modes) for bias in (0.0, 1e-3 * modes[:, :, 2]))
    held = begin()
    follow(held, [rest] * 30)
    guess = follow(held, [drawn] * 20)[-1]
    assert guess == pytest.approx(0.7, abs=0.1)  # so it looks, until the pose says better
    held.lead(np.array([0.0, 1e-3]))
    assert abs(follow(held, [drawn] * 20)[-1]) < 0.3 * guess


def test_a_weight_stays_what_it_was_while_the_object_slides():
    held = begin()
    follow(held, [frame() for _ in range(30)])
    follow(held, [frame(0.6) for _ in range(40)])
    for step in range(1, 30):
        held.lead(np.array([0.0, 0.4e-3]))
        moved = frame(0.6, x=(3e-3, 0.0, 0.04 + 0.4e-3 * step))
        assert follow(held, [moved])[-1] == pytest.approx(0.6, abs=0.1)
