"""The filter of a contact: its algebra beside the textbook's, its friction beside an independent program's.

data/rubbed_bench.npz holds key points [mm] and forces [N] of CalculiX 2.20 for a cylinder of 25 mm pressed 8 mm deep
and back with a coefficient of friction of 0.3.
"""

import itertools
from functools import cache
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from estimator_fakes import BENCH, PERIOD, box, circle, contact_with

from finforce.kalman import MotionNoise, Track
from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, Coefficient, constant_traction
from finforce_ifea.contact_mechanics.indenter import OutlineIndenter, RoundIndenter
from finforce_ifea.contact_mechanics.pressed_jaw import limit_step
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.filter.filter import expect_innovations, innovate, reduce_covariance, update
from finforce_ifea.filter.friction_path import NODES, TractionHypotheses, find_held, preview
from finforce_ifea.filter.image_update import _follow_scatter
from finforce_ifea.filter.jump import BUMPED, MISPLACED, NUDGED, watch, watch_for, weigh_jump
from finforce_ifea.filter.measurement import (
    FREEDOM,
    NO_WEIGHT,
    DetectorErrors,
    Measurement,
    measure_distances,
    observe,
    summarize_detector_errors,
    weigh,
)
from finforce_ifea.filter.process import CAMERA_TIME, FREE_DEPTH, Expectation, expect_state, find_decay, predict
from finforce_ifea.filter.readout import find_held_ratio, spread_common
from finforce_ifea.filter.slip_path import PathState, SlipPath, turn_path
from finforce_ifea.filter.state import CAMERA_TURN, CAMERA_X, CAMERA_Z, DEPTH, SHARED, TRACTION, state_size
from finforce_ifea.jaw.calibration import Calibration, load_calibration
from finforce_ifea.mechanics import build_chosen
from finforce_ifea.observation import Observation
from finforce_ifea.settings import EstimatorSettings
from finforce_ifea.tracking.contact_state import KEYPOINT
from lab.presses import rub_jaw

RUBBED = np.load(Path(__file__).parents[1] / "data" / "rubbed_bench.npz")
HEIGHTS = {"lower": 0.020, "middle": 0.040, "upper": 0.060}
COUNT = 4
SIZE = state_size(COUNT)


@cache
def mechanics():
    return build_chosen(load_calibration("bench").apply(BENCH), EstimatorSettings())


def draw(seed=0, rho=0.0):
    """A random measurement of three of four key points, H in full, P, and means of two hypotheses.

    The noise of the first two correlates by rho.
    """
    random, rows = np.random.default_rng(seed), np.array([0, 1, 2, 3, 6, 7])
    H, u = random.standard_normal((6, SHARED)), np.repeat(random.uniform(0.0, 1.0, 3), 2)
    full = np.zeros((6, SIZE))
    full[:, :SHARED] = H
    for row, entry in enumerate(rows):
        full[row, SHARED + entry] = 1.0
        full[row, SHARED + 2 * COUNT + entry] = u[row]
    root = random.standard_normal((SIZE, SIZE))
    R = np.stack([each @ each.T + 0.1 * np.eye(2) for each in random.standard_normal((3, 2, 2))])
    cross, roots = np.zeros((6, 6)), np.linalg.cholesky(R)
    cross[:2, 2:4] = rho * roots[0] @ roots[1].T
    measured = Measurement(H, rows, u, random.standard_normal(6), R, np.zeros(3), cross + cross.T)
    return measured, full, root @ root.T, random.standard_normal((2, SIZE))


def block(R):
    """A matrix of blocks (m, 2, 2) on the diagonal."""
    out = np.zeros((2 * len(R), 2 * len(R)))
    for k, each in enumerate(R):
        out[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = each
    return out


class TestUpdate:
    @pytest.mark.parametrize("rho", [0.0, 0.8])
    def test_it_is_the_textbooks(self, rho):
        measured, full, P, x = draw(rho=rho)
        R = block(measured.R) + measured.cross
        S, ratios = full @ P @ full.T + R, np.array([-0.2, 0.3])
        K = P @ full.T @ np.linalg.inv(S)
        nu = measured.z - x @ full.T - np.outer(ratios, measured.H[:, TRACTION])
        np.testing.assert_allclose(expect_innovations(measured, ratios, x), nu, rtol=1e-9)
        prior = innovate(measured, P)
        post = update(measured, np.ones(3), ratios, x, np.log([0.3, 0.7]), *prior)
        np.testing.assert_allclose(post.x, x + nu @ K.T, rtol=1e-8)
        np.testing.assert_allclose(reduce_covariance(P, post.A), P - K @ S @ K.T, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(post.L @ post.L.T, S, rtol=1e-9)
        np.testing.assert_allclose(post.own, (K @ R @ K.T)[:4, :4], rtol=1e-7, atol=1e-10)
        likelihoods = np.array([0.3, 0.7]) * np.exp(-0.5 * np.einsum("ia,ab,ib->i", nu, np.linalg.inv(S), nu))
        likelihoods = np.maximum(likelihoods / likelihoods.sum(), np.exp(-9.0))
        np.testing.assert_allclose(np.exp(post.log_weights), likelihoods / likelihoods.sum(), rtol=1e-6)

    def test_the_innovation_has_the_covariance_of_prediction_and_noise(self):
        measured, full, P, _ = draw(1)
        HP, S = innovate(measured, P)
        np.testing.assert_allclose(HP, full @ P, rtol=1e-10)
        np.testing.assert_allclose(S, full @ P @ full.T + block(measured.R), rtol=1e-10)


def test_neighbours_share_their_noise_as_far_as_the_tare_has_seen():
    points = np.zeros(COUNT, KEYPOINT)
    random, correlation = np.random.default_rng(0), 0.5 ** np.abs(np.subtract.outer(np.arange(COUNT), np.arange(COUNT)))
    points["tare_noise"] = [each @ each.T + 0.1 * np.eye(2) for each in random.standard_normal((COUNT, 2, 2))]
    points["noise_ratio"], points["width_variance"], seen = [1.0, 1.0, 0.5, 1.0], 1.0, np.array([0, 2, 3])
    motions = np.zeros((COUNT, 3, 4))
    measured = observe((points, seen, 2.0, correlation), np.zeros((COUNT, 3)), motions, np.zeros(3), 0.0)
    roots = np.linalg.cholesky(2.0 * points["tare_noise"] / points["noise_ratio"][:, None, None])[seen]
    for k, j in product(range(3), repeat=2):
        expected = correlation[seen[k], seen[j]] * roots[k] @ roots[j].T
        found = measured.cross[2 * k : 2 * k + 2, 2 * j : 2 * j + 2]
        np.testing.assert_allclose(measured.R[k] if k == j else found, expected, atol=1e-12)
        assert k != j or not found.any()
    assert np.linalg.eigvalsh(block(measured.R) + measured.cross).min() > 0.0


EXPECTED = Expectation(np.ones(2), np.full(2, 4.0), 0.01, 0.04, np.ones(4), CAMERA_TIME)


def test_what_all_key_points_err_by_alike_is_told_as_far_as_it_moves_the_state():
    measured, full, P, x = draw()
    prior, variances = innovate(measured, P), np.array([0.1, 0.2, 0.3])
    before = update(measured, np.ones(3), np.zeros(2), x, np.log([0.5, 0.5]), *prior)
    expected = np.zeros((4, 4))
    for variance, entry in zip(variances, (CAMERA_X, CAMERA_Z, CAMERA_TURN), strict=True):
        off = measured._replace(z=measured.z + measured.H[:, entry])
        moved = (update(off, np.ones(3), np.zeros(2), x, np.log([0.5, 0.5]), *prior).x - before.x)[0, :4]
        expected += variance * np.outer(moved, moved)
    found = spread_common(measured.H, before.A, before.L, variances)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-12)


class TestProcess:
    def test_errors_of_a_detector_that_last_may_look_like_traction(self):
        search = ForceEstimator(BENCH)._tracker._search
        usual = search._expect().apparent_variance
        search.points["detector_variance"], search.points["offset_variance"] = (0.2e-3) ** 2, (0.4e-3) ** 2
        search._detector_errors = DetectorErrors(*summarize_detector_errors(search.points))
        assert search._detector_errors.share == pytest.approx(0.25)
        assert search._expect().apparent_variance == pytest.approx(usual + 0.2**2)

    def test_a_prior_counts_once_and_for_ever(self):
        m, V = expect_state(EXPECTED, np.full(COUNT, 1e-8), np.zeros(COUNT))
        x, P = np.zeros((2, SIZE)), np.diag(V)
        for _ in range(50):
            predict(x, P, find_decay(np.zeros(COUNT), 100.0, 0.1, CAMERA_TIME), m, V, np.ones(SIZE))
        np.testing.assert_allclose(x[:, 1:], np.tile(m[1:], (2, 1)), atol=1e-9)
        np.testing.assert_allclose(np.diag(P)[1:], V[1:], rtol=1e-9)
        assert P[DEPTH, DEPTH] == FREE_DEPTH**2

    def test_nothing_changes_in_no_time_without_motion_but_the_depth(self):
        m, V = expect_state(EXPECTED, np.full(COUNT, 1e-8), np.zeros(COUNT))
        x, P = np.random.default_rng(0).standard_normal((2, SIZE)), 0.5 * np.diag(V)
        before = x.copy()
        predict(x, P, find_decay(np.zeros(COUNT), 0.0, 0.0, CAMERA_TIME), m, V, np.ones(SIZE))
        np.testing.assert_allclose(x, before, rtol=1e-12)
        np.testing.assert_allclose(np.diag(P)[1:], 0.5 * V[1:])


class TestJump:
    @pytest.mark.parametrize("jump", [BUMPED, MISPLACED], ids=["bumped", "misplaced"])
    def test_it_is_told_where_the_innovation_is_beyond_chance_alone(self, jump):
        information = np.diag(100.0 / jump.stddev**2)
        score = information @ (0.1 * jump.stddev)
        assert weigh_jump(jump, information, score) < 0.0
        assert weigh_jump(jump, information, 10.0 * score) > 0.0

    def test_errors_that_are_alike_tell_less_of_one(self):
        """Three key points whose errors correlate by 0.2 tell of what moves all of them as 3 / 1.4 do."""
        measured, _, P, x = draw()
        HP, S = innovate(measured, P)
        posterior = update(measured, np.ones(3), np.zeros(2), x, np.log([0.5, 0.5]), HP, S)
        told = {}
        for sight in (0.0, 1.0):
            watched = watch_for(NUDGED, SIZE)
            watch(watched, measured, posterior, sight, np.zeros(3))
            told[sight] = np.r_[watched.information.ravel(), watched.score]
        assert told[0.0].any()
        np.testing.assert_allclose(told[1.0], told[0.0] / 1.4)

    def test_what_a_detector_errs_by_in_all_key_points_is_no_bump_however_long_it_lasts(self):
        measured, _, P, x = draw()
        HP, S = innovate(measured, P)
        posterior, seen = update(measured, np.ones(3), np.zeros(2), x, np.log([0.5, 0.5]), HP, S), {}
        for share in (0.0, 0.2):
            watched = watch_for(NUDGED, SIZE)
            watched.information[:] = np.diag(1e6 / NUDGED.stddev**2)
            watched.score[:] = watched.information @ (0.3 * NUDGED.stddev)
            seen[share] = watch(watched, measured, posterior, 1.0, (share * NUDGED.stddev) ** 2)
        assert seen[0.0] and not seen[0.2]


def learn_scatter(depths, R=1e-10):
    """The mean variance over R that depths (n,) [m] show."""
    scatter, seen = 1.0, []
    for i in range(2, len(depths)):
        scatter = _follow_scatter(scatter, depths[i - 2 : i], depths[i], scatter * R)
        seen.append(scatter)
    return np.mean(seen[100:])


class TestScatter:
    @pytest.mark.parametrize("size", [1.0, 2.0, 3.0])
    def test_depths_that_scatter_more_than_their_noise_tells_are_believed_less(self, size):
        noise = 1e-5 * np.random.default_rng(0).standard_normal(3000)
        assert 0.7 * size**2 < learn_scatter(1e-3 + size * noise) < 1.4 * size**2

    def test_an_object_that_moves_is_no_noise(self):
        noise, steps = 1e-5 * np.random.default_rng(0).standard_normal((2, 3000))
        assert learn_scatter(1e-4 * np.arange(3000) + noise) < 1.4
        assert learn_scatter(np.cumsum(5.0 * steps) + noise) < 4.0  # a random walk, of 25 R in each image

    def test_a_jump_is_no_noise(self):
        assert _follow_scatter(2.0, np.array([1e-3, 1e-3]), 3e-3, 1e-10) == 2.0

    @pytest.mark.parametrize("before", [[np.nan, np.nan], [np.nan, 1e-3]])
    def test_the_first_depths_tell_nothing(self, before):
        assert _follow_scatter(2.0, np.array(before), 1e-3, 1e-10) == 2.0


class TestWeights:
    def test_a_gross_error_has_no_weight_and_chance_has_all(self):
        noise, square = np.tile((0.2e-3) ** 2 * np.eye(2), (2, 1, 1)), np.zeros(2)
        weights = weigh(measure_distances(np.array([[0.2e-3, 0.0], [10e-3, 0.0]]), noise, square))
        assert weights[0] == 1.0
        assert weights[1] == NO_WEIGHT

    def test_between_them_it_is_that_of_students_t(self):
        noise, square = np.tile((0.2e-3) ** 2 * np.eye(2), (1, 1, 1)), np.zeros(1)
        weights = weigh(measure_distances(np.array([[1e-3, 0.0]]), noise, square))
        assert weights[0] == pytest.approx((FREEDOM + 3.0) / (FREEDOM + 25.0))


def press(contact, x, ratio, q):
    """Equilibrium in a state (3,) at a traction ratio: unknowns and linearisation."""
    for _ in range(60):
        pressed = contact.linearize(q, x, constant_traction(ratio))
        if not pressed.touches:
            q = q + contact.approach(q, pressed.correction, x)
            continue
        q = q + limit_step(contact.model, pressed.correction)
        if pressed.size < 1e-4:
            break
    return q, contact.linearize(q, x, constant_traction(ratio))


def incline(force):
    """Angle of a force off -x [degrees], positive towards the base."""
    return float(np.degrees(np.arctan2(-force[..., 2], -force[..., 0])))


class TestSlipPath:
    @pytest.mark.parametrize("name", HEIGHTS)
    def test_the_force_leans_as_in_the_independent_program_there_and_back(self, name):
        contact, height = mechanics().contact, HEIGHTS[name]
        contact.set_indenter(RoundIndenter())
        path, q, before, errors = SlipPath(np.array([0.3])), contact.begin(height), 0.02e-3, []
        depths, forces = 1e-3 * RUBBED[f"25_{name}_depth"], RUBBED[f"25_{name}_force"]
        for depth, force in zip(depths, forces, strict=True):
            for at in np.linspace(before, depth, max(2, round(abs(depth - before) / 0.1e-3) + 1))[1:]:
                x = np.array([at, 12.5e-3, height])
                q, _ = press(contact, x, path.ratios[0], q)
                path.move(contact, q, x, np.array([[at - before, 0.0]]))
                before = at
            q, pressed = press(contact, x, path.ratios[0], q)
            if depth >= 4e-3:
                errors.append(incline(pressed.force) - incline(force))
        assert np.sqrt(np.mean(np.square(errors))) < 4.0  # of a cone of 33 degrees
        contact.set_indenter(RoundIndenter())

    @pytest.mark.parametrize("name", HEIGHTS)
    def test_a_contact_begins_by_sticking_wherever_it_is_seen_first(self, name):
        contact, height = mechanics().contact, HEIGHTS[name]
        contact.set_indenter(RoundIndenter())
        states = [np.array([depth, 12.5e-3, height]) for depth in np.linspace(0.02e-3, 0.2e-3, 6)]
        for coefficient in (0.3, 0.9):
            q, pressed = rub_jaw(contact, states, coefficient)[-1]
            smooth = contact.linearize(q, states[-1]).force
            leans = np.tan(np.radians(incline(smooth) - incline(pressed.force)))
            seen = SlipPath(np.array([coefficient]))
            seen.measure(contact, q, states[-1])
            assert seen.ratios[0] == pytest.approx(leans, abs=0.1)

    @pytest.mark.parametrize("height", [0.040, 0.058])
    def test_the_edges_of_a_box_stick_and_slide_by_themselves(self, height):
        contact, coefficient = mechanics().contact, 0.7
        contact.set_indenter(OutlineIndenter(box(0.015, 0.015)))
        turns = ((0.0, 4e-3), (4e-3, 2.5e-3), (2.5e-3, 5e-3))
        depths = np.concatenate([np.linspace(a, b, round(abs(b - a) / 0.1e-3) + 1)[1:] for a, b in turns])
        states = [np.array([contact.find_touch(np.array([0.0, 0.0, height])) + d, 0.0, height]) for d in depths]
        path, errors = SlipPath(np.array([coefficient])), []
        path.measure(contact, rub_jaw(contact, states[:1], coefficient)[0][0], states[0])
        for before, x, (q, pressed) in zip(states, states[1:], rub_jaw(contact, states, coefficient)[1:], strict=False):
            path.move(contact, q, x, np.array([[x[0] - before[0], 0.0]]))
            pressure = contact.press(contact.place_points(q), x, FRICTIONLESS).forces.sum(0)
            leans = np.tan(np.radians(incline(pressure) - incline(pressed.force)))
            errors.append((path.ratios[0] - leans) if x[0] - states[0][0] > 0.5e-3 else 0.0)
        assert np.sqrt(np.mean(np.square(errors))) < 0.12  # one ratio for both edges is 0.2 off
        contact.set_indenter(RoundIndenter())

    def test_a_part_that_is_elsewhere_begins_anew_and_one_that_stays_goes_on(self):
        contact, path = mechanics().contact, SlipPath(np.array([0.5]))
        contact.set_indenter(OutlineIndenter(box(0.015, 0.015)))
        q, x = contact.begin(0.040), np.array([0.0, 0.0, 0.040])
        for depth in (0.5e-3, 1e-3, 1.5e-3, 2e-3):
            x[0] = contact.find_touch(x) + depth
            q, _ = press(contact, x, 0.0, q)
        path.measure(contact, q, x)
        begun = path.parts.copy()
        path.resume(PathState(np.array([[0.11, 0.22]]), path.state.heights))
        np.testing.assert_array_equal(path.parts, [[0.11, 0.22]])
        upper = path.state.heights[1]
        path.resume(PathState(np.array([[0.33, 0.0]]), np.array([upper, np.inf])))  # it was the only one
        np.testing.assert_array_equal(path.parts, [[begun[0, 0], 0.33]])
        contact.set_indenter(RoundIndenter())

    def test_a_look_ahead_is_where_the_path_will_be(self):
        contact, path = mechanics().contact, SlipPath(np.array([0.3, 0.9]))
        contact.set_indenter(RoundIndenter())
        q = contact.begin(0.040)
        for depth in (0.5e-3, 1e-3, 1.5e-3, 2e-3):
            x = np.array([depth, 12.5e-3, 0.040])
            q, _ = press(contact, x, 0.0, q)
        path.measure(contact, q, x)
        path.parts[:] = -0.2
        motion = np.full((2, 2), [0.2e-3, 0.0])
        ahead, before = turn_path(path.parts, path.coefficients, path.rates, motion) @ path.shares, path.ratios
        path.move(contact, q, x, motion)
        np.testing.assert_allclose(path.ratios, ahead)
        assert (ahead > before).any()

    def test_the_ratio_never_leaves_the_cone(self):
        contact, path = mechanics().contact, SlipPath(np.array([0.1, 0.3, 0.5]))
        contact.set_indenter(RoundIndenter())
        q = contact.begin(0.040)
        for depth in (0.5e-3, 1e-3, 2e-3, 3e-3):
            x = np.array([depth, 12.5e-3, 0.040])
            q, _ = press(contact, x, 0.0, q)
        path.move(contact, q, x, np.tile([5e-3, 0.0], (3, 1)))
        np.testing.assert_allclose(path.ratios, [0.1, 0.3, 0.5])
        path.move(contact, q, x, np.tile([-0.1e-3, 0.0], (3, 1)))
        assert (path.ratios < [0.1, 0.3, 0.5]).all()
        assert (path.ratios > [-0.1, -0.3, -0.5]).all()


class TestHypotheses:
    def test_a_way_back_that_may_be_chance_is_doubted_by_what_it_would_turn(self):
        contact, unknown = mechanics().contact, TractionHypotheses(Coefficient(0.45, 0.25), "no")
        contact.set_indenter(RoundIndenter())
        q, x = contact.begin(0.040), np.array([2e-3, 12.5e-3, 0.040])
        q, _ = press(contact, x, 0.0, q)
        track, weights = Track(MotionNoise(1e-12, 1e-6, 1e-6, 3.0, 1.0), 2e-3, (0.1e-3) ** 2), np.exp(unknown.prior)
        places, there = np.tile([2e-3, 0.040], (NODES, 1)), np.tile(x, (NODES, 1))

        def look(there, shift=0.0):
            return preview(unknown.packed, there, shift, weights, track.state)

        assert look(there)[1] == pytest.approx(0.45, abs=0.05)  # nobody knows which way it sticks
        unknown.follow(contact, q, x, places, track, weights)
        ratios, small = look(there - [0.05e-3, 0.0, 0.0])
        np.testing.assert_array_equal(ratios, unknown.ratios)
        assert 0.0 < small < look(there, -0.1e-3)[1]

    @pytest.mark.parametrize("images", [12, 2])
    @pytest.mark.parametrize("ways", [(2e-3,), (2e-3, 1.4e-3)])
    def test_what_stopped_earlier_than_it_seemed_is_where_it_would_be_without_going_on(self, ways, images):
        contact, results = mechanics().contact, []
        contact.set_indenter(RoundIndenter())
        for beyond in (0.0, 0.1e-3):
            known = TractionHypotheses(Coefficient(0.5, 0.03), "no")
            moving, resting = (SimpleNamespace(variance=each**2, rests=rests) for each, rests in ((4e-5, 0), (1e-5, 1)))
            turns, q = [0.02e-3, *ways], contact.begin(0.040)
            there = turns[-1] + np.sign(turns[-1] - turns[-2]) * beyond
            way = [np.linspace(a, b, 12) for a, b in itertools.pairwise(turns[:-1])]
            way = np.concatenate([*way, np.linspace(turns[-2], there, images), turns[-1:]])
            for i, depth in enumerate(way):
                x = np.array([depth, 12.5e-3, 0.040])
                q, _ = press(contact, x, 0.0, q)
                track = resting if i == len(way) - 1 else moving
                known.follow(contact, q, x, np.array([[depth, 0.040]]), track, np.ones(1))
            results.append(float(known.ratios[0]))
        assert results[1] == pytest.approx(results[0], abs=0.06)

    def test_friction_is_known_as_it_was_stated(self):
        stated = TractionHypotheses(Coefficient(0.5, 0.1), "no")
        mean, stddev = stated.estimate(np.exp(stated.prior))
        assert (mean, stddev) == (pytest.approx(0.5), pytest.approx(0.1, rel=0.1))

    def test_an_object_that_only_the_jaws_hold_tells_of_its_friction_what_it_bears(self):
        either = TractionHypotheses(Coefficient(0.5, 0.2), "either")
        lowest = np.where(either.mu == either.mu.min(), 0.1, 0.0)  # what no traction would mean of any other object
        weights = np.append(lowest, 0.9)
        mean, stddev = either.estimate(weights)
        assert (mean, stddev) == (pytest.approx(0.45, abs=0.01), pytest.approx(0.24, abs=0.03))
        again = np.exp(either.reweigh(np.log(weights + 1e-300)))
        assert again[-1] == pytest.approx(0.5)
        assert again[:-1] @ either.mu / again[:-1].sum() == pytest.approx(mean)
        either.upright = 0.6
        assert either.estimate(np.append(0.0 * lowest, 1.0)).mean > 0.65

    def test_what_friction_cannot_bear_only_something_else_can_hold(self):
        smooth, rough = (TractionHypotheses(Coefficient(mean, 0.03), "either") for mean in (0.0, 0.6))
        held = []
        for each in (smooth, rough):
            each.upright = 0.3
            held.append(float(np.exp(each.bound_held(each.prior)[-1])))
        assert held[0] < 1e-3
        assert held[1] == pytest.approx(0.5, abs=0.01)

    def test_what_is_turned_has_left_behind_what_else_held_it(self):
        either, weights = TractionHypotheses(Coefficient(0.5, 0.2), "either"), []
        for _ in range(3):
            weights.append(either.bound_held(weights[-1] if weights else either.prior))
            either.part(2.7, shows_lifts=False)
        held = [find_held(either.packed, np.exp(each)) for each in weights]
        assert held[0] == pytest.approx(0.5, abs=0.02) and 0.9 < held[1] < held[2] < 0.99
        told, weights = TractionHypotheses(Coefficient(0.5, 0.2), "either"), either.prior
        for parting, expected in ((0.0, 0.018), (4.0, 0.5), (10.0, 0.98)):
            told.part(parting, shows_lifts=True)
            weights = told.bound_held(weights)
            assert find_held(told.packed, np.exp(weights)) == pytest.approx(expected, rel=0.1)
        supported = TractionHypotheses(Coefficient(0.5, 0.2), "no")
        assert find_held(supported.packed, np.ones(NODES) / NODES) == 0.0

    def test_a_held_weight_pulls_along_the_finger(self):
        ahead, ratio = np.array([-2.0, 0.0, 0.3]), 0.1
        upright, slope = find_held_ratio(ahead, ratio, 0.0)
        pulled, _ = find_held_ratio(ahead, ratio, 0.5)
        normal = (ahead[0] - ratio * ahead[2]) / (1.0 + ratio**2)
        base = (ahead[2] + ratio * ahead[0]) / (1.0 + ratio**2)
        assert base - upright * normal == pytest.approx(0.0)
        assert base - pulled * normal == pytest.approx(0.5)
        assert abs(pulled - upright) == pytest.approx(0.5 * slope)

    def test_jaws_alone_need_no_path(self):
        only = TractionHypotheses(Coefficient(0.5, 0.2), "yes")
        assert not only.follows_path
        assert len(only.prior) == len(only.ratios) == 1

    def test_the_weights_of_the_grid_and_the_jaws_add_to_one(self):
        either = TractionHypotheses(Coefficient(0.4, 0.2), "either")
        assert len(either.prior) == NODES + 1
        assert np.exp(either.prior).sum() == pytest.approx(1.0)


# Without relaxation: the truth here is quasi-static.
CALIBRATION = Calibration(**{**load_calibration("bench").__dict__, "relaxation": ()})
NOISE = np.array([0.2e-3, 0.2e-3, 0.45e-3])


def run(name, steps=18, hold=12, shift=None, **settings):
    """Force, deviation and truth along the path of a rubbed cylinder, as (n, 3) each, with the estimator.

    Key points are moved by `shift` [m] once the object is deepest.
    """
    estimator = ForceEstimator(BENCH, settings=EstimatorSettings(**settings), calibration=CALIBRATION)
    random, height, rows, image = np.random.default_rng(5), HEIGHTS[name], [], 0
    rest = 1e-3 * RUBBED["keypoints0"]
    offset = estimator.jaw.keypoints - rest
    depths = np.r_[0.0, 1e-3 * RUBBED[f"25_{name}_depth"][:steps]]
    shapes = np.concatenate([rest[None], 1e-3 * RUBBED[f"25_{name}_keypoints"][:steps]])
    forces = np.concatenate([np.zeros((1, 3)), RUBBED[f"25_{name}_force"][:steps]])
    moved = np.zeros(3)

    contact = contact_with(circle(12.5e-3), height)

    def see(points, truth):
        nonlocal image
        seen = points + offset + NOISE * random.standard_normal(points.shape) + moved
        solution = estimator.update(Observation(stamp=image * PERIOD, points=seen), contact)
        image += 1
        rows.append((solution.force, solution.force_stddev, truth, np.full(3, solution.trusted)))

    for _ in range(60):
        see(rest, np.zeros(3))
    for step in range(1, len(depths)):
        ramp = max(1, round(abs(depths[step] - depths[step - 1]) / 2e-3 / PERIOD))
        for share in np.linspace(0.0, 1.0, ramp + 1)[1:]:
            mix = [(1.0 - share) * each[step - 1] + share * each[step] for each in (shapes, forces)]
            see(*mix)
        if shift is not None and depths[step] == depths.max():
            moved = np.asarray(shift)
        for _ in range(hold):
            see(shapes[step], forces[step])
    force, stddev, truth, trusted = (np.array(each) for each in zip(*rows, strict=True))
    return force, stddev, truth, trusted[:, 0].astype(bool), estimator


class TestFirstGrasp:
    def test_unknown_friction_is_in_the_deviation_of_a_first_loading(self):
        count = int(RUBBED["25_middle_depth"].argmax()) + 1
        force, stddev, truth, trusted, _ = run("middle", count)
        loaded = trusted & (np.linalg.norm(truth, axis=1) > 0.3)
        assert loaded.sum() > 100
        assert (np.abs(force - truth)[loaded][:, [0, 2]] < 3.0 * stddev[loaded][:, [0, 2]]).mean() > 0.98

    def test_a_way_back_tells_the_coefficient(self):
        force, _, truth, trusted, estimator = run("middle")
        assert estimator.friction.mean == pytest.approx(0.3, abs=3.0 * estimator.friction.stddev)
        assert estimator.friction.stddev < 0.15
        back = trusted & (np.arange(len(force)) > len(force) // 2) & (np.linalg.norm(truth, axis=1) > 0.5)
        assert np.sqrt(np.mean((force - truth)[back][:, 2] ** 2)) < 0.3

    def test_stated_friction_leaves_less_uncertain(self):
        count = int(RUBBED["25_middle_depth"].argmax()) + 1
        _, unknown, _, trusted, _ = run("middle", count)
        _, stated, _, _, _ = run("middle", count, friction=0.3, friction_stddev=0.03)
        late = trusted & (np.arange(len(trusted)) > len(trusted) - 20)
        assert stated[late, 2].mean() < 0.7 * unknown[late, 2].mean()


class TestBumpedCamera:
    @pytest.mark.parametrize("size", [0.5, 1.0])
    def test_a_bump_under_load_costs_no_answer_and_no_honesty(self, size):
        count = int(RUBBED["25_middle_depth"].argmax()) + 1
        shift = 1e-3 * size * np.array([0.8, 0.0, -0.6])
        force, stddev, truth, trusted, _ = run(
            "middle", count, hold=45, shift=shift, friction=0.3, friction_stddev=0.05
        )
        after = np.arange(len(force)) >= len(force) - 44
        assert trusted[after].mean() > 0.9
        within = np.abs(force - truth)[after & trusted][:, [0, 2]] < 3.0 * stddev[after & trusted][:, [0, 2]]
        assert within.mean() > 0.9

    def test_a_new_tare_forgets_the_bump(self):
        estimator = ForceEstimator(BENCH)
        random, contact, image = np.random.default_rng(2), contact_with(circle(12.5e-3), 0.040), 0

        def see(shift, count):
            nonlocal image
            for _ in range(count):
                points = BENCH.keypoints + shift + NOISE * random.standard_normal(BENCH.keypoints.shape)
                solution = estimator.update(Observation(stamp=image * PERIOD, points=points), contact)
                image += 1
            return solution

        see(np.zeros(3), 60)
        bump = np.array([2e-3, 0.0, 1e-3])
        see(bump, 60)
        estimator.tare()
        last = see(bump, 10)
        assert np.linalg.norm(last.force) < 3.0 * last.magnitude_stddev + 1e-3
        assert last.magnitude_stddev < 0.1


class TestGarbage:
    @pytest.mark.parametrize("kind", ["scattered", "far away"])
    def test_it_gives_no_force_and_is_forgotten_at_once(self, kind):
        estimator = ForceEstimator(BENCH)
        random, contact = np.random.default_rng(4), contact_with(circle(12.5e-3), 0.040)
        trusted = []
        for image in range(80):
            points = BENCH.keypoints + NOISE * random.standard_normal(BENCH.keypoints.shape)
            if 60 <= image < 70:
                scatter = 5e-3 * random.standard_normal(points.shape)
                points += scatter if kind == "scattered" else np.array([0.0, 0.0, 20e-3])
            trusted.append(estimator.update(Observation(stamp=image * PERIOD, points=points), contact).trusted)
        assert not any(trusted[60:70])
        assert all(trusted[72:])
