"""How well a placed mesh explains a masked depth image, pixel by pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
