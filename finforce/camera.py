"""Pixels, rays and depth of a camera: a pinhole with the lens models of ROS, and a fisheye."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError, one_line

DEPTH_TYPES = {"16UC1": np.dtype(np.uint16), "mono16": np.dtype(np.uint16), "32FC1": np.dtype(np.float32)}
MILLIMETRE = 1e-3  # the unit of 16-bit depth images (REP 118)
FARTHEST_CENTRE = 10.0  # of a principal point outside its image, in sizes of that image; a cut-out has one
SHORTEST_FOCAL, LONGEST_FOCAL = 0.01, 1000.0  # of a focal length, in sizes of the image; a cut-out's is long
PLUMB_BOB, RATIONAL, EQUIDISTANT = "plumb_bob", "rational_polynomial", "equidistant"
# how many coefficients each has, filled up with zeros to the last number; the names are those of ROS (REP 104)
COEFFICIENTS = {PLUMB_BOB: (0, 4, 5), RATIONAL: (0, 5, 8), EQUIDISTANT: (0, 4)}
# what files and drivers call them; realsense2_camera, too, takes its device's inverse coefficients for plumb_bob's
_LENSES = dict.fromkeys(("radtan", "none", "pinhole", "brown_conrady", "inverse_brown_conrady"), PLUMB_BOB)
_LENSES |= dict.fromkeys(("fisheye", "equi", "kannala_brandt4", "opencv_fisheye", "kannalabrandt8"), EQUIDISTANT)
WIDEST = np.radians(88.0)  # from the optical axis; farther out a ray has no place on the plane z = 1


class ImageError(FinforceError, ValueError):
    """A depth image or a mask cannot be used."""


class IntrinsicsError(FinforceError, ValueError):
    """Intrinsics that no camera has."""


def name_lens(model: str) -> str:
    """Return our name of a lens, or the name as it is where it is none that is known."""
    return _LENSES.get(model.lower().removeprefix("distortion.").replace(" ", "_"), model)


def name_matrix(matrix: Sequence[float]) -> dict[str, float]:
    """Return fx, fy, cx, cy of a camera's 3x3 matrix, row by row; raises IntrinsicsError where its axes are skew."""
    if matrix[6] and matrix[7] and not matrix[2] and not matrix[5]:  # column by column, as Open3D writes it
        matrix = [*matrix[0::3], *matrix[1::3], *matrix[2::3]]
    if any(matrix[index] for index in (1, 3, 6, 7)):
        raise IntrinsicsError(f"camera matrix {[*matrix]}: expected no skew, [fx 0 cx 0 fy cy 0 0 1]")
    return {"fx": matrix[0], "fy": matrix[4], "cx": matrix[2], "cy": matrix[5]}


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraIntrinsics:
    """A camera; the centre of the upper left pixel has the coordinates (0, 0), as in OpenCV.

    With r the distance from the axis on the plane z = 1 and a = atan(r), a lens moves a point to

    - plumb_bob: (1 + k1 r^2 + k2 r^4 + k3 r^6) (x, y) and tangential terms with p1 and p2,
    - rational_polynomial: the same with the factor divided by 1 + k4 r^2 + k5 r^4 + k6 r^6,
    - equidistant, a fisheye: (a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9) / r (x, y).

    Attributes:
        width: of the image [px].
        height: of the image [px].
        fx: focal length along the rows [px].
        fy: focal length along the columns [px].
        cx: column of the principal point [px].
        cy: row of the principal point [px].
        distortion: k1, k2, p1, p2, k3 (5,); k1, k2, p1, p2, k3 to k6 (8,); or k1 to k4 (4,) of a fisheye.
        model: "plumb_bob", "rational_polynomial" or "equidistant".

    Raises:
        IntrinsicsError: a size or a focal length is not positive, a number is not finite, the principal point is far
            outside the image, a focal length is out of proportion to it, the model is another one, or its coefficients
            are too many or too few.

    Source: OpenCV, calib3d and its fisheye module.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: NDArray = field(default_factory=lambda: np.zeros(0))
    model: str = PLUMB_BOB

    def __post_init__(self) -> None:
        numbers = np.array([self.fx, self.fy, self.cx, self.cy], dtype=float)
        if self.width < 1 or self.height < 1 or not np.isfinite(numbers).all() or min(self.fx, self.fy) <= 0.0:
            raise IntrinsicsError(
                f"intrinsics {self.width}x{self.height}, fx fy cx cy = {numbers.tolist()}: expected a positive size, "
                "positive focal lengths and finite numbers [px]" + ("" if numbers.any() else ": calibrate the camera")
            )
        if abs(self.cx) > FARTHEST_CENTRE * self.width or abs(self.cy) > FARTHEST_CENTRE * self.height:
            raise IntrinsicsError(
                f"intrinsics {self.width}x{self.height}, cx cy = {numbers[2:].tolist()}: expected a principal point in "
                "or near the image [px]"
            )
        proportion = numbers[:2] / (self.width, self.height)
        if proportion.min() < SHORTEST_FOCAL or proportion.max() > LONGEST_FOCAL:
            raise IntrinsicsError(
                f"intrinsics {self.width}x{self.height}, fx fy = {numbers[:2].tolist()}: expected focal lengths in "
                f"proportion to the image, {SHORTEST_FOCAL:g} to {LONGEST_FOCAL:g} of its size [px]"
            )
        if self.model not in COEFFICIENTS:
            raise IntrinsicsError(
                f"distortion model {self.model!r}: expected one of {', '.join(COEFFICIENTS)}; rectify the images of a "
                "camera with another model"
            )
        distortion, counts = np.asarray(self.distortion, dtype=float).ravel(), COEFFICIENTS[self.model]
        if len(distortion) > counts[-1] and not np.any(distortion[counts[-1] :]):
            distortion = distortion[: counts[-1]]
        if len(distortion) not in counts or not np.isfinite(distortion).all():
            raise IntrinsicsError(
                f"distortion {distortion.tolist()}: expected {' or '.join(map(str, counts))} finite coefficients of "
                f"the model {self.model}; rectify the images of a camera with another model"
            )
        object.__setattr__(self, "distortion", np.pad(distortion, (0, counts[-1] - len(distortion))))

    @cached_property
    def lens(self) -> NDArray[np.float64]:
        """fx, fy, cx, cy, kind (0 pinhole, 1 distorted, 2 fisheye), eight coefficients and widest angle [rad] (14,)."""
        kind = 2.0 if self.model == EQUIDISTANT else float(self.distortion.any())
        coefficients = np.pad(self.distortion, (0, 8 - len(self.distortion)))
        return np.array([self.fx, self.fy, self.cx, self.cy, kind, *coefficients, WIDEST])


@dataclass(frozen=True, kw_only=True)
class ImageLayout:
    """The layout of the bytes of an image: rows, columns, bytes per row (0: no padding) and byte order."""

    height: int
    width: int
    step: int = 0
    is_bigendian: bool = False


@lru_cache(maxsize=4)
def compute_rays(camera: CameraIntrinsics) -> NDArray:
    """Return the viewing ray of every pixel, read-only.

    Returns:
        (h, w, 3) directions in the camera frame with z = 1, so that a ray times its depth is a point.
    """
    rays = rays_of_window(camera, range(camera.height), range(camera.width))
    rays.flags.writeable = False
    return rays


def rays_of_window(camera: CameraIntrinsics, rows: range, columns: range) -> NDArray:
    """Return the viewing rays (len(rows), len(columns), 3), z = 1, of the pixels in some rows and columns."""
    pixels = np.empty((len(rows), len(columns), 2))
    pixels[..., 0], pixels[..., 1] = columns, np.asarray(rows)[:, None]
    return rays_from_pixels(pixels.reshape(-1, 2), camera).reshape(*pixels.shape[:2], 3)


def rays_from_pixels(pixels: NDArray, camera: CameraIntrinsics) -> NDArray:
    """Return the viewing rays (n, 3), z = 1, of pixels (n, 2) given as column and row [px].

    The rays of pixels that are NaN are NaN, and so are those farther than `WIDEST` from the axis of a fisheye.

    Raises:
        IntrinsicsError: the distortion cannot be inverted at one of the pixels.
    """
    from finforce.lens import find_rays

    rays, found = find_rays(camera.lens, np.ascontiguousarray(pixels, dtype=float))
    if not found:
        raise IntrinsicsError(f"distortion {camera.distortion.tolist()}: cannot be inverted within the image")
    return rays


def project(points: NDArray, camera: CameraIntrinsics) -> NDArray:
    """Return the pixels (n, 2), column and row, of points (n, 3) [m] in the camera frame.

    Points at or behind the camera's plane have no pixel and come back as NaN; so do those beyond `WIDEST` of a fisheye.
    """
    from finforce.lens import project_points

    return project_points(camera.lens, np.ascontiguousarray(points, dtype=float))


def decode_depth(
    data: NDArray | bytes, encoding: str, layout: ImageLayout | None = None, scale: float = MILLIMETRE
) -> NDArray:
    """Return a depth image in metres.

    Args:
        data: the image (h, w), or its bytes together with their layout.
        encoding: 16UC1 (or mono16), in steps of `scale`, 0 where invalid; or 32FC1, in metres.
        layout: layout of the bytes.
        scale: one step of a 16-bit image [m].

    Returns:
        (h, w) float32 [m], NaN where nothing was measured.

    Raises:
        ImageError: the encoding is another one, or the data do not fill the layout.
    """
    if encoding not in DEPTH_TYPES:
        raise ImageError(f"depth image: encoding '{encoding}'; expected 16UC1 [mm] or 32FC1 [m]")
    if layout is not None:
        data = unpack_rows("depth image", data, DEPTH_TYPES[encoding], layout)
    image = np.asarray(data)
    if image.ndim != 2:
        raise ImageError(f"depth image: shape {image.shape}; expected (height, width)")
    if encoding != "32FC1":
        depth = np.multiply(image, np.float32(scale), dtype=np.float32)
        with np.errstate(invalid="ignore"):  # 0 / 0 is NaN, and an eighth of the price of an index
            return np.divide(depth, image != 0, out=depth)
    depth = image.astype(np.float32)
    depth[~(np.isfinite(depth) & (depth > 0.0))] = np.nan
    return depth


def unpack_rows(what: str, data: NDArray | bytes, dtype: np.dtype, layout: ImageLayout, channels: int = 1) -> NDArray:
    """Return the image (h, w), or (h, w, channels), of bytes that may have padding at the end of their rows.

    Raises:
        ImageError: the data do not fill the layout; `what` names them.
    """
    raw = np.frombuffer(data, dtype=np.uint8)
    used = layout.width * channels * dtype.itemsize
    step = layout.step or used
    if min(layout.width, layout.height) < 1 or step < used or len(raw) != step * layout.height:
        raise ImageError(
            f"{what}: {len(raw)} bytes with {step} a row; expected {layout.height} rows of at least {used} bytes"
        )
    rows = raw.reshape(layout.height, step)[:, :used]
    if dtype.itemsize > 1:
        rows = np.ascontiguousarray(rows).view(dtype.newbyteorder(">" if layout.is_bigendian else "<"))
    return rows if channels == 1 else rows.reshape(layout.height, layout.width, channels)


def check_depth(depth: NDArray, camera: CameraIntrinsics) -> None:
    """Refuse a depth image (h, w) [m] that has another size than its camera, or no depth at all.

    Raises:
        ImageError: it is one of these.
    """
    if np.shape(depth) != (camera.height, camera.width):
        raise ImageError(
            f"depth image: shape {np.shape(depth)}; the intrinsics are of {camera.height} rows and {camera.width} "
            "columns"
        )
    if not (np.isfinite(depth) & (np.nan_to_num(depth) > 0.0)).any():
        raise ImageError("depth image: no pixel has a depth; is the camera covered, or nearer than it can see?")


def check_mask(mask: NDArray, depth: NDArray, least: int = 1) -> None:
    """Refuse a mask (h, w) bool of another size than its depth image, or with fewer than `least` pixels with depth.

    Raises:
        ImageError: it is one of these.
    """
    if np.shape(mask) != np.shape(depth):
        raise ImageError(f"mask: shape {np.shape(mask)}; expected that of the depth image, {np.shape(depth)}")
    selected = np.asarray(mask, dtype=bool)
    if not selected.any():
        raise ImageError("mask: nothing in it; expected the object's pixels to be set")
    known = int((selected & np.isfinite(depth)).sum())
    if known < least:
        raise ImageError(
            f"mask: {known} of its {int(selected.sum())} pixels have a depth, at least {least} are needed; "
            "is the object nearer or farther than the camera can see?"
        )


_BYTE, _WORD = np.dtype(np.uint8), np.dtype(np.uint16)
# type and channels of the encodings of sensor_msgs/Image, and OpenCV's conversion to RGB, "" for RGB itself
COLOR_ENCODINGS = {
    "rgb8": (_BYTE, 3, ""),
    "bgr8": (_BYTE, 3, "BGR2RGB"),
    "8UC3": (_BYTE, 3, "BGR2RGB"),
    "rgba8": (_BYTE, 4, "RGBA2RGB"),
    "bgra8": (_BYTE, 4, "BGRA2RGB"),
    "mono8": (_BYTE, 1, "GRAY2RGB"),
    "8UC1": (_BYTE, 1, "GRAY2RGB"),
    "rgb16": (_WORD, 3, ""),
    "bgr16": (_WORD, 3, "BGR2RGB"),
    "mono16": (_WORD, 1, "GRAY2RGB"),
    "uyvy": (_BYTE, 2, "YUV2RGB_UYVY"),
    "yuv422": (_BYTE, 2, "YUV2RGB_UYVY"),
    "yuyv": (_BYTE, 2, "YUV2RGB_YUY2"),
    "yuv422_yuy2": (_BYTE, 2, "YUV2RGB_YUY2"),
    "nv12": (_BYTE, 1, "YUV2RGB_NV12"),
    "nv21": (_BYTE, 1, "YUV2RGB_NV21"),
    **{f"bayer_{tiles}8": (_BYTE, 1, f"Bayer{tiles.upper()}2RGB") for tiles in ("rggb", "bggr", "gbrg", "grbg")},
}
_HALF_CHROMA = ("nv12", "nv21")  # whose rows of brightness are followed by half as many of colour


def decode_color(data: NDArray | bytes, encoding: str, layout: ImageLayout | None = None) -> NDArray:
    """Return a colour image as RGB.

    Args:
        data: the image (h, w, channels), (h, w) with one channel, or its bytes together with their layout.
        encoding: one of `COLOR_ENCODINGS`, as in sensor_msgs/Image; 8UC3 is taken for bgr8, as OpenCV has
            it, 8UC1 for mono8.
        layout: layout of the bytes.

    Returns:
        (h, w, 3) uint8, contiguous; a view of the data where nothing has to move.

    Raises:
        ImageError: the encoding is another one, or the data do not fill the layout.
    """
    if encoding not in COLOR_ENCODINGS:
        raise ImageError(f"colour image: encoding {encoding!r}; expected one of {', '.join(COLOR_ENCODINGS)}")
    dtype, channels, conversion = COLOR_ENCODINGS[encoding]
    if layout is not None:
        if encoding in _HALF_CHROMA:
            layout = replace(layout, height=layout.height + layout.height // 2)
        data = unpack_rows("colour image", data, dtype, layout, channels)
    image = np.asarray(data)
    if image.shape[2:] != ((channels,) if channels > 1 else ()) or image.dtype.newbyteorder("=") != dtype:
        wanted = f"(h, w, {channels})" if channels > 1 else "(h, w)"
        raise ImageError(
            f"colour image: {image.dtype} of shape {image.shape}; expected {dtype} {wanted} for {encoding}"
        )
    if dtype == _WORD:
        image = (image >> 8).astype(np.uint8)
    if channels == 2 and image.shape[1] > 2:
        _check_luma(image, encoding)
    return _convert(image, encoding, conversion) if conversion else np.ascontiguousarray(image)


def _check_luma(image: NDArray, encoding: str) -> None:
    """Refuse an image (h, w, 2) whose brightness, which has more detail, is where the two colours in turn should be."""
    rows, luma = image[::8].astype(np.int16), int("UYVY" in COLOR_ENCODINGS[encoding][2])
    near, far = (np.abs(rows[:, apart:] - rows[:, :-apart]).mean(axis=(0, 1)) for apart in (1, 2))
    if far[1 - luma] > 1.5 * far[luma] and near[1 - luma] < 1.1 * far[1 - luma]:
        others = ("uyvy or yuv422", "yuyv or yuv422_yuy2")[luma]
        raise ImageError(f"colour image: said to be {encoding}, its bytes are those of {others}: correct its encoding")


def _convert(image: NDArray, encoding: str, conversion: str) -> NDArray[np.uint8]:
    """Return an image as RGB (h, w, 3), by OpenCV; raises ImageError for a size that the encoding cannot have."""
    import cv2

    try:
        return cv2.cvtColor(np.ascontiguousarray(image), getattr(cv2, f"COLOR_{conversion}"))
    except cv2.error:
        raise ImageError(
            f"colour image: {image.shape[:2]} rows and columns; expected even ones for {encoding}"
        ) from None


_SENT = ("JPEG", "PNG")  # formats of a compressed image
LARGEST_PICTURE = 50_000_000  # px, of a picture that is unpacked: no camera here makes more


PACKET = (b"\0\0\0\1", b"\0\0\1")  # how the packets of H.264 and H.265 begin
HEIC = (b"ftypheic", b"ftypheix", b"ftyphevc", b"ftypmif1", b"ftypmsf1")  # how files of phones begin, from byte 4 on


def open_picture(data: bytes, what: str, formats: tuple[str, ...] | None = _SENT) -> Any:
    """Return a picture of Pillow, unpacked and upright; of any format that Pillow reads where `formats` is None.

    Raises:
        ImageError: the bytes are none, are damaged, or unpack to more than 50 million pixels; `what` names them.
    """
    from PIL import Image, ImageOps, UnidentifiedImageError

    if data[4:12] in HEIC:
        raise ImageError(f"{what}: an HEIC picture; expected JPEG or PNG: export it as one of these")
    if data.startswith(PACKET):
        raise ImageError(
            f"{what}: a packet of a video, no picture by itself; expected JPEG or PNG, or H.264 of colours: record raw "
            "or compressed images, or unpack the packets to a video file"
        )
    expected = f"at most {LARGEST_PICTURE} pixels"
    try:
        picture = Image.open(io.BytesIO(data), formats=formats)
        if picture.width * picture.height > LARGEST_PICTURE:
            raise ImageError(f"{what}: {picture.width} x {picture.height}; expected {expected}")
        picture.load()
        ImageOps.exif_transpose(picture, in_place=True)
    except ImageError:
        raise
    except UnidentifiedImageError as error:
        kinds = "no picture" if formats is None else f"neither {' nor '.join(map(str.lower, formats))}"
        raise ImageError(f"{what}: {len(data)} bytes that are {kinds}") from error
    except Image.DecompressionBombError as error:
        raise ImageError(f"{what}: expected {expected}: {error}") from error
    except Exception as error:  # each format has its own classes for damage
        raise ImageError(f"{what}: damaged: {one_line(error)}") from error
    return picture


def decode_picture(data: NDArray | bytes, what: str, formats: tuple[str, ...] | None = _SENT) -> NDArray[np.uint8]:
    """Return the colours (h, w, 3), red green blue, of a picture; formats and errors are those of `open_picture`."""
    picture = open_picture(bytes(data), what, formats)
    # a camera's pictures come as they are wanted: converting one anyway would copy it
    return np.asarray(picture if picture.mode == "RGB" else picture.convert("RGB"))
