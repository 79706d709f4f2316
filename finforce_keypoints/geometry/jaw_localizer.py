"""One jaw in one image after another: its place, its key points, and a camera that is elsewhere.

A camera that is not where it is said to be shifts, turns and stretches the picture of a jaw's side, all of it an affine
map of the side's places; a load bends the finger, which is none. A load moves the key points along the closing axis, a
camera's errors move them across it, too. By both, the two are told apart.

A network places the reference point a little differently in every light and before every background, and all key points
of the jaw would share the error. What surrounds the point is rigid and does not change: registered image by
image, it tells ten times as exactly how far it has slid since the first ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project, rays_from_pixels
from finforce.optional import import_cv2
from finforce_ifea.jaw.jaw import Jaw
from finforce_keypoints.geometry.depth import (
    DepthEvidence,
    DepthScale,
    SideFit,
    SideModel,
    SideView,
    build_side_samples,
    compute_stddev,
    fit_side,
    look_along,
    sample_depths,
    weigh_depths,
)
from finforce_keypoints.geometry.jaw_pose import Origin, OriginFinder, OriginTrack
from finforce_keypoints.geometry.side_picture import PlaneGrid, SidePlane, map_picture, take_picture
from finforce_keypoints.images import RgbdImage, lie_inside
from finforce_keypoints.pixel_finder import PixelFinding
from finforce_keypoints.settings import DetectorSettings

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
        x, y, z = jaw.reference_point
        self._side = SidePlane(level=float(y))
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
        picture = take_picture(color, map_picture(self._grid, self._side, T_camera_jaw, camera))
        red, green, blue = np.moveaxis(picture.astype(np.float32), 2, 0)
        grey = (red + green + blue) / np.float32(3.0)
        return import_cv2().GaussianBlur(grey, (0, 0), BLUR).astype(np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class PatchMatcher:
    """Tells by how much patches have slid against one template, by least squares to first order in the slide s.

    patch = a template - a (s_x d_x + s_z d_z) template + b

    Attributes:
        template: (n,) of the inner pixels, without its mean and of length 1.
        inverse: (4, n) that gives -a s_x, -a s_z, a and b of a patch.
    """

    template: NDArray
    inverse: NDArray

    def match(self, patch: NDArray) -> Slide:
        """Return by how much a patch (h, w) has slid."""
        values = patch[_INNER].ravel()
        slope_x, _, gain, _ = self.inverse @ values
        if not gain > 0.0:
            return Slide(x=0.0, likeness=0.0)
        seen = values - values.sum() / values.size
        likeness = float(seen @ self.template / max(sqrt(seen @ seen), 1e-9))
        return Slide(x=float(-slope_x / gain), likeness=likeness)


def build_matcher(template: NDArray) -> PatchMatcher:
    """Return what compares patches with a template (h, w)."""
    by_z, by_x = np.gradient(template)
    values = template[_INNER].ravel()
    columns = np.column_stack([by_x[_INNER].ravel(), by_z[_INNER].ravel(), values, np.ones(values.size)])
    normal = columns.T @ columns + 1e-6 * np.eye(4)
    known = values - values.mean()
    known /= max(np.linalg.norm(known), 1e-9)
    return PatchMatcher(template=known, inverse=np.linalg.solve(normal, columns.T))


_LEAST_SEEN = 3  # points, or all there are: fewer likely ones are no jaw
_LEAST_FOUND = 1 / 3  # share of the points that have to be likely where no jaw was known before
REASONS = ("image", "likelihood", "depth", "workspace")


@dataclass(frozen=True, kw_only=True, eq=False)
class JawKeypoints:
    """The key points of one jaw in one image.

    Attributes:
        stamp: image capture time [s].
        points: (K, 3) [m], jaw frame, in the order of the jaw file; NaN where there is no depth.
        likelihood: (K,) from 0 to 1; 0 where a point is not valid, so that whoever reads no `valid` drops it, too.
        pixels: (K, 2) column and row in the raw image [px]; NaN where nothing was found.
        valid: (K,) bool, whether a point may be used.
        stddev: (K, 3) one standard deviation along the jaw's axes [m].
        T_camera_jaw: (4, 4) where the jaw is.
        reasons: (K,) str, "" for valid points, else what speaks against them, one of `REASONS`.
    """

    stamp: float
    points: NDArray
    likelihood: NDArray
    pixels: NDArray
    valid: NDArray
    stddev: NDArray
    T_camera_jaw: NDArray
    reasons: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class SideEvidence:
    """Where a jaw's points are across its side, and which of them (K + 1,) bool the depth image confirms."""

    fit: SideFit
    has_depth: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Located:
    """What one image says of a jaw: its key points, and how wrong the depth image's scale is."""

    keypoints: JawKeypoints
    scale: DepthScale


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """One image, what was found in it, which points (K + 1,) are likely, their rays (K + 1, 3) and these' errors."""

    image: RgbdImage
    finding: PixelFinding
    likely: NDArray
    rays: NDArray
    ray_stddev: NDArray


class JawLocalizer:
    """Follows one jaw; raises MeshError when the jaw's mesh is bad."""

    def __init__(self, jaw: Jaw, T_gripper_camera: NDArray, settings: DetectorSettings) -> None:
        """Prepare where to sample depth on the jaw."""
        self._settings, self._sign = settings, 1.0 if jaw.side == "left" else -1.0
        self._origin, self._track = OriginFinder(jaw, T_gripper_camera, settings), OriginTrack(settings)
        self._patch, self._rest_check = ReferencePatch(jaw), RestCheck(jaw.keypoints)
        self._unconfirmed = 0
        self._samples = build_side_samples(jaw, settings.window, settings.edge)
        self._rest = np.vstack((jaw.keypoints, jaw.reference_point))
        self._model = SideModel(
            places=self._rest[:, ::2],
            offset=settings.offset_stddev,
            tilt=settings.tilt_stddev,
            bow=settings.bow_stddev,
            relief=settings.relief_stddev,
        )
        self._box = np.array([settings.workspace_closing, settings.workspace_width, settings.workspace_length])

    def reset(self) -> None:
        """Forget where the jaw was."""
        self._track.reset()
        self._patch.reset()
        self._rest_check.reset()
        self._unconfirmed = 0

    @property
    def warning(self) -> str:
        """What is suspicious about this jaw, in a sentence; "" for nothing."""
        distance = self._rest_check.distance
        if not distance > self._settings.rest_tolerance:
            return ""
        return (
            f"the key points at rest lie {1e3 * distance:.1f} mm from the jaw file: are the camera's extrinsics right?"
        )

    @property
    def is_lost(self) -> bool:
        """Whether the jaw has to be looked for everywhere."""
        return self._track.is_lost

    @property
    def place(self) -> float:
        """Where the jaw's origin is on the closing axis [m]; NaN when it is lost."""
        return self._track.place

    @property
    def is_settled(self) -> bool:
        """Whether the jaw's place is no longer learnt, so that images in a row tell the same."""
        return self._patch.is_learnt

    def rest(self, stamp: float) -> None:
        """Take it that the jaw has not moved from the last image to one of `stamp` [s]."""
        self._track.rest(stamp)

    @property
    def middle(self) -> NDArray:
        """T_camera_jaw (4, 4) in the middle of the opening range."""
        return self._origin.place(self._origin.middle)

    def imagine(self, camera: CameraIntrinsics) -> PixelFinding:
        """Return the finding of a jaw at rest, seen without error in the middle of the opening range."""
        T, count = self.middle, len(self._rest)
        return PixelFinding(
            pixels=project(self._rest @ T[:3, :3].T + T[:3, 3], camera),
            likelihood=np.ones(count),
            stddev=np.full(count, 0.5),
        )

    def expect(self, stamp: float) -> NDArray | None:
        """Return T_camera_jaw (4, 4) where the jaw should be at a time [s]; None when it is lost."""
        forecast = self._track.forecast(stamp)
        return None if forecast is None else self._origin.place(forecast)

    def locate(self, image: RgbdImage, finding: PixelFinding | None, scale: DepthScale) -> Located | None:
        """Return the jaw's key points, None when nobody knows where the jaw is.

        Args:
            image: the image, checked.
            finding: the pixels found; None when the finder saw nothing of the jaw.
            scale: what is known of the depth image's scale beforehand.
        """
        if finding is None:
            self._track.update(image.stamp, None)
            return None
        seen = self._look(image, finding)
        origin = self._track.update(image.stamp, self._measure(seen))
        if origin is None:
            return None
        located = self._describe(seen, scale, origin)
        # without one key point that depth confirms, a picture of a jaw would do as well
        self._unconfirmed = 0 if located.keypoints.valid.any() else self._unconfirmed + 1
        if self._unconfirmed >= self._settings.lost_images:
            self._track.reset()
            return None
        return located

    def _look(self, image: RgbdImage, finding: PixelFinding) -> _Seen:
        """Return the rays to the points that were found."""
        inside = lie_inside(image, finding.pixels)
        return _Seen(
            image=image,
            finding=finding,
            likely=self._find_likely(image, finding),
            rays=rays_from_pixels(np.where(inside[:, None], finding.pixels, np.nan), image.camera),
            ray_stddev=finding.stddev / np.sqrt(image.camera.fx * image.camera.fy),
        )

    def _measure(self, seen: _Seen) -> Origin | None:
        """Return where one image shows the jaw; None where it does not."""
        measured = self._origin.measure(np.where(seen.likely[:, None], seen.rays, np.nan), seen.ray_stddev)
        if measured is None or not self._is_there(seen.likely):
            return None
        if seen.likely[-1]:
            return self._patch.refine(seen.image.color, seen.image.camera, measured, self._origin.place)
        return measured

    def _describe(self, seen: _Seen, scale: DepthScale, origin: Origin) -> Located:
        """Return the key points of the jaw at an origin."""
        T_camera_jaw = self._origin.place(origin)
        sight = look_along(seen.rays, T_camera_jaw)
        side = self._fit_side(seen.image, sight, seen.likely, scale, T_camera_jaw)
        depths = sight.depths_at(self._rest[:, 1] + side.fit.y)
        self._check_rest(seen, sight, side)
        points = np.where(side.has_depth[:, None], sight.camera + depths[:, None] * sight.rays, np.nan)
        late = self._find_delays(seen, T_camera_jaw)
        points[:, 0] -= self._sign * self._track.speed * (late - late[-1])
        stddev = compute_stddev(sight, depths, side.fit.stddev, seen.ray_stddev)
        stddev[:, 0] = np.hypot(stddev[:, 0], origin.stddev)
        reasons = self._judge(seen.image, seen.finding, side, points)
        valid = reasons == ""
        count = len(valid)
        keypoints = JawKeypoints(
            stamp=seen.image.stamp,
            points=points[:count],
            likelihood=np.where(valid, seen.finding.likelihood[:count], 0.0),
            pixels=seen.finding.pixels[:count],
            valid=valid,
            stddev=stddev[:count],
            T_camera_jaw=self._origin.place(replace(origin, x=origin.x - self._track.speed * late[-1])),
            reasons=reasons,
        )
        return Located(keypoints=keypoints, scale=side.fit.scale)

    def _find_delays(self, seen: _Seen, T_camera_jaw: NDArray) -> NDArray:
        """Return how long after the image's stamp the points' rows were exposed (K + 1,) [s].

        The reference point, which tells where the jaw is, has one wherever it was found.
        """
        camera, rows = seen.image.camera, seen.finding.pixels[:, 1].copy()
        rows[-1] = project(self._rest[-1:] @ T_camera_jaw[:3, :3].T + T_camera_jaw[:3, 3], camera)[0, 1]
        return self._settings.readout * (rows / camera.height - 1.0)

    def _check_rest(self, seen: _Seen, sight: SideView, side: SideEvidence) -> None:
        """Compare the likely points with the jaw file: along the side where their rays meet it, across it by depth."""
        points = sight.points_at(self._rest[:, 1])
        points[:, 1] += side.fit.y
        self._rest_check.take(np.where(seen.likely[:, None], points, np.nan)[:-1])

    def _is_there(self, likely: NDArray) -> bool:
        """Say whether enough of the points (K + 1,) bool are likely for a jaw, more of them for one that was lost."""
        least = min(_LEAST_SEEN, len(likely))
        return likely.sum() >= (max(least, _LEAST_FOUND * len(likely)) if self.is_lost else least)

    def _find_likely(self, image: RgbdImage, finding: PixelFinding) -> NDArray:
        """Return which points (K + 1,) bool the finder believes in."""
        likely = finding.likelihood >= self._settings.likelihood
        return likely & lie_inside(image, finding.pixels) & np.isfinite(finding.stddev)

    def _fit_side(
        self, image: RgbdImage, sight: SideView, likely: NDArray, scale: DepthScale, T_camera_jaw: NDArray
    ) -> SideEvidence:
        """Return where the points are across the jaw's side: first near the known plane, then near the one found."""
        expected = sight.depths_at(self._rest[:, 1])
        lever = expected * sight.rays[:, 1]
        nothing = np.full(len(expected), np.nan)
        if image.depth is None:
            fit = fit_side(self._model, nothing, nothing, np.nan_to_num(lever), scale)
            return SideEvidence(fit=fit, has_depth=np.full(len(expected), self._settings.plane_depth))
        points = sight.camera + expected[:, None] * sight.rays
        excess = sample_depths(image.depth, image.camera, points, self._samples, T_camera_jaw)
        fit, settings = None, self._settings
        for gate in (settings.wide_gate, settings.gate):
            away = np.zeros(len(expected)) if fit is None else fit.y / sight.rays[:, 1]
            error = scale.error if fit is None else fit.scale.error
            evidence = weigh_depths(excess, away + error * expected, gate, settings.quantum)
            measured = self._measures(evidence)
            used = measured & likely
            fit = fit_side(
                self._model,
                np.where(used, evidence.excess * sight.rays[:, 1], np.nan),
                np.hypot(evidence.stddev, settings.depth_noise) * np.abs(sight.rays[:, 1]),
                np.nan_to_num(lever),
                scale,
            )
        with np.errstate(invalid="ignore"):
            refused = np.abs(fit.misfit) > settings.misfit
        hole = (evidence.known < settings.least_depths) & settings.plane_depth
        return SideEvidence(fit=fit, has_depth=(measured & ~refused) | hole)

    def _measures(self, evidence: DepthEvidence) -> NDArray:
        """Return at which points (K + 1,) bool enough depths, and most of them, are the finger's."""
        return (evidence.count >= self._settings.least_depths) & (evidence.share >= self._settings.least_share)

    def _judge(self, image: RgbdImage, finding: PixelFinding, side: SideEvidence, points: NDArray) -> NDArray:
        """Return what speaks against each key point (K,) str, the first reason that does; "" for nothing."""
        with np.errstate(invalid="ignore"):
            outside = (np.abs(points - self._rest) > self._box).any(axis=1)
        against = (
            ~lie_inside(image, finding.pixels),
            ~(finding.likelihood >= self._settings.likelihood),
            ~side.has_depth | ~np.isfinite(points).all(axis=1),
            outside,
        )
        return np.select(against, REASONS, default="")[:-1]


IMAGES = 15  # over which displacements are averaged
_LEAST_POINTS = 8  # with fewer, an affine map explains a bent finger, too
_BENT = 0.3e-3  # [m] root mean square of what no affine map explains: more of it is a load
_BENT_SHARE = 0.15  # of the displacement across the closing axis, the same


class RestCheck:
    """Finds how far the key points of one jaw at rest lie from its file, across the closing axis.

    Attributes:
        distance: the least root mean square of any IMAGES consecutive images of a jaw that is not bent [m]; NaN before.

    Args:
        rest: key points of the jaw file (K, 3) [m].
    """

    def __init__(self, rest: NDArray) -> None:
        self._rest = rest
        self.reset()

    def reset(self) -> None:
        """Forget what was seen."""
        self.distance = float("nan")
        self._begin()

    def _begin(self) -> None:
        """Begin to average."""
        self._sum, self._count, self._images = np.zeros_like(self._rest), np.zeros(len(self._rest), dtype=int), 0

    def take(self, points: NDArray) -> None:
        """Take the key points (K, 3) [m] of one image, NaN where one was not seen."""
        away = points - self._rest
        seen = np.isfinite(away).all(axis=1)
        self._sum[seen] += away[seen]
        self._count += seen
        self._images += 1
        if self._images < IMAGES:
            return
        often = self._count >= IMAGES // 2
        if often.sum() >= _LEAST_POINTS:
            self._judge(self._rest[often], self._sum[often] / self._count[often, None])
        self._begin()

    def _judge(self, rest: NDArray, away: NDArray) -> None:
        """Keep the root mean square of displacements (n, 3) [m] unless they are those of a bent jaw."""
        plane = np.column_stack((np.ones(len(rest)), rest[:, ::2]))
        left = away - plane @ np.linalg.lstsq(plane, away, rcond=None)[0]
        across, bent = (float(np.sqrt((part**2).sum(axis=1).mean())) for part in (away[:, 1:], left))
        if bent <= max(_BENT, _BENT_SHARE * across):
            self.distance = float(np.fmin(self.distance, across))
