"""The parts of a jaw from the tables of a jaw file: drawing, mesh file, key points, candidates."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.drawing import Band, Drawing, Rib
from finforce_ifea.errors import JawFileError
from finforce_ifea.jaw_file import Table, parse_point
from finforce_ifea.mesh_file import ClampRule

# A thicker band or rib [m] was given in millimetres.
_LARGEST_THICKNESS = 0.1


@dataclass(frozen=True, kw_only=True)
class Material:
    """A linear elastic material.

    Attributes:
        young_modulus: [Pa].
        poisson_ratio: [-].
    """

    young_modulus: float
    poisson_ratio: float


@dataclass(frozen=True, kw_only=True)
class MeshFile:
    """A volume mesh file and how to read it.

    Attributes:
        path: the file.
        scale: [-], multiplies its coordinates; 0.001 for millimetres.
        clamp: which of its nodes are clamped.
    """

    path: Path
    scale: float
    clamp: ClampRule


def parse_material(table: Table) -> Material:
    """Read the table `material`.

    Raises:
        JawFileError: A number is missing or cannot belong to a material.
    """
    table.expect_keys(("young_modulus", "poisson_ratio"), ("name",))
    modulus, ratio = table.number("young_modulus"), table.number("poisson_ratio")
    name = table.name("young_modulus")
    if modulus <= 0.0:
        raise JawFileError(f"{name}: got {modulus:g}, expected a positive number of Pa")
    if modulus < 1e4:
        raise JawFileError(f"{name}: got {modulus:g}, which looks like MPa; expected Pa, such as {modulus * 1e6:.3e}")
    if not -1.0 < ratio < 0.5:
        raise JawFileError(f"{table.name('poisson_ratio')}: got {ratio:g}, expected more than -1 and less than 0.5")
    return Material(young_modulus=modulus, poisson_ratio=ratio)


def parse_drawing(table: Table) -> Drawing:
    """Read the table `drawing`.

    Raises:
        JawFileError: It does not describe a finger.
    """
    table.expect_keys(("length", "width", "inner_band", "outer_band", "tip"), ("ribs", "clamped_z", "joints", "bars"))
    length = table.length("length")
    if length <= 0.0:
        raise JawFileError(f"{table.name('length')}: got {length:g}, expected a positive length in metres")
    inner = _parse_band(table.table("inner_band"), length, -1)
    outer = _parse_band(table.table("outer_band"), length, 1)
    bars = table.choice("bars", ("elastic", "rigid"), "elastic")
    return Drawing(
        length=length,
        width=table.length("width"),
        inner=inner,
        outer=outer,
        ribs=_parse_ribs(table.table("ribs"), inner, outer, bars) if "ribs" in table else (),
        tip_z=_parse_tip(table),
        clamped_z=table.length("clamped_z", 0.0),
        joints=table.choice("joints", ("stiff", "hinged"), "stiff"),
        bars=bars,
    )


def _parse_band(table: Table, length: float, inward: int) -> Band:
    """Read a band, given by `face_x` or `centre_x`: one number, or one at the base and one at the tip."""
    table.expect_keys(("thickness",), ("face_x", "centre_x"))
    key = table.expect_one_of("face_x", "centre_x")
    ends = table.lengths(key)
    if len(ends) not in (1, 2):
        raise JawFileError(f"{table.name(key)}: got {len(ends)} numbers, expected one, or [at base, at tip]")
    thickness = table.length("thickness", largest=_LARGEST_THICKNESS)
    shift = -0.5 * inward * thickness if key == "centre_x" else 0.0
    base, tip = ends[0] + shift, ends[-1] + shift
    return Band(base=(base, 0.0), tip=(tip, length), thickness=thickness, inward=inward)


def _parse_tip(table: Table) -> float | None:
    """Read the tip: the word rigid, or the height from which it is solid."""
    if table.values["tip"] == "rigid":
        return None
    if not isinstance(table.values["tip"], dict):
        raise JawFileError(f"{table.name('tip')}: got {table.values['tip']!r}, expected rigid or {{solid_from_z: ...}}")
    tip = table.table("tip")
    tip.expect_keys(("solid_from_z",))
    return tip.length("solid_from_z")


def _parse_ribs(table: Table, inner: Band, outer: Band, bars: str) -> tuple[Rib, ...]:
    """Read the ribs, given by common heights, by heights on either band, or by arc lengths on either band."""
    table.expect_keys((), ("z", "inner_z", "outer_z", "inner_arc", "outer_arc", "thickness"))
    key = table.expect_one_of("z", "inner_z", "inner_arc")
    other = {"z": "z", "inner_z": "outer_z", "inner_arc": "outer_arc"}[key]
    table.expect_keys((key, other), ("thickness",))
    inner_z, outer_z = np.array(table.lengths(key)), np.array(table.lengths(other))
    if key == "inner_arc":
        inner_z, outer_z = inner.z_from_arc(inner_z), outer.z_from_arc(outer_z)
    if "thickness" not in table and bars == "elastic":
        raise JawFileError(f"{table.name('thickness')} is missing; only rigid bars need none")
    thickness = np.array(table.lengths("thickness", _LARGEST_THICKNESS) if "thickness" in table else [0.0])
    if len(thickness) == 1:
        thickness = np.repeat(thickness, len(inner_z))
    if not len(inner_z) == len(outer_z) == len(thickness):
        raise JawFileError(
            f"{table.prefix}: got {len(inner_z)} inner ends, {len(outer_z)} outer ends and {len(thickness)} "
            "thicknesses, expected as many of each (or one thickness for all)"
        )
    rows = zip(inner_z.tolist(), outer_z.tolist(), thickness.tolist(), strict=True)
    return tuple(Rib(inner_z=low, outer_z=high, thickness=t) for low, high, t in rows)


def parse_mesh_file(table: Table, folder: Path) -> MeshFile:
    """Read the table `mesh`; its path is relative to the folder of the jaw file.

    Raises:
        JawFileError: It does not describe a mesh file.
    """
    table.expect_keys(("file", "clamped"), ("scale",))
    scale = table.number("scale", 1.0)
    if scale <= 0.0:
        raise JawFileError(f"{table.name('scale')}: got {scale:g}, expected a positive number")
    clamp = _parse_clamp(table.table("clamped"))
    return MeshFile(path=folder / table.text("file", ""), scale=scale, clamp=clamp)


def _parse_clamp(table: Table) -> ClampRule:
    """Read which nodes are clamped: `z_below`, `box` or `nodes`."""
    table.expect_keys((), ("z_below", "box", "nodes"))
    rule = table.expect_one_of("z_below", "box", "nodes")
    if rule == "z_below":
        return ClampRule(z_below=table.length(rule))
    value = table.values[rule]
    if rule == "box":
        if not isinstance(value, list) or len(value) != 2:
            raise JawFileError(f"{table.name(rule)}: expected two corners [[x, y, z], [x, y, z]], lowest first")
        corners = np.array([parse_point(corner, f"{table.name(rule)}[{i}]") for i, corner in enumerate(value)])
        if (corners[0] > corners[1]).any():
            raise JawFileError(f"{table.name(rule)}: got {value}, expected the lowest corner first")
        return ClampRule(box=corners)
    whole = isinstance(value, list) and all(isinstance(n, int) and not isinstance(n, bool) for n in value)
    if not whole or not value:
        raise JawFileError(f"{table.name(rule)}: expected a list of node indices from 0")
    return ClampRule(nodes=tuple(value))


def parse_keypoints(table: Table, drawing: Drawing | None) -> dict[str, NDArray]:
    """Read the key points (name -> (3,) [m]): listed by name, or by `rule: rib_junctions`.

    Raises:
        JawFileError: A point is none, or the rule does not fit the jaw.
    """
    if "rule" not in table:
        if not table.values:
            raise JawFileError(f"{table.prefix}: got none, expected at least one name: [x, y, z]")
        return {str(name): parse_point(value, table.name(name)) for name, value in table.values.items()}
    table.expect_keys(("rule", "side_y"), ("tip",))
    table.choice("rule", ("rib_junctions",), "rib_junctions")
    if drawing is None:
        raise JawFileError(f"{table.name('rule')}: rib_junctions needs a drawing; list the points as name: [x, y, z]")
    return _junction_points(drawing, table.length("side_y"), table.switch("tip", drawing.tip_z is not None))


def _junction_points(drawing: Drawing, side_y: float, tip: bool) -> dict[str, NDArray]:
    """Return the rib ends on the inner band, then on the outer band, base to tip, then the tip."""
    points = {}
    for name, ends in zip(("inner", "outer"), drawing.junctions, strict=True):
        for number, (x, z) in enumerate(ends, start=1):
            points[f"{name}_{number}"] = np.array([x, side_y, z])
    if tip:
        x, z = drawing.tip_point
        points["tip"] = np.array([x, side_y, z])
    if not points:
        raise JawFileError("keypoints: rib_junctions gives none, because the drawing has no ribs")
    return points


def parse_candidates(table: Table, inner_face_x: float) -> NDArray:
    """Read the contact candidates (C, 3) [m]: a list of points, or first_z, step_z, count on the inner face.

    Raises:
        JawFileError: They are neither.
    """
    value = table.values["candidates"]
    if isinstance(value, list):
        if not value:
            raise JawFileError("candidates: got none, expected at least one point [x, y, z]")
        return np.array([parse_point(point, f"candidates[{i}]") for i, point in enumerate(value)])
    rule = table.table("candidates")
    rule.expect_keys(("first_z", "step_z", "count"), ("y",))
    count = rule.count("count")
    z = rule.length("first_z") + rule.length("step_z") * np.arange(count)
    return np.column_stack([np.full(count, inner_face_x), np.full(count, rule.length("y", 0.0)), z])
