"""A finger as people draw it: base with bolts, straight inner band, slanted outer band, slanted ribs."""

import json

import numpy as np
import shapely

from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.section import Section, order_rings

MILLIMETRE = 1e-3
LENGTH, WIDTH, BASE = 70.0, 20.0, 12.0
TPU = Material(young_modulus=26.0e6, poisson_ratio=0.45)


def draw_polygon(ribs=4, slant=4.0, band=1.6, rib=1.2, face=14.0, bolts=((-8.0, 5.0), (8.0, 5.0)), bulge=0.0):
    """Returns a section (shapely) in millimetres: inner face at x = face, base at z = 0, tip at z = LENGTH.

    `slant` is by how much the outer ends of the ribs are higher, `bulge` how far the inner face stands out.
    """
    outline = [(face, 0.0), (face, BASE)]
    if bulge:
        z = np.linspace(BASE, LENGTH, 30)[1:-1]
        outline += [(face + bulge * np.sin(np.pi * (h - BASE) / (LENGTH - BASE)), h) for h in z]
    outline += [(face, LENGTH), (face - 4.0, LENGTH), (-face, BASE), (-face, 0.0)]
    whole = shapely.Polygon(outline)
    room = whole.buffer(-band, join_style="mitre").intersection(shapely.box(-50.0, BASE, 50.0, LENGTH - 6.0))
    heights = np.linspace(BASE + 10.0, LENGTH - 16.0, ribs)
    for z in heights:
        line = shapely.LineString([(face + 5.0, z), (-face - 5.0, z + slant * (2 * face + 10) / (2 * face))])
        room = room.difference(line.buffer(0.5 * rib, cap_style="flat"))
    section = whole.difference(room)
    for x, z in bolts:
        section = section.difference(shapely.Point(x, z).buffer(1.5, quad_segs=12))
    return section


def make_section(polygon=None, clamped_z=BASE, width=WIDTH, circles=(), size=None):
    """Returns a section of a polygon in millimetres."""
    polygon = draw_polygon() if polygon is None else polygon
    rings = tuple(MILLIMETRE * ring for ring in order_rings(polygon))
    return Section(
        rings=rings,
        width=MILLIMETRE * width,
        clamped_z=MILLIMETRE * clamped_z,
        clamped_circles=np.array(circles, float).reshape(-1, 3),
        size=size,
    )


def draw_keypoints():
    """Returns places on the bands where the ribs meet them, about, and the tip."""
    heights = np.linspace(BASE + 10.0, LENGTH - 16.0, 4) * MILLIMETRE
    points = {f"inner_{k}": [0.0132, 0.01, float(z)] for k, z in enumerate(heights, start=1)}
    for k, z in enumerate(heights + 4e-3, start=1):
        points[f"outer_{k}"] = [float(-0.014 + 0.024 * (z - 0.012) / 0.058 + 0.8e-3), 0.01, float(z)]
    return {**points, "tip": [0.012, 0.01, 0.068]}


def write_section_jaw(folder, polygon=None, **changes):
    """Writes a jaw file with its section into a folder; changes replace keys of the file. Returns its path."""
    polygon = draw_polygon() if polygon is None else polygon
    loops = [ring.tolist() for ring in order_rings(polygon)]
    (folder / "finger.section.json").write_text(json.dumps({"unit": "mm", "loops": loops}))
    content = {
        "name": "printed finger",
        "section": {"file": "finger.section.json", "width": 0.02, "clamped": {"z_below": 0.012}},
        "material": "tpu95a",
        "keypoints": draw_keypoints(),
        "candidates": {"first_z": 0.016, "step_z": 0.005, "count": 9},
        **changes,
    }
    path = folder / "finger.yaml"
    path.write_text(json.dumps(content))
    return path
