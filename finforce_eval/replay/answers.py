"""The answers of the nodes during a replay, as the time series of an offline run."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC
from finforce.messages import NANOSECONDS, decode_columns, decode_keypoints, pose_from_message, stamp_of
from finforce_eval.evaluation.forces import sight_columns, truth_columns
from finforce_eval.evaluation.keypoint_source import with_detections
from finforce_eval.evaluation.pressure_centre import InnerSurface, true_lines
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import WAITING, ForceSeries, stddev_along
from finforce_ifea.messages import contact_from_cloud
from finforce_ifea.observation import is_touch
from finforce_keypoints.geometry.jaw_localizer import REASONS, JawKeypoints


class ReplayLog:
    """Takes messages, brings their stamps back to the recording's [ns] and keeps what they say.

    Attributes:
        offset: by which stamps are later than they were recorded [ns].
        sent: side -> stamp -> when the key points, or the image, left [s, monotonic].
        rows: side -> stamp -> columns of the table of forces, and the deformed vertices (n, 3) as `surface`.
        grasp: stamp -> grasp force [N].
        grasp_latency: stamp -> from the leaving to its arrival [s].
        poses: side -> stamp -> T_camera_jaw (4, 4) that the detector found.
        clouds: side -> stamp -> message with its key points, and the time [s, monotonic].
        health: node -> its last diagnostics.

    Args:
        sides: the jaws that are played.
    """

    def __init__(self, sides: tuple[str, ...]) -> None:
        self.offset = 0
        self.sent: dict[str, dict[int, float]] = {side: {} for side in sides}
        self.rows: dict[str, dict[int, dict[str, Any]]] = {side: defaultdict(dict) for side in sides}
        self.grasp: dict[int, float] = {}
        self.grasp_latency: dict[int, float] = {}
        self.poses: dict[str, dict[int, NDArray]] = {side: {} for side in sides}
        self.clouds: dict[str, dict[int, tuple[Any, float]]] = {side: {} for side in sides}
        self.health: dict[str, Mapping[str, str]] = {}
        self._ended = False

    def end(self) -> None:
        """Take what comes now as the nodes' last words."""
        self._ended = True

    def _stamp(self, message: Any) -> int:
        """Return a stamp as it was recorded [ns]."""
        return stamp_of(message) - self.offset

    def take_sent(self, topic: str, stamp: int, time: float) -> None:
        """Note when a message left [s, monotonic]; those count that a run begins with: key points, or an image."""
        is_image = topic in (COLOR_TOPIC, DEPTH_TOPIC)
        for side, times in self.sent.items():
            if is_image or topic == f"/{side}/keypoints":
                times[stamp] = time  # an image is whole with the later of its two messages

    def take_wrench(self, side: str, message: Any, time: float) -> None:
        """Keep a wrench that arrived at `time` [s, monotonic]."""
        stamp = self._stamp(message)
        found = {"force": _vector(message.wrench.force), "torque": _vector(message.wrench.torque)}
        self.rows[side][stamp] |= found | {"step_ms": 1e3 * (time - self.sent[side].get(stamp, np.nan))}

    def take_stddev(self, side: str, message: Any) -> None:
        """Keep the standard deviation of a force."""
        self.rows[side][self._stamp(message)]["force_stddev"] = _vector(message.wrench.force)

    def take_surface(self, side: str, message: Any) -> None:
        """Keep a surface."""
        self.rows[side][self._stamp(message)]["surface"] = decode_keypoints(message).points.astype(np.float32)

    def take_contact(self, side: str, message: Any) -> None:
        """Keep the reported contact."""
        contact, row = contact_from_cloud(message, f"{side}_jaw", free=False), self.rows[side][self._stamp(message)]
        if len(contact.points):
            row["contact_height"] = float(np.average(contact.points[:, 2], weights=contact.weights))
        row["contact_status"] = "live"

    def take_pose(self, side: str, message: Any) -> None:
        """Keep the pose of a jaw that the detector found."""
        self.poses[side][self._stamp(message)] = pose_from_message(message, message.header.frame_id, "the jaw's pose")

    def take_keypoints(self, side: str, message: Any, time: float) -> None:
        """Keep key points that the detector found and that arrived at `time` [s, monotonic]."""
        self.clouds[side][self._stamp(message)] = message, time

    def take_grasp(self, message: Any, time: float) -> None:
        """Keep a grasp force that arrived at `time` [s, monotonic]."""
        stamp = self._stamp(message)
        self.grasp[stamp] = message.wrench.force.x
        sent = [times[stamp] for times in self.sent.values() if stamp in times]
        if sent:
            self.grasp_latency[stamp] = time - min(sent)

    def take_diagnostics(self, message: Any) -> None:
        """Keep the last state of every node; that nothing arrives any more after the end is no news."""
        for status in message.status:
            if self._ended and status.name in self.health:
                continue
            values = {entry.key: entry.value for entry in status.values}
            self.health[status.name] = {"message": status.message, **values}


def with_heard_keypoints(recording: Recording, log: ReplayLog) -> Recording:
    """Return a recording with the key points that the detector sent, where pose and key points both came."""
    found, late = {}, {}
    for side, clouds in log.clouds.items():
        poses, sent = log.poses[side], log.sent[side]
        found[side] = {stamp: heard_keypoints(clouds[stamp][0], poses[stamp]) for stamp in poses.keys() & clouds.keys()}
        late[side] = {stamp: 1e3 * (time - sent[stamp]) for stamp, (_, time) in clouds.items() if stamp in sent}
    return with_detections(recording, found, late)


def heard_keypoints(cloud: Any, T_camera_jaw: NDArray[np.float64]) -> JawKeypoints:
    """Return the key points of a cloud and the pose (4, 4) that came with it."""
    seen = decode_keypoints(cloud)
    columns = decode_columns(cloud, ("u", "v", "reason"))
    return JawKeypoints(
        stamp=stamp_of(cloud) / NANOSECONDS,
        points=seen.points,
        likelihood=seen.likelihood,
        pixels=np.stack([columns["u"], columns["v"]], axis=1).astype(np.float64),
        valid=np.isfinite(seen.points).all(axis=1),
        stddev=np.full_like(seen.points, np.nan) if seen.stddev is None else seen.stddev,
        T_camera_jaw=T_camera_jaw,
        reasons=np.array(["", *REASONS])[columns["reason"]],
        shared=seen.shared,
    )


def live_result(
    recording: Recording, side: str, log: ReplayLog, *, likelihood_threshold: float, estimator: Any
) -> ForceSeries:
    """Return the answers of one solver as the time series of an offline run.

    The solver's own contact location, its residual and the key points used do not travel; the first two stay open, and
    the key points that passed the threshold stand for those used. Images with key points before the first wrench are
    those of the tare.

    Args:
        recording: that was played.
        side: "left" or "right".
        log: the answers.
        likelihood_threshold: of the solver.
        estimator: a fresh one of the same jaw, for the undeformed surface.
    """
    track, nothing = recording.jaw(side).keypoints, np.full(3, np.nan)
    rows = [log.rows[side].get(stamp, {}) for stamp in track.stamps_ns.tolist()]
    force, stddev = (np.array([row.get(name, nothing) for row in rows]) for name in ("force", "force_stddev"))
    seen = np.isfinite(track.points).all(axis=2) & (track.likelihood >= likelihood_threshold)
    magnitude_stddev = stddev_along(force, stddev)
    told, contact = np.isfinite(force).all(axis=1), {}
    waiting = seen.any(axis=1) & ~np.logical_or.accumulate(told) & told.any()
    if any("contact_status" in row for row in rows):
        newest = np.maximum.accumulate(np.where(told, np.arange(len(told)), 0))  # what was told last still holds
        touching = (told & is_touch(np.linalg.norm(force, axis=1), magnitude_stddev))[newest]
        contact = _contact_columns(recording, side, rows, estimator) | {"touching": touching}
    return ForceSeries.build(
        recording.name,
        side,
        track.stamps_ns,
        force=force,
        magnitude_stddev=magnitude_stddev,
        force_stddev=stddev if np.isfinite(stddev).any() else None,
        used=seen,
        status=np.select([told, waiting], ["ok", WAITING], "no wrench"),
        message="",
        step_ms=np.array([row.get("step_ms", np.nan) for row in rows]),
        **recording.phases_at(track.stamps_ns),
        **contact,
        true_force=truth_columns(recording, side)["true_force"],
        **sight_columns(recording, side),
    )


def _contact_columns(recording: Recording, side: str, rows: list[dict[str, Any]], estimator: Any) -> dict[str, Any]:
    """Return the reported contact and the true one."""
    surface = InnerSurface(np.array(estimator.surface()), estimator.jaw.face)
    lines = true_lines(recording, side, recording.jaw(side).keypoints.stamps_ns, surface.face_x)
    truth = [
        surface.cut(row["surface"], point, direction) if "surface" in row else np.nan
        for row, point, direction in zip(rows, lines.points, lines.directions, strict=True)
    ]
    return {
        "contact_source": "live",
        "contact_height": np.array([row.get("contact_height", np.nan) for row in rows]),
        "true_height": np.array(truth),
        "contact_status": np.array([row.get("contact_status", "") for row in rows]),
    }


def _vector(xyz: Any) -> NDArray[np.float64]:
    return np.array([xyz.x, xyz.y, xyz.z])
