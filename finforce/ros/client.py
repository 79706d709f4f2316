"""The gripper for a script: the driver node's services and topics as calls."""

from __future__ import annotations

import math
from collections.abc import Callable
from threading import Thread
from time import monotonic, sleep
from types import TracebackType
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from finforce.errors import ServiceError
from finforce.ros import node as ros

FRESH = 0.5  # [s] for which a force or an opening is what there is
DISCOVERY = 10.0  # [s] in which the driver is found
FOUND = 2.0  # [s] after which a publisher that there is has been found
TOLD = 0.2  # [s] in which a goal reaches a driver before it is asked to grasp
ARRIVED = 1e-3  # [m] from an opening at which it is reached
LONGEST_MOVE = 15.0  # [s] that a move may take
NO_ADAPTER = "there is no port"  # in the driver's answer
LONGEST = 120.0  # [s] that a service may take


class GripperClient:
    """Calls a gripper driver that runs elsewhere, from a script without a node of its own.

    Args:
        driver: name of the driver's node, in the namespace of whose robot forces and joint states are.
        context: of rclpy; None: the default one, which is initialised where it is not, and shut down at the end.
    """

    def __init__(self, driver: str = "gripper_driver", context: Any = None) -> None:
        self._driver, self._owned = driver, context is None and not rclpy.ok()
        if self._owned:
            rclpy.init()
        self._node = rclpy.create_node("gripper_client", context=context)
        self._began = monotonic()
        self._force: tuple[float, float] = (-math.inf, math.nan)  # when [s], and how much [N]
        self._opening: tuple[float, float] = (-math.inf, math.nan)
        self._grasp = ""
        node = self._node
        self._commands = node.create_publisher(JointState, f"{driver}/command", ros.RESULT)
        self._goals = node.create_publisher(JointState, f"{driver}/grasp_goal", ros.RESULT)
        space = driver[: driver.rfind("/") + 1]
        self._topic = node.resolve_topic_name(f"{space}grasp_wrench")
        node.create_subscription(WrenchStamped, self._topic, self._take_force, ros.SENSOR)
        node.create_subscription(JointState, f"{space}joint_states", self._take_joints, ros.RESULT)
        node.create_subscription(DiagnosticStatus, f"{driver}/grasp_state", self._take_grasp, ros.LATCHED)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)
        self._thread = Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def __enter__(self) -> GripperClient:
        """Return the client."""
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """End the client; the gripper stays as it is."""
        self.disconnect()

    def disconnect(self) -> None:
        """End the client; the gripper stays as it is."""
        self._executor.shutdown()
        self._thread.join(DISCOVERY)
        self._node.destroy_node()
        if self._owned:
            rclpy.shutdown()

    @property
    def force(self) -> float | None:
        """The grasp force [N]; None while none comes that is trusted. A warning says if nobody publishes any, or two.

        The two may be nodes of different robots.
        """
        force, trouble = _fresh(self._force), ros.describe_rivals(self._node, self._topic)
        if force is None and monotonic() - self._began > FOUND and not self._node.count_publishers(self._topic):
            trouble = (
                f"nobody publishes {self._topic}, where the {self._driver} is: start a solver there with finforce "
                "launch or pipeline"
            )
        if trouble:
            self._node.get_logger().warning(trouble, throttle_duration_sec=5.0)
        return None if trouble else force

    @property
    def opening(self) -> float | None:
        """The opening between the jaws [m]; None while it is not known."""
        return _fresh(self._opening)

    @property
    def grasp_state(self) -> str:
        """The driver's report on the last grasp, as "holding: holds the set force"; empty before the first."""
        return self._grasp

    def calibrate(self) -> str:
        """Find the end stops, over the whole stroke; return the driver's answer when that is done.

        Waits for an adapter that is not there yet, as that of a simulated gripper while its images are rendered.

        Raises:
            ServiceError: it failed, with the driver's reason; so for all calls.
        """
        end = monotonic() + LONGEST
        while True:
            try:
                return self._call("calibrate")
            except ServiceError as error:
                if NO_ADAPTER not in str(error) or monotonic() > end:
                    raise
                self._node.get_logger().info(f"waiting for the gripper: {error}", throttle_duration_sec=10.0)
                sleep(1.0)

    def grasp(self, force: float, speed: float | None = None) -> str:
        """Close until a force [N] is held, at a speed of the opening [m/s]; return the driver's answer.

        The driver goes on holding the force, until something else is asked for.
        """
        self._tell(self._goals, "grasp_goal", JointState(effort=[float(force)], velocity=_known(speed)))
        sleep(TOLD)
        return self._call("grasp")

    def move(self, opening: float, speed: float | None = None) -> None:
        """Move the jaws to an opening [m] at a speed of the opening [m/s]; return when they are there.

        Raises:
            ServiceError: they are not there in time, because of an object, a rejected command or a fault.
        """
        self._tell(self._commands, "command", JointState(position=[float(opening)], velocity=_known(speed)))
        missed = f"{self._driver}: the jaws did not get to {1e3 * opening:.1f} mm in {LONGEST_MOVE:g} s"
        _await(lambda: (now := self.opening) is not None and abs(now - opening) < ARRIVED, LONGEST_MOVE, missed)

    def close(self, speed: float | None = None) -> None:
        """Close the jaws without an object between them; see `move`. `grasp` holds an object, `disconnect` ends."""
        self.move(0.0, speed)

    def release(self) -> str:
        """Open; return the driver's answer when that is done."""
        return self._call("release")

    def stop(self) -> str:
        """Hold in place."""
        return self._call("stop")

    def estop(self) -> str:
        """Stop at once, limp."""
        return self._call("estop")

    def clear_errors(self) -> str:
        """Clear faults and emergency stops."""
        return self._call("clear_errors")

    def _tell(self, publisher: Any, topic: str, message: JointState) -> None:
        """Publish a message once the driver listens."""
        missing = f"{self._driver}: no subscriber on its {topic}; is the driver running?"
        _await(lambda: publisher.get_subscription_count() > 0, DISCOVERY, missing)
        publisher.publish(message)

    def _call(self, name: str) -> str:
        service = f"{self._driver}/{name}"
        client = self._node.create_client(Trigger, service)
        try:
            if not client.wait_for_service(DISCOVERY):
                raise ServiceError(f"{service}: not there for {DISCOVERY:g} s; is the driver running, in this domain?")
            answer = client.call_async(Trigger.Request())
            _await(answer.done, LONGEST, f"{service}: no answer for {LONGEST:g} s")
            if not answer.result().success:
                raise ServiceError(f"{service}: {answer.result().message}")
            return answer.result().message
        finally:
            self._node.destroy_client(client)

    def _take_force(self, message: WrenchStamped) -> None:
        self._force = monotonic(), message.wrench.force.x

    def _take_joints(self, message: JointState) -> None:
        jaws = [
            position
            for name, position in zip(message.name, message.position, strict=False)
            if name.endswith("jaw_joint")
        ]
        if len(jaws) == 2:
            self._opening = monotonic(), sum(jaws)

    def _take_grasp(self, message: DiagnosticStatus) -> None:
        phase = next((entry.value for entry in message.values if entry.key == "grasp"), "")
        self._grasp = f"{phase}: {message.message}"


def _await(condition: Callable[[], bool], longest: float, complaint: str) -> None:
    """Return when a condition holds; raise ServiceError if it does not for the longest time [s]."""
    end = monotonic() + longest
    while not condition():
        if monotonic() > end:
            raise ServiceError(complaint)
        sleep(0.005)


def _known(value: float | None) -> list[float]:
    return [] if value is None else [float(value)]


def _fresh(last: tuple[float, float]) -> float | None:
    when, value = last
    return value if monotonic() - when < FRESH else None
