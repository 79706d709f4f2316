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
from finforce_keypoints.geometry.side_picture import project_side, find_side
from finforce_keypoints.geometry.template import draw_template, find_shape, fit_grid

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

EVERY = 2  # [px] of the network's pictures between samples each way: a third of a thin rib's distance to the next
# Powers of x and z of the shading that is no pattern: it changes over the whole finger, ribs within a tenth of it.
ORDERS = [(i, j) for i in range(4) for j in range(9 - 2 * i)]
NOISE = 2.0  # variance [of 255 squared] that a camera adds to each colour
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
        part = self.opens[edge]
        places = np.ascontiguousarray(part.places if move is None else move(part.places), dtype=float)
        T = np.ascontiguousarray(T_camera_jaw, dtype=float)
        pixels = project_side(camera.lens, T, self._side.numbers, places)
        moments, shading, size, count = _sum_moments(color, pixels, part.smooth, part.pattern)
        share = count / max(len(places), 1)
        if count < LEAST_SAMPLES:
            return Moments(along=np.zeros(3), among=np.eye(3) / 3.0, share=share)
        if count < len(places):  # of all samples the smooth functions are orthonormal, of a part of them not quite
            moments = moments - shading.T @ np.linalg.solve(size + 1e-6 * np.eye(len(size)), shading)
        else:
            moments = moments - shading.T @ shading
        among = moments[:3, :3] + NOISE * count * np.eye(3)
        trace = float(np.trace(among))
        along = moments[:3, 3] / np.sqrt(trace * max(float(moments[3, 3]), 1e-9))
        return Moments(along=along, among=among / trace, share=share)


@njit(cache=True, error_model="numpy", nogil=True)
def _sum_moments(color, pixels, smooth, pattern):
    """Return sums over the samples that lie in an image: colours and pattern with themselves (4, 4), with the smooth
    functions (m, 4), these with each other (m, m) where samples are missing, and how many there are.

    Args:
        color: (h, w, 3) uint8.
        pixels: of the samples (n, 2).
        smooth: (n, m).
        pattern: (n,).
    """
    height, width = color.shape[:2]
    kinds = smooth.shape[1]
    moments, shading, size = np.zeros((4, 4)), np.zeros((kinds, 4)), np.zeros((kinds, kinds))
    inside = np.zeros(len(pixels), np.bool_)
    values = np.empty(4)
    for i in range(len(pixels)):
        x, y = pixels[i]
        if not (x >= 0.0 and y >= 0.0 and x < width - 1 and y < height - 1):
            continue
        inside[i] = True
        column, row = int(x), int(y)
        u, v = x - column, y - row
        for k in range(3):
            upper = (1.0 - u) * color[row, column, k] + u * color[row, column + 1, k]
            lower = (1.0 - u) * color[row + 1, column, k] + u * color[row + 1, column + 1, k]
            values[k] = (1.0 - v) * upper + v * lower
        values[3] = pattern[i]
        for a in range(4):
            for b in range(4):
                moments[a, b] += values[a] * values[b]
        for m in range(kinds):
            for a in range(4):
                shading[m, a] += smooth[i, m] * values[a]
    count = inside.sum()
    if count < len(pixels):
        for i in range(len(pixels)):
            if inside[i]:
                for m in range(kinds):
                    for n in range(kinds):
                        size[m, n] += smooth[i, m] * smooth[i, n]
    return moments, shading, size, count


def correlate(moments: Sequence[Moments]) -> float:
    """Return the correlation, 0 to 1, of the pattern with that mixture of the colours that it goes with best.

    The finger is of one colour: of all mixtures w, the one is taken that is best for all pictures together,
    r = w . m / sqrt(w G w) with m the mean of what they have in common with the pattern and G of what among each other.
    """
    along = np.mean([each.along for each in moments], axis=0)
    among = np.mean([each.among for each in moments], axis=0)
    return float(np.sqrt(max(along @ np.linalg.solve(among, along), 0.0)))


def weigh_evidence(moments: Sequence[Moments], samples: int) -> float:
    """Return the logarithm of how much likelier a pattern of so many samples makes a picture's colours than chance."""
    shown = samples * float(np.mean([each.share for each in moments]))
    return -0.5 * shown * float(np.log1p(-min(correlate(moments), 0.999) ** 2))
