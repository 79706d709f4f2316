"""Friction between an object and the finger, beside an independent program that knows it.

data/rubbed_bench.npz holds key points [mm] and forces [N] of CalculiX 2.20 for a cylinder of 25 mm pressed 8 mm deep
and back with a coefficient of friction of 0.3, of the bench finger of Mooney-Rivlin;
data/pressed_bench_mooney.npz the same without friction.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from estimator_fakes import BENCH, PERIOD, box, circle, contact_with
from scipy.interpolate import interp1d

from finforce_ifea.contact_mechanics.friction import Coefficient, Traction, constant_traction
from finforce_ifea.contact_mechanics.indenter import OutlineIndenter, RoundIndenter
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.filter.readout import find_held_ratio
from finforce_ifea.jaw.calibration import Calibration, load_calibration
from finforce_ifea.observation import Observation
from finforce_ifea.settings import EstimatorSettings

FOLDER = Path(__file__).parents[1] / "data"
RUBBED, SMOOTH = np.load(FOLDER / "rubbed_bench.npz"), np.load(FOLDER / "pressed_bench_mooney.npz")
HEIGHTS = {"lower": 0.020, "middle": 0.040, "upper": 0.060}
FACE = BENCH.inner_face_x


def drag(coefficient, *, shift=0.0, moved=0.0, before=0.0):
    """Forces (5, 3) [N] on points of a flat face that a block presses along -x with 1 N each.

    The points have moved along z by `shift` [m] since they stood by the block at rest, which has `moved` itself, and
    bore a shear `before` [N].
    """
    rest = np.zeros((5, 3))
    rest[:, 2] = 1e-3 * np.arange(5)
    traction = Traction(0.0, np.full(5, coefficient), np.full(5, before), rest, np.array([0.0, moved]))
    block, x = OutlineIndenter(box(0.02, 0.02)), np.array([1.1e-4, 0.0, moved])
    return block.press(rest + [0.0, 0.0, shift], np.full(5, 1e4), 0.0, x, traction).forces


class TestCone:
    def test_a_point_that_is_dragged_pulls_back_until_it_slides(self):
        np.testing.assert_allclose(drag(0.5, shift=20e-6), np.tile([-1.0, 0.0, -0.2], (5, 1)), atol=1e-9)
        np.testing.assert_allclose(drag(0.5, shift=1e-3)[:, 2], -0.5)

    def test_an_object_that_is_dragged_takes_the_points_along(self):
        np.testing.assert_allclose(drag(0.5, moved=20e-6)[:, 2], 0.2, atol=1e-9)

    def test_the_way_back_begins_where_the_way_there_ended(self):
        np.testing.assert_allclose(drag(0.5, shift=50e-6, before=0.5)[:, 2], 0.0, atol=1e-9)

    def test_without_friction_nothing_acts_along_the_face(self):
        np.testing.assert_allclose(drag(0.0, shift=1e-3), np.tile([-1.0, 0.0, 0.0], (5, 1)), atol=1e-9)

    @pytest.mark.parametrize("ratio", [0.0, 0.4, -0.3])
    def test_changes_at_a_constant_traction_ratio_are_derivatives(self, ratio):
        points = np.stack([np.full(40, 0.0145), np.zeros(40), np.linspace(0.035, 0.045, 40)], axis=1)
        stiffness = np.full(40, 1e4)

        def press(depth=1e-3, height=0.04, turn=0.0, shift=(0.0, 0.0, 0.0)):
            moved = points + shift
            x = np.array([depth, 0.0125, height])
            return RoundIndenter().press(moved, stiffness, 0.014, x, constant_traction(ratio + turn))

        there, step = press(), 1e-8
        by_depth = (press(depth=1e-3 + step).forces - press(depth=1e-3 - step).forces) / (2 * step)
        by_height = (press(height=0.04 + step).forces - press(height=0.04 - step).forces) / (2 * step)
        by_ratio = (press(turn=1e-6).forces - press(turn=-1e-6).forces) / 2e-6
        for column, change in ((0, by_depth), (2, by_height), (3, by_ratio)):
            np.testing.assert_allclose(there.changes[:, :, column], change, atol=1e-3 * np.abs(change).max())
        for axis in (0, 2):
            move = step * np.eye(3)[axis]
            change = (press(shift=-move).forces - press(shift=move).forces) / (2 * step)
            np.testing.assert_allclose(there.springs[:, :, axis], change, atol=1e-3 * np.abs(change).max())


def play(truth, place, seed=0, **settings):
    """Solutions of a finger that is loaded to 8 mm and back twice at 2 mm/s, with true forces (n, 3) [N]."""
    depths = np.r_[0.0, truth[f"25_{place}_depth"]]
    moved = 1e-3 * (truth[f"25_{place}_keypoints"] - truth["keypoints0"])
    moved, forces = np.concatenate([0 * moved[:1], moved]), np.r_[np.zeros((1, 3)), truth[f"25_{place}_force"]]
    if depths[-1] > 9.0:  # the way there alone: it is the way back, too
        keep = depths <= 8.0
        depths, moved, forces = depths[keep], moved[keep], forces[keep]
        depths, moved, forces = (np.concatenate([part, part[-2::-1]]) for part in (depths, moved, forces))
    else:
        depths, moved, forces = (np.concatenate([part, 0 * part[:1]]) for part in (depths, moved, forces))
    way = np.r_[0.0, np.cumsum(np.abs(np.diff(depths)))]
    cycle = np.arange(0.0, way[-1], 2.0 * PERIOD)
    held = np.sort(np.concatenate([cycle, *(np.full(45, level) for level in (2.0, 5.0, 8.0, 11.0, 14.0))]))
    course = np.concatenate([np.zeros(75), held, held])
    points, true = interp1d(way, moved, axis=0)(course), interp1d(way, forces, axis=0)(course)
    random = np.random.default_rng(seed)
    estimator = ForceEstimator(BENCH, calibration=CALIBRATION, settings=EstimatorSettings(**settings))
    contact, offsets = contact_with(circle(0.0125), HEIGHTS[place]), 0.3e-3 * random.standard_normal((15, 3))
    solutions = []
    for number, point in enumerate(points):
        seen = BENCH.keypoints + point + offsets + 0.2e-3 * random.standard_normal((15, 3))
        solutions.append(
            estimator.update(Observation(stamp=PERIOD * number, points=seen, likelihood=np.ones(15)), contact)
        )
    return solutions, true, estimator


# Without relaxation: the truth here is quasi-static.
CALIBRATION = Calibration(**{**load_calibration("bench").__dict__, "relaxation": ()})


@cache
def played(rubs, place):
    return play(RUBBED if rubs else SMOOTH, place)


class TestCoefficient:
    @pytest.mark.parametrize(
        ("place", "low", "high"), [("lower", 0.15, 0.35), ("middle", 0.2, 0.42), ("upper", 0.15, 0.38)]
    )
    def test_loops_tell_a_rough_object(self, place, low, high):
        _, _, estimator = played(True, place)
        assert low < estimator.friction.mean < high

    @pytest.mark.parametrize("place", HEIGHTS)
    def test_loops_tell_a_smooth_object(self, place):
        _, _, estimator = played(False, place)
        assert estimator.friction.mean < 0.03

    @pytest.mark.parametrize("place", HEIGHTS)
    def test_the_second_loop_has_the_force_along_the_finger(self, place):
        """At most three fifths of the error that is left without friction."""
        solutions, true, _ = played(True, place)
        half = len(true) // 2 + 40
        error = np.array([s.force for s in solutions[half:]]) - true[half:]
        blind, _, _ = play(RUBBED, place, friction=0.0, friction_stddev=1e-3)
        without = np.array([s.force for s in blind[half:]]) - true[half:]
        assert np.sqrt((error**2).sum(1).mean()) < 0.6 * np.sqrt((without**2).sum(1).mean())

    @pytest.mark.parametrize(("rubs", "place"), [(True, "middle"), (True, "upper"), (False, "lower"), (False, "upper")])
    def test_deviations_hold_on_every_axis(self, rubs, place):
        solutions, true, _ = played(rubs, place)
        known = [(s, f) for s, f in zip(solutions, true, strict=True) if s.status == "ok"]
        error = np.array([s.force - f for s, f in known]) / np.array([s.force_stddev for s, _ in known])
        assert (np.abs(error[:, ::2]) < 3.0).mean(axis=0).min() > 0.98

    def test_a_coefficient_that_is_told_goes_before_what_the_settings_expect(self):
        estimator = ForceEstimator(BENCH, calibration=CALIBRATION)
        estimator.expect_friction(Coefficient(0.6, 0.05))
        assert estimator.friction == pytest.approx((0.6, 0.05))
        assert estimator.friction_source == "stated"
        estimator.expect_friction(None)
        assert estimator.friction_source == "expected"
        assert estimator.friction.mean == pytest.approx(estimator.settings.friction, abs=0.05)

    def test_another_object_begins_anew(self):
        _, _, estimator = play(RUBBED, "middle")
        learnt, first = estimator.friction, ForceEstimator(BENCH, calibration=CALIBRATION).friction
        assert learnt.stddev < 0.5 * first.stddev
        assert estimator.friction_source == "learned"
        estimator.reset()
        assert estimator.friction == learnt
        estimator.forget()
        assert estimator.friction == first


@pytest.mark.parametrize(("name", "value"), [("friction", -0.1), ("friction", 2.5), ("friction_stddev", 0.0)])
def test_coefficients_that_are_none_are_refused(name, value):
    with pytest.raises(Exception, match=f"{name}.*expected"):
        EstimatorSettings(**{name: value})


class TestHeld:
    @pytest.mark.parametrize("ratio", [0.0, 0.3, -0.2])
    def test_the_upright_ratio_takes_up_what_the_faces_are_inclined(self, ratio):
        normal = np.array([-5.0, 0.0, -1.0])
        force = np.array([normal[0] + ratio * normal[2], 0.0, normal[2] - ratio * normal[0]])
        upright, _ = find_held_ratio(force, ratio, 0.0)
        assert upright == pytest.approx(0.2)
        assert normal[2] - upright * normal[0] == pytest.approx(0.0)

    def test_friction_has_its_bounds(self):
        assert find_held_ratio(np.array([-1.0, 0.0, -5.0]), 0.0, 0.0)[0] == 0.9
        assert find_held_ratio(np.zeros(3), 0.0, 0.5) == (0.0, 0.0)

    def test_what_the_jaws_hold_has_no_force_along_them(self):
        free, _, _ = played(False, "lower")
        held, _, estimator = play(SMOOTH, "lower", held="yes")
        pressed = [number for number, s in enumerate(free) if s.status == "ok" and abs(s.force[0]) > 2.0]
        assert max(abs(free[number].force[2]) for number in pressed) > 1.0
        settled = [number for number in pressed if np.linalg.norm(held[number].force) > 2.0]
        along = np.array([held[number].force[2] for number in settled])
        assert np.sqrt(np.mean(along**2)) < 0.15
        # of a weight, of which nothing is known, a part of the normal force in any direction
        share = np.array([held[number].force_stddev[2] / np.linalg.norm(held[number].force) for number in settled])
        assert 0.15 < np.median(share) < 0.25
        assert estimator.friction.stddev == np.inf  # it tells nothing
