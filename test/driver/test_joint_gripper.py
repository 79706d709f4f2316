"""Claims about grippers that are a joint: other makers' servos, the same calls, forces held by the same controller."""

import math
from itertools import count

import numpy as np
import pytest
from grasp_fakes import build_spring
from joint_fakes import LEROBOT, ROBOTIQ, EmulatedJoint

from finforce_driver.errors import GraspError, GripperStateError, GripperTimeoutError, TargetError
from finforce_driver.grasp.force_monitor import ForceSample
from finforce_driver.grasp.session import hold_force
from finforce_driver.settings import GraspGoal, GraspSettings, JointSettings
from finforce_driver.state import GraspPhase, MoveOutcome, Phase
from finforce_ifea.relaxation import Relaxation
from lab.experiments.grasp_world import TERMS

MAKERS = pytest.mark.parametrize("maker", [ROBOTIQ, LEROBOT], ids=["robotiq", "lerobot"])


def ready(maker, **options):
    joint = EmulatedJoint(**{**maker, **options})
    joint.gripper.wait(lambda state: state.phase is Phase.READY, 1.0)
    return joint


def arrive(joint, opening, speed=0.05):
    joint.gripper.move(opening, speed)
    return joint.gripper.wait(lambda state: state.phase is not Phase.MOVING, 20.0)


@MAKERS
@pytest.mark.parametrize("takes_speed", [False, True])
def test_a_move_reaches_its_opening_at_the_speed_that_was_asked_for(maker, takes_speed):
    joint = ready(maker, takes_speed=takes_speed)
    began, start = joint.clock.now(), joint.opening
    state = arrive(joint, 0.020, 0.02)
    assert state.outcome is MoveOutcome.REACHED
    assert joint.opening == pytest.approx(0.020, abs=1.5 * joint.gripper.resolution)
    assert joint.clock.now() - began == pytest.approx((start - 0.020) / 0.02, rel=0.15)


@MAKERS
def test_something_in_the_way_is_grasped(maker):
    joint = ready(maker)
    joint.blocked_at = 0.030
    state = arrive(joint, 0.010)
    assert state.outcome is MoveOutcome.GRASPED
    assert state.opening == pytest.approx(0.030, abs=2 * joint.gripper.resolution)


@MAKERS
def test_hold_stops_in_place_within_the_latency(maker):
    joint = ready(maker)
    joint.gripper.move(0.0, 0.02)
    joint.clock.wait(1.0)
    before = joint.opening
    joint.gripper.hold()
    joint.clock.wait(1.0)
    assert joint.opening == pytest.approx(before, abs=0.02 * (maker["latency"] + 2 * maker["period"] + 0.04) + 1e-3)
    assert joint.gripper.state.phase is Phase.READY


def test_an_emergency_stop_holds_and_refuses_moves_until_it_is_cleared():
    joint = ready(ROBOTIQ)
    joint.gripper.move(0.0, 0.02)
    joint.clock.wait(0.5)
    joint.gripper.estop()
    joint.clock.wait(0.2)
    before = joint.opening
    with pytest.raises(GripperStateError, match="emergency stop is latched"):
        joint.gripper.move(0.01)
    joint.clock.wait(1.0)
    assert joint.opening == before and joint.gripper.state.phase is Phase.FAULT
    joint.gripper.clear_errors()
    assert arrive(joint, 0.05).outcome is MoveOutcome.REACHED


def test_silence_is_noticed_and_commands_are_refused():
    joint = ready(ROBOTIQ)
    joint.gripper.move(0.0, 0.02)
    joint.answers = False
    joint.clock.wait(1.0)
    assert joint.gripper.state.phase is Phase.DISCONNECTED
    sent = len(joint.commands)
    joint.clock.wait(1.0)
    assert len(joint.commands) == sent  # it is led no further
    with pytest.raises(GripperStateError, match="no state of gripper_joint"):
        joint.gripper.move(0.01)
    joint.answers = True
    joint.clock.wait(0.1)
    assert joint.gripper.state.phase is Phase.READY
    assert joint.gripper.state.outcome is MoveOutcome.ABORTED


def test_what_a_joint_does_not_do_is_refused():
    gripper = ready(ROBOTIQ).gripper
    for call in (gripper.calibrate, gripper.release_power, lambda: gripper.activate(False)):
        with pytest.raises(GripperStateError, match="is a joint"):
            call()
    gripper.activate(True)
    for bad in ((math.nan,), (0.2,), (0.02, 0.0), (0.02, 5.0)):
        with pytest.raises(TargetError):
            gripper.move(*bad)
    with pytest.raises(GripperTimeoutError):
        gripper.wait(lambda state: False, 0.1)


@pytest.mark.parametrize(
    ("named", "words"),
    [({"names": ()}, "joint.names"), ({"names": ("a", "a")}, "each once"), ({"open": 0.0}, "both are 0")],
)
def test_settings_that_no_joint_has_are_refused(named, words):
    with pytest.raises(TargetError, match=words):
        JointSettings(**named)


class Camera:
    """Fingers between the jaws of a joint, and the force that a camera sees of them, late."""

    def __init__(self, joint, stiffness, latency=0.06, seed=0):
        self.joint, self.latency = joint, latency
        self.force_at = build_spring(stiffness)
        self.relaxation, self.random = Relaxation(TERMS), np.random.default_rng(seed)
        self.next, self.arrivals, self.number = 0.0, [], count()
        self.force, self.forces = 0.0, []
        joint.clock.attach(self)

    def step(self, dt):
        now = self.joint.clock.now()
        self.force = float(self.relaxation.update(np.array([self.force_at(self.joint.opening), 0.0, 0.0]), dt)[0])
        self.forces.append(self.force)
        if now >= self.next:
            self.next = now + 1.0 / 30.0
            seen = abs(self.force + 0.05 * self.random.standard_normal())
            self.arrivals.append(ForceSample(stamp=now, arrived=now + self.latency, force=seen))

    def take(self):
        now = self.joint.clock.now()
        ready = [sample for sample in self.arrivals if sample.arrived <= now]
        self.arrivals = [sample for sample in self.arrivals if sample.arrived > now]
        return ready


@MAKERS
@pytest.mark.parametrize("takes_speed", [False, True])
@pytest.mark.parametrize("stiffness", [400.0, 1300.0])
@pytest.mark.parametrize("force", [1.0, 3.0])
def test_the_same_controller_holds_a_force_with_another_gripper(maker, takes_speed, stiffness, force):
    joint = ready(maker, takes_speed=takes_speed)
    arrive(joint, 0.028)
    camera = Camera(joint, stiffness)
    settings = GraspSettings(reaction=maker["latency"] + maker["period"] + 0.04)
    until = []

    def held(status):
        until.append(joint.clock.now()) if status.phase is GraspPhase.HOLDING else None
        return bool(until) and joint.clock.now() > until[0] + 4.0

    status = hold_force(joint.gripper, camera.take, GraspGoal(force=force), settings, until=held)
    step = stiffness * joint.gripper.resolution
    assert max(camera.forces) < force + 0.15 + 0.5 * step
    assert camera.forces[-1] == pytest.approx(force, abs=0.12 + step)
    assert status.phase is GraspPhase.HOLDING


@MAKERS
def test_a_camera_that_falls_silent_stops_another_gripper(maker):
    joint = ready(maker)
    arrive(joint, 0.028)
    camera = Camera(joint, 800.0)
    settings = GraspSettings(reaction=maker["latency"] + maker["period"] + 0.04)

    def until(status):
        if camera.force > 0.5:
            camera.next = math.inf
        return False

    with pytest.raises(GraspError, match="old"):
        hold_force(joint.gripper, camera.take, GraspGoal(force=3.0), settings, until=until)
    joint.clock.wait(0.3)
    before = joint.opening
    joint.clock.wait(1.0)
    assert joint.opening == pytest.approx(before, abs=joint.gripper.resolution)
    assert max(camera.forces) < 3.1
