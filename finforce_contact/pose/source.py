"""Where poses of the object come from, and the source fed by another program's messages."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce.errors import PoseError
from finforce.transforms import check_pose, invert_pose, pose_from_quaternion
from finforce_contact.mesh.object_mesh import ObjectMesh, surrounds
from finforce_contact.parameters import ORIGINS


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectPose:
    """Where the object was in one image.

    Attributes:
        stamp: capture time of the image [s].
        T_camera_object: pose of the mesh file's own frame in the camera optical frame (4, 4) [m].
        covariance: of x, y, z [m] and the rotations about x, y, z [rad], camera axes, about the object's origin (6, 6);
            a direction that nothing determines has a large variance.
        fitness: share of what should be seen that was seen where it should be, 0 to 1; 1 where the source tells none.
        source: who says so.
    """

    stamp: float
    T_camera_object: NDArray
    covariance: NDArray
    fitness: float
    source: str

    def age(self, now: float) -> float:
        """Return the time since the image was taken [s], at the time `now` [s] of the same clock."""
        return now - self.stamp


class ExternalPoseSource:
    """Poses that another program publishes, each refused or taken as it is.

    Attributes:
        latest: the newest pose taken; a refused one does not replace it.
    """

    def __init__(
        self,
        frame: str,
        *,
        mesh: ObjectMesh | None = None,
        origin: str = "mesh",
        stddev: ArrayLike = (0.002,) * 3 + (0.02,) * 3,
    ) -> None:
        """Prepare to listen.

        Args:
            frame: the camera optical frame that the messages must be in.
            mesh: the object, for the check that it is not around the camera; None to do without.
            origin: what the poses are of, one of `ORIGINS`.
            stddev: standard deviations (6,) [m, rad] that the poses are taken to have, as such messages state none.

        Raises:
            PoseError: A standard deviation is not positive.
        """
        stddev = np.asarray(stddev, float)
        if stddev.shape != (6,) or not (np.isfinite(stddev).all() and (stddev > 0.0).all()):
            raise PoseError(f"standard deviations of poses: got {stddev}, expected six positive numbers [m, rad]")
        self.latest: ObjectPose | None = None
        self._frame, self._mesh, self._covariance = frame.lstrip("/"), mesh, np.diag(stddev**2)
        self._back = np.zeros(3)
        if mesh is not None:
            self._back = -ORIGINS[origin] * mesh.middle

    def reset(self) -> None:
        """Forget the latest pose, so that a stamp before it is taken again."""
        self.latest = None

    def take_pose(self, message: Any) -> ObjectPose:
        """Take an object shaped like a geometry_msgs/PoseStamped.

        Raises:
            PoseError: The frame is another one, the stamp is not after the last one taken, the numbers are no rigid
                pose, or the object would be around the camera.
        """
        return self._take(message.header, message.pose, "PoseStamped")

    def take_detections(self, message: Any) -> ObjectPose | None:
        """Take an object shaped like a vision_msgs/Detection3DArray, of which the first detection counts.

        Its pose is `bbox.center`, where isaac_ros_foundationpose writes it, or `results[0].pose.pose` when the former
        was left as the message type makes it.

        Returns:
            The pose, or None when the list is empty: nothing was detected.

        Raises:
            PoseError: As `take_pose`, or the detection holds no pose.
        """
        if not message.detections:
            return None
        detection = message.detections[0]
        pose = detection.bbox.center
        if _is_unset(pose):
            pose = _first_result(detection.results)
        return self._take(message.header, pose, "Detection3DArray")

    def _take(self, header: Any, pose: Any, source: str) -> ObjectPose:
        if header.frame_id.lstrip("/") != self._frame:
            raise PoseError(
                f"{source}: got a pose in frame '{header.frame_id}', expected '{self._frame}'; "
                "set the frame of the camera, or have the tracker publish in it"
            )
        stamp = header.stamp.sec + 1e-9 * header.stamp.nanosec
        if self.latest is not None and stamp <= self.latest.stamp:
            raise PoseError(
                f"{source}: got stamp {stamp:.6f} s, expected one after {self.latest.stamp:.6f} s; "
                "reset after time has jumped back"
            )
        T_camera_object = pose_from_quaternion(_position(pose), _quaternion(pose))
        T_camera_object[:3, 3] += T_camera_object[:3, :3] @ self._back
        if self._mesh is not None:
            check_camera_outside(T_camera_object, self._mesh)
        self.latest = ObjectPose(
            stamp=stamp, T_camera_object=T_camera_object, covariance=self._covariance, fitness=1.0, source=source
        )
        return self.latest


def check_camera_outside(T_camera_object: ArrayLike, mesh: ObjectMesh) -> NDArray:
    """Return a checked pose (4, 4) after having refused one that puts the object around the camera.

    Raises:
        PoseError: The pose is not rigid, or the mesh surrounds the camera's origin.
    """
    T_camera_object = check_pose(T_camera_object, "object pose")
    camera = invert_pose(T_camera_object)[:3, 3]
    if surrounds(mesh, camera):
        raise PoseError(
            f"object pose: got one that puts the camera inside the object '{mesh.name}', at {camera.round(4)} m of its "
            "frame; expected the object in front of the camera (z forward), with T_camera_object and not its inverse"
        )
    return T_camera_object


def _position(pose: Any) -> NDArray:
    return np.array([pose.position.x, pose.position.y, pose.position.z], float)


def _quaternion(pose: Any) -> NDArray:
    return np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w], float)


def _is_unset(pose: Any) -> bool:
    """Return whether a pose is what a new message holds: at the origin, turned by nothing."""
    return not _position(pose).any() and not _quaternion(pose)[:3].any()


def _first_result(results: Sequence[Any]) -> Any:
    if not results or _is_unset(results[0].pose.pose):
        raise PoseError("Detection3DArray: got a detection with neither bbox.center nor results[0].pose.pose set")
    return results[0].pose.pose
