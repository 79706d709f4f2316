"""The contact patch: where the object's outline overlaps the deformed inner face, as a few weighted rows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce_contact.localization.section import ObjectSection, compute_gaps, distances_to
from finforce_ifea.errors import MeshError
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.mesh import VolumeMesh

_SPACING = 0.5e-3
# No jaw bends by more than this share of its length.
_MOST_BENT = 0.6
# Where along the width the line is averaged, as shares of the half width.
_LATERAL = np.array([-0.8, 0.0, 0.8])
# Least share of a triangle of the face that stands across x.
_LEAST_FACING = 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class InnerFace:
    """A line along the inner surface, averaged over the width.

    Attributes:
        mesh: of the jaw, undeformed.
        heights: (h,) [m] on the undeformed surface, rising.
        x: (h,) [m], of the undeformed surface.
        half_width: [m], along y.
        nodes: (h, m) mesh nodes that carry each height.
        weights: (h, m) of these nodes [-], rows sum to one.
    """

    mesh: VolumeMesh
    heights: NDArray
    x: NDArray
    half_width: float
    nodes: NDArray
    weights: NDArray

    def check_surface(self, surface: NDArray) -> NDArray:
        """Return a deformed surface (n, 3) [m] as floats after having refused what does not belong to the mesh.

        Raises:
            MeshError: Another number of vertices than the mesh has, coordinates that are not finite, or vertices
                farther from their places at rest than a jaw can bend.
        """
        surface = np.ascontiguousarray(surface, dtype=float)
        if surface.shape != self.mesh.nodes.shape:
            raise MeshError(
                f"a deformed surface of shape {surface.shape}, expected {self.mesh.nodes.shape}, the jaw's mesh; "
                "give both sides the same jaw file, calibration and mesh setting (coarse, default or fine)"
            )
        moved, most = np.abs(surface - self.mesh.nodes).max(), self._most_bent
        if not moved <= most:  # neither is what is not a number
            if not np.isfinite(surface).all():
                raise MeshError("a deformed surface with vertices that are not finite; drop it at its source")
            raise MeshError(
                f"a deformed surface with a vertex {1e3 * moved:.3g} mm from its place at rest, expected "
                f"{1e3 * most:.0f} mm at most; is it in metres, in the frame of the jaw and in the order of the mesh?"
            )
        return surface

    @cached_property
    def _most_bent(self) -> float:
        """How far a vertex may be from its place at rest [m]."""
        return _MOST_BENT * float(np.ptp(self.mesh.nodes, axis=0).max())

    @cached_property
    def front(self) -> float:
        """Where the undeformed surface stands out most, x [m]."""
        return float(self.x.max())

    def deform(self, surface: NDArray) -> NDArray:
        """Return x and z (h, 2) [m] of the line on a deformed surface (n, 3) [m] in mesh order."""
        return _average(surface, self.nodes, self.weights)


def build_inner_face(jaw: Jaw, density: str) -> InnerFace:
    """Build the line every half millimetre along the inner surface of a jaw's mesh.

    Args:
        jaw: the jaw, with its calibration applied if the solver has one.
        density: "coarse", "default" or "fine"; a jaw with a mesh file of its own knows "default" alone.

    Raises:
        MeshError: The mesh has no triangles on the plane of the inner face.
    """
    mesh = jaw.build_mesh(density)
    on_face = jaw.face.holds(mesh.nodes)
    triangles = mesh.surface[on_face[mesh.surface].all(axis=1)]
    corners = mesh.nodes[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # a broken edge of the face is within its tolerance, too, and may stand square to it
    triangles = triangles[np.abs(normals[:, 0]) > _LEAST_FACING * np.linalg.norm(normals, axis=1)]
    if not len(triangles):
        raise MeshError(f"the mesh has no triangles on the inner face x = {jaw.inner_face_x:g} m; check inner_face_x")
    places = mesh.nodes[np.unique(triangles)][:, 1:]
    (low_y, low), (high_y, high) = places.min(axis=0), places.max(axis=0)
    heights = np.arange(low + 0.5 * _SPACING, high, _SPACING)
    middle, half_width = 0.5 * (low_y + high_y), 0.5 * (high_y - low_y)
    samples = np.stack(np.meshgrid(middle + half_width * _LATERAL, heights), axis=-1).reshape(-1, 2)
    chosen, shares = _locate(mesh.nodes[triangles][:, :, 1:], samples)
    return InnerFace(
        mesh=mesh,
        heights=heights,
        x=jaw.face.read(heights),
        half_width=half_width,
        nodes=triangles[chosen].reshape(len(heights), -1),
        weights=shares.reshape(len(heights), -1) / len(_LATERAL),
    )


def _locate(corners: NDArray, samples: NDArray) -> tuple[NDArray, NDArray]:
    """Return the triangle of corners (t, 3, 2) that each sample (p, 2) is in, and its shares of the corners (p, 3)."""
    origin, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    offset = samples[:, None] - origin
    b = (offset[..., 0] * second[:, 1] - offset[..., 1] * second[:, 0]) / area
    c = (first[:, 0] * offset[..., 1] - first[:, 1] * offset[..., 0]) / area
    shares = np.stack([1.0 - b - c, b, c], axis=-1)
    chosen = shares.min(axis=-1).argmax(axis=1)
    return chosen, shares[np.arange(len(samples)), chosen]


@njit(cache=True, error_model="numpy")
def _average(surface, nodes, weights):
    """Return the weighted x and z (h, 2) of nodes (h, m)."""
    line = np.zeros((len(nodes), 2))
    for h in range(len(nodes)):
        for k in range(nodes.shape[1]):
            line[h, 0] += weights[h, k] * surface[nodes[h, k], 0]
            line[h, 1] += weights[h, k] * surface[nodes[h, k], 2]
    return line


_OPTIONS = {"cache": True, "error_model": "numpy"}
_BISECTIONS = 40
# Exponents of the tilt over the span of the rows; beyond, all weight is on the last row anyway.
_STEEPEST = 40.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactPatch:
    """A contact patch as rows across the finger.

    Attributes:
        heights: (n,) [m] on the undeformed inner surface, rising.
        weights: (n,), sum 1.
    """

    heights: NDArray
    weights: NDArray

    @property
    def mean(self) -> float:
        """The weighted mean height [m]."""
        return float(self.heights @ self.weights)


def overlap_of(gaps: NDArray, depth: float) -> NDArray:
    """Return the overlap (h,) [m] with gaps (h,) [m] closed along x until the deepest overlap is `depth` [m].

    o = max(0, depth + min g - g): whatever the pose errs along x drops out.
    """
    return np.maximum(0.0, depth + gaps.min() - gaps)


def patch_from_overlap(heights: NDArray, overlap: NDArray, spacing: float, narrow: float) -> ContactPatch:
    """Return rows no farther apart than `spacing` [m], weighted by the overlap that each stands for.

    A contact whose overlap has the spread of an even one no higher than `narrow` [m], 12^0.5 standard deviations,
    is one row at its centre. Heights without overlap between two contacts part them.

    Args:
        heights: (h,) [m], evenly spaced.
        overlap: (h,) [m], somewhere above zero.
        spacing: greatest height per row [m].
        narrow: [m].
    """
    places, weights = _gather(heights, overlap, spacing, narrow)
    return ContactPatch(heights=places, weights=weights / weights.sum())


def tilt_patch(patch: ContactPatch, mean: float) -> ContactPatch:
    """Return the rows with weights w_i exp(s z_i) whose mean is `mean` [m], or one row there when none has it."""
    if not patch.heights[0] < mean < patch.heights[-1]:
        return ContactPatch(heights=np.array([mean]), weights=np.ones(1))
    return ContactPatch(heights=patch.heights, weights=_tilt(patch.heights, patch.weights, mean))


def cross_line_of_action(line: NDArray, heights: NDArray, force: NDArray, torque: NDArray, near: float) -> float:
    """Return the undeformed height [m] where the force's line of action cuts the deformed line, NaN if nowhere.

    The cut is where z F_x - x F_z = M_y; of several the one nearest to the height `near` [m] counts.

    Args:
        line: x and z (h, 2) [m] of the deformed surface.
        heights: (h,) [m] of its points on the undeformed surface.
        force: (3,) [N].
        torque: (3,) [N m] about the jaw's origin.
        near: [m].
    """
    miss = line[:, 1] * force[0] - line[:, 0] * force[2] - torque[1]
    before = np.flatnonzero((miss[:-1] <= 0.0) != (miss[1:] <= 0.0))
    if not len(before):
        return float("nan")
    share = miss[before] / (miss[before] - miss[before + 1])
    cuts = heights[before] + share * (heights[before + 1] - heights[before])
    return float(cuts[np.abs(cuts - near).argmin()])


@njit(**_OPTIONS)
def _gather(heights, overlap, spacing, narrow):
    """Return heights and weights of the rows of every contact."""
    places, weights, count = np.empty(len(heights)), np.empty(len(heights)), 0
    first = 0
    while first < len(heights):
        if overlap[first] <= 0.0:
            first += 1
            continue
        last = first
        while last + 1 < len(heights) and overlap[last + 1] > 0.0:
            last += 1
        h, w = heights[first : last + 1], overlap[first : last + 1]
        centre = (h * w).sum() / w.sum()
        spread = np.sqrt(12.0 * ((h - centre) ** 2 * w).sum() / w.sum())
        rows = 1 if spread <= narrow else int(np.ceil((h[-1] - h[0]) / spacing))
        for r in range(rows):
            start, stop = r * len(h) // rows, (r + 1) * len(h) // rows
            share = w[start:stop].sum()
            if share > 0.0:
                places[count], weights[count] = (h[start:stop] * w[start:stop]).sum() / share, share
                count += 1
        first = last + 1
    return places[:count].copy(), weights[:count].copy()


@njit(**_OPTIONS)
def _tilt(heights, weights, mean):
    """Return the tilted weights; the slope is found by bisection."""
    span = heights[-1] - heights[0]
    low, high = -_STEEPEST, _STEEPEST
    tilted = weights.copy()
    for _ in range(_BISECTIONS):
        slope = 0.5 * (low + high)
        exponent = slope * (heights - mean) / span
        tilted = weights * np.exp(exponent - exponent.max())
        tilted /= tilted.sum()
        if (tilted * heights).sum() < mean:
            low = slope
        else:
            high = slope
    return tilted


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactScene:
    """What a localizer looks at.

    Attributes:
        T: T_jaw_object (4, 4).
        section: the object's outline there.
        surface: (n, 3) [m] of the jaw's vertices, deformed or at rest.
        line: (h, 2) [m] of the inner face on that surface.
        wrench: force (3,) [N] and torque (3,) [N m] about the jaw's origin; None when nobody knows.
    """

    T: NDArray
    section: ObjectSection
    surface: NDArray
    line: NDArray
    wrench: tuple[NDArray, NDArray] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactLocation:
    """Where the object touches, or would touch first.

    Attributes:
        patch: heights and weights on the undeformed inner surface.
        gap: from the surface to the object along x [m], negative when they overlap.
        bend: how far the surface has given way where the object is nearest [m].
        touching: what the localizer finds itself; None when gap and bend are to decide.
    """

    patch: ContactPatch
    gap: float
    bend: float
    touching: bool | None = None


class Localizer(Protocol):
    """Finds the contact in a scene."""

    def reset(self) -> None:
        """Forget earlier scenes, where any are remembered."""

    def locate(self, scene: ContactScene) -> ContactLocation | None:
        """Return the contact, None when the object does not stand before the inner surface."""


class ClosestLocalizer(Localizer):
    """Takes the candidate nearest to the point of the undeformed inner surface that is nearest to the object.

    Where the object is in the undeformed jaw, the deepest point counts.
    """

    def __init__(self, jaw: Jaw, face: InnerFace) -> None:
        self._candidates = jaw.candidates[:, 2]
        self._face = face
        self._line = face.deform(face.mesh.nodes)

    def locate(self, scene: ContactScene) -> ContactLocation | None:
        """Return the contact, None when the object does not stand before the inner surface."""
        gaps = compute_gaps(self._line, scene.section.edges)
        if not np.isfinite(gaps).any():
            return None
        nearest = gaps if gaps.min() < 0.0 else distances_to(self._line, scene.section.edges)
        height = self._face.heights[nearest.argmin()]
        height = self._candidates[np.abs(self._candidates - height).argmin()]
        patch = ContactPatch(heights=np.array([height]), weights=np.ones(1))
        bend = float(np.interp(height, self._face.heights, self._face.x - scene.line[:, 0]))
        return ContactLocation(patch=patch, gap=float(gaps.min()) + bend, bend=bend)


_OVERLAP = 0.2e-3  # [m] into which the object is brought with the deformed surface
_ROW_SPACING = 2.5e-3  # [m], the greatest height of the surface that one row stands for
_NARROW = 5e-3  # [m], the greatest height of a contact that is one row
WRENCH_FORCE = 0.2  # [N]; the line of action of a weaker force tells nothing
WRENCH_GAIN = 0.93  # share of the line of action in the mean; the rest is that of the overlap
# A line of action counts where it misses the overlap by no more than this [m], or meets an object this near [m].
_WRENCH_REACH, _WRENCH_SLACK = 3e-3, 1e-3


class OutlineLocalizer(Localizer):
    """Brings the object along x into slight overlap with the deformed surface, whatever its pose errs along x.

    The overlap is where it touches. Once a force is known, its line of action cuts the surface in the pressure centre;
    the rows are weighted so that it is their mean when it agrees with the overlap.
    """

    def __init__(self, face: InnerFace) -> None:
        self._face = face

    def locate(self, scene: ContactScene) -> ContactLocation | None:
        """Return the contact, None when the object does not stand before the inner surface."""
        gaps = compute_gaps(scene.line, scene.section.edges)
        nearest = int(gaps.argmin())
        if not np.isfinite(gaps[nearest]):
            return None
        heights = self._face.heights
        overlap = overlap_of(gaps, _OVERLAP)
        patch = patch_from_overlap(heights, overlap, _ROW_SPACING, _NARROW)
        if scene.wrench is not None:
            patch = self._follow_wrench(patch, gaps - gaps[nearest] - _OVERLAP, scene)
        bend = float(np.interp(patch.mean, heights, self._face.x - scene.line[:, 0]))
        return ContactLocation(patch=patch, gap=float(gaps[nearest]), bend=bend)

    def _follow_wrench(self, patch: ContactPatch, gaps: NDArray, scene: ContactScene) -> ContactPatch:
        """Return the rows with their mean moved towards the pressure centre, if that agrees with the gaps left (h,).

        A pose that is a little off along z closes the gap at one end of a wrapped surface and opens it at the other.
        """
        force, torque = scene.wrench
        heights = self._face.heights
        if np.hypot(force[0], force[2]) < WRENCH_FORCE:
            return patch
        centre = cross_line_of_action(scene.line, heights, force, torque, patch.mean)
        touched = heights[gaps < 0.0]
        near = touched[0] - _WRENCH_REACH <= centre <= touched[-1] + _WRENCH_REACH
        if not (near or np.interp(centre, heights, gaps) < _WRENCH_SLACK):
            return patch
        mean = patch.mean + WRENCH_GAIN * (centre - patch.mean)
        return tilt_patch(patch, mean)
