"""Claims about the motor's current as a second witness of the force; the true force on the object is the judge."""

from contextlib import nullcontext

import numpy as np
import pytest
from grasp_fakes import STEP, build_spring

from finforce_driver.errors import UnseenForceError
from finforce_driver.grasp.controller import ForceGrasp
from finforce_driver.settings import GraspGoal, GraspSettings
from finforce_driver.state import GraspPhase, GripperState, Phase
from lab.experiments.grasp_world import GraspCase, NoisySensor, Plant, World


class FrozenSensor:
    """A camera that sees well up to a force [N], and from then on says the same again and again."""

    touching = None
    stddev = 0.0

    def __init__(self, frozen_at):
        self.frozen_at, self.last = frozen_at, 0.0

    def measure(self, stamp, force, opening):
        if force < self.frozen_at:
            self.last = force
        return self.last


def grasp(sensor, *, stiffness, force, variant, speed=0.004):
    """The world after a grasp and what came of it; a moment later, when the jaws have done what they were told."""
    plant = Plant(force_at=build_spring(stiffness))
    world = World(GraspCase(plant=plant, force=force, speed=speed, latency=0.06, seed=1, variant=variant), sensor)
    course = world.run()
    with np.errstate(all="ignore"):
        world.gripper.wait(lambda state: state.phase is Phase.READY, 10.0)
    return world, course


class LowSensor(NoisySensor):
    """A camera that sees half of the force."""

    def measure(self, stamp, force, opening):
        return 0.5 * super().measure(stamp, force, opening)


@pytest.mark.parametrize("force", [2.0, 3.0, 5.0])
def test_a_camera_that_reads_half_is_noticed_at_rest(variant, force):
    world, course = grasp(LowSensor(0.05, 1), stiffness=800.0, force=force, variant=variant)
    assert "calibration off by a factor" in course.error
    assert max(course.forces) < 4.5 and world.force < 1.0


@pytest.mark.parametrize(("ratios", "noticed"), [([], True), ([0.7] * 2, True), ([0.7] * 3, False)])
def test_the_motor_is_compared_by_what_the_first_grasps_taught(ratios, noticed):
    grasp = ForceGrasp(GraspGoal(force=3.0), resolution=STEP, ratios=ratios)
    grasp._load.loaded = grasp._load.resting = True
    grasp._load.model.begin(0.02, 3.0, 0.0)
    grasp._load.opening = grasp._plan.target = 0.02
    grasp._plan._arrives = 0.0
    state = GripperState(phase=Phase.READY, stamp=1.0, opening=0.02, force=6.0)
    with pytest.raises(UnseenForceError, match="the motor holds 6.0 N") if noticed else nullcontext():
        for _ in range(3):
            grasp._compare_motor(state)


@pytest.mark.parametrize(("stiffness", "force"), [(400.0, 3.0), (1300.0, 1.0), (1300.0, 3.0)])
def test_a_blind_camera_crushes_nothing(variant, stiffness, force):
    world, course = grasp(FrozenSensor(0.0), stiffness=stiffness, force=force, variant=variant)
    assert max(course.forces) < 5.5  # the limit of a grasp is 8 N; the motor could give 60
    assert "the motor presses with" in course.error and "the camera says 0.00 N" in course.error
    assert world.force < 1.0  # the jaws have backed off
    assert course.statuses == [] or not course.statuses[-1][1].unseen or course.statuses[-1][1].failed


def test_a_rigid_object_gets_no_more_than_the_limit_of_the_motor(variant):
    _, course = grasp(FrozenSensor(0.0), stiffness=20_000.0, force=3.0, variant=variant)
    assert max(course.forces) < 9.0
    assert "the jaws back off" in course.error.lower()


def test_a_camera_that_freezes_on_the_way_crushes_nothing(variant):
    world, course = grasp(FrozenSensor(0.6), stiffness=1300.0, force=3.0, variant=variant)
    assert max(course.forces) < 6.5
    assert course.error and world.force < 2.5


@pytest.mark.parametrize(
    ("stiffness", "force", "speed"),
    [(300.0, 1.0, 0.008), (1300.0, 1.0, 0.004), (1300.0, 3.0, 0.008), (1300.0, 5.0, 0.004), (1300.0, 5.0, 0.008)],
)
def test_a_grasp_that_is_seen_is_held(variant, stiffness, force, speed):
    sensor = NoisySensor(0.05, 3)
    plant = Plant(force_at=build_spring(stiffness))
    course = World(
        GraspCase(plant=plant, force=force, speed=speed, latency=0.08, seed=2, variant=variant), sensor
    ).run()
    assert course.error == ""
    assert max(course.forces) < force + 0.25


class HighSensor(NoisySensor):
    """A camera that sees a multiple of the force, an offset [N] more, and more from second to second [N/s]."""

    def __init__(self, factor=1.0, offset=0.0, drift=0.0):
        super().__init__(0.05, 1)
        self.factor, self.offset, self.drift, self.began = factor, offset, drift, None

    def measure(self, stamp, force, opening):
        self.began = stamp if self.began is None else self.began
        seen = self.factor * super().measure(stamp, force, opening)
        return seen + self.offset + self.drift * (stamp - self.began)


def low_while_held(sensor, stiffness, force):
    """By how much the true force is below the set one at most while it is said to be held [N], and the course."""
    plant, low = Plant(force_at=build_spring(stiffness)), [0.0]
    world = World(GraspCase(plant=plant, force=force, speed=0.004, latency=0.06, seed=1), sensor)
    is_over = world._is_over

    def look(status):
        if status.phase is GraspPhase.HOLDING:
            low.append(force - world.force)
        return is_over(status)

    world._is_over = look
    course = world.run()
    return max(low), course


@pytest.mark.parametrize("high", [{"factor": 1.3}, {"offset": 1.0}, {"drift": 0.1}], ids=["130 %", "+1 N", "+0.1 N/s"])
@pytest.mark.parametrize(("stiffness", "force"), [(400.0, 2.0), (1300.0, 5.0), (800.0, 7.0)])
def test_a_camera_that_reads_too_much_is_no_success(high, stiffness, force):
    low, course = low_while_held(HighSensor(**high), stiffness, force)
    assert low < 1.0
    assert "the motor holds" in course.error and "does the camera read too much" in course.error
    assert max(status.stddev for _, status in course.statuses) > 0.3


@pytest.mark.parametrize(("factor", "stiffness", "force"), [(0.95, 400.0, 1.0), (1.0, 1300.0, 5.0), (1.05, 800.0, 7.0)])
def test_a_camera_within_its_error_is_believed(factor, stiffness, force):
    low, course = low_while_held(HighSensor(factor), stiffness, force)
    assert course.error == "" and low < 0.1 * force + 0.1


def test_a_gear_with_more_friction_is_known_by_a_setting():
    settings = GraspSettings(motor_friction=1.0)
    for limits, excess in ((GraspSettings(), 0.8), (settings, 0.0)):
        grasp = ForceGrasp(GraspGoal(force=3.0), limits, resolution=STEP)
        grasp._load.loaded = grasp._load.resting = True
        grasp._load.model.begin(0.02, 3.0, 0.0)
        grasp._load.opening = grasp._plan.target = 0.02
        grasp._plan._arrives = 0.0
        for _ in range(3):
            grasp._compare_motor(GripperState(phase=Phase.READY, stamp=1.0, opening=0.02, force=2.2))
        assert grasp._excess == pytest.approx(excess)
