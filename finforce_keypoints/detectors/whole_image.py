"""Key points by a DeepLabCut network that sees the whole image, or what is cut out of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project
from finforce.optional import import_cv2
from finforce_keypoints.errors import DetectionError
from finforce_keypoints.images import PixelDetection

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw
    from finforce_keypoints.images import RgbdImage
    from finforce_keypoints.networks.metadata import NameMap
    from finforce_keypoints.networks.model import KeypointModel, Peaks

CROP_MARGIN = 48.0  # px around the undeformed key points: 15 mm at the nearest that a wrist camera is
CROP_STEP = 64  # px, of a cut-out's height and width, so that a network rarely meets a new size
_BLANK = (124, 116, 104)  # ImageNet's mean, which is 0 to the network
_CONFIDENT = 0.6  # DeepLabCut's cut-off


@dataclass(frozen=True, kw_only=True)
class Crop:
    """A part of an image: left column, upper row, width, height [px]."""

    x: int
    y: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its rows and columns."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)


@dataclass(frozen=True, kw_only=True)
class _CropView:
    """The input of the network for some sides: a part of the image, blank but for a window, mirrored or not."""

    sides: tuple[str, ...]
    canvas: Crop
    window: Crop
    is_mirrored: bool = False


class WholeImageDetector:
    """Finds the key points of all jaws with one run of a network; a `PixelDetector`.

    A network of both jaws sees the image once. A network of one jaw sees one part of it for each jaw, in one batch:
    around the jaw where it is expected, else the half of the image on the jaw's side; the right jaw is mirrored, so
    that it looks like the left one that the network knows. Where statistics of the whole picture enter the answer, as
    by group normalisation, what is cut out does not follow the jaws.
    """

    def __init__(
        self,
        model: KeypointModel,
        names: NameMap,
        jaws: Mapping[str, Jaw],
        allow_resize: bool = False,
    ) -> None:
        """Take a network and its names.

        Args:
            model: the network.
            names: its body parts.
            jaws: side -> jaw.
            allow_resize: True if images of another size than the training's are scaled uniformly, less accurate.
        """
        self.name, self.sha256 = f"frame {model.path.stem}", model.sha256
        self._model, self._names = model, names
        self._allow_resize = allow_resize
        self._is_frozen = model.frozen_size != (None, None)
        self._points = {side: np.vstack((jaw.keypoints, jaw.reference_point)) for side, jaw in jaws.items()}

    def detect(self, image: RgbdImage, expected: Mapping[str, NDArray | None]) -> Mapping[str, PixelDetection]:
        """Return the key points of every jaw that is asked for; see `PixelDetector`.

        Raises:
            DetectionError: the image is not of the training's size, or the network gives no sensible offsets.
        """
        if not expected:
            return {}
        color = np.asarray(image.color)
        scale = self._find_scale(color.shape[:2])
        views = self._plan(image.camera, expected)
        peaks = self._model.locate(np.stack([self._show(color, view, scale) for view in views]))
        check_offsets(peaks)
        detections = {}
        for number, view in enumerate(views):
            pixels = _map_back(peaks.pixels[number], view, scale)
            places, box = pixels - (view.canvas.x, view.canvas.y), view.canvas
            is_known = ((places >= -0.5) & (places <= (box.width - 0.5, box.height - 0.5))).all(axis=1)
            likelihood = np.where(is_known, peaks.likelihood[number], 0.0)
            stddev = np.where(is_known, peaks.stddev[number] / scale, np.inf)
            pixels = np.where(is_known[:, None], pixels, np.nan)
            for side in view.sides:
                rows = self._names.rows[side]
                if likelihood[rows].any():
                    detections[side] = PixelDetection(
                        pixels=pixels[rows], likelihood=likelihood[rows], stddev=stddev[rows]
                    )
        return detections

    def _find_scale(self, size: tuple[int, int]) -> float:
        """Return network pixels per image pixel for an image of some height and width."""
        if self._model.accepts(size):
            return 1.0
        trained = self._model.training_size
        if not self._allow_resize or trained is None:
            raise DetectionError(
                f"image of {size[0]}x{size[1]} px (height x width): the network was trained on "
                f"{trained or self._model.frozen_size}; set the camera to that size, or allow resizing, at a loss of "
                "accuracy"
            )
        return float(np.divide(trained, size).min())

    def _plan(self, camera: CameraIntrinsics, expected: Mapping[str, NDArray | None]) -> list[_CropView]:
        """Return what the network is shown."""
        whole = Crop(x=0, y=0, width=camera.width, height=camera.height)
        poses = dict.fromkeys(expected) if self._model.sees_whole else expected
        boxes = {side: self._expect(camera, side, pose) for side, pose in poses.items()}
        if not self._names.is_of_one_jaw:
            known = [box for box in boxes.values() if box is not None]
            is_whole = self._is_frozen or len(known) < len(boxes)
            canvas = whole if is_whole else _join(known, whole)
            return [_CropView(sides=tuple(boxes), canvas=canvas, window=canvas)]
        rest = {side: whole if len(self._points) == 1 else _half(whole, side) for side in boxes}
        windows = [boxes[side] or rest[side] for side in boxes]
        largest = np.max([(window.width, window.height) for window in windows], axis=0)
        equal = [_place((window.x, window.y), largest, whole) for window in windows]
        canvases = [whole] * len(windows) if self._is_frozen else equal
        return [
            _CropView(
                sides=(side,), canvas=canvas, window=window if self._is_frozen else canvas, is_mirrored=side == "right"
            )
            for side, canvas, window in zip(boxes, canvases, windows, strict=True)
        ]

    def _expect(self, camera: CameraIntrinsics, side: str, T_camera_jaw: NDArray | None) -> Crop | None:
        """Return the part of the image where a jaw is expected, None where that is unknown."""
        if T_camera_jaw is None:
            return None
        T = np.asarray(T_camera_jaw, dtype=float)
        pixels = project(self._points[side] @ T[:3, :3].T + T[:3, 3], camera)
        low, high = pixels.min(axis=0) - CROP_MARGIN, pixels.max(axis=0) + CROP_MARGIN
        if not np.isfinite(pixels).all() or (high <= 0).any() or (low >= (camera.width, camera.height)).any():
            return None
        return _fit_box(low, high, Crop(x=0, y=0, width=camera.width, height=camera.height))

    def _show(self, color: NDArray, view: _CropView, scale: float) -> NDArray:
        """Return the picture (H, W, 3) uint8 of a view, in network pixels."""
        picture = color[view.canvas.slices]
        if view.window != view.canvas:
            picture = np.full_like(color, _BLANK)
            picture[view.window.slices] = color[view.window.slices]
            picture = picture[view.canvas.slices]
        if view.is_mirrored:
            picture = picture[:, ::-1]
        return picture if self._model.accepts(color.shape[:2]) else self._resize(picture, scale)

    def _resize(self, picture: NDArray, scale: float) -> NDArray:
        """Return a picture scaled uniformly, with a border at the right and at the bottom up to a frozen size."""
        cv2 = import_cv2()
        height, width = (max(1, round(px * scale)) for px in picture.shape[:2])
        kind = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
        picture = cv2.resize(np.ascontiguousarray(picture), (width, height), interpolation=kind)
        if not self._is_frozen:
            return picture
        framed = np.full((*self._model.training_size, 3), _BLANK, np.uint8)
        framed[:height, :width] = picture
        return framed


def check_offsets(peaks: Peaks) -> None:
    """Refuse peaks most of which have offsets longer than training allows.

    Raises:
        DetectionError: they have.
    """
    astray, kept = (peaks.astray > _CONFIDENT).sum(), (peaks.likelihood > _CONFIDENT).sum()
    if astray > kept:
        raise DetectionError(
            f"{astray} of {astray + kept} likely points have offsets longer than the training allows; expected a "
            "locref_std and outputs (heatmap, then locref) as in the network's metadata"
        )


def _map_back(pixels: NDArray, view: _CropView, scale: float) -> NDArray:
    """Return the pixels (n, 2) of the image for pixels (n, 2) of a view; the centre of the first one is (0, 0)."""
    pixels = (pixels + 0.5) / scale - 0.5
    if view.is_mirrored:
        pixels = np.column_stack((view.canvas.width - 1.0 - pixels[:, 0], pixels[:, 1]))
    return pixels + (view.canvas.x, view.canvas.y)


def _half(whole: Crop, side: str) -> Crop:
    """Return the half of an image on the side of a jaw; the rows of the image run from the left to the right jaw."""
    width = whole.width // 2
    return replace(whole, width=width, x=0 if side == "left" else whole.width - width)


def _join(boxes: Sequence[Crop], whole: Crop) -> Crop:
    """Return the box around several ones."""
    low = np.min([(box.x, box.y) for box in boxes], axis=0)
    high = np.max([(box.x + box.width, box.y + box.height) for box in boxes], axis=0)
    return _fit_box(low, high, whole)


def _fit_box(low: NDArray, high: NDArray, whole: Crop) -> Crop:
    """Return a box around two corners, of a size in steps and inside the image."""
    low = np.floor(np.clip(low, 0, (whole.width, whole.height)))
    high = np.ceil(np.clip(high, 0, (whole.width, whole.height)))
    return _place(low, np.ceil((high - low) / CROP_STEP) * CROP_STEP, whole)


def _place(corner: Sequence[float], size: NDArray, whole: Crop) -> Crop:
    """Return a box of some size (width, height) at a corner, moved into the image."""
    width, height = (int(min(px, limit)) for px, limit in zip(size, (whole.width, whole.height), strict=True))
    x, y = int(min(corner[0], whole.width - width)), int(min(corner[1], whole.height - height))
    return Crop(x=x, y=y, width=width, height=height)
