"""Shapes fitted to a depth image: meshes that move and stretch, and primitives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.reconstruction.evidence import ImageEvidence, Reconstruction, Report, ShapeScore, score_shape


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


FACING = 0.2  # least cosine between a measured normal and the mesh's, else the point is on another side of a wall
NEAR = 3e-4  # [m] from the surface, below which the direction to it is its normal
OUTLINE_WEIGHT = 0.5  # of all outline pixels together, that of all surface points being one
STEP_TOLERANCE = 2e-5  # [rad], [m] or in the logarithm
DAMPING = 1e-4
LARGEST_TURN = 0.3  # [rad], of one step
LARGEST_MOVE = 0.03  # [m], of one step
LARGEST_STRETCH = 0.2  # [-], of one step, logarithm of the scale


@dataclass(frozen=True, kw_only=True)
class FitStage:
    """One pass of the fit: grid of the view [px], iterations, points used and the width of the loss [m]."""

    step: int
    iterations: int
    points: int
    width: float


COARSE = (FitStage(step=8, iterations=8, points=250, width=15e-3),)
MIDDLE = (
    FitStage(step=4, iterations=12, points=500, width=8e-3),
    FitStage(step=2, iterations=8, points=1000, width=4e-3),
)
FINE = (
    FitStage(step=1, iterations=12, points=2000, width=2e-3),
    FitStage(step=1, iterations=8, points=2000, width=1e-3),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class ScaleFreedom:
    """The free scales, and the stiffness of the axes' proportions.

    Attributes:
        basis: (3, k) what each free scale does to the logarithms of the three.
        stiffness: misfit [m], over the size of the object, that a deviation by a factor e from the given
            proportions is worth.
    """

    basis: NDArray = field(default_factory=lambda: np.ones((3, 1)))
    stiffness: float = 0.0


UNIFORM = ScaleFreedom()


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pull:
    """The residuals of mesh points (n, 3) [m]: unit directions (n, 3), distances (n,) [m], weights (n,)."""

    points: NDArray
    directions: NDArray
    residuals: NDArray
    weights: NDArray


def fit_shape(
    mesh: ObjectMesh,
    start: Placement,
    evidence: ImageEvidence,
    stages: Iterable[FitStage],
    freedom: ScaleFreedom = UNIFORM,
) -> Placement:
    """Return the placement of the mesh that explains the image best, near a start.

    Gauss-Newton on the sum of rho(distance of measured points) and rho(distance of the outlines), with the
    Geman-McClure loss rho and a weak pull towards the mesh's own proportions.

    Args:
        mesh: as given; its own units and frame.
        start: where to begin.
        evidence: of the image.
        stages: passes, from coarse to fine.
        freedom: the scales that are free.
    """
    placement = start
    for stage in stages:
        fit = _StageFit(mesh, placement, evidence, stage, freedom)
        for _ in range(stage.iterations):
            step = fit.solve_step(placement, placement.log_scale - start.log_scale)
            placement = placement.moved(step, freedom.basis)
            if np.abs(step).max() < STEP_TOLERANCE:
                break
    return placement


class _StageFit:
    """The equations of one stage, for a mesh into which the scale so far has gone."""

    def __init__(
        self, mesh: ObjectMesh, placement: Placement, evidence: ImageEvidence, stage: FitStage, freedom: ScaleFreedom
    ) -> None:
        # only then does "nearest on the mesh" mean nearest in metres
        self._baked = placement.log_scale
        scaled = scale_mesh(mesh, self._baked)
        self._view = MeshView(scaled)
        self._size = float(np.ptp(scaled.vertices, axis=0).mean())
        self._evidence, self._stage, self._freedom = evidence, stage, freedom
        self._stride = max(1, len(evidence.points) // stage.points)

    def solve_step(self, placement: Placement, stretched: NDArray) -> NDArray:
        """Return the Gauss-Newton step (6 + k,) from a placement stretched by (3,) from the given proportions."""
        affine = replace(placement, log_scale=placement.log_scale - self._baked).affine
        basis = self._freedom.basis
        H = np.zeros((6 + basis.shape[1],) * 2)
        gradient = np.zeros(len(H))
        for pull in (self._pull_surface(affine), self._pull_outline(affine)):
            J = placement.compute_rows(pull.points, pull.directions, basis)
            weighted = J * pull.weights[:, None]
            H += weighted.T @ J
            gradient += weighted.T @ pull.residuals
        # deviations from the given proportions: what is common to the axes is free
        common = np.eye(3) - np.full((3, 3), 1.0 / 3.0)
        stiff = (self._freedom.stiffness * self._size) ** 2
        H[6:, 6:] += stiff * basis.T @ common @ basis
        gradient[6:] -= stiff * basis.T @ common @ stretched
        H[np.diag_indices_from(H)] += DAMPING * np.diag(H) + 1e-12
        step = np.linalg.solve(H, gradient)
        parts = (np.linalg.norm(step[:3]) / LARGEST_TURN, np.linalg.norm(step[3:6]) / LARGEST_MOVE)
        stretch = np.abs(step[6:]).max(initial=0.0) / LARGEST_STRETCH
        return step / max(1.0, *parts, stretch)

    def _pull_surface(self, affine: NDArray) -> _Pull:
        """Return the pull of the measured points on the nearest points of the mesh, along the distance's gradient."""
        measured = self._evidence.points[:: self._stride]
        nearest = self._view.closest(measured, affine)
        offset = measured - nearest.points
        distance = np.linalg.norm(offset, axis=1)
        side = np.where(np.einsum("ij,ij->i", offset, nearest.normals) < 0.0, -1.0, 1.0)
        apart = (side / np.maximum(distance, 1e-12))[:, None] * offset
        directions = np.where(distance[:, None] < NEAR, nearest.normals, apart)
        residuals = np.einsum("ij,ij->i", offset, directions)
        facing = np.einsum("ij,ij->i", nearest.normals, self._evidence.normals[:: self._stride]) > FACING
        weights = facing * _weigh(residuals, self._stage.width) / len(measured)
        return _Pull(points=nearest.points, directions=directions, residuals=residuals, weights=weights)

    def _pull_outline(self, affine: NDArray) -> _Pull:
        """Return the pull of the mask's outline on the rim of the mesh, across the outline."""
        step, evidence = self._stage.step, self._evidence
        view = self._view.render(affine, evidence.camera, step)
        hit = np.isfinite(view.depth)
        rim = np.flatnonzero(~binary_erosion(hit, border_value=0)[hit])
        points, (columns, rows) = view.points[rim], view.pixels[rim].T
        z = points[:, 2]
        weights = evidence.edge_weight[rows, columns]
        # the rim's pixels lie half a step inside the mesh's outline
        residuals = -(evidence.edge_distance[rows, columns] + 0.5 * step) * z / evidence.camera.fx
        slope = evidence.edge_slope[rows, columns]
        directions = np.column_stack((slope, -(slope * points[:, :2]).sum(axis=1) / z))
        weights = OUTLINE_WEIGHT * weights * _weigh(residuals, self._stage.width) / max(len(rim), 1)
        return _Pull(points=points, directions=directions, residuals=residuals, weights=weights)


def _weigh(residuals: NDArray, width: float) -> NDArray:
    """Return the Geman-McClure weights w = (c^2 / (c^2 + r^2))^2."""
    return (width**2 / (width**2 + residuals**2)) ** 2


def scale_mesh(mesh: ObjectMesh, log_scale: NDArray) -> ObjectMesh:
    """Return the mesh stretched along its axes by exp(log_scale) (3,)."""
    return replace(mesh, vertices=mesh.vertices * np.exp(log_scale))


HIDDEN_SHARE = 0.15  # of the outline, above which the mask says too little about the size
HIDDEN_GROWTH = 0.35
KEPT_COARSE = 8  # placements kept of the coarse stage
KEPT_MIDDLE = 3  # placements kept of the middle stage
SEAT_ROUNDS = 3
SEAT_STEP = 8  # [px], grid of the views for seating
COARSE_STEP = 4  # [px], grid of the views for scoring coarse fits
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


SEGMENTS = 64
BALL_POINTS = 600
# pulls what the image does not show, such as the depth of a box seen from the front, towards the other lengths
STIFFNESS = 0.005
# of the misfit: a shape with more freedom has to explain the image better by as much
HANDICAP = {"sphere": 1.0, "cylinder": 1.05, "box": 1.1}
AXIS_STARTS = 12  # directions of a cylinder's axis to start from
BOX_STARTS = 16  # rotations of a box to start from
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
        told = lambda stage, share, name=name: report(f"{name}: {stage}", share)  # noqa: E731
        fits[name] = search_shape(primitive.mesh, primitive.starts, evidence, freedom, told)
    return fits


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
    hull = ObjectMesh(vertices=points, triangles=ConvexHull(points).simplices, watertight=True, name=name)
    return hull.turn(hull.volumes < 0.0)
