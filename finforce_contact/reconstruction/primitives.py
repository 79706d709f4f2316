"""Cylinder, box or sphere for a masked depth image, where no mesh was generated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.reconstruction.evidence import ImageEvidence
from finforce_contact.reconstruction.result import Reconstruction, Report
from finforce_contact.reconstruction.shape_search import (
    Placement,
    ScaleFreedom,
    SearchFreedom,
    ShapeFit,
    scale_mesh,
    search_shape,
)

SEGMENTS = 64
BALL_POINTS = 600
# pulls what the image does not show, such as the depth of a box seen from the front, towards the other lengths
STIFFNESS = 0.005
# of the misfit: a shape with more freedom has to explain the image better by as much
HANDICAP = {"sphere": 1.0, "cylinder": 1.05, "box": 1.1}
AXIS_STARTS, BOX_STARTS = 12, 16
ELONGATIONS = (0.0, 0.7, -0.7)  # logarithm of length over diameter


@dataclass(frozen=True, kw_only=True, eq=False)
class Primitive:
    """A shape of unit size, the scales that are free, and where to begin."""

    mesh: ObjectMesh
    freedom: ScaleFreedom
    starts: tuple[Placement, ...]


def fit_primitive(evidence: ImageEvidence, report: Report | None = None) -> Reconstruction:
    """Return the cylinder, box or sphere that explains the image best; its score says how well.

    Each is fitted to surface and outline together. Compared are the misfits over all pixels of mask and shape, so
    that a shape whose unseen part would be seen beyond the mask is refused; the simpler shape wins between equals.

    Args:
        evidence: of the masked depth image.
        report: called with the name of a stage and the share of it that is done.

    Raises:
        MissingDependencyError: Open3D is not installed.
    """
    report = report or (lambda stage, share: None)
    fits = compare_primitives(evidence, report)
    name = min(fits, key=lambda key: HANDICAP[key] * fits[key].score.misfit)
    fit = fits[name]
    mesh = scale_mesh(build_primitive(name).mesh, fit.placement.log_scale)
    return Reconstruction(
        mesh=replace(mesh, notes=(*mesh.notes, f"The back was not seen; it is guessed to be that of a {name}.")),
        T_camera_object=fit.placement.pose,
        scale=np.ones(3),
        score=fit.score,
        method=f"primitive: {name}",
    )


def compare_primitives(evidence: ImageEvidence, report: Report) -> Mapping[str, ShapeFit]:
    """Return the best fit of each shape by its name."""
    fits = {}
    for name in HANDICAP:
        primitive = build_primitive(name)
        freedom = SearchFreedom(early=primitive.freedom, late=primitive.freedom)
        fits[name] = search_shape(primitive.mesh, primitive.starts, evidence, freedom, _prefix(report, name))
    return fits


def _prefix(report: Report, name: str) -> Report:
    """Return a report that says which shape a stage is of."""
    return lambda stage, share: report(f"{name}: {stage}", share)


def build_primitive(name: str) -> Primitive:
    """Return a shape by its name, a key of `HANDICAP`; sphere and cylinder have unit diameter, all unit height."""
    if name == "sphere":
        return Primitive(
            mesh=_hull_mesh(0.5 * spread_directions(BALL_POINTS), name), freedom=ScaleFreedom(), starts=(_start_with(),)
        )
    if name == "cylinder":
        angles = np.linspace(0.0, 2.0 * np.pi, SEGMENTS, endpoint=False)
        circle = 0.5 * np.column_stack((np.cos(angles), np.sin(angles), np.ones(SEGMENTS)))
        mesh = _hull_mesh(np.vstack((circle, circle * (1.0, 1.0, -1.0))), name)
        freedom = ScaleFreedom(basis=np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), stiffness=STIFFNESS)
        axes = [axis for axis in spread_directions(2 * AXIS_STARTS) if axis[2] <= 0.0]
        turns = [Rotation.align_vectors(axis[None], [[0.0, 0.0, 1.0]])[0] for axis in axes]
        starts = [_start_with(turn, elongation) for turn in turns for elongation in ELONGATIONS]
        return Primitive(mesh=mesh, freedom=freedom, starts=tuple(starts))
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
    turns = Rotation.random(BOX_STARTS, rng=np.random.default_rng(0))
    freedom = ScaleFreedom(basis=np.eye(3), stiffness=STIFFNESS)
    return Primitive(mesh=_hull_mesh(corners, name), freedom=freedom, starts=tuple(map(_start_with, turns)))


def spread_directions(count: int) -> NDArray:
    """Return unit vectors (count, 3), spread evenly along a spiral from pole to pole."""
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - z**2)
    return np.column_stack((radius * np.cos(angle), radius * np.sin(angle), z))


def _start_with(turn: Rotation | None = None, elongation: float = 0.0) -> Placement:
    """Return a start of unit size."""
    turn = turn or Rotation.identity()
    stretch = elongation * np.array([-1.0, -1.0, 2.0]) / 3.0
    return Placement(rotation=turn.as_matrix(), translation=np.zeros(3), log_scale=stretch)


def _hull_mesh(points: NDArray, name: str) -> ObjectMesh:
    """Return the closed convex surface through points (n, 3) about the origin."""
    triangles = ConvexHull(points).simplices
    corners = points[triangles]
    inward = (
        np.einsum("ij,ij->i", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners[:, 0]) < 0
    )
    triangles = np.where(inward[:, None], triangles[:, ::-1], triangles).astype(np.int32)
    return ObjectMesh(vertices=points, triangles=triangles, watertight=True, name=name)
