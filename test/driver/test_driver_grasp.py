"""Claims about a grasp by force on springs that relax, seen by a camera that is late, noisy and sometimes silent."""

import itertools
import math

import numpy as np
import pytest
from grasp_fakes import STEP, Bench, Camera, Fingers, Jaws, spring

from finforce_driver.errors import TargetError
from finforce_driver.settings import GraspGoal, GraspSettings
from finforce_driver.state import GraspPhase

STIFF = 1300.0  # [N/m] of opening, the greatest of a real finger
NOISE = 0.05


def grasp(force=2.0, *, speed=0.004, seconds=12.0, seed=0, force_at=None, **parts):
    camera = parts.pop("camera", None) or Camera(noise=NOISE, seed=seed)
    fingers = Fingers(force_at=force_at or spring(STIFF), width=0.025 + 1.7e-5 * seed)
    jaws = parts.pop("jaws", None) or Jaws(opening=142 * STEP)
    return Bench(goal=GraspGoal(force=force, speed=speed), fingers=fingers, jaws=jaws, camera=camera, **parts).run(
        seconds
    )


def count_reversals(course, after):
    targets = [target for time, target, _ in course.moves if time > after]
    ways = [b - a for a, b in itertools.pairwise(targets) if abs(b - a) > 1e-9]
    return sum(a * b < 0.0 for a, b in itertools.pairwise(ways))


@pytest.mark.parametrize("force", [1.0, 2.0, 3.0, 4.0, 5.0])
@pytest.mark.parametrize("latency", [0.03, 0.1])
def test_set_force_is_reached_and_passed_by_less_than_a_step(force, latency):
    course = grasp(force, camera=Camera(latency=latency, noise=NOISE, seed=3), seed=3)
    assert course.status.phase is GraspPhase.HOLDING
    assert course.overshoot(force) < 0.2  # a step is 0.245 N, the noise 0.05 N
    assert abs(course.steady_error(force)) < 0.25  # a step
    assert course.held_after() - course.onset_at() < 2.0


@pytest.mark.parametrize("force", [0.15, 0.3])
def test_force_below_the_usual_onset_is_reached(force):
    for seed in range(3):
        course = grasp(force, force_at=spring(600.0), camera=Camera(noise=0.03, seed=seed), seconds=25.0)
        assert course.status.phase is GraspPhase.HOLDING
        assert course.overshoot(force) < 0.13  # a step


def test_fast_closing_is_slowed_by_the_bound_and_not_by_the_overshoot():
    slow, fast = grasp(1.0, speed=0.004), grasp(1.0, speed=0.05, camera=Camera(noise=NOISE, seed=1))
    assert fast.overshoot(1.0) < 0.2
    assert fast.onset_at() > 0.5 * slow.onset_at()  # the camera's rate allows little more than 3 mm/s for 1 N


def test_stiff_goal_without_prediction_would_be_passed():
    # what closing at 8 mm/s does until an image of 100 ms ago shows the force: the yardstick of all figures here
    unseen = 0.008 * (0.1 + 1 / 30) * STIFF
    assert unseen > 1.0
    course = grasp(3.0, speed=0.008, camera=Camera(latency=0.1, noise=NOISE))
    assert course.overshoot(3.0) < 0.2 * unseen


def test_overshoot_stays_within_the_bound_that_is_shown():
    for seed, force in itertools.product(range(3), (1.0, 3.0, 5.0)):
        course = grasp(force, seed=seed, speed=0.008, seconds=8.0)
        bound = max(status.overshoot_bound for status in course.statuses)
        assert course.overshoot(force) <= bound + STIFF * STEP * 0.5, (seed, force)
        assert bound < 1.6  # twice the stiffness of 1.3 N/mm on 8 mm/s x 0.1 s would be 2 N


def test_stiffness_is_learnt_on_the_way():
    soft, stiff = grasp(3.0, force_at=spring(300.0)), grasp(3.0, force_at=spring(STIFF))
    # relaxation makes a loaded finger up to 15 % stiffer than its spring
    assert soft.status.stiffness == pytest.approx(330.0, rel=0.3)
    assert stiff.status.stiffness == pytest.approx(1400.0, rel=0.3)


def test_stiffness_that_triples_while_loading_is_followed():
    for seed in range(3):
        course = grasp(5.0, force_at=spring(400.0, 3.0, 0.004), seed=seed)
        assert course.status.phase is GraspPhase.HOLDING
        assert course.overshoot(5.0) < 0.25


def test_latency_and_period_are_measured():
    status = grasp(camera=Camera(latency=0.08, noise=NOISE)).status
    assert status.latency == pytest.approx(0.08, abs=0.01)
    assert status.period == pytest.approx(1 / 30, abs=0.003)


def test_relaxation_is_followed():
    terms = ((0.15, 2.0), (0.15, 6.0))
    bench = Bench(
        goal=GraspGoal(force=4.0),
        fingers=Fingers(force_at=spring(700.0), terms=terms),
        jaws=Jaws(opening=142 * STEP),
        camera=Camera(noise=NOISE),
    )
    course = bench.run(25.0)
    assert abs(course.steady_error(4.0)) < 0.14  # a step of 0.13 N
    held = next(t for t in course.times if t > course.held_after())
    opening = dict(zip(course.times, course.openings, strict=True))[held]
    assert opening - course.openings[-1] > 2.5 * STEP  # 0.4 N have relaxed, what no feedback would have made up for


@pytest.mark.parametrize("stiffness", [300.0, 700.0, STIFF])
def test_holding_does_not_hunt_between_two_steps(stiffness):
    course = grasp(3.0, force_at=spring(stiffness), seconds=20.0)
    assert course.status.phase is GraspPhase.HOLDING
    assert count_reversals(course, course.held_after()) <= 1
    assert sum(time > course.held_after() + 1.0 for time, *_ in course.moves) <= 8


def test_gripper_is_not_flooded_with_commands():
    course = grasp(5.0, force_at=spring(300.0), speed=0.008)
    assert len(course.moves) < 100  # 14 mm and 75 steps; every command may clear the gripper's integrators
    gaps = np.diff([time for time, *_ in course.moves])
    assert np.median(gaps) > 0.04


def test_force_may_be_raised_and_lowered_while_holding():
    forces = {6.0: 4.0, 12.0: 1.0}

    def change(bench, now):
        for when, force in forces.items():
            if abs(now - when) < 1e-4:
                bench.grasp.change_force(force)

    course = grasp(2.0, seconds=20.0, on_step=change, force_at=spring(900.0))
    at = {when: course.forces[int(np.searchsorted(course.times, when))] for when in (5.9, 11.9, 19.9)}
    for when, force in {5.9: 2.0, 11.9: 4.0, 19.9: 1.0}.items():
        assert at[when] == pytest.approx(force, abs=0.2)  # a step of the gripper
    late = [force for time, force in zip(course.times, course.forces, strict=True) if time > 6.0]
    assert min(late) > 0.6  # never let go
    assert max(late) < 4.2


def test_the_same_force_again_changes_nothing():
    def repeat(bench, _):
        bench.grasp.change_force(2.0)

    course = grasp(2.0, seconds=12.0, on_step=repeat, force_at=spring(900.0))
    reasons = [status.reason for status in course.statuses]
    assert reasons[-1] == "holds the set force"
    assert "goes to another force" not in reasons


def test_grasp_that_begins_under_load_goes_to_the_set_force():
    jaws = Jaws(opening=126 * STEP)  # 23.7 mm about an object of 25 mm: 1.6 N
    for force in (1.0, 3.0):
        course = grasp(force, jaws=Jaws(opening=jaws.opening))
        assert course.status.phase is GraspPhase.HOLDING
        assert course.steady_error(force) == pytest.approx(0.0, abs=0.25)


def test_same_input_gives_the_same_moves():
    assert grasp(seed=5).moves == grasp(seed=5).moves
    assert grasp(seed=5).moves != grasp(seed=6).moves


def test_jaws_stop_by_themselves_when_nobody_calls_any_more():
    # between two updates the driver may die: the target alone must keep the force below the set one
    course = grasp(2.0)
    closest = min(target for _, target, _ in course.moves)
    assert spring(STIFF)(0.025 - closest) < 2.0 + 0.3
    before = [target for time, target, _ in course.moves if time < course.onset_at() + 0.1]
    assert spring(STIFF)(0.025 - min(before)) < 2.0


@pytest.mark.parametrize("force", [math.nan, -1.0, 0.0, 8.1, math.inf])
def test_force_that_cannot_be_held_is_refused(force):
    with pytest.raises(TargetError, match="force"):
        Bench(goal=GraspGoal(force=force))
    bench = Bench(goal=GraspGoal(force=1.0))
    with pytest.raises(TargetError, match="set force"):
        bench.grasp.change_force(force)


def test_force_limit_bounds_the_goal():
    Bench(goal=GraspGoal(force=8.1), settings=GraspSettings(force_limit=9.0))
    with pytest.raises(TargetError, match=r"force_limit: got nan"):
        GraspSettings(force_limit=math.nan)
