"""The curves of DXF and SVG drawings; a process that reads a file needs no more than this."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_library
from finforce_ifea.errors import JawFileError

_DXF_UNITS = {1: "inch", 4: "mm", 6: "m"}


def read_dxf(path: Path) -> tuple[list[NDArray], str | None]:
    """Read the curves of a DXF drawing, and its unit."""
    ezdxf = import_library("ezdxf", f"reading {path.name}")
    make_path = import_library("ezdxf.path", f"reading {path.name}").make_path
    document = ezdxf.readfile(path)
    lines = []
    for entity in document.modelspace():
        try:
            curve = make_path(entity)
        except TypeError:
            continue
        points = np.array([(point.x, point.y) for point in curve.flattening(0.01)])
        if len(points) > 1:
            lines.append(points)
    unit = _DXF_UNITS.get(document.header.get("$INSUNITS", 0))
    return _keep_lines(lines), unit


def read_svg(path: Path) -> tuple[list[NDArray], str | None]:
    """Read the curves of an SVG drawing; lengths without a unit are CSS pixels, as in browsers, unless one is named."""
    svgelements = import_library("svgelements", f"reading {path.name}")
    # a pixel is 1/96 inch: at 25.4 per inch everything comes out in millimetres where sizes have units
    document = svgelements.SVG.parse(str(path), ppi=25.4, reify=True)
    shapes = [element for element in document.elements() if isinstance(element, svgelements.Shape)]
    parts = [part for shape in shapes for part in svgelements.Path(shape).as_subpaths()]
    lines = [_sample_curve(svgelements.Path(part)) for part in parts]
    return _keep_lines(lines), None


def _sample_curve(curve) -> NDArray:
    """Return points (n, 2) along the segments of an SVG path; y points up."""
    points = []
    for segment in curve:
        kind = type(segment).__name__
        if kind == "Move" or segment.start is None or segment.end is None:
            continue
        count = 1 if kind in ("Line", "Close") else 24
        points += [segment.point(k / count) for k in range(count)] + [segment.end]
    return np.array([(point.x, -point.y) for point in points]).reshape(-1, 2)


def _keep_lines(lines: list[NDArray]) -> list[NDArray]:
    """Return the curves that have a length, as closed loops need three points to be checked."""
    kept = [line if len(line) > 2 else np.vstack([line[0], line.mean(axis=0), line[-1]]) for line in lines if len(line)]
    if not kept:
        raise JawFileError("holds no curves, expected the outline of a finger and its holes")
    return kept
