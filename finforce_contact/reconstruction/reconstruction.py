"""A metrically right, watertight object mesh and its pose from one masked depth image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.closing import build_poisson_mesh, close_mesh
from finforce_contact.mesh.object_mesh import prepare_object_mesh
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.reconstruction.completion import complete_surface
from finforce_contact.reconstruction.evidence import ImageEvidence
from finforce_contact.reconstruction.paper_alignment import align_as_paper
from finforce_contact.reconstruction.primitives import fit_primitive
from finforce_contact.reconstruction.result import GeneratedMesh, Reconstruction, Report, check_agreement, score_shape
from finforce_contact.reconstruction.shape_search import (
    Placement,
    ScaleFreedom,
    SearchFreedom,
    search_shape,
    turn_starts,
)

METHODS = ("robust", "paper", "primitive", "completion")
FROM_GENERATED = ("robust", "paper")
PRIMITIVE_MISFIT = 2e-3  # [m] above which an object is no primitive: true ones reach 0.7 to 1.6 mm, others 2.7 and more
# generators get proportions wrong by some per cent; what the image does not show keeps them
STRETCHABLE = SearchFreedom(late=ScaleFreedom(basis=np.eye(3), stiffness=0.03))


def reconstruct(
    evidence: ImageEvidence,
    generated: GeneratedMesh | None = None,
    method: str = "",
    report: Report | None = None,
) -> Reconstruction:
    """Return the object's mesh in metres and its pose.

    Args:
        evidence: of the masked depth image.
        generated: mesh with a guess of pose and scale, where there is one.
        method: "robust": many starts, surface and outline together, every axis with a scale of its own; "paper":
            scale by the x extent, two alignments, Poisson surface; "primitive": cylinder, box or sphere; "completion":
            what is seen, closed by the back of such a shape. When empty: "robust" with a generated mesh; without, a
            primitive if it explains the image, else the completion.
        report: called with the name of a stage and the share of it that is done.

    Raises:
        ReconstructionError: the method is unknown or lacks the generated mesh, or nothing explains the image.
        ObjectMeshError: the generated mesh is none.
        MissingDependencyError: Open3D or manifold3d is not installed.
    """
    report = report or (lambda stage, share: None)
    method = method or ("robust" if generated is not None else "")
    if method not in ("", *METHODS):
        raise ReconstructionError(f"method '{method}': expected one of {', '.join(METHODS)}")
    if method in FROM_GENERATED and generated is None:
        raise ReconstructionError(f"method '{method}' needs a generated mesh; without one use primitive or completion")
    if method not in FROM_GENERATED:
        return _reconstruct_alone(evidence, method, report)
    mesh, affine = prepare_generated(generated, evidence)
    report("mesh prepared", 1.0)
    return (_fit_robustly if method == "robust" else _fit_as_paper)(mesh, affine, evidence, report)


def _reconstruct_alone(evidence: ImageEvidence, method: str, report: Report) -> Reconstruction:
    """Reconstruct without a generated mesh: a primitive where that is asked for or good enough, else a completion."""
    shape = fit_primitive(evidence, report)
    if method == "completion" or (method == "" and shape.score.misfit > PRIMITIVE_MISFIT):
        return complete_surface(evidence, shape, report)
    check_agreement(shape.score)
    return shape


def prepare_generated(generated: GeneratedMesh, evidence: ImageEvidence) -> tuple[ObjectMesh, NDArray]:
    """Return the generated mesh about its middle and of the object's likely size, and its guessed map (4, 4).

    Raises:
        ObjectMeshError: it is no mesh.
    """
    vertices = np.asarray(generated.vertices, dtype=float)
    if vertices.ndim != 2 or vertices.shape[-1] != 3 or len(vertices) < 4 or not np.isfinite(vertices).all():
        raise ReconstructionError(f"generated mesh: vertices {vertices.shape}; expected finite ones, (n, 3), n > 3")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = max(float(np.linalg.norm(high - low)), 1e-12)
    factor = float(np.linalg.norm(np.ptp(evidence.points, axis=0))) / size
    mesh = prepare_object_mesh((vertices - 0.5 * (low + high)) * factor, generated.triangles, name=generated.name)
    affine = np.array(generated.affine, dtype=float)
    affine[:3, 3] += affine[:3, :3] @ (0.5 * (low + high))
    affine[:3, :3] /= factor
    return mesh, affine


def _fit_robustly(mesh: ObjectMesh, affine: NDArray, evidence: ImageEvidence, report: Report) -> Reconstruction:
    """Fit from many starts; a mesh that is closed already stays as it is."""
    fit = search_shape(mesh, turn_starts(_start_at(affine)), evidence, STRETCHABLE, report)
    check_agreement(fit.score)
    closed = close_mesh(bake_scale(mesh, fit.placement))
    report("closed", 1.0)
    return Reconstruction(
        mesh=closed,
        T_camera_object=fit.placement.pose,
        scale=_relative_scale(fit.placement.affine, affine),
        score=fit.score,
        method="robust",
    )


def _fit_as_paper(mesh: ObjectMesh, affine: NDArray, evidence: ImageEvidence, report: Report) -> Reconstruction:
    """Fit as the paper does, and take the Poisson surface."""
    aligned = align_as_paper(mesh, affine, evidence)
    report("aligned", 1.0)
    placement = _start_at(aligned)
    score = score_shape(MeshView(mesh), aligned, evidence)
    check_agreement(score)
    closed = build_poisson_mesh(bake_scale(mesh, placement))
    report("closed", 1.0)
    return Reconstruction(
        mesh=closed,
        T_camera_object=placement.pose,
        scale=_relative_scale(aligned, affine),
        score=score,
        method="paper",
    )


def bake_scale(mesh: ObjectMesh, placement: Placement) -> ObjectMesh:
    """Return the mesh with the placement's scale in its vertices."""
    return replace(mesh, vertices=mesh.vertices * np.exp(placement.log_scale))


def _start_at(affine: NDArray) -> Placement:
    """Return the placement of a map (4, 4) without shear."""
    scales = np.linalg.norm(affine[:3, :3], axis=0)
    left, _, right = np.linalg.svd(affine[:3, :3] / scales)
    return Placement(rotation=left @ right, translation=affine[:3, 3], log_scale=np.log(scales))


def _relative_scale(found: NDArray, given: NDArray) -> NDArray:
    """Return the factors (3,) between the column lengths of two maps (4, 4)."""
    return np.linalg.norm(found[:3, :3], axis=0) / np.linalg.norm(given[:3, :3], axis=0)
