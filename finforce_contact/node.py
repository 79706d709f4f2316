"""The contact estimator node: poses and images in, contacts and outlines out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup

from finforce.camera_topics import COMPRESSED_DEPTH
from finforce.health import IDLE, Health, Idling, Level, Outcome, Report, Skips, StampGate
from finforce.messages import SECOND, stamp_of
from finforce.ros import node as ros
from finforce.settings import check_bounds
from finforce.transforms import pose_numbers
from finforce_contact.contact_session import ContactSession, detections_type
from finforce_contact.estimator import CONTRADICTED, ContactEstimate
from finforce_contact.loop import TimedEstimate
from finforce_contact.mesh.object_mesh import describe_mesh
from finforce_contact.parameters import ContactParameters, ContactSettings, TrackerSettings
from finforce_contact.pose.source import MeshFeed, StampedPose
from finforce_contact.slip import Slip
from finforce_ifea.messages import columns_from_contact, columns_from_outline


class _ContactOutputs:
    """The publishers of a contact estimator node.

    Args:
        stage: makes publishers and watches them.
        parameters: jaws, and source of the object's poses.
        session: knows the camera's stream and the jaws.
        skips: True if outputs without subscribers are left out.
    """

    def __init__(self, stage: ros.Stage, parameters: ContactParameters, session: ContactSession, skips: Skips) -> None:
        cloud, sides = ros.PointCloud2, parameters.sides
        self._camera, self._jaws, self._skips = session.stream, parameters.jaw_frame, skips
        self._candidates = session.jaws[sides[0]].loop.estimator.jaw.candidates[:, 2]
        self.contact = {side: stage.publisher(cloud, f"{side}/contact", ros.RESULT) for side in sides}
        self.outline = {side: stage.publisher(cloud, f"{side}/object_outline", ros.RESULT) for side in sides}
        self.slip = {side: stage.publisher(ros.TwistStamped, f"{side}/slip", ros.RESULT) for side in sides}
        self._slip_told = dict.fromkeys(sides, -math.inf)
        self.pose = stage.publisher(ros.PoseStamped, "object_pose", ros.RESULT) if parameters.tracks else None

    def send_contact(self, side: str, timed: TimedEstimate) -> None:
        """Send outline and contact of an image; no rows say that there is none."""
        header = ros.Header(stamp=ros.stamp_message(timed.stamp), frame_id=self._jaws(side))
        # the outline goes first: the solver looks for it when the contact comes
        if ros.is_wanted(self.outline[side], self._skips):
            ros.send_cloud(self.outline[side], header, columns_from_outline(timed.estimate.contact.outline))
        if ros.is_wanted(self.contact[side], self._skips):
            ros.send_cloud(self.contact[side], header, columns_from_contact(timed.estimate.contact, self._candidates))
        self._send_slip(side, timed.estimate.slip)

    def _send_slip(self, side: str, slip: Slip | None) -> None:
        """Send how the object moves over a jaw, once for every pose of the object while it touches."""
        if slip is None or not slip.stamp > self._slip_told[side] or not np.isfinite(slip.stddev):
            return
        self._slip_told[side] = slip.stamp
        if ros.is_wanted(self.slip[side], self._skips):
            stamp = ros.stamp_message(round(slip.stamp / SECOND))
            header = ros.Header(stamp=stamp, frame_id=self._jaws(side))
            self.slip[side].publish(ros.twist_message(header, slip.velocity))

    def send_pose(self, found: StampedPose) -> None:
        """Send the object's pose, unless it came by topic."""
        if self.pose is not None and ros.is_wanted(self.pose, self._skips):
            header = ros.Header(stamp=ros.stamp_message(found.stamp), frame_id=self._camera.frame)
            self.pose.publish(ros.pose_message(header, pose_numbers(found.pose.T_camera_object)))


class ContactEstimatorNode(ros.ImageNode):
    """Says where the object touches the jaws, image by image; lives on without an object.

    Args:
        pipeline: of a process of several nodes.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter or the jaw cannot be used.
    """

    answer = "contact"

    def __init__(self, pipeline: ros.Pipeline | None = None, **options: Any) -> None:
        super().__init__("contact_estimator", **options)
        self.parameters = parameters = ros.declare_record(self, ContactParameters)
        contact = ros.declare_record(self, ContactSettings, "contact")
        tracker = ros.declare_record(self, TrackerSettings, "tracker")
        ros.name_unknown_parameters(self)
        self.sides, age = parameters.sides, parameters.max_age
        self.skips = Skips(parameters.skip_off)
        ros.warn_first_start()
        self.session = ContactSession(parameters, contact, tracker)
        self._follows_surface = contact.mode == "paper"
        self.gates = {side: StampGate(age) for side in self.sides}
        self.health = {side: Health(source=f"{side}/jaw_pose", stale_after=age) for side in self.sides}
        ros.follow_settings(self, parameters, self._take_changes)
        self.stage = ros.Stage(self, pipeline)
        self.out = _ContactOutputs(self.stage, parameters, self.session, self.skips)
        self.stage.rest_unheard(self.skips, self.turn)
        with self.rejections():
            self.get_logger().info(self.session.load_mesh(parameters))
        self._serve()
        self.idling = {side: Idling() for side in self.sides}
        self._subscribe()
        self.get_logger().info(f"jaws: {parameters.jaws}, ready, object poses from {parameters.pose_source}")

    def _serve(self) -> None:
        """Offer services, whose long work holds up nothing else, and diagnostics."""
        session, period = self.session, self.parameters.diagnostics_period
        one_by_one = MutuallyExclusiveCallbackGroup()
        ros.serve_trigger(self.stage, "~/load_mesh", lambda: session.load_mesh(self._checked()), one_by_one)
        ros.serve_trigger(self.stage, "~/reconstruct", lambda: session.reconstruct(self._checked()), one_by_one)
        ros.serve_trigger(self.stage, "~/reset", session.reset)
        for side in self.sides:
            report = partial(self._report, side)
            ros.publish_diagnostics(self.stage, f"finforce: {side} contact", period, report)

    def _subscribe(self) -> None:
        """Subscribe to all that the parameters ask for.

        Raises:
            MissingDependencyError: a message type is not installed.
        """
        stage, source = self.stage, self.parameters.pose_source
        self.objects = None
        if self.parameters.tracks:
            camera, info = self.session.camera, partial(self._on_image, self.session.camera.take_camera, "")
            # whoever rests loses the object
            options = {"is_wanted": lambda: True, "callback_group": MutuallyExclusiveCallbackGroup()}
            self.stage.subscription(ros.CameraInfo, self.parameters.info_topic, info, ros.SENSOR, **options)
            images = partial(ros.ImageInput, self.stage, transport=self.parameters.image_transport, **options)
            images("object_mask", partial(self._on_image, camera.take_mask))
            images(self.parameters.depth_topic, partial(self._on_image, camera.take_depth), end=COMPRESSED_DEPTH)
        elif source == "topic":
            self.objects = stage.subscription(ros.PoseStamped, "object_pose", self._on_object, ros.SENSOR)
        else:
            self.objects = stage.subscription(detections_type(), "object_detections", self._on_object, ros.SENSOR)
        if self.session.check:
            self._subscribe_to_check(self.session.check)
        for side in self.sides:
            if self._follows_surface:
                stage.subscription(ros.PointCloud2, f"{side}/surface", partial(self._on_surface, side), ros.SENSOR)
            find = partial(self._on_jaw_pose, side)
            stage.subscription(ros.PoseStamped, f"{side}/jaw_pose", find, ros.BUFFERED).can_wait = True

    def _subscribe_to_check(self, check: MeshFeed) -> None:
        """Subscribe to depth images, while one is due, for the comparison with the mesh."""
        parameters, group = self.parameters, MutuallyExclusiveCallbackGroup()
        info, stream = partial(self._on_camera, check), self.session.stream

        def is_wanted() -> bool:
            return check.is_due and self.stage.is_needed

        options = {"is_wanted": lambda: stream.camera is None or is_wanted(), "callback_group": group}
        self.stage.subscription(ros.CameraInfo, parameters.info_topic, info, ros.SENSOR, **options)
        ros.ImageInput(
            self.stage,
            parameters.depth_topic,
            self._on_compared,
            parameters.image_transport,
            end=COMPRESSED_DEPTH,
            is_wanted=is_wanted,
            callback_group=group,
        )

    def _on_camera(self, check: MeshFeed, info: ros.CameraInfo) -> None:
        """Keep the intrinsics of the depth images."""
        with self.rejections():
            check.take_camera(info)

    async def _on_compared(self, _topic: str, image: Any) -> None:
        """Compare the mesh with a depth image, while other callbacks go on."""
        await ros.run_aside(self, partial(self.session.compare, image))

    def _take_changes(self, changed: ContactParameters) -> None:
        """Take parameters that were set at run time."""
        self.parameters = changed
        for gate in self.gates.values():
            gate.limit(changed.max_age)

    def _checked(self) -> ContactParameters:
        """Return the parameters; raise ParameterError where one that was set at run time is out of its choices."""
        check_bounds(self.parameters, ros.ParameterError)
        return self.parameters

    def _on_jaw_pose(self, side: str, pose: ros.PoseStamped) -> None:
        """Find the contact of an image, unless it may be passed over."""
        began, stamp = perf_counter(), stamp_of(pose)
        self.health[side].arrive()
        # poses of the object that came while the image was looked at
        for message in self.objects.take_waiting() if self.objects else ():
            self._on_object(message)
        with self.rejections(side):
            if self.idling[side].passes(stamp):
                self.skips.count(IDLE)
                self.session.pass_over(side, pose)
                return
            if self.gates[side].enter(stamp, self.now()):
                self.session.restart(side)
                self.get_logger().warning("the stamps jumped back: poses and contacts are cleared")
            self.idling[side].end()
            self._send(side, began, self.session.take_jaw_pose(side, pose))
            self.idling[side].note(stamp, self.session.jaws[side].loop.is_out_of_reach and self.skips.allows(IDLE))

    def _on_surface(self, side: str, cloud: ros.PointCloud2) -> None:
        """Keep a jaw's deformed surface."""
        with self.rejections(side):
            self._check_ahead(cloud)
            self.session.keep_surface(side, cloud)

    def _on_object(self, message: Any) -> None:
        """Use the object's pose that another node has found."""
        with self.rejections():
            self._check_ahead(message)
            self._hand_on(self.session.read_pose(message))

    async def _on_image(self, take: Callable[[Any], StampedPose | None], _topic: str, image: Any) -> None:
        """Use the object's pose, if one is found with an image, while other callbacks go on."""
        with self.rejections():
            self._check_ahead(image)
            self._hand_on(await ros.run_aside(self, partial(take, image)))

    def _check_ahead(self, message: Any) -> None:
        """Refuse a stamp ahead of the clock before anything is kept that all later stamps would be behind."""
        now = self.now()
        self.gates[self.sides[0]].check_age(max(stamp_of(message), now), now)

    def _hand_on(self, found: StampedPose | None) -> None:
        """Give the jaws a pose of the object, if it was found."""
        began = perf_counter()
        if found is None:
            return
        self.gates[self.sides[0]].check_age(found.stamp, self.now())
        self.out.send_pose(found)
        for side in self.sides:
            with self.rejections(side):
                self._send(side, began, self.session.take_object_pose(side, found))

    def _send(self, side: str, began: float, estimates: Iterable[TimedEstimate]) -> None:
        """Publish contacts that are still fresh; an object whose pose is not known gives none."""
        for timed in estimates:
            self.gates[side].check_age(timed.stamp, self.now())
            outcome = outcome_of_estimate(timed.estimate)
            if timed.estimate.status in ("no_pose", CONTRADICTED):
                self.reject(outcome, side)
                continue
            self.out.send_contact(side, timed)
            self.confirm(side, timed.stamp, outcome, began)

    def _report(self, side: str, alarms: list[Outcome]) -> Report:
        """Return how one jaw's contact is doing."""
        values = describe(self.session, side) | self.skips.describe()
        if self.session.trouble:  # the object's mesh cannot be used
            alarms = [*alarms, Outcome(level=Level.ERROR, reason="object", text=self.session.trouble)]
        return self.health[side].report(alarms, values, self.unheard)


LEVELS = {"touching": Level.OK, "apart": Level.OK}  # any other status: WARN


def outcome_of_estimate(estimate: ContactEstimate) -> Outcome:
    """Return the level of an estimate's status and its sentence."""
    if estimate.slip is not None and estimate.slip.sliding:
        return Outcome(level=Level.WARN, reason="slip", text=f"the object slides: {describe_slip(estimate.slip)}")
    level = LEVELS.get(estimate.status, Level.WARN)
    return Outcome(level=level, reason=estimate.status, text=estimate.message or estimate.status)


def describe(session: ContactSession, side: str) -> dict[str, str]:
    """Return what is known of the object and of its contact with one jaw, as text."""
    loop, mesh, pose = session.jaws[side].loop, session.mesh, session.pose
    values = {"object": describe_mesh(mesh) if mesh else "unknown"}
    if mesh and session.check:
        check = session.check
        values["mesh"] = check.contradiction or check.trouble or f"compared with {check.compared} depth images"
    if mesh and pose:
        values |= {"pose source": pose.source, "pose fitness": f"{pose.fitness:.2f}"}
    if loop.last is not None:
        estimate = loop.last.estimate
        values |= {
            "status": estimate.status,
            "pose age [ms]": f"{1e3 * loop.pose_age():.0f}",
            "slip": describe_slip(estimate.slip),
        }
    counts = loop.estimator.counts.items()
    return values | {"work": ", ".join(f"{count} {reason}" for reason, count in counts if count) or "none"}


def describe_slip(slip: Slip | None) -> str:
    """Return how an object moves over a jaw, in words."""
    if slip is None or not np.isfinite(slip.stddev):
        return "unknown"
    speed = 1e3 * float(np.linalg.norm(slip.velocity))
    return f"{speed:.1f} ± {1e3 * slip.stddev:.1f} mm/s{', slides' if slip.sliding else ''}"
