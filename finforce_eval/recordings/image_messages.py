"""Colour, depth and camera messages to pixels and back, plain or compressed.

Compressed images are those of image_transport: jpeg or png on `.../compressed`, and a 16-bit png behind twelve bytes of
header on `.../compressedDepth`. It knows no bags and no topics.
"""

from __future__ import annotations

import io
import struct
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import MILLIMETRE, ImageError, decode_color, decode_depth
from finforce.errors import MissingDependencyError
from finforce.messages import layout_of

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
DEPTH_FORMAT = "16UC1; compressedDepth png"
DEPTH_HEADER = 12  # bytes of compressed_depth_image_transport: an enum and two numbers for 32-bit depth
PNG = b"\x89PNG"
STEPPED = ("", "16UC1", "mono16")  # what a png of depth can be said to hold; of 32FC1 it holds inverse depths
LARGEST_PICTURE = 50_000_000  # px, of a picture that is unpacked: no camera here makes more
QUALITY = 90  # of a jpeg, the key points' pixels stay within a few hundredths
LEVEL = 1  # of png: the highest makes a noisy depth image a quarter smaller, and takes eighty times as long


def color_from_message(message: Any) -> NDArray[np.uint8]:
    """Return the colour image (h, w, 3) RGB of a sensor_msgs/Image or CompressedImage.

    Raises:
        ImageError: the encoding is not known, or the data are damaged.
    """
    if not is_compressed(message):
        return decode_color(message.data, message.encoding, layout_of(message))
    picture = _open_picture(bytes(message.data), f"colour image {message.format!r}")
    return np.array(picture.convert("RGB"))


def depth_from_message(message: Any, scale: float = MILLIMETRE) -> NDArray[np.float32]:
    """Return the depth image (h, w) [m], NaN invalid, of a sensor_msgs/Image or CompressedImage.

    One step of 16 bits is `scale` [m].

    Raises:
        ImageError: the encoding is not known, or the data are damaged.
    """
    if not is_compressed(message):
        return decode_depth(message.data, message.encoding, layout_of(message), scale)
    return decode_depth(depth_steps(message), "16UC1", scale=scale)


def depth_steps(message: Any) -> NDArray[np.uint16]:
    """Return the depth image (h, w) in steps, most cameras' are of 1 mm, 0 invalid, of a CompressedImage.

    Raises:
        ImageError: it is no 16-bit png.
    """
    encoding = message.format.partition(";")[0].strip() if ";" in message.format else ""
    if encoding not in STEPPED:
        raise ImageError(f"depth image {message.format!r}: encoding {encoding}; expected '{DEPTH_FORMAT}'")
    data = bytes(message.data)
    begin = data.find(PNG, 0, DEPTH_HEADER + len(PNG))
    if begin < 0:
        raise ImageError(f"depth image {message.format!r}: no png in it; expected '{DEPTH_FORMAT}'")
    image = np.array(_open_picture(data[begin:], f"depth image {message.format!r}"))
    if image.ndim != 2 or image.dtype.kind not in "ui" or image.dtype == np.uint8:
        raise ImageError(f"depth image {message.format!r}: {image.dtype} {image.shape}; expected 16 bits, one channel")
    return np.clip(image, 0, 65535).astype(np.uint16)


def is_compressed(message: Any) -> bool:
    """Say whether a message is a CompressedImage."""
    return hasattr(message, "format")


def encode_color(color: NDArray[np.uint8], kind: str = "jpeg", quality: int = QUALITY) -> bytes:
    """Return a colour image (h, w, 3) RGB as the bytes of a "jpeg" of some quality (1 to 95), or of a "png"."""
    buffer = io.BytesIO()
    options = {"quality": quality} if kind == "jpeg" else {"compress_level": LEVEL}
    _pillow().fromarray(color).save(buffer, format=kind, **options)
    return buffer.getvalue()


def compress_depth(steps: NDArray[np.uint16]) -> bytes:
    """Return a 16-bit depth image (h, w) as `compressedDepth` has it: a header of zeros and a png."""
    buffer = io.BytesIO()
    _pillow().fromarray(steps).save(buffer, format="png", compress_level=LEVEL)
    return bytes(DEPTH_HEADER) + buffer.getvalue()


def _open_picture(data: bytes, what: str) -> Any:
    """Return a decoded picture of Pillow."""
    pillow = _pillow()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", pillow.DecompressionBombWarning)  # smaller ones are refused below
            picture = pillow.open(io.BytesIO(data), formats=("JPEG", "PNG"))
        if picture.width * picture.height > LARGEST_PICTURE:
            raise ImageError(f"{what}: {picture.width} x {picture.height}; expected at most {LARGEST_PICTURE} pixels")
        picture.load()
    except pillow.UnidentifiedImageError as error:
        raise ImageError(f"{what}: {len(data)} bytes that are neither jpeg nor png") from error
    except pillow.DecompressionBombError as error:
        raise ImageError(f"{what}: expected at most {LARGEST_PICTURE} pixels: {error}") from error
    except ImageError:
        raise
    except (OSError, SyntaxError, ValueError, struct.error) as error:
        raise ImageError(f"{what}: damaged: {error}") from error
    return picture


def _pillow() -> Any:
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingDependencyError("pictures need Pillow: pip install pillow") from error
    return Image
