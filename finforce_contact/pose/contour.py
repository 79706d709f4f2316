"""The outline of a mesh as a camera sees it, and where a depth image has it."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project
from finforce.transforms import invert_pose
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.pose.depth_image import Comparison, DepthImage, Glance, Samples, Visibility

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
        """Returns the same points in the frame a of a pose T_a_b (4, 4), these being in b."""
        return replace(self, samples=self.samples.moved(T))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Edges:
    """Points along the convex edges of a mesh, object frame: points, tangents, normals of the two faces (n, 3)."""

    points: NDArray
    tangents: NDArray
    first: NDArray
    second: NDArray


class MeshOutline:
    """The edges of a mesh, prepared for finding the outline from any side."""

    def __init__(self, mesh: ObjectMesh, samples: int = 60) -> None:
        """Puts points along the edges, no farther apart than the mesh's size divided by `samples`."""
        self._edges = _place_points(mesh, np.ptp(mesh.vertices, axis=0).max() / samples)

    def find(self, T_camera_object: NDArray, glance: Glance, camera: CameraIntrinsics, most: int) -> Outline:
        """Returns at most `most` points of the outline behind which the object ends, with their outward normals.

        A point of an edge is on the outline where one of its faces looks at the camera and the other away. Its
        direction is perpendicular to the ray, and to the edge where that is sharp.

        Args:
            T_camera_object: pose (4, 4) of the glance.
            glance: the visible part of the mesh there, which tells hidden edges.
            camera: of the glance.
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
        bulges = _find_bulges(outline, glance, camera)
        kept = np.flatnonzero(np.isfinite(bulges))
        kept = kept[:: max(1, -(-len(kept) // most))]
        samples = Samples(points=outline.points[kept], directions=outline.directions[kept])
        return Outline(samples=samples, bulges=bulges[kept])


def compare_outline(outline: Outline, image: DepthImage, reach: float) -> Comparison:
    """Finds the end of the object in a depth image across points of its outline.

    From inside to outside, the pixels near a point are object up to the split that most of them agree with, and behind
    the object after it. Points beside which something else is in front, or whose split is not clear, are unknown.

    Args:
        outline: in the camera frame, as of `MeshOutline.find`.
        image: where to look.
        reach: how far to look to either side [m].
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
    return Comparison(residuals=residuals, sights=np.where(clear, Visibility.SEEN, Visibility.UNKNOWN))


def _walk_across(outline: Samples, camera: CameraIntrinsics, reach: float) -> tuple[NDArray, NDArray]:
    """Returns whole pixels (n, k, 2) across the outline, and how far out they lie (n, k) [m]."""
    start = project(outline.points, camera)
    metres = outline.points[:, 2] / (0.5 * (camera.fx + camera.fy))
    across = project(outline.points + outline.directions * metres[:, None], camera) - start
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    count = max(4, int(np.ceil(reach / np.median(metres)))) if len(metres) else 4
    places = np.rint(start[:, None] + across[:, None] * np.arange(-count, count + 1)[:, None])
    along = np.einsum("nki,ni->nk", places - start[:, None], across) * metres[:, None]
    return places, along


def _best_split(votes: NDArray) -> tuple[NDArray, NDArray]:
    """Returns where the outside begins in votes (n, k) of +1 inside and -1 outside, and how many agree with it."""
    inside = np.cumsum(votes, axis=1)
    agreement = 2 * inside[:, :-1] - inside[:, -1:]
    split = agreement.argmax(axis=1)
    return split + 1, agreement[np.arange(len(split)), split]


def _find_bulges(outline: Samples, glance: Glance, camera: CameraIntrinsics) -> NDArray:
    """Returns the bulges (n,) [m] of points of an outline, NaN where the mesh does not end behind them."""
    pixels = project(outline.points, camera)
    metres = glance.step * outline.points[:, 2] / camera.fx
    outward = project(outline.points + outline.directions * metres[:, None], camera) - pixels
    depth = outline.points[:, 2]
    outer = _look(glance, pixels + 1.5 * outward)
    inner = np.array([depth - _look(glance, pixels - steps * outward) for steps in (1.5, 3.0)])
    bulges = np.maximum(inner[0], np.nan_to_num(inner[1], nan=0.0))
    ends = (np.abs(bulges) < _DEEPEST) & ~(outer < depth + _STEP_BACK)
    return np.where(ends, np.maximum(bulges, 0.0), np.nan)


def _look(glance: Glance, pixels: NDArray) -> NDArray:
    """Returns the depths (n,) of a glance next to pixels (n, 2), NaN outside."""
    height, width = glance.depth.shape
    whole = np.rint(np.nan_to_num(pixels, nan=-1e6) / glance.step).astype(np.intp)
    inside = ((whole >= 0) & (whole < (width, height))).all(axis=1)
    whole[~inside] = 0
    return np.where(inside, glance.depth[whole[:, 1], whole[:, 0]], np.nan)


def _across(rays: NDArray, tangents: NDArray, first: NDArray, second: NDArray) -> NDArray:
    """Returns the outward unit normals (n, 3) of outline points, perpendicular to their rays."""
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    mean = first + second
    smooth = mean - np.einsum("ij,ij->i", mean, rays)[:, None] * rays
    sharp = np.cross(rays, tangents)
    sharp *= np.sign(np.einsum("ij,ij->i", sharp, mean))[:, None]
    is_sharp = np.einsum("ij,ij->i", first, second) < np.cos(_SHARP)
    across = np.where(is_sharp[:, None], sharp, smooth)
    return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)


def _place_points(mesh: ObjectMesh, spacing: float) -> _Edges:
    table = mesh.edges
    corners = mesh.vertices[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    flat = table.of_triangles.ravel()
    paired = np.flatnonzero(np.bincount(flat, minlength=len(table.ends)) == 2)
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], paired)
    one, other = order[starts] // 3, order[starts + 1] // 3
    begin, end = mesh.vertices[table.ends[paired, 0]], mesh.vertices[table.ends[paired, 1]]
    # seen from one face, the middle of the other one lies below an edge that can be an outline
    dip = np.einsum("ij,ij->i", normals[one], corners[other].mean(axis=1) - begin)
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
