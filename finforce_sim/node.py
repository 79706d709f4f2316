"""The twin camera node: a synthetic scene published as a camera would."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from time import monotonic
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header, String

from finforce.camera import CameraIntrinsics
from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC, relative
from finforce.ros import node as ros
from finforce.settings import setting
from finforce.transforms import pose_numbers
from finforce_sim.emulator.adapter import EmulatedAdapter
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.emulator.pty_port import PtyPort
from finforce_sim.scenarios import RATE, Scenario, build_scenario
from finforce_sim.sensor import Flicker
from finforce_sim.simulated_camera import Shot
from finforce_sim.simulated_recording import (
    SimulatedRecording,
    TwinFrame,
    build_simulated_recording,
    detection_truth_columns,
    encode_depth,
    info_fields,
    parse_size,
)
from finforce_sim.stored_grasp import LiveScene, build_live_scene

PIXEL_TYPES = {"rgb8": np.uint8, "16UC1": np.uint16}
TOLD_EVERY = 5.0  # s between two words on how far the rendering is
Output = tuple[Any, Any]  # publisher and message


class TwinCameraNode(Node):
    """Publishes the images of a scene, its object's pose and the truth, at 30 Hz with the stamps of now.

    Rendering is slower than that: all images are rendered first and kept. They are played as the scene's script has
    them, or, with a link to a gripper, as the emulated gripper there moves.

    Args:
        build: makes the recording of a scenario with a seed and a camera.
        build_live: makes of the same a scene that follows a gripper.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter or the scene cannot be used.
    """

    def __init__(
        self,
        build: Callable[..., SimulatedRecording] = build_simulated_recording,
        build_live: Callable[..., LiveScene] = build_live_scene,
        **options: Any,
    ) -> None:
        super().__init__("twin_camera", **options)
        self.parameters = parameters = ros.declare_record(self, TwinParameters)
        ros.name_unknown_parameters(self)
        ros.warn_first_start()
        self.gripper: EmulatedGripper | None = None
        self.scene = (build_live if parameters.gripper_link else build)(
            parameters.scenario,
            parameters.seed,
            parse_size(parameters.size),
            finger=parameters.finger,
            depth_step=parameters.depth_step,
        )
        if parameters.gripper_link:
            self.gripper = EmulatedGripper(load=self.scene.grasp.elastic_force)
            self.port = PtyPort(EmulatedAdapter(self.gripper), parameters.gripper_link)
        self.images: list[list[Output]] = []
        self.is_over = False
        self._next, self._phase, self._told = 0, "", monotonic()
        self._outputs: dict[str, Any] = {}
        self._flicker = Flicker(parameters.seed)

    def render(self) -> None:
        """Render all images into messages, and begin to play them."""
        name = self.parameters.scene
        if self.gripper is not None:
            self.scene.render(lambda frame: list(self._seen(frame)), self._tell)
            self.port.open()
            self.get_logger().info(f"{name}: playing as the gripper at {self.port.path} moves")
        else:
            for frame in self.scene:
                self._tell(len(self.images) + 1, len(self.scene))
                self.images.append([*self._scripted(frame), *self._seen(frame)])
            self.get_logger().info(f"{name}: {len(self.images)} images, {len(self.images) / RATE:.1f} s, playing")
        self.create_timer(1.0 / RATE, self.publish_next)

    def publish_next(self) -> None:
        """Publish an image and what belongs to it; after the last one of a script begin again, or be over."""
        messages = self._follow_script() if self.gripper is None else self._follow_gripper()
        stamp = self.get_clock().now().to_msg()
        for publisher, message in messages:
            if hasattr(message, "header"):
                message.header.stamp = stamp
            publisher.publish(message)

    def destroy_node(self) -> None:
        """Remove the gripper's port, and the node."""
        if self.gripper is not None:
            self.port.close()
        super().destroy_node()

    def _follow_script(self) -> Iterable[Output]:
        """Return the next image of the script, nothing after the last one."""
        if self._next == len(self.images):
            self._next, self.is_over = 0, not self.parameters.loop
            if self.is_over:
                return ()
        self._next += 1
        return self.images[self._next - 1]

    def _follow_gripper(self) -> Iterable[Output]:
        """Return the image of the gripper as it is now."""
        moment = self.scene.take(self.gripper.jaws.opening, monotonic())
        for _, message in moment.picture:
            if isinstance(message, Image):
                self._flicker.lay(np.frombuffer(message.data, PIXEL_TYPES[message.encoding]), id(message))
        return [*self._true(moment.wrenches, moment.T_camera_object), *moment.picture]

    def _tell(self, done: int, count: int) -> None:
        """Say now and then how far the rendering is, and end it when the node has to end."""
        if not self.context.ok():
            raise ExternalShutdownException
        if monotonic() - self._told > TOLD_EVERY:
            self._told = monotonic()
            self.get_logger().info(f"rendering {self.parameters.scene}: {done} of {count} images")

    def _scripted(self, frame: TwinFrame) -> Iterable[Output]:
        """Yield publishers and messages of what a script's image has in addition to what is seen."""
        if frame.phase != self._phase:
            self._phase = frame.phase
            yield self._output(String, "bench/phase"), String(data=frame.phase)
        yield from self._true(frame.jaws, frame.T_camera_object)

    def _true(self, wrenches: Any, T_camera_object: Any) -> Iterable[Output]:
        """Yield publishers and messages of wrenches by side and of the object's pose, unless that is None."""
        for side, jaw in wrenches.items():
            message = ros.wrench_message(Header(frame_id=f"{side}_jaw"), jaw.force, jaw.torque)
            yield self._output(WrenchStamped, f"{side}/ground_truth_wrench"), message
        if T_camera_object is not None:
            header = Header(frame_id=self.parameters.camera_frame)
            yield self._output(PoseStamped, "object_pose"), ros.pose_message(header, pose_numbers(T_camera_object))

    def _seen(self, frame: Shot) -> Iterable[Output]:
        """Yield publishers and messages of an image, after the key points in it."""
        for side, jaw in frame.jaws.items():
            cloud = ros.cloud_message(Header(frame_id=f"{side}_jaw"), detection_truth_columns(jaw))
            yield self._output(PointCloud2, f"{side}/ground_truth_keypoints"), cloud
        if self.parameters.detects:
            yield from self._detected(frame)
        header, depth = Header(frame_id=self.parameters.camera_frame), encode_depth(frame.depth, self.scene.depth_step)
        yield self._output(CameraInfo, relative(INFO_TOPIC)), camera_info(header, self.scene.camera)
        yield self._output(Image, relative(DEPTH_TOPIC)), ros.image_message(header, depth, "16UC1")
        yield self._output(Image, relative(COLOR_TOPIC)), ros.image_message(header, frame.color)

    def _detected(self, frame: Shot) -> Iterable[Output]:
        """Yield publishers and messages of what a detector without errors finds."""
        for side, jaw in frame.jaws.items():
            header = Header(frame_id=self.parameters.camera_frame)
            yield (
                self._output(PoseStamped, f"{side}/jaw_pose"),
                ros.pose_message(header, pose_numbers(jaw.T_camera_jaw)),
            )
            seen = np.where(jaw.visible[:, None], jaw.points, np.nan).astype(np.float32)
            columns = {**ros.xyz_columns(seen), "likelihood": jaw.visible.astype(np.float32)}
            cloud = ros.cloud_message(Header(frame_id=f"{side}_jaw"), columns)
            yield self._output(PointCloud2, f"{side}/keypoints"), cloud

    def _output(self, kind: type, topic: str) -> Any:
        """Return the publisher of a topic."""
        if topic not in self._outputs:
            self._outputs[topic] = self.create_publisher(kind, topic, ros.RESULT)
        return self._outputs[topic]


def camera_info(header: Header, camera: CameraIntrinsics) -> CameraInfo:
    """Return the intrinsics of a camera."""
    values = info_fields(camera)
    return CameraInfo(
        header=header, **{name: value.tolist() if hasattr(value, "tolist") else value for name, value in values.items()}
    )


def play_scene(node: TwinCameraNode, executor: Executor) -> None:
    """Render the scene and play it."""
    node.render()
    executor.add_node(node)
    while not node.is_over:
        executor.spin_once()


def main() -> int:
    """Run the node until the scene is over, or Ctrl-C."""
    return ros.run_node("twin_camera", TwinCameraNode, play_scene)


@dataclass(frozen=True, kw_only=True)
class TwinParameters:
    """Parameters of a twin camera node; units stand in the metadata."""

    scene: str = setting("grasp_cylinder", "Scene, by a name that `finforce twin list` prints")
    seed: int = setting(0, "Seed of textures, light and noise", "", 0, 2**31 - 1)
    finger: int = setting(0, "Seed of the jaws' material", "", 0, 2**31 - 1)
    light: str = setting("", "Light: bright, dim or any; empty: that of the scene")
    object: str = setting("", "Object, by the name of a shape or a mesh file; empty: that of the scene")
    jaw_file: str = setting("", "Jaw file, or name of an included jaw; empty: that of the scene")
    size: str = setting("640x480", "Size of the images, WIDTHxHEIGHT [px]")
    depth_step: float = setting(0.001, "Resolution of the depth image", "m", 1e-5, 0.01)
    loop: bool = setting(True, "Whether the scene is repeated; else the node ends with it")
    gripper_link: str = setting(
        "", "Port link of an emulated gripper that grasps the scene; empty: the scene as scripted"
    )
    detects: bool = setting(
        False, "Whether true key points and jaw poses are published, as by a detector without errors"
    )
    camera_frame: str = setting("camera_color_optical_frame", "Frame of the images")

    @property
    def scenario(self) -> Scenario:
        """The scene with what is changed in it.

        Raises:
            ScenarioError: there is no such scene, light or object.
            JawFileError: there is no such jaw.
        """
        changes = {"light": self.light, "object": self.object, "jaw": self.jaw_file}
        return build_scenario(self.scene, **{name: value for name, value in changes.items() if value})
