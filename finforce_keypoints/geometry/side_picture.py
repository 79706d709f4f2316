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
from finforce_keypoints.geometry.kernels import map_side, project_side

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

COARSE = 4  # [px] between the places that are projected exactly; between them a line is right within 0.04 px


@dataclass(frozen=True, kw_only=True)
class PlaneGrid:
    """Where the pixels of a picture lie on the side plane.

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
    return project_side(camera.lens, np.ascontiguousarray(T_camera_jaw, dtype=float), side.numbers, places)


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
    return map_side(camera.lens, T, side.numbers, place, grid.width, grid.height, COARSE)


def take_picture(image: NDArray, mapping: NDArray) -> NDArray:
    """Return the picture (height, width, 3) of an image (h, w, 3) uint8 by the map of `map_picture`; black outside."""
    from finforce.optional import import_cv2

    cv2 = import_cv2()
    return cv2.remap(image, mapping, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0, 0, 0))
