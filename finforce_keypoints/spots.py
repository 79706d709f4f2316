"""How the grey values around a jaw's key points answer to its motion and to the light; knows no network and no time.

Around every key point, what a picture differs by from a mean picture m is explained by what light does (gain and
brightness) and by what a jaw does: a shift along its x, one that grows with the height h and one with its square, and a
shift along its z; all of them small.

    d = g m + b - (c_0 + c_1 h + c_2 h^2) dm/dx - c_3 dm/dz + noise

The least squares c say how far each key point has gone; that is a length, and so is what may be missed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce_camera import CameraIntrinsics, project

if TYPE_CHECKING:
    from finforce_keypoints.jaw_localizer import JawKeypoints

LEAST_POINTS = 8  # valid key points that a jaw needs
HALVES = (5, 10)  # [px] of the patch around a key point, larger where little is to be seen; gradients need one more
INNER = (slice(None), slice(1, -1), slice(1, -1))  # of patches (n, s, s), without what the gradients need
_LENGTH = 1e-3  # [m] in which shifts are solved for
_ALIKE = 1.7  # by which shifts err more than from noise that no neighbours share; seen on twin images
_RIDGE = 1e-3  # keeps a picture without any contrast regular


@dataclass(frozen=True, kw_only=True, eq=False)
class JawSpots:
    """The patches of one jaw, and how its places move in the picture.

    Attributes:
        pixels: (n, s, s) places of the patches in the flat picture [px].
        along_x: (n, 2) pixels by which a key point moves along the jaw's x [px/m].
        along_z: (n, 2) the same along its z.
        powers: (n, 3) 1, h and h^2 of the key points' heights, the highest one's being 1.
    """

    pixels: NDArray
    along_x: NDArray
    along_z: NDArray
    powers: NDArray

    def reach(self, shifts: NDArray) -> NDArray:
        """Return how far shifts (4,) [m] move the key points along x, (n,), and all of them along z: (n + 1,) [m]."""
        return np.abs(np.append(self.powers @ shifts[:3], shifts[3]))

    def solve(self, mean: NDArray, square: NDArray) -> SpotModel:
        """Return what answers for the differences from a mean picture.

        Args:
            mean: (n, s, s) of the patches.
            square: (n,) mean square around each key point of what is left in pictures of a jaw that stands still.
        """
        by_row, by_column = np.gradient(mean, axis=(1, 2))
        slope_x, slope_z = (
            (by_column * way[:, 0, None, None] + by_row * way[:, 1, None, None])[INNER] * _LENGTH
            for way in (self.along_x, self.along_z)
        )
        inner = mean[INNER]
        shifts = -slope_x[..., None] * self.powers[:, None, None, :]
        columns = (inner / 100.0, np.ones_like(inner), *np.moveaxis(shifts, -1, 0), -slope_z)
        design = np.stack(columns, axis=-1).reshape(-1, len(columns))
        covariance = np.linalg.inv(design.T @ design + _RIDGE * np.eye(len(columns)))
        along_x = np.einsum("ij,jk,ik->i", self.powers, covariance[2:5, 2:5], self.powers)
        spread = np.append(along_x, covariance[5, 5])
        return SpotModel(
            mean=inner.ravel(),
            design=design,
            inverse=covariance @ design.T,
            square=square,
            errors=_LENGTH * _ALIKE * np.sqrt(spread * square.mean()),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class SpotModel:
    """What answers for the differences d (N,) of a picture from a mean one (N,): d = design @ c, (N, 6).

    Attributes:
        mean: (N,) grey values.
        design: (N, 6) of gain, brightness, three shifts along x and one along z.
        inverse: (6, N) c = inverse @ d.
        square: (n,) mean square of what is left around each key point while nothing moves.
        errors: (n + 1,) standard deviations of the key points' shifts along x, then of the one along z [m].
    """

    mean: NDArray
    design: NDArray
    inverse: NDArray
    square: NDArray
    errors: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """How one jaw differs from its mean picture: shifts (4,) [m], what is left around each key point (n,)."""

    shifts: NDArray
    left: NDArray


def look_at(values: NDArray, model: SpotModel) -> Look:
    """Return how the grey values (N,) of a jaw differ from those of a model."""
    away = values - model.mean
    answer = model.inverse @ away
    left = away - model.design @ answer
    return Look(shifts=_LENGTH * answer[2:], left=np.square(left).reshape(len(model.square), -1).mean(axis=1))


def place_spots(found: JawKeypoints, camera: CameraIntrinsics, half: int = HALVES[0]) -> JawSpots | None:
    """Return where a jaw is watched, None where too few of its key points are seen well inside the image.

    Args:
        found: its key points.
        camera: that saw them.
        half: of the patches' width and height [px].
    """
    size = np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):
        inside = ((found.pixels > half + 1) & (found.pixels < size - half - 2)).all(axis=1)
    kept = found.valid & inside
    if kept.sum() < LEAST_POINTS:
        return None
    points, T = found.points[kept], found.T_camera_jaw
    start, beside, above = (
        project((points + step) @ T[:3, :3].T + T[:3, 3], camera)
        for step in np.array([[0.0, 0.0, 0.0], [_LENGTH, 0.0, 0.0], [0.0, 0.0, _LENGTH]])
    )
    steps = np.arange(-half - 1, half + 2)
    around = np.stack(np.meshgrid(steps, steps), axis=-1)
    places = np.rint(found.pixels[kept]).astype(np.intp)[:, None, None] + around
    height = points[:, 2] / points[:, 2].max()
    return JawSpots(
        pixels=places[..., 1] * camera.width + places[..., 0],
        along_x=(beside - start) / _LENGTH,
        along_z=(above - start) / _LENGTH,
        powers=height[:, None] ** np.arange(3),
    )
