"""RGB-D images to key points in the jaw frames, image after image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.transforms import check_pose
from finforce_ifea.jaw.jaw import Jaw
from finforce_keypoints.errors import DetectionError, GeometryError, ImageOrderError, KeypointError
from finforce_keypoints.geometry.depth import DepthScale
from finforce_keypoints.geometry.jaw_localizer import JawKeypoints, JawLocalizer
from finforce_keypoints.geometry.side_picture import find_side
from finforce_keypoints.geometry.stillness import StillWatch
from finforce_keypoints.images import ImageWatch, PixelDetection, PixelDetector, RgbdImage, check_image
from finforce_keypoints.parameters import DetectorSettings, JawMount
from finforce_keypoints.tags import TagFinder

__all__ = ["JawKeypoints", "KeypointDetector"]

_SAME_SIDE = 2e-3  # [m] by which a reference point may lie off the plane of the key points
_OFF_CENTRE = 6e-3  # [m] by which the middle between two jaws may be off the gripper's
_FEW, _MEMORY = 0.4, 45  # share of a jaw's key points that are too few on average, and over how many images
# Images in a row in which a lost jaw is looked for, and then the interval: a search costs as much as ten images with it
_SEARCHES, _SEARCH_PERIOD = 30, 0.3  # images, s
_PRACTICE_SIZE, _RATE = (640, 480), 30.0  # px, Hz
_SCALE_DRIFT = 1e-3  # [1/s^0.5] random walk of the depth scale's error
_LEAST_SCALE_STDDEV = 5e-4  # images do not err independently: no average is better than this


@dataclass(frozen=True, kw_only=True, eq=False)
class _ColorDetections:
    """Contents of the colours of an image: key points by side where nothing has moved, else the pixels found.

    `is_watched` says whether anybody looked for motion; `tags` are the corners (4, 2) [px] of those seen, by number.
    """

    is_watched: bool
    still: Mapping[str, JawKeypoints] | None
    detections: Mapping[str, PixelDetection]
    tags: Mapping[int, NDArray] = field(default_factory=dict)


class KeypointDetector:
    """Finds the key points of one jaw or two in the images of one camera.

    A pixel detector finds their pixels. This class finds the poses of the jaws and the depths, and rejects outliers.

    Attributes:
        was_still: True if nothing moved in the last image, so that its key points are means over the images before.
        mounts: side -> how the jaw is mounted in the gripper.
        counts: "images", "still", "<side>" found, "<side>/<reason>" refused key points, "off centre".

    Raises:
        GeometryError: there is no jaw, a jaw is not the one of its side, or its reference point is not on the side of
            its key points.
        PoseError: the camera pose is not valid.
        MeshError: the mesh of a jaw is not valid.
    """

    def __init__(
        self,
        pixel_detector: PixelDetector,
        jaws: Mapping[str, Jaw],
        T_gripper_camera: NDArray,
        settings: DetectorSettings | None = None,
        watch: ImageWatch | None = None,
        rests: bool = False,
        mounts: Mapping[str, JawMount] | None = None,
        tags: TagFinder | None = None,
    ) -> None:
        """Prepare to look at jaws.

        Args:
            pixel_detector: of these jaws.
            jaws: side -> jaw.
            T_gripper_camera: (4, 4).
            settings: of the geometry.
            watch: notices a camera that fails; None: nobody does.
            rests: True if pixels and depth are left out where nothing has moved.
            mounts: by side; without, jaws stand straight and nothing covers them.
            tags: finds those of the mounts; None: nobody looks for them.
        """
        self.settings = settings or DetectorSettings()
        wrong = [side for side, jaw in jaws.items() if jaw.side != side]
        if wrong or not jaws:
            raise GeometryError(f"jaws {sorted(jaws)}, wrong side: {wrong}; expected left, right or both")
        for jaw in jaws.values():
            check_reference(jaw)
        T_gripper_camera = check_pose(T_gripper_camera, "T_gripper_camera")
        self._pixel_detector, self._image_watch, self._tags = pixel_detector, watch, tags
        self._still_watch = StillWatch() if rests else None
        self._counts_of = {side: len(jaw.keypoints) + 1 for side, jaw in jaws.items()}
        self.mounts = mounts or {side: JawMount() for side in jaws}
        self._jaws = {
            side: JawLocalizer(jaw, T_gripper_camera, self.settings, self.mounts[side]) for side, jaw in jaws.items()
        }
        self._visible = {side: self.mounts[side].seen_points(jaw)[:-1] for side, jaw in jaws.items()}
        self.reset()

    def reset(self) -> None:
        """Forget where the jaws were, the depth scale and the counts; for a new recording or another camera."""
        for part in (*self._jaws.values(), self._image_watch, self._still_watch, self._tags):
            if part is not None:
                part.reset()
        if hasattr(self._pixel_detector, "reset"):  # one that remembers the picture before
            self._pixel_detector.reset()
        self._stamp: float | None = None
        self._looks, self._shares = dict.fromkeys(self._jaws, 0), dict.fromkeys(self._jaws, 0.0)
        self._scale = DepthScale(error=0.0, stddev=self.settings.scale_stddev)
        self._color_detections: dict[float, _ColorDetections] = {}
        self._searches = dict.fromkeys(self._jaws, 0)
        self._searched = dict.fromkeys(self._jaws, -np.inf)
        self.was_still = self._is_mirrored = False
        self.counts: Counter[str] = Counter()

    def adjust(self, settings: DetectorSettings) -> None:
        """Go on with other thresholds of likelihood and of key points at rest; all other settings stay."""
        for jaw in self._jaws.values():
            jaw.adjust(settings.likelihood, settings.rest_tolerance)

    @property
    def name(self) -> str:
        """The method that finds the pixels, and its network."""
        return self._pixel_detector.name

    @property
    def sha256(self) -> str:
        """The checksum of its network, empty without one."""
        return self._pixel_detector.sha256

    @property
    def warnings(self) -> Mapping[str, str]:
        """Warnings of a jaw, by side, in a sentence."""
        said = {side: [jaw.warning] if jaw.warning else [] for side, jaw in self._jaws.items()}
        for side, share in self._shares.items():
            if self._looks[side] >= _MEMORY and share < _FEW:
                said[side].append(
                    f"{100 * share:.0f} % of the key points are seen on average: are the extrinsics right, is it the "
                    "finger of the jaw file, and nothing before it? finforce check tells"
                )
        if self._off_centre > _OFF_CENTRE:
            text = (
                f"the jaws' middle lies {1e3 * self._off_centre:.0f} mm off the gripper's: is the image cropped "
                "without camera_info, or has the camera moved?"
            )
            said = {side: [*texts, text] for side, texts in said.items()}
        if self._is_mirrored:
            said = {side: ["the image is mirrored: its tags decode only when it is flipped"] for side in said}
        return {side: "; ".join(texts) for side, texts in said.items() if texts}

    @property
    def depth_ratio(self) -> float:
        """Measured depth over that of the jaws' places by their colours [-]; NaN where that is not known."""
        return max((jaw.depth_ratio for jaw in self._jaws.values()), key=lambda ratio: abs(ratio - 1.0))

    @property
    def _off_centre(self) -> float:
        """By how much the middle between two jaws is off the gripper's [m]; 0 with one jaw."""
        return abs(sum(jaw.place for jaw in self._jaws.values()) / 2.0) if len(self._jaws) == 2 else 0.0

    @property
    def depth_scale(self) -> DepthScale:
        """The relative error of the depth image's scale, as the rigid reference points show it."""
        return self._scale

    def warm_up(self) -> None:
        """Do once all that images need, so that the first of them waits for no library; the jaws are forgotten."""
        image = _practice_image()
        for expected in ({side: None for side in self._jaws}, {side: jaw.middle for side, jaw in self._jaws.items()}):
            with suppress(KeypointError):  # a network of images of another size
                self._pixel_detector.detect(image, expected)
        for jaw in self._jaws.values():
            for number in range(2):  # the second is compared with the first
                later = replace(image, stamp=image.stamp + number / _RATE)
                jaw.locate(later, jaw.predict_pixels(image.camera), self._scale)
        self.reset()

    def detect(self, image: RgbdImage) -> Mapping[str, JawKeypoints]:
        """Return the key points of the jaws in an image; a jaw that is not found is absent.

        No jaw is returned while the jaws are further off the centre of the gripper than the settings allow; see
        `warnings`. While nothing moves, the key points are means over the images since the last motion.

        Raises:
            ImageError: the image's parts do not fit each other, it shows nothing, or the camera is frozen.
            ImageOrderError: it is not younger than the one before.
            DetectionError: the pixel detector returned a detection of the wrong shape.
            KeypointError: the pixel detector cannot use it.
        """
        check_image(image)
        if self._image_watch is not None:
            self._image_watch.check(image)
        if self._stamp is not None and image.stamp <= self._stamp:
            raise ImageOrderError(
                f"image of {image.stamp:.6f} s after one of {self._stamp:.6f} s; expected rising stamps; "
                "reset for a new recording"
            )
        self._drift(image.stamp)
        colors = self._color_detections.pop(image.stamp, None) or self._detect_color(image)
        self._color_detections = {
            stamp: later for stamp, later in self._color_detections.items() if stamp > image.stamp
        }
        self.was_still = colors.still is not None
        if colors.still is None:
            found = self._find(image, colors)
            if not colors.is_watched:
                return found
            return self._still_watch.take(found if len(found) == len(self._jaws) else {}, image) or found
        for jaw in self._jaws.values():
            jaw.rest(image.stamp)
        self.counts["still"] += 1
        return colors.still

    def detect_color(self, image: RgbdImage) -> None:
        """Look at an image whose depth is yet to come, so that less is left for `detect` to do once it is there.

        Raises:
            ImageError: colours and camera do not fit each other.
            KeypointError: the pixel detector cannot use it.
        """
        if self._stamp is None or image.stamp > self._stamp:
            check_image(image)
            self._color_detections[image.stamp] = self._detect_color(image)

    def _detect_color(self, image: RgbdImage) -> _ColorDetections:
        """Return what the colours of an image show."""
        watch = self._still_watch
        is_watched = watch is not None and all(jaw.is_settled for jaw in self._jaws.values())
        still = watch.confirm(image) if is_watched else None
        if still is not None:
            return _ColorDetections(is_watched=True, still=still, detections={})
        tags = self._find_tags(image) if self._tags is not None else {}
        detections = self._pixel_detector.detect(image, self._expect(image, tags))
        return _ColorDetections(is_watched=is_watched, still=None, detections=detections, tags=tags)

    def _find_tags(self, image: RgbdImage) -> Mapping[int, NDArray]:
        """Return the tags seen; notice whether the mirrored image has them on the jaws, as no mirror in view does."""
        tags = self._tags.find(image.color)
        self._is_mirrored = any(
            (corners := self._corners(side, self._tags.mirrored)) is not None and jaw.has_tag_at(image, corners)
            for side, jaw in self._jaws.items()
        )
        return tags

    def _expect(self, image: RgbdImage, tags: Mapping[int, NDArray]) -> dict[str, NDArray | None]:
        """Return where the jaws should be in an image, None for a lost one; one not worth a search yet is absent."""
        expected: dict[str, NDArray | None] = {}
        stamp = image.stamp
        for side, jaw in self._jaws.items():
            pose = jaw.expect(image, self._corners(side, tags))
            if pose is None and self._searches[side] >= _SEARCHES and stamp < self._searched[side] + _SEARCH_PERIOD:
                continue
            self._searches[side] = 0 if pose is not None else self._searches[side] + 1
            expected[side], self._searched[side] = pose, stamp
        return expected

    def _corners(self, side: str, tags: Mapping[int, NDArray]) -> NDArray | None:
        """Return the corners (4, 2) [px] of a jaw's tag; None where it is not seen."""
        tag = self.mounts[side].tag
        return None if tag is None else tags.get(tag.id)

    def _find(self, image: RgbdImage, colors: _ColorDetections) -> dict[str, JawKeypoints]:
        """Return the key points of the jaws in an image that has to be looked at."""
        found = {} if self._is_mirrored else self._locate(image, colors)
        self.counts["images"] += 1
        if self._off_centre > self.settings.largest_offset:  # intrinsics or place of a camera that bend every finger
            self.counts["off centre"] += 1
            found = {}
        for side in self._jaws:
            self._looks[side] += 1
            seen = float(found[side].valid[self._visible[side]].mean()) if side in found else 0.0
            self._shares[side] += (seen - self._shares[side]) / min(self._looks[side], _MEMORY)
        return found

    def _locate(self, image: RgbdImage, colors: _ColorDetections) -> dict[str, JawKeypoints]:
        """Return the key points of the jaws that are found."""
        keypoints = {}
        for side, jaw in self._jaws.items():
            detection = self._check(side, colors.detections.get(side))
            found = jaw.locate(image, detection, self._scale, self._corners(side, colors.tags))
            if found is not None:
                stddev = max(found.scale.stddev, _LEAST_SCALE_STDDEV)
                self._scale = replace(found.scale, stddev=min(stddev, self.settings.scale_stddev))
                keypoints[side] = found
                self._count(side, found)
        return keypoints

    def _drift(self, stamp: float) -> None:
        """Let the depth scale, once known, become less certain with time."""
        if self._stamp is not None:
            spread = np.hypot(self._scale.stddev, _SCALE_DRIFT * np.sqrt(stamp - self._stamp))
            self._scale = replace(self._scale, stddev=float(min(spread, self.settings.scale_stddev)))
        self._stamp = stamp

    def _check(self, side: str, detection: PixelDetection | None) -> PixelDetection | None:
        """Refuse a detection with another number of points than the jaw has."""
        count = self._counts_of[side]
        if detection is not None and (
            detection.pixels.shape != (count, 2) or not detection.likelihood.shape == detection.stddev.shape == (count,)
        ):
            raise DetectionError(
                f"{side} jaw: pixels {detection.pixels.shape}, likelihood {detection.likelihood.shape}, stddev "
                f"{detection.stddev.shape}; expected {count} rows: the jaw's key points, then its reference point"
            )
        return detection

    def _count(self, side: str, keypoints: JawKeypoints) -> None:
        """Count a found jaw and its refused key points."""
        self.counts[side] += 1
        for reason in keypoints.reasons[~keypoints.valid]:
            self.counts[f"{side}/{reason}"] += 1


def _practice_image() -> RgbdImage:
    """Return an image of noise, as large as a D405's, with something as far away as jaws are."""
    width, height = _PRACTICE_SIZE
    camera = CameraIntrinsics(
        width=width, height=height, fx=0.67 * width, fy=0.67 * width, cx=0.5 * width, cy=0.5 * height
    )
    rng = np.random.default_rng(0)
    color = rng.integers(60, 180, (height, width, 3), dtype=np.uint8)
    depth = rng.uniform(0.12, 0.14, (height, width)).astype(np.float32)
    return RgbdImage(stamp=0.0, color=color, depth=depth, camera=camera)


def check_reference(jaw: Jaw) -> None:
    """Refuse a jaw whose reference point the camera cannot see on the side of its key points.

    Raises:
        GeometryError: it lies off their plane by more than 2 mm.
    """
    left = jaw if jaw.side == "left" else jaw.mirrored()  # as the jaw file has it
    (x, y, z) = left.reference_point + 0.0  # no -0 in the message
    side_y = float(find_side(left).at(np.array([x, z])))
    if not abs(y - side_y) <= _SAME_SIDE:
        raise GeometryError(
            f"jaw '{jaw.name}': got the reference point [{x:g}, {y:g}, {z:g}] m, expected it on the side that the "
            f"camera sees, y = {side_y:g} m like the key points' ({1e3 * _SAME_SIDE:g} mm more or less), on the rigid "
            "holder; set reference_point in the jaw file"
        )
