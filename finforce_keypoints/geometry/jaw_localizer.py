"""One jaw in one image after another: its place, its key points, and a camera that is elsewhere.

A camera that is not where it is said to be shifts, turns and stretches the picture of a jaw's side, all of it an affine
map of the side's places; a load bends the finger, which is none. A load moves the key points along the closing axis, a
camera's errors move them across it, too. By both, the two are told apart.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project, rays_from_pixels
from finforce.messages import NOTHING_SHARED, SharedStddev
from finforce_ifea.jaw.jaw import Jaw
from finforce_keypoints.geometry.depth import (
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
from finforce_keypoints.geometry.jaw_pose import COVERED_STDDEV, Origin, OriginEstimator, OriginTrack, ReferencePatch
from finforce_keypoints.images import PixelDetection, RgbdImage, lie_inside
from finforce_keypoints.parameters import DetectorSettings, JawMount
from finforce_keypoints.tags import CORNER_STDDEV

GATES = (5e-3, 2e-3)  # [m] off the known side plane, then off the one found, beyond which depth is not the finger's
LEAST_DEPTHS, LEAST_SHARE = 6, 0.4  # samples of the finger with depth that a key point needs, and their share of all
DEPTH_NOISE = 0.06e-3  # [m] error of the depth that the samples of one point share
DEPTH_IMAGES = 5  # with depth at the jaw, over which that is compared with the jaw's place
DEPTH_WORDS = "the depth at the jaw is"
DEPTH_OFF = 0.2  # [-] of depth at the jaw by its place, above which it is of another unit or another picture
MISFIT = 5.0  # standard deviations of its depth off the fit, above which a key point is not there
TAGGED_STDDEV = 0.5e-3  # [m] of a shift that all points share beside a tag: holder and network give by so much
MOST_SLIP = 6e-3  # [m] along its z that a jaw in a holder is off its place; more is another camera or rig
_LEAST_SEEN = 3  # points, or all there are: fewer likely ones are no jaw
_LEAST_FOUND = 1 / 3  # share of the points that have to be likely where no jaw was known before
REASONS = ("image", "likelihood", "depth", "workspace", "covered")


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
        scale: of the depth image, as this jaw shows it; None where nobody knows.
        shared: standard deviations, beyond `stddev`, of what all points share.
    """

    stamp: float
    points: NDArray
    likelihood: NDArray
    pixels: NDArray
    valid: NDArray
    stddev: NDArray
    T_camera_jaw: NDArray
    reasons: NDArray
    scale: DepthScale | None = None
    shared: SharedStddev = NOTHING_SHARED


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """One image, what was found in it, which points (K + 1,) are likely, their rays (K + 1, 3) and these' errors.

    `tag` are the rays (4, 3) to the corners of the jaw's tag, None where none is seen.
    """

    image: RgbdImage
    detection: PixelDetection
    likely: NDArray
    rays: NDArray
    ray_stddev: NDArray
    tag: NDArray | None


class JawLocalizer:
    """Follows one jaw; raises MeshError when the jaw's mesh is bad."""

    def __init__(
        self, jaw: Jaw, T_gripper_camera: NDArray, settings: DetectorSettings, mount: JawMount | None = None
    ) -> None:
        """Prepare where to sample depth on the jaw."""
        self._settings, self._sign = settings, 1.0 if jaw.side == "left" else -1.0
        self._mount = mount or JawMount()
        self._visible = self._mount.seen_points(jaw)
        self._origin = OriginEstimator(jaw, T_gripper_camera, settings, self._mount)
        self._track = OriginTrack(settings)
        self._patch, self._rest_check = ReferencePatch(jaw), _RestCheck(jaw.keypoints)
        self._unconfirmed, self._slip, self._astray, self._is_tag_elsewhere = 0, 0.0, 0.0, False
        self._ratios: deque[float] = deque(maxlen=DEPTH_IMAGES)
        self._samples = build_side_samples(jaw)
        self._rest = np.vstack((jaw.keypoints, jaw.reference_point))
        self._model = SideModel(places=self._rest[:, ::2])
        self._box = np.array([settings.workspace_closing, settings.workspace_width, settings.workspace_length])

    def adjust(self, likelihood: float, rest_tolerance: float) -> None:
        """Take another least likelihood, and distance [m] of key points at rest above which a warning is given."""
        self._settings = replace(self._settings, likelihood=likelihood, rest_tolerance=rest_tolerance)

    def reset(self) -> None:
        """Forget where the jaw was."""
        self._track.reset()
        self._patch.reset()
        self._rest_check.reset()
        self._unconfirmed, self._slip, self._astray, self._is_tag_elsewhere = 0, 0.0, 0.0, False
        self._ratios: deque[float] = deque(maxlen=DEPTH_IMAGES)

    @property
    def warning(self) -> str:
        """A warning about this jaw, in a sentence; "" for none."""
        if self._is_tag_elsewhere:
            return f"tag {self._mount.tag.id} is not where the rig has it: is it on the other side, or of another rig?"
        if abs(self._astray) > MOST_SLIP:
            return (
                f"the jaw lies {1e3 * self._astray:+.0f} mm along its z from where the rig has it: is the image zoomed "
                "or stabilised, or of another rig?"
            )
        if abs((ratio := self.depth_ratio) - 1.0) > DEPTH_OFF:
            return describe_depth(ratio)
        distance = self._rest_check.distance
        if not distance > self._settings.rest_tolerance:
            return ""
        return (
            f"the key points at rest lie {1e3 * distance:.1f} mm from the jaw file: are the camera's extrinsics right?"
        )

    @property
    def depth_ratio(self) -> float:
        """Measured depth over that of the jaw's place by its colours [-], over some images; NaN before."""
        return median(self._ratios) if len(self._ratios) == DEPTH_IMAGES else float("nan")

    @property
    def is_lost(self) -> bool:
        """True if the jaw has to be looked for everywhere."""
        return self._track.is_lost

    @property
    def place(self) -> float:
        """The position of the jaw's origin on the closing axis [m]; NaN when it is lost."""
        return self._track.place

    @property
    def is_settled(self) -> bool:
        """True if the jaw's place is no longer learnt, so that images in a row tell the same."""
        return self._patch.is_settled

    def rest(self, stamp: float) -> None:
        """Take it that the jaw has not moved from the last image to one of `stamp` [s]."""
        self._track.rest(stamp)

    @property
    def middle(self) -> NDArray:
        """T_camera_jaw (4, 4) in the middle of the opening range."""
        return self._origin.place(self._origin.middle)

    def predict_pixels(self, camera: CameraIntrinsics) -> PixelDetection:
        """Return the detection of a jaw at rest, seen without error in the middle of the opening range."""
        T, count = self.middle, len(self._rest)
        return PixelDetection(
            pixels=project(self._rest @ T[:3, :3].T + T[:3, 3], camera),
            likelihood=np.ones(count),
            stddev=np.full(count, 0.5),
        )

    def expect(self, image: RgbdImage, corners: NDArray | None) -> NDArray | None:
        """Return T_camera_jaw (4, 4) where the jaw should be in an image; None when it is lost.

        Args:
            image: the image.
            corners: of its tag (4, 2) [px]; None where it is not seen.
        """
        forecast = self._track.forecast(image.stamp)
        if forecast is not None:
            return self._origin.place(replace(forecast, slip=self._slip))
        if corners is None:
            return None
        nothing = np.full((len(self._rest), 3), np.nan)
        found = self._origin.measure(
            nothing, nothing[:, 0], rays_from_pixels(corners, image.camera), _tag_stddev(image)
        )
        return None if found is None else self._origin.place(found)

    def has_tag_at(self, image: RgbdImage, corners: NDArray) -> bool:
        """Return True if a jaw of the opening range has its tag at corners (4, 2) [px] of an image."""
        return not self._origin.is_elsewhere(rays_from_pixels(corners, image.camera))

    def locate(
        self, image: RgbdImage, detection: PixelDetection | None, scale: DepthScale, corners: NDArray | None = None
    ) -> JawKeypoints | None:
        """Return the jaw's key points, None when nobody knows where the jaw is.

        Args:
            image: the image, checked.
            detection: the pixels found; None when the pixel_detector saw nothing of the jaw.
            scale: prior of the depth image's scale.
            corners: of its tag (4, 2) [px]; None where it is not seen.
        """
        if detection is None:
            self._track.update(image.stamp, None)
            return None
        seen = self._look(image, detection, corners)
        measured = self._measure(seen)
        origin = self._track.update(image.stamp, measured)
        if measured is not None:
            self._slip = measured.slip
        if origin is None:
            return None
        keypoints = self._describe(seen, scale, replace(origin, slip=self._slip))
        # without one key point that depth confirms, a picture of a jaw would do as well
        self._unconfirmed = 0 if keypoints.valid.any() else self._unconfirmed + 1
        if self._unconfirmed >= self._settings.lost_images:
            self._track.reset()
            return None
        return keypoints

    def _look(self, image: RgbdImage, detection: PixelDetection, corners: NDArray | None) -> _Seen:
        """Return the rays to the points that were found, and which of these the pixel detector believes in."""
        inside = lie_inside(image, detection.pixels)
        likely = detection.likelihood >= self._settings.likelihood
        return _Seen(
            image=image,
            detection=detection,
            likely=likely & inside & np.isfinite(detection.stddev) & self._visible,
            rays=rays_from_pixels(np.where(inside[:, None], detection.pixels, np.nan), image.camera),
            ray_stddev=detection.stddev / np.sqrt(image.camera.fx * image.camera.fy),
            tag=None if corners is None else rays_from_pixels(corners, image.camera),
        )

    def _measure(self, seen: _Seen) -> Origin | None:
        """Return where one image shows the jaw; None where it does not."""
        self._is_tag_elsewhere = seen.tag is not None and self._origin.is_elsewhere(seen.tag)
        rays = np.where(seen.likely[:, None], seen.rays, np.nan)
        measured = self._origin.measure(rays, seen.ray_stddev, seen.tag, _tag_stddev(seen.image))
        if measured is None or self._is_tag_elsewhere or not self._is_there(seen.likely):
            return None
        self._astray = measured.slip
        if abs(measured.slip) > MOST_SLIP:
            return None
        if seen.likely[-1] and not self._mount.is_held:
            image, forecast = seen.image, self._track.forecast(seen.image.stamp)
            return self._patch.refine(image.color, image.camera, measured, self._origin.place, forecast)
        return measured

    def _describe(self, seen: _Seen, scale: DepthScale, origin: Origin) -> JawKeypoints:
        """Return the key points of the jaw at an origin."""
        T_camera_jaw = self._origin.place(origin)
        sight = look_along(seen.rays, T_camera_jaw)
        # closing moves the jaw in the plane whose depth is measured: of another time it is as good, from where it was
        T_measured = self._origin.place(replace(origin, x=origin.x + self._track.speed * seen.image.depth_delay))
        fit, has_depth = self._fit_side(seen.image, sight, seen.likely, scale, T_measured)
        depths = sight.depths_at(self._rest[:, 1] + fit.y)
        self._check_rest(seen, sight, fit)
        points = np.where(has_depth[:, None], sight.camera + depths[:, None] * sight.rays, np.nan)
        late = self._find_delays(seen, T_camera_jaw)
        points[:, 0] -= self._sign * self._track.speed * (late - late[-1])
        # where a holder covers what is rigid, the place was found by points that bend: it tells nothing of the bending
        is_held = self._mount.is_held
        shared = COVERED_STDDEV if seen.tag is None else float(np.hypot(origin.stddev, TAGGED_STDDEV))
        y_stddev = np.where(is_held, self._model.relief, fit.stddev)
        stddev = compute_stddev(sight, depths, y_stddev, seen.ray_stddev)
        own = np.sqrt(max(origin.stddev**2 - origin.shared**2, 0.0))
        stddev[:, 0] = np.hypot(stddev[:, 0], 0.0 if is_held else own)
        reasons = self._judge(seen.image, seen.detection, has_depth, points)
        valid = reasons == ""
        count = len(valid)
        return JawKeypoints(
            stamp=seen.image.stamp,
            points=points[:count],
            likelihood=np.where(valid, seen.detection.likelihood[:count], 0.0),
            pixels=seen.detection.pixels[:count],
            valid=valid,
            stddev=stddev[:count],
            T_camera_jaw=self._origin.place(replace(origin, x=origin.x - self._track.speed * late[-1])),
            reasons=reasons,
            scale=fit.scale,
            shared=SharedStddev(shared if is_held else 0.0, *self._mount.stddev, closing=origin.shared),
        )

    def _find_delays(self, seen: _Seen, T_camera_jaw: NDArray) -> NDArray:
        """Return how long after the image's stamp the points' rows were exposed (K + 1,) [s].

        The reference point, which tells where the jaw is, has one wherever it was found.
        """
        camera, rows = seen.image.camera, seen.detection.pixels[:, 1].copy()
        rows[-1] = project(self._rest[-1:] @ T_camera_jaw[:3, :3].T + T_camera_jaw[:3, 3], camera)[0, 1]
        return self._settings.readout * (rows / camera.height - 1.0)

    def _check_rest(self, seen: _Seen, sight: SideView, fit: SideFit) -> None:
        """Compare the likely points with the jaw file: along the side where their rays meet it, across it by depth."""
        points = sight.points_at(self._rest[:, 1])
        points[:, 1] += fit.y
        self._rest_check.take(np.where(seen.likely[:, None], points, np.nan)[:-1])

    def _is_there(self, likely: NDArray) -> bool:
        """Say whether enough of the points (K + 1,) bool are likely for a jaw, more of them for one that was lost."""
        count = self._visible.sum()
        least = min(_LEAST_SEEN, count)
        return likely.sum() >= (max(least, _LEAST_FOUND * count) if self.is_lost else least)

    def _fit_side(
        self, image: RgbdImage, sight: SideView, likely: NDArray, scale: DepthScale, T_camera_jaw: NDArray
    ) -> tuple[SideFit, NDArray]:
        """Return where the points are across the jaw's side, and which of them (K + 1,) bool the depth confirms.

        They are looked for first near the known plane, then near the one found.
        """
        expected = sight.depths_at(self._rest[:, 1])
        lever = expected * sight.rays[:, 1]
        nothing = np.full(len(expected), np.nan)
        if image.depth is None:
            fit = fit_side(self._model, nothing, nothing, np.nan_to_num(lever), scale)
            return fit, np.full(len(expected), self._settings.plane_depth)
        points = sight.camera + expected[:, None] * sight.rays
        excess = sample_depths(image.depth, image.camera, points, self._samples, T_camera_jaw)
        known = np.isfinite(excess) & likely[:, None]
        if known.any():
            away = excess[known] / np.broadcast_to(expected[:, None], excess.shape)[known]
            self._ratios.append(1.0 + float(np.median(away)))
        fit = None
        for gate in GATES:
            away = np.zeros(len(expected)) if fit is None else fit.y / sight.rays[:, 1]
            error = scale.error if fit is None else fit.scale.error
            evidence = weigh_depths(excess, away + error * expected, gate, self._settings.quantum)
            # enough depths, and most of them, are the finger's
            measured = (evidence.count >= LEAST_DEPTHS) & (evidence.share >= LEAST_SHARE)
            used = measured & likely
            fit = fit_side(
                self._model,
                np.where(used, evidence.excess * sight.rays[:, 1], np.nan),
                np.hypot(evidence.stddev, DEPTH_NOISE) * np.abs(sight.rays[:, 1]),
                np.nan_to_num(lever),
                scale,
            )
        with np.errstate(invalid="ignore"):
            refused = np.abs(fit.misfit) > MISFIT
        hole = (evidence.known < LEAST_DEPTHS) & self._settings.plane_depth
        return fit, (measured & ~refused) | hole

    def _judge(self, image: RgbdImage, detection: PixelDetection, has_depth: NDArray, points: NDArray) -> NDArray:
        """Return what speaks against each key point (K,) str, the first reason that does; "" for nothing."""
        with np.errstate(invalid="ignore"):
            outside = (np.abs(points - self._rest) > self._box).any(axis=1)
        against = (
            ~lie_inside(image, detection.pixels),
            ~(detection.likelihood >= self._settings.likelihood),
            ~has_depth | ~np.isfinite(points).all(axis=1),
            outside,
        )
        return np.where(self._visible, np.select(against, REASONS[:-1], default=""), REASONS[-1])[:-1]


def describe_depth(ratio: float) -> str:
    """Return what to say of depth that is so many times that of the jaw's place."""
    return (
        f"{DEPTH_WORDS} {ratio:.3g} times that of its place by the colours: check the unit of the depth "
        "images, depth_scale, that they are aligned to the colours, and that the jaws are not nearer than the camera "
        "can measure"
    )


def _tag_stddev(image: RgbdImage) -> float:
    """Return the standard deviation of rays to a tag's corners [-]."""
    return float(CORNER_STDDEV / np.sqrt(image.camera.fx * image.camera.fy))


IMAGES = 15  # over which displacements are averaged
_LEAST_POINTS = 8  # with fewer, an affine map explains a bent finger, too
_BENT = 0.3e-3  # [m] root mean square of what no affine map explains: more of it is a load
_BENT_SHARE = 0.15  # of the displacement across the closing axis, the same


class _RestCheck:
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
