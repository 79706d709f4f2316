"""What a depth image says about points where an object's surface should be."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, check_depth, check_mask, compute_rays, project, rays_from_pixels

# With fewer pixels of the object, any pose agrees with any image.
LEAST_PIXELS = 30


class Visibility(IntEnum):
    """What the image says about one point of the surface."""

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
        """Returns the same samples in the frame a of a pose T_a_b (4, 4), these being in b."""
        return Samples(points=self.points @ T[:3, :3].T + T[:3, 3], directions=self.directions @ T[:3, :3].T)


@dataclass(frozen=True, kw_only=True, eq=False)
class Glance:
    """What should be seen of an object in one pose, on the grid of every `step`-th pixel.

    Attributes:
        depth: grid of depths (h, w) [m], NaN beside the object.
        surface: what is seen of the surface, camera frame.
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
        sights: (n,) of type `Visibility`.
    """

    residuals: NDArray
    sights: NDArray

    def count(self, sight: Visibility) -> int:
        """Returns how many samples have this sight."""
        return int(np.count_nonzero(self.sights == sight))


class DepthImage:
    """A checked depth image, with the mask of the object where there is one.

    Attributes:
        depth: (h, w) [m], NaN where nothing was measured.
        mask: (h, w) bool, or None.
        camera: its intrinsics.
    """

    def __init__(self, depth: NDArray, camera: CameraIntrinsics, mask: NDArray | None = None) -> None:
        """Takes an image.

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
        self._rays = compute_rays(camera)

    def ray(self, pixel: NDArray) -> NDArray:
        """Returns the viewing ray (3,) with z = 1 of one pixel (2,), which may lie outside the image."""
        return rays_from_pixels(pixel[None], self.camera)[0]

    def look(self, pixels: NDArray) -> NDArray:
        """Returns the depths (...,) [m] at pixels (..., 2), NaN where there is none or outside the image."""
        column, row, inside = self._nearest(pixels)
        return np.where(inside, self.depth[row, column], np.nan)

    def is_masked_out(self, pixels: NDArray) -> NDArray:
        """Returns where (...,) the mask says that pixels (..., 2) are not the object; nowhere without a mask."""
        if self.mask is None:
            return np.zeros(pixels.shape[:-1], bool)
        column, row, inside = self._nearest(pixels)
        return inside & ~self.mask[row, column]

    def compare_surface(self, surface: Samples, gate: float) -> Comparison:
        """Compares points of a surface with the depths at their pixels.

        residual = n . (q - p) for a point p with normal n and the point q measured on the ray next to p. The point
        counts as seen where |residual| is below the gate, and the depth itself no farther off than twice the gate:
        a plate in front of a surface that is seen from the side is near its plane, too.

        Args:
            surface: samples in the camera frame.
            gate: [m].
        """
        pixels = project(surface.points, self.camera)
        column, row, inside = self._nearest(pixels)
        depth = np.where(inside, self.depth[row, column], np.nan)
        measured = self._rays[row, column] * depth[:, None]
        residuals = np.einsum("ij,ij->i", surface.directions, measured - surface.points)
        foreign = self.is_masked_out(pixels)
        sights = np.where(depth < surface.points[:, 2], Visibility.HIDDEN, Visibility.ABSENT)
        sights[np.isnan(depth) & ~foreign] = Visibility.UNKNOWN
        near = (np.abs(residuals) < gate) & (np.abs(depth - surface.points[:, 2]) < 2.0 * gate)
        sights[near & ~foreign] = Visibility.SEEN
        return Comparison(residuals=np.where(sights == Visibility.SEEN, residuals, np.nan), sights=sights)

    def _nearest(self, pixels: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        known = np.isfinite(pixels).all(axis=-1)
        whole = np.rint(np.where(known[..., None], pixels, -1.0)).astype(np.intp)
        column, row = whole[..., 0], whole[..., 1]
        inside = (column >= 0) & (column < self.camera.width) & (row >= 0) & (row < self.camera.height)
        return np.where(inside, column, 0), np.where(inside, row, 0), inside
