"""The twin camera node: a synthetic scene published as a camera would; it renders first, and then plays on time."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from time import monotonic
from typing import Any

from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.executors import Executor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header, String

import finforce_ros as ros
from finforce_contact.poses import pose_numbers
from finforce_keypoints.parameters import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from finforce_twin.encoding import encode_depth, info_fields, sight_columns
from finforce_twin.parameters import TwinParameters
from finforce_twin.record import Footage, TwinFrame, build_footage, parse_size
from finforce_twin.script import RATE

TOLD_EVERY = 5.0  # s between two words on how far the rendering is


class TwinCameraNode(Node):
    """Publishes the images of a scene, its object's pose and the truth, at 30 Hz with the stamps of now.

    Rendering is slower than that: all images are rendered first and kept.

    Args:
        build: makes the footage of a scenario with a seed and a camera.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter or the scene cannot be used.
    """

    def __init__(self, build: Callable[..., Footage] = build_footage, **options: Any) -> None:
        super().__init__("twin_camera", **options)
        self.parameters = parameters = ros.declare_record(self, TwinParameters)
        ros.name_unknown_parameters(self)
        size = parse_size(parameters.size)
        self.footage = build(
            parameters.scenario, parameters.seed, size, finger=parameters.finger, depth_step=parameters.depth_step
        )
        self.reel: list[list[tuple[Any, Any]]] = []
        self.is_over = False
        self._next, self._phase = 0, ""
        self._outputs: dict[str, Any] = {}

    def film(self) -> None:
        """Render all images into messages."""
        count, told = len(self.footage), monotonic()
        for frame in self.footage:
            self.reel.append(list(self._messages(frame)))
            if monotonic() - told > TOLD_EVERY:
                told = monotonic()
                self.get_logger().info(f"rendering {self.parameters.scene}: {len(self.reel)} of {count} images")
        self.get_logger().info(f"{self.parameters.scene}: {count} images, {count / RATE:.1f} s, playing")
        self.create_timer(1.0 / RATE, self.publish_next)

    def publish_next(self) -> None:
        """Publish the next image and what belongs to it; after the last one begin again, or be over."""
        if self._next == len(self.reel):
            self._next, self.is_over = 0, not self.parameters.loop
            if self.is_over:
                return
        stamp = self.get_clock().now().to_msg()
        for publisher, message in self.reel[self._next]:
            if hasattr(message, "header"):
                message.header.stamp = stamp
            publisher.publish(message)
        self._next += 1

    def _messages(self, frame: TwinFrame) -> Iterable[tuple[Any, Any]]:
        """Yield publishers and messages, what is true before what is seen."""
        if frame.phase != self._phase:
            self._phase = frame.phase
            yield self._output(String, "/bench/phase"), String(data=frame.phase)
        for side, jaw in frame.jaws.items():
            header = Header(frame_id=f"{side}_jaw")
            wrench = ros.wrench_message(header, jaw.force, jaw.torque)
            yield self._output(WrenchStamped, f"{side}/ground_truth_wrench"), wrench
            cloud = ros.cloud_message(header, sight_columns(jaw))
            yield self._output(PointCloud2, f"{side}/ground_truth_keypoints"), cloud
        header = Header(frame_id=self.parameters.camera_frame)
        if frame.T_camera_object is not None:
            pose = ros.pose_message(header, pose_numbers(frame.T_camera_object))
            yield self._output(PoseStamped, "object_pose"), pose
        yield self._output(CameraInfo, INFO_TOPIC), camera_info(header, self.footage)
        yield (
            self._output(Image, DEPTH_TOPIC),
            ros.image_message(header, encode_depth(frame.depth, self.footage.depth_step), "16UC1"),
        )
        yield self._output(Image, COLOR_TOPIC), ros.image_message(header, frame.color)

    def _output(self, kind: type, topic: str) -> Any:
        """Return the publisher of a topic."""
        if topic not in self._outputs:
            self._outputs[topic] = self.create_publisher(kind, topic, ros.RESULT)
        return self._outputs[topic]


def camera_info(header: Header, footage: Footage) -> CameraInfo:
    """Return the intrinsics of the camera."""
    values = info_fields(footage.camera)
    return CameraInfo(
        header=header, **{name: value.tolist() if hasattr(value, "tolist") else value for name, value in values.items()}
    )


def play_scene(node: TwinCameraNode, executor: Executor) -> None:
    """Render the scene and play it."""
    node.film()
    executor.add_node(node)
    while not node.is_over:
        executor.spin_once()


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until the scene is over, or Ctrl-C."""
    return ros.run_node("twin_camera", TwinCameraNode, args, play_scene)


if __name__ == "__main__":
    sys.exit(main())
