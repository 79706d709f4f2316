"""The node of the SSG-48 gripper: commands and forces in, joint states out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from geometry_msgs.msg import WrenchStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import JointState, PointCloud2

from finforce.errors import FinforceError, MissingDependencyError
from finforce.health import Level, Outcome, Report
from finforce.messages import stamp_of
from finforce.optional import import_library
from finforce.ros import node as ros
from finforce_driver.can import build_bus
from finforce_driver.conversions import (
    GripperHealth,
    MessageTimes,
    fill_gripper_command,
    fill_joint_state,
    find_alarms,
    goal_from_joint_state,
    move_from_gripper_command,
    move_from_joint_state,
    move_from_parallel_command,
    news_of_state,
    outcome_of_grasp,
    outcome_of_state,
)
from finforce_driver.errors import GraspError, TargetError
from finforce_driver.grasp.controller import check_force_value
from finforce_driver.grasp.force_monitor import ForceSample
from finforce_driver.grasp.session import GraspSession
from finforce_driver.gripper import Gripper
from finforce_driver.joint import JointGripper, SendCommand
from finforce_driver.services import GripperTasks, MoveAction
from finforce_driver.settings import DriverParameters, GraspGoal, GraspSettings, GripperSettings, JointSettings
from finforce_driver.state import GripperState, describe_record

JAWS = ("left", "right")
LINKS = ("joint_command", "parallel_gripper_command", "gripper_command")  # of other grippers
ACTIONS = {"GripperCommand": "~/gripper_cmd", "ParallelGripperCommand": "~/parallel_gripper_cmd"}


def build_gripper(parameters: DriverParameters, settings: GripperSettings) -> Gripper:
    """Make the driver of the gripper that the parameters name; nothing is opened before it starts.

    Raises:
        TargetError: release_opening is beyond the stroke.
    """
    if not math.isnan(parameters.release_opening):
        settings.check_opening("release_opening", parameters.release_opening)
    return Gripper(build_bus(parameters.port, parameters.interface, baud_rate=parameters.baud_rate), settings)


class _JointLink:
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
        send = self._topic(target) if kind == "joint_command" else self._action(kind, target)
        self.gripper = JointGripper(send, settings, joint)
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
            self._node.get_logger().warning(f"joint state rejected: {error}", throttle_duration_sec=5.0)

    def _message(self, position: float, velocity: float, effort: float) -> JointState:
        """Return a command for all joints alike; what it does not say stays empty."""
        count = len(self._joint.names)
        return JointState(
            name=list(self._joint.names),
            position=[position] * count,
            velocity=[velocity] * count if math.isfinite(velocity) and not self._joint.rate else [],
            effort=[effort] * count if math.isfinite(effort) else [],
        )

    def _topic(self, target: str) -> SendCommand:
        out = self._node.create_publisher(JointState, target, ros.RESULT)
        return lambda *command: out.publish(self._message(*command))

    def _action(self, kind: str, target: str) -> SendCommand:
        from rclpy.action import ActionClient

        actions = import_library("control_msgs.action", f"port:={target}")
        parallel = kind == "parallel_gripper_command"
        action = actions.ParallelGripperCommand if parallel else actions.GripperCommand
        client = ActionClient(self._node, action, target)

        def send(position: float, velocity: float, effort: float) -> None:
            goal = action.Goal()
            if parallel:
                goal.command = self._message(position, velocity, effort)
            else:
                goal.command.position = position
                goal.command.max_effort = effort if math.isfinite(effort) else 0.0
            if client.server_is_ready():
                client.send_goal_async(goal)
            else:
                self._node.get_logger().warning(f"no action server {target}", throttle_duration_sec=5.0)

        return send


class GripperDriverNode(Node):
    """Drives one gripper; what is wrong with a command leaves it as it was.

    Args:
        build: makes the gripper's driver from parameters and settings.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter cannot be used.
    """

    def __init__(self, build: Callable[..., Any] = build_gripper, **options: Any) -> None:
        super().__init__("gripper_driver", **options)
        self.parameters = parameters = ros.declare_record(self, DriverParameters)
        settings = ros.declare_record(self, GripperSettings, "gripper")
        grasp = ros.declare_record(self, GraspSettings, "grasp")
        joint = ros.declare_record(self, JointSettings, "joint")
        ros.name_unknown_parameters(self)
        # another gripper's driver has joint states and actions of its own
        self.is_other = parameters.interface in LINKS
        if self.is_other:
            self.gripper = _JointLink(self, parameters.interface, parameters.port, settings, joint).gripper
        else:
            self.gripper = build(parameters, settings)
        self.wake = self.create_guard_condition(self._on_states)
        first = {name: getattr(parameters, f"grasp_{name}") for name in ("force", "speed", "time_limit")}
        self.session = GraspSession(self.gripper, GraspGoal(**first), grasp, self.wake.trigger)
        self.tasks = GripperTasks(self.gripper, self.session, parameters)
        told = [f"{side} stddev" for side in JAWS]
        self.times = MessageTimes(self.gripper.clock, ("force", *JAWS, *told), parameters.max_age)
        self.health = GripperHealth(source=parameters.port, stale_after=parameters.max_age)
        self.stage = ros.Stage(self)
        self.joints = None if self.is_other else self.stage.publisher(JointState, "joint_states", ros.RESULT)
        self.grasp_state = self.stage.publisher(ros.DiagnosticStatus, "~/grasp_state", ros.LATCHED)
        self.seen: ForceSample | None = None
        self.stale_after = grasp.stale_after
        self.arrived: deque[GripperState] = deque(maxlen=100)
        self.published = -math.inf
        self._serve()
        self._subscribe()
        self.forget = self.gripper.listen(self._take_state)
        self.gripper.start()
        self.get_logger().info(f"node started, gripper on {parameters.port} ({parameters.interface})")

    def _serve(self) -> None:
        """Offer services, whose waiting holds up nothing else, and diagnostics."""
        tasks = self.tasks
        for name in ("estop", "stop"):
            ros.serve_trigger(self.stage, f"~/{name}", getattr(tasks, name))
        for name in ("calibrate", "clear_errors", "grasp", "grasp_without_vision", "release"):
            # what waits for an earlier call would move the jaws after a stop
            ros.serve_trigger(self.stage, f"~/{name}", getattr(tasks, name), ReentrantCallbackGroup())
        ros.serve_switch(self.stage, "~/activate", tasks.activate)
        offered = [] if self.is_other else ACTIONS
        self.actions = [action for action in map(self._offer_action, offered) if action is not None]
        ros.publish_diagnostics(self.stage, "finforce: gripper", self.parameters.diagnostics_period, self._report)

    def _offer_action(self, name: str) -> ActionServer | None:
        """Offer a standard action, if it is installed; a newer goal ends an older one."""
        topic = ACTIONS[name]
        try:
            kind = getattr(import_library("control_msgs.action", topic), name, None)
        except MissingDependencyError:
            kind = None
        if kind is None:
            self.get_logger().info(f"action {topic} is not available: {name} of control_msgs is not installed")
            return None
        read, fill = move_from_gripper_command, fill_gripper_command
        if name == "ParallelGripperCommand":
            read, fill = partial(move_from_parallel_command, joints=self.parameters.joint_names), self._fill_joints
        action = MoveAction(kind, read, fill, self.gripper, self.tasks)

        async def execute(handle: Any) -> Any:
            return await ros.run_aside(self, partial(action.execute, handle))

        def judge(goal: Any) -> GoalResponse:
            if rejection := action.rejection(goal):
                self.get_logger().warning(f"goal of {topic} rejected: {rejection}")
            elif remark := action.remark(goal):
                self.get_logger().info(f"goal of {topic}: {remark}")
            return GoalResponse.REJECT if rejection else GoalResponse.ACCEPT

        accept = {"goal_callback": judge, "cancel_callback": lambda _: CancelResponse.ACCEPT}
        return ActionServer(self, kind, topic, execute, **accept)

    def _subscribe(self) -> None:
        """Create the subscriptions; a node that has them is ready."""
        shared = {"is_exclusive": False}  # several programs may command; of rival forces the grasp is told
        self.stage.subscription(JointState, "~/command", self._on_command, ros.RESULT, **shared)
        self.stage.subscription(JointState, "~/grasp_goal", self._on_goal, ros.RESULT, **shared)
        self.stage.subscription(WrenchStamped, "grasp_wrench", self._on_wrench, ros.SENSOR, **shared)
        for side in JAWS:
            self.stage.subscription(PointCloud2, f"{side}/contact", partial(self._on_contact, side), ros.SENSOR)
            stddev = f"{side}/wrench_stddev"
            self.stage.subscription(WrenchStamped, stddev, partial(self._on_stddev, side), ros.RESULT)

    def _take_state(self, state: GripperState) -> None:
        """Keep a state, in the gripper's thread, until the node's own thread has time for it."""
        self.arrived.append(state)
        self.wake.trigger()

    def _on_states(self) -> None:
        """Publish the states that have come, and go on with the grasp."""
        while self.arrived:
            state = self.arrived.popleft()
            self.session.update(state)
            if state.stamp > self.published:
                self.published = state.stamp
                self.health.take(state, self.gripper.clock.now())
                with self._rejections("joint state"):
                    stamp = self.times.to_stamp(state.stamp, self._now())
                    if self.joints is not None:
                        message = JointState(header=ros.Header(stamp=ros.stamp_message(stamp)))
                        fill_joint_state(message, self.parameters.joint_names, state, self._effort(state))
                        self.joints.publish(message)
            if self.health.is_news("gripper", text := news_of_state(state)):
                self._log(outcome_of_state(state).level, text)
        self._tell_grasp()

    def _fill_joints(self, message: Any, state: GripperState) -> None:
        """Write a state into a result or feedback of control_msgs/ParallelGripperCommand."""
        fill_joint_state(message.state, self.parameters.joint_names, state, self._effort(state))

    def _effort(self, state: GripperState) -> float | None:
        """Return the force for joint_states [N]; None where none is trusted."""
        if self.parameters.joint_effort == "motor":
            return state.force if math.isfinite(state.force) else None
        status, seen = self.session.status, self.seen
        wrong = self.parameters.joint_effort == "none" or seen is None or (status is not None and status.unseen)
        if wrong or self.gripper.clock.now() - seen.stamp > self.stale_after:
            return None
        try:
            return check_force_value(seen.force)
        except GraspError:
            return None

    def _tell_grasp(self) -> None:
        """Publish how the grasp is when its phase or its reason has changed, and log that it failed."""
        status = self.session.status
        if status is not None and self.health.is_news("grasp state", f"{status.phase.value}: {status.reason}"):
            outcome = outcome_of_grasp(status)
            report = Report(level=outcome.level, message=outcome.text, values=describe_record(status))
            self.grasp_state.publish(ros.status_message("finforce: grasp", self.get_name(), report))
            if status.failed:
                self._log(outcome.level, f"the grasp failed: {outcome.text}")

    def _log(self, level: Level, text: str) -> None:
        """Log a sentence at the level of a diagnosis."""
        if level == Level.OK:
            self.get_logger().info(text)
        elif level == Level.WARN:
            self.get_logger().warning(text)
        else:
            self.get_logger().error(text)

    def _on_command(self, message: JointState) -> None:
        """Move as a message says."""
        with self._rejections("command"):
            self.tasks.stream(move_from_joint_state(message, self.parameters.joint_names))

    def _on_goal(self, message: JointState) -> None:
        """Set the goal of the grasp that runs, and of the next."""
        with self._rejections("grasp goal", stream=False):
            self.session.set_goal(goal_from_joint_state(message, self.session.goal))

    def _on_wrench(self, message: WrenchStamped) -> None:
        """Hand the force of an image to the grasp."""
        with self._rejections("force", told=self.session.reject):
            if rivals := ros.describe_rivals(self, "grasp_wrench"):
                raise TargetError(rivals)
            force, stamp = ros.grasp_force(message, self.parameters.base_frame), self._enter("force", message)
            sample = ForceSample(stamp=stamp, arrived=self.gripper.clock.now(), force=force)
            self.session.take_force(sample)
            self.seen = sample
            self._tell_grasp()

    def _on_stddev(self, side: str, message: WrenchStamped) -> None:
        """Keep how sure a jaw's force is."""
        with self._rejections("standard deviation"):
            stddev = ros.force_stddev(message, self.parameters.jaw_frame(side))
            self.session.take_stddev(side, stddev, self._enter(f"{side} stddev", message))

    def _on_contact(self, side: str, cloud: PointCloud2) -> None:
        """Hand to the grasp whether a jaw touches the object."""
        with self._rejections("contact"):
            touching = ros.is_touching(cloud, self.parameters.jaw_frame(side))
            self.session.take_touch(side, touching, self._enter(side, cloud))

    def _enter(self, source: str, message: Any) -> float:
        """Return the stamp of a fresh message on the gripper's clock [s]."""
        return self.times.enter(source, stamp_of(message), self._now())

    @contextmanager
    def _rejections(
        self, what: str, stream: bool = True, told: Callable[[str], None] = lambda _: None
    ) -> Iterator[None]:
        """Log what is wrong with a message and go on; in a stream only once while its kind is the same."""
        kind = ""
        try:
            yield
        except FinforceError as error:
            told(str(error))
            self.health.refuse(outcome := Outcome.of_error(error))
            kind = outcome.reason
            if self.health.is_news(what, kind) or not stream:
                self.get_logger().warning(f"{what} rejected: {error}")
        self.health.is_news(what, kind)

    def _report(self, alarms: list[Outcome]) -> Report:
        """Return how gripper and grasp are doing."""
        state, status = self.gripper.state, self.session.status
        values = describe_record(state) | ({} if status is None else describe_record(status))
        return self.health.report([*alarms, *find_alarms(state, status)], values)

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds

    def destroy_node(self) -> None:
        """Leave the gripper holding, or limp where the parameters say so, and end the node."""
        self.tasks.close()
        self.forget()
        self.gripper.close()
        while self.actions:
            self.actions.pop().destroy()
        super().destroy_node()
