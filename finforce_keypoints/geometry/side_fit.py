"""Pixels and depths of one jaw's key points to points in its frame.

The key points lie on the jaw's side face. What their depths share (the place and the slopes of that face, the scale of
the depth image) is found from all of them and the reference point, which is rigid; what is left over is each one's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, rays_from_pixels

_OUTLIER_SIGMA = 2.5
_ROBUST_STEPS = 3
_LEAST_STDDEV = 1e-7  # [m], or relative: keeps the fit regular where settings are zero


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


def rays_through(pixels: NDArray, camera: CameraIntrinsics) -> NDArray:
    """Return the undistorted rays (n, 3), z = 1, camera frame, through pixels (n, 2); NaN where these are."""
    rays = np.full((len(pixels), 3), np.nan)
    seen = np.isfinite(pixels).all(axis=1)
    rays[seen] = rays_from_pixels(pixels[seen], camera)
    return rays


def look_along(rays: NDArray, T_camera_jaw: NDArray) -> SideView:
    """Return rays (n, 3), camera frame, as seen from the jaw."""
    R = T_camera_jaw[:3, :3]
    return SideView(camera=-T_camera_jaw[:3, 3] @ R, rays=rays @ R, axes=R)


@dataclass(frozen=True, kw_only=True, eq=False)
class SideModel:
    """What is known beforehand of a jaw's side and of the depth image.

    Attributes:
        places: (K + 1, 2) x and z of the points at rest, the reference point last [m].
        offset: standard deviation of the side at its base [m].
        tilt: of its slopes along x and z [-].
        bow: of its curvature along z [1/m].
        relief: of single key points [m].
    """

    places: NDArray
    offset: float
    tilt: float
    bow: float
    relief: float


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthScale:
    """The relative error that all depths of a camera share, and its standard deviation."""

    error: float
    stddev: float


@dataclass(frozen=True, kw_only=True, eq=False)
class SideFit:
    """Where the points of a jaw are across its side.

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
        scale: what is known of the relative error s beforehand.
    """
    rigid = np.append(np.ones(len(measured) - 1), 0.0)
    shape = rigid[:, None] * np.column_stack((np.ones(len(measured)), model.places, model.places[:, 1] ** 2))
    seen = np.isfinite(measured)
    rows = np.column_stack((shape, lever))[seen]
    known, own = measured[seen] - lever[seen] * scale.error, (model.relief * rigid[seen]) ** 2
    beforehand = (model.offset, model.tilt, model.tilt, model.bow, scale.stddev)
    prior = np.diag(1.0 / np.maximum(beforehand, _LEAST_STDDEV) ** 2)
    measured_variance = np.maximum(stddev[seen], _LEAST_STDDEV) ** 2
    noise = measured_variance
    for _ in range(_ROBUST_STEPS):
        weights = 1.0 / (own + noise)
        covariance = np.linalg.inv(prior + (rows * weights[:, None]).T @ rows)
        theta = covariance @ (rows.T @ (weights * known))
        left = known - rows @ theta
        standard = left**2 / (own + measured_variance)
        noise = measured_variance * (1.0 + standard / _OUTLIER_SIGMA**2)
    share = np.zeros(len(measured))
    share[seen] = own / (own + noise)
    y = shape @ theta[:4]
    y[seen] += share[seen] * left
    spread = np.column_stack((shape, np.zeros(len(measured))))
    spread[seen] -= share[seen, None] * rows
    variance = np.einsum("ij,jk,ik->i", spread, covariance, spread) + (1.0 - share) * (model.relief * rigid) ** 2
    misfit = np.full(len(measured), np.nan)
    misfit[seen] = left / np.sqrt(own + measured_variance)
    found = DepthScale(error=float(scale.error + theta[4]), stddev=float(np.sqrt(covariance[4, 4])))
    return SideFit(y=y, stddev=np.sqrt(variance), misfit=misfit, scale=found)


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
