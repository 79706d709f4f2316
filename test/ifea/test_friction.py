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

from finforce_ifea.contact_mechanics.friction import Friction, constant_traction
from finforce_ifea.contact_mechanics.indenter import OutlineIndenter, RoundIndenter
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.calibration import Calibration, load_calibration
from finforce_ifea.mechanics import build_chosen
from finforce_ifea.observation import Observation
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.friction import Coefficient, FrictionEstimate, SlipHistory, leave_play
from finforce_ifea.tracking.held_weight import HeldWeight, find_upright_ratio

FOLDER = Path(__file__).parents[1] / "data"
RUBBED, SMOOTH = np.load(FOLDER / "rubbed_bench.npz"), np.load(FOLDER / "pressed_bench_mooney.npz")
HEIGHTS = {"lower": 0.020, "middle": 0.040, "upper": 0.060}
FACE = BENCH.inner_face_x


@cache
def mechanics():
    return build_chosen(load_calibration("bench").apply(BENCH), EstimatorSettings())


class Dragged:
    """Points of a flat face that a block presses along -x with 1 N each and drags along z."""

    def __init__(self, coefficient):
        self.friction = Friction(5, coefficient)
        self.block, self.points = OutlineIndenter(box(0.02, 0.02)), np.zeros((5, 3))
        self.points[:, 2] = 1e-3 * np.arange(5)

    def press(self, shift=0.0, moved=0.0):
        """The contact with the points shifted along z and the object moved."""
        points = self.points + [0.0, 0.0, shift]
        traction, x = self.friction.describe(np.array([0.0, moved])), np.array([1.1e-4, 0.0, moved])
        return points, self.block.press(points, np.full(5, 1e4), 0.0, x, traction)

    def settle(self, shift=0.0):
        """Remember that contact, and how far the cone is used there."""
        points, contact = self.press(shift)
        self.friction.settle(contact.shear, points, np.zeros(2))
        return contact.mobilised


class TestCone:
    def test_a_point_that_is_dragged_pulls_back_until_it_slides(self):
        face = Dragged(0.5)
        assert face.settle() == 0.0
        _, stuck = face.press(20e-6)  # 0.2 N of 0.5
        np.testing.assert_allclose(stuck.forces, np.tile([-1.0, 0.0, -0.2], (5, 1)), atol=1e-9)
        assert stuck.mobilised == pytest.approx(-0.4)
        _, far = face.press(1e-3)
        np.testing.assert_allclose(far.forces[:, 2], -0.5)
        assert far.mobilised == -1.0

    def test_an_object_that_is_dragged_takes_the_points_along(self):
        face = Dragged(0.5)
        face.settle()
        np.testing.assert_allclose(face.press(moved=20e-6)[1].forces[:, 2], 0.2, atol=1e-9)

    def test_the_way_back_begins_where_the_way_there_ended(self):
        face = Dragged(0.5)
        face.settle()
        face.settle(1e-3)
        np.testing.assert_allclose(face.press(0.95e-3)[1].forces[:, 2], 0.0, atol=1e-9)
        face.friction.reset()
        assert face.press()[1].mobilised == 0.0

    def test_without_friction_nothing_acts_along_the_face(self):
        face = Dragged(0.0)
        face.settle()
        np.testing.assert_allclose(face.press(1e-3)[1].forces, np.tile([-1.0, 0.0, 0.0], (5, 1)), atol=1e-9)

    @pytest.mark.parametrize("ratio", [0.0, 0.4, -0.3])
    def test_changes_at_a_constant_traction_ratio_are_derivatives(self, ratio):
        points = np.stack([np.full(40, 0.0145), np.zeros(40), np.linspace(0.035, 0.045, 40)], axis=1)
        stiffness = np.full(40, 1e4)

        def press(depth=1e-3, height=0.04, turn=0.0, shift=(0.0, 0.0, 0.0)):
            moved = points + shift
            x = np.array([depth, np.log(0.0125), height])
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


class TestHistory:
    def test_play_is_made_good_before_anything_moves(self):
        assert leave_play(0.5, 1.0) == 0.0
        assert leave_play(1.5, 1.0) == 0.5
        assert leave_play(-1.5, 1.0) == -0.5

    @pytest.mark.parametrize(
        ("place", "loading", "unloading"), [("lower", 0.02, 0.18), ("middle", 0.02, 0.10), ("upper", 0.08, 0.30)]
    )
    def test_friction_is_used_as_the_independent_program_has_it(self, place, loading, unloading):
        """The share of the cone, from the force's inclination to the normal force of the model; 1 mm is left out."""
        contact, height = mechanics().contact, HEIGHTS[place]
        history, traction = SlipHistory(contact), constant_traction(0.0)
        contact.set_indenter(OutlineIndenter(circle(0.0125)))
        depths, forces = 1e-3 * RUBBED[f"25_{place}_depth"], RUBBED[f"25_{place}_force"]
        q, last, errors = contact.begin(height), 0.0, []
        for depth, force in zip(depths, forces, strict=True):
            for step in np.linspace(last, depth, 1 + int(np.ceil(abs(depth - last) / 0.07e-3)))[1:]:
                here = np.array([step, 0.0, height])
                for _ in range(12):
                    state = contact.linearize(q, here, traction)
                    q = q + (state.correction if state.touches else contact.approach(q, state.correction, here))
                traction = constant_traction(0.3 * history.follow(q, here, 0.0, 0.3))
            last = depth
            errors.append(np.linalg.norm(contact.linearize(q, here, traction).force - force) / np.linalg.norm(force))
        there = np.arange(len(depths)) <= np.argmax(depths)
        assert np.sqrt(np.mean(np.array(errors)[there & (depths > 1.5e-3)] ** 2)) < loading
        assert np.sqrt(np.mean(np.array(errors)[~there & (depths > 1.5e-3)] ** 2)) < unloading


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
CALIBRATED = Coefficient(CALIBRATION.friction, CALIBRATION.friction_stddev)


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
        blind, _, _ = play(RUBBED, place, friction=0.0, friction_stddev=1e-3, smooth_share=1.0)
        without = np.array([s.force for s in blind[half:]]) - true[half:]
        assert np.sqrt((error**2).sum(1).mean()) < 0.6 * np.sqrt((without**2).sum(1).mean())

    @pytest.mark.parametrize(("rubs", "place"), [(True, "middle"), (True, "upper"), (False, "lower"), (False, "upper")])
    def test_deviations_hold_on_every_axis(self, rubs, place):
        solutions, true, _ = played(rubs, place)
        known = [(s, f) for s, f in zip(solutions, true, strict=True) if s.status == "ok"]
        error = np.array([s.force - f for s, f in known]) / np.array([s.force_stddev for s, _ in known])
        assert (np.abs(error[:, ::2]) < 3.0).mean(axis=0).min() > 0.98

    def test_a_coefficient_that_is_told_goes_before_loops(self):
        told = FrictionEstimate(EstimatorSettings(friction=0.6, friction_stddev=0.05, smooth_share=0.0))
        assert told.coefficient == pytest.approx((0.6, 0.05))

    def test_half_knowledge_is_a_mixture(self):
        mixed = FrictionEstimate(EstimatorSettings(friction=0.4, friction_stddev=0.2, smooth_share=0.5))
        assert mixed.coefficient.mean == pytest.approx(0.2)
        assert mixed.coefficient.stddev > 0.2

    def test_objects_of_the_calibration_are_the_smooth_ones(self):
        known = FrictionEstimate(EstimatorSettings(smooth_share=1.0), Coefficient(0.35, 0.03))
        assert known.coefficient == pytest.approx((0.35, 0.03))

    def test_another_object_begins_anew(self):
        _, _, estimator = play(RUBBED, "middle")
        assert estimator.friction.mean > 0.2
        first = FrictionEstimate(estimator.settings, CALIBRATED).coefficient
        estimator.forget()
        assert estimator.friction == first


@pytest.mark.parametrize(
    ("name", "value"), [("friction", -0.1), ("friction", 2.5), ("friction_stddev", 0.0), ("smooth_share", 1.5)]
)
def test_coefficients_that_are_none_are_refused(name, value):
    with pytest.raises(Exception, match=f"{name}.*expected"):
        EstimatorSettings(**{name: value})


class TestHeld:
    @pytest.mark.parametrize("ratio", [0.0, 0.3, -0.2])
    def test_the_upright_ratio_takes_up_what_the_faces_are_inclined(self, ratio):
        normal = np.array([-5.0, 0.0, -1.0])
        force = np.array([normal[0] + ratio * normal[2], 0.0, normal[2] - ratio * normal[0]])
        upright = find_upright_ratio(force, ratio)
        assert upright == pytest.approx(0.2)
        assert normal[2] - upright * normal[0] == pytest.approx(0.0)

    def test_friction_has_its_bounds(self):
        assert find_upright_ratio(np.array([-1.0, 0.0, -5.0]), 0.0) == 0.9
        assert find_upright_ratio(np.zeros(3), 0.0) == 0.0

    def test_what_the_jaws_hold_has_no_force_along_them(self):
        free, _, _ = played(False, "lower")
        held, _, estimator = play(SMOOTH, "lower", held="yes")
        pressed = [number for number, s in enumerate(free) if s.status == "ok" and abs(s.force[0]) > 2.0]
        assert max(abs(free[number].force[2]) for number in pressed) > 1.0
        settled = [number for number in pressed if np.linalg.norm(held[number].force) > 2.0]
        along = np.array([held[number].force[2] for number in settled])
        assert np.sqrt(np.mean(along**2)) < 0.15
        assert estimator.friction == FrictionEstimate(estimator.settings, CALIBRATED).coefficient

    @pytest.mark.parametrize("weight", [0.7, -0.4])
    def test_what_hung_on_the_jaw_is_forgotten_once_it_has_let_go(self, monkeypatch, weight):
        """A grasp is found the same after one in which something pulled along the finger and after one without."""
        depths, moved = SMOOTH["25_lower_depth"], 1e-3 * (SMOOTH["25_lower_keypoints"] - SMOOTH["keypoints0"])
        pressed, way = moved[np.abs(depths - 6.0).argmin()], np.linspace(0.0, 1.0, 30)[:, None, None]
        grasp = np.concatenate([pressed * way, np.tile(pressed, (45, 1, 1)), pressed * way[::-1]])
        points = BENCH.keypoints + np.concatenate([np.zeros((75, 15, 3)), grasp, np.zeros((30, 15, 3)), grasp])
        points += 0.05e-3 * np.random.default_rng(3).standard_normal(points.shape)
        contact, one = contact_with(circle(0.0125), HEIGHTS["lower"]), slice(75 + 60, 75 + 75)
        two = slice(one.start + 135, one.stop + 135)

        def weigh(held, *_):
            held.force = weight

        def find_forces():
            estimator = ForceEstimator(BENCH, calibration=CALIBRATION, settings=EstimatorSettings(held="yes"))
            forces = []
            for number, seen in enumerate(points):
                if number == one.stop:
                    monkeypatch.undo()
                seen = Observation(stamp=PERIOD * number, points=seen, likelihood=np.ones(15))
                forces.append(estimator.update(seen, contact).force)
            return np.array(forces)

        free = find_forces()
        monkeypatch.setattr(HeldWeight, "_compare", weigh)
        pulled = find_forces()
        assert (pulled[one, 2] - free[one, 2]).mean() == pytest.approx(weight, abs=0.1)
        np.testing.assert_allclose(pulled[two], free[two], atol=0.02)
