"""How well the ribs and cells of a finger explain what a picture shows at a place.

Outlines hardly change when a finger is one rib further along itself, and a network finds a rib wherever there is one.
Distances and directions of all ribs together fit at one place only: pitch and slant change along the finger, and a
stretch by a twentieth puts the ribs at one end into the cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.optional import import_cv2
from finforce_keypoints.geometry.side_picture import find_side, project_side
from finforce_keypoints.geometry.template import draw_template, find_shape, fit_grid

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

EVERY = 2  # [px] of the network's pictures between samples each way: a third of a thin rib's distance to the next
# Powers of x and z of the shading that is no pattern: it changes over the whole finger, ribs within a tenth of it.
ORDERS = [(i, j) for i in range(4) for j in range(9 - 2 * i)]
NOISE = 2.0  # variance [of 255 squared] that a camera adds to each colour
USUAL = 3.0  # median deviations from their median, of colours beyond which a picture is taken to show something else
# Weight of an outline in that of ribs: what it tells apart is four times as large as a rib, at least.
OUTLINE = 0.25
LEAST_SAMPLES = 100  # of an open part: fewer tell nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Open:
    """The part of a finger that no holder covers.

    Attributes:
        places: x and z of its samples (n, 2) [m].
        smooth: (n, m) orthonormal, what light and shadow can be.
        pattern: (n,) how much material is there, without what is smooth; of length 1.
    """

    places: NDArray
    smooth: NDArray
    pattern: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Moments:
    """What the colours of one picture have in common with the pattern, and with each other.

    Attributes:
        along: (3,).
        among: (3, 3), with a trace of 1.
        share: of the samples that lie in the picture.
    """

    along: NDArray
    among: NDArray
    share: float = 1.0


class RibPattern:
    """The pattern of ribs and cells on the side of a jaw.

    Args:
        jaw: whose side it is.
        edges: directions (2,) on the side, and how far along them the holder reaches [m].
    """

    def __init__(self, jaw: Jaw, edges: Sequence[tuple[NDArray, float]]) -> None:
        cv2, shape = import_cv2(), find_shape(jaw)
        grid = fit_grid(shape)
        self._side = find_side(jaw)
        material = cv2.GaussianBlur(draw_template(shape, grid)[..., 0].astype(float), (0, 0), 1.0)
        filled = np.zeros(material.shape, np.uint8)
        for ring in shape.rings:
            cv2.fillPoly(filled, [np.round(16.0 * grid.pixels(ring)).astype(np.int32)], 1, shift=4)
        rows, columns = np.nonzero(filled[::EVERY, ::EVERY])
        places = grid.places(EVERY * np.column_stack((columns, rows)))
        held = places[:, 1] <= shape.clamped_z
        self._places, self._material = places[~held], material[EVERY * rows, EVERY * columns][~held]
        self.opens = [self._open(across, edge) for across, edge in edges]

    def _open(self, across: NDArray, edge: float) -> Open:
        there = self._places @ across > edge
        places, pattern = self._places[there], self._material[there]
        low, high = self._places.min(axis=0), self._places.max(axis=0)
        x, z = (2.0 * (places - low) / (high - low) - 1.0).T
        smooth = np.linalg.qr(np.column_stack([x**i * z**j for i, j in ORDERS]))[0]
        pattern = pattern - smooth @ (smooth.T @ pattern)
        if len(places) < LEAST_SAMPLES:
            pattern = np.zeros(len(places))
        return Open(places=places, smooth=smooth, pattern=pattern / max(float(np.linalg.norm(pattern)), 1.0))

    def compare(
        self,
        color: NDArray,
        T_camera_jaw: NDArray,
        camera: CameraIntrinsics,
        edge: int,
        move: Callable[[NDArray], NDArray] | None = None,
    ) -> Moments:
        """Return the moments of an image (h, w, 3) with the jaw at T_camera_jaw (4, 4) in a camera.

        Args:
            color: RGB.
            T_camera_jaw: pose of the jaw.
            camera: intrinsics.
            edge: number of the holder's edge.
            move: where places (n, 2) of the side [m] lie instead.
        """
        samples = self.sample(color, T_camera_jaw, camera, edge, move)
        count = np.count_nonzero(samples[:, 3])
        share = count / max(len(samples), 1)
        if count < LEAST_SAMPLES:
            return Moments(along=np.zeros(3), among=np.eye(3) / 3.0, share=share)
        moments = samples.T @ samples
        among = moments[:3, :3] + NOISE * count * np.eye(3)
        trace = float(np.trace(among))
        along = moments[:3, 3] / np.sqrt(trace * max(float(moments[3, 3]), 1e-9))
        return Moments(along=along, among=among / trace, share=share)

    def sample(
        self,
        color: NDArray,
        T_camera_jaw: NDArray,
        camera: CameraIntrinsics,
        edge: int,
        move: Callable[[NDArray], NDArray] | None = None,
    ) -> NDArray:
        """Return red, green, blue and pattern (n, 4) without what is smooth, 0 where the image does not show it.

        The arguments are those of `compare`.
        """
        part = self.opens[edge]
        places = np.ascontiguousarray(part.places if move is None else move(part.places), dtype=float)
        T = np.ascontiguousarray(T_camera_jaw, dtype=float)
        values, inside = _sample(color, project_side(camera.lens, T, self._side.numbers, places), part.pattern)
        count = np.count_nonzero(inside)
        if count:  # a holder, a screw or a pocket is not worth more than ribs
            middle = np.median(values[inside, :3], axis=0)
            reach = USUAL * np.median(np.abs(values[inside, :3] - middle), axis=0) + 1.0
            values[:, :3] = np.clip(values[:, :3], middle - reach, middle + reach) * inside[:, None]
        if count < len(places):  # of all samples the smooth functions are orthonormal, of a part of them not quite
            smooth = part.smooth * inside[:, None]
            size = smooth.T @ smooth + 1e-6 * np.eye(smooth.shape[1])
            return values - smooth @ np.linalg.solve(size, smooth.T @ values)
        return values - part.smooth @ (part.smooth.T @ values)


@njit(cache=True, error_model="numpy", nogil=True)
def _sample(color, pixels, pattern):
    """Return colours and pattern (n, 4) of samples at pixels (n, 2) of an image (h, w, 3), and which lie in it (n,)."""
    height, width = color.shape[:2]
    values, inside = np.zeros((len(pixels), 4)), np.zeros(len(pixels), np.bool_)
    for i in range(len(pixels)):
        x, y = pixels[i]
        if x >= 0.0 and y >= 0.0 and x < width - 1 and y < height - 1:
            inside[i], column, row = True, int(x), int(y)
            u, v = x - column, y - row
            for k in range(3):
                upper = (1.0 - u) * color[row, column, k] + u * color[row, column + 1, k]
                lower = (1.0 - u) * color[row + 1, column, k] + u * color[row + 1, column + 1, k]
                values[i, k] = (1.0 - v) * upper + v * lower
            values[i, 3] = pattern[i]
    return values, inside


def correlate(moments: Sequence[Moments]) -> float:
    """Return the correlation, 0 to 1, of the pattern with that mixture of the colours that it goes with best.

    The finger is of one colour: of all mixtures w, the one is taken that is best for all pictures together,
    r = w . m / sqrt(w G w) with m the mean of what they have in common with the pattern and G of what among each other.
    """
    along = np.mean([each.along for each in moments], axis=0)
    among = np.mean([each.among for each in moments], axis=0)
    return float(np.sqrt(max(along @ np.linalg.solve(among, along), 0.0)))


def subtract_pattern(samples: Sequence[NDArray]) -> NDArray:
    """Return what that mixture of colours that goes best with the pattern leaves of it in each picture.

    Args:
        samples: of pictures (n, 4), see `RibPattern.sample`.
    """
    scaled = []
    for each in samples:
        size = np.linalg.norm(each[:, :3]) + np.sqrt(NOISE * len(each)), max(float(np.linalg.norm(each[:, 3])), 1e-9)
        scaled.append(each / np.array([size[0]] * 3 + [size[1]]))
    values = np.concatenate(scaled) / np.sqrt(len(scaled))
    colours, pattern = values[:, :3], values[:, 3]
    return pattern - colours @ np.linalg.solve(colours.T @ colours + 1e-3 * np.eye(3) / 3.0, colours.T @ pattern)


def weigh_evidence(moments: Sequence[Moments], samples: int, outline: float = 0.0) -> float:
    """Return the logarithm of how much likelier a pattern makes a picture's colours than chance.

    Args:
        moments: of the pictures with the pattern.
        samples: their number.
        outline: share of the outline's variance that the colours explain, see `OutlineContrast`.
    """
    shown = samples * float(np.mean([each.share for each in moments]))
    explained = min(correlate(moments), 0.999) ** 2, float(np.clip(outline, 0.0, 0.999))
    return -0.5 * shown * float(np.log1p(-explained[0]) + OUTLINE * np.log1p(-explained[1]))
