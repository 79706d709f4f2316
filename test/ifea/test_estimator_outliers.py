"""Claims about gross errors, hidden points, gaps, jumps and garbage in what `ForceEstimator` gets."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_fakes import (
    HELD_5,
    MODELS,
    MODULUS,
    REST,
    STEPS,
    assert_identical,
    errors,
    loaded_frames,
    magnitudes,
    make_estimator,
    pressed,
    ramp,
    record,
    rms,
    run,
    solved,
)
from mechanics_fakes import BENCH

from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.observation import Contact
from finforce_ifea.relaxation import RelaxationTerm

# --- gross errors, hidden points, holes


def misidentify(count, seed=1):
    """Moves `count` random points of a frame by 3 to 20 mm and keeps their likelihood high."""
    random = np.random.default_rng(seed)

    def change(points, likelihood):
        which = random.choice(len(points), count, replace=False)
        away = random.normal(size=(count, 3))
        points[which] += away / np.linalg.norm(away, axis=1, keepdims=True) * random.uniform(3e-3, 20e-3, (count, 1))
        likelihood[which] = 0.95

    return change


def swap(points, likelihood):
    """Confuses the same three points in every frame with their neighbours."""
    points[[2, 8, 12]] = points[[3, 9, 13]]
    likelihood[[2, 8, 12]] = 0.95


@pytest.mark.parametrize(("solver", "height", "bound"), [*((one, 20, 0.05) for one in MODELS), ("frame", 40, 0.015)])
@pytest.mark.parametrize("change", [misidentify(4), swap], ids=["27 %", "the same"])
def test_gross_errors_of_high_likelihood_do_not_move_the_force(change, height, bound, solver):
    recording = pressed(height)
    spoilt = recording.changed(range(REST, len(STEPS)), change)
    solutions, loaded = run(spoilt, solver=solver), loaded_frames(recording)
    moved = (magnitudes(solutions) - magnitudes(solved(height, solver)))[loaded]
    stated = np.array([solution.magnitude_stddev for solution in solutions])[loaded]
    # measured: 0.04 and 0.01 N, and 0.16 and 0.07 N at most in one image
    assert np.isfinite(moved).all()
    assert rms(moved) < bound
    assert np.abs(moved / stated).max() < 3.0


def test_gross_errors_are_not_reported_as_used():
    spoilt = pressed().changed(range(REST, len(STEPS)), swap)
    solution = run(spoilt, solver="frame")[150]
    assert not solution.keypoints_used[[2, 8, 12]].any()
    assert solution.keypoints_used.sum() == 12


def test_points_of_low_likelihood_may_be_anywhere():
    def hide(points, likelihood):
        likelihood[[3, 4, 10]] = 0.3

    def hide_and_move(points, likelihood):
        hide(points, likelihood)
        points[[3, 4, 10]] += [0.005, -0.010, 0.002]

    frames = range(80, len(STEPS))
    first, second = (run(pressed().changed(frames, change), solver="frame") for change in (hide, hide_and_move))
    assert_identical(first, second)
    assert not any(solution.keypoints_used[[3, 4, 10]].any() for solution in second[80:])


def show_now_and_then():
    """A recording whose points 3, 4 and 10 are hidden, and the same where they appear once in twenty images."""
    hidden = pressed().changed(range(70, len(STEPS)), lambda _, likelihood: likelihood.put([3, 4, 10], 0.1))

    def show(points, likelihood):
        points[[3, 4, 10]] = BENCH.keypoints[[3, 4, 10]] + [0.002, 0.003, 0.0]
        likelihood[[3, 4, 10]] = 0.95

    return hidden, hidden.changed(range(85, len(STEPS), 20), show)


def test_points_that_appear_once_in_twenty_frames_count_for_little():
    usual, found = (np.array([each.force for each in run(steps, solver="frame")]) for steps in show_now_and_then())
    assert np.nanmax(np.abs(found - usual)) < 0.01


def test_points_that_appear_once_in_twenty_frames_are_not_believed_at_a_given_contact():
    given = Contact(points=pressed().contact.points, weights=np.ones(1), free=False)
    hidden, flickering = (run(steps, contact=given, solver="frame") for steps in show_now_and_then())
    assert_identical(hidden, flickering)


def test_holes_in_the_depth_image_are_bridged():
    random = np.random.default_rng(4)

    def change(points, _):
        points[random.random(15) < 0.2] = np.nan

    recording = pressed()
    found = errors(recording, run(recording.changed(range(len(STEPS)), change), solver="frame"))
    assert rms(found[loaded_frames(recording)]) < 0.06


def test_one_coordinate_of_a_point_may_be_missing():
    def change(points, _):
        points[5, 2] = np.nan

    solutions = run(pressed().changed(range(len(STEPS)), change), solver="frame")
    assert not any(solution.keypoints_used[5] for solution in solutions)
    assert np.nanmax(np.abs(errors(pressed(), solutions))) < 0.15


# --- gaps and jumps


@pytest.mark.parametrize(
    "hide", [lambda p, _: p.fill(np.nan), lambda _, likelihood: likelihood.fill(0.1)], ids=["nan", "low"]
)
def test_hidden_jaw_gives_no_force(hide):
    solutions = run(pressed().changed(range(100, 130), hide), solver="frame")
    for solution in solutions[100:130]:
        assert solution.status == "not_enough_points"
        assert not solution.trusted
        assert not solution.force.any()
        assert "0 of 15" in solution.message


@pytest.mark.parametrize("solver", MODELS)
@pytest.mark.parametrize(("first", "last"), [(125, 150), (100, 160)])
def test_force_after_a_gap_is_right_or_not_trusted(first, last, solver):
    """Everything is hidden while the object moves on: what comes first afterwards must not be the force of before."""
    recording = pressed().changed(range(first, last), lambda points, _: points.fill(np.nan))
    solutions = run(recording, solver=solver)
    assert recording.depths[last] - recording.depths[first] > 1.5e-3
    after = errors(recording, solutions)[last : last + 10]
    assert np.nanmax(np.abs(after)) < 0.25
    assert solutions[last + 9].trusted


@pytest.mark.parametrize("solver", MODELS)
@pytest.mark.parametrize("height", [20, 40])
def test_jump_of_5_mm_is_followed_within_five_frames(height, solver):
    depths = 1e-3 * np.r_[np.zeros(60), np.full(40, 1.0), np.full(40, 6.0), np.full(40, 1.0)]
    recording = record(depths, height=height)
    solutions = run(recording, solver=solver)
    true = np.linalg.norm(recording.forces, axis=1)
    for jump in (100, 140):
        settled = errors(recording, solutions)[jump + 5 : jump + 35]
        assert np.isfinite(settled).all()
        assert np.abs(settled).max() < 0.10 * true.max()


@pytest.mark.parametrize("seed", range(3))
def test_load_that_came_in_a_pause_is_no_bump_of_the_camera(seed):
    """4 mm next to the base, far from where the jaw was linearised before a pause of ten seconds."""
    recording = record(1e-3 * np.r_[np.zeros(60), np.full(40, 4.0)], height=20, seed=seed, noise=0.3)
    for index, observation in enumerate(recording.observations):
        stddev = np.full(observation.points.shape, 0.25e-3)
        later = replace(observation, stamp=observation.stamp + 10.0 * (index >= 60), stddev=stddev)
        recording.observations[index] = later
    solutions = run(recording)
    assert np.abs(errors(recording, solutions)[62:]).max() < 0.12
    assert max(solution.magnitude_stddev for solution in solutions[62:]) < 0.25


def test_a_force_that_stayed_through_an_interruption_may_have_been_let_go_meanwhile():
    """Grasped again at its end, it has the whole overstress; grasped throughout, none."""
    term = RelaxationTerm(share=0.15, time_constant=5.0)
    calibration = Calibration(young_modulus=MODULUS, force_error=0.02, relaxation=(term,))
    recording, found = record(ramp(5), noise=0.3), {}
    for is_interrupted in (False, True):
        estimator = make_estimator(solver="frame", calibration=calibration)
        for observation in recording.observations:
            last = estimator.update(observation, recording.contact)
        if is_interrupted:
            estimator.interrupt()
        later = replace(recording.observations[-3], stamp=observation.stamp + 30.0)
        found[is_interrupted] = estimator.update(later, recording.contact)
    assert np.linalg.norm(last.force) > 1.0
    overstress = 0.15 * np.linalg.norm(found[True].force)
    assert 3.0 * found[True].magnitude_stddev > overstress > 3.0 * found[False].magnitude_stddev


@pytest.mark.parametrize("height", [20, 40])
def test_force_during_a_jump_is_not_passed_off_as_certain(height):
    depths = 1e-3 * np.r_[np.zeros(60), np.full(40, 1.0), np.full(40, 6.0)]
    recording = record(depths, height=height)
    solutions = run(recording, solver="frame")
    for error, solution in zip(errors(recording, solutions)[100:105], solutions[100:105], strict=True):
        assert not solution.trusted or abs(error) < 6.0 * solution.magnitude_stddev


@pytest.mark.parametrize("height", [20, 60])
def test_divergence_is_a_state_of_its_own_after_which_the_same_contact_goes_on(height, monkeypatch):
    """Mechanics that turn inside out for one frame, as no key points of this finger could make them."""
    recording, estimator = record(ramp(3, hold=3.0), height=height), make_estimator(solver="frame")
    model, solutions = estimator.mechanics.model, []
    evaluate = model.linearize
    for i, observation in enumerate(recording.observations):
        turned = i == 120
        monkeypatch.setattr(
            model, "linearize", lambda q, turned=turned, **options: inside_out(evaluate(q, **options), turned)
        )
        solutions.append(estimator.update(observation, recording.contact))
    assert solutions[120].status == "diverged"
    assert not solutions[120].force.any()
    assert "shape" in solutions[120].message
    found = errors(recording, solutions)[150:]
    assert np.isfinite(found).all()
    assert np.abs(found).max() < 0.10 * np.linalg.norm(recording.forces[-1])


def inside_out(state, turned):
    return replace(state, smallest_det=-1.0) if turned else state


GARBAGE = {
    "noise of 5 mm": lambda points, random: points + 5e-3 * random.normal(size=points.shape),
    "shuffled": lambda points, random: random.permutation(points),
    "one place": lambda points, random: np.broadcast_to(points.mean(0), points.shape),
    "2 cm up": lambda points, random: points + [0.0, 0.0, 0.02],
    "2 cm in": lambda points, random: points - 0.02 * np.outer(np.sin(points[:, 2] / 0.03), [1.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("given", [False, True], ids=["followed", "given"])
@pytest.mark.parametrize("name", GARBAGE)
def test_garbage_gives_no_force_and_is_forgotten_at_once(name, given):
    """A second of key points that belong to no shape of the finger, all with a high likelihood."""
    random = np.random.default_rng(0)

    def change(points, _):
        points[:] = GARBAGE[name](points.copy(), random)

    recording = record(ramp(3, hold=3.0), height=60)
    contact = Contact(points=recording.contact.points, weights=np.ones(1)) if given else recording.contact
    solutions = run(recording.changed(range(120, 150), change), contact=contact, solver="frame")
    assert not any(solution.trusted for solution in solutions[120:150])
    after = errors(recording, solutions)[152:]
    assert np.isfinite(after).all()
    assert np.abs(after).max() < 0.15


# --- cameras that move, and that stop


def bump(motion):
    """Moves all key points by a vector [m], or turns them about one through their middle [rad]."""
    shift, turn = np.array(motion[:3]), np.array(motion[3:])

    def change(points, likelihood):
        points += shift + np.cross(turn, points - np.nanmean(points, axis=0))

    return change


BUMPS = {
    "1 mm along x": (1e-3, 0, 0, 0, 0, 0),
    "-1 mm along z": (0, 0, -1e-3, 0, 0, 0),
    "1 degree": (0,) * 4 + (0.02, 0),
}


@pytest.mark.parametrize(
    ("height", "motion"),
    [
        *((40, motion) for motion in BUMPS.values()),
        *((height, BUMPS["1 mm along x"]) for height in (20, 60)),
        (40, (0.3e-3, 0, 0, 0, 0, 0)),
        (40, (-0.4e-3, 0, 0, 0, 0, 0)),
        (40, (0, 0, 0.3e-3, 0, 0, 0)),
    ],
)
def test_camera_that_is_bumped_under_load_costs_no_answer_and_moves_no_force(height, motion):
    recording = pressed(height)
    spoilt = recording.changed(range(HELD_5, len(STEPS)), bump(motion))
    solutions, after = run(spoilt, solver="frame"), slice(HELD_5 + 3, len(STEPS))
    found, stated = errors(recording, solutions)[after], np.array([s.magnitude_stddev for s in solutions[after]])
    assert np.isfinite(found).mean() > 0.97
    # what shows over several images only is told a little late
    assert np.nanmean(np.abs(found) < 3.0 * stated) > (0.98 if np.linalg.norm(motion) > 0.5e-3 else 0.95)
    assert np.nanmax(np.abs(found)) < (0.5 if height == 20 else 0.35)  # of 3.8 and of 1.6 to 2.0 N


def test_tare_of_the_opened_jaw_takes_a_bump_up():
    recording = pressed()
    spoilt = recording.changed(range(REST - 20, len(STEPS)), bump((1e-3, 0, 0, 0, 0, 0)))
    estimator, solutions = make_estimator(solver="frame"), []
    apart = replace(recording.contact, touching=False)
    for index, observation in enumerate(spoilt.observations):
        solutions.append(estimator.update(observation, apart if index < REST else recording.contact))
        if index == REST - 1:
            assert "tared 15 key points" in estimator.tare()
    before = solutions[REST - 5]  # without a tare yet, for the bump came among its images
    assert before.status == "waiting" or before.magnitude_stddev * 3.0 > np.linalg.norm(before.force)
    assert rms(errors(recording, solutions)[REST + 5 :]) < 0.1


def test_key_points_that_repeat_to_the_bit_for_seconds_are_not_believed_once_a_camera_was_seen():
    recording = pressed()
    still = recording.observations[HELD_5]
    frozen = [replace(still, stamp=still.stamp + 0.5 * i) for i in range(1, 14)]
    stopped = replace(recording, observations=recording.observations[: HELD_5 + 1] + frozen)
    solutions = run(stopped, solver="frame")[HELD_5 + 1 :]
    assert [solution.status for solution in solutions] == 10 * ["ok"] + 3 * ["unobservable"]
    assert "to the bit for 6 s" in solutions[-1].message
