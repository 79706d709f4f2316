"""The picture of a recognized finger: its section with all that was found, and the finger in three dimensions."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from finforce_ifea.jaw.cad.recognition import RecognizedFinger, say_range
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.mesh import VolumeMesh
from finforce_ifea.jaw.section import order_rings

_VIEW = {"elev": 16.0, "azim": 53.0}  # [deg], from the side that the camera sees
_MATERIAL, _HELD, _INNER, _OUTER, _RIB = "#d9dee6", "#8a93a3", "#c0392b", "#2d6cb5", "#3a8f4d"


def draw_finger(finger: RecognizedFinger, jaw: Jaw, path: Path) -> None:
    """Draw a finger into a PNG file.

    Args:
        finger: the recognized finger.
        jaw: that was made of it.
        path: of the picture.
    """
    from matplotlib.figure import Figure

    size = np.array([np.ptp(finger.rings[0][:, 0]), finger.length])
    figure = Figure(figsize=(13.0, 9.0))
    flat = figure.add_axes((0.06, 0.07, 0.43, 0.87))
    solid = figure.add_axes((0.5, 0.07, 0.49, 0.87), projection="3d", proj_type="ortho")
    _draw_section(flat, finger)
    _draw_walls(flat, finger)
    _draw_points(flat, finger, jaw)
    flat.set(xlabel="x / mm, towards the object", ylabel="z / mm, base to tip", aspect="equal")
    widths = [finger.width] if finger.layers else finger.read_width(finger.rings[0])
    low, high = (f"{1e3 * width:.1f}" for width in (np.min(widths), np.max(widths)))
    across = high if low == high else f"{low} to {high}"
    flat.set_title(f"{jaw.name}: {1e3 * size[0]:.1f} x {across} x {1e3 * size[1]:.1f} mm")
    flat.legend(loc="upper left", fontsize=8, framealpha=0.9)
    _draw_solid(solid, jaw.build_mesh("coarse"))
    figure.savefig(path, dpi=110)


def draw_refused(polygon: shapely.Polygon, reason: str, path: Path) -> None:
    """Draw a section [m] that shows no finger into a PNG file: its holes with numbers, and why it was refused."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 9.0), layout="constrained")
    axes = figure.add_subplot()
    _draw_material(axes, order_rings(polygon))
    for number, hole in enumerate(polygon.interiors, start=1):
        place = shapely.Polygon(hole).representative_point()
        axes.annotate(str(number), (1e3 * place.x, 1e3 * place.y), ha="center", va="center", fontsize=8)
    axes.set(xlabel="mm, as in the file", ylabel="mm", aspect="equal")
    axes.autoscale_view()
    axes.set_title("\n".join(wrap(reason, 90)), fontsize=9)
    figure.savefig(path, dpi=110)


def _draw_material(axes, rings: Sequence[NDArray]) -> Any:
    """Draw the material within rings (n, 2) [m] and return its patch."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Curve

    vertices, codes = [], []
    for ring in rings:
        vertices.append(1e3 * np.vstack([ring, ring[:1]]))
        codes.append(np.r_[Curve.MOVETO, np.full(len(ring) - 1, Curve.LINETO), Curve.CLOSEPOLY])
    curve = Curve(np.concatenate(vertices), np.concatenate(codes))
    return axes.add_patch(PathPatch(curve, facecolor=_MATERIAL, edgecolor="black", linewidth=0.7))


def _draw_section(axes, finger: RecognizedFinger) -> None:
    """Draw the material, and what is clamped in a darker tone."""
    from matplotlib.patches import Circle

    patch = _draw_material(axes, finger.rings)
    bounds = 1e3 * np.array(finger.polygon.bounds)
    x = np.array([bounds[0], bounds[2]])
    held = axes.fill_between(
        x, bounds[1] - 1.0, 1e3 * finger.clamp_height(1e-3 * x), facecolor=_HELD, edgecolor="none", label="clamped"
    )
    held.set_clip_path(patch)
    for x, z, radius in 1e3 * finger.clamped_circles:
        around = axes.add_patch(Circle((x, z), radius, facecolor=_HELD))
        around.set_clip_path(patch)
    margin = 0.06 * (bounds[3] - bounds[1])
    axes.set_xlim(bounds[0] - 3.0 * margin, bounds[2] + 3.0 * margin)
    axes.set_ylim(bounds[1] - margin, bounds[3] + margin)


def _draw_walls(axes, finger: RecognizedFinger) -> None:
    """Draw the centre lines with their thickness."""
    for wall, colour, name in ((finger.inner, _INNER, "inner band"), (finger.outer, _OUTER, "outer band")):
        free = wall.line[:, 1] > finger.clamp_height(wall.line[:, 0])
        label = f"{name}, {say_range(wall.thickness[free])} mm"
        axes.plot(*(1e3 * wall.line[free].T), color=colour, linewidth=1.2, label=label)
    for number, rib in enumerate(finger.ribs):
        ends = 1e3 * np.array([rib.inner, rib.outer])
        label = f"{len(finger.ribs)} ribs, {say_range([rib.wall.usual for rib in finger.ribs])} mm"
        axes.plot(*ends.T, color=_RIB, linewidth=1.2, label=None if number else label)


def _draw_points(axes, finger: RecognizedFinger, jaw: Jaw) -> None:
    """Draw key points with their names, candidates, reference point and bolts."""
    points = 1e3 * jaw.keypoints
    axes.plot(points[:, 0], points[:, 2], "o", color="black", markersize=5, label=f"{len(points)} key points")
    middle = float(np.mean(points[:, 0]))
    for name, (x, _, z) in zip(jaw.keypoint_names, points, strict=True):
        right = name.startswith("inner") or (name == "tip" and x >= middle)
        axes.annotate(
            name,
            (x, z),
            xytext=(7 if right else -7, 0),
            textcoords="offset points",
            ha="left" if right else "right",
            va="center",
            fontsize=7,
        )
    x, _, z = 1e3 * jaw.candidates.T
    axes.plot(x, z, "<", color=_INNER, markersize=4, label=f"{len(x)} contact candidates")
    axes.plot(*(1e3 * jaw.reference_point[[0, 2]]), "+", color="black", markersize=11, label="reference point")
    for x, z, radius in 1e3 * finger.bolts:
        axes.annotate(f"Ø{2.0 * radius:.2f}", (x, z), ha="center", va="center", fontsize=6)


def _draw_solid(axes, mesh: VolumeMesh) -> None:
    """Draw a mesh as seen from the camera's side, without the triangles that look away, which would shine through."""
    up, around = np.radians([_VIEW["elev"], _VIEW["azim"]])
    towards = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    corners = mesh.nodes[mesh.surface]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axes.plot_trisurf(
        *(1e3 * mesh.nodes.T), triangles=mesh.surface[normals @ towards > 0.0], color=_MATERIAL, linewidth=0.0
    )
    axes.view_init(**_VIEW)
    axes.set_aspect("equal")
    axes.set_axis_off()
