"""The lens models of ROS and the fisheye, compiled: points to pixels, and pixels to rays."""

from __future__ import annotations

import numpy as np

from finforce.compiled import njit

_OPTIONS = {"cache": True, "error_model": "numpy", "nogil": True}
POLYNOMIAL, FISHEYE = 1.0, 2.0  # kinds of lenses in addition to the pinhole, the fifth number of a lens
STEPS = 50  # iterations that invert a distortion, at most
TOLERANCE = 1e-10  # [-], their last change, of a ray with z = 1


@njit(**_OPTIONS)
def bend_radially(lens, s):
    """Return the radial factor of a polynomial or rational lens at a squared distance s from the axis."""
    radial = 1.0 + s * (lens[5] + s * (lens[6] + s * lens[9]))
    return radial / (1.0 + s * (lens[10] + s * (lens[11] + s * lens[12])))


@njit(**_OPTIONS)
def bend_angle(lens, angle):
    """Return what an angle [rad] from a fisheye's axis becomes, and the slope of that."""
    s = angle * angle
    bent = angle * (1.0 + s * (lens[5] + s * (lens[6] + s * (lens[7] + s * lens[8]))))
    return bent, 1.0 + s * (3.0 * lens[5] + s * (5.0 * lens[6] + s * (7.0 * lens[7] + s * 9.0 * lens[8])))


@njit(**_OPTIONS)
def project_point(lens, x, y, z):
    """Return column and row [px] of a point [m] in the camera frame; NaN where the lens shows it nowhere.

    Args:
        lens: fx, fy, cx, cy, kind, eight coefficients of distortion, the widest angle [rad] (14,).
        x: of the point.
        y: of the point.
        z: of the point.
    """
    if not z > 0.0:
        return np.nan, np.nan
    u, v = x / z, y / z
    if lens[4] == FISHEYE:
        distance = np.hypot(u, v)
        angle = np.arctan(distance)
        bent, slope = bend_angle(lens, angle)
        # beyond the angle where its circles begin to shrink again, a lens shows nothing
        if not (angle <= lens[13] and slope > 0.0):
            return np.nan, np.nan
        if distance > 1e-12:
            u, v = u * bent / distance, v * bent / distance
    elif lens[4] == POLYNOMIAL:
        s = u * u + v * v
        radial = bend_radially(lens, s)
        shift_u = 2.0 * lens[7] * u * v + lens[8] * (s + 2.0 * u * u)
        shift_v = lens[7] * (s + 2.0 * v * v) + 2.0 * lens[8] * u * v
        u, v = u * radial + shift_u, v * radial + shift_v
    return u * lens[0] + lens[2], v * lens[1] + lens[3]


@njit(**_OPTIONS)
def project_points(lens, points):
    """Return the pixels (n, 2) of points (n, 3) [m]; see `project_point`."""
    pixels = np.empty((len(points), 2))
    for i in range(len(points)):
        pixels[i, 0], pixels[i, 1] = project_point(lens, points[i, 0], points[i, 1], points[i, 2])
    return pixels


@njit(**_OPTIONS)
def find_rays(lens, pixels):
    """Return the rays (n, 3), z = 1, through pixels (n, 2), and whether all of them could be found.

    The rays of NaN are NaN, and so are those beyond the widest angle of a fisheye.
    """
    rays, found = np.ones((len(pixels), 3)), True
    for i in range(len(pixels)):
        u, v = (pixels[i, 0] - lens[2]) / lens[0], (pixels[i, 1] - lens[3]) / lens[1]
        if lens[4] == FISHEYE:
            u, v = _unbend_fisheye(lens, u, v)
        elif lens[4] == POLYNOMIAL:
            u, v, change = _unbend_polynomial(lens, u, v)
            found = found and not change >= TOLERANCE
        rays[i, 0], rays[i, 1] = u, v
        if not (np.isfinite(u) and np.isfinite(v)):
            rays[i] = np.nan
    return rays, found


@njit(**_OPTIONS)
def _unbend_polynomial(lens, aim_u, aim_v):
    """Return the place on z = 1 that is shown at another one, and the iteration's last change.

    A fixed-point iteration: x = (x_d - tangential(x)) / radial(x).
    """
    u, v, change = aim_u, aim_v, 0.0
    for _ in range(STEPS):
        s = u * u + v * v
        radial = bend_radially(lens, s)
        next_u = (aim_u - 2.0 * lens[7] * u * v - lens[8] * (s + 2.0 * u * u)) / radial
        next_v = (aim_v - lens[7] * (s + 2.0 * v * v) - 2.0 * lens[8] * u * v) / radial
        change = max(abs(next_u - u), abs(next_v - v))
        u, v = next_u, next_v
        if change < TOLERANCE:
            break
    return u, v, change


@njit(**_OPTIONS)
def _unbend_fisheye(lens, u, v):
    """Return the place on z = 1 that a fisheye shows at another one, by Newton's method; NaN beyond its edge."""
    aim = np.hypot(u, v)
    angle = min(aim, 0.5 * np.pi)
    for _ in range(STEPS):
        bent, slope = bend_angle(lens, angle)
        before, angle = angle, min(max(angle - (bent - aim) / max(slope, 0.05), 0.0), 0.5 * np.pi)
        if abs(angle - before) < TOLERANCE:
            break
    if not (abs(bend_angle(lens, angle)[0] - aim) <= 1e-6 and angle <= lens[13]):
        return np.nan, np.nan
    share = np.tan(angle) / aim if aim > 1e-12 else 1.0
    return share * u, share * v
