"""What the nodes answered during a replay, as the time series of an offline run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.messages import decode_columns, decode_keypoints, pose_from_message
from finforce.stamps import NANOSECONDS
from finforce_eval.evaluation.evaluate import sight_columns
from finforce_eval.evaluation.keypoint_source import SideLog
from finforce_eval.evaluation.places import InnerSurface, true_lines
from finforce_eval.evaluation.scoring import match_truth
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import ForceSeries, Snapshot
from finforce_ifea.messages import contact_from_cloud, outline_from_cloud
from finforce_keypoints.geometry.jaw_localizer import REASONS
from finforce_keypoints.parameters import COLOR_TOPIC, DEPTH_TOPIC


@dataclass(kw_only=True)
class JawLog:
    """The answers of one solver, by recorded stamp [ns].

    Attributes:
        sent: when the key points left [s, monotonic].
        latency: from then to the arrival of the wrench [s].
        force: (3,) [N], jaw frame.
        torque: (3,) [N m], about the origin of the jaw frame.
        stddev: (3,) [N].
        surface: (n, 3) [m] deformed vertices.
        place: weighted mean height of the contact rows [m].
        touching: whether a row said that object and jaw touch.
        outline: the object's polygons (n, 2) [m], jaw frame, before or at the image with the largest force.
        largest: stamp of that image; -1 before the first.
    """

    sent: dict[int, float] = field(default_factory=dict)
    latency: dict[int, float] = field(default_factory=dict)
    force: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    torque: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    stddev: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    surface: dict[int, NDArray[np.float32]] = field(default_factory=dict)
    place: dict[int, float] = field(default_factory=dict)
    touching: dict[int, bool] = field(default_factory=dict)
    outline: tuple[NDArray[np.float64], ...] = ()
    largest: int = -1

    def is_largest(self, stamp: int) -> bool:
        """Say whether the force at a stamp exceeds that of the largest so far by two per cent."""
        kept = self.force.get(self.largest)
        largest = 0.0 if kept is None else float(np.linalg.norm(kept))
        return stamp in self.force and float(np.linalg.norm(self.force[stamp])) > 1.02 * largest


class ReplayLog:
    """Takes messages, brings their stamps back to the recording's and keeps what they say.

    Attributes:
        offset: by which stamps are later than they were recorded [ns].

    Args:
        sides: the jaws that are played.
    """

    def __init__(self, sides: tuple[str, ...]) -> None:
        self.jaws = {side: JawLog() for side in sides}
        self._outlines: dict[str, tuple[NDArray[np.float64], ...]] = {}
        self.grasp: dict[int, float] = {}
        self.grasp_latency: dict[int, float] = {}
        self.detections = {side: DetectionLog() for side in sides}
        self.health: dict[str, Mapping[str, str]] = {}
        self.offset = 0
        self._ended = False

    def begin(self, offset: int) -> None:
        """Take stamps as later by so much than they were recorded [ns]."""
        self.offset = offset

    def end(self) -> None:
        """Take what comes now as the nodes' last words."""
        self._ended = True

    def _stamp(self, message: Any) -> int:
        """Return a stamp as it was recorded [ns]."""
        stamp = message.header.stamp
        return stamp.sec * NANOSECONDS + stamp.nanosec - self.offset

    def take_sent(self, topic: str, stamp: int, time: float) -> None:
        """Note when a message left [s, monotonic]; those count that a run begins with: key points, or an image."""
        if topic in (COLOR_TOPIC, DEPTH_TOPIC):
            # an image is whole with the later of its two messages
            for log in self.jaws.values():
                log.sent[stamp] = time
            return
        side = topic.removeprefix("/").removesuffix("/keypoints")
        if side in self.jaws:
            self.jaws[side].sent[stamp] = time

    def take_wrench(self, side: str, message: Any, time: float) -> None:
        """Keep a wrench that arrived at `time` [s, monotonic]."""
        stamp, log = self._stamp(message), self.jaws[side]
        log.force[stamp] = _vector(message.wrench.force)
        log.torque[stamp] = _vector(message.wrench.torque)
        if stamp in log.sent:
            log.latency[stamp] = time - log.sent[stamp]

    def take_stddev(self, side: str, message: Any) -> None:
        """Keep the standard deviation of a force."""
        self.jaws[side].stddev[self._stamp(message)] = _vector(message.wrench.force)

    def take_surface(self, side: str, message: Any) -> None:
        """Keep a surface, and the object's outline with that under the largest force."""
        stamp, log = self._stamp(message), self.jaws[side]
        log.surface[stamp] = decode_keypoints(message).points.astype(np.float32)
        if log.is_largest(stamp):
            log.largest, log.outline = stamp, self._outlines.get(side, ())

    def take_contact(self, side: str, message: Any) -> None:
        """Keep where the object was said to touch."""
        stamp, log = self._stamp(message), self.jaws[side]
        contact = contact_from_cloud(message, f"{side}_jaw", free=False)
        if len(contact.points):
            log.place[stamp] = float(np.average(contact.points[:, 2], weights=contact.weights))
        log.touching[stamp] = bool(contact.touching)

    def take_outline(self, side: str, message: Any) -> None:
        """Keep the newest outline of the object."""
        outline = outline_from_cloud(message, f"{side}_jaw", None)
        self._outlines[side] = () if outline is None else outline.placed()

    def take_pose(self, side: str, message: Any) -> None:
        """Keep the pose of a jaw that the detector found."""
        self.detections[side].take_pose(self._stamp(message), message)

    def take_keypoints(self, side: str, message: Any, time: float) -> None:
        """Keep key points that the detector found and that arrived at `time` [s, monotonic]."""
        stamp = self._stamp(message)
        sent = self.jaws[side].sent.get(stamp)
        self.detections[side].take_cloud(stamp, message, None if sent is None else time - sent)

    def take_grasp(self, message: Any, time: float) -> None:
        """Keep a grasp force that arrived at `time` [s, monotonic]."""
        stamp = self._stamp(message)
        self.grasp[stamp] = message.wrench.force.x
        sent = [log.sent[stamp] for log in self.jaws.values() if stamp in log.sent]
        if sent:
            self.grasp_latency[stamp] = time - min(sent)

    def take_diagnostics(self, message: Any) -> None:
        """Keep the last state of every node; that nothing arrives any more after the end is no news."""
        for status in message.status:
            if self._ended and status.name in self.health:
                continue
            values = {entry.key: entry.value for entry in status.values}
            self.health[status.name] = {"message": status.message, **values}


def live_result(
    recording: Recording, side: str, log: JawLog, *, likelihood_threshold: float, estimator: Any
) -> ForceSeries:
    """Return the answers of one solver as the time series of an offline run.

    The solver's own place, its residual and the key points used do not travel; the first two stay open, and the key
    points that passed the threshold stand for those used.

    Args:
        recording: that was played.
        side: "left" or "right".
        log: the answers.
        likelihood_threshold: of the solver.
        estimator: a fresh one of the same jaw, for the undeformed surface and its triangles.
    """
    track = recording.jaw(side).keypoints
    stamps = track.stamps
    force, stddev = _rows(log.force, stamps), _rows(log.stddev, stamps)
    norm = np.linalg.norm(force, axis=1, keepdims=True)
    along = np.divide(force, norm, out=np.zeros_like(force), where=norm > 0.0)
    phases = recording.phases_at(stamps)
    seen = np.isfinite(track.points).all(axis=2) & (track.likelihood >= likelihood_threshold)
    return ForceSeries.build(
        recording.name,
        side,
        stamps,
        true_force=match_truth(recording.truth(side), stamps),
        force=force,
        magnitude_stddev=np.linalg.norm(along * stddev, axis=1),
        force_stddev=stddev if log.stddev else None,
        used=seen,
        status=np.where(np.isfinite(force).all(axis=1), "ok", "no wrench"),
        message="",
        step_ms=1e3 * np.array([log.latency.get(int(stamp), np.nan) for stamp in stamps]),
        cycle=phases.cycle,
        direction=phases.direction,
        scored=phases.scored,
        **(_contact_columns(recording, side, log, estimator) if log.touching else {}),
        **sight_columns(recording, side),
    ).with_snapshot(_snapshot(recording, side, log, seen, estimator))


def _contact_columns(recording: Recording, side: str, log: JawLog, estimator: Any) -> dict[str, Any]:
    """Return where the contact was said to be, and where it was."""
    stamps = recording.jaw(side).keypoints.stamps
    surface = InnerSurface(np.array(estimator.surface()), estimator.jaw.face)
    lines = true_lines(recording, side, stamps, surface.face_x)
    truth = [
        surface.cut(log.surface[int(stamp)], point, direction) if int(stamp) in log.surface else np.nan
        for stamp, point, direction in zip(stamps, lines.points, lines.directions, strict=True)
    ]
    return {
        "contact_source": "live",
        "contact_height": np.array([log.place.get(int(stamp), np.nan) for stamp in stamps]),
        "true_height": np.array(truth),
        "touching": np.array([log.touching.get(int(stamp), False) for stamp in stamps]),
        "contact_status": np.where([int(stamp) in log.touching for stamp in stamps], "live", ""),
    }


def _snapshot(recording: Recording, side: str, log: JawLog, seen: NDArray[np.bool_], estimator: Any) -> Snapshot | None:
    """Return the jaw under the largest force, None if no surface came."""
    if log.largest < 0:
        return None
    track = recording.jaw(side).keypoints
    row = int(np.searchsorted(track.stamps, log.largest))
    force, surface = log.force[log.largest], log.surface[log.largest].astype(np.float64)
    return Snapshot(
        stamp=log.largest,
        surface0=np.array(estimator.surface()),
        surface=surface,
        triangles=np.asarray(estimator.surface_triangles),
        keypoints0=np.asarray(estimator.jaw.keypoints),
        keypoints=track.points[row],
        used=seen[row],
        contact_point=point_of_application(force, log.torque[log.largest], surface),
        force=force,
        outline=log.outline,
    )


def point_of_application(
    force: NDArray[np.float64], torque: NDArray[np.float64], surface: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the point of a surface through which a force acts, (3,) [m].

    The line of action is x(s) = F x T / |F|^2 + s F; of the vertices the one counts that lies nearest to it,
    and among equals the one that the force meets first.

    Args:
        force: F (3,) [N].
        torque: T (3,) [N m] about the origin.
        surface: (n, 3) [m].
    """
    square = float(force @ force)
    if square == 0.0:
        return np.full(3, np.nan)
    foot = np.cross(force, torque) / square
    along = (surface - foot) @ force / square
    distance = np.linalg.norm(surface - foot - along[:, None] * force, axis=1)
    near = np.flatnonzero(distance < distance.min() + 1e-3)
    first = near[np.argmin(along[near])]
    return foot + along[first] * force


def _rows(values: Mapping[int, NDArray[np.float64]], stamps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return one row per stamp, NaN where there is none."""
    missing = np.full(3, np.nan)
    return np.array([values.get(int(stamp), missing) for stamp in stamps]).reshape(-1, 3)


def _vector(xyz: Any) -> NDArray[np.float64]:
    return np.array([xyz.x, xyz.y, xyz.z])


@dataclass(frozen=True, kw_only=True, eq=False)
class HeardKeypoints:
    """The key points of one jaw in one image as they came by topic; see `finforce_keypoints.JawKeypoints`."""

    points: NDArray[np.float64]
    likelihood: NDArray[np.float64]
    pixels: NDArray[np.float64]
    valid: NDArray[np.bool_]
    stddev: NDArray[np.float64]
    T_camera_jaw: NDArray[np.float64]
    reasons: NDArray[np.str_]


@dataclass(kw_only=True)
class DetectionLog:
    """The messages of one jaw, by recorded stamp [ns].

    Attributes:
        poses: T_camera_jaw (4, 4).
        clouds: key points.
        step_ms: from the image's leaving to their arrival [ms].
    """

    poses: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    clouds: dict[int, Any] = field(default_factory=dict)
    step_ms: dict[int, float] = field(default_factory=dict)

    def take_pose(self, stamp: int, message: Any) -> None:
        """Keep the pose of the jaw."""
        self.poses[stamp] = pose_from_message(message, message.header.frame_id, "the jaw's pose")

    def take_cloud(self, stamp: int, message: Any, delay: float | None) -> None:
        """Keep key points that arrived `delay` [s] after their image had left."""
        self.clouds[stamp] = message
        if delay is not None:
            self.step_ms[stamp] = 1e3 * delay

    def side_log(self) -> SideLog:
        """Return what was said of each image, where pose and key points both came."""
        stamps = self.poses.keys() & self.clouds.keys()
        found = {stamp: heard_keypoints(self.clouds[stamp], self.poses[stamp]) for stamp in stamps}
        return SideLog(found=found, step_ms=self.step_ms)


def heard_keypoints(cloud: Any, T_camera_jaw: NDArray[np.float64]) -> HeardKeypoints:
    """Return the key points of a cloud and the pose (4, 4) that came with it."""
    seen = decode_keypoints(cloud)
    columns = decode_columns(cloud, ("u", "v", "reason"))
    return HeardKeypoints(
        points=seen.points,
        likelihood=seen.likelihood,
        pixels=np.stack([columns["u"], columns["v"]], axis=1).astype(np.float64),
        valid=np.isfinite(seen.points).all(axis=1),
        stddev=np.full_like(seen.points, np.nan) if seen.stddev is None else seen.stddev,
        T_camera_jaw=T_camera_jaw,
        reasons=np.array(["", *REASONS])[columns["reason"]],
    )
