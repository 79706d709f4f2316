"""The outlines of a finger in a photograph of its side; a process that reads one needs no more than this."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from finforce.camera import open_picture
from finforce.files import read_bytes
from finforce.optional import import_cv2, import_library
from finforce_ifea.errors import JawFileError

PHOTOS = (".jpg", ".jpeg", ".png")
SCALE = "--scale X1,Y1,X2,Y2=50 (two marks of the ruler in pixels, the mm between them) or --scale MM_PER_PIXEL"
_NUMBER = r"(\d{1,6}(?:\.\d*)?)"
_LARGEST_FILE, _MOST_PIXELS = 100_000_000, 16_000_000  # more pixels are reduced: they are finer than any lens
_LENGTHS = (0.02, 0.3)  # [m], range of a finger's length
_SPECK = 1e-6  # [m^2], largest area of a hole that is a speck
_SIMILAR = 0.25  # [-], area of a second piece over that of the first
# The background is seen in this share of the picture at its edge. A piece is off it by so many times the usual
# deviation and by so much light (white: 1); light is sure to be its own where it is off by this share of the most.
_EDGE, _OFF, _FAINT, _SURE = 0.06, 6.0, 0.04, 0.6
_CELLS = 64  # cells of the grid on which light is fitted
_ROUNDS = 6  # rounds of the fit, each of which leaves out outliers
_TRIMMED = 3.0  # usual deviations from which on a cell is an outlier
_FINE = 0.05  # [px], largest distance of a line from the edge
_GREY = 0.4  # [-], largest distance of a grey pixel's coverage from one half


class Photo(NamedTuple):
    """Outline and holes (n, 2) [m], y up; size of a pixel and width of edges [m]; whether the background is lighter."""

    loops: list[NDArray]
    pixel: float
    edge: float
    is_dark: bool


def read_photo(path: Path, scale: str | None) -> Photo:
    """Trace the largest piece in a photograph, a ruler aside, at a scale as in `SCALE`.

    Its edge is where the light is half way between background and piece: blur leaves it there.

    Raises:
        JawFileError: There is no scale, no such piece, several of them, or one that is cut or has no finger's size.
        ImageError: It is no picture.
    """
    cv2 = import_cv2()
    light, shrunk = _read_light(path)
    marks, pixel = _read_scale(scale, light.shape, shrunk)
    rim = max(int(_EDGE * min(light.shape[:2])), 1)
    edge = np.pad(np.zeros(np.subtract(light.shape[:2], 2 * rim), bool), rim, constant_values=True)
    off = light - _fit_light(light, edge)
    away = np.linalg.norm(off, axis=2)
    piece = _choose_piece(away > max(_OFF * float(np.median(away[edge])), _FAINT), marks)
    sure = np.uint8(piece & (away > _SURE * np.percentile(away[piece], 95)))
    full = _fit_light(off, cv2.erode(sure, None, iterations=2) > 0)
    near = cv2.dilate(np.uint8(piece), None, iterations=4) > 0
    cross, square = (np.einsum("ijk,ijk->ij", part, full) for part in (off, full))
    share = np.where(near, cross / square, 0.0)
    loops = [loop * [pixel, -pixel] for loop in _trace(share, _SPECK / pixel**2)]
    size = 2.0 * float(shapely.minimum_bounding_radius(shapely.Polygon(loops[0])))
    if not _LENGTHS[0] <= size <= _LENGTHS[1]:
        raise JawFileError(
            f"its largest piece is {1e3 * size:.3g} mm long at {1e-3 / pixel:.3g} pixels a millimetre, expected a "
            f"finger of {1e3 * _LENGTHS[0]:g} to {1e3 * _LENGTHS[1]:g} mm, apart from the ruler, and {SCALE}"
        )
    grey = np.count_nonzero(np.abs(share - 0.5) < _GREY) * pixel**2
    return Photo(loops, pixel, grey / shapely.Polygon(loops[0], loops[1:]).length, bool(full[sure > 0].mean() < 0.0))


def _read_light(path: Path) -> tuple[NDArray[np.float32], int]:
    """Return the light (h, w, 3) of a picture, white 1, turned as it is shown; and by what factor it was reduced."""
    from PIL import ImageOps

    picture = ImageOps.exif_transpose(open_picture(read_bytes(path, _LARGEST_FILE), path.name))
    shrunk = int(np.ceil(np.sqrt(picture.width * picture.height / _MOST_PIXELS)))
    values = np.arange(256) / 255.0
    # sRGB, IEC 61966-2-1: a lens mixes light, not these numbers
    light = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return light[np.asarray(picture.convert("RGB").reduce(shrunk))], shrunk


def _read_scale(text: str | None, shape: tuple[int, ...], shrunk: int) -> tuple[NDArray, float]:
    """Return marks (2, 2) [px], if any, and the size of a pixel [m], reduced; raises JawFileError for a bad scale."""
    found = re.fullmatch(rf"(?:{_NUMBER},{_NUMBER},{_NUMBER},{_NUMBER}=)?{_NUMBER}", (text or "").replace(" ", ""))
    numbers = [float(number) for number in found.groups() if number] if found else [0.0]
    size = np.array(shape[1::-1])
    marks, length = np.reshape(numbers[:-1], (-1, 2)) / shrunk, 1e-3 * numbers[-1]
    apart = float(np.linalg.norm(marks[1] - marks[0])) if len(marks) else 1.0 / shrunk
    if not length > 0.0 or not apart > 0.0 or (marks > size).any():
        got = f"the scale {text!r} for {' x '.join(map(str, size * shrunk))} pixels" if text else "no scale"
        raise JawFileError(f"a photograph came with {got}; expected {SCALE}")
    return marks, length / apart


def _fit_light(light: NDArray, where: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the smooth light (h, w, 3), quadratic in the place, of most of some pixels (h, w), of 100 at least."""
    cv2 = import_cv2()
    cells = {"dsize": (_CELLS, _CELLS), "interpolation": cv2.INTER_AREA}
    weight = cv2.resize(where.astype(np.float32), **cells).ravel()
    if where.sum() < 100:
        raise JawFileError("its largest piece is a few pixels across, expected a finger: take a closer photograph")
    values = cv2.resize(light * where[..., None], **cells).reshape(-1, 3) / np.fmax(weight, 1e-9)[:, None]
    v, u = np.indices((_CELLS, _CELLS)).reshape(2, -1) / _CELLS
    terms = np.stack([u**0, u, v, u * u, u * v, v * v], axis=1)
    smooth = np.median(values[weight > 0.0], axis=0)
    for _ in range(_ROUNDS):
        miss = np.linalg.norm(values - smooth, axis=1)
        kept = miss <= _TRIMMED * np.median(miss[weight > 0.0]) + 1e-6
        share = np.sqrt(weight * kept)[:, None]
        smooth = terms @ np.linalg.lstsq(share * terms, share * values, rcond=None)[0]
    return cv2.resize(smooth.reshape(_CELLS, _CELLS, 3).astype(np.float32), where.shape[::-1])


def _choose_piece(stands: NDArray[np.bool_], marks: NDArray) -> NDArray[np.bool_]:
    """Return the largest piece (h, w) off the line of marks (2, 2) [px]; raises JawFileError for none, two or a cut."""
    cv2 = import_cv2()
    _, labels, boxes, middles = cv2.connectedComponentsWithStats(np.uint8(stands))
    ruler = np.zeros(labels.shape, np.uint8)
    if len(marks):
        cv2.line(ruler, *marks.round().astype(int).tolist(), 1, 3)
    sizes = boxes[:, cv2.CC_STAT_AREA].copy()
    sizes[[0, *np.unique(labels[ruler > 0])]] = 0
    second, largest = np.argsort(np.r_[0, sizes])[-2:] - 1
    piece = labels == largest
    if sizes[largest] < 100:
        raise JawFileError(
            "nothing stands out beside the ruler, expected a finger apart from it on another, plain colour"
        )
    if sizes[second] > _SIMILAR * sizes[largest]:
        places = " and ".join(f"({x:.0f}, {y:.0f})" for x, y in middles[[largest, second]])
        raise JawFileError(f"two similar pieces at {places} [px], expected one on a plain ground, marks on the ruler")
    if piece[[0, -1]].any() or piece[:, [0, -1]].any():
        raise JawFileError("the edge of the picture cuts its largest piece, expected a whole finger on a plain ground")
    return piece


def _trace(share: NDArray, speck: float) -> list[NDArray]:
    """Return the outline, then the holes (n, 2) [px] from `speck` [px^2] on, of the largest area above half a share."""
    contourpy = import_library("contourpy", "tracing a photograph")
    _, labels, boxes, _ = import_cv2().connectedComponentsWithStats(np.uint8(share > 0.5))
    share = np.where((labels == 0) | (labels == 1 + boxes[1:, -1].argmax()), share, 0.0)
    areas = [shapely.Polygon(line).simplify(_FINE) for line in contourpy.contour_generator(z=share).lines(0.5)]
    areas = sorted((area for area in areas if area.area > speck), key=lambda area: -area.area)
    return [shapely.get_coordinates(area.exterior)[:-1] for area in areas if areas[0].covers(area)]
