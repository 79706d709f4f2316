"""RGB-D images to key points in the jaw frames, image after image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.skipping import ALL, STILL, Skips
from finforce.transforms import check_pose
from finforce_ifea.jaw.jaw import Jaw
from finforce_keypoints.errors import DetectionError, GeometryError, ImageOrderError, KeypointError
from finforce_keypoints.geometry.depth import DepthScale
from finforce_keypoints.geometry.jaw_localizer import JawKeypoints, JawLocalizer
from finforce_keypoints.geometry.side_picture import find_side
from finforce_keypoints.geometry.stillness import StillWatch
from finforce_keypoints.images import RgbdImage, check_image
from finforce_keypoints.pixel_finder import PixelFinder, PixelFinding
from finforce_keypoints.settings import LOOK_EVERY, RULES, SEARCH_EVERY, SEARCHED, UNSEEN, DetectorSettings

__all__ = ["JawKeypoints", "KeypointDetector"]

_SAME_SIDE = 2e-3  # [m] by which a reference point may lie off the plane of the key points
_BESIDE = 6e-3  # [m] by which the middle between two jaws may lie beside the gripper's
_FEW, _MEMORY = 0.4, 45  # share of a jaw's key points that are too few on average, and over how many images
_PRACTICE_SIZE, _RATE = (640, 480), 30.0  # px, Hz
_LEAST_SCALE_STDDEV = 5e-4  # images do not err independently: no average is better than this


@dataclass(frozen=True, kw_only=True, eq=False)
class _Look:
    """A picture, which jaws were looked for in it, and what was found of them."""

    stamp: float
    color: NDArray
    sides: tuple[str, ...]
    findings: Mapping[str, PixelFinding]


class KeypointDetector:
    """Finds the key points of one jaw or two in the images of one camera.

    A finder gives their pixels; the jaws' places, depths, and what is believed, are found here.

    Raises:
        GeometryError: there is no jaw, a jaw is not the one of its side, or its reference point is not on the side of
            its key points.
        PoseError: the camera's pose is none.
        MeshError: a jaw's mesh is bad.
    """

    def __init__(
        self,
        finder: PixelFinder,
        jaws: Mapping[str, Jaw],
        T_gripper_camera: NDArray,
        settings: DetectorSettings | None = None,
        skips: Skips | None = None,
    ) -> None:
        """Prepare to look at jaws, side -> jaw, with a camera at T_gripper_camera (4, 4); every image without skips."""
        self.settings = settings or DetectorSettings()
        self._skips = skips or Skips(RULES, (ALL,))
        wrong = [side for side, jaw in jaws.items() if jaw.side != side]
        if wrong or not jaws:
            raise GeometryError(f"jaws {sorted(jaws)}, wrong side: {wrong}; expected left, right or both")
        for jaw in jaws.values():
            check_reference(jaw)
        T_gripper_camera = check_pose(T_gripper_camera, "T_gripper_camera")
        self._finder = finder
        self._counts_of = {side: len(jaw.keypoints) + 1 for side, jaw in jaws.items()}
        self._jaws = {side: JawLocalizer(jaw, T_gripper_camera, self.settings) for side, jaw in jaws.items()}
        self.reset()

    def reset(self) -> None:
        """Forget where the jaws were, the depth scale and the counts; for a new recording or another camera."""
        for jaw in self._jaws.values():
            jaw.reset()
        self._stamp: float | None = None
        self._looked = -np.inf
        self._begun: _Look | None = None
        self._missed = dict.fromkeys(self._jaws, 0)
        self._looks, self._shares = dict.fromkeys(self._jaws, 0), dict.fromkeys(self._jaws, 0.0)
        self._watch = StillWatch()
        self._scale = DepthScale(error=0.0, stddev=self.settings.scale_stddev)
        self.counts: Counter[str] = Counter()

    @property
    def lost_sides(self) -> tuple[str, ...]:
        """The jaws that have to be looked for everywhere."""
        return tuple(side for side, jaw in self._jaws.items() if jaw.is_lost)

    @property
    def warnings(self) -> Mapping[str, str]:
        """What is suspicious about a jaw, by side, in a sentence."""
        said = {side: [jaw.warning] if jaw.warning else [] for side, jaw in self._jaws.items()}
        for side, share in self._shares.items():
            if self._looks[side] >= _MEMORY and share < _FEW:
                said[side].append(
                    f"{100 * share:.0f} % of the key points are seen on average: is it the finger of the jaw file, and "
                    "nothing before it?"
                )
        if self._beside > _BESIDE:
            text = (
                f"the jaws' middle lies {1e3 * self._beside:.0f} mm beside the gripper's: is the picture cut and "
                "camera_info not, or the camera elsewhere?"
            )
            said = {side: [*texts, text] for side, texts in said.items()}
        return {side: "; ".join(texts) for side, texts in said.items() if texts}

    @property
    def _beside(self) -> float:
        """By how much the middle between two jaws lies beside the gripper's [m]; 0 with one jaw."""
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
                self._finder.find(image, expected)
        for jaw in self._jaws.values():
            for number in range(2):  # the second is compared with the first
                later = replace(image, stamp=image.stamp + number / _RATE)
                jaw.locate(later, jaw.imagine(image.camera), self._scale)
        self.reset()

    def confirm(self, stamp: float, color: NDArray, camera: CameraIntrinsics) -> Mapping[str, JawKeypoints] | None:
        """Return the key points of an image in which nothing has moved, None where it has to be looked at in full.

        They are the means of the images since when nothing has moved; "confirmed" in `counts` counts them. A motion of
        more than `stillness.LARGEST_SHIFT` is seen at once; all that cannot be seen so, after `LOOK_EVERY` at most.

        Args:
            stamp: of the image [s].
            color: (h, w, 3) uint8.
            camera: its intrinsics.
        """
        is_due = self._stamp is None or not self._stamp < stamp <= self._looked + LOOK_EVERY
        if is_due or not self._skips.allows(STILL) or not all(jaw.is_settled for jaw in self._jaws.values()):
            return None
        found = self._watch.confirm(stamp, color, camera)
        if found is not None:
            self._drift(stamp)
            for jaw in self._jaws.values():
                jaw.rest(stamp)
            self._skips.count(STILL)
            self.counts["confirmed"] += 1
        return found

    def begin(self, stamp: float, color: NDArray, camera: CameraIntrinsics) -> None:
        """Find the pixels of a picture's key points while its depth is on its way; `detect` takes them from here.

        A picture that `detect` would refuse is left to it.

        Args:
            stamp: of the image [s].
            color: (h, w, 3) uint8; `detect` knows it by being the same array.
            camera: its intrinsics.

        Raises:
            ImageError: colour and camera do not fit each other.
            KeypointError: the finder cannot use it.
        """
        self._begun = None
        image = RgbdImage(stamp=stamp, color=color, depth=None, camera=camera)
        check_image(image)
        if self._stamp is None or stamp > self._stamp:
            self._begun = self._look(image)

    def detect(self, image: RgbdImage) -> Mapping[str, JawKeypoints]:
        """Return the key points of the jaws in an image; a jaw that is not found is absent.

        None is there while their middle lies beside the gripper's by more than the settings allow; see `warnings`.
        Counts go to `counts`: "images", "<side>" found, "<side>/<reason>" refused key points,
        "beside".

        Raises:
            ImageError: the image's parts do not fit each other.
            ImageOrderError: it is not younger than the one before.
            DetectionError: the finder returned a finding of the wrong shape.
            KeypointError: the finder cannot use it.
        """
        check_image(image)
        if self._stamp is not None and image.stamp <= self._stamp:
            raise ImageOrderError(
                f"image of {image.stamp:.6f} s after one of {self._stamp:.6f} s; expected rising stamps; "
                "reset for a new recording"
            )
        self._drift(image.stamp)
        self._looked = image.stamp
        look, self._begun = self._begun, None
        if look is None or look.stamp != image.stamp or look.color is not image.color:
            look = self._look(image)
        self.counts["images"] += 1
        found = self._locate(image, look.findings)
        if self._beside > self.settings.largest_beside:  # intrinsics or place of a camera that bend every finger
            self.counts["beside"] += 1
            found = {}
        for side in look.sides:
            self._looks[side] += 1
            seen = float(found[side].valid.mean()) if side in found else 0.0
            self._shares[side] += (seen - self._shares[side]) / min(self._looks[side], _MEMORY)
        self._missed = {side: 0 if side in found else missed + 1 for side, missed in self._missed.items()}
        if not self._skips.allows(STILL):
            return found
        return self._watch.take(found if len(found) == len(self._jaws) else {}, image.color, image.camera) or found

    def _look(self, image: RgbdImage) -> _Look:
        """Return the pixels of the jaws that are looked for in a picture."""
        expected = {side: jaw.expect(image.stamp) for side, jaw in self._jaws.items() if self._is_wanted(side)}
        findings = self._finder.find(image, expected) if expected else {}
        return _Look(stamp=image.stamp, color=image.color, sides=tuple(expected), findings=findings)

    def _is_wanted(self, side: str) -> bool:
        """Say whether a jaw is looked for in the next image; one that has long been lost is so in every few only."""
        beyond = self._missed[side] - SEARCHED
        is_due = beyond < 0 or beyond % SEARCH_EVERY == SEARCH_EVERY - 1
        if is_due or not self._jaws[side].is_lost or not self._skips.allows(UNSEEN):
            return True
        self._skips.count(UNSEEN)
        return False

    def _locate(self, image: RgbdImage, findings: Mapping[str, PixelFinding]) -> dict[str, JawKeypoints]:
        """Return the key points of the jaws that are found."""
        keypoints = {}
        for side, jaw in self._jaws.items():
            finding = self._check(side, findings.get(side))
            located = jaw.locate(image, finding, self._scale)
            if located is not None:
                stddev = max(located.scale.stddev, _LEAST_SCALE_STDDEV)
                self._scale = replace(located.scale, stddev=min(stddev, self.settings.scale_stddev))
                keypoints[side] = located.keypoints
                self._count(side, located.keypoints)
        return keypoints

    def _drift(self, stamp: float) -> None:
        """Let the depth scale, once known, become less certain with time."""
        if self._stamp is not None:
            spread = np.hypot(self._scale.stddev, self.settings.scale_drift * np.sqrt(stamp - self._stamp))
            self._scale = replace(self._scale, stddev=float(min(spread, self.settings.scale_stddev)))
        self._stamp = stamp

    def _check(self, side: str, finding: PixelFinding | None) -> PixelFinding | None:
        """Refuse a finding with another number of points than the jaw has."""
        count = self._counts_of[side]
        if finding is not None and (
            finding.pixels.shape != (count, 2) or not finding.likelihood.shape == finding.stddev.shape == (count,)
        ):
            raise DetectionError(
                f"{side} jaw: pixels {finding.pixels.shape}, likelihood {finding.likelihood.shape}, stddev "
                f"{finding.stddev.shape}; expected {count} rows: the jaw's key points, then its reference point"
            )
        return finding

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
