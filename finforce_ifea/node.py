"""The solver node of one jaw: key points and contacts in, wrenches out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from threading import Timer
from time import monotonic, perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Vector3Stamped, WrenchStamped
from sensor_msgs.msg import PointCloud2

from finforce.errors import MissingDependencyError
from finforce.gripper_frames import SIDES
from finforce.health import IDLE, Health, Idling, Level, Outcome, Report, Skips, StampGate
from finforce.messages import SECOND, pose_from_message, stamp_of, wrench_from_message
from finforce.ros import node as ros
from finforce.ros.messages import MarkerStyle, points_marker
from finforce_ifea.grasp_force import ForcePairing, Grasp, Wrench, single_jaw_grasp, to_jaw
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.messages import (
    ARROW,
    CONTACT,
    CONTACT_DIAMETER,
    FORCE,
    NEWTONS_PER_METRE,
    PostureFeed,
    build_contact_feed,
    observation_from_cloud,
)
from finforce_ifea.observation import Observation, Solution
from finforce_ifea.parameters import NodeParameters, build_estimator
from finforce_ifea.payload import Payload
from finforce_ifea.posture import WristPosture
from finforce_ifea.resting import RestingContact
from finforce_ifea.settings import EstimatorSettings

if TYPE_CHECKING:
    from finforce_ifea.estimator import ForceEstimator

_SLOW = 4.0  # s of preparation, after which somebody may wonder
_TARE_TIME = 2.0  # [s] of images for a tare that is asked for at rest


class _SolverOutputs:
    """The publishers of a solver node.

    Args:
        stage: makes publishers and watches them.
        parameters: side of the jaw, and True if the forces on the gripper are completed here.
        skips: True if outputs without subscribers are left out.
    """

    def __init__(self, stage: ros.Stage, parameters: NodeParameters, skips: Skips) -> None:
        side = parameters.jaw_name
        self._parameters, self._skips = parameters, skips
        self.wrench = stage.publisher(ros.WrenchStamped, f"{side}/wrench", ros.RESULT)
        self.stddev = stage.publisher(ros.WrenchStamped, f"{side}/wrench_stddev", ros.RESULT)
        self.surface = stage.publisher(ros.PointCloud2, f"{side}/surface", ros.RESULT)
        self.markers = stage.publisher(ros.MarkerArray, f"{side}/markers", ros.RESULT)
        if parameters.peer or parameters.completes_grasp:
            self.grasp = stage.publisher(ros.WrenchStamped, "grasp_wrench", ros.RESULT)
            self.manipulation = stage.publisher(ros.WrenchStamped, "manipulation_wrench", ros.RESULT)
        self._markers_sent = -float("inf")

    def send_stddev(self, header: Any, solution: Solution) -> None:
        """Send one standard deviation of the wrench.

        Raises:
            ObservationError: a component is not finite.
        """
        if ros.is_wanted(self.stddev, self._skips):
            self.stddev.publish(ros.wrench_message(header, solution.force_stddev, solution.torque_stddev))

    def send_grasp(self, header: Any, grasp: Grasp) -> None:
        """Send what the object does to the gripper; a torque that is not known is left at zero."""
        header = ros.Header(stamp=header.stamp, frame_id=self._parameters.base_frame)
        if ros.is_wanted(self.grasp, self._skips):
            self.grasp.publish(ros.wrench_message(header, grasp.grasp))
        if ros.is_wanted(self.manipulation, self._skips):
            torque = (0.0, 0.0, 0.0) if grasp.torque is None else grasp.torque
            self.manipulation.publish(ros.wrench_message(header, grasp.manipulation, torque))

    def send_shape(self, header: Any, observation: Observation, solution: Solution, estimator: ForceEstimator) -> None:
        """Send the deformed surface, and markers at their own rate; markers only to listeners, whatever the rules."""
        if self._parameters.publish_surface and ros.is_wanted(self.surface, self._skips):
            ros.send_cloud(self.surface, header, ros.xyz_columns(estimator.surface()))
        due = monotonic() - self._markers_sent >= 1.0 / self._parameters.marker_rate
        if due and self.markers.get_subscription_count():
            self._markers_sent = monotonic()
            markers = _build_markers(header, observation, solution, estimator)
            self.markers.publish(ros.MarkerArray(markers=markers))


_USED = (0.1, 0.8, 0.2, 1.0)
_UNUSED = (0.9, 0.2, 0.1, 1.0)
_SURFACE = MarkerStyle("triangles", (0.45, 0.55, 0.65, 0.6), (1.0, 1.0, 1.0))
_KEYPOINTS = MarkerStyle("spheres", _USED, (0.003,) * 3)
_CONTACT = MarkerStyle("spheres", CONTACT, (CONTACT_DIAMETER,) * 3)
_FORCE = MarkerStyle("arrow", FORCE, ARROW)


def _build_markers(header: Any, observation: Observation, solution: Solution, estimator: ForceEstimator) -> list[Any]:
    """Return the markers of one image, in the jaw frame: contact and force only where they are trusted."""
    triangles = np.asarray(estimator.surface())[np.asarray(estimator.surface_triangles)].reshape(-1, 3)
    seen = np.isfinite(observation.points).all(axis=1)
    colors = [_USED if used else _UNUSED for used in np.asarray(solution.keypoints_used)[seen]]
    touched = solution.trusted and np.any(solution.force)
    place = np.asarray(solution.contact_point)
    # the arrow ends on the surface that the object presses on
    arrow = np.stack([place - np.asarray(solution.force) / NEWTONS_PER_METRE, place]) if touched else ()
    return [
        points_marker(header, "surface", _SURFACE, triangles),
        points_marker(header, "keypoints", _KEYPOINTS, observation.points[seen], colors),
        points_marker(header, "contact", _CONTACT, place if touched else ()),
        points_marker(header, "force", _FORCE, arrow),
    ]


_LEVELS = {"ok": Level.OK, "unloaded": Level.OK, "diverged": Level.ERROR}  # any other status: WARN


def outcome_of_solution(solution: Solution) -> Outcome:
    """Return the level of a solution's status and its sentence."""
    level = _LEVELS.get(solution.status, Level.WARN)
    return Outcome(level=level, reason=solution.status, text=solution.message or solution.status)


def describe_solution(solution: Solution | None) -> dict[str, str]:
    """Return the figures of the last solution as text, nothing before the first."""
    if solution is None:
        return {}
    used = np.asarray(solution.keypoints_used)
    return {
        "status": solution.status,
        "key points used": f"{int(used.sum())} of {used.size}",
        "force [N]": f"{np.linalg.norm(solution.force):.3f}",
        "force standard deviation [N]": f"{solution.magnitude_stddev:.3f}",
        "residual [mm]": f"{1e3 * solution.residual:.3f}",
        "kkt": f"{solution.kkt:.2e}",
        "iterations": str(solution.iterations),
    }


def peer_alarms(peer: str, silence: float, limit: float) -> list[Outcome]:
    """Return the alarm of a jaw `peer` that has not been heard of for longer than `limit` [s]."""
    if not peer or silence <= limit:
        return []
    text = f"no wrench of the {peer} jaw, therefore no grasp_wrench"
    return [Outcome(level=Level.WARN, reason="peer", text=text)]


class IfeaSolverNode(ros.ImageNode):
    """Solves one jaw, image by image, and publishes nothing that it does not trust.

    Args:
        build: makes the estimator from jaw, parameters and settings.
        pipeline: of a process of several nodes.
        options: of `rclpy.node.Node`.

    Raises:
        FinforceError: a parameter, the jaw or the calibration cannot be used.
    """

    answer = "wrench"

    def __init__(
        self,
        build: Callable[..., Any] = build_estimator,
        pipeline: ros.Pipeline | None = None,
        **options: Any,
    ) -> None:
        super().__init__("ifea_solver", **options)
        self.parameters = parameters = ros.declare_record(self, NodeParameters)
        settings = ros.declare_record(self, EstimatorSettings, "estimator")
        settings = settings.resolve_held(both=parameters.paired or bool(parameters.peer))
        ros.name_unknown_parameters(self)
        self.skips, self.frame = Skips(parameters.skip_off), parameters.frame
        jaw = load_jaw(parameters.jaw_file, parameters.jaw_name)
        self.contacts = build_contact_feed(jaw, parameters)
        self.posture = PostureFeed(parameters) if settings.may_be_held else None
        self.frames = ros.Frames(self)
        if parameters.gravity_frame and not self.frames.listen():
            raise MissingDependencyError(f"gravity_frame {parameters.gravity_frame} needs tf2_ros: source ROS 2")
        ros.warn_first_start()
        with self._announce_wait(jaw.name):
            self.estimator = build(jaw, parameters, settings)
        self.gate = StampGate(parameters.max_age)
        ros.follow_settings(self, parameters, lambda changed: self.gate.limit(changed.max_age))
        health = Health(source=f"{parameters.jaw_name}/keypoints", stale_after=parameters.max_age)
        self.health[parameters.jaw_name] = health
        self.pairing, self.payload = ForcePairing(parameters.jaw_name), Payload()
        self.idling, self.resting = Idling(), RestingContact()
        self.waiting: tuple[PointCloud2, float] | None = None  # key points without their contact, and when they came
        self.last: Solution | None = None
        self.stage = ros.Stage(self, pipeline)
        self.out = _SolverOutputs(self.stage, parameters, self.skips)
        self.stage.rest_unheard(self.skips, self.turn, lambda: self.estimator.is_taring)
        self._serve(parameters.jaw_name)
        self._subscribe(parameters.jaw_name)
        source = "fixed" if self.contacts.is_fixed else "by topic"
        self.get_logger().info(f"{parameters.jaw_name} jaw '{jaw.name}' ready, contact {source}")

    @contextmanager
    def _announce_wait(self, jaw: str) -> Iterator[None]:
        """Say what takes so long, if it does."""
        words = f"preparing jaw '{jaw}': a minute or two at its first start, seconds later on"
        late = Timer(_SLOW, lambda: self.get_logger().info(words))
        late.start()
        try:
            yield
        finally:
            late.cancel()

    def _serve(self, side: str) -> None:
        """Offer services and diagnostics."""
        ros.serve_trigger(self.stage, f"{side}/tare", lambda: self.estimator.tare(), awake=_TARE_TIME)
        ros.serve_trigger(self.stage, f"{side}/reset", lambda: self._restart("reset by service"))
        longest = self.parameters.contact_timeout
        self.overdue = self.create_timer(longest, self.stage.guard(self._solve_waiting), clock=ros.STEADY_CLOCK)
        self.overdue.cancel()
        period = self.parameters.diagnostics_period
        ros.publish_diagnostics(self.stage, f"finforce: {side} jaw", period, self._report)

    def _subscribe(self, side: str) -> None:
        """Create the subscriptions; a node that has them is ready."""
        if not self.contacts.is_fixed:
            # the outline first: a contact is whole with its own
            self.stage.subscription(PointCloud2, f"{side}/object_outline", self._on_outline, ros.SENSOR)
            self.stage.subscription(PointCloud2, f"{side}/contact", self._on_contact, ros.SENSOR)
        if peer := self.parameters.peer:
            self.stage.subscription(WrenchStamped, f"{peer}/wrench", self._on_peer, ros.RESULT)
            for jaw in SIDES:
                self.stage.subscription(PoseStamped, f"{jaw}/jaw_pose", partial(self._on_jaw_pose, jaw), ros.SENSOR)
        # of what one jaw presses, friction tells nothing of its weight
        if self.posture is not None and not self.parameters.gravity_frame:
            self.stage.subscription(Vector3Stamped, "gravity", self._on_gravity, ros.SENSOR)
        self.stage.subscription(PointCloud2, f"{side}/keypoints", self._on_keypoints, ros.NEWEST)

    def _on_keypoints(self, cloud: PointCloud2) -> None:
        """Take an image, to be solved with its contact, or with the one before where that takes too long."""
        began, stamp = perf_counter(), stamp_of(cloud)
        self.health[self.parameters.jaw_name].arrive()
        if self.idling.passes(stamp):
            self.skips.count(IDLE)
            return
        self.waiting = (cloud, began)
        if self.contacts.expect(stamp, began):
            self.overdue.reset()
        else:
            self._solve_waiting()

    def _solve_waiting(self) -> None:
        """Solve the image that waits for its contact, if there is one."""
        self.overdue.cancel()
        image, self.waiting = self.waiting, None
        if image is not None:
            self._solve(*image)

    def _solve(self, cloud: PointCloud2, began: float) -> None:
        """Solve an image and publish its wrench, if it can be trusted."""
        header, stamp = cloud.header, stamp_of(cloud)
        with self.rejections():
            posture = to_jaw(self._find_posture(stamp), self.parameters.jaw_name)
            observation = observation_from_cloud(cloud, self.frame, posture)
            if self.gate.enter(stamp, self.now()):
                self._restart("the stamps went back: a new recording")
            contact = self.resting.complete(self.contacts.at(stamp), observation.stamp)
            self.last = solution = self.estimator.update(observation, contact)
            self.resting.note(solution, observation.stamp)
            self.gate.check_age(stamp, self.now())
            self.idling.note(stamp, self.estimator.is_idle and self.skips.allows(IDLE))
            if not solution.trusted:
                self.reject(outcome_of_solution(solution))
                return
            self.out.wrench.publish(ros.wrench_message(header, solution.force, solution.torque))
            wrench = Wrench(solution.force, solution.torque)
            if self.parameters.peer:
                self._send_grasp(header, stamp, self.pairing.add(stamp, wrench, solution.force_stddev, own=True))
            elif self.parameters.completes_grasp:
                self.out.send_grasp(header, single_jaw_grasp(wrench, self.parameters.jaw_name))
            self.out.send_stddev(header, solution)
            self.confirm(self.parameters.jaw_name, stamp, outcome_of_solution(solution), began)
            self.stage.afterwards(partial(self._finish, header, observation, solution))

    def _send_grasp(self, header: Any, stamp: int, grasp: Grasp | None) -> None:
        """Send the grasp of both jaws in an image [ns], with the weight that they carry where the posture is known."""
        if grasp is not None:
            posture = None if self.posture is None else self.posture.at(stamp)  # which its image has looked up
            grasp = self.payload.update(grasp, SECOND * stamp, posture)
            self.out.send_grasp(header, grasp)

    def _find_posture(self, stamp: int) -> WristPosture | None:
        """Return the posture of the gripper at an image [ns]; None where nobody says."""
        if self.posture is None:
            return None
        upright = self.parameters.gravity_frame
        found = self.frames.find_stamped(self.parameters.base_frame, upright) if upright else None
        if found is not None:
            T, told = found
            self.posture.keep(told or stamp, WristPosture(-T[:3, 2], float(-T[:3, 2] @ T[:3, 3])))
        return self.posture.at(stamp)

    def _finish(self, header: Any, observation: Observation, solution: Solution) -> None:
        """Do what no force waits for."""
        self.out.send_shape(header, observation, solution, self.estimator)
        self.estimator.learn()

    def _on_contact(self, cloud: PointCloud2) -> None:
        """Keep the newest contact."""
        with self.rejections():
            self.contacts.take(cloud, stamp_of(cloud))
        if self.contacts.completes(perf_counter()):
            self._solve_waiting()

    def _on_outline(self, cloud: PointCloud2) -> None:
        """Keep the newest outline of the object."""
        with self.rejections():
            self.contacts.take_outline(cloud, stamp_of(cloud))

    def _on_peer(self, wrench: WrenchStamped) -> None:
        """Complete the grasp with the other jaw's force."""
        stamp, peer = stamp_of(wrench), self.parameters.peer
        with self.rejections():
            found = Wrench(*wrench_from_message(wrench, self.parameters.jaw_frame(peer)))
            self.gate.check_age(stamp, self.now())
            self._send_grasp(wrench.header, stamp, self.pairing.add(stamp, found, own=False))

    def _on_gravity(self, direction: Vector3Stamped) -> None:
        """Keep which way things fall."""
        with self.rejections():
            self.posture.take(direction)

    def _on_jaw_pose(self, side: str, pose: PoseStamped) -> None:
        """Keep where a jaw is, for the torque on the gripper."""
        with self.rejections():
            T = pose_from_message(pose, pose.header.frame_id, f"the pose of the {side} jaw")
            self.pairing.distance.take(side, stamp_of(pose), T)

    def turn(self) -> None:
        """Begin or end to rest."""
        super().turn()
        self.pairing.resume()
        self.estimator.interrupt()

    def _restart(self, reason: str) -> str:
        self.estimator.reset()
        self.resting.reset()
        self.payload.reset()
        self.get_logger().warning(f"{reason}; the estimator restarts")
        return reason

    def _report(self, alarms: list[Outcome]) -> Report:
        """Return how this node is doing."""
        limit = max(1.0, self.parameters.max_age)
        if self.stage.is_needed:
            alarms = [*alarms, *peer_alarms(self.parameters.peer, self.pairing.silence, limit)]
        (mean, stddev), source = self.estimator.friction, self.estimator.friction_source
        tared = {"tared": str(self.estimator.tared), "friction": f"{mean:.2f} ± {stddev:.2f}, {source}"}
        tared["touch probability"] = f"{self.estimator.touch_probability:.2f}"
        health = self.health[self.parameters.jaw_name]
        if np.isfinite(self.payload.stddev):
            tared["payload"] = f"{self.payload.weight:.2f} ± {self.payload.stddev:.2f} N"
        values = describe_solution(self.last) | tared | self.skips.describe()
        return health.report(alarms, values, self.unheard)
