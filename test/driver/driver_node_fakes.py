"""A gripper that does what a test says, and driver nodes around it on a DDS domain of their own."""

import math
from dataclasses import replace
from threading import Condition, Thread
from time import monotonic, sleep, time_ns
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from node_fakes import PATIENCE
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from finforce.ros import node as ros
from finforce_driver.errors import GripperStateError, GripperTimeoutError, TargetError
from finforce_driver.gripper import Clock
from finforce_driver.node import GripperDriverNode
from finforce_driver.settings import GripperSettings
from finforce_driver.state import GripperState, MoveOutcome, Phase

COMMAND, GOAL = "/gripper_driver/command", "/gripper_driver/grasp_goal"
READY = GripperState(
    phase=Phase.READY,
    opening=0.03,
    velocity=0.0,
    current=-0.02,
    force=0.95,
    target=0.03,
    calibrated=True,
    activated=True,
    message="ready",
    temperature=26.0,
    voltage=24.0,
    latency=0.002,
)


class FakeGripper:
    """Keeps what it is told in `calls`, and answers only when a test says `reply`."""

    resolution = 0.048 / 255

    def __init__(self, state=READY, **settings):
        self.settings, self.clock = GripperSettings(**settings), Clock()
        self.state = state
        self.calls, self.listeners = [], []
        self.started = self.closed = False
        self.refusal = None
        self._changed = Condition()

    def reply(self, **changes):
        with self._changed:
            self.state = replace(self.state, **{"stamp": monotonic(), **changes})
            self._changed.notify_all()
        for listener in self.listeners:
            listener(self.state)

    def listen(self, callback):
        self.listeners.append(callback)
        return lambda: self.listeners.remove(callback) if callback in self.listeners else None

    def start(self):
        self.started = True

    def close(self):
        self.closed = True

    def wait(self, condition, timeout):
        deadline = monotonic() + timeout
        with self._changed:
            while not condition(self.state):
                if monotonic() > deadline:
                    raise GripperTimeoutError(f"waited {timeout} s in vain")
                self._changed.wait(0.02)
            return self.state

    def opening_at(self, time):
        return self.state.opening

    def move(self, opening, speed=None, force=None):
        for name, value in (("opening", opening), ("speed", speed), ("force", force)):
            if value is not None and not (math.isfinite(value) and value >= 0.0):
                raise TargetError(f"{name}: got {value}, expected a number that is not negative")
        self._do("move", opening, speed, force)
        self.state = replace(self.state, phase=Phase.MOVING, outcome=MoveOutcome.NONE, target=opening)

    def activate(self, on):
        self._do("activate", on)

    def calibrate(self):
        self._do("calibrate")
        self.state = replace(self.state, phase=Phase.CALIBRATING)

    def clear_errors(self):
        self._do("clear_errors")

    def hold(self):
        self._do("hold")

    def estop(self):
        self._do("estop")

    def release_power(self):
        self._do("release_power")

    def _do(self, *call):
        if self.refusal:
            raise GripperStateError(self.refusal)
        self.calls.append(call)


class Caller:
    """Runs a call that waits in a thread of its own, for the length of a block."""

    def __init__(self, call):
        self._call, self._outcome = call, {}
        self._thread = Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._thread.join(PATIENCE)
        assert self.done

    @property
    def done(self):
        return not self._thread.is_alive()

    def wait_for(self, condition):
        until = monotonic() + PATIENCE
        while not condition():
            assert monotonic() < until
            sleep(0.005)

    def result(self):
        self._thread.join(PATIENCE)
        if "error" in self._outcome:
            raise self._outcome["error"]
        return self._outcome["value"]

    def _run(self):
        try:
            self._outcome["value"] = self._call()
        except Exception as error:
            self._outcome["error"] = error


class FakeGoal:
    """A goal of the standard action."""

    def __init__(self, position, max_effort=0.0):
        command = SimpleNamespace(position=position, max_effort=max_effort)
        self.request = SimpleNamespace(command=command)
        self.is_cancel_requested = False
        self.feedback, self.ends = [], []
        self.publish_feedback = self.feedback.append
        for name in ("succeed", "abort", "canceled"):
            setattr(self, name, lambda name=name: self.ends.append(name))


def start_driver(probe, gripper=None, remap=(), **parameters):
    """Add a driver node around a fake gripper to the probe's executor."""
    given = {"diagnostics_period": 0.1, **parameters}
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    build = {} if gripper is None else {"build": lambda *_: gripper}
    words = ["--ros-args", *(word for rule in remap for word in ("-r", rule))] if remap else None
    node = GripperDriverNode(context=probe.context, parameter_overrides=overrides, cli_args=words, **build)
    probe.spinner.add_node(node)
    probe.hear("joint_states", JointState)
    probe.hear("/gripper_driver/grasp_state", DiagnosticStatus, ros.LATCHED)
    return node


def call(probe, kind, name, request=None, patience=PATIENCE):
    """What a service of the driver answers."""
    client = probe.create_client(kind, f"/gripper_driver/{name}")
    assert client.wait_for_service(PATIENCE)
    answer = client.call_async(request or kind.Request())
    probe.wait_for(answer.done, patience)
    return answer.result()


def driver(probe, state=READY, **parameters):
    """A driver node around a fake gripper, both ends of joint_states found."""
    gripper = FakeGripper(state)
    node = start_driver(probe, gripper, **parameters)
    probe.wait_for(lambda: node.joints.get_subscription_count() == 1)
    return gripper, node


def send(probe, topic, message):
    """Publish a message to the driver once it listens."""
    out = probe.speak(topic, type(message))
    probe.connected(out)
    out.publish(message)


def gripper_state(probe, level=None, word=""):
    """Wait for the diagnosis of the gripper at a level, with a word in its message."""
    found = []

    def matches():
        states = [s for array in probe.got["/diagnostics"] for s in array.status if s.name == "finforce: gripper"]
        found[:] = [s for s in states if (level is None or s.level[0] == level) and word in s.message]
        return bool(found)

    probe.wait_for(matches)
    return found[-1]


def ask(probe, kind, name, request=None):
    """Ask a service and return the answer that is to come."""
    client = probe.create_client(kind, f"/gripper_driver/{name}")
    assert client.wait_for_service(10.0)
    return client.call_async(request or kind.Request())


def wrench(force, *, stamp=None, message="gripper_base"):
    header = Header(stamp=ros.stamp_message(time_ns() if stamp is None else stamp), frame_id=message)
    return WrenchStamped(header=header, wrench=Wrench(force=Vector3(x=force)))
