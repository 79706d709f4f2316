"""Claims about the motor's current as a second witness of the force; the true force on the object is the judge."""

from contextlib import nullcontext

import numpy as np
import pytest
from grasp_fakes import STEP, build_spring

from finforce_driver.errors import UnseenForceError
from finforce_driver.grasp.controller import ForceGrasp
from finforce_driver.settings import GraspGoal
from finforce_driver.state import GripperState, Phase
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
