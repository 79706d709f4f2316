"""Detection of jaws that stand as they did in the last images, so that their key points hold.

Around every key point, what a picture differs by from a mean picture m is explained by what light does (gain and
brightness) and by what a jaw does: a shift along its x, one that grows with the height h and one with its square, and a
shift along its z; all of them small.

    d = g m + b - (c_0 + c_1 h + c_2 h^2) dm/dx - c_3 dm/dz + noise

The least squares c say how far each key point has gone; that is a length, and so is what may be missed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project
from finforce_keypoints.geometry.jaw_localizer import JawKeypoints
from finforce_keypoints.images import RgbdImage

LARGEST_SHIFT = 0.05e-3  # [m] of a key point in one image, up to which it has not moved
LARGEST_CREEP = 0.02e-3  # [m] the same, averaged over the last images
AVERAGED = 10  # images, over which a creep is averaged
SIGMA = 4.0  # standard deviations of a shift that noise explains, where that is more
LARGEST_ERROR = 0.02e-3  # [m] standard deviation of a shift, above which nobody can tell
STRANGEST = 3.0  # mean square of what is left around one key point by that of still images: more is another thing
LEARNT = 15  # images of which a reference is the mean
MOVED = 0.3e-3  # [m] of a jaw from one image to the next, which needs no look at its picture
LOOK_EVERY = 4.0  # [s] after which an image is looked at in full though nothing has moved
LEAST_POINTS = 8  # valid key points that a jaw needs
HALF = 8  # [px] of the patch around a key point, without the pixel at its edge that gradients need
INNER = (..., slice(1, -1), slice(1, -1))
_LENGTH = 1e-3  # [m] in which shifts are solved for
_ALIKE = 1.7  # by which shifts err more than from noise that no neighbours share; seen on twin images
_RIDGE = 1e-3  # keeps a picture without any contrast regular


@dataclass(frozen=True, kw_only=True, eq=False)
class JawSpots:
    """The watched region of one jaw, and the motion of its key points in the picture.

    Attributes:
        places: (3, n, s, s) of red, green and blue of the patches in the flat picture.
        along_x: (n, 2) pixels by which a key point moves along the jaw's x [px/mm].
        along_z: (n, 2) the same along its z.
        powers: (n, 3) 1, h and h^2 of the key points' heights, the highest one's being 1.
    """

    places: NDArray
    along_x: NDArray
    along_z: NDArray
    powers: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class StillReference:
    """The appearance of a jaw at rest: d = design @ c for the differences d (N,) of a picture from it.

    Attributes:
        keypoints: the means of its key points, told while nothing moves.
        places: (3, N) of red, green and blue in the flat picture.
        mean: (N,) grey values.
        design: (N, 6) of gain, brightness, three shifts along x and one along z.
        inverse: (6, N) c = inverse @ d.
        powers: (n, 3) 1, h and h^2 of the key points' heights, the highest one's being 1.
        square: (n,) mean square of what is left around each key point while nothing moves.
        errors: (n + 1,) standard deviations of the key points' shifts along x, then of the one along z [m].
    """

    keypoints: JawKeypoints
    places: NDArray
    mean: NDArray
    design: NDArray
    inverse: NDArray
    powers: NDArray
    square: NDArray
    errors: NDArray

    @property
    def limits(self) -> NDArray:
        """Shifts (n + 1,) [m] of the key points in one image, as of `reach`, up to which noise explains them."""
        return np.maximum(LARGEST_SHIFT, SIGMA * self.errors)

    def refine(self, found: JawKeypoints) -> StillReference:
        """Return the reference with one more image in the mean of its key points, which thus never repeat for long."""
        known = self.keypoints
        change = np.where(found.valid[:, None] & known.valid[:, None], found.points - known.points, 0.0)
        return replace(self, keypoints=replace(known, points=known.points + np.nan_to_num(change) / LEARNT))

    def reach(self, shifts: NDArray) -> NDArray:
        """Return how far shifts (4,) [m] move the key points along x, (n,), and all of them along z: (n + 1,) [m]."""
        return np.abs(np.append(self.powers @ shifts[:3], shifts[3]))

    def measure(self, values: NDArray) -> NDArray | None:
        """Return the shifts (4,) [m] that grey values (N,) show; None where the jaw has moved, or is hidden in part."""
        difference = values - self.mean
        answer = self.inverse @ difference
        left = np.square(difference - self.design @ answer).reshape(len(self.square), -1).mean(axis=1)
        shifts = _LENGTH * answer[2:]
        moved = (self.reach(shifts) > self.limits).any() or (left > STRANGEST * self.square).any()
        return None if moved else shifts


class StillWatch:
    """Tells of a picture whether all jaws stand as they did in the last ones, so that their key points hold."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all pictures."""
        self.references: dict[str, StillReference] = {}
        self._learning: list[Mapping[str, JawKeypoints]] = []  # of images in which the jaws seem to stand still, and
        self._patches: list[Mapping[str, NDArray]] = []  # the grey patches (n, s, s) of these
        self._spots: dict[str, JawSpots | None] = {}
        self._camera: CameraIntrinsics | None = None
        self._creep: dict[str, NDArray] = {}
        self._values = np.empty(0)
        self._moved = 0  # pictures in a row that looked moved
        self._looked = -np.inf

    def confirm(self, image: RgbdImage) -> Mapping[str, JawKeypoints] | None:
        """Return the key points by side of a picture in which nothing has moved, else None: look at it in full.

        A picture that is the one before to the bit says nothing: a sensor has noise.
        """
        if not self.references or image.camera is not self._camera:
            return None
        values = [gather(image.color, reference.places) for reference in self.references.values()]
        before, self._values = self._values, np.concatenate(values)
        if np.array_equal(before, self._values):
            return None
        if not all([self._is_still(side, part) for side, part in zip(self.references, values, strict=True)]):
            self._moved += 1
            return None
        self._moved = 0
        return None if image.stamp > self._looked + LOOK_EVERY else self._tell(image.stamp)

    def _is_still(self, side: str, values: NDArray) -> bool:
        """Say whether a jaw stands where it stood, by the grey values (N,) of its patches."""
        reference = self.references[side]
        shifts = reference.measure(values)
        if shifts is None:
            return False
        self._creep[side] += (shifts - self._creep[side]) / AVERAGED
        return bool(reference.reach(self._creep[side]).max() <= LARGEST_CREEP)

    def _tell(self, stamp: float) -> Mapping[str, JawKeypoints]:
        return {side: replace(reference.keypoints, stamp=stamp) for side, reference in self.references.items()}

    def take(self, found: Mapping[str, JawKeypoints], image: RgbdImage) -> Mapping[str, JawKeypoints]:
        """Take what was found of all jaws in an image, and return it, or its mean while they stand still.

        A single picture that looks moved changes nothing; after a second one the jaws are learnt anew.
        """
        self._looked = image.stamp
        if self.references:
            if found.keys() == self.references.keys() and image.camera is self._camera and self._moved < 2:
                known = {side: reference.keypoints for side, reference in self.references.items()}
                if not have_moved(found, known):
                    if self._moved:
                        return found
                    self.references = {side: each.refine(found[side]) for side, each in self.references.items()}
                    return self._tell(image.stamp)
            self.references, self._moved = {}, 0
        self._learn(found, image)
        return self._tell(image.stamp) if self.references else found

    def _learn(self, found: Mapping[str, JawKeypoints], image: RgbdImage) -> None:
        """Learn from one more image; a motion begins anew."""
        last = self._learning[-1] if self._learning else found
        if found.keys() != last.keys() or image.camera is not self._camera or have_moved(found, last):
            self._learning, self._patches = [], []
        if not self._learning:
            self._camera = image.camera
            self._spots = {side: place_spots(jaw, image.camera) for side, jaw in found.items()}
        if not found or None in self._spots.values():
            self._learning, self._patches = [], []
            return
        self._learning.append(found)
        self._patches.append({side: gather(image.color, spots.places) for side, spots in self._spots.items()})
        if len(self._learning) == LEARNT:
            references = {
                side: build_reference(spots, [f[side] for f in self._learning], [p[side] for p in self._patches])
                for side, spots in self._spots.items()
            }
            self._learning, self._patches = [], []
            if None not in references.values():
                self.references, self._creep = references, {side: np.zeros(4) for side in references}


def have_moved(found: Mapping[str, JawKeypoints], known: Mapping[str, JawKeypoints]) -> bool:
    """Say whether a jaw stands elsewhere than it did."""
    return any(np.abs(jaw.T_camera_jaw - known[side].T_camera_jaw).max() > MOVED for side, jaw in found.items())


def average(found: Sequence[JawKeypoints]) -> JawKeypoints:
    """Return the last key points with the mean places of those that were seen in at least half of the images."""
    last, valid = found[-1], np.array([jaw.valid for jaw in found])
    points = np.array([jaw.points for jaw in found])
    seen = valid & np.isfinite(points).all(axis=2)
    often = seen.mean(axis=0) >= 0.5
    mean = np.where(seen[..., None], points, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None]
    return replace(
        last,
        points=np.where(often[:, None], mean, last.points),
        stddev=np.hypot(last.stddev, LARGEST_SHIFT),
        T_camera_jaw=np.mean([jaw.T_camera_jaw for jaw in found], axis=0),
    )


def place_spots(found: JawKeypoints, camera: CameraIntrinsics) -> JawSpots | None:
    """Return where a jaw is watched, None where too few of its key points are seen well inside the image."""
    reach, size = HALF + 1, np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):
        inside = ((found.pixels > reach) & (found.pixels < size - reach - 1)).all(axis=1)
    kept = found.valid & inside
    if kept.sum() < LEAST_POINTS:
        return None
    points, T = found.points[kept], found.T_camera_jaw
    start, beside, above = (
        project((points + step) @ T[:3, :3].T + T[:3, 3], camera)
        for step in _LENGTH * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    )
    steps = np.arange(-reach, reach + 1)
    around = np.rint(found.pixels[kept]).astype(np.intp)[:, None, None] + np.stack(np.meshgrid(steps, steps), axis=-1)
    flat = 3 * (around[..., 1] * camera.width + around[..., 0])
    return JawSpots(
        places=np.stack((flat, flat + 1, flat + 2)),
        along_x=beside - start,
        along_z=above - start,
        powers=(points[:, 2] / points[:, 2].max())[:, None] ** np.arange(3),
    )


def build_reference(
    spots: JawSpots, found: Sequence[JawKeypoints], patches: Sequence[NDArray]
) -> StillReference | None:
    """Return what a jaw that stands still looks like; None where it moved, or too little is to be seen.

    Args:
        spots: where it is watched.
        found: its key points in some pictures.
        patches: grey values (n, s, s) of these.
    """
    mean, count = np.mean(patches, axis=0), len(spots.powers)
    by_row, by_column = np.gradient(mean, axis=(1, 2))
    slope_x, slope_z = (
        (by_column * way[:, 0, None, None] + by_row * way[:, 1, None, None])[INNER]
        for way in (spots.along_x, spots.along_z)
    )
    grey = mean[INNER]
    shifts = (-slope_x * power[:, None, None] for power in spots.powers.T)
    design = np.stack((grey / 100.0, np.ones_like(grey), *shifts, -slope_z), axis=-1).reshape(grey.size, -1)
    covariance = np.linalg.inv(design.T @ design + _RIDGE * np.eye(design.shape[1]))
    inverse = covariance @ design.T
    seen = [part[INNER].ravel() for part in patches]
    difference = np.array(seen) - grey.ravel()
    left = (difference - difference @ inverse.T @ design.T).reshape(len(seen), count, -1)
    square = np.square(left).mean(axis=(0, 2)) * len(seen) / (len(seen) - 1)  # the mean takes its part of the noise
    along_x = np.einsum("ij,jk,ik->i", spots.powers, covariance[2:5, 2:5], spots.powers)
    reference = StillReference(
        keypoints=average(found),
        places=spots.places[INNER].reshape(3, -1),
        mean=grey.ravel(),
        design=design,
        inverse=inverse,
        powers=spots.powers,
        square=square,
        errors=_LENGTH * _ALIKE * np.sqrt(np.append(along_x, covariance[5, 5]) * square.mean()),
    )
    is_clear = reference.errors.max() <= LARGEST_ERROR
    return reference if is_clear and all(reference.measure(values) is not None for values in seen) else None


def gather(color: NDArray, places: NDArray) -> NDArray:
    """Return the grey values (...), red and green and blue together, of a picture at places (3, ...)."""
    return color.reshape(-1).take(places).sum(axis=0, dtype=np.float32)
