"""Pixels and depths of one jaw's key points to points in its frame.

The key points lie on the jaw's side face. Depth is read from many pixels inside its outline. What the depths share (the
place and the slopes of that face, the scale of the depth image) is found from all of them and the reference point,
which is rigid; what is left over is each one's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.compiled import njit
from finforce.elimination import eliminate
from finforce.lens import project_point
from finforce.optional import import_cv2
from finforce_ifea.jaw.jaw import Jaw

_OPTIONS = {"cache": True, "error_model": "numpy", "nogil": True}
WINDOW, EDGE = 3e-3, 0.4e-3  # [m] around a key point, and inside the edges where depths are mixed, that is sampled
_SPACING = 0.15e-3  # of the raster on which the finger's side is drawn [m]
_STRIDES = (3, 2, 1)  # every so many points of it are sampled: a pixel is 0.25 to 0.5 mm
_ENOUGH = 24  # samples; a thin band is sampled more densely for as many, then nearer to its edges
_EDGE_SHARES = (1.0, 0.5, 0.0)
_ON_SIDE = 0.2e-3  # a triangle's corners this near to the side plane are on it [m]
_REFERENCE_RADIUS = 1.5e-3  # the reference point's holder is flat so far around it [m]
_SMALLEST_RADIUS = 0.45e-3  # around a key point that is not on a flat side of the mesh [m]
_INLIER_SIGMA = 3.0
_MAD_TO_STDDEV = 1.4826
_CORRELATED = 6.0  # neighbouring samples whose errors are alike
_OUTLIER_SIGMA = 2.5
_ROBUST_STEPS = 3
_LEAST_STDDEV = 1e-7  # [m], or relative: keeps the fit regular where settings are zero


@dataclass(frozen=True, kw_only=True, eq=False)
class SideSamples:
    """Places on the finger's side around its key points, the reference point last.

    Attributes:
        offsets: (K + 1, S, 3) from the point, parallel to the side plane [m, jaw frame].
        used: (K + 1, S) bool; the rest is padding.
    """

    offsets: NDArray
    used: NDArray


@dataclass(frozen=True, eq=False)
class DepthEvidence:
    """The evidence of the depth image for points on the finger's side.

    Attributes:
        excess: (n,) measured less expected depth [m]; NaN where there are no depths of the finger.
        stddev: (n,) of `excess` without what all depths of the image share [m].
        known: (n,) samples with depth.
        count: (n,) samples that are the finger's.
        share: (n,) of the samples with depth that are the finger's; 0 where none has depth.
    """

    excess: NDArray
    stddev: NDArray
    known: NDArray
    count: NDArray
    share: NDArray


@lru_cache(maxsize=16)  # one for each jaw at hand
def build_side_samples(jaw: Jaw, window: float = WINDOW, edge: float = EDGE) -> SideSamples:
    """Return places on the jaw's side, `edge` [m] inside its outline and at most `window` [m] from a key point.

    Where a band is too thin for enough of them, they lie nearer to its edges.

    Raises:
        MeshError: the jaw's mesh is bad.
    """
    mesh = jaw.build_mesh("coarse" if jaw.drawing is not None else None)
    triangles = mesh.nodes[mesh.surface]
    steps = np.arange(-window - edge, window + edge + 0.5 * _SPACING, _SPACING)
    raster = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
    places = [_select_places(raster, point, triangles, window, edge) for point in jaw.keypoints]
    places.append(_thin_out(raster, np.linalg.norm(raster, axis=-1) <= _REFERENCE_RADIUS))
    offsets = np.zeros((len(places), max(map(len, places)), 3))
    used = np.zeros(offsets.shape[:2], dtype=bool)
    for row, place in enumerate(places):
        offsets[row, : len(place), ::2] = place
        used[row, : len(place)] = True
    return SideSamples(offsets=offsets, used=used)


def _select_places(raster: NDArray, point: NDArray, triangles: NDArray, window: float, edge: float) -> NDArray:
    """Return the places x, z (s, 2) of a raster (a, a, 2) around a key point, well inside the side's outline."""
    reach = np.abs(raster).max()
    corners = triangles[(np.abs(triangles[:, :, 1] - point[1]) < _ON_SIDE).all(axis=1)][:, :, ::2] - point[::2]
    corners = corners[(corners.min(axis=1) < reach).all(axis=1) & (corners.max(axis=1) > -reach).all(axis=1)]
    inside = _cover(corners, raster)
    cv2, away = import_cv2(), np.linalg.norm(raster, axis=-1)
    depth = cv2.distanceTransform(inside.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * _SPACING
    for share in _EDGE_SHARES:
        places = _thin_out(raster, (away <= window) & (depth > share * edge))
        if len(places) >= _ENOUGH:
            return places
    return places if len(places) else _thin_out(raster, away <= _SMALLEST_RADIUS)


def _thin_out(raster: NDArray, chosen: NDArray) -> NDArray:
    """Return chosen places (s, 2) of a raster (a, a, 2), as sparse as leaves enough of them."""
    for stride in _STRIDES:
        places = raster[::stride, ::stride][chosen[::stride, ::stride]]
        if len(places) >= _ENOUGH:
            break
    return places


def _cover(triangles: NDArray, raster: NDArray) -> NDArray[np.bool_]:
    """Return which points (a, a) of a raster (a, a, 2) triangles (n, 3, 2) cover."""
    inside, steps, slack = np.zeros(raster.shape[:2], dtype=bool), raster[:, 0, 0], 1e-9
    for corners in triangles:
        box = tuple(map(slice, *np.searchsorted(steps, (corners.min(axis=0) - slack, corners.max(axis=0) + slack))))
        along, away = np.roll(corners, -1, axis=0) - corners, raster[box][..., None, :] - corners
        turn = along[:, 0] * away[..., 1] - along[:, 1] * away[..., 0]
        inside[box] |= (turn >= -slack).all(axis=2) | (turn <= slack).all(axis=2)
    return inside


def sample_depths(
    depth: NDArray, camera: CameraIntrinsics, points: NDArray, samples: SideSamples, T_camera_jaw: NDArray
) -> NDArray:
    """Return measured less expected depths (n, S) [m] around points on a jaw's side, NaN where nothing was measured.

    Args:
        depth: (h, w) [m].
        camera: of the depth image.
        points: (n, 3) where the points would be on the expected side plane [m, jaw frame]; NaN: not to be sampled.
        samples: places around them.
        T_camera_jaw: (4, 4).
    """
    T, depth = np.ascontiguousarray(T_camera_jaw, dtype=float), np.asarray(depth)
    return _sample_side(depth, camera.lens, T, np.ascontiguousarray(points), samples.offsets, samples.used)


@njit(**_OPTIONS)
def _sample_side(depth, lens, T, points, offsets, used):
    """Return measured less expected depths (n, S) [m] at places around points of a side; NaN without one.

    Args:
        depth: (h, w) [m].
        lens: see `finforce.lens.project_point`.
        T: T_camera_jaw (4, 4).
        points: (n, 3) [m], jaw frame.
        offsets: (n, S, 3) of the places [m], jaw frame.
        used: (n, S) which of them there are.
    """
    height, width = depth.shape
    excess = np.full(used.shape, np.nan)
    for i in range(used.shape[0]):
        if not np.isfinite(points[i]).all():
            continue
        for s in range(used.shape[1]):
            if not used[i, s]:
                continue
            x, y, z = points[i, 0] + offsets[i, s, 0], points[i, 1] + offsets[i, s, 1], points[i, 2] + offsets[i, s, 2]
            away = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            u, v = project_point(
                lens,
                T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
                T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
                away,
            )
            if -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5:
                excess[i, s] = depth[int(np.rint(v)), int(np.rint(u))] - away
    return excess


def weigh_depths(excess: NDArray, centre: NDArray, gate: float, quantum: float) -> DepthEvidence:
    """Return what sampled depths say, those of the finger being within `gate` [m] of the expectation.

    The median of these and their median absolute deviation (MAD) choose the ones to average:
    |excess - median| <= 3 max(1.4826 MAD, quantum / 2). The average's error is that of one depth, at least that of
    rounding, quantum / sqrt 12, by the root of the number of samples whose errors are not alike.

    Args:
        excess: (n, S) measured less expected depths [m], NaN where nothing was measured.
        centre: (n,) excess around which the finger is expected [m].
        gate: [m].
        quantum: step of the depths [m].
    """
    return DepthEvidence(*_weigh_samples(excess, np.asarray(centre, dtype=float), gate, quantum))


@njit(**_OPTIONS)
def _weigh_samples(excess, centre, gate, quantum):
    """Return excess, stddev, known, count and share (5, n) of `DepthEvidence`.

    Args:
        excess: (n, S) measured less expected depths [m], NaN where nothing was measured.
        centre: (n,) [m].
        gate: [m].
        quantum: [m].
    """
    n, size = excess.shape
    found, chosen, apart = np.zeros((5, n)), np.empty(size), np.empty(size)
    for i in range(n):
        known, count = 0, 0
        for s in range(size):
            away = excess[i, s] - centre[i]
            known += np.isfinite(away)
            if abs(away) <= gate:
                chosen[count] = away
                count += 1
        middle = np.median(chosen[:count]) if count else np.nan
        for s in range(count):
            apart[s] = abs(chosen[s] - middle)
        spread = _MAD_TO_STDDEV * np.median(apart[:count]) if count else np.nan
        widest, total, kept = _INLIER_SIGMA * max(spread, 0.5 * quantum), 0.0, 0
        for s in range(count):
            if abs(chosen[s] - middle) <= widest:
                total += chosen[s]
                kept += 1
        found[0, i] = total / kept + centre[i] if kept else np.nan
        rounded = max(spread, quantum / np.sqrt(12.0)) if count else np.nan
        found[1, i] = rounded / np.sqrt(max(kept / _CORRELATED, 1.0))
        found[2, i], found[3, i] = known, kept
        found[4, i] = kept / max(known, 1)
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class SideView:
    """Rays through pixels, in the jaw frame.

    Attributes:
        camera: (3,) the camera's place [m].
        rays: (n, 3) directions whose length is one metre of depth; a point is camera + depth rays.
        axes: (3, 3) the camera's axes, one a row.
    """

    camera: NDArray
    rays: NDArray
    axes: NDArray

    def depths_at(self, y: NDArray) -> NDArray:
        """Return the depths (n,) [m] at which the rays reach y (n,) [m], NaN where they never do."""
        with np.errstate(divide="ignore", invalid="ignore"):
            depths = (y - self.camera[1]) / self.rays[:, 1]
        return np.where(depths > 0.0, depths, np.nan)

    def points_at(self, y: NDArray) -> NDArray:
        """Return the points (n, 3) [m] where the rays reach y (n,) [m]."""
        return self.camera + self.depths_at(y)[:, None] * self.rays


def look_along(rays: NDArray, T_camera_jaw: NDArray) -> SideView:
    """Return rays (n, 3), camera frame, as seen from the jaw."""
    R = T_camera_jaw[:3, :3]
    return SideView(camera=-T_camera_jaw[:3, 3] @ R, rays=rays @ R, axes=R)


@dataclass(frozen=True, kw_only=True, eq=False)
class SideModel:
    """The prior of a jaw's side and of the depth image.

    Attributes:
        places: (K + 1, 2) x and z of the points at rest, the reference point last [m].
        offset: standard deviation of the side at its base [m].
        tilt: of its slopes along x and z [-].
        bow: of its curvature along z [1/m].
        relief: of single key points [m].
    """

    places: NDArray
    offset: float = 0.2e-3
    tilt: float = 0.02
    bow: float = 0.2
    relief: float = 0.06e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthScale:
    """The relative error that all depths of a camera share, and its standard deviation."""

    error: float
    stddev: float


@dataclass(frozen=True, kw_only=True, eq=False)
class SideFit:
    """The positions of the points of a jaw across its side.

    Attributes:
        y: (K + 1,) above the side plane, expected value [m].
        stddev: (K + 1,) of y [m].
        misfit: (K + 1,) measured y less expected, in standard deviations; NaN without depth.
        scale: of the depth image.
    """

    y: NDArray
    stddev: NDArray
    misfit: NDArray
    scale: DepthScale


def fit_side(model: SideModel, measured: NDArray, stddev: NDArray, lever: NDArray, scale: DepthScale) -> SideFit:
    """Return the side's points given noisy measurements of some of them.

    m_i = h_i . (a, b, c, d) + e_i + s l_i + n_i with h_i = (1, x_i, z_i, z_i^2), all normal with known standard
    deviations; of the reference point, h and e are zero. The expectation of y_i = h_i . (a, b, c, d) + e_i given all m
    follows, with the noise of outliers raised as for a t distribution.

    Args:
        model: of the side.
        measured: (K + 1,) measured y above the side plane [m], NaN without depth; the reference point last.
        stddev: (K + 1,) of the measurements' own noise n [m].
        lever: (K + 1,) derivative l of y by the depth's relative error [m].
        scale: prior of the relative error s.
    """
    beforehand = np.array([model.offset, model.tilt, model.tilt, model.bow, scale.stddev])
    places = np.ascontiguousarray(model.places)
    known = measured - lever * scale.error
    (y, spread, misfit), change, left = _fit_shape(places, model.relief, beforehand, known, stddev, lever)
    scale = DepthScale(error=float(scale.error + change), stddev=float(left))
    return SideFit(y=y, stddev=spread, misfit=misfit, scale=scale)


@njit(**_OPTIONS)
def _fit_shape(places, relief, beforehand, known, stddev, lever):
    """Return y, stddev and misfit (3, K + 1), and the change of the scale's error and its stddev; see `fit_side`.

    Args:
        places: (K + 1, 2) x and z at rest [m], the reference point last.
        relief: of single key points [m].
        beforehand: (5,) standard deviations of offset, tilts, bow and scale.
        known: (K + 1,) measured y, at the scale so far [m], NaN without depth.
        stddev: (K + 1,) [m].
        lever: (K + 1,) [m].
    """
    count = len(known)
    seen, noise, own = np.isfinite(known), np.ones(count), np.zeros(count)
    rows, left = np.zeros((count, 5)), np.full(count, np.nan)
    own[:-1] = relief**2
    rows[:-1, 0], rows[:-1, 1], rows[:-1, 2], rows[:-1, 3] = 1.0, places[:-1, 0], places[:-1, 1], places[:-1, 1] ** 2
    rows[:, 4] = lever
    noise[seen] = np.maximum(stddev[seen], _LEAST_STDDEV) ** 2
    variance = noise.copy()
    prior = np.diag(1.0 / np.maximum(beforehand, _LEAST_STDDEV) ** 2)
    covariance, theta = prior, beforehand
    for _ in range(_ROBUST_STEPS):
        covariance, theta = _solve_weighted(prior, rows, known, seen, own + noise)
        left = known - (rows * theta).sum(axis=1)  # @ would load SciPy, which takes half a second
        noise = variance * (1.0 + left**2 / (own + variance) / _OUTLIER_SIGMA**2)
    found, spread = np.full((3, count), np.nan), np.empty(5)
    for i in range(count):
        share = own[i] / (own[i] + noise[i]) if seen[i] else 0.0
        spread[:] = (1.0 - share) * rows[i]
        spread[4] = -share * rows[i, 4]
        found[0, i] = (rows[i, :4] * theta[:4]).sum() + (share * left[i] if seen[i] else 0.0)
        found[1, i] = np.sqrt((spread * (covariance * spread).sum(axis=1)).sum() + (1.0 - share) * own[i])
        if seen[i]:
            found[2, i] = left[i] / np.sqrt(own[i] + variance[i])
    return found, theta[4], np.sqrt(covariance[4, 4])


@njit(**_OPTIONS)
def _solve_weighted(prior, rows, known, seen, variance):
    """Return covariance (m, m) and mean (m,) by least squares with a prior information (m, m), of rows (n, m) seen."""
    size = len(prior)
    A, g = prior.copy(), np.zeros(size)
    for i in range(len(rows)):
        if not seen[i]:
            continue
        w = 1.0 / variance[i]
        for a in range(size):
            g[a] += w * rows[i, a] * known[i]
            for b in range(size):
                A[a, b] += w * rows[i, a] * rows[i, b]
    covariance = np.eye(size)
    eliminate(A, covariance)
    return covariance, (covariance * g).sum(axis=1)


def compute_stddev(sight: SideView, depths: NDArray, y_stddev: NDArray, ray_stddev: NDArray) -> NDArray:
    """Return the standard deviations (n, 3) [m] of points along the jaw's axes.

    On the plane y = const, dp = d (dv - v dv_y / v_y) for a ray that errs by dv; across it, dp = v / v_y dy.

    Args:
        sight: rays v.
        depths: (n,) d [m].
        y_stddev: (n,) of y [m].
        ray_stddev: (n,) of the rays along the image's rows and along its columns [-].
    """
    across = sight.rays / sight.rays[:, 1:2]
    slopes = sight.axes[:2] - across[:, None, :] * sight.axes[:2, 1:2]
    lateral = (depths * ray_stddev)[:, None] ** 2 * (slopes**2).sum(axis=1)
    return np.sqrt(lateral + (across * y_stddev[:, None]) ** 2)
