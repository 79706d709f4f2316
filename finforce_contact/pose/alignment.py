"""Brings a mesh into agreement with one depth image by Gauss-Newton steps."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics
from finforce.transforms import invert_pose
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.pose.contour import MeshOutline, Outline, compare_outline
from finforce_contact.pose.depth_image import Comparison, DepthImage, Glance, Samples, Visibility
from finforce_contact.settings import TrackerSettings

_EDGE_POINTS = 200  # of the outline that are compared per image
_NOISE_WIDTH = 5.0  # [px] over which the errors of the depth are alike
# Errors of the normals of the mesh and of its outline [rad]: a motion along its surface up to this is not seen.
_NORMAL_ERROR, _EDGE_ERROR = 0.035, 0.15
# A surface seen at less than this cosine tells more about flying pixels than about itself.
_GRAZING = 0.2
# The end of an object in a depth image is known to about this [px].
_EDGE_NOISE = 1.0
_MAD = 1.4826  # from the median of absolute values to a standard deviation, normal distribution
_CAUCHY = 2.385  # [sigma], 95 % efficient where errors are normal after all
# One step moves by no more than this [m, at the object's rim where it turns].
_LONGEST_STEP = 0.02
_SHORTEST_STEP = 2e-5  # [m], after which there is no other
_FEWEST = 20  # fewer points of a kind tell less than all of them would
_EDGE_REACH = 0.004  # [m], the least way to look for the end of the object
# To be sure, a direction must be told so much more than errors of the mesh would feign. Three points of an outline tell
# 6.7 by default, and a few flying pixels at the edge of what hides the object look like its own end.
_SURE = 7.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """A mesh as it agrees with one image.

    Attributes:
        T_camera_object: pose (4, 4).
        information: (6, 6) inverse covariance of x, y, z [m] and rotation [rad], camera axes, about the origin;
            of the determined directions alone.
        determined: how many of the six directions the image tells by more than a few stray points.
        fitness: points where they should be, as a share of those that nothing hides, 0 to 1.
        visible: points where they should be, as a share of those in view, 0 to 1.
        seen: points where they should be.
        outlined: points of the outline where the object is seen to end, as a share of all, 0 to 1.
        stddev: of the depths about the mesh [m].
    """

    T_camera_object: NDArray
    information: NDArray
    determined: int
    fitness: float
    visible: float
    seen: int
    outlined: float
    stddev: float


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How hard to try.

    Attributes:
        gates: surface farther off than this [m] is not the object, one after the other; each looks afresh.
        steps: most Gauss-Newton steps for each gate.
        points: pixels of the object that are compared.
        outline: compare its outline, too.
    """

    gates: tuple[float, ...]
    steps: int
    points: int
    outline: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class _Normal:
    """Normal equations about the object's middle: information (6, 6) and gradient (6,), lengths at the rim.

    `told` (6, 6) is what each kind of evidence tells, over what errors of the mesh would make it seem to tell. In
    `counted` (6, 6), points of the outline count the same however many others there are.
    """

    information: NDArray
    gradient: NDArray
    told: NDArray
    counted: NDArray
    stddev: float
    sights: NDArray
    outlined: float = 0.0

    def plus(self, other: "_Normal") -> "_Normal":
        """Returns both together, the other being that of the outline."""
        return replace(
            self,
            outlined=float((other.sights == Visibility.SEEN).mean()) if len(other.sights) else 0.0,
            information=self.information + other.information,
            gradient=self.gradient + other.gradient,
            told=self.told + other.told,
            counted=self.told + other.counted,
        )

    def directions(self) -> NDArray:
        """Returns an orthonormal basis (6, k) of the directions that the image tells."""
        values, vectors = np.linalg.eigh(self.told)
        return vectors[:, values > 1.0]

    def sure_directions(self) -> NDArray:
        """Returns an orthonormal basis (6, k) of those of them that more than a few points tell."""
        basis = self.directions()
        values, vectors = np.linalg.eigh(basis.T @ self.counted @ basis)
        return basis @ vectors[:, values > _SURE]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Expected:
    """What should be seen, object frame; `step` as of `Glance`."""

    surface: Samples
    outline: Outline | None
    step: int


@dataclass(frozen=True, kw_only=True, eq=False)
class _About:
    """What normal equations are about: middle (3,) and radius of the object [m], deviation of the residuals [m]."""

    middle: NDArray
    radius: float
    stddev: float


class MeshAligner:
    """A mesh prepared for being aligned to images of one camera."""

    def __init__(self, mesh: ObjectMesh, camera: CameraIntrinsics, settings: TrackerSettings) -> None:
        """Prepares rays and edges.

        Raises:
            MissingDependencyError: Open3D is not installed.
        """
        self.camera, self.settings = camera, settings
        low, high = mesh.bounds
        self.middle, self.radius = mesh.middle, 0.5 * float(np.linalg.norm(high - low))
        self._view, self._outline = MeshView(mesh), MeshOutline(mesh)

    def middle_of(self, T_camera_object: NDArray) -> NDArray:
        """Returns the middle of the object's bounding box (3,) [m] in the camera frame, for a pose (4, 4)."""
        return T_camera_object[:3, :3] @ self.middle + T_camera_object[:3, 3]

    def glance(self, T_camera_object: NDArray, points: int) -> Glance:
        """Returns what should be seen of the object in a pose (4, 4), in about so many points."""
        distance = max(float(self.middle_of(T_camera_object)[2]), 0.02)
        # from the side, a box fills about a third of the disc around its bounding sphere
        area = (self.radius * self.camera.fx / distance) ** 2
        step = int(np.clip(np.sqrt(area / points), 1, 64))
        view = self._view.render(T_camera_object, self.camera, step)
        cosine = -np.einsum("ij,ij->i", view.normals, view.points) / np.linalg.norm(view.points, axis=1)
        kept = cosine > _GRAZING
        return Glance(
            depth=view.depth, surface=Samples(points=view.points[kept], directions=view.normals[kept]), step=step
        )

    def align(self, T_camera_object: NDArray, image: DepthImage, effort: Effort) -> Alignment:
        """Returns the mesh aligned to an image.

        Args:
            T_camera_object: pose (4, 4) to start from; directions that the image does not tell keep it.
            image: the image.
            effort: how hard to try.
        """
        T = T_camera_object
        for gate in effort.gates:
            expected = self._expect(T, effort)
            for _ in range(effort.steps):
                step = self._step(self._build(T, expected, image, gate))
                T = self._move(T, step)
                if np.abs(step).max() < _SHORTEST_STEP:
                    break
        return self._judge(T, image, effort)

    def _expect(self, T: NDArray, effort: Effort) -> _Expected:
        """Returns what should be seen in a pose (4, 4), in the object's frame."""
        glance, back = self.glance(T, effort.points), invert_pose(T)
        outline = None
        if effort.outline:
            outline = self._outline.find(T, glance, self.camera, _EDGE_POINTS).moved(back)
        return _Expected(surface=glance.surface.moved(back), outline=outline, step=glance.step)

    def _build(self, T: NDArray, expected: _Expected, image: DepthImage, gate: float) -> _Normal:
        middle = self.middle_of(T)
        surface = expected.surface.moved(T)
        depths = image.compare_surface(surface, gate)
        about = _About(middle=middle, radius=self.radius, stddev=_spread(depths, self.settings.noise))
        normal = _normal_equations(surface, depths, about, _NORMAL_ERROR)
        if expected.outline is None:
            return normal
        outline = expected.outline.moved(T)
        edges = compare_outline(outline, image, max(gate, _EDGE_REACH))
        edge_noise = max(_EDGE_NOISE * middle[2] / self.camera.fx, about.stddev)
        about = replace(about, stddev=_spread(edges, edge_noise))
        return normal.plus(_normal_equations(outline.samples, edges, about, _EDGE_ERROR))

    def _step(self, normal: _Normal) -> NDArray:
        """Returns the step (6,) in the directions that the image tells."""
        basis = normal.directions()
        step = basis @ np.linalg.solve(basis.T @ normal.information @ basis, basis.T @ normal.gradient)
        return step * min(1.0, _LONGEST_STEP / max(np.abs(step).max(), 1e-12))

    def _move(self, T: NDArray, step: NDArray) -> NDArray:
        middle = self.middle_of(T)
        moved = T.copy()
        moved[:3, :3] = Rotation.from_rotvec(step[3:] / self.radius).as_matrix() @ T[:3, :3]
        moved[:3, 3] = middle + step[:3] - moved[:3, :3] @ self.middle
        return moved

    def _judge(self, T: NDArray, image: DepthImage, effort: Effort) -> Alignment:
        expected = self._expect(T, effort)
        normal = self._build(T, expected, image, effort.gates[-1])
        counts = np.bincount(normal.sights, minlength=len(Visibility))
        basis = normal.sure_directions()
        # neighbouring depths err alike: so many pixels count as one
        alike = max(1.0, _NOISE_WIDTH / expected.step) ** 2
        known = basis.T @ self._to_middle(T)
        return Alignment(
            T_camera_object=T,
            information=known.T @ (basis.T @ normal.information @ basis) @ known / alike,
            determined=basis.shape[1],
            fitness=float(counts[Visibility.SEEN] / max(counts[Visibility.SEEN] + counts[Visibility.ABSENT], 1)),
            visible=float(counts[Visibility.SEEN] / max(counts.sum(), 1)),
            seen=int(counts[Visibility.SEEN]),
            outlined=normal.outlined,
            stddev=normal.stddev,
        )

    def _to_middle(self, T: NDArray) -> NDArray:
        """Returns what turns a step (6,) about the object's origin [m, rad] into one about its middle [m, m at rim]."""
        x, y, z = T[:3, :3] @ self.middle
        change = np.eye(6)
        change[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        change[3:, 3:] *= self.radius
        return change


def _spread(comparison: Comparison, least: float) -> float:
    known = comparison.residuals[comparison.sights == Visibility.SEEN]
    return max(_MAD * float(np.median(np.abs(known))), least) if len(known) else least


def _normal_equations(samples: Samples, seen: Comparison, about: _About, error: float) -> _Normal:
    """Returns sum w J^T J and sum w J^T r with J = [d, (p - m) x d / radius] and Cauchy weights w over stddev^2.

    Directions d that are off by an angle `error` make a motion along the surface look like one across it, this much
    smaller: what is told must be more than error^2 sum w.
    """
    chosen = seen.sights == Visibility.SEEN
    directions, residuals = samples.directions[chosen], seen.residuals[chosen]
    J = np.hstack([directions, np.cross(samples.points[chosen] - about.middle, directions) / about.radius])
    weights = 1.0 / (1.0 + (residuals / (_CAUCHY * about.stddev)) ** 2) / about.stddev**2
    weighted = J * weights[:, None]
    information = J.T @ weighted
    fewest = _FEWEST / about.stddev**2
    return _Normal(
        information=information,
        gradient=weighted.T @ residuals,
        told=information / (error**2 * max(float(weights.sum()), fewest)),
        counted=information / (error**2 * fewest),
        stddev=about.stddev,
        sights=seen.sights,
    )
