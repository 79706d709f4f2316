"""The key point detector node: images in, key points and poses of the jaws out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from time import monotonic, perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from sensor_msgs.msg import CameraInfo

from finforce.camera_topics import COMPRESSED_DEPTH
from finforce.errors import FinforceError, ObservationError
from finforce.health import IDLE, STILL, Health, Idling, Level, Outcome, Report, Skips, StampGate
from finforce.messages import CameraStream, Stamped, shared_columns
from finforce.ros import node as ros
from finforce.transforms import pose_numbers
from finforce_keypoints.build import build_detector
from finforce_keypoints.detectors.dots import DotSettings
from finforce_keypoints.diagnostics import (
    build_skeleton,
    describe,
    describe_names,
    draw_keypoints,
    outcome_of_keypoints,
)
from finforce_keypoints.geometry.jaw_localizer import REASONS
from finforce_keypoints.images import COLOR, DEPTH, RgbdFeed
from finforce_keypoints.parameters import (
    NO_DEPTH,
    DetectorParameters,
    DetectorSettings,
    load_jaws,
)

if TYPE_CHECKING:
    from finforce_keypoints.detector import KeypointDetector
    from finforce_keypoints.geometry.jaw_localizer import JawKeypoints


TF_WAIT = 2.0  # [s] from the first image, for the camera's pose on /tf


class _DetectorOutputs:
    """The publishers of a key point detector node.

    Args:
        stage: makes publishers and watches them.
        parameters: jaws, and the names of their frames.
        stream: of the camera.
        frames: by which the jaws' poses go to /tf.
        names: of the rows of the clouds; sent once, and kept for whoever comes later.
        detector: that finds them.
    """

    def __init__(
        self,
        stage: ros.Stage,
        parameters: DetectorParameters,
        stream: CameraStream,
        frames: ros.Frames,
        names: Sequence[str],
        detector: KeypointDetector,
    ) -> None:
        sides, self._jaws = parameters.sides, parameters.jaw_frame
        self._camera, self._skeleton = stream, build_skeleton(names)
        self._frames = frames if parameters.publish_tf else None
        self.keypoints = {side: stage.publisher(ros.PointCloud2, f"{side}/keypoints", ros.RESULT) for side in sides}
        self.pose = {side: stage.publisher(ros.PoseStamped, f"{side}/jaw_pose", ros.RESULT) for side in sides}
        self.annotated = stage.publisher(ros.Image, "~/annotated", ros.RESULT)
        self.names = stage.publisher(ros.String, "~/keypoint_names", ros.LATCHED, is_answer=False)
        self.names.publish(ros.String(data=describe_names(names, detector)))

    def send_jaw(self, side: str, stamp: int, found: JawKeypoints) -> None:
        """Send the key points of a jaw and its pose, of the image at `stamp` [ns]."""
        time = ros.stamp_message(stamp)
        # the pose goes first: the contact estimator and the solver work at the same time then
        header = ros.Header(stamp=time, frame_id=self._camera.frame)
        self.pose[side].publish(ros.pose_message(header, pose_numbers(found.T_camera_jaw)))
        here = ros.Header(stamp=time, frame_id=self._jaws(side))
        ros.send_cloud(self.keypoints[side], here, keypoint_columns(found))
        if self._frames is not None:
            self._frames.send(header, here.frame_id, found.T_camera_jaw)

    def send_annotated(self, stamp: int, color: NDArray, found: Mapping[str, JawKeypoints]) -> None:
        """Send the image at `stamp` [ns], (h, w, 3), with what was found in it, while someone subscribes."""
        if not self.annotated.get_subscription_count():
            return
        header = ros.Header(stamp=ros.stamp_message(stamp), frame_id=self._camera.frame)
        self.annotated.publish(ros.image_message(header, draw_keypoints(color, found.values(), self._skeleton)))


def keypoint_columns(found: JawKeypoints) -> dict[str, NDArray]:
    """Return the columns of a cloud of key points, one row (K,) per key point of the jaw file."""
    u, v = np.asarray(found.pixels, dtype=np.float32).T
    stddev = np.asarray(found.stddev, dtype=np.float32).T
    # 0 for a key point that is used, else the place of the reason why not in `REASONS`, from 1
    codes = np.select([found.reasons == reason for reason in REASONS], range(1, len(REASONS) + 1), default=0)
    return {
        **ros.xyz_columns(found.points),
        "likelihood": np.asarray(found.likelihood, dtype=np.float32),
        "u": u,
        "v": v,
        "valid": np.asarray(found.valid, dtype=np.uint8),
        "reason": codes.astype(np.uint8),
        **dict(zip(("stddev_x", "stddev_y", "stddev_z"), stddev, strict=True)),
        **shared_columns(found.shared, len(u)),
    }


class KeypointDetectorNode(ros.ImageNode):
    """Finds the key points of the jaws, image by image; publishes nothing of an image that it does not trust.

    Args:
        build: makes the detector, as `build_detector`.
        pipeline: of a process of several nodes.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter, a jaw or the network cannot be used.
    """

    answer = "key points"

    def __init__(
        self,
        build: Callable[..., KeypointDetector] = build_detector,
        pipeline: ros.Pipeline | None = None,
        **options: Any,
    ) -> None:
        super().__init__("keypoint_detector", **options)
        self.parameters = parameters = ros.declare_record(self, DetectorParameters)
        settings = ros.declare_record(self, DetectorSettings, "detector")
        dots = ros.declare_record(self, DotSettings, "dots")
        jaws = load_jaws(parameters)
        names = next(iter(jaws.values())).keypoint_names
        said = ParameterDescriptor(description="Names of the rows of the key point clouds", read_only=True)
        self.declare_parameter("keypoint_names", list(names), said, ignore_override=True)
        ros.name_unknown_parameters(self)
        self.skips = Skips(parameters.skip_off)
        ros.warn_first_start()
        self.detector = build(jaws, parameters, settings, dots, self.skips.allows(STILL))
        ros.follow_settings(self, settings, self._adjust, "detector")
        ros.follow_settings(self, parameters, self._limit)
        self.feed = RgbdFeed(parameters)
        self.frames, self._settings = ros.Frames(self), settings
        self._build = partial(build, jaws, dots=dots, rests=self.skips.allows(STILL))
        self._mounting = "T_gripper_camera" not in self._parameter_overrides and self.frames.listen()
        self._asked, self._tared, self._mount_trouble = float("inf"), False, ""
        self.gate = StampGate(parameters.max_age)
        source, age = self.feed.source, parameters.max_age
        self.health = {side: Health(source=source, stale_after=age) for side in parameters.sides}
        self.found: Mapping[str, JawKeypoints] = {}
        self.idling = Idling()
        self.stage = ros.Stage(self, pipeline)
        self.out = _DetectorOutputs(self.stage, parameters, self.feed.stream, self.frames, names, self.detector)
        self.stage.rest_unheard(self.skips, self.turn)
        self.detector.warm_up()  # before images come: those that came meanwhile would be lost
        self._serve()
        self._subscribe()
        self.get_logger().info(f"jaws: {parameters.jaws}, ready, key points from {self.detector.name}")

    def _serve(self) -> None:
        """Offer services and diagnostics."""
        ros.serve_trigger(self.stage, "~/reset", lambda: self._restart("reset by service"))
        for side in self.parameters.sides:
            report, period = partial(self._report, side), self.parameters.diagnostics_period
            ros.publish_diagnostics(self.stage, f"finforce: {side} key points", period, report)

    def _subscribe(self) -> None:
        """Create the subscriptions."""
        parameters = self.parameters
        stream = self.feed.stream
        info = {"is_wanted": lambda: stream.camera is None or self.stage.is_needed}
        self.stage.subscription(CameraInfo, parameters.info_topic, self._on_info, ros.SENSOR, **info)
        images = partial(ros.ImageInput, self.stage, transport=parameters.image_transport)
        if parameters.depth != NO_DEPTH:
            images(parameters.depth_topic, self._on_depth, end=COMPRESSED_DEPTH)
        for topic in parameters.color_topics:
            images(topic, self._on_color)
        mounting = {"is_wanted": lambda: self._mounting and not self._tared}
        for side in parameters.sides if self._mounting else ():  # a solver that tells a force has made its tare
            self.stage.subscription(ros.WrenchStamped, f"{side}/wrench", self._on_wrench, ros.SENSOR, **mounting)

    def _on_info(self, message: CameraInfo) -> None:
        """Keep the camera's intrinsics."""
        with self.rejections():
            self.feed.take_info(message)

    def turn(self) -> None:
        """Begin or end to rest, in which no image gets lost."""
        super().turn()
        self.feed.pause()

    def _on_wrench(self, _: ros.WrenchStamped) -> None:
        """Keep that solvers rely on the camera's pose."""
        self._tared = True

    def _on_color(self, topic: str, message: Any) -> None:
        """Take a colour image of the camera's topic."""
        if not self.feed.listens(topic):
            return
        for health in self.health.values():
            health.arrive(source=topic)
        with self.rejections():
            whole = self.feed.take_color(topic, message, self.stage.pipeline.spare)
            waiting = self.feed.waiting
            if not whole and waiting is not None:  # its pixels are found while its depth is on its way
                with suppress(FinforceError):  # what is wrong with it is said after that
                    self.gate.check_age(waiting.stamp, self.now())
                    self.detector.detect_color(waiting.value)
            self._answer(whole)

    def _on_depth(self, _topic: str, message: Any) -> None:
        """Take a depth image."""
        with self.rejections():
            self._answer(self.feed.take_depth(message, self.stage.pipeline.spare))
        if delay := self.feed.delay_of_depth:
            self.get_logger().warning(delay, throttle_duration_sec=10.0)

    def _answer(self, images: Sequence[Stamped]) -> None:
        """Find the key points of all jaws in images that are whole."""
        for whole in images:
            with self.rejections():
                self._find(whole)

    def _find(self, whole: Stamped) -> None:
        """Find the key points of all jaws in an image that is whole."""
        began, image = perf_counter(), whole.value
        if self._mounting:
            self._mount()
        if self.gate.enter(whole.stamp, self.now()):
            self._restart("the stamps went back: a new recording")
        self.found = {}  # until they are found again
        self.found = self.detector.detect(image)
        is_still = self.detector.was_still
        if is_still:
            self.skips.count(STILL)
            if self.skips.allows(IDLE) and self.idling.passes(whole.stamp):
                self.skips.count(IDLE)
                return
        self._publish(whole.stamp, image.color, began)
        self.idling.note(whole.stamp, is_still)

    def _mount(self) -> None:
        """Take the camera's pose from /tf; after a while without it, the shipped mount's, until it comes.

        One that comes after the solvers' tare is not taken: their offsets are those of the other pose.

        Raises:
            ObservationError: /tf has not got it yet.
        """
        names = self.parameters.base_frame, self.feed.stream.frame
        T_gripper_camera, arrow = self.frames.find(*names), " <- ".join(names)
        self._asked = min(self._asked, monotonic())
        if T_gripper_camera is None and monotonic() - self._asked < TF_WAIT:
            raise ObservationError(f"waiting for the camera's pose on /tf, {arrow}, or set T_gripper_camera")
        if T_gripper_camera is None:
            self._complain(f"/tf has no transform {arrow}: using the default T_gripper_camera")
            return
        if self._mount_trouble and self._tared:
            self._complain(
                f"/tf has a transform {arrow} only since the tare, which was made with the default T_gripper_camera: "
                "that stays; restart the nodes"
            )
            self._mounting = False
            return
        parameters = replace(self.parameters, T_gripper_camera=pose_numbers(T_gripper_camera))
        if not np.allclose(parameters.camera_pose, self.parameters.camera_pose, atol=1e-6):
            self.detector = self._build(parameters, settings=self._settings)  # where refused, the default is not taken
            self.parameters = parameters
            self.detector.warm_up()
        self._mounting, self._mount_trouble = False, ""
        self.get_logger().info(f"camera pose taken from /tf, {arrow}")

    def _complain(self, trouble: str) -> None:
        """Say once in the log, and from now on in the diagnostics, what is wrong with the camera's pose."""
        if trouble != self._mount_trouble:
            self.get_logger().warning(trouble)
        self._mount_trouble = trouble

    def _limit(self, parameters: DetectorParameters) -> None:
        """Go on with a maximum age that was changed."""
        self.gate.limit(parameters.max_age)
        self.feed.max_age = parameters.max_age

    def _adjust(self, settings: DetectorSettings) -> None:
        """Go on with settings that were changed."""
        self._settings = settings
        self.detector.adjust(settings)

    def _publish(self, stamp: int, color: NDArray, began: float) -> None:
        """Publish the key points of an image, (h, w, 3), while they are fresh."""
        found = self.found
        self.gate.check_age(stamp, self.now())
        warnings = self.detector.warnings
        for side in self.health:
            outcome = outcome_of_keypoints(found.get(side), side, warnings.get(side, ""))
            if side not in found:
                self.reject(outcome, side)
                continue
            self.out.send_jaw(side, stamp, found[side])
            self.confirm(side, stamp, outcome, began)
        self.out.send_annotated(stamp, color, found)

    def _restart(self, reason: str) -> str:
        self.detector.reset()
        self.feed.reset()
        self.found = {}
        self.get_logger().warning(f"{reason}; images and jaws are cleared")
        return reason

    def _find_losses(self) -> list[str]:
        """Return what is wrong with images that do not arrive; log it the first time."""
        warnings, topics = [], {COLOR: self.feed.topic, DEPTH: self.parameters.depth_topic}
        for name, topic in topics.items():
            if topic and (losses := self.feed.arrivals[name].count_losses()).are_many:
                warnings.append(losses.warn(name, ros.remedy_for_losses(topic, ros.is_published_here(self, topic))))
        for warning in warnings:
            self.get_logger().warning(warning, once=True)
        return warnings

    def _report(self, side: str, alarms: list[Outcome]) -> Report:
        """Return how one jaw is seen."""
        known = describe(self.feed, self.detector.name, self.found.get(side)) | self.skips.describe()
        troubles = filter(None, (self.feed.delay_of_depth, self._mount_trouble, *self._find_losses()))
        alarms = [*alarms, *(Outcome(level=Level.WARN, reason=text, text=text) for text in troubles)]
        return self.health[side].report(alarms, known, self.unheard)
