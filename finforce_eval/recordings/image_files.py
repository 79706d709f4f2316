"""Images and intrinsics from files, checked."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.camera import MILLIMETRE, CameraIntrinsics, ImageError, IntrinsicsError, decode_depth, open_picture
from finforce.camera_file import build_camera, camera_numbers, cut_camera, read_camera
from finforce.errors import one_line
from finforce.files import FileError, read_bytes
from finforce_eval.errors import OptionError

_LARGEST_FILE = 1 << 28  # bytes
FARTHEST = 10.0  # [m] of the median depth; more means that the numbers are no metres


def read_image(path: Path | str) -> NDArray:
    """Return the pixels of a picture (h, w) or (h, w, channels), as the file has them.

    Raises:
        OptionError: the file is missing, no picture, damaged or too large.
    """
    path = Path(path)
    content = _read_file(path)
    try:
        image = open_picture(content, path.name, formats=None)
    except ImageError as error:
        raise OptionError(str(error)) from error
    return np.array(image.convert("RGB") if image.mode == "P" else image)


def _read_file(path: Path) -> bytes:
    """Return the content of a file; raises OptionError where it is no plain one, or too large."""
    try:
        return read_bytes(path, _LARGEST_FILE)
    except FileError as error:
        raise OptionError(f"{path.name}: {error}") from error


def read_depth(path: Path | str, scale: float = MILLIMETRE) -> NDArray:
    """Return a depth image (h, w) [m], NaN invalid, of whole numbers in steps of `scale` [m], or others in metres.

    Raises:
        OptionError: the file holds neither.
    """
    path = Path(path)
    image = _read_array(path) if path.suffix == ".npy" else read_image(path)
    if image.ndim != 2 or image.dtype.kind not in "uif" or image.dtype == np.uint8:
        raise OptionError(
            f"{path.name}: {image.dtype} of shape {image.shape}; expected a 16-bit grey PNG [mm] or an .npy file of "
            "shape (height, width) [m]"
        )
    if image.dtype.kind in "ui":
        depth = decode_depth(np.clip(image, 0, 65535).astype(np.uint16), "16UC1", scale=scale)
    else:
        depth = decode_depth(image, "32FC1")
    if np.isfinite(depth).any() and np.nanmedian(depth) > FARTHEST:
        raise OptionError(
            f"{path.name}: a median depth of {np.nanmedian(depth):.0f} m, expected {FARTHEST:g} m at most; whole "
            "numbers are steps of --depth-scale (0.001 m; TUM 0.0002, many BOP sets 0.0001), others metres"
        )
    return depth


def read_mask(path: Path | str) -> NDArray:
    """Return a mask (h, w) of a picture or an .npy file: alpha where there is one, else what is brighter than half.

    Raises:
        OptionError: the file holds no such thing.
    """
    path = Path(path)
    image = _read_array(path) if path.suffix == ".npy" else read_image(path)
    if image.ndim == 3 and image.shape[2] in (2, 4):
        image = image[..., -1]
    elif image.ndim == 3:
        image = image.max(axis=2)
    if image.ndim != 2 or image.dtype.kind not in "buif":
        raise OptionError(f"{path.name}: {image.dtype} of shape {image.shape}; expected a picture or (height, width)")
    return image.astype(bool) if image.dtype == bool else image > 0.5 * max(float(np.nan_to_num(image).max()), 1e-9)


def _read_array(path: Path) -> NDArray:
    """Return the array of an .npy file.

    Raises:
        OptionError: it is none, or of something else than numbers.
    """
    content = _read_file(path)
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # whatever a header can hold
        raise OptionError(f"{path.name}: no .npy file of numbers ({one_line(error)})") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "buif" or not array.size:
        raise OptionError(f"{path.name}: expected an .npy file of numbers")
    return array


def read_intrinsics(words: Sequence[str], shape: tuple[int, int], *, is_cut: bool = False) -> CameraIntrinsics:
    """Return the camera of images (h, w) from numbers, or from a file and perhaps the name of one of its cameras.

    Args:
        words: fx fy cx cy [and k1 k2 p1 p2 k3], also with commas, or what `read_camera` takes.
        shape: height and width of the images.
        is_cut: True if these may be the middle of the file's images, scaled.

    Raises:
        OptionError: they are neither, or of a camera with images of another size.
    """
    try:
        numbers = [float(part) for word in words for part in word.split(",")]
    except ValueError:
        numbers = []
    try:
        if numbers or len(words) > 2:
            return build_camera(camera_numbers(numbers), shape)
        if not is_cut:
            return read_camera(words[0], shape, *words[1:])
        return cut_camera(read_camera(words[0], None, *words[1:]), shape)
    except IntrinsicsError as error:
        raise OptionError(f"intrinsics {' '.join(words)[:80]}: {error}") from error
