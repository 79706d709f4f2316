"""The match of the ribs, the cells and the tip of a finger with a picture, at a position and beside it.

A network finds a rib wherever there is one, and the outline of a finger hardly changes when it is one rib further along
itself. Two measures tell such places apart: the correlation of ribs and cells with the picture, which is high at one
place only where the distance of the ribs changes along the finger, and the contrast at the tip.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.optional import import_cv2
from finforce_keypoints.geometry.side_picture import PlaneGrid, find_side, map_picture, project_plane, take_picture
from finforce_keypoints.geometry.template import SideShape, draw_template, find_shape

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

PER_PITCH = 7.0  # [px] between two ribs, in pictures of the side
SMOOTH = 0.5  # [pitches] standard deviation of what is taken for light and shadow
HUE = 0.13  # difference of the shares of red, green and blue of the finger and of what is before it
DARK = 30.0  # of 255: what is added to the brightness by which colours are divided
USUAL = 2.5  # standard deviations of brightness beyond which it is taken for something else than ribs
UPPER = 0.4  # share of the side, from the base, that holders may cover: what is above has the finger's colour
HIDDEN = 0.35  # share of the face, from the base, whose ribs holders usually hide
LEAST_SHOWN = 0.35  # share of the side that has to have the finger's colour
# Other places of a finger: stretched along itself, slanted by so much along its width, shifted along it [pitches] and
# across [lengths].
STRETCHES, SLANTS = np.linspace(-0.15, 0.15, 11), np.linspace(-0.48, 0.48, 13)
ALONG, ACROSS = 2.6, 0.03
TIP, AROUND = 0.3, 0.08  # [lengths] of the finger that counts as its tip, and of what surrounds it
BEYOND = 0.3  # share of the compared pixels outside the image, from which on nothing is said


@dataclass(frozen=True, kw_only=True, eq=False)
class RibScan:
    """The match of ribs and cells with a picture at many positions of a finger.

    Attributes:
        ribs: correlation by stretch, slant and shifts along and across the finger (s, k, n, m), positive where ribs are
            brighter than cells.
        along: shifts along the finger (n,) [m].
        across: shifts across it (m,) [m].
    """

    ribs: NDArray
    along: NDArray
    across: NDArray


class RibPattern:
    """Ribs, cells and tip on the side of a jaw.

    Attributes:
        pitch: median distance of the ribs along the face [m].
        middle: x and z of the point about which the finger is stretched and slanted (2,) [m].
        heights: z above it of the ribs on the face that no holder hides (r,) [m].

    Args:
        jaw: whose side it is.
    """

    def __init__(self, jaw: Jaw) -> None:
        cv2, shape = import_cv2(), find_shape(jaw)
        face = np.sort(jaw.keypoints[[name.startswith("inner") for name in jaw.keypoint_names], 2])
        self.pitch = float(np.median(np.diff(face)))
        self.side = find_side(jaw)
        points = np.vstack(shape.rings)
        low, high = points.min(axis=0), points.max(axis=0)
        length, scale = float(high[1] - low[1]), self.pitch / PER_PITCH
        base = np.array([low[0], max(low[1], shape.clamped_z)])
        self.middle = np.array([high[0], 0.35 * base[1] + 0.65 * high[1]])
        self.heights = face[face >= face[0] + HIDDEN * (face[-1] - face[0])] - self.middle[1]
        self._margin = np.array([round(ACROSS * length / scale), round(ALONG * PER_PITCH)])
        self._grid = _cover(base, high, scale)
        self._filled = _fill(shape, self._grid)
        material = draw_template(shape, self._grid)[..., 0].astype(np.float32) / 255.0
        self._pattern = _sharpen(cv2.GaussianBlur(material, (0, 0), 0.8), self._filled)
        upper = self._filled.copy()
        upper[: round(UPPER * len(upper))] = 0.0
        self._upper = np.pad(upper, [(each, each) for each in self._margin[::-1]]) > 0.0
        around = AROUND * length
        grid = _cover(np.array([low[0] - around, high[1] - TIP * length]), high + around, 1.5 * scale)
        inside = _fill(shape, grid)
        reach = max(round(around / grid.scale), 1)
        near = cv2.dilate(inside, np.ones((3, 3), np.uint8), iterations=reach) > 0.0
        rows, columns = np.nonzero(near)
        self._tip_places = grid.places(np.column_stack((columns, rows)))
        self._inside = cv2.GaussianBlur(inside, (0, 0), 1.0)[near].astype(float)
        self._inside -= self._inside.mean()

    def warp(self, stretch: float, slant: float, across: float, along: float) -> NDArray:
        """Return the affine map (2, 3) of x and z [m] of a finger that is stretched, slanted and shifted [m]."""
        linear = np.array([[1.0, 0.0], [slant, 1.0 + stretch]])
        return np.column_stack((linear, self.middle - linear @ self.middle + (across, along)))

    def rectify(self, color: NDArray, T_camera_jaw: NDArray, camera: CameraIntrinsics) -> tuple[NDArray, NDArray]:
        """Return what of an image's colours (h, w, 3) is sharp (r, c), and where it has the finger's colour (r, c)."""
        cv2 = import_cv2()
        grid = PlaneGrid(
            scale=self._grid.scale,
            x=self._grid.x - self._margin[0] * self._grid.scale,
            z=self._grid.z - self._margin[1] * self._grid.scale,
            width=self._grid.width + 2 * int(self._margin[0]),
            height=self._grid.height + 2 * int(self._margin[1]),
        )
        mapping = map_picture(grid, self.side, T_camera_jaw, camera)
        picture = take_picture(color, mapping).astype(np.float32)
        height, width = color.shape[:2]
        shown = ((mapping >= 0.0) & (mapping < (width - 1.0, height - 1.0))).all(axis=2)
        if not (shown & self._upper).any():
            return np.zeros(shown.shape, np.float32), np.zeros(shown.shape, np.float32)
        shares = picture / (picture.sum(axis=2, keepdims=True) + DARK)
        usual = np.median(shares[shown & self._upper], axis=0)
        alike = (shown & (np.abs(shares - usual) < HUE).all(axis=2)).astype(np.uint8)
        square = np.ones((3, 3), np.uint8)
        mask = cv2.erode(cv2.morphologyEx(alike, cv2.MORPH_CLOSE, square), square, borderValue=1).astype(np.float32)
        sharp = _sharpen(picture, mask)
        there = sharp[(mask > 0.0) & self._upper]
        colour = np.linalg.eigh(there.T @ there)[1][:, -1]
        colour = np.copysign(1.0, colour.sum()) * colour
        values = sharp @ colour.astype(np.float32)
        reach = USUAL * float(np.sqrt(np.mean((there @ colour) ** 2) + 1.0))
        return np.clip(values, -reach, reach), mask

    def scan(self, color: NDArray, T_camera_jaw: NDArray, camera: CameraIntrinsics) -> RibScan:
        """Return how well an image (h, w, 3) fits the jaw at a pose (4, 4) and at places beside it."""
        cv2 = import_cv2()
        values, mask = self.rectify(color, T_camera_jaw, camera)
        squares, grid = values**2, self._grid
        found = []
        for stretch, slant in product(STRETCHES, SLANTS):
            linear = self.warp(stretch, slant, 0.0, 0.0)
            offset = grid.pixels(linear[:, :2] @ (grid.x, grid.z) + linear[:, 2])
            moved = np.column_stack((linear[:, :2], offset)).astype(np.float32)
            size = (grid.width, grid.height)
            pattern, filled = (cv2.warpAffine(each, moved, size) for each in (self._pattern, self._filled))
            both = cv2.matchTemplate(values, pattern, cv2.TM_CCORR)
            seen = cv2.matchTemplate(squares, filled, cv2.TM_CCORR)
            drawn = cv2.matchTemplate(mask, pattern**2, cv2.TM_CCORR)
            share = cv2.matchTemplate(mask, filled, cv2.TM_CCORR) / max(float(self._filled.sum()), 1.0)
            ribs = both / np.sqrt(np.maximum(seen * drawn, 1e-3))
            found.append(np.where(share > LEAST_SHOWN, np.clip(ribs, -0.99, 0.99), 0.0))
        ribs = np.reshape(found, (len(STRETCHES), len(SLANTS), *found[0].shape))
        across, along = ((np.arange(2 * each + 1) - each) * grid.scale for each in self._margin)
        return RibScan(ribs=ribs, along=along, across=across)

    def contrast(self, color: NDArray, T_camera_jaw: NDArray, camera: CameraIntrinsics, warp: NDArray) -> float:
        """Return which share of the variance, inside or outside of the tip's outline, an image's colours explain.

        Args:
            color: (h, w, 3) uint8 RGB.
            T_camera_jaw: pose of the jaw (4, 4).
            camera: intrinsics.
            warp: affine map (2, 3) of x and z of the side to where they are looked for [m].
        """
        cv2, places = import_cv2(), self._tip_places @ warp[:, :2].T + warp[:, 2]
        pixels = np.nan_to_num(project_plane(places, self.side, T_camera_jaw, camera), nan=-1e4).astype(np.float32)
        colours = cv2.remap(color, pixels[:, None], None, cv2.INTER_LINEAR)[:, 0].astype(float)
        brightness = colours.sum(axis=1, keepdims=True)
        if (brightness == 0.0).mean() > BEYOND:
            return 0.0
        values = np.hstack((colours, 100.0 * colours[:, :2] / (brightness + DARK)))
        values -= values.mean(axis=0)
        along = values.T @ self._inside
        among = values.T @ values + 1e-2 * len(values) * np.eye(5)
        return float(along @ np.linalg.solve(among, along) / (self._inside @ self._inside))


def _sharpen(values: NDArray, mask: NDArray) -> NDArray[np.float32]:
    """Return values (h, w) or (h, w, k) without what is smooth within a mask (h, w), 0 beyond it."""
    cv2, sigma = import_cv2(), SMOOTH * PER_PITCH
    weight = mask if values.ndim == 2 else mask[..., None]
    share = np.maximum(cv2.GaussianBlur(mask, (0, 0), sigma), 1e-3)
    smooth = cv2.GaussianBlur(values * weight, (0, 0), sigma) / (share if values.ndim == 2 else share[..., None])
    return ((values - smooth) * weight).astype(np.float32)


def _cover(low: NDArray, high: NDArray, scale: float) -> PlaneGrid:
    """Return the grid of pixels of a size [m] that covers what lies between two corners (2,) [m]."""
    width, height = (np.ceil((high - low) / scale).astype(int) + 1).tolist()
    return PlaneGrid(scale=scale, x=float(low[0]), z=float(low[1]), width=width, height=height)


def _fill(shape: SideShape, grid: PlaneGrid) -> NDArray[np.float32]:
    """Return 1 in the outline of a finger, its cells among them, and 0 outside (height, width)."""
    filled = np.zeros((grid.height, grid.width), np.uint8)
    for ring in shape.rings:
        import_cv2().fillPoly(filled, [np.round(16.0 * grid.pixels(ring)).astype(np.int32)], 1, shift=4)
    return filled.astype(np.float32)
