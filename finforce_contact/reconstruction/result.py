"""What a reconstruction gives, and from what."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.reconstruction.shape_score import ShapeScore

Report = Callable[[str, float], None]  # the name of a stage, and the share of it that is done
LEAST_OVERLAP = 0.8  # right ones reach 0.95, wrong ones 0.72 at most
LARGEST_RESIDUAL = 3e-3  # [m]


@dataclass(frozen=True, kw_only=True, eq=False)
class GeneratedMesh:
    """A mesh that a generator made from a picture, with its guess of where it is and how large.

    Attributes:
        vertices: (n, 3) in the generator's unit and axes.
        triangles: (m, 3).
        affine: (4, 4) map of the vertices into the camera frame [m]; a rotation times one scale, and a translation.
        name: of the object.
    """

    vertices: NDArray
    triangles: NDArray
    affine: NDArray
    name: str = "object"

    def __post_init__(self) -> None:
        A = np.asarray(self.affine, dtype=float)
        if A.shape != (4, 4) or not np.isfinite(A).all() or not np.allclose(A[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
            raise ReconstructionError(f"pose of the generated mesh: {A.tolist()}; expected a finite (4, 4) affine map")
        scales = np.linalg.norm(A[:3, :3], axis=0)
        if scales.min() < 1e-9 or np.linalg.det(A[:3, :3] / np.maximum(scales, 1e-12)) < 0.99:
            raise ReconstructionError(
                f"pose of the generated mesh: column lengths {scales.tolist()}, determinant "
                f"{np.linalg.det(A[:3, :3]):.3g}; expected a rotation times a scale, neither sheared nor mirrored"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Reconstruction:
    """An object's mesh in metres, where it is, and how well the two explain the image.

    Attributes:
        mesh: in a frame with the origin in its middle.
        T_camera_object: (4, 4) its pose.
        scale: (3,) that the given mesh was stretched by along its axes; ones where none was given.
        score: agreement with the image.
        method: that was used.
    """

    mesh: ObjectMesh
    T_camera_object: NDArray
    scale: NDArray
    score: ShapeScore
    method: str


def check_agreement(score: ShapeScore) -> None:
    """Refuse a result that does not explain the image.

    Raises:
        ReconstructionError: it does not.
    """
    if score.overlap < LEAST_OVERLAP or not score.residual <= LARGEST_RESIDUAL:
        raise ReconstructionError(
            f"no placement of the mesh explains the image: {100.0 * score.overlap:.1f} % of its outline and the mask "
            f"overlap, its surface {1e3 * score.residual:.1f} mm off; expected {100.0 * LEAST_OVERLAP:.0f} % or more "
            f"and {1e3 * LARGEST_RESIDUAL:.0f} mm or less. Is the mesh of this object, and the mask of it alone?"
        )
