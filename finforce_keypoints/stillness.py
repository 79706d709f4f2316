"""Whether the jaws stand as they did in the last images, so that their key points hold; knows no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce_keypoints.spots import HALVES, INNER, JawSpots, Look, look_at, place_spots

if TYPE_CHECKING:
    from finforce_camera import CameraIntrinsics
    from finforce_keypoints.jaw_localizer import JawKeypoints

LARGEST_SHIFT = 0.05e-3  # [m] of a key point in one image, up to which it has not moved
LARGEST_CREEP = 0.02e-3  # [m] the same, averaged over the last images
AVERAGED = 10  # images, over which a creep is averaged
SIGMA = 4.0  # standard deviations of a shift that noise explains, where that is more
LARGEST_ERROR = 0.02e-3  # [m] standard deviation of a shift, above which nobody can tell
STRANGEST = 3.0  # mean square of what is left around one key point by that of still images: more is another thing
JUDGED = 8  # images after which it shows whether the patches are large enough
LEAST_IMAGES = 15  # over which the mean is taken before it stands for anything
MOST_IMAGES = 60  # of which it is the mean at most; older ones fade
MOVED = 0.3e-3  # [m] of a jaw from one image to the next, which needs no look at its picture


class JawWatch:
    """Watches one jaw: the mean picture of its patches, and the mean of its key points over the same images.

    Args:
        found: its key points in the first image.
        spots: where it is watched.
    """

    def __init__(self, found: JawKeypoints, spots: JawSpots) -> None:
        self.spots = spots
        self._creep, self._model = np.zeros(4), None
        self._count = 0
        self._points, self._seen = np.zeros_like(found.points), np.zeros(len(found.points))

    @property
    def is_sure(self) -> bool:
        """Whether the mean is one of enough images, and shows a shift well enough."""
        return self._count >= LEAST_IMAGES and self._model.errors.max() <= LARGEST_ERROR

    @property
    def is_vague(self) -> bool:
        """Whether the patches show too little for ever telling."""
        return self._count >= JUDGED and self._model.errors.max() > LARGEST_ERROR

    @property
    def limits(self) -> NDArray:
        """Shifts (n + 1,) [m] of the key points in one image, as `JawSpots.reach`, up to which noise explains them."""
        return np.maximum(LARGEST_SHIFT, SIGMA * self._model.errors)

    def add(self, found: JawKeypoints, patches: NDArray) -> None:
        """Average with one more image its key points and its patches (n, s, s)."""
        first = self._count == 0
        self._count += 1
        share = 1.0 / min(self._count, MOST_IMAGES)
        if first:
            self._mean, self._place = patches.copy(), found.T_camera_jaw.copy()
            self._square = np.full(len(patches), np.nan)
        else:
            left = self.look(patches[INNER].ravel()).left
            self._square = left if self._count == 2 else self._square + share * (left - self._square)
            self._mean += share * (patches - self._mean)
            self._place += share * (found.T_camera_jaw - self._place)
        known = np.isfinite(found.points).all(axis=1) & found.valid
        self._seen += share * (known - self._seen)
        self._points += share * (np.where(known[:, None], found.points, 0.0) - self._points)
        self._known = None if first else self._average(found)
        if self._count & (self._count - 1) == 0 or self._count >= LEAST_IMAGES:
            self._model = self.spots.solve(self._mean, self._square)

    def look(self, values: NDArray) -> Look:
        """Return how the inner grey values (N,) of a picture differ from the mean."""
        return look_at(values, self._model)

    def is_still(self, values: NDArray) -> bool:
        """Say whether the jaw stands where it stood, by the inner grey values (N,) of a picture."""
        seen = self.look(values)
        is_strange = (seen.left > STRANGEST * self._square).any()  # of the first image nothing is known: NaN
        if is_strange or (self.spots.reach(seen.shifts) > self.limits).any():
            return False
        self._creep += (seen.shifts - self._creep) / AVERAGED
        return bool(self.spots.reach(self._creep).max() <= LARGEST_CREEP)

    def tell(self, stamp: float) -> JawKeypoints:
        """Return the key points of an image of `stamp` [s] in which nothing has moved: the means."""
        return replace(self._known, stamp=stamp)

    def _average(self, found: JawKeypoints) -> JawKeypoints:
        """Return the last key points with the mean places of those that were seen in most of the images."""
        often = self._seen >= 0.5
        with np.errstate(invalid="ignore", divide="ignore"):
            points = np.where(often[:, None], self._points / self._seen[:, None], found.points)
        stddev = np.hypot(found.stddev, LARGEST_SHIFT)
        return replace(found, points=points, stddev=stddev, T_camera_jaw=self._place.copy())


class StillWatch:
    """Tells of a picture whether all jaws stand as they did in the last ones, so that their key points hold."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all pictures."""
        self._last: Mapping[str, JawKeypoints] = {}
        self._forget()

    def _forget(self) -> None:
        """Forget where the jaws stood still."""
        self._jaws: dict[str, JawWatch] = {}
        self._camera: CameraIntrinsics | None = None
        self._values = np.empty(0)
        self._has_moved = False
        self._doubted = False
        self._half = HALVES[0]

    def confirm(self, stamp: float, color: NDArray, camera: CameraIntrinsics) -> Mapping[str, JawKeypoints] | None:
        """Return the key points by side of a picture (h, w, 3) uint8 in which nothing has moved, else None.

        A picture that is the one before to the bit says nothing: a sensor has noise.
        """
        if camera is not self._camera or color.shape[:2] != (camera.height, camera.width) or not self._is_sure:
            return None
        before, self._values = self._values, _gather(color, self._inner)
        if np.array_equal(before, self._values):
            return None
        if self._judge(self._values):
            return self._tell(stamp)
        self._has_moved = True
        return None

    @property
    def _is_sure(self) -> bool:
        return bool(self._jaws) and all(jaw.is_sure for jaw in self._jaws.values())

    def _tell(self, stamp: float) -> Mapping[str, JawKeypoints]:
        return {side: jaw.tell(stamp) for side, jaw in self._jaws.items()}

    def _judge(self, values: NDArray) -> bool:
        """Say whether all jaws stand still by their inner grey values (N,)."""
        parts = np.split(values, self._inner_ends)
        return all([jaw.is_still(part) for jaw, part in zip(self._jaws.values(), parts, strict=True)])

    def take(
        self, found: Mapping[str, JawKeypoints], color: NDArray, camera: CameraIntrinsics
    ) -> Mapping[str, JawKeypoints]:
        """Take what was found of all jaws in a picture (h, w, 3), and return it, or its mean while they stand still.

        A single picture that looks moved changes nothing; after a second one the mean begins anew.
        """
        last, self._last = self._last, found
        has_moved, self._has_moved = self._has_moved, False
        if not found or found.keys() != last.keys() or _have_moved(found, last):
            self._forget()
        elif camera is not self._camera or not self._jaws:
            self._begin(found, color, camera)
        elif not has_moved and self._add(found, color):
            if self._half < HALVES[-1] and any(jaw.is_vague for jaw in self._jaws.values()):
                self._begin(found, color, camera, HALVES[-1])
            return self._tell(next(iter(found.values())).stamp) if self._is_sure else found
        elif self._doubted or not self._is_sure:
            self._begin(found, color, camera)
        else:
            self._doubted = True
        return found

    def _add(self, found: Mapping[str, JawKeypoints], color: NDArray, *, first: bool = False) -> bool:
        """Add a picture to the means if it is still, as the first one is; return whether it was."""
        patches = np.split(_gather(color, self._all), self._ends)
        patches = [part.reshape(jaw.spots.pixels.shape) for jaw, part in zip(self._jaws.values(), patches, strict=True)]
        is_still = first or self._judge(np.concatenate([part[INNER].ravel() for part in patches]))
        if is_still:
            self._doubted = False
            for (side, jaw), part in zip(self._jaws.items(), patches, strict=True):
                jaw.add(found[side], part)
        return is_still

    def _begin(
        self, found: Mapping[str, JawKeypoints], color: NDArray, camera: CameraIntrinsics, half: int = HALVES[0]
    ) -> None:
        """Begin new means with a picture and patches of a size [px], unless too little of a jaw is seen in it."""
        self._forget()
        self._half = half
        spots = {side: place_spots(jaw, camera, half) for side, jaw in found.items()}
        if any(jaw is None for jaw in spots.values()):
            return
        self._camera = camera
        self._all, self._ends = _join([jaw.pixels for jaw in spots.values()])
        self._inner, self._inner_ends = _join([jaw.pixels[INNER] for jaw in spots.values()])
        self._jaws = {side: JawWatch(found[side], jaw) for side, jaw in spots.items()}
        self._add(found, color, first=True)


def _have_moved(found: Mapping[str, JawKeypoints], last: Mapping[str, JawKeypoints]) -> bool:
    """Say whether a jaw stands elsewhere than in the image before."""
    return any(np.abs(jaw.T_camera_jaw - last[side].T_camera_jaw).max() > MOVED for side, jaw in found.items())


def _join(parts: Sequence[NDArray]) -> tuple[NDArray, NDArray]:
    """Return places (3, N) of red, green and blue in the flat picture, and where the parts but the first begin."""
    flat = np.concatenate([part.ravel() for part in parts])
    return 3 * flat + np.arange(3)[:, None], np.cumsum([part.size for part in parts])[:-1]


def _gather(color: NDArray, places: NDArray) -> NDArray:
    """Return the grey values (N,), red and green and blue together, of a picture at places (3, N)."""
    return color.reshape(-1).take(places).sum(axis=0, dtype=np.float32)
