"""Pictures of a jaw's side plane, square to it and to scale whatever the camera's place and lens.

The key points lie on the side of the jaw that looks at the camera, a plane near y = const of the jaw frame. The column
c and the row r of the picture are x = x_0 + c s and z = z_0 + r s on it; left and right jaw look alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, rays_from_pixels
from finforce.compiled import njit
from finforce.lens import project_point
from finforce.optional import import_cv2

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

COARSE = 4  # [px] between the places that are projected exactly; between them a line is right within 0.04 px
OUTSIDE = -1e4  # [px] where what the camera does not see is taken
_OPTIONS = {"cache": True, "error_model": "numpy", "nogil": True}


@dataclass(frozen=True, kw_only=True)
class PlaneGrid:
    """The positions of the pixels of a picture on the side plane.

    Attributes:
        scale: size of a pixel [m].
        x: of the centre of the first column, jaw frame [m].
        z: of the centre of the first row [m].
        width: number of columns.
        height: number of rows.
    """

    scale: float = 0.45e-3
    x: float = -0.036
    z: float = -0.012
    width: int = 176
    height: int = 224

    def padded(self, margin: int) -> PlaneGrid:
        """Return the grid with a margin [px] on every side."""
        return PlaneGrid(
            scale=self.scale,
            x=self.x - margin * self.scale,
            z=self.z - margin * self.scale,
            width=self.width + 2 * margin,
            height=self.height + 2 * margin,
        )

    def shifted(self, shift: NDArray) -> PlaneGrid:
        """Return the grid that begins `shift` (2,) [px] later along columns and rows."""
        return replace(self, x=self.x + float(shift[0]) * self.scale, z=self.z + float(shift[1]) * self.scale)

    def places(self, pixels: NDArray) -> NDArray:
        """Return x and z (n, 2) [m] of pixels (n, 2) of the picture, column and row."""
        return np.array([self.x, self.z]) + self.scale * np.asarray(pixels, dtype=float)

    def pixels(self, places: NDArray) -> NDArray:
        """Return the pixels (n, 2) of the picture at x and z (n, 2) [m]."""
        return (np.asarray(places, dtype=float) - (self.x, self.z)) / self.scale


@dataclass(frozen=True, kw_only=True, eq=False)
class SidePlane:
    """The side of a finger that its key points lie on; a tapered finger's is slanted.

    Attributes:
        level: y at x = z = 0 of the jaw frame [m].
        slope: change of y along x and z (2,) [m/m].
    """

    level: float
    slope: NDArray = field(default_factory=lambda: np.zeros(2))

    def at(self, places: NDArray) -> NDArray:
        """Return the y (...,) [m] of the side at x and z (..., 2) [m]."""
        return self.level + np.asarray(places) @ self.slope

    def points(self, places: NDArray) -> NDArray:
        """Return the points (n, 3) [m] of the side at x and z (n, 2) [m]."""
        return np.insert(np.asarray(places, dtype=float), 1, self.at(places), axis=1)

    @property
    def numbers(self) -> NDArray:
        """Level [m] and slopes (3,)."""
        return np.array([self.level, *self.slope])


def find_side(jaw: Jaw) -> SidePlane:
    """Return the plane of least squares through a jaw's key points, level across what they do not tell."""
    middle = jaw.keypoints.mean(axis=0)
    away = jaw.keypoints - middle
    slope = np.linalg.lstsq(away[:, [0, 2]], away[:, 1], rcond=1e-3)[0]
    return SidePlane(level=float(middle[1] - slope @ middle[[0, 2]]), slope=slope)


def project_plane(places: NDArray, side: SidePlane, T_camera_jaw: NDArray, camera: CameraIntrinsics) -> NDArray:
    """Return the image pixels (n, 2) of places x, z (n, 2) [m] on a jaw's side."""
    places = np.ascontiguousarray(places, dtype=float)
    return _project_side(camera.lens, np.ascontiguousarray(T_camera_jaw, dtype=float), side.numbers, places)


@njit(**_OPTIONS)
def _project_side(lens, T, side, places):
    """Return the pixels (n, 2) of places x, z (n, 2) [m] on a side (level, slopes) (3,) of a jaw at T (4, 4)."""
    pixels = np.empty(places.shape)
    for i in range(len(places)):
        x, z = places[i, 0], places[i, 1]
        y = side[0] + side[1] * x + side[2] * z
        pixels[i, 0], pixels[i, 1] = project_point(
            lens,
            T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
            T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
            T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
        )
    return pixels


def intersect_plane(pixels: NDArray, side: SidePlane, T_camera_jaw: NDArray, camera: CameraIntrinsics) -> NDArray:
    """Return x and z (n, 2) [m] where the rays of image pixels (n, 2) meet a jaw's side.

    With n the plane's normal, whose part along y is 1, and o the jaw's origin, both in the camera frame, and l its
    level: t = (n . o + l) / n . ray.
    """
    rays = rays_from_pixels(pixels, camera)
    R, origin = T_camera_jaw[:3, :3], T_camera_jaw[:3, 3]
    normal = R @ np.array([-side.slope[0], 1.0, -side.slope[1]])
    points = rays * ((normal @ origin + side.level) / (rays @ normal))[:, None]
    return ((points - origin) @ R)[:, [0, 2]]


def map_picture(
    grid: PlaneGrid, side: SidePlane, T_camera_jaw: NDArray, camera: CameraIntrinsics
) -> NDArray[np.float32]:
    """Return the image column and row (height, width, 2) at which each pixel of a picture is taken.

    Parts of the plane that the camera does not see come from outside the image.
    """
    place = np.array([grid.scale, grid.x, grid.z])
    T = np.ascontiguousarray(T_camera_jaw, dtype=float)
    return _map_side(camera.lens, T, side.numbers, place, grid.width, grid.height)


@njit(**_OPTIONS)
def _map_side(lens, T, side, grid, width, height):
    """Return the image column and row (height, width, 2) float32 at which the pixels of a picture of a side are taken.

    Every `COARSE`-th pixel is projected, those between are on a line.

    Args:
        lens: see `finforce.lens.project_point`.
        T: T_camera_jaw (4, 4).
        side: level [m] and slopes (3,).
        grid: pixel size, x and z of the first pixel (3,) [m].
        width: of the picture [px].
        height: of the picture [px].
    """
    rows, columns = (height - 1) // COARSE + 2, (width - 1) // COARSE + 2
    places = np.empty((rows * columns, 2))
    for knot in range(rows * columns):
        places[knot, 0] = grid[1] + grid[0] * COARSE * (knot % columns)
        places[knot, 1] = grid[2] + grid[0] * COARSE * (knot // columns)
    exact = _project_side(lens, T, side, places)
    knots = np.empty((rows, columns, 2), np.float32)
    for knot in range(rows * columns):
        for k in range(2):
            seen = np.isfinite(exact[knot, k])
            knots[knot // columns, knot % columns, k] = exact[knot, k] if seen else OUTSIDE
    return _fill_between(knots, width, height)


@njit(**_OPTIONS)
def _fill_between(knots, width, height):
    """Return values (height, width, 2) float32 on lines between knots (rows, columns, 2) that are `COARSE` apart."""
    filled = np.empty((height, width, 2), np.float32)
    line = np.empty(knots.shape[1:], np.float32)
    for r in range(height):
        i, down = r // COARSE, np.float32((r % COARSE) / COARSE)
        for j in range(len(line)):
            for k in range(2):
                line[j, k] = knots[i, j, k] + down * (knots[i + 1, j, k] - knots[i, j, k])
        for c in range(width):
            j, across = c // COARSE, np.float32((c % COARSE) / COARSE)
            for k in range(2):
                filled[r, c, k] = line[j, k] + across * (line[j + 1, k] - line[j, k])
    return filled


def take_picture(image: NDArray, mapping: NDArray) -> NDArray:
    """Return the picture (height, width, 3) of an image (h, w, 3) uint8 by the map of `map_picture`; black outside."""
    cv2 = import_cv2()
    return cv2.remap(image, mapping, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0, 0, 0))
