"""Coulomb friction between surface points and a rigid object, with the history that it needs.

A point that touches is held by a tangential spring as stiff as the penalty along the normal. It slides once the spring
exceeds the cone,

    T = clamp(T_before - k t . (x - x_before - X + X_before), +- c N),

with the normal n and N = |normal force|, the tangent t = (n_z, -n_x), the point's position x and the object's X.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.compiled import njit

_OPTIONS = {"cache": True, "error_model": "numpy"}


class Coefficient(NamedTuple):
    """A coefficient of friction and its standard deviation [-]."""

    mean: float
    stddev: float


class Touch(NamedTuple):
    """The load of an object on one surface point.

    Attributes:
        fx: force along x [N].
        fz: along z [N].
        kxx: negative derivative of the force along x by the point's x [N/m].
        kxz: of either by the other [N/m].
        kzz: of the force along z by z [N/m].
        bx: derivative of the force along x by the object's size [N/m], its centre held, or by its tilt [N/rad].
        bz: of that along z.
    """

    fx: float
    fz: float
    kxx: float
    kxz: float
    kzz: float
    bx: float
    bz: float


class Traction(NamedTuple):
    """The traction along the surface while an object presses.

    Attributes:
        ratio: of tangential to normal force at all points [-], where friction is not followed.
        coefficient: of friction at each point (p,) [-]; none where it is not followed.
        shear: of each point before (p,) [N].
        before: where each point was then (p, 3) [m]; none of them where nothing has moved yet.
        moved: of the object since then (x, z) [m].
    """

    ratio: float
    coefficient: NDArray
    shear: NDArray
    before: NDArray
    moved: NDArray


_NO_HISTORY = np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros(2)


def constant_traction(ratio: float) -> Traction:
    """Return tangential forces that are one share of all normal forces, as where everything slides the same way."""
    return Traction(ratio, *_NO_HISTORY)


FRICTIONLESS = constant_traction(0.0)


_SPRING, _CHANGE = 1, 3
# What `add_traction` writes of each point: force, two columns of springs, four of changes, along x and z.
POINT_SHAPE = (2, 7)


@njit(**_OPTIONS)
def _add_ratio(ratio, touch, out):
    """Add what a traction ratio makes of a point's springs and of its derivatives by the contact state, in place."""
    out[0, _SPRING] += ratio * touch.kxz
    out[0, _SPRING + 1] += ratio * touch.kzz
    out[1, _SPRING] -= ratio * touch.kxx
    out[1, _SPRING + 1] -= ratio * touch.kxz
    for i in range(_CHANGE, _CHANGE + 3):
        x, z = out[0, i], out[1, i]
        out[0, i], out[1, i] = x + ratio * z, z - ratio * x


@njit(**_OPTIONS)
def add_traction(traction, touch, p, x, z, stiffness, out):
    """Write point p, at x and z [m], with what acts along the surface to out (2, 7); see `POINT_SHAPE`."""
    fx, fz = touch.fx, touch.fz
    out[0, 0], out[0, 1], out[0, 2] = fx, touch.kxx, touch.kxz
    out[1, 0], out[1, 1], out[1, 2] = fz, touch.kxz, touch.kzz
    out[0, 3], out[0, 4], out[0, 5], out[0, 6] = -touch.kxx, touch.bx, touch.kxz, fz
    out[1, 3], out[1, 4], out[1, 5], out[1, 6] = -touch.kxz, touch.bz, touch.kzz, -fx
    if len(traction.coefficient) == 0:
        _add_ratio(traction.ratio, touch, out)
        out[0, 0] += traction.ratio * fz
        out[1, 0] -= traction.ratio * fx
        return
    normal = np.hypot(fx, fz)
    if normal <= 0.0:
        return
    tx, tz = fz / normal, -fx / normal
    slip, before = 0.0, traction.before
    if len(before) > 0:
        slip = tx * (x - before[p, 0] - traction.moved[0]) + tz * (z - before[p, 2] - traction.moved[1])
    shear, limit = traction.shear[p] - stiffness * slip, traction.coefficient[p] * normal
    if abs(shear) > limit or limit == 0.0:
        shear = limit if shear > 0.0 else -limit
        _add_ratio(shear / normal, touch, out)
    else:
        for a, ta in ((0, tx), (1, tz)):
            out[a, _SPRING] += stiffness * ta * tx
            out[a, _SPRING + 1] += stiffness * ta * tz
            out[a, _CHANGE] -= stiffness * ta * tx
            out[a, _CHANGE + 2] += stiffness * ta * tz
    out[0, 0] += shear * tx
    out[1, 0] += shear * tz


def measure_shear(forces: NDArray, pressure: NDArray) -> NDArray:
    """Return the tangential force (p,) [N] at each point, for the next step's `Traction.shear`.

    Args:
        forces: of the contact at points (p, 3) [N].
        pressure: the same without friction (p, 3) [N].
    """
    size = np.hypot(pressure[:, 0], pressure[:, 2])
    along = (forces - pressure)[:, 0] * pressure[:, 2] - (forces - pressure)[:, 2] * pressure[:, 0]
    return np.divide(along, size, out=np.zeros(len(size)), where=size > 0.0)
