"""The way of a joint's commands and states through ROS: a topic, or one of the standard actions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from sensor_msgs.msg import JointState

from finforce.errors import FinforceError
from finforce.optional import import_library
from finforce.ros import node as ros
from finforce_driver.errors import TargetError
from finforce_driver.joint.gripper import JointCommand, JointGripper
from finforce_driver.joint.settings import JointSettings
from finforce_driver.settings import GripperSettings

LINKS = ("joint_command", "parallel_gripper_command", "gripper_command")


class JointLink:
    """A `JointGripper` on a node: it listens to the joint's states and sends commands.

    Args:
        node: whose topics and clock they are.
        kind: of `LINKS`: a topic with JointState, or an action.
        target: name of the topic or the action.
        settings: of the gripper.
        joint: of the joint.

    Attributes:
        gripper: it.

    Raises:
        TargetError: there is no name.
        MissingDependencyError: it is an action, and control_msgs is not installed.
    """

    def __init__(self, node: Any, kind: str, target: str, settings: GripperSettings, joint: JointSettings) -> None:
        if not target:
            raise TargetError(f"port: got none, expected the name of the {kind} to send to")
        self._node, self._joint = node, joint
        self._send = self._topic(target) if kind == "joint_command" else self._action(kind, target)
        self.gripper = JointGripper(self._send, settings, joint)
        node.create_subscription(JointState, "joint_states", self._take, ros.SENSOR)
        node.create_timer(1.0 / (joint.rate or 10.0), self.gripper.tick)

    def _take(self, message: JointState) -> None:
        """Hand on the joint's value, with the time at which it came: the joint's clock may be another one."""
        names = list(message.name)
        first = self._joint.names[0]
        if first not in names or len(message.position) != len(names):
            return
        index = names.index(first)
        effort = message.effort[index] if len(message.effort) == len(names) else math.nan
        try:
            self.gripper.take(message.position[index], self.gripper.clock.now(), effort)
        except FinforceError as error:
            self._node.get_logger().warning(f"joint state refused: {error}", throttle_duration_sec=5.0)

    def _message(self, command: JointCommand) -> JointState:
        """Return a command for all joints alike; what it does not say stays empty."""
        count = len(self._joint.names)
        return JointState(
            name=list(self._joint.names),
            position=[command.position] * count,
            velocity=[command.velocity] * count if math.isfinite(command.velocity) and not self._joint.rate else [],
            effort=[command.effort] * count if math.isfinite(command.effort) else [],
        )

    def _topic(self, target: str) -> Callable[[JointCommand], None]:
        out = self._node.create_publisher(JointState, target, ros.RESULT)
        return lambda command: out.publish(self._message(command))

    def _action(self, kind: str, target: str) -> Callable[[JointCommand], None]:
        from rclpy.action import ActionClient

        actions = import_library("control_msgs.action", f"port:={target}")
        parallel = kind == "parallel_gripper_command"
        action = actions.ParallelGripperCommand if parallel else actions.GripperCommand
        client = ActionClient(self._node, action, target)

        def send(command: JointCommand) -> None:
            goal = action.Goal()
            if parallel:
                goal.command = self._message(command)
            else:
                goal.command.position = command.position
                goal.command.max_effort = command.effort if math.isfinite(command.effort) else 0.0
            if client.server_is_ready():
                client.send_goal_async(goal)
            else:
                self._node.get_logger().warning(f"no action server {target}", throttle_duration_sec=5.0)

        return send
