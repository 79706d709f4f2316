"""What a reconstruction gives, from what, and how well it explains a masked depth image, pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.reconstruction.evidence import ImageEvidence

HIDING_STEP = 4e-3  # [m] by which something measured is nearer than the mesh when it hides it
MISFIT_BOUND = 5e-3  # [m] beyond which a pixel is simply not explained


@dataclass(frozen=True, kw_only=True)
class ShapeScore:
    """How well a mesh explains an image.

    Attributes:
        misfit: root mean square over the pixels of mask and mesh together, each at most `MISFIT_BOUND` [m].
        residual: median distance of the measured pixels from the mesh, along its normals [m].
        overlap: pixels in mask and mesh over those in either, without those of the mesh that something hides.
    """

    misfit: float
    residual: float
    overlap: float


def score_shape(view: MeshView, affine: NDArray, evidence: ImageEvidence, step: int = 2) -> ShapeScore:
    """Compare the image with what the camera would see of a mesh.

    Args:
        view: of the mesh.
        affine: (4, 4) map of its coordinates into the camera frame.
        evidence: of the image.
        step: every how many pixels to look.
    """
    seen = view.render(affine, evidence.camera, step)
    mask, depth = evidence.mask[::step, ::step], evidence.depth[::step, ::step]
    covered = np.isfinite(seen.depth)
    with np.errstate(invalid="ignore"):
        is_hidden = depth < seen.depth - HIDING_STEP
    # the mesh may go on where nothing was measured or something nearer is, and nowhere else
    excess = covered & ~mask & ~is_hidden & np.isfinite(depth)
    both = covered & mask
    offsets = (depth - seen.depth)[covered] * _normal_shares(seen.points, seen.normals)
    offsets = offsets[both[covered]]
    known = np.abs(offsets[np.isfinite(offsets)])
    missed = int((mask & ~covered).sum() + excess.sum())
    squares = np.minimum(known, MISFIT_BOUND) ** 2
    count = len(known) + missed
    overlap = both.sum() / max(both.sum() + missed, 1)
    misfit = np.sqrt((squares.sum() + missed * MISFIT_BOUND**2) / count) if count else MISFIT_BOUND
    residual = float(np.median(known)) if len(known) else np.inf
    return ShapeScore(misfit=float(misfit), residual=residual, overlap=float(overlap))


def _normal_shares(points: NDArray, normals: NDArray) -> NDArray:
    """Return what (n,) of a difference in depth counts across the surface: |n . ray|, for the ray with z = 1."""
    return np.abs(np.einsum("ij,ij->i", normals, points) / points[:, 2])


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

    @property
    def mesh(self) -> ObjectMesh:
        """The triangles, in the generator's unit and axes."""
        return ObjectMesh(vertices=self.vertices, triangles=self.triangles, watertight=False, name=self.name)


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
