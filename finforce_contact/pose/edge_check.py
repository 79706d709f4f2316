"""The agreement of a posed mesh with edges in colour images, and the turn of it that would agree better."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter

from finforce.camera import CameraIntrinsics
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.pose.mesh_check import LEAST_IMAGES, list_turns

COLUMNS = 200  # of the grid on which outlines are drawn
BLUR = 1.2  # [px] of that grid, of edges and outlines
REACH = 2  # [px] of that grid, by which an outline may be off
LEAST_RATIO = 1.2  # [-], of contrasts: at most 1.02 for a mesh that is right, at least 1.3 for one that is not
LEAST_CONTRAST = 1.0  # [of 255 per px]


class EdgeCheck:
    """Compares the outline of a mesh, posed by whoever tracks it, with edges in colour images, for want of depth.

    Turns that lay axes on axes are told by it, where they change the outline; other faults are not.

    Attributes:
        contradiction: which turn of the mesh would fit, "" for none.

    Args:
        mesh: of the object.
        camera: of the images.

    Raises:
        MissingDependencyError: Open3D is not installed.
    """

    def __init__(self, mesh: ObjectMesh, camera: CameraIntrinsics) -> None:
        self._name, self._camera, self._view = mesh.name, camera, MeshView(mesh)
        self._step, self._turns = max(camera.width // COLUMNS, 1), list_turns()
        self._contrasts = np.zeros(1 + len(self._turns))
        self._count, self.contradiction = 0, ""

    def add(self, color: NDArray, T_camera_object: NDArray) -> str:
        """Compare an image (h, w, 3) and return the contradiction by this and those before; the pose is (4, 4)."""
        grey = gaussian_filter(color.mean(axis=2), BLUR * self._step)[:: self._step, :: self._step]
        slopes = np.stack(np.gradient(grey), axis=-1)
        changes = np.eye(4), *(turn.change for turn in self._turns)
        self._contrasts += [self._find_contrast(slopes, T_camera_object @ change) for change in changes]
        self._count += 1
        own, best = self._contrasts[0], int(self._contrasts[1:].argmax())
        is_turned = self._contrasts[1 + best] > LEAST_RATIO * own + LEAST_CONTRAST * self._count
        said = f"the camera contradicts the mesh {self._name}: edges in colour are not at its outline; the mesh fits "
        said += f"when {self._turns[best].text}"
        self.contradiction = said if is_turned and self._count >= LEAST_IMAGES else ""
        return self.contradiction

    @property
    def sees_mesh(self) -> bool:
        """True if the outline of the mesh is in an image."""
        return bool(self._contrasts[0] > 0.0)

    def _find_contrast(self, slopes: NDArray, T_camera_object: NDArray) -> float:
        """Return the mean slope of an image (h, w, 2) across the outline of the mesh, wherever that shows best."""
        mask = np.isfinite(self._view.render(T_camera_object, self._camera, self._step).depth)
        normals = np.stack(np.gradient(gaussian_filter(mask.astype(float), BLUR)), axis=-1)
        outline = np.argwhere(mask & ~binary_erosion(mask, border_value=1))
        if not len(outline):
            return 0.0
        across = normals[tuple(outline.T)]
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        moves = np.stack(np.meshgrid(*[np.arange(-REACH, REACH + 1)] * 2), axis=-1).reshape(-1, 1, 2)
        rows, columns = np.clip(outline + moves, 0, np.array(mask.shape) - 1).transpose(2, 0, 1)
        return float(np.abs((slopes[rows, columns] * across).sum(axis=2)).mean(axis=1).max())
