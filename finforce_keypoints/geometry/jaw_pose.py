"""The position of a jaw on the closing axis: by the rays to its rigid points, the patch around one, and over time.

A network places the reference point a little differently in every light and before every background, and all key points
of the jaw would share the error. What surrounds the point is rigid and does not change: registered image by
image, it tells ten times as exactly how far it has slid since the first ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import hypot, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.gripper_frames import jaw_in_camera
from finforce.kalman import MotionNoise, Track
from finforce.optional import import_cv2
from finforce_ifea.jaw.jaw import Jaw
from finforce_keypoints.geometry.side_picture import PlaneGrid, SidePlane, map_picture, take_picture
from finforce_keypoints.geometry.template import BENDS, PAIRS, SHARE, find_motions
from finforce_keypoints.parameters import DetectorSettings, JawMount

# Errors of a network in the reference point, by what it states: of images in a row alike, and of a single one; measured
# on 34 jaws without a mark in images of the twin.
_LASTING, _NETWORK_NOISE = 0.6, 0.5
_BENT_AT = 0.010  # height for which the bending is given [m]
_HIGHEST_RIGID = 3.5e-3  # key points that bend more than this say nothing about the jaw's place [m]
_LEAST_AGREEMENT = 0.6  # share of the points near the base that stand where the jaw is said to be: of a jaw, all do
_SET_ASIDE = 3  # consecutive places off the trajectory that are believed when they agree
_RIGID_STDDEV = 0.3e-3  # [m] bending of the jaw at that height; more with the square of the height
COVERED_STDDEV = 3e-3  # [m] of a jaw whose rigid part is covered; one whose place is less well known is not found
SLIP = 1.5e-3  # [m] standard deviation of how far holder and camera give under load, along the jaw
_ROUNDS = 6  # of reweighting
_LEAST_BENT = 5  # points that tell the place of a jaw that may be bent
_LEAST_WEIGHT = 0.4  # mean over these: 0.5 and more in 99 of 100 images of jaws, up to 0.3 where there is none
_ORIGIN_GATE = 3.0  # standard deviations of an origin off the forecast, which mean that the speed has changed
# Process noise of a jaw that stands, or closes at some centimetres per second.
_NOISE = MotionNoise(
    drift=(0.01e-3) ** 2,
    acceleration=0.004**2,
    start=0.01**2,
    rest_time=3.0,
    motion_time=1.0,
)
_LONGEST_STEP = 0.5  # [s] without an image, after which the trajectory starts anew
SCALE = 0.25e-3  # [m] of a pixel of the patch
HALF = 20  # [px] of the patch's width and height
BLUR = 1.5  # [px] standard deviation; wide enough that a slide by a pixel is still linear
TEMPLATE_IMAGES = 30  # over which template and anchor are averaged
ITERATIONS = 5
SETTLED = 0.02  # [px] that a last iteration may move
FARTHEST = 2.0e-3  # [m] between the network's place and the registered one
_FARTHEST_SIGMA = 4.0  # standard deviations of the network's place by which it may be farther
_CLEAR = 0.5  # noise of a registered place by the deviation of the network's, up to which the patch tells more
LEAST_LIKENESS = 0.75  # correlation with the template, below which something else is seen
STDDEV = 0.04e-3  # [m] of a registered slide
_INNER = (slice(3, -3), slice(3, -3))  # the border's gradients are one-sided
FORGOTTEN_AFTER = 15  # images in a row without likeness: the light or the thing itself has changed


@dataclass(frozen=True, kw_only=True)
class Origin:
    """A jaw's place.

    Attributes:
        x: of the jaw's origin in the gripper base [m].
        stddev: [m].
        shared: the part of it that images in a row have in common [m].
        noise: error of a single image [m], where that is known apart; such a place is followed at once.
        is_bent: whether it is by points that may be bent, and not by the reference point.
        slip: by which a jaw in a holder that gives has moved along its own z [m].
    """

    x: float
    stddev: float
    shared: float = 0.0
    noise: float | None = None
    is_bent: bool = False
    slip: float = 0.0


class OriginEstimator:
    """Finds the origin of one jaw, whose rotation is known, from rays to its points and the corners of its tag.

    A point of the rigid jaw moves on a line q(x) = p + x a, a the closing axis; it is where it comes nearest to the
    ray r: the x for which r_xy q_z - q_xy, its distance from the ray [m], is least. All in the camera frame.
    """

    def __init__(
        self, jaw: Jaw, T_gripper_camera: NDArray, settings: DetectorSettings, mount: JawMount | None = None
    ) -> None:
        """Keep the lines on which the jaw's points move, the reference point last, then the tag's corners."""
        mount = mount or JawMount()
        self._tolerance = settings.reference_tolerance
        self._T_camera_middle = jaw_in_camera(T_gripper_camera, jaw.side, 0.0, mount.turn)
        corners = np.zeros((0, 3)) if mount.tag is None else mount.tag.corners
        self._count = len(jaw.keypoints) + 1
        points = np.vstack((jaw.keypoints, jaw.reference_point, corners))
        self._starts = points @ self._T_camera_middle[:3, :3].T + self._T_camera_middle[:3, 3]
        self._axis = T_gripper_camera[0, :3].copy()
        bent = _RIGID_STDDEV * (jaw.keypoints[:, 2] / _BENT_AT) ** 2
        self._bent = np.append(np.where(bent < _HIGHEST_RIGID, bent, np.inf), 0.0)
        sign = -1.0 if jaw.side == "left" else 1.0
        self._low, self._high = sorted((sign * settings.opening_min, sign * settings.opening_max))
        self._is_held = mount.is_held
        bends = np.insert(find_motions(jaw), 1, 0.0, axis=2) @ self._T_camera_middle[:3, :3].T
        slip = np.broadcast_to(SLIP * self._is_held * self._T_camera_middle[:3, 2], (1, *points.shape))
        rigid = np.zeros((len(bends), 1 + len(corners), 3))
        self._motions = np.concatenate((slip, np.append(bends, rigid, axis=1)))

    @property
    def middle(self) -> Origin:
        """The middle of the opening range."""
        return Origin(x=0.5 * (self._low + self._high), stddev=0.0)

    def place(self, origin: Origin) -> NDArray:
        """Return T_camera_jaw (4, 4) of an origin."""
        T = self._T_camera_middle.copy()
        T[:3, 3] += origin.x * self._axis + origin.slip * T[:3, 2]
        return T

    def is_elsewhere(self, tag: NDArray) -> bool:
        """Say whether rays (4, 3) to the tag's corners pass where no jaw of the opening range has them."""
        rays = np.vstack((np.full((self._count, 3), np.nan), tag))
        x, _, off = np.median(self._solve(rays, np.ones(len(rays)))[:, self._count :], axis=1)
        return not (self._low <= x <= self._high and off <= 2.0 * self._tolerance)

    def measure(
        self, rays: NDArray, stddev: NDArray, tag: NDArray | None = None, tag_stddev: float = 0.0
    ) -> Origin | None:
        """Return the origin that rays show, None when they show none within the opening range.

        The reference point decides, unless the points near the clamped base contradict it. Where it is not seen, all
        points decide, bent in whatever way the jaw's mechanics allow.

        Args:
            rays: (K + 1, 3) through the jaw's points, camera frame, z = 1; NaN: not seen.
            stddev: (K + 1,) of the rays' x and y [-]: that of the pixels by the focal length.
            tag: rays (4, 3) to the corners of the jaw's tag; None where it is not seen.
            tag_stddev: of these rays' x and y [-].
        """
        if not self._is_held:
            x, error, off = self._solve(rays, stddev)
            if off[-1] <= self._tolerance and self._low <= x[-1] <= self._high:
                known = float(error[-1])
                origin = Origin(x=float(x[-1]), stddev=known, shared=_LASTING * known, noise=_NETWORK_NOISE * known)
                return origin if self._agrees(origin, x, off) else None
            rays = np.vstack((rays[:-1], np.full(3, np.nan)))  # what is off the mark's line is not the mark
        corners = len(self._starts) - self._count
        tag = np.full((corners, 3), np.nan) if tag is None else tag
        return self._measure_bent(np.vstack((rays, tag)), np.append(stddev, np.full(corners, tag_stddev)))

    def _measure_bent(self, rays: NDArray, stddev: NDArray) -> Origin | None:
        """Return the origin by all points that are seen; None where they are too few or no jaw within the range.

        Least squares with less weight for what is far off, to first order around the median of the points' own places:

            r_k - p_k / p_kz = D_k (a x + sum_i c_i m_ki + sum_ij c_i c_j m_kij) + e_k,   D_k = dr / dp,

        c_i of the motions m_i ~ N(0, 1), m_ij of the products in `PAIRS`, those of the round before. The first of the
        motions is the slip of a held jaw in its holder, or of the holder before the camera.
        """
        with np.errstate(invalid="ignore"):
            x, _, off = self._solve(rays, stddev)
            seen = off <= 2.0 * self._tolerance
        if seen.sum() < _LEAST_BENT and not seen[self._count :].any():
            return None
        middle = float(np.median(x[seen]))
        points = self._starts[seen] + middle * self._axis
        slopes = np.zeros((len(points), 2, 3))
        slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
        slopes[:, :, 2] = -points[:, :2] / points[:, 2:]
        slopes /= points[:, 2, None, None]
        along = np.broadcast_to(self._axis, (1, *points.shape))
        columns = np.einsum("kab,ikb->kai", slopes, np.concatenate((along, self._motions[:, seen])))
        columns, products = np.split(columns, [2 + BENDS], axis=2)
        straight = rays[seen, :2] - points[:, :2] / points[:, 2:]
        prior, variance, weights = np.diag([0.0, *np.ones(1 + BENDS)]), stddev[seen] ** 2, np.ones(len(points))
        found = np.zeros(2 + BENDS)
        for _ in range(_ROUNDS):
            away = straight - products @ [found[2 + i] * found[2 + j] for i, j in PAIRS]
            weighted = columns * (weights / variance)[:, None, None]
            covariance = np.linalg.inv(np.einsum("kai,kaj->ij", weighted, columns) + prior)
            found = covariance @ np.einsum("kai,ka->i", weighted, away)
            # what moves far differs from its shapes more
            variance = stddev[seen] ** 2 + (SHARE**2) * ((columns[:, :, 2:] @ found[2:]) ** 2).sum(axis=1)
            weights = 1.0 / (1.0 + 0.5 * ((away - columns @ found) ** 2).sum(axis=1) / variance)
        place, spread = middle + float(found[0]), float(np.sqrt(covariance[0, 0]))
        # what a finger differs from its shapes by is the same from image to image
        origin = Origin(x=place, stddev=spread, shared=spread, slip=SLIP * float(found[1]))
        is_jaw = self._low <= place <= self._high
        if not self._is_held:
            origin = replace(origin, noise=_NETWORK_NOISE * spread, is_bent=True)
            is_jaw &= bool(weights.mean() >= _LEAST_WEIGHT)
        return origin if is_jaw else None

    def _agrees(self, origin: Origin, x: NDArray, off: NDArray) -> bool:
        """Say whether the points near the base, by origins (K + 1,) and distances (K + 1,), are of a jaw there."""
        near = np.isfinite(x) & np.isfinite(self._bent)
        near[-1] = False
        bent = self._bent[near]
        there = (np.abs(x[near] - origin.x) <= self._tolerance + 3.0 * bent) & (off[near] <= self._tolerance + bent)
        return bool(there.sum() >= _LEAST_AGREEMENT * near.sum())

    def _solve(self, rays: NDArray, stddev: NDArray) -> NDArray:
        """Return rows (3, K + 1): origin, its standard deviation, distance of the line of motion from the ray [m]."""
        slopes = rays[:, :2] * self._axis[2] - self._axis[:2]
        apart = rays[:, :2] * self._starts[:, 2:] - self._starts[:, :2]
        square = (slopes**2).sum(axis=1)
        x = -(slopes * apart).sum(axis=1) / square
        depth = self._starts[:, 2] + x * self._axis[2]
        off = np.linalg.norm(apart + x[:, None] * slopes, axis=1)
        return np.stack((x, depth * stddev / np.sqrt(square), off))


class ReferencePatch:
    """Follows the reference point of one jaw by what surrounds it.

    Args:
        jaw: whose reference point lies on its side.
    """

    def __init__(self, jaw: Jaw) -> None:
        x, y, z = jaw.reference_point
        self._side = SidePlane(level=float(y))
        size = 2 * HALF + 1
        self._grid = PlaneGrid(scale=SCALE, x=x - HALF * SCALE, z=z - HALF * SCALE, width=size, height=size)
        self._sign = 1.0 if jaw.side == "left" else -1.0
        self.reset()

    def reset(self) -> None:
        """Forget what was seen."""
        self._forget()
        self._unlike = 0  # consecutive images in which the patch did not show the jaw

    def _forget(self) -> None:
        """Forget the template."""
        self._template: NDArray | None = None
        self._matcher: PatchMatcher | None = None
        self._count, self._anchor = 0, 0.0

    @property
    def is_settled(self) -> bool:
        """True if the template is one of enough images, so that it changes no more, or shows nothing."""
        return max(self._count, self._unlike) >= TEMPLATE_IMAGES

    def refine(
        self,
        color: NDArray,
        camera: CameraIntrinsics,
        measured: Origin,
        place: Callable[[Origin], NDArray],
        forecast: Origin | None = None,
    ) -> Origin:
        """Return where the jaw is by its patch, or as it was measured where the patch does not show it.

        Args:
            color: image (h, w, 3) uint8.
            camera: its intrinsics.
            measured: origin that the network's reference point shows.
            place: origin to T_camera_jaw (4, 4).
            forecast: where the jaw should be, which is looked at first.
        """
        if self._template is None:
            self._template, self._count = self._take(color, camera, place(measured)), 1
            return measured
        starts = (measured,) if forecast is None else (forecast, measured)
        tries = (self._register(color, camera, measured, place, start) for start in starts)
        found = next((origin for origin in tries if origin is not None), None)
        if found is None:
            self._unlike += 1
            if self._unlike % FORGOTTEN_AFTER == 0:
                self._forget()
            return measured
        self._unlike = 0
        if self._count < TEMPLATE_IMAGES:
            self._learn(self._take(color, camera, place(found)), measured.x - found.x)
        return replace(found, x=found.x + self._anchor)

    def _learn(self, patch: NDArray, off: float) -> None:
        """Average template and anchor with one more image, its patch taken where it was found."""
        share = 1.0 / (self._count + 1)
        self._template += share * (patch - self._template)
        self._anchor += share * (off - self._anchor)
        self._count += 1
        self._matcher = None

    def _register(
        self,
        color: NDArray,
        camera: CameraIntrinsics,
        measured: Origin,
        place: Callable[[Origin], NDArray],
        start: Origin,
    ) -> Origin | None:
        """Return the origin, without the anchor, at which the patch is the template; None when it is nowhere near.

        A patch without a mark or an edge tells less than the network does.
        """
        x, farthest = start.x - self._anchor, FARTHEST + _FARTHEST_SIGMA * measured.stddev
        self._matcher = self._matcher or PatchMatcher(self._template)
        for _ in range(ITERATIONS):
            slide = self._matcher.match(self._take(color, camera, place(Origin(x=x, stddev=0.0))))
            x += self._sign * slide.x * SCALE
            if not abs(x + self._anchor - measured.x) <= farthest:
                return None
            if abs(slide.x) < SETTLED:
                noise = SCALE * slide.stddev
                is_clear = slide.likeness >= LEAST_LIKENESS and noise < _CLEAR * measured.stddev
                return Origin(x=x, stddev=hypot(STDDEV, noise)) if is_clear else None
        return None

    def _take(self, color: NDArray, camera: CameraIntrinsics, T_camera_jaw: NDArray) -> NDArray:
        """Return the patch (h, w) of a jaw at a place, smoothed."""
        picture = take_picture(color, map_picture(self._grid, self._side, T_camera_jaw, camera))
        red, green, blue = np.moveaxis(picture.astype(np.float32), 2, 0)
        grey = (red + green + blue) / np.float32(3.0)
        return import_cv2().GaussianBlur(grey, (0, 0), BLUR).astype(np.float64)


class Slide(NamedTuple):
    """How far a patch has slid against a template.

    Attributes:
        x: along the jaw's x [px].
        stddev: of x by what the template leaves of the patch [px].
        likeness: correlation with the template.
    """

    x: float
    stddev: float
    likeness: float


class PatchMatcher:
    """Tells by how much patches have slid against one template, by least squares to first order in the slide s.

    patch = a template - a (s_x d_x + s_z d_z) template + b

    Args:
        template: (h, w) grey values.
    """

    def __init__(self, template: NDArray) -> None:
        by_z, by_x = np.gradient(template)
        values = template[_INNER].ravel()
        columns = np.column_stack([by_x[_INNER].ravel(), by_z[_INNER].ravel(), values, np.ones(values.size)])
        self._columns, covariance = columns, np.linalg.inv(columns.T @ columns + 1e-6 * np.eye(4))
        self._inverse = covariance @ columns.T
        self._deviation = sqrt(covariance[0, 0] * 4.0 * pi * BLUR**2 / values.size)  # by the root of the sum of squares
        known = values - values.mean()
        self._template = known / max(np.linalg.norm(known), 1e-9)

    def match(self, patch: NDArray) -> Slide:
        """Return the slide of a patch (h, w); a likeness of 0 for the negative of the template."""
        values = patch[_INNER].ravel()
        found = self._inverse @ values
        slope_x, _, gain, _ = found
        if not gain > 0.0:
            return Slide(0.0, np.inf, 0.0)
        left, seen = values - self._columns @ found, values - values.sum() / values.size
        likeness = float(seen @ self._template / max(sqrt(seen @ seen), 1e-9))
        return Slide(float(-slope_x / gain), self._deviation * sqrt(left @ left) / gain, likeness)


class OriginTrack:
    """The place of a jaw that stands or moves, see `finforce.kalman`, over images in which it may not be seen.

    An origin farther off the forecast than the gate means that the speed has changed: position and speed of a jaw that
    moves are opened to what was seen.

    What images in a row err by alike does not hold the place back: it is in what is stated, and what it changes by
    from one image to the next is in the noise of this one, or in that of the forecast where the last one was worse.
    """

    def __init__(self, settings: DetectorSettings) -> None:
        """Keep the gates."""
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget the jaw."""
        self._stamp: float | None = None
        self._track = Track(_NOISE, 0.0, 0.0)
        self._aside: list[tuple[float, float]] = []
        self._missed, self._last, self._bias = 0, Origin(x=0.0, stddev=0.0), 0.0

    @property
    def is_lost(self) -> bool:
        """True if nobody knows where the jaw is."""
        return self._stamp is None

    @property
    def place(self) -> float:
        """The position of the jaw's origin on the closing axis [m]; NaN when it is lost."""
        return float("nan") if self.is_lost else self._track.x

    @property
    def speed(self) -> float:
        """The sliding speed of the jaw [m/s]."""
        return self._track.speed

    def forecast(self, stamp: float) -> Origin | None:
        """Return where the jaw should be at a time [s]; None when it is lost."""
        track = self._predict(stamp)
        return None if track is None else self._tell(track)

    def _predict(self, stamp: float) -> Track | None:
        """Return the track at a time [s]; None when the jaw is lost."""
        if self._stamp is None or stamp - self._stamp > _LONGEST_STEP:
            return None
        return self._track.after(stamp - self._stamp)

    def update(self, stamp: float, origin: Origin | None) -> Origin | None:
        """Take the origin seen in an image, None when it was not; return the best estimate, None when lost."""
        track = self._predict(stamp)
        if origin is None:
            return self._miss(stamp, track)
        if track is None:
            return self._begin(stamp, origin)
        origin, dt = self._take_bias(origin, self._tell(track)), stamp - self._stamp
        variance, wider = origin.stddev**2, 0.0
        if origin.noise is not None or self._last.noise is not None:
            worse = origin.stddev - self._last.stddev
            variance = (origin.noise or origin.stddev) ** 2 + max(worse, 0.0) ** 2
            wider = min(worse, 0.0) ** 2
        before, off = track.variance + wider, origin.x - track.x
        gate = _ORIGIN_GATE * sqrt(before + variance)
        if abs(off) > self._settings.largest_speed * dt + gate:
            return self._set_aside(stamp, origin, track)
        track.widen(wider)
        if abs(off) > gate:
            track.free(off**2, (off / dt) ** 2)
        self._missed, self._aside, self._last = 0, [], origin
        self._stamp, self._track = stamp, track
        track.update(origin.x, variance)
        if origin.noise is None:
            # a finger stays bent from image to image: no average of its points knows better where its base is
            track.widen(max(min(before, origin.shared**2) - track.variance, 0.0))
        found = self._tell(track)
        return found if found.stddev <= COVERED_STDDEV else None

    def _take_bias(self, origin: Origin, forecast: Origin) -> Origin:
        """Return an origin by points that may be bent less what it was off when the reference point was last seen."""
        if not origin.is_bent:
            self._bias = 0.0
            return origin
        if not self._last.is_bent:
            off = origin.x - forecast.x
            self._bias = off if abs(off) <= _ORIGIN_GATE * np.hypot(forecast.stddev, origin.stddev) else 0.0
        return replace(origin, x=origin.x - self._bias)

    def rest(self, stamp: float) -> None:
        """Take it that the jaw has not moved since the last image."""
        if self._stamp is not None:
            self._stamp = stamp
            self._track.stop()

    def _begin(self, stamp: float, origin: Origin, speed: float = 0.0) -> Origin:
        """Start the trajectory at an origin."""
        self._stamp, self._track = stamp, Track(_NOISE, origin.x, (origin.noise or origin.stddev) ** 2, speed)
        self._aside, self._missed, self._last = [], 0, origin
        return self._tell(self._track) if origin.stddev <= COVERED_STDDEV else None

    def _miss(self, stamp: float, track: Track | None) -> Origin | None:
        """Go on as predicted, without an origin, for a few images."""
        self._missed += 1
        if track is None or self._missed >= self._settings.lost_images:
            self.reset()
            return None
        self._stamp, self._track = stamp, track
        found = self._tell(track)
        return found if found.stddev <= COVERED_STDDEV else None

    def _set_aside(self, stamp: float, origin: Origin, track: Track) -> Origin | None:
        """Keep an origin that no jaw can reach; believe it once some in a row agree."""
        if self._aside and abs(origin.x - self._aside[-1][1]) > self._settings.largest_speed * (
            stamp - self._aside[-1][0]
        ):
            self._aside = []
        self._aside.append((stamp, origin.x))
        if len(self._aside) >= _SET_ASIDE:
            (first, begin), (last, end) = self._aside[0], self._aside[-1]
            return self._begin(stamp, origin, speed=(end - begin) / (last - first))
        return self._miss(stamp, track)

    def _tell(self, track: Track) -> Origin:
        """Return the jaw's place by a track."""
        shared = 0.0 if self._last.noise is None else self._last.shared
        return Origin(x=track.x, stddev=hypot(sqrt(track.variance), shared), shared=shared)
