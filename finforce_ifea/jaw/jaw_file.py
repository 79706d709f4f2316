"""Typed reading of a jaw file's YAML into the parts of a jaw, with errors that say what would do."""

import contextlib
import difflib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.files import FileError, read_yaml
from finforce_ifea.errors import JawFileError
from finforce_ifea.jaw.drawing import Band, Drawing, Rib
from finforce_ifea.jaw.face import FaceLine
from finforce_ifea.jaw.mesh_file import ClampRule
from finforce_ifea.jaw.section import Section, join_loops, order_rings, read_loops

_LARGEST_COUNT = 10_000


def read_table(path: Path) -> "Table":
    """Read a YAML file whose content is a mapping.

    Raises:
        JawFileError: The file is missing, empty, no YAML, or no mapping.
    """
    try:
        content = read_yaml(path, text_keys=False)
    except FileError as error:
        raise JawFileError(str(error)) from error
    if content is None:
        raise JawFileError("is empty, expected drawing or mesh, material, keypoints, candidates")
    if not isinstance(content, dict):
        raise JawFileError(f"got {_describe(content)} at the top, expected a mapping")
    return Table(prefix="", values=content)


@dataclass(frozen=True, kw_only=True)
class Table:
    """A mapping of the file.

    Attributes:
        prefix: the full name of its key, such as "drawing.ribs"; empty at the top.
        values: its content.
    """

    prefix: str
    values: dict[str, Any]

    def __contains__(self, key: str) -> bool:
        """Whether a key is given."""
        return key in self.values

    def name(self, key: str) -> str:
        """Return the full name of a key."""
        return f"{self.prefix}.{key}" if self.prefix else str(key)

    def expect_keys(self, required: Iterable[str], optional: Iterable[str] = ()) -> None:
        """Refuse missing and unknown keys, suggesting the nearest valid key.

        Raises:
            JawFileError: A key is missing or unknown.
        """
        required, valid = list(required), [*required, *optional]
        for key in self.values:
            if key not in valid:
                near = difflib.get_close_matches(str(key), valid, n=1, cutoff=0.5)
                hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(valid)}"
                raise JawFileError(f"unknown key {self.name(key)!r}; {hint}")
        for key in required:
            if key not in self.values:
                raise JawFileError(f"{self.name(key)} is missing; expected {', '.join(required)}")

    def expect_one_of(self, *keys: str) -> str:
        """Return which one of some keys is given.

        Raises:
            JawFileError: None or several are given.
        """
        given = [key for key in keys if key in self.values]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            table = self.prefix or "the file"
            raise JawFileError(f"{table}: got {found}, expected exactly one of {', '.join(keys)}")
        return given[0]

    def table(self, key: str) -> "Table":
        """Return the mapping under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        value = self.values[key]
        if not isinstance(value, dict):
            raise JawFileError(f"{self.name(key)}: got {_describe(value)}, expected a mapping")
        return Table(prefix=self.name(key), values=value)

    def choice(self, key: str, options: tuple[str, ...], default: str) -> str:
        """Return the word under a key, one of some options.

        Raises:
            JawFileError: Something else stands there.
        """
        value = self.values.get(key, default)
        if value not in options:
            raise JawFileError(f"{self.name(key)}: got {_describe(value)}, expected {' or '.join(options)}")
        return value

    def text(self, key: str, default: str) -> str:
        """Return the text under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        value = self.values.get(key, default)
        if not isinstance(value, str) or not value.strip():
            raise JawFileError(f"{self.name(key)}: got {_describe(value)}, expected a text")
        return value

    def switch(self, key: str, default: bool) -> bool:
        """Return the true or false under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        value = self.values.get(key, default)
        if not isinstance(value, bool):
            raise JawFileError(f"{self.name(key)}: got {_describe(value)}, expected true or false")
        return value

    def count(self, key: str) -> int:
        """Return the whole number from 1 to 10000 under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        value = self.values[key]
        if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= _LARGEST_COUNT:
            raise JawFileError(
                f"{self.name(key)}: got {_describe(value)}, expected a whole number >= 1 and <= {_LARGEST_COUNT}"
            )
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """Return the finite number under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        return _parse_number(self.values.get(key, default), self.name(key))

    def length(self, key: str, default: float | None = None, largest: float = 1.0) -> float:
        """Return the length [m] under a key.

        Raises:
            JawFileError: Something else stands there, or more than the largest that makes sense.
        """
        return _parse_length(self.values.get(key, default), self.name(key), largest)

    def lengths(self, key: str, largest: float = 1.0) -> list[float]:
        """Return the list of lengths [m] under a key; a single one is a list of one.

        Raises:
            JawFileError: Something else stands there, or more than the largest that makes sense.
        """
        value = self.values[key]
        if not isinstance(value, list):
            return [_parse_length(value, self.name(key), largest)]
        return [_parse_length(item, f"{self.name(key)}[{i}]", largest) for i, item in enumerate(value)]

    def point(self, key: str, default: tuple[float, float, float] | None = None) -> NDArray:
        """Return the point (3,) [m] under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        return parse_point(self.values.get(key, default), self.name(key))


def parse_point(value: Any, name: str) -> NDArray:
    """Return a point (3,) [m] from a list of three lengths.

    Raises:
        JawFileError: It is something else.
    """
    if not isinstance(value, (list, tuple)) or len(value) != 3:
        raise JawFileError(f"{name}: got {_describe(value)}, expected a point [x, y, z] in metres")
    return np.array([_parse_length(item, f"{name}[{axis}]") for item, axis in zip(value, "xyz", strict=True)])


def _parse_number(value: Any, name: str) -> float:
    """Return a finite number; texts such as 26e6, which YAML does not take for numbers, are read too."""
    number = value
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            number = float(value)
    if not isinstance(number, (int, float)) or isinstance(number, bool):
        raise JawFileError(f"{name}: got {_describe(value)}, expected a number")
    if not math.isfinite(number):
        raise JawFileError(f"{name}: got {number}, expected a finite number")
    return float(number)


def _parse_length(value: Any, name: str, largest: float = 1.0) -> float:
    """Return a length [m] that is not larger than makes sense."""
    length = _parse_number(value, name)
    if abs(length) > largest:
        raise JawFileError(
            f"{name}: got {length:g}, which looks like millimetres; expected metres, such as {length / 1000:g}"
        )
    return length


def _describe(value: Any) -> str:
    """Return a short description of a value that was not expected."""
    if value is None:
        return "nothing"
    kinds = {dict: "a mapping", list: "a list", str: "the text", bool: "the switch"}
    text = repr(value)
    text = text if len(text) <= 60 else text[:57] + "..."
    return f"{kinds.get(type(value), 'the ' + type(value).__name__)} {text}"


# A thicker band or rib [m] was given in millimetres.
_LARGEST_THICKNESS = 0.1


@dataclass(frozen=True, kw_only=True)
class Material:
    """A linear elastic material.

    Attributes:
        young_modulus: [Pa].
        poisson_ratio: [-].
        spread: relative standard deviation of the modulus among parts of that material; 0 where it was not stated.
    """

    young_modulus: float
    poisson_ratio: float
    spread: float = 0.0


# What printed parts of a material are like before anybody has measured one: Young's modulus at small strain [MPa],
# Poisson's ratio, and the relative spread over makers, printers, infill, temperature and age. Moduli from data sheets
# (NinjaFlex, Ultimaker, Bambu and eSun TPU, Formlabs) and, where those give none, from the Shore hardness by Qi, Joyce,
# Boyce, Rubber Chem. Technol. 76 (2003).
MATERIALS = {
    "tpu85a": Material(young_modulus=12.0e6, poisson_ratio=0.47, spread=0.35),
    "tpu90a": Material(young_modulus=18.0e6, poisson_ratio=0.46, spread=0.35),
    "tpu95a": Material(young_modulus=26.0e6, poisson_ratio=0.45, spread=0.3),
    "tpu64d": Material(young_modulus=110.0e6, poisson_ratio=0.43, spread=0.3),
    "petg": Material(young_modulus=1.9e9, poisson_ratio=0.38, spread=0.15),
    "pla": Material(young_modulus=2.9e9, poisson_ratio=0.35, spread=0.15),
    "spring_steel": Material(young_modulus=206.0e9, poisson_ratio=0.3, spread=0.03),
}


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


def parse_material(top: Table) -> Material:
    """Read `material`: a name, or its numbers.

    Raises:
        JawFileError: The name is unknown, or a number is missing or cannot belong to a material.
    """
    name = top.values["material"]
    if isinstance(name, str):
        if name.lower() not in MATERIALS:
            raise JawFileError(f"material: got {name!r}, expected one of {', '.join(MATERIALS)}, or young_modulus [Pa]")
        return MATERIALS[name.lower()]
    table = top.table("material")
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


def parse_section(table: Table, folder: Path) -> Section:
    """Read the table `section`; its path is relative to the folder of the jaw file.

    Raises:
        JawFileError: It does not describe a section.
    """
    table.expect_keys(("file", "clamped"), ("width", "taper", "size"))
    path = folder / table.text("file", "")
    loops, width = read_loops(path)
    try:
        rings = order_rings(join_loops(loops))
    except JawFileError as error:
        raise JawFileError(f"{path.name}: {error}") from error
    width = table.length("width") if "width" in table else width
    if not (width and width > 0.0):
        raise JawFileError(f"{table.name('width')}: got {width}, expected a positive length in metres")
    taper = np.array(table.values.get("taper", [0.0, 0.0]), dtype=object)
    if taper.shape != (2,) or not all(isinstance(value, int | float) and abs(value) < 1.0 for value in taper):
        raise JawFileError(f"{table.name('taper')}: got {taper.tolist()}, expected [by x, by z], each -1 to 1")
    size = table.length("size", largest=_LARGEST_THICKNESS) if "size" in table else None
    if size is not None and size <= 0.0:
        raise JawFileError(f"{table.name('size')}: got {size:g}, expected a positive length in metres")
    clamp = table.table("clamped")
    clamp.expect_keys((), ("z_below", "circles"))
    circles = clamp.values.get("circles", [])
    if not isinstance(circles, list) or not ("z_below" in clamp or circles):
        raise JawFileError(f"{clamp.prefix}: expected z_below, or circles, a list of [x, z, radius]")
    circles = np.array([parse_point(circle, f"{clamp.name('circles')}[{i}]") for i, circle in enumerate(circles)])
    section = Section(
        rings=rings,
        width=width,
        taper=taper.astype(float),
        clamped_z=clamp.length("z_below") if "z_below" in clamp else None,
        clamped_circles=circles.reshape(-1, 3),
        size=size,
    )
    least = float(section.read_width(rings[0]).min())
    if not least > 0.0:
        raise JawFileError(f"{table.name('taper')}: leaves a width of {1e3 * least:.3g} mm somewhere, expected any")
    return section


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


def parse_candidates(table: Table, face: FaceLine) -> NDArray:
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
    return np.column_stack([face.read(z), np.full(count, rule.length("y", 0.0)), z])
