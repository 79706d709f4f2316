"""Where a mesh is and how large, axis by axis: rotation, translation and scale as one record; knows no images."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, kw_only=True, eq=False)
class Placement:
    """A point x of the mesh lies at R diag(exp(log_scale)) x + t in the camera frame.

    Attributes:
        rotation: (3, 3) R.
        translation: (3,) t [m].
        log_scale: (3,) natural logarithm of the scale along the mesh's axes.
    """

    rotation: NDArray
    translation: NDArray
    log_scale: NDArray = field(default_factory=lambda: np.zeros(3))

    @property
    def affine(self) -> NDArray:
        """The map (4, 4) of mesh coordinates into the camera frame."""
        A = np.eye(4)
        A[:3, :3] = self.rotation * np.exp(self.log_scale)
        A[:3, 3] = self.translation
        return A

    @property
    def pose(self) -> NDArray:
        """The rigid part (4, 4), the pose of the mesh once the scale is baked into it."""
        T = np.eye(4)
        T[:3, :3] = self.rotation
        T[:3, 3] = self.translation
        return T

    def moved(self, step: NDArray, basis: NDArray) -> Placement:
        """Return the placement after a step: rotation vector (3,), translation (3,) and scales (k,) of basis (3, k)."""
        return Placement(
            rotation=Rotation.from_rotvec(step[:3]).as_matrix() @ self.rotation,
            translation=self.translation + step[3:6],
            log_scale=self.log_scale + basis @ step[6:],
        )

    def compute_rows(self, points: NDArray, directions: NDArray, basis: NDArray) -> NDArray:
        """Return (n, 6 + k) derivatives, by the step, of the movement of mesh points along directions.

        d(g . x) = g . (w x (x - t) + dt + R diag(R^T (x - t)) B ds)

        Args:
            points: (n, 3) points x of the placed mesh, camera frame [m].
            directions: (n, 3) directions g.
            basis: (3, k) B, what each free scale does to the three logarithms.
        """
        arms = points - self.translation
        stretch = (directions @ self.rotation) * (arms @ self.rotation)
        return np.hstack((np.cross(arms, directions), directions, stretch @ basis))
