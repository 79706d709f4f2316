"""The surroundings of the reference point, registered image by image.

A network places the reference point a little differently in every light and before every background, and all key points
of the jaw would share the error. What surrounds the point is rigid and does not change: how far it has slid since the
first images is told ten times as exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.optional import import_cv2
from finforce_ifea.jaw.jaw import Jaw
from finforce_keypoints.geometry.jaw_pose import Origin
from finforce_keypoints.geometry.side_picture import PlaneGrid, map_picture, take_picture

SCALE = 0.25e-3  # [m] of a pixel of the patch
HALF = 20  # [px] of the patch's width and height
BLUR = 1.5  # [px] standard deviation; wide enough that a slide by a pixel is still linear
TEMPLATE_IMAGES = 30  # over which template and anchor are averaged
ITERATIONS = 5
SETTLED = 0.02  # [px] that a last iteration may move
FARTHEST = 2.0e-3  # [m] between the network's place and the registered one
LEAST_LIKENESS = 0.75  # correlation with the template, below which something else is seen
STDDEV = 0.04e-3  # [m] of a registered slide
_INNER = (slice(3, -3), slice(3, -3))  # the border's gradients are one-sided
FORGOTTEN_AFTER = 15  # images in a row without likeness: the light or the thing itself has changed


@dataclass(frozen=True, kw_only=True)
class Slide:
    """How a patch lies beside the template.

    Attributes:
        x: way along the jaw's x [px].
        likeness: their correlation, brightness and contrast aside.
    """

    x: float
    likeness: float


class ReferencePatch:
    """Follows the reference point of one jaw by what surrounds it.

    Args:
        jaw: whose reference point lies on its side.
    """

    def __init__(self, jaw: Jaw) -> None:
        x, self._side_y, z = jaw.reference_point
        size = 2 * HALF + 1
        self._grid = PlaneGrid(scale=SCALE, x=x - HALF * SCALE, z=z - HALF * SCALE, width=size, height=size)
        self._sign = 1.0 if jaw.side == "left" else -1.0
        self.reset()

    def reset(self) -> None:
        """Forget the template."""
        self._template: NDArray | None = None
        self._matcher: PatchMatcher | None = None
        self._count, self._anchor, self._unlike = 0, 0.0, 0

    @property
    def is_learnt(self) -> bool:
        """Whether the template is one of enough images, so that it changes no more."""
        return self._count >= TEMPLATE_IMAGES

    def refine(
        self, color: NDArray, camera: CameraIntrinsics, measured: Origin, place: Callable[[Origin], NDArray]
    ) -> Origin:
        """Return where the jaw is by its patch, or as it was measured where the patch does not show it.

        Args:
            color: image (h, w, 3) uint8.
            camera: its intrinsics.
            measured: origin that the network's reference point shows.
            place: origin to T_camera_jaw (4, 4).
        """
        if self._template is None:
            self._template, self._count = self._take(color, camera, place(measured)), 1
            return measured
        found = self._register(color, camera, measured, place)
        if found is None:
            self._unlike += 1
            if self._unlike >= FORGOTTEN_AFTER:
                self.reset()
            return measured
        self._unlike = 0
        if self._count < TEMPLATE_IMAGES:
            self._learn(self._take(color, camera, place(found)), measured.x - found.x)
        return Origin(x=found.x + self._anchor, stddev=STDDEV)

    def _learn(self, patch: NDArray, off: float) -> None:
        """Average template and anchor with one more image, its patch taken where it was found."""
        share = 1.0 / (self._count + 1)
        self._template += share * (patch - self._template)
        self._anchor += share * (off - self._anchor)
        self._count += 1
        self._matcher = None

    def _register(
        self, color: NDArray, camera: CameraIntrinsics, measured: Origin, place: Callable[[Origin], NDArray]
    ) -> Origin | None:
        """Return the origin, without the anchor, at which the patch is the template; None when it is nowhere near."""
        x = measured.x - self._anchor
        self._matcher = self._matcher or build_matcher(self._template)
        for _ in range(ITERATIONS):
            slide = self._matcher.match(self._take(color, camera, place(Origin(x=x, stddev=0.0))))
            step = self._sign * slide.x * SCALE
            x += step
            if abs(x + self._anchor - measured.x) > FARTHEST or not np.isfinite(x):
                return None
            if abs(slide.x) < SETTLED:
                return Origin(x=x, stddev=STDDEV) if slide.likeness >= LEAST_LIKENESS else None
        return None

    def _take(self, color: NDArray, camera: CameraIntrinsics, T_camera_jaw: NDArray) -> NDArray:
        """Return the patch (h, w) of a jaw at a place, smoothed."""
        picture = take_picture(color, map_picture(self._grid, float(self._side_y), T_camera_jaw, camera))
        grey = picture.astype(np.float32).mean(axis=2)
        return import_cv2().GaussianBlur(grey, (0, 0), BLUR).astype(np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class PatchMatcher:
    """Tells by how much patches have slid against one template, by least squares to first order in the slide s.

    patch = a template - a (s_x d_x + s_z d_z) template + b

    Attributes:
        columns: (n, 4) d_x template, d_z template, template and 1 of the inner pixels.
        inverse: (4, n) that gives -a s_x, -a s_z, a and b of a patch.
    """

    columns: NDArray
    inverse: NDArray

    def match(self, patch: NDArray) -> Slide:
        """Return by how much a patch (h, w) has slid."""
        values = patch[_INNER].ravel()
        slope_x, _, gain, _ = self.inverse @ values
        if not gain > 0.0:
            return Slide(x=0.0, likeness=0.0)
        template = self.columns[:, 2]
        seen, known = values - values.mean(), template - template.mean()
        likeness = float(seen @ known / max(np.linalg.norm(seen) * np.linalg.norm(known), 1e-9))
        return Slide(x=float(-slope_x / gain), likeness=likeness)


def build_matcher(template: NDArray) -> PatchMatcher:
    """Return what compares patches with a template (h, w)."""
    by_z, by_x = np.gradient(template)
    values = template[_INNER].ravel()
    columns = np.column_stack([by_x[_INNER].ravel(), by_z[_INNER].ravel(), values, np.ones(values.size)])
    normal = columns.T @ columns + 1e-6 * np.eye(4)
    return PatchMatcher(columns=columns, inverse=np.linalg.solve(normal, columns.T))
