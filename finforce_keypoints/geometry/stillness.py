"""Whether the jaws stand as they did in the last images, so that their key points hold.

Around every key point, what a picture differs by from a mean picture m is explained by what light does (gain and
brightness) and by what a jaw does: a shift along its x, one that grows with the height h and one with its square, and a
shift along its z; all of them small.

    d = g m + b - (c_0 + c_1 h + c_2 h^2) dm/dx - c_3 dm/dz + noise

The least squares c say how far each key point has gone; that is a length, and so is what may be missed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project

if TYPE_CHECKING:
    from finforce_keypoints.geometry.jaw_localizer import JawKeypoints

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
class GreyLook:
    """How one jaw differs from its mean picture: shifts (4,) [m], what is left around each key point (n,)."""

    shifts: NDArray
    left: NDArray


def look_at(values: NDArray, model: SpotModel) -> GreyLook:
    """Return how the grey values (N,) of a jaw differ from those of a model."""
    away = values - model.mean
    answer = model.inverse @ away
    left = away - model.design @ answer
    return GreyLook(shifts=_LENGTH * answer[2:], left=np.square(left).reshape(len(model.square), -1).mean(axis=1))


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


if TYPE_CHECKING:
    from finforce.camera import CameraIntrinsics
    from finforce_keypoints.geometry.jaw_localizer import JawKeypoints

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

    def look(self, values: NDArray) -> GreyLook:
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
