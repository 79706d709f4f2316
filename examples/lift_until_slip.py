"""A node that closes until 2 N, lifts, and stops when what it holds slips.

It lifts by a velocity on `~/lift` (geometry_msgs/TwistStamped), as MoveIt Servo takes it:
`python lift_until_slip.py --ros-args -r ~/lift:=/servo_node/delta_twist_cmds`. The driver watches the force; when it
falls or jumps as no motion of the jaws explains, the grasp ends, and so does the lift.
"""

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped, WrenchStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LEAST_SHARE = 0.6  # of the set force, below which what is held is about to go


class LiftUntilSlip(Node):
    """Grasps, lifts while the force is held, and stands still as soon as it is not."""

    def __init__(self):
        super().__init__("lift_until_slip")
        self.force = self.declare_parameter("force", 2.0).value  # N
        self.speed = self.declare_parameter("speed", 0.05).value  # m/s, upwards
        self.way = self.declare_parameter("way", 0.10).value  # m
        self.lifted, self.outcome = 0.0, ""
        self.lift = self.create_publisher(TwistStamped, "~/lift", 10)
        self.goal = self.create_publisher(JointState, "gripper_driver/grasp_goal", 10)
        self.create_subscription(DiagnosticStatus, "gripper_driver/grasp_state", self.on_grasp, LATCHED)
        self.create_subscription(WrenchStamped, "grasp_wrench", self.on_wrench, qos_profile_sensor_data)
        self.grasp = self.create_client(Trigger, "gripper_driver/grasp")
        self.holding, self.period = False, 0.02
        self.timer = self.create_timer(self.period, self.on_timer)

    def start(self):
        """Tell the driver the force and have it close; it answers when the force is held."""
        self.grasp.wait_for_service()
        self.goal.publish(JointState(effort=[self.force]))
        self.grasp.call_async(Trigger.Request()).add_done_callback(self.on_held)

    def on_held(self, answer):
        """Begin to lift, if the force is held."""
        self.holding = answer.result().success
        self.get_logger().info(answer.result().message)
        if not self.holding:
            self.end(answer.result().message)

    def on_grasp(self, status):
        """End with the grasp: the driver says why."""
        phase = {entry.key: entry.value for entry in status.values}.get("grasp")
        if self.holding and phase == "stopped":
            self.end(status.message)

    def on_wrench(self, message):
        """End when the force is about to go, before the driver is sure of it."""
        if self.holding and message.wrench.force.x < LEAST_SHARE * self.force:
            self.end(f"slips: {message.wrench.force.x:.2f} N are left")

    def on_timer(self):
        """Lift on, or be done."""
        if not self.holding:
            return
        self.lifted += self.speed * self.period
        self.move(self.speed)
        if self.lifted >= self.way:
            self.end("lifted")

    def end(self, outcome):
        """Stand still and say why."""
        self.holding, self.outcome = False, outcome
        self.move(0.0)
        self.get_logger().info(f"{outcome}, after {1e3 * self.lifted:.0f} mm")

    def move(self, speed):
        """Send a velocity [m/s] along the world's z."""
        twist = TwistStamped()
        twist.header.stamp, twist.header.frame_id = self.get_clock().now().to_msg(), "world"
        twist.twist.linear.z = speed
        self.lift.publish(twist)


def main():
    """Grasp and lift once."""
    rclpy.init()
    node = LiftUntilSlip()
    node.start()
    while rclpy.ok() and not node.outcome:
        rclpy.spin_once(node)
    node.lift.wait_for_all_acked(Duration(seconds=1.0))  # the last one stops the lift, and must not end with us
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
