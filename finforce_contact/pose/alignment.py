"""Agreement of a mesh with one depth image: its surface and its outline, by Gauss-Newton steps."""

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, check_depth, check_mask, project, rays_from_pixels
from finforce.transforms import invert_pose, move_pose
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.parameters import TrackerSettings

# With fewer pixels of the object, any pose agrees with any image.
LEAST_PIXELS = 30


class Visibility(IntEnum):
    """The evidence of the image for one point of the surface."""

    UNKNOWN = 0  # no depth there, or outside the image
    SEEN = 1  # where it should be
    HIDDEN = 2  # something is in front of it
    ABSENT = 3  # what is seen there lies behind it, or is not the object by the mask


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Points of a surface or an outline, each measured along one direction.

    Attributes:
        points: (n, 3) [m].
        directions: (n, 3) unit vectors: the surface's normal, or the normal of the outline across the view.
    """

    points: NDArray
    directions: NDArray

    def moved(self, T: NDArray) -> "Samples":
        """Return the same samples in the frame a of a pose T_a_b (4, 4), these being in b."""
        return Samples(points=self.points @ T[:3, :3].T + T[:3, 3], directions=self.directions @ T[:3, :3].T)


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedView:
    """The predicted view of an object in one pose, on the grid of every `step`-th pixel.

    Attributes:
        depth: grid of depths (h, w) [m], NaN beside the object.
        surface: visible part of the surface, camera frame.
        step: pixels from one to the next.
    """

    depth: NDArray
    surface: Samples
    step: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Samples against an image.

    Attributes:
        residuals: (n,) way along its direction from a sample to what was measured [m], NaN where nothing was.
        visibility: (n,) of type `Visibility`.
    """

    residuals: NDArray
    visibility: NDArray

    def count(self, kind: Visibility) -> int:
        """Return the number of samples of a kind."""
        return int(np.count_nonzero(self.visibility == kind))


class DepthImage:
    """A checked depth image, with the mask of the object where there is one.

    Attributes:
        depth: (h, w) [m], NaN where nothing was measured.
        mask: (h, w) bool, or None.
        camera: its intrinsics.
    """

    def __init__(self, depth: NDArray, camera: CameraIntrinsics, mask: NDArray | None = None) -> None:
        """Take an image.

        Raises:
            ImageError: The image has another size than the camera, no depth at all, or a mask with next to none.
        """
        check_depth(depth, camera)
        # a zero is how many drivers write "nothing measured"
        self.depth = np.where(np.asarray(depth) > 0.0, depth, np.nan)
        if mask is not None:
            check_mask(mask, self.depth, least=LEAST_PIXELS)
            mask = np.asarray(mask, bool)
        self.mask, self.camera = mask, camera

    def ray(self, pixel: NDArray) -> NDArray:
        """Return the viewing ray (3,) with z = 1 of one pixel (2,), which may lie outside the image."""
        return rays_from_pixels(pixel[None], self.camera)[0]

    def look(self, pixels: NDArray) -> NDArray:
        """Return the depths (...,) [m] at pixels (..., 2), NaN where there is none or outside the image."""
        nearest, inside = self._nearest(pixels)
        return np.where(inside, self.depth[nearest], np.nan)

    def is_masked_out(self, pixels: NDArray) -> NDArray:
        """Return where (...,) the mask says that pixels (..., 2) are not the object; nowhere without a mask."""
        if self.mask is None:
            return np.zeros(pixels.shape[:-1], bool)
        nearest, inside = self._nearest(pixels)
        return inside & ~self.mask[nearest]

    def compare_surface(self, surface: Samples, gate: float) -> Comparison:
        """Compare points of a surface with the depths at their pixels.

        residual = n . (q - p) for a point p with normal n and the point q measured on the ray next to p. The point
        counts as seen where |residual| is below the gate, and the depth itself no farther off than twice the gate:
        a plate in front of a surface that is seen from the side is near its plane, too.

        Args:
            surface: samples in the camera frame.
            gate: [m].
        """
        pixels = project(surface.points, self.camera)
        nearest, inside = self._nearest(pixels)
        depth = np.where(inside, self.depth[nearest], np.nan)
        rows, columns = nearest
        measured = rays_from_pixels(np.column_stack((columns, rows)), self.camera) * depth[:, None]
        residuals = np.einsum("ij,ij->i", surface.directions, measured - surface.points)
        foreign = self.is_masked_out(pixels)
        visibility = np.where(depth < surface.points[:, 2], Visibility.HIDDEN, Visibility.ABSENT)
        visibility[np.isnan(depth) & ~foreign] = Visibility.UNKNOWN
        near = (np.abs(residuals) < gate) & (np.abs(depth - surface.points[:, 2]) < 2.0 * gate)
        visibility[near & ~foreign] = Visibility.SEEN
        return Comparison(residuals=np.where(visibility == Visibility.SEEN, residuals, np.nan), visibility=visibility)

    def _nearest(self, pixels: NDArray) -> tuple[tuple[NDArray, NDArray], NDArray]:
        """Return row and column (...,) of the nearest pixels, and which are inside the image."""
        known = np.isfinite(pixels).all(axis=-1)
        whole = np.rint(np.where(known[..., None], pixels, -1.0)).astype(np.intp)
        column, row = whole[..., 0], whole[..., 1]
        inside = (column >= 0) & (column < self.camera.width) & (row >= 0) & (row < self.camera.height)
        return (np.where(inside, row, 0), np.where(inside, column, 0)), inside


# Behind the outline the image must fall back by this [m] to be told from the object's own shape and from noise.
_STEP_BACK = 0.006
# No object that a gripper holds comes nearer than this [m] within a few pixels of its outline: an edge is hidden there.
_DEEPEST = 0.03
# Edges that turn by more than this [rad] are sharp: their outline runs along them, and not along the mean surface.
_SHARP = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Outline:
    """Points where the object ends in the view.

    Attributes:
        samples: the points, with their outward normals across the view.
        bulges: (n,) how far in front of each point the object is a few pixels within the outline [m].
    """

    samples: Samples
    bulges: NDArray

    def moved(self, T: NDArray) -> "Outline":
        """Return the same points in the frame a of a pose T_a_b (4, 4), these being in b."""
        return replace(self, samples=self.samples.moved(T))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Edges:
    """Points along the convex edges of a mesh, object frame: points, tangents, normals of the two faces (n, 3)."""

    points: NDArray
    tangents: NDArray
    first: NDArray
    second: NDArray


class _MeshOutline:
    """The edges of a mesh, prepared for finding the outline from any side."""

    def __init__(self, mesh: ObjectMesh, samples: int = 60) -> None:
        """Put points along the edges, no farther apart than the mesh's size divided by `samples`."""
        self._edges = _place_points(mesh, np.ptp(mesh.vertices, axis=0).max() / samples)

    def find(self, T_camera_object: NDArray, view: RenderedView, camera: CameraIntrinsics, most: int) -> Outline:
        """Return at most `most` points of the outline behind which the object ends, with their outward normals.

        A point of an edge is on the outline where one of its faces looks at the camera and the other away. Its
        direction is perpendicular to the ray, and to the edge where that is sharp.

        Args:
            T_camera_object: pose (4, 4) of the view.
            view: the visible part of the mesh there, which tells hidden edges.
            camera: of the view.
            most: points that are kept.

        Returns:
            The outline in the camera frame.
        """
        edges, camera_place = self._edges, invert_pose(T_camera_object)[:3, 3]
        rays = edges.points - camera_place
        sides = np.einsum("ij,ij->i", edges.first, rays) * np.einsum("ij,ij->i", edges.second, rays)
        chosen = np.flatnonzero(sides <= 0.0)
        outline = Samples(
            points=edges.points[chosen],
            directions=_across(rays[chosen], edges.tangents[chosen], edges.first[chosen], edges.second[chosen]),
        ).moved(T_camera_object)
        bulges = _find_bulges(outline, view, camera)
        kept = np.flatnonzero(np.isfinite(bulges))
        kept = kept[:: max(1, -(-len(kept) // most))]
        samples = Samples(points=outline.points[kept], directions=outline.directions[kept])
        return Outline(samples=samples, bulges=bulges[kept])


def compare_outline(outline: Outline, image: DepthImage, reach: float) -> Comparison:
    """Find the end of the object in a depth image across points of its outline.

    From inside to outside, the pixels near a point are object up to the split that most of them agree with, and behind
    the object after it. Points beside which something else is in front, or whose split is not clear, are unknown.

    Args:
        outline: in the camera frame, as of `_MeshOutline.find`.
        image: where to look.
        reach: range of the search to either side [m].
    """
    places, along = _walk_across(outline.samples, image.camera, reach)
    depth, edge_depth = image.look(places), outline.samples.points[:, 2:3]
    nearest = edge_depth - outline.bulges[:, None] - _STEP_BACK
    foreign = image.is_masked_out(places)
    behind = (depth > edge_depth + _STEP_BACK) | (foreign & ~(depth < edge_depth))
    votes = np.where(behind, -1, np.where(np.isnan(depth), 0, 1))
    votes[(depth < nearest) | (foreign & (depth < edge_depth))] = 0
    split, agreement = _best_split(votes)
    rows = np.arange(len(split))
    before, after = along[rows, split - 1], along[rows, split]
    clear = (agreement > 0.7 * votes.shape[1]) & (after - before < 3.1 * (along[:, -1] - along[:, 0]) / along.shape[1])
    clear &= (votes[rows, split - 1] == 1) & (votes[rows, split] == -1)
    residuals = np.where(clear, 0.5 * (before + after), np.nan)
    return Comparison(residuals=residuals, visibility=np.where(clear, Visibility.SEEN, Visibility.UNKNOWN))


def _walk_across(outline: Samples, camera: CameraIntrinsics, reach: float) -> tuple[NDArray, NDArray]:
    """Return whole pixels (n, k, 2) across the outline, and how far out they lie (n, k) [m]."""
    start = project(outline.points, camera)
    metres = outline.points[:, 2] / (0.5 * (camera.fx + camera.fy))
    across = project(outline.points + outline.directions * metres[:, None], camera) - start
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    count = max(4, int(np.ceil(reach / np.median(metres)))) if len(metres) else 4
    places = np.rint(start[:, None] + across[:, None] * np.arange(-count, count + 1)[:, None])
    along = np.einsum("nki,ni->nk", places - start[:, None], across) * metres[:, None]
    return places, along


def _best_split(votes: NDArray) -> tuple[NDArray, NDArray]:
    """Return where the outside begins in votes (n, k) of +1 inside and -1 outside, and how many agree with it."""
    inside = np.cumsum(votes, axis=1)
    agreement = 2 * inside[:, :-1] - inside[:, -1:]
    split = agreement.argmax(axis=1)
    return split + 1, agreement[np.arange(len(split)), split]


def _find_bulges(outline: Samples, view: RenderedView, camera: CameraIntrinsics) -> NDArray:
    """Return the bulges (n,) [m] of points of an outline, NaN where the mesh does not end behind them."""
    pixels = project(outline.points, camera)
    metres = view.step * outline.points[:, 2] / camera.fx
    outward = project(outline.points + outline.directions * metres[:, None], camera) - pixels
    depth = outline.points[:, 2]
    outer = _look(view, pixels + 1.5 * outward)
    inner = np.array([depth - _look(view, pixels - steps * outward) for steps in (1.5, 3.0)])
    bulges = np.maximum(inner[0], np.nan_to_num(inner[1], nan=0.0))
    ends = (np.abs(bulges) < _DEEPEST) & ~(outer < depth + _STEP_BACK)
    return np.where(ends, np.maximum(bulges, 0.0), np.nan)


def _look(view: RenderedView, pixels: NDArray) -> NDArray:
    """Return the depths (n,) of a view next to pixels (n, 2), NaN outside."""
    height, width = view.depth.shape
    whole = np.rint(np.nan_to_num(pixels, nan=-1e6) / view.step).astype(np.intp)
    inside = ((whole >= 0) & (whole < (width, height))).all(axis=1)
    whole[~inside] = 0
    return np.where(inside, view.depth[whole[:, 1], whole[:, 0]], np.nan)


def _across(rays: NDArray, tangents: NDArray, first: NDArray, second: NDArray) -> NDArray:
    """Return the outward unit normals (n, 3) of outline points, perpendicular to their rays."""
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    mean = first + second
    smooth = mean - np.einsum("ij,ij->i", mean, rays)[:, None] * rays
    sharp = np.cross(rays, tangents)
    sharp *= np.sign(np.einsum("ij,ij->i", sharp, mean))[:, None]
    is_sharp = np.einsum("ij,ij->i", first, second) < np.cos(_SHARP)
    across = np.where(is_sharp[:, None], sharp, smooth)
    return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)


def _place_points(mesh: ObjectMesh, spacing: float) -> _Edges:
    normals = mesh.normals
    one, other = (mesh.edges.pairs // 3).T
    begin, end = mesh.vertices[mesh.edges.ends[mesh.edges.uses == 2].T]
    # seen from one face, the middle of the other one lies below an edge that can be an outline
    dip = np.einsum("ij,ij->i", normals[one], mesh.vertices[mesh.triangles[other]].mean(axis=1) - begin)
    convex = dip < -1e-6 * spacing
    one, other, begin, end = one[convex], other[convex], begin[convex], end[convex]
    lengths = np.linalg.norm(end - begin, axis=1)
    counts = np.maximum(1, np.ceil(lengths / spacing)).astype(int)
    which = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[which]
    tangents = (end - begin) / np.maximum(lengths, 1e-30)[:, None]
    return _Edges(
        points=begin[which] + share[:, None] * (end - begin)[which],
        tangents=tangents[which],
        first=normals[one[which]],
        second=normals[other[which]],
    )


_EDGE_POINTS = 200  # of the outline that are compared per image
_NOISE_WIDTH = 5.0  # [px] over which the errors of the depth are alike
# A motion along the surface up to these errors is not seen.
_NORMAL_ERROR = 0.035  # [rad], of the normals of the mesh
_EDGE_ERROR = 0.15  # [rad], of the normals of its outline
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
        fitness: points where they should be, as a share of those that nothing hides, 0 to 1.
        visible: points where they should be, as a share of those in view, 0 to 1.
        seen: points where they should be.
        outlined: points of the outline where the object is seen to end, as a share of all, 0 to 1.
        stddev: of the depths about the mesh [m].
    """

    T_camera_object: NDArray
    information: NDArray
    fitness: float
    visible: float
    seen: int
    outlined: float
    stddev: float


@dataclass(frozen=True, kw_only=True)
class Effort:
    """The effort of an alignment.

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
    visibility: NDArray
    outlined: float = 0.0

    def plus(self, other: "_Normal") -> "_Normal":
        """Return both together, the other being that of the outline."""
        return replace(
            self,
            outlined=float((other.visibility == Visibility.SEEN).mean()) if len(other.visibility) else 0.0,
            information=self.information + other.information,
            gradient=self.gradient + other.gradient,
            told=self.told + other.told,
            counted=self.told + other.counted,
        )

    def directions(self) -> NDArray:
        """Return an orthonormal basis (6, k) of the directions that the image tells."""
        values, vectors = np.linalg.eigh(self.told)
        return vectors[:, values > 1.0]

    def sure_directions(self) -> NDArray:
        """Return an orthonormal basis (6, k) of those of them that more than a few points tell."""
        basis = self.directions()
        values, vectors = np.linalg.eigh(basis.T @ self.counted @ basis)
        return basis @ vectors[:, values > _SURE]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Expected:
    """The predicted view in the object frame; `step` as of `RenderedView`."""

    surface: Samples
    outline: Outline | None
    step: int


@dataclass(frozen=True, kw_only=True, eq=False)
class _About:
    """The scale of normal equations: middle (3,) and radius of the object [m], deviation of the residuals [m]."""

    middle: NDArray
    radius: float
    stddev: float


class MeshAligner:
    """A mesh prepared for being aligned to images of one camera."""

    def __init__(self, mesh: ObjectMesh, camera: CameraIntrinsics, settings: TrackerSettings) -> None:
        """Prepare rays and edges.

        Raises:
            MissingDependencyError: Open3D is not installed.
        """
        self.camera, self.settings = camera, settings
        low, high = mesh.bounds
        self.middle, self.radius = mesh.middle, 0.5 * float(np.linalg.norm(high - low))
        self._view, self._outline = MeshView(mesh), _MeshOutline(mesh)

    def middle_of(self, T_camera_object: NDArray) -> NDArray:
        """Return the middle of the object's bounding box (3,) [m] in the camera frame, for a pose (4, 4)."""
        return T_camera_object[:3, :3] @ self.middle + T_camera_object[:3, 3]

    def render_view(self, T_camera_object: NDArray, points: int) -> RenderedView:
        """Return what should be seen of the object in a pose (4, 4), in about so many points."""
        distance = max(float(self.middle_of(T_camera_object)[2]), 0.02)
        # from the side, a box fills about a third of the disc around its bounding sphere
        area = (self.radius * self.camera.fx / distance) ** 2
        step = int(np.clip(np.sqrt(area / points), 1, 64))
        view = self._view.render(T_camera_object, self.camera, step)
        cosine = -np.einsum("ij,ij->i", view.normals, view.points) / np.linalg.norm(view.points, axis=1)
        kept = cosine > _GRAZING
        return RenderedView(
            depth=view.depth, surface=Samples(points=view.points[kept], directions=view.normals[kept]), step=step
        )

    def align(self, T_camera_object: NDArray, image: DepthImage, effort: Effort) -> Alignment:
        """Return the mesh aligned to an image.

        Args:
            T_camera_object: pose (4, 4) to start from; directions that the image does not tell keep it.
            image: the image.
            effort: iterations and starts.
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
        """Return what should be seen in a pose (4, 4), in the object's frame."""
        view, back = self.render_view(T, effort.points), invert_pose(T)
        outline = None
        if effort.outline:
            outline = self._outline.find(T, view, self.camera, _EDGE_POINTS).moved(back)
        return _Expected(surface=view.surface.moved(back), outline=outline, step=view.step)

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
        """Return the step (6,) in the directions that the image tells."""
        basis = normal.directions()
        step = basis @ np.linalg.solve(basis.T @ normal.information @ basis, basis.T @ normal.gradient)
        return step * min(1.0, _LONGEST_STEP / max(np.abs(step).max(), 1e-12))

    def _move(self, T: NDArray, step: NDArray) -> NDArray:
        middle = self.middle_of(T)
        moved = move_pose(T, np.r_[step[:3], step[3:] / self.radius])
        moved[:3, 3] = middle + step[:3] - moved[:3, :3] @ self.middle
        return moved

    def _judge(self, T: NDArray, image: DepthImage, effort: Effort) -> Alignment:
        expected = self._expect(T, effort)
        normal = self._build(T, expected, image, effort.gates[-1])
        counts = np.bincount(normal.visibility, minlength=len(Visibility))
        basis = normal.sure_directions()
        # neighbouring depths err alike: so many pixels count as one
        alike = max(1.0, _NOISE_WIDTH / expected.step) ** 2
        known = basis.T @ self._to_middle(T)
        return Alignment(
            T_camera_object=T,
            information=known.T @ (basis.T @ normal.information @ basis) @ known / alike,
            fitness=float(counts[Visibility.SEEN] / max(counts[Visibility.SEEN] + counts[Visibility.ABSENT], 1)),
            visible=float(counts[Visibility.SEEN] / max(counts.sum(), 1)),
            seen=int(counts[Visibility.SEEN]),
            outlined=normal.outlined,
            stddev=normal.stddev,
        )

    def _to_middle(self, T: NDArray) -> NDArray:
        """Return what turns a step (6,) about the object's origin [m, rad] into one about its middle [m, m at rim]."""
        x, y, z = T[:3, :3] @ self.middle
        change = np.eye(6)
        change[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        change[3:, 3:] *= self.radius
        return change


def _spread(comparison: Comparison, least: float) -> float:
    known = comparison.residuals[comparison.visibility == Visibility.SEEN]
    return max(_MAD * float(np.median(np.abs(known))), least) if len(known) else least


def _normal_equations(samples: Samples, seen: Comparison, about: _About, error: float) -> _Normal:
    """Return sum w J^T J and sum w J^T r with J = [d, (p - m) x d / radius] and Cauchy weights w over stddev^2.

    Directions d that are off by an angle `error` make a motion along the surface look like one across it, this much
    smaller: the information must exceed error^2 sum w.
    """
    chosen = seen.visibility == Visibility.SEEN
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
        visibility=seen.visibility,
    )
