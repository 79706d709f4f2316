"""The topics that a gripper driver writes: what stands in each of them, and when it is sent."""

from __future__ import annotations

import math

from finforce.health import Report
from finforce.ros import node as ros
from finforce_driver.diagnostics import describe_grasp, outcome_of_grasp
from finforce_driver.grasp.status import GraspStatus
from finforce_driver.parameters import DriverParameters
from finforce_driver.state import GripperState


class DriverOutputs:
    """The publishers of a gripper driver node.

    Args:
        qos: makes publishers and watches them.
        parameters: names of the joints.
    """

    def __init__(self, qos: ros.QosWatch, parameters: DriverParameters) -> None:
        self._names, self._source = parameters.joint_names, qos.node.get_name()
        self._told: tuple[str, str] | None = None
        self.joints = qos.publisher(ros.JointState, "joint_states", ros.RESULT)
        self.grasp = qos.publisher(ros.DiagnosticStatus, "~/grasp_state", ros.LATCHED)

    def send_joints(self, stamp: int, state: GripperState) -> None:
        """Send the joints as a reply at `stamp` [ns] shows them, unless it does not tell all of them."""
        values = (state.opening / 2.0, state.velocity / 2.0, state.force)
        if all(map(math.isfinite, values)):
            header = ros.Header(stamp=ros.stamp_message(stamp))
            self.joints.publish(ros.joint_state_message(header, self._names, *([value] * 2 for value in values)))

    def send_grasp(self, status: GraspStatus | None) -> None:
        """Send how the grasp is, when its phase or its reason has changed."""
        if status is None:
            return
        outcome = outcome_of_grasp(status)
        if self._told != (told := (outcome.reason, outcome.text)):
            self._told = told
            report = Report(level=outcome.level, message=outcome.text, values=describe_grasp(status))
            self.grasp.publish(ros.status_message("finforce: grasp", self._source, report))
