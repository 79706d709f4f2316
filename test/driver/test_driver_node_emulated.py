"""Claims about the driver node on an emulated gripper behind a port, in real time: from unplugged to a held force."""

import math
from contextlib import ExitStack
from time import time_ns

import pytest
from driver_node_fakes import ask
from emulator_fakes import Bench, Fingers
from node_fakes import ros_domain
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from finforce.health import Level
from finforce.messages import stamp_of
from finforce.ros import node as ros
from finforce_driver.can.protocol import CanMessage

VARIANTS = ("new", "old")
STEP = 0.048 / 255  # m, of the position byte
CALIBRATION = 60.0  # s; 3 s on an idle machine
HASTY = {"gripper.reply_timeout": 0.02}


@pytest.fixture
def bench():
    with ros_domain() as probe, ExitStack() as stack:

        def build(*arguments, **named):
            made = Bench(probe, *arguments, **named)
            stack.callback(made.close)
            return made

        yield build


def test_joint_states_follow_the_gripper_with_the_times_of_its_replies(bench):
    bench = bench()
    bench.wait_for_joints(10)
    stamps = [stamp_of(message) for message in bench.joints]
    assert all(later > earlier for earlier, later in zip(stamps, stamps[1:], strict=False))
    # none from the future, none older than the test's patience
    assert 0 < time_ns() - stamps[-1] < 10 * ros.NANOSECONDS
    assert list(bench.joints[-1].position) == pytest.approx([bench.gripper.jaws.opening / 2] * 2, abs=STEP)
    numbers = [value for m in bench.joints for value in (*m.position, *m.velocity, *m.effort)]
    assert all(map(math.isfinite, numbers))


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_command_moves_the_gripper(bench, variant):
    bench = bench(variant)
    bench.wait_for_joints()
    bench.move(0.03, velocity=[0.1], effort=[15.0])
    bench.probe.wait_for(lambda: abs(bench.gripper.jaws.opening - 0.03) < 2 * STEP)
    bench.probe.wait_for(lambda: abs(2 * bench.joints[-1].position[0] - 0.03) < 2 * STEP)
    assert min(message.velocity[0] for message in bench.joints) < 0.0


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_calibration_makes_the_gripper_ready(bench, variant):
    bench = bench(variant, calibrated=False)
    bench.diagnosis(Level.WARN, "not calibrated")
    assert all(len(joints.name) == 2 and len(joints.position) == 0 for joints in bench.joints)
    answer = bench.call("calibrate", patience=CALIBRATION)
    assert answer.success, answer.message
    assert bench.gripper.calibrated
    bench.probe.wait_for(lambda: len(bench.joints[-1].position) == 2)


def test_a_gripper_that_is_not_calibrated_refuses_to_move_and_says_what_helps(bench):
    bench = bench(calibrated=False)
    bench.diagnosis(Level.WARN, "not calibrated")
    before = bench.gripper.jaws.opening
    bench.move(0.02)
    bench.diagnosis(Level.ERROR, "calibrate")
    for name in ("release", "grasp_without_vision", "stop", "grasp"):
        answer = bench.call(name)
        assert not answer.success and "calibrate" in answer.message, name
    assert bench.gripper.jaws.opening == before


@pytest.mark.parametrize("variant", VARIANTS)
def test_an_emergency_stop_stops_a_motion_and_clearing_it_lets_the_next_one_go(bench, variant):
    bench = bench(variant)
    bench.wait_for_joints()
    bench.move(0.005, velocity=[0.01])
    bench.probe.wait_for(lambda: bench.gripper.jaws.opening < 0.047)
    assert bench.call("estop").success
    stopped = bench.gripper.jaws.opening
    bench.diagnosis(Level.ERROR, "emergency stop")
    assert bench.gripper.jaws.opening == pytest.approx(stopped, abs=STEP)
    bench.move(0.005)
    bench.probe.spin(0.1)
    assert bench.gripper.jaws.opening == pytest.approx(stopped, abs=STEP)
    answer = bench.call("clear_errors")
    assert answer.success, answer.message
    bench.move(0.03, velocity=[0.1])
    bench.probe.wait_for(lambda: abs(bench.gripper.jaws.opening - 0.03) < 2 * STEP)


def test_a_port_that_is_unplugged_is_an_error_until_it_is_back(bench):
    bench = bench()
    bench.wait_for_joints()
    bench.port.close()
    bench.port.adapter.unplug()
    bench.diagnosis(Level.ERROR, "")
    have = len(bench.joints)
    bench.move(0.02)
    bench.probe.spin(0.3)
    assert len(bench.joints) <= have + 1  # one may have been on its way
    bench.port.adapter.replug()
    bench.port.open()
    bench.wait_for_joints(3)
    assert bench.gripper.jaws.opening == pytest.approx(0.048, abs=STEP)
    bench.diagnosis(Level.OK, "")


def test_a_port_that_does_not_exist_is_named_and_waited_for(bench, capfd):
    bench = bench(open_port=False)
    state = bench.diagnosis(Level.ERROR, "/dev/no_such_port")
    assert "\n" not in state.message
    bench.move(0.02)
    answer = bench.call("calibrate")
    assert not answer.success and "/dev/no_such_port" in answer.message
    assert not bench.joints
    logged = capfd.readouterr().err
    assert "gripper on /dev/no_such_port" in logged and "ready" not in logged


def test_a_gripper_without_power_is_named_with_what_to_check(bench):
    bench = bench(**HASTY)
    bench.gripper.handle = lambda message: []
    bench.diagnosis(Level.ERROR, "check its 24 V")


def test_a_gripper_at_another_node_is_found(bench):
    bench = bench(**HASTY, **{"gripper.node_id": 3})
    bench.diagnosis(Level.ERROR, "set node_id to 0")
    assert not bench.joints


def test_a_wrong_adapter_speed_is_silence_with_advice(bench):
    bench = bench(garbled=True, **HASTY)
    bench.diagnosis(Level.ERROR, "baud_rate")
    assert not bench.joints


def test_another_program_that_commands_the_gripper_is_named(bench):
    bench = bench()
    bench.wait_for_joints()
    bench.move(0.03, velocity=[0.1])
    bench.probe.wait_for(lambda: abs(bench.gripper.jaws.opening - 0.03) < 2 * STEP)
    with bench.port.lock:
        bench.port.adapter.put_on_bus(CanMessage(id=0x07A, data=bytes([0x40, 0x80, 0x01, 0xF4, 0xC0])))
    bench.diagnosis(Level.ERROR, "another program")


BAD_COMMANDS = {
    "NaN opening": {"opening": math.nan},
    "negative force": {"opening": 0.02, "effort": [-1.0]},
    "NaN speed": {"opening": 0.02, "velocity": [math.nan]},
    "beyond the stroke": {"opening": 0.06},
}


def test_bad_commands_are_named_and_move_nothing(bench):
    bench = bench()
    bench.wait_for_joints()
    for name, fields in BAD_COMMANDS.items():
        bench.probe.got["/diagnostics"].clear()
        bench.move(**fields)
        bench.diagnosis(Level.ERROR, "got")
        assert bench.gripper.jaws.opening == pytest.approx(0.048, abs=STEP), name
    assert not bench.gripper.order.action


def test_the_power_stage_is_switched_off_and_on(bench):
    bench = bench()
    bench.wait_for_joints()
    assert bench.call("activate", SetBool, SetBool.Request(data=True)).success
    bench.probe.wait_for(lambda: bench.gripper.order.activated)
    assert bench.call("activate", SetBool, SetBool.Request(data=False)).success
    bench.probe.wait_for(lambda: not bench.gripper.order.activated)


def grasped(bench, variant="new", **parameters):
    """A bench that holds 1 N, and its fingers."""
    bench = bench(variant, **parameters)
    bench.wait_for_joints()
    fingers = Fingers(bench)
    answer = bench.call("grasp", patience=60.0)
    assert answer.success, answer.message
    return bench, fingers


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_grasp_holds_the_set_force(bench, variant):
    bench, fingers = grasped(bench, variant)
    # one step of the gripper is 0.15 N here, and the tolerance of the grasp 0.05 N
    assert fingers.present == pytest.approx(1.0, abs=0.2)


def test_the_force_is_changed_without_letting_go(bench):
    bench, fingers = grasped(bench)
    goal = bench.probe.speak("/gripper_driver/grasp_goal", JointState)
    bench.probe.connected(goal)
    for force in (2.0, 1.0):
        goal.publish(JointState(effort=[force]))
        bench.probe.wait_for(lambda force=force: fingers.present == pytest.approx(force, abs=0.2))
    assert bench.node.session.runs


def test_a_camera_that_falls_silent_ends_the_grasp_in_place(bench):
    bench, fingers = grasped(bench)
    fingers.timer.cancel()
    bench.probe.wait_for(lambda: not bench.node.session.runs)
    held = bench.gripper.jaws.opening
    state = bench.probe.got["/gripper_driver/grasp_state"]
    bench.probe.wait_for(lambda: state and state[-1].level[0] == Level.WARN)
    assert "s old" in state[-1].message or "silent" in state[-1].message or "force" in state[-1].message
    bench.probe.spin(0.3)
    assert bench.gripper.jaws.opening == pytest.approx(held, abs=STEP)


def test_an_emergency_stop_ends_a_grasp(bench):
    bench, _ = grasped(bench)
    assert bench.call("estop").success
    assert not bench.node.session.runs
    bench.probe.wait_for(lambda: bench.gripper.faults)


def test_a_grasp_without_vision_holds_with_the_motors_force(bench):
    bench = bench(motor_force=10.0, grasp_speed=0.05)
    bench.wait_for_joints()
    bench.gripper.jaws.object_opening = 0.04
    answer = bench.call("grasp_without_vision")
    assert answer.success and "without vision" in answer.message, answer.message
    assert bench.gripper.jaws.opening == pytest.approx(0.04, abs=STEP)


def test_release_opens_again(bench):
    bench = bench(release_opening=0.045, **{"gripper.default_speed": 0.1})
    bench.wait_for_joints()
    bench.move(0.04, velocity=[0.1])
    bench.probe.wait_for(lambda: bench.gripper.jaws.opening < 0.041)
    answer = bench.call("release")
    assert answer.success, answer.message
    assert bench.gripper.jaws.opening == pytest.approx(0.045, abs=2 * STEP)


def test_what_was_asked_for_before_a_stop_does_not_move_the_jaws_after_it(bench):
    bench = bench(**{"gripper.default_speed": 0.01})
    bench.wait_for_joints()
    bench.move(0.04, velocity=[0.1])
    bench.probe.wait_for(lambda: bench.gripper.jaws.opening < 0.041)
    answers = [ask(bench.probe, Trigger, "release") for _ in range(3)]
    bench.probe.wait_for(lambda: bench.gripper.jaws.opening > 0.0415)
    assert bench.call("stop").success
    left = bench.gripper.jaws.opening
    bench.probe.wait_for(lambda: all(answer.done() for answer in answers))
    bench.probe.spin(0.3)  # in which a waiting release would open by 3 mm
    assert not any(answer.result().success for answer in answers)
    assert bench.gripper.jaws.opening == pytest.approx(left, abs=2 * STEP)


def test_a_driver_that_ends_while_the_gripper_calibrates_stops_it(bench):
    bench = bench(calibrated=False)
    bench.diagnosis(Level.WARN, "not calibrated")
    ask(bench.probe, Trigger, "calibrate")
    bench.probe.wait_for(lambda: bench.gripper.mode.name.lower() == "calibrate")
    bench.node.destroy_node()
    bench.probe.wait_for(lambda: bench.gripper.mode.name.lower() != "calibrate")


def test_a_driver_that_ends_leaves_moving_jaws_where_they_are(bench):
    bench = bench()
    bench.wait_for_joints()
    bench.move(0.005, velocity=[0.01])
    bench.probe.wait_for(lambda: bench.gripper.jaws.opening < 0.047)
    bench.node.destroy_node()
    left = bench.gripper.jaws.opening
    bench.probe.spin(0.2)
    assert bench.gripper.jaws.opening == pytest.approx(left, abs=2 * STEP)
