"""Ways to follow an object that the tracker is compared with, and what a pose is off."""

from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics, deproject
from finforce.transforms import invert_pose, rotation_between
from finforce_contact.errors import PoseLostError
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.pose.source import ObjectPose
from finforce_twin.scenes.pose_sequences import SequenceImage

ROUND = ("cylinder", "bottle")
HANDLE_RADIUS, HANDLE_SHARE = 0.042, 0.015  # the mug's body ends within; fewer of its pixels say nothing of its turn
POINTS = 1000
REACH = 0.01  # [m] between corresponding points


@dataclass(frozen=True, kw_only=True)
class PoseDeviation:
    """What a pose is off: translation [m], and rotation [rad] beyond what the object's symmetry leaves open."""

    translation: float
    rotation: float


class IcpTracker:
    """The visible part of the mesh against the masked points, frame to frame, by small_gicp or Open3D."""

    def __init__(self, mesh: ObjectMesh, camera: CameraIntrinsics, library: ModuleType) -> None:
        """Prepares the mesh; the library is small_gicp (GICP) or open3d (point to plane)."""
        self._view, self._camera, self._library = MeshView(mesh), camera, library
        self._T: NDArray | None = None

    def locate(self, frame: SequenceImage, guess: NDArray) -> ObjectPose:
        """Starts from a guess (4, 4)."""
        self._T = guess
        return self.track(frame)

    def track(self, frame: SequenceImage) -> ObjectPose:
        """Follows the object by the points within the frame's mask, which is the true one."""
        step = max(1, int(np.sqrt(frame.mask.sum() / POINTS)))
        chosen = np.zeros_like(frame.mask)
        chosen[::step, ::step] = frame.mask[::step, ::step]
        measured = deproject(frame.depth, self._camera, chosen)
        view = self._view.render(self._T, self._camera, step)
        if min(len(measured), len(view.points)) < 30:
            raise PoseLostError("too few points")
        align = _align_gicp if self._library.__name__ == "small_gicp" else _align_open3d
        self._T = align(self._library, view, measured) @ self._T
        return ObjectPose(
            stamp=frame.stamp, T_camera_object=self._T, covariance=np.eye(6) * 1e-6, fitness=1.0, source="icp"
        )


def compute_deviation(name: str, frame: SequenceImage, T: NDArray, camera: CameraIntrinsics) -> PoseDeviation:
    """Returns what a pose (4, 4) of an object is off.

    Of round objects, and of the mug while less than 1.5 % of its seen pixels are handle, the tilt of the axis counts;
    of the cube, the nearest of the turns that map it onto itself.
    """
    true = frame.T_camera_object
    tilt = float(np.arccos(np.clip(true[:3, 2] @ T[:3, 2], -1.0, 1.0)))
    if name == "cylinder":
        rotation = min(tilt, np.pi - tilt)
    elif name in ROUND or (name == "mug" and not _shows_handle(frame, camera)):
        rotation = tilt
    elif name == "cube":
        turned = [T[:3, :3] @ turn for turn in Rotation.create_group("O").as_matrix()]
        rotation = min(rotation_between(true, turn) for turn in turned)
    else:
        rotation = rotation_between(true, T)
    return PoseDeviation(translation=float(np.linalg.norm(T[:3, 3] - true[:3, 3])), rotation=rotation)


def _shows_handle(frame: SequenceImage, camera: CameraIntrinsics) -> bool:
    back = invert_pose(frame.T_camera_object)
    points = deproject(frame.depth, camera, frame.mask) @ back[:3, :3].T + back[:3, 3]
    outside = np.hypot(points[:, 0], points[:, 1]) > HANDLE_RADIUS
    return bool((outside & (np.abs(points) < 0.08).all(axis=1)).mean() > HANDLE_SHARE)


def _align_gicp(small_gicp, view, measured: NDArray) -> NDArray:
    """Returns the motion (4, 4) of the mesh onto the measured points."""
    found = small_gicp.align(
        measured, view.points, registration_type="GICP", downsampling_resolution=1e-4,
        max_correspondence_distance=REACH, num_threads=1,
    )  # fmt: skip
    return np.asarray(found.T_target_source)


def _align_open3d(open3d, view, measured: NDArray) -> NDArray:
    """Returns the motion (4, 4) of the mesh onto the measured points; planes are those of the mesh."""
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (measured, view.points)]
    clouds[1].normals = open3d.utility.Vector3dVector(view.normals)
    registration = open3d.pipelines.registration
    found = registration.registration_icp(
        clouds[0], clouds[1], REACH, np.eye(4), registration.TransformationEstimationPointToPlane()
    )
    return invert_pose(found.transformation)
