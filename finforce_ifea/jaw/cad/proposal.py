"""A jaw file from a recognized finger: key points, contact candidates, reference point, and the text of it all."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from finforce_ifea.jaw.cad.recognition import RecognizedFinger
from finforce_ifea.jaw.jaw_file import MATERIALS

# Key points [m] above the clamp at least; candidates so far from either end of the inner face, and from each other.
_ABOVE, _AWAY, _STEP = 1e-3, 4e-3, 4e-3
_FEWEST, _MOST = 6, 30
_TIP = 2.5e-3
# With fewer key points where ribs meet bands, those between them are taken, too: an object hides some.
FEW = 12
BANDS = ("inner", "outer")
# A reference point [m] below a clamp that the section does not show.
_BELOW = -6e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """What the jaw file says beside the section.

    Attributes:
        name: of the finger.
        material: its name in `MATERIALS`.
        keypoints: name to (3,) [m], jaw frame.
        candidates: first height, step [m] and number of the contact candidates.
        reference: (3,) [m].
        reference_note: where that is.
    """

    name: str
    material: str
    keypoints: dict[str, NDArray]
    candidates: tuple[float, float, int]
    reference: NDArray
    reference_note: str


def propose(finger: RecognizedFinger, name: str, material: str) -> Proposal:
    """Choose what a camera can see and where objects may touch.

    Key points are where the ribs meet the bands, on the side face towards the camera, inner band first, base to tip,
    and the tip; what the clamp holds is left out, since it does not move. Where these are few, points of the bands half
    way between them come behind.
    """
    places = {}
    for band in BANDS:
        for number, rib in enumerate(finger.ribs, start=1):
            x, z = getattr(rib, band)
            if z > finger.clamped_z + _ABOVE and not finger.find_clamped(np.array([[x, z]])).any():
                places[f"{band}_{number}"] = (x, z)
    top = finger.polygon.intersection(shapely.box(-1.0, finger.length - _TIP, 1.0, 1.0)).centroid
    places["tip"] = (top.x, top.y)
    if len(places) < FEW:
        places |= _find_middles(finger, places)
    points = {name: _put_on_side(finger, *place) for name, place in places.items()}
    low, high = finger.clamped_z + _AWAY, _find_face_end(finger) - _AWAY
    count = int(np.clip(round((high - low) / _STEP) + 1, _FEWEST, _MOST))
    reference, note = _choose_reference(finger)
    return Proposal(
        name=name,
        material=material,
        keypoints=points,
        candidates=(low, (high - low) / (count - 1), count),
        reference=_put_on_side(finger, *reference),
        reference_note=note,
    )


def _find_middles(
    finger: RecognizedFinger, places: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Return points (x, z) [m] of each band half way between clamp, key points on it, and tip, by the names of both."""
    found = {}
    for band in BANDS:
        line = getattr(finger, band).line
        ends = {name: z for name, (_, z) in places.items() if name.startswith(band)}
        ends = {"clamp": finger.clamped_z, **ends, "tip": places["tip"][1]}
        for (below, low), (above, high) in pairwise(ends.items()):
            z = 0.5 * (low + high)
            x = float(np.interp(z, line[:, 1], line[:, 0]))
            if not finger.find_clamped(np.array([[x, z]])).any():
                found[f"{band}_{below.removeprefix(f'{band}_')}_{above.removeprefix(f'{band}_')}"] = (x, z)
    return found


def _put_on_side(finger: RecognizedFinger, x: float, z: float) -> NDArray:
    """Return a place of the section on the side that the camera sees (3,) [m]."""
    return np.array([x, 0.5 * float(finger.read_width(np.array([x, z]))), z])


def _find_face_end(finger: RecognizedFinger) -> float:
    """Return the highest z [m] at which the outline is on the plane of the inner face."""
    ring = np.array(finger.polygon.exterior.coords)
    return float(ring[np.abs(ring[:, 0] - finger.face_x) < max(1e-4, 1.1 * finger.face_deviation), 1].max())


def _choose_reference(finger: RecognizedFinger) -> tuple[NDArray, str]:
    """Return a point (2,) [m] that never bends: in the middle of the largest flat patch of what is clamped."""
    held = finger.polygon.intersection(shapely.box(-1.0, -1.0, 1.0, finger.clamped_z))
    circle = shapely.maximum_inscribed_circle(held) if held.area > 0.0 else None
    if circle is None or circle.length < 1.5e-3:
        return np.array([0.0, _BELOW]), "on the holder, below the finger: mark it there with a dot"
    place = np.array(circle.coords[0])
    return place, f"on the clamped part, a patch of {1e3 * circle.length:.1f} mm around it: mark it with a dot"


def write_jaw(finger: RecognizedFinger, proposal: Proposal, path: Path, source: str) -> Path:
    """Write the jaw file and, beside it, its section; return the section's path.

    Args:
        finger: what was recognized.
        proposal: what was chosen.
        path: of the YAML file.
        source: name of the file that it comes from.
    """
    section = path.with_suffix(".section.json")
    loops = [np.round(1e3 * ring, 4).tolist() for ring in finger.rings]
    content = {
        "source": source,
        "unit": "mm",
        "axes": ["x", "z"],
        "width": round(1e3 * finger.width, 4),
        "loops": loops,
    }
    section.write_text(json.dumps(content) + "\n", encoding="utf-8")
    path.write_text(_describe_jaw(finger, proposal, section.name, source), encoding="utf-8")
    return section


def _describe_jaw(finger: RecognizedFinger, proposal: Proposal, section: str, source: str) -> str:
    """Return the text of a jaw file."""
    material = MATERIALS[proposal.material]
    first, step, count = proposal.candidates
    circles = ", ".join(f"[{x:.5f}, {z:.5f}, {radius:.5f}]" for x, z, radius in finger.clamped_circles)
    tapers = bool(finger.taper.any())
    clamped = f"z_below: {finger.clamped_z:.5g}" + (f", circles: [{circles}]" if circles else "")
    lines = [
        f"# {proposal.name}, from {source}. Lengths in metres, jaw frame (x closing, y width, z base to tip).",
        f"name: {proposal.name}",
        "section:",
        f"  file: {section}  # polygons in the x-z plane",
        f"  width: {finger.width:.5g}" + ("  # at x = z = 0" if tapers else ""),
        *([f"  taper: [{finger.taper[0]:.5f}, {finger.taper[1]:.5f}]  # of the width, by x and z"] if tapers else []),
        f"  clamped: {{{clamped}}}  # what the holder keeps from moving; circles: [x, z, radius] about bolts",
        f"inner_face_x: {finger.face_x:.5g}",
        f"material: {proposal.material}  # {1e-6 * material.young_modulus:.3g} MPa +- {material.spread:.0%}, until "
        "it is calibrated",
        "keypoints:  # on the side that the camera sees: where ribs meet bands, of few also between, and the tip",
        *(f"  {name}: {_list(point)}" for name, point in proposal.keypoints.items()),
        f"candidates: {{first_z: {first:.5g}, step_z: {step:.5g}, count: {count}}}",
        f"reference_point: {_list(proposal.reference)}  # {proposal.reference_note}",
    ]
    return "\n".join(lines) + "\n"


def _list(point: NDArray) -> str:
    return "[" + ", ".join(f"{value:.5f}" for value in point) + "]"
