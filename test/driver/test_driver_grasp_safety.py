"""Claims about grasps in which something goes wrong: each ends in place, or goes on and stays below the force."""

import math
from dataclasses import replace

import pytest
from grasp_fakes import STEP, Bench, Camera, Fingers, Jaws, spring

from finforce_driver.grasp.force_monitor import ForceSample
from finforce_driver.settings import GraspGoal, GraspSettings
from finforce_driver.state import GraspPhase, Phase

STIFF = 1300.0


def build(force=2.0, *, camera=None, fingers=None, jaws=None, speed=0.004, **parts):
    goal = parts.pop("goal", None) or GraspGoal(force=force, speed=speed)
    return Bench(
        goal=goal,
        fingers=fingers or Fingers(force_at=spring(STIFF)),
        jaws=jaws or Jaws(opening=142 * STEP),
        camera=camera or Camera(),
        **parts,
    )


def first_stop(course):
    """Time of the first stopped status [s]."""
    return next(t for t, s in zip(course.times, course.statuses, strict=True) if s.phase is GraspPhase.STOPPED)


def assert_stays(course, after):
    """The jaws do not close after a time."""
    later = [o for t, o in zip(course.times, course.openings, strict=True) if t > after]
    assert min(later) > later[0] - 0.6 * STEP


def changed_after(time, change):
    """Camera samples changed from a time on."""
    return lambda sample: change(sample) if sample.stamp > time else sample


@pytest.mark.parametrize("when", [1.0, 2.0, 6.0])
def test_silence_ends_a_grasp_in_place(when):
    course = build(camera=Camera(change=changed_after(when, lambda sample: None))).run(9.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert "old" in course.status.reason
    # of the newest image: up to a period before the silence
    assert when + 0.2 < first_stop(course) < when + 0.25 + 0.05
    assert len(course.stops) == 1
    assert_stays(course, first_stop(course) + 0.1)
    assert course.peak < 2.1


def test_short_silence_does_not_end_a_grasp():
    def blink(sample):
        return None if sample.stamp % 1.0 < 0.1 else sample  # three images of every second

    course = build(camera=Camera(change=blink)).run(12.0)
    assert course.status.phase is GraspPhase.HOLDING
    assert course.overshoot(2.0) < 0.25


def test_messages_refused_while_the_force_rises_fast_cost_time_and_no_force():
    last = [0.0, 0.0]

    def refuse(sample):
        is_fast = sample.force - last[0] > 0.08
        last[0] = sample.force
        return None if is_fast else sample

    for seed in range(4):
        course = build(4.0, camera=Camera(change=refuse, seed=seed, missing=0.0), speed=0.008).run(12.0)
        assert course.overshoot(4.0) < 0.3
        assert course.status.phase is GraspPhase.HOLDING or "old" in course.status.reason


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.5])
def test_number_that_is_no_force_ends_a_grasp(value):
    camera = Camera(change=changed_after(2.0, lambda sample: replace(sample, force=value)))
    course = build(camera=camera).run(6.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert str(value) in course.status.reason
    assert first_stop(course) < 2.0 + 0.1 + 0.06


def test_single_outliers_are_waited_out():
    count = [0]

    def spoil(sample):
        count[0] += 1
        return replace(sample, force=sample.force + 3.0) if count[0] % 37 == 0 else sample

    course = build(camera=Camera(change=spoil)).run(14.0)
    assert course.status.phase is GraspPhase.HOLDING
    assert course.overshoot(2.0) < 0.15
    assert course.steady_error(2.0) == pytest.approx(0.0, abs=0.25)


def test_doubtful_force_stops_closing_jaws_until_the_next_image():
    spoilt = []

    def spoil(sample):
        if sample.force > 1.5 and not spoilt:
            spoilt.append(sample)
            return replace(sample, force=sample.force + 3.0)
        return sample

    course = build(5.0, camera=Camera(change=spoil, missing=0.0), fingers=Fingers(force_at=spring(400.0))).run(12.0)
    paused = next(move for move in course.moves if move[0] >= spoilt[0].arrived)
    there = next(o for t, o in zip(course.times, course.openings, strict=True) if t >= paused[0])
    assert paused[0] - spoilt[0].arrived < 0.03
    assert abs(paused[1] - there) < STEP  # where the jaws are, not where they were going
    assert course.status.phase is GraspPhase.HOLDING


def test_jump_that_stays_ends_a_grasp():
    camera = Camera(change=changed_after(6.0, lambda sample: replace(sample, force=sample.force + 2.0)))
    course = build(camera=camera).run(8.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert "jumped" in course.status.reason
    assert first_stop(course) < 6.0 + 2 / 30 + 0.15
    assert_stays(course, 6.0)


def test_fracture_ends_a_grasp_instead_of_closing_on():
    def break_object(bench, now):
        if now > 5.0:
            bench.fingers.width = 0.020

    course = build(4.0, on_step=break_object).run(9.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert "fell" in course.status.reason
    assert_stays(course, 5.0)


def test_small_force_that_vanishes_ends_a_grasp():
    def lose(bench, now):
        if now > 5.0:
            bench.fingers.width = 0.020

    course = build(0.9, on_step=lose, fingers=Fingers(force_at=spring(600.0))).run(9.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert "gone" in course.status.reason or "fell" in course.status.reason
    assert first_stop(course) < 5.4


def test_object_that_slips_slowly_is_not_chased():
    def slip(bench, now):
        if now > 5.0:
            bench.fingers.width -= 0.0004 * 0.002  # 0.4 mm/s

    course = build(2.0, on_step=slip).run(20.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert "slips" in course.status.reason
    assert course.openings[-1] > 0.020


def test_push_from_outside_above_the_limit_ends_a_grasp():
    def push(bench, now):
        if now > 5.0:
            bench.fingers.width = min(0.027, bench.fingers.width + 4e-6)  # 2 mm/s

    course = build(3.0, on_step=push, settings=GraspSettings(force_limit=4.0)).run(9.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert "limit of 4 N" in course.status.reason or "jumped" in course.status.reason


def test_offset_before_contact_is_no_contact():
    course = build(1.0, camera=Camera(offset=0.1, noise=0.05)).run(12.0)
    early = [s.phase for t, s in zip(course.times, course.statuses, strict=True) if t < course.onset_at()]
    assert set(early) == {GraspPhase.APPROACH}
    assert course.status.phase is GraspPhase.HOLDING
    assert course.overshoot(1.0) < 0.2


@pytest.mark.parametrize("delay", [-1.0, -0.2, 0.0, 0.3, 100.0])
def test_early_late_or_missing_touch_costs_no_force(delay):
    course = build(1.0, touch_delay=delay).run(12.0)
    assert course.status.phase is GraspPhase.HOLDING
    assert course.overshoot(1.0) < 0.2


def test_touch_that_is_always_said_stops_nothing():
    bench = build(1.0)
    bench.on_step = lambda bench, now: bench.grasp.take_touch(True, now - 0.05)
    course = bench.run(12.0)
    assert course.status.phase is GraspPhase.HOLDING
    assert course.overshoot(1.0) < 0.2


def test_nothing_moves_before_the_camera_has_said_anything():
    course = build(camera=Camera(missing=1.0)).run(4.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert "no force came" in course.status.reason
    assert course.moves[:-1] == []  # but for holding in place
    assert first_stop(course) == pytest.approx(2.0, abs=0.1)


def silent_until(force):
    """A camera whose forces come from a load on."""
    heard = [False]

    def change(sample):
        heard[0] |= sample.force > force
        return sample if heard[0] else None

    return Camera(change=change, noise=0.02)


def test_words_on_touching_lead_a_grasp_whose_forces_begin_with_the_contact():
    bench = build(2.0, camera=silent_until(0.2))
    bench.on_step = lambda bench, now: bench.grasp.take_touch(bench.fingers.force > 0.1, now - 0.06)
    course = bench.run(14.0)
    assert course.status.phase is GraspPhase.HOLDING
    assert course.overshoot(2.0) < 0.25


def test_touch_without_a_force_ends_a_grasp_before_the_set_force():
    for said in (lambda bench: bench.fingers.force > 0.1, lambda bench: False):
        bench = build(2.0, camera=Camera(missing=1.0))
        bench.on_step = lambda bench, now, said=said: bench.grasp.take_touch(said(bench), now - 0.06)
        course = bench.run(14.0)
        if said(bench):
            assert course.status.phase is GraspPhase.STOPPED
            assert "touch" in course.status.reason
            assert course.peak < 2.0


def test_blocked_jaws_end_a_grasp():
    course = build(jaws=Jaws(opening=142 * STEP, blocked_at=0.0255)).run(9.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert "jaws stay at" in course.status.reason


def test_least_opening_is_never_passed():
    goal = GraspGoal(force=2.0, least_opening=0.0246)
    course = build(goal=goal).run(9.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert "least opening" in course.status.reason
    assert min(course.openings) >= 0.0246 - 1e-9


def test_grasp_of_nothing_ends_closed():
    fingers = Fingers(width=-1.0)
    course = build(1.0, fingers=fingers, jaws=Jaws(opening=12 * STEP)).run(9.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert "least opening" in course.status.reason
    assert min(course.openings) >= 0.0


def test_time_limit_ends_a_grasp():
    course = build(goal=GraspGoal(force=2.0, time_limit=1.0)).run(4.0)
    assert "time limit" in course.status.reason
    assert first_stop(course) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    "change",
    [
        {"estopped": True, "phase": Phase.FAULT},
        {"phase": Phase.FAULT, "message": "too hot"},
        {"phase": Phase.DISCONNECTED},
        {"phase": Phase.UNCALIBRATED, "opening": math.nan},
        {"phase": Phase.CALIBRATING},
    ],
)
def test_gripper_that_cannot_move_ends_a_grasp_without_a_command(change):
    course = build(change_state=lambda state, now: replace(state, **change) if now > 3.0 else state).run(5.0)
    assert course.status.phase is GraspPhase.STOPPED
    assert course.stops == []
    assert all(time < 3.0 + 0.01 for time, *_ in course.moves)
    assert change.get("message", "") in course.status.reason


def test_jaws_that_somebody_made_limp_end_a_grasp():
    course = build(change_state=lambda state, now: replace(state, activated=now < 3.0)).run(5.0)
    assert "power stage is off" in course.status.reason
    assert first_stop(course) < 3.05


def test_gripper_that_does_not_answer_ends_a_grasp():
    course = build(change_state=lambda state, now: replace(state, stamp=min(state.stamp, 3.0))).run(5.0)
    assert "no reply" in course.status.reason
    assert first_stop(course) < 3.4


@pytest.mark.parametrize("step", [5.0, -5.0, 0.5, -0.5, 0.09])
@pytest.mark.parametrize("when", [2.0, 6.0])
def test_stamps_of_a_clock_that_was_set_end_a_grasp_or_cost_no_force(step, when):
    camera = Camera(change=changed_after(when, lambda sample: replace(sample, stamp=sample.stamp + step)))
    course = build(camera=camera, speed=0.008).run(9.0)
    if abs(step) > 0.1:
        assert course.status.phase is GraspPhase.STOPPED
        assert sum(course.status.rejected.values()) > 0
    assert course.overshoot(2.0) < 0.25


def test_old_doubled_and_disordered_samples_are_refused():
    queue = []

    def disorder(sample):
        queue.append(sample)
        return queue[-2] if len(queue) % 7 == 0 else queue[-4] if len(queue) % 11 == 0 else sample

    course = build(camera=Camera(change=disorder)).run(12.0)
    assert course.status.phase is GraspPhase.HOLDING
    assert course.status.rejected["out of order"] > 10


def test_ended_grasp_stays_ended():
    bench = build(camera=Camera(change=changed_after(3.0, lambda sample: None)))
    course = bench.run(6.0)
    assert len(course.stops) == 1
    bench.grasp.take_force(ForceSample(stamp=6.0, arrived=6.05, force=0.0))
    assert bench.grasp.update(bench.jaws.state, 6.06, bench.jaws.opening_at) is None
    assert bench.grasp.phase is GraspPhase.STOPPED
