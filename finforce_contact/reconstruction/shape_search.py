"""The best placement of a mesh from many starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.reconstruction.evidence import ImageEvidence
from finforce_contact.reconstruction.result import Report
from finforce_contact.reconstruction.shape_fit import (
    COARSE,
    FINE,
    MIDDLE,
    UNIFORM,
    Placement,
    ScaleFreedom,
    fit_shape,
    scale_mesh,
)
from finforce_contact.reconstruction.shape_score import ShapeScore, score_shape

HIDDEN_SHARE = 0.15  # of the outline, above which the mask says too little about the size
HIDDEN_GROWTH = 0.35
KEPT_COARSE, KEPT_MIDDLE = 8, 3
SEAT_ROUNDS = 3
SEAT_STEP, COARSE_STEP = 8, 4  # [px]
TURN_PENALTY = 0.05  # of the misfit, for half a turn away from the given rotation: decides between equals only


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchFreedom:
    """The scales that are free while starts are compared, and in the refinement of the best."""

    early: ScaleFreedom = UNIFORM
    late: ScaleFreedom = UNIFORM


@dataclass(frozen=True, kw_only=True, eq=False)
class ShapeFit:
    """A placement and how well it explains the image."""

    placement: Placement
    score: ShapeScore


_UNKNOWN = ShapeScore(misfit=np.inf, residual=np.inf, overlap=0.0)


def search_shape(
    mesh: ObjectMesh,
    starts: Sequence[Placement],
    evidence: ImageEvidence,
    freedom: SearchFreedom | None = None,
    report: Report | None = None,
) -> ShapeFit:
    """Return the placement that explains the image best, from coarse fits of all starts and finer ones of the best.

    Args:
        mesh: its frame's origin near its middle.
        starts: where to begin; the first is what the others are turned from.
        evidence: of the image.
        freedom: the scales that are free; one for all axes when absent.
        report: called with the stage's name and the share of it that is done.
    """
    report = report or (lambda stage, share: None)
    freedom = freedom or SearchFreedom()
    seated = [seat(mesh, start, evidence, growth) for start in starts for growth in _choose_growths(evidence)]
    candidates = [ShapeFit(placement=placement, score=_UNKNOWN) for placement in seated]
    passes = (
        ("starts", COARSE, len(seated), freedom.early, COARSE_STEP),
        ("best starts", MIDDLE, KEPT_COARSE, freedom.early, 2),
        ("refinement", (*MIDDLE, *FINE), KEPT_MIDDLE, freedom.late, 2),
    )
    for name, stages, kept, scales, step in passes:
        fits = []
        for index, candidate in enumerate(candidates[:kept]):
            placement = fit_shape(mesh, candidate.placement, evidence, stages, scales)
            score = score_shape(MeshView(mesh), placement.affine, evidence, step)
            fits.append(ShapeFit(placement=placement, score=score))
            report(name, (index + 1) / min(kept, len(candidates)))
        candidates = sorted(fits, key=lambda fit: _handicap(fit.placement, starts[0]) * fit.score.misfit)
    return candidates[0]


def _handicap(placement: Placement, first: Placement) -> float:
    """Return the factor on the misfit for being turned away from the first start."""
    return 1.0 + TURN_PENALTY * Rotation.from_matrix(placement.rotation @ first.rotation.T).magnitude() / np.pi


def _choose_growths(evidence: ImageEvidence) -> tuple[float, ...]:
    """Return logarithms by which starts grow beyond the mask: none, and some where much of the outline is hidden."""
    outline = evidence.edge_weight[np.abs(evidence.edge_distance) < 1.0]
    return (0.0, HIDDEN_GROWTH) if np.mean(outline == 0.0) > HIDDEN_SHARE else (0.0,)


def seat(mesh: ObjectMesh, start: Placement, evidence: ImageEvidence, growth: float = 0.0) -> Placement:
    """Return a start moved and scaled so that the box around its view, and its depth, agree with the mask.

    The box of a mask that something cuts off is too small; `growth`, a logarithm, is added for it.
    """
    view = MeshView(mesh)
    centre = evidence.points.mean(axis=0)
    size = np.ptp(scale_mesh(mesh, start.log_scale).vertices, axis=0).mean()
    spread = np.linalg.norm(np.ptp(evidence.points, axis=0)[:2])
    placement = replace(
        start,
        log_scale=start.log_scale + np.log(spread / (1.4 * size)),
        translation=centre * (1.0 + 0.4 * spread / np.linalg.norm(centre)),
    )
    columns_rows = np.argwhere(evidence.mask)[:, ::-1]
    low, high = columns_rows.min(axis=0), columns_rows.max(axis=0)
    camera = evidence.camera
    for _ in range(SEAT_ROUNDS):
        seen = view.render(placement.affine, camera, SEAT_STEP)
        if len(seen.points) == 0:
            break
        z = np.median(seen.points[:, 2])
        seen_low, seen_high = seen.pixels.min(axis=0), seen.pixels.max(axis=0) + SEAT_STEP - 1
        shift = 0.5 * (low + high - seen_low - seen_high) * z / (camera.fx, camera.fy)
        missing = np.log(np.linalg.norm(high - low) / np.linalg.norm(seen_high - seen_low))
        deeper = np.median(evidence.points[:, 2]) - z
        placement = replace(
            placement,
            log_scale=placement.log_scale + np.clip(missing, -0.7, 0.7),
            translation=placement.translation + (*shift, deeper),
        )
    return replace(placement, log_scale=placement.log_scale + growth)


def turn_starts(start: Placement, tilt: float = 0.6) -> list[Placement]:
    """Return the start itself, tilted by +-`tilt` [rad] about each axis, and turned by the 23 turns of a cube."""
    tilts = [sign * tilt * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
    turns = [Rotation.identity(), *map(Rotation.from_rotvec, tilts)]
    turns += [turn for turn in Rotation.create_group("O") if turn.magnitude() > 1e-6]
    return [replace(start, rotation=start.rotation @ turn.as_matrix()) for turn in turns]
