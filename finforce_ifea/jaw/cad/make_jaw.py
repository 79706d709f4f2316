"""A jaw file from the file of a finger: key points, contact candidates, reference point, its section and a picture."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
import shapely.affinity
from numpy.typing import NDArray

from finforce_ifea.errors import JawFileError
from finforce_ifea.jaw.cad.cad_file import RawSection, UnlikeSectionsError, read_section
from finforce_ifea.jaw.cad.photo import Photo
from finforce_ifea.jaw.cad.picture import draw_finger, draw_refused
from finforce_ifea.jaw.cad.recognition import Overrides, RecognizedFinger, count_cells, recognize
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.jaw.jaw_file import MATERIALS
from finforce_ifea.jaw.section import cut_below, find_face, find_reach, order_rings

_ABOVE = 1e-3  # [m], least height of key points above the clamp
_AWAY = 4e-3  # [m], least distance of contact candidates from either end of the inner face
_STEP = 4e-3  # [m], between candidates
_FEWEST = 6  # candidates
_MOST = 30  # candidates
_TIP = 2.5e-3
# With fewer key points where ribs meet bands, those between them are taken, too: an object hides some.
FEW = 12
BANDS = ("inner", "outer")
# Cells that a finger without ribs is given.
_CELLS = 8
_CELLS_FROM = (0.08, 0.95)  # [-], range of the cells over its length
_GAP = 0.008  # [-], half of the gap between cells over its length
_SKIN = 0.06  # [-], skin over them over its width
_SLOT = 0.3  # [-], depth of slots in its ends
_LEVELS = 200
_WARPING = 0.25  # [-], warping of layers, see `measure_warping`, from which on a finger needs a solid
_SIZE = 0.002  # [m], of the elements of that solid
# Walls in a photograph, of whose thickness bending takes the cube.
_ACROSS = 5  # [px], least thickness
_BLURRED = 0.2  # [-], uncertainty of the thickness over the width of edges in the picture
_SIDES = 0.025  # [-], the same over the finger's width, where a camera a metre away sees dark sides
# A reference point [m] below a clamp that the section does not show.
_BELOW = -6e-3


def make_jaw(
    file: Path,
    output: Path,
    overrides: Overrides,
    *,
    material: str = "tpu95a",
    picture: Path | None = None,
    measure_warping: Callable[[Jaw], float] | None = None,
) -> tuple[list[Path], list[str]]:
    """Read a finger and write the jaw file that describes it; return what was written, and what was found and guessed.

    Args:
        file: the finger, see `read_section`.
        output: the YAML file; its section goes next to it.
        overrides: values stated in place of the guesses.
        material: a name in `MATERIALS`.
        picture: the PNG file; None for one next to the jaw file.
        measure_warping: returns by what share the stiffness of a layered jaw is off where it is taken as plane;
            None: it is taken so unasked.

    Raises:
        JawFileError: The file shows no fin-ray finger; the message says what it shows and what to do.
        MissingDependencyError: An optional reader is not installed.
    """
    picture, name = picture or output.with_suffix(".png"), overrides.name or file.stem
    output.parent.mkdir(parents=True, exist_ok=True)
    raw = _read_section(file, overrides, picture)
    finger, stiffness_error = _find_finger(file, raw, overrides, picture)
    reference, place = _choose_reference(finger)
    section = output.with_suffix(".section.json")
    section.write_text(_describe_section(finger, file.name), encoding="utf-8")
    heading = f"# {name}, from {file.name}. Lengths in metres, jaw frame (x closing, y width, z base to tip)."
    lines = [heading, f"name: {name}", *_describe_finger(finger, section.name, material, stiffness_error)]
    lines.append(f"reference_point: {_list(_put_on_side(finger, *reference))}  # {place}")
    jaw = _write_jaw(output, lines)
    if len(finger.layers) > 1 and measure_warping and (warping := measure_warping(jaw)) > _WARPING:
        raw.notes.append(f"its layers move apart (stiffness {warping:.0%} off), thus `model: solid`, which is slow")
        lines[lines.index("section:")] += f"\n  size: {_SIZE}"
        jaw = _write_jaw(output, [*lines, "model: solid"])
    draw_finger(finger, jaw, picture)
    spread = f"{1e-6 * jaw.material.young_modulus:.3g} MPa +- {jaw.material.spread:.0%}"
    notes = [
        *raw.notes,
        *finger.notes,
        f"{len(jaw.keypoints)} key points, {len(jaw.candidates)} contact candidates",
        f"reference point {place}",
        f"{material}: {spread}, until `finforce calibrate` has measured it (--material)",
    ]
    return [output, section, picture], notes


def _write_jaw(output: Path, lines: Sequence[str]) -> Jaw:
    """Write the lines of a jaw file and return the jaw that they describe."""
    output.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return load_jaw(output)


def _read_section(file: Path, overrides: Overrides, picture: Path) -> RawSection:
    """Read the section of a finger; draw the usual one of a solid that has others, too."""
    try:
        return read_section(file, unit=overrides.unit, body=overrides.body, layered=overrides.solid)
    except JawFileError as error:
        if not isinstance(error.__cause__, UnlikeSectionsError):
            raise
        draw_refused(error.__cause__.section, str(error), picture)
        raise JawFileError(f"{error} (its usual section is drawn in {picture})") from error


def _find_finger(file: Path, raw: RawSection, overrides: Overrides, picture: Path) -> tuple[RecognizedFinger, float]:
    """Return the finger in a section and the relative deviation of its stiffness; draw one that shows none.

    Raises:
        JawFileError: The section shows no fin-ray finger, or the file names no width and none is given.
    """
    width = overrides.width or raw.width
    if width is None:
        raise JawFileError(f"{file.name}: a flat file has no width; give it in millimetres: --width 25")
    try:
        finger = _recognize(raw, width, overrides)
        return finger, 0.0 if raw.photo is None else _find_wall_error(finger, raw.photo)
    except JawFileError as error:
        draw_refused(raw.polygon, str(error), picture)
        raise JawFileError(f"{file.name}: {error} (its section is drawn in {picture})") from error


def _find_wall_error(finger: RecognizedFinger, photo: Photo) -> float:
    """Return, and note, the relative deviation of a photographed stiffness; raises JawFileError for too few pixels."""
    thinnest = min(finger.inner.usual, finger.outer.usual, float(np.median([rib.wall.usual for rib in finger.ribs])))
    across = thinnest / photo.pixel
    if across < _ACROSS:
        raise JawFileError(f"its thinnest walls are {across:.1f} pixels across, expected at least {_ACROSS}: zoom in")
    stiffness_error = 3.0 * float(np.hypot(_BLURRED * photo.edge, _SIDES * finger.width * photo.is_dark)) / thinnest
    advice = "; the sides of its walls, as dark, look like walls: chalk it and lay it on black" * photo.is_dark
    finger.notes.append(f"thinnest walls {across:.1f} pixels across: a stiffness +- {stiffness_error:.0%}{advice}")
    return stiffness_error


def _recognize(raw: RawSection, width: float, overrides: Overrides) -> RecognizedFinger:
    """Return the finger in a section; of layers without ribs that could be found as if there were some, evenly.

    Raises:
        JawFileError: The section shows no fin-ray finger.
    """
    if not raw.layers:
        return recognize(raw.polygon, width, overrides, raw.taper, raw.base, raw.unlike)
    try:
        finger = recognize(raw.polygon, width, overrides)
        is_prism = len(raw.layers) == 1 and count_cells(raw.polygon) > 1
        return finger if is_prism else _layer(finger, raw)
    except JawFileError:
        try:
            finger = _layer(recognize(_open_cells(raw.polygon), width, overrides), raw)
        except JawFileError as error:
            if "--solid" not in str(error):
                raise
            raise JawFileError("its outline is no finger's: export the finger alone, without its holder") from error
    finger.notes[-1] = "no ribs found: key points stand at even heights, as if there were some"
    return finger


def _open_cells(polygon: shapely.Polygon) -> shapely.Polygon:
    """Return what an outline bounds with cells, evenly along it."""
    polygon = shapely.Polygon(polygon.exterior)
    corners = np.array(polygon.minimum_rotated_rectangle.exterior.coords)[:4]
    across, along = sorted((corners[1] - corners[0], corners[2] - corners[1]), key=lambda way: np.hypot(*way))
    start, size = corners.mean(axis=0) - 0.5 * along, np.hypot(*along)
    interior = polygon.buffer(-_SKIN * np.hypot(*across))
    cells = []
    for low, high in pairwise(np.linspace(*_find_whole(interior, start, along, across), _CELLS + 1)):
        middle = shapely.LineString([start + (low + _GAP) * along, start + (high - _GAP) * along])
        parts = shapely.get_parts(interior.intersection(middle.buffer(size, cap_style="flat")))
        cells.append(max(parts, key=lambda part: part.area, default=shapely.Polygon()))
    return polygon.difference(shapely.union_all(cells))


def _find_whole(interior: shapely.Geometry, start: NDArray, along: NDArray, across: NDArray) -> tuple[float, float]:
    """Return between which shares of an outline's length cells lie: not beside a slot in either end, as of a base.

    Args:
        interior: depth left for cells [m].
        start: the middle of one end of the box around the outline (2,) [m].
        along: from there to the other end (2,) [m].
        across: from side to side (2,) [m].
    """
    shares = np.linspace(0.0, 1.0, _LEVELS)
    ends = start + shares[:, None, None] * along + np.array([[-1.0], [1.0]]) * across
    is_apart = shapely.get_num_geometries(shapely.intersection(interior, shapely.linestrings(ends))) > 1
    lower, upper = (shares[is_apart & side].tolist() for side in (shares < _SLOT, shares > 1.0 - _SLOT))
    return max([_CELLS_FROM[0], *lower]), min([_CELLS_FROM[1], *upper])


def _layer(finger: RecognizedFinger, raw: RawSection) -> RecognizedFinger:
    """Return a finger that was recognized in one of its layers with all of them."""
    a, b = finger.frame[:, :2], finger.frame[:, 2]
    matrix = [*a.ravel(), *b]
    areas = [shapely.affinity.affine_transform(layer.area, matrix) for layer in raw.layers]
    areas = [shapely.set_precision(area, 1e-7) for area in areas]  # as they are written
    layers = [replace(layer, area=area) for layer, area in zip(raw.layers, areas, strict=True)]
    if np.linalg.det(a) > 0.0:  # x, z and the axis of the cuts make a left-handed frame
        layers = [replace(layer, low=-layer.high, high=-layer.low) for layer in reversed(layers)]
    whole = shapely.union_all([layer.area for layer in layers], grid_size=1e-6).buffer(0.0)
    face_x = float(max(find_reach(whole, np.array([z for _, z in finger.inner.line])).max(), finger.face_x))
    return replace(finger, rings=order_rings(whole), layers=tuple(layers), face_x=face_x)


def choose_keypoints(finger: RecognizedFinger) -> dict[str, NDArray]:
    """Return what a camera can see by name: (3,) [m], jaw frame.

    Key points are where the ribs meet the bands, on the side face towards the camera, inner band first, base to tip,
    and the tip; what the clamp holds is left out, since it does not move, ends of ribs on no band, and all but one of
    those that meet a band within its thickness, as the walls of a corner. Where these are few, points of the bands half
    way between them come behind.
    """
    places: dict[str, tuple[float, float]] = {}
    tips = shapely.get_parts(finger.polygon.intersection(shapely.box(-1.0, finger.length - _TIP, 1.0, 1.0)))
    top = max(tips, key=lambda part: part.area).centroid
    for band in BANDS:
        wall = getattr(finger, band)
        line = shapely.LineString(wall.line)
        for number, rib in enumerate(finger.ribs, start=1):
            x, z = getattr(rib, band)
            is_there = line.distance(shapely.Point(x, z)) < wall.usual  # else it ends elsewhere, as on the base
            others = [(top.x, top.y), *places.values()]
            is_new = all(np.hypot(x - other, z - height) > wall.usual for other, height in others)
            is_free = z > finger.clamp_height(x) + _ABOVE and not finger.find_clamped(np.array([[x, z]])).any()
            if is_there and is_new and is_free:
                places[f"{band}_{number}"] = (x, z)
    places["tip"] = (top.x, top.y)
    if len(places) < FEW:
        places |= _find_middles(finger, places)
    return {name: _put_on_side(finger, *place) for name, place in places.items()}


def _find_middles(
    finger: RecognizedFinger, places: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Return points (x, z) [m] of each band half way between clamp, key points on it, and tip, by the names of both."""
    found = {}
    for band in BANDS:
        line = getattr(finger, band).line
        ends = {name: z for name, (_, z) in places.items() if name.startswith(band)}
        ends = {"clamp": float(finger.clamp_height(line[0, 0])), **ends, "tip": places["tip"][1]}
        for (below, low), (above, high) in pairwise(ends.items()):
            z = 0.5 * (low + high)
            x = float(np.interp(z, line[:, 1], line[:, 0]))
            if not finger.find_clamped(np.array([[x, z]])).any():
                found[f"{band}_{below.removeprefix(f'{band}_')}_{above.removeprefix(f'{band}_')}"] = (x, z)
    return found


def _put_on_side(finger: RecognizedFinger, x: float, z: float) -> NDArray:
    """Return a place of the section on the side that the camera sees (3,) [m]."""
    return np.array([x, *finger.place_across(np.array([[x, 1.0, z]])), z])


def _find_face_end(finger: RecognizedFinger) -> float:
    """Return the highest z [m] at which the outline is on the plane of the inner face, or near that of a curved one."""
    ring = np.array(finger.polygon.exterior.coords)
    bent = 0.0 if find_face(finger, finger.face_x).is_flat else 1.1 * finger.face_deviation
    return float(ring[np.abs(ring[:, 0] - finger.face_x) < max(1e-4, bent), 1].max())


def _choose_reference(finger: RecognizedFinger) -> tuple[NDArray, str]:
    """Return a point (2,) [m] that never bends: in the middle of the largest flat patch of what is clamped."""
    held = cut_below(finger.polygon, finger.clamped_z, finger.clamp_slope)
    held = max(getattr(held, "geoms", [held]), key=lambda part: part.area, default=held)
    circle = shapely.maximum_inscribed_circle(held) if held.area > 0.0 else None
    if circle is None or circle.length < 1.5e-3:
        return np.array([0.0, _BELOW]), "on the holder, below the finger: mark it there with a dot"
    place = np.array(circle.coords[0])
    return place, f"on the clamped part, a patch of {1e3 * circle.length:.1f} mm around it: mark it with a dot"


def _describe_section(finger: RecognizedFinger, source: str) -> str:
    """Return the text of a section file; `source` is the name of the file that it comes from."""
    width = round(1e3 * finger.width, 4)
    content = {"source": source, "unit": "mm", "axes": ["x", "z"], "width": width, "loops": _list_rings(finger.rings)}
    if finger.layers:
        content["layers"] = [
            {"y": np.round(1e3 * np.array([layer.low, layer.high]), 4).tolist(), "loops": _list_rings(rings)}
            for layer in finger.layers
            for rings in [[ring for part in shapely.get_parts(layer.area) for ring in order_rings(part)]]
        ]
    return json.dumps(content) + "\n"


def _list_rings(rings: Sequence[NDArray]) -> list:
    """Return rings (n, 2) [m] as lists in millimetres."""
    return [np.round(1e3 * ring, 4).tolist() for ring in rings]


def _describe_finger(finger: RecognizedFinger, section: str, name: str, stiffness_error: float) -> list[str]:
    """Return the lines of a jaw file on section, material, key points and candidates.

    Args:
        finger: the recognized finger.
        section: name of its file.
        name: of its material.
        stiffness_error: relative standard deviation of the stiffness for another reason.
    """
    material, tapers = MATERIALS[name], bool(finger.taper.any())
    if stiffness_error:
        spread = round(min(float(np.hypot(material.spread, stiffness_error)), 1.0), 2)
        material = material.model_copy(update={"name": name, "spread": spread})
        name = json.dumps(material.model_dump())
    low, high = float(finger.clamp_height(finger.face_x)) + _AWAY, _find_face_end(finger) - _AWAY
    count = int(np.clip(round((high - low) / _STEP) + 1, _FEWEST, _MOST))
    circles = ", ".join(f"[{x:.5f}, {z:.5f}, {radius:.5f}]" for x, z, radius in finger.clamped_circles)
    tilt = f", slope: {finger.clamp_slope:.5f}" if finger.clamp_slope else ""
    clamped = f"z_below: {finger.clamped_z:.5g}{tilt}" + (f", circles: [{circles}]" if circles else "")
    return [
        "section:",
        f"  file: {section}  # polygons in the x-z plane",
        f"  width: {finger.width:.5g}" + ("  # at x = z = 0" if tapers else ""),
        *([f"  taper: [{finger.taper[0]:.5f}, {finger.taper[1]:.5f}]  # of the width, by x and z"] if tapers else []),
        f"  clamped: {{{clamped}}}  # held by the holder; circles: [x, z, radius] about bolts",
        f"inner_face_x: {finger.face_x:.5g}",
        f"material: {name}  # {1e-6 * material.young_modulus:.3g} MPa +- {material.spread:.0%}, until it is calibrated",
        "keypoints:  # on the side that the camera sees: where ribs meet bands, of few also between, and the tip",
        *(f"  {place}: {_list(point)}" for place, point in choose_keypoints(finger).items()),
        f"candidates: {{first_z: {low:.5g}, step_z: {(high - low) / (count - 1):.5g}, count: {count}}}",
    ]


def _list(point: NDArray) -> str:
    return "[" + ", ".join(f"{value:.5f}" for value in point) + "]"
