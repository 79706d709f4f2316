"""Scale and pose of a generated mesh as the paper finds them (section "Mesh Reconstruction"); one start, one scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from finforce.camera import deproject
from finforce.optional import import_open3d
from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.reconstruction.evidence import ImageEvidence

REACH = 0.02  # [m] of correspondences; the paper names none
ITERATIONS = 100


def scale_coarsely(mesh: ObjectMesh, affine: NDArray, cloud: NDArray) -> NDArray:
    """Return the map (4, 4) with the mesh scaled, about its own middle, to the x extent of the cloud.

    Args:
        mesh: generated.
        affine: (4, 4) the generator's map into the camera frame.
        cloud: (n, 3) measured points of the object, camera frame [m].
    """
    placed = mesh.vertices @ affine[:3, :3].T + affine[:3, 3]
    factor = np.ptp(cloud[:, 0]) / np.ptp(placed[:, 0])
    middle = 0.5 * (placed.min(axis=0) + placed.max(axis=0))
    return _similarity(factor * np.eye(3), middle - factor * middle) @ affine


def align_as_paper(mesh: ObjectMesh, affine: NDArray, evidence: ImageEvidence) -> NDArray:
    """Return the map (4, 4) after the coarse scale and two point-to-point alignments, the second with scale.

    The visible part of the mesh is what the camera's pixel grid shows of it; it is looked at anew before each.

    Raises:
        ReconstructionError: the mesh is out of the camera's sight.
    """
    cloud = deproject(evidence.depth, evidence.camera, evidence.mask)
    affine = scale_coarsely(mesh, affine, cloud)
    for with_scale in (False, True):
        visible = MeshView(mesh).render(affine, evidence.camera).points
        if len(visible) < 10:
            raise ReconstructionError(
                "the generated mesh lies out of the camera's sight after the coarse scale; "
                "is its pose meant for this camera? The method 'robust' needs no good pose"
            )
        affine = _register(visible, cloud, with_scale) @ affine
    return affine


def _register(source: NDArray, target: NDArray, with_scale: bool) -> NDArray:
    """Return the map (4, 4) of source points (n, 3) onto target points (m, 3), by iterated closest points."""
    open3d = import_open3d()
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (source, target)]
    registration = open3d.pipelines.registration
    result = registration.registration_icp(
        *clouds,
        REACH,
        np.eye(4),
        registration.TransformationEstimationPointToPoint(with_scale),
        registration.ICPConvergenceCriteria(max_iteration=ITERATIONS),
    )
    return np.array(result.transformation)


def _similarity(linear: NDArray, translation: NDArray) -> NDArray:
    """Return the map (4, 4) x -> linear x + translation."""
    A = np.eye(4)
    A[:3, :3], A[:3, 3] = linear, translation
    return A
