"""The jaw file: what may stand in it, and the parts of a jaw that it stands for."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, StrictBool, Tag, model_validator

from finforce.typed_yaml import TAGS, Count, FileModel, Length, Number, Point, Text, Thickness
from finforce_ifea.errors import JawFileError
from finforce_ifea.jaw.drawing import Band, Drawing, Rib
from finforce_ifea.jaw.mesh_file import MeshFile
from finforce_ifea.jaw.section import FaceLine, Section, join_loops, order_rings, read_section_file

LIST, MAPPING = TAGS


def _list_one(value: Any) -> Any:
    """Return a single number as a list of one."""
    return value if isinstance(value, list | tuple) else [value]


Lengths = Annotated[tuple[Length, ...], BeforeValidator(_list_one)]
Thicknesses = Annotated[tuple[Thickness, ...], BeforeValidator(_list_one)]


def _refuse_megapascals(modulus: float) -> float:
    if 0.0 < modulus < 1e4:
        raise ValueError(f"got {modulus:g}, which looks like MPa; expected Pa, such as {modulus * 1e6:.3e}")
    return modulus


# Young's modulus [Pa] above which a material is hard: a glassy plastic or a metal, no elastomer.
_HARD = 1e9
# Coefficient of friction of elastomers and of hard materials on dry everyday objects, and its standard deviation [-].
# Tables for engineers have 0.2 to 0.45 for steel on plastics, 0.3 to 0.7 on wood, metals and glass.
_ELASTOMER_FRICTION, _HARD_FRICTION = (0.45, 0.25), (0.35, 0.15)


class Material(FileModel):
    """A linear elastic material."""

    young_modulus: Annotated[Number, AfterValidator(_refuse_megapascals)] = Field(
        gt=0.0, description="Young's modulus [Pa]"
    )
    poisson_ratio: Number = Field(gt=-1.0, lt=0.5, description="Poisson's ratio [-]")
    spread: Number = Field(
        0.0, ge=0.0, le=1.0, description="Relative standard deviation of the modulus among parts [-]"
    )
    name: Text = Field("", description="What it is called, for people")

    @property
    def friction(self) -> tuple[float, float]:
        """Coefficient of friction to expect of an object that nothing is known of, and its standard deviation [-]."""
        return _HARD_FRICTION if self.young_modulus > _HARD else _ELASTOMER_FRICTION


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


def _look_up(value: Any) -> Any:
    """Return the numbers of a material that is given by its name."""
    if not isinstance(value, str):
        return value
    known = MATERIALS.get(value.lower())
    if known is None:
        raise ValueError(f"got {value!r}, expected one of {', '.join(MATERIALS)}, or young_modulus [Pa]")
    return known


class BandEntry(FileModel):
    """A band by its outer face or its centre line: one number, or one at the base and one at the tip."""

    face_x: Lengths | None = Field(None, min_length=1, max_length=2, description="Outer face [m]")
    centre_x: Lengths | None = Field(None, min_length=1, max_length=2, description="Centre line [m]")
    thickness: Thickness = Field(description="Thickness along x [m]")

    @model_validator(mode="after")
    def _check(self) -> "BandEntry":
        self.expect_one_of("face_x", "centre_x")
        return self

    def build(self, length: float, inward: int) -> Band:
        """Return the band of a finger of some length [m] whose inner side is to +x (1) or -x (-1)."""
        shift = 0.0 if self.centre_x is None else -0.5 * inward * self.thickness
        ends = self.face_x or self.centre_x
        base, tip = ends[0] + shift, ends[-1] + shift
        return Band(base=(base, 0.0), tip=(tip, length), thickness=self.thickness, inward=inward)


class RibsEntry(FileModel):
    """Ribs by common heights, by heights on either band, or by arc lengths on either band."""

    z: Lengths | None = Field(None, description="Heights of straight ribs [m]")
    inner_z: Lengths | None = Field(None, description="Heights of their ends on the inner band [m]")
    outer_z: Lengths | None = Field(None, description="Heights of their ends on the outer band [m]")
    inner_arc: Lengths | None = Field(
        None, description="Distances of their ends from the base along the inner band [m]"
    )
    outer_arc: Lengths | None = Field(
        None, description="Distances of their ends from the base along the outer band [m]"
    )
    thickness: Thicknesses | None = Field(
        None, description="Thickness, one for all or one each [m]; rigid ones need none"
    )

    @model_validator(mode="after")
    def _check(self) -> "RibsEntry":
        self.expect_one_of("z", "inner_z", "inner_arc")
        self.expect_one_of("z", "outer_z", "outer_arc")
        if (self.inner_z is None) != (self.outer_z is None):
            raise ValueError("expected inner_z with outer_z, or inner_arc with outer_arc")
        return self

    def build(self, inner: Band, outer: Band, bars: str) -> tuple[Rib, ...]:
        """Return the ribs between two bands."""
        inner_z, outer_z = (np.array(self.z or ends or ()) for ends in (self.inner_z, self.outer_z))
        if self.inner_arc is not None:
            inner_z, outer_z = inner.z_from_arc(np.array(self.inner_arc)), outer.z_from_arc(np.array(self.outer_arc))
        if self.thickness is None and bars == "elastic":
            raise JawFileError("drawing.ribs.thickness is missing; only rigid bars need none")
        thickness = np.array(self.thickness or [0.0])
        if len(thickness) == 1:
            thickness = np.repeat(thickness, len(inner_z))
        if not len(inner_z) == len(outer_z) == len(thickness):
            raise JawFileError(
                f"drawing.ribs: got {len(inner_z)} inner ends, {len(outer_z)} outer ends and {len(thickness)} "
                "thicknesses, expected as many of each (or one thickness for all)"
            )
        rows = zip(inner_z.tolist(), outer_z.tolist(), thickness.tolist(), strict=True)
        return tuple(Rib(inner_z=low, outer_z=high, thickness=t) for low, high, t in rows)


class SolidTip(FileModel):
    """A tip that is solid."""

    solid_from_z: Length = Field(description="Height from which it is [m]")


def _refuse_other_tips(value: Any) -> Any:
    if value == "rigid":
        return None
    if not isinstance(value, dict):
        raise ValueError(f"got {value!r}, expected rigid or {{solid_from_z: ...}}")
    return value


class DrawingEntry(FileModel):
    """A finger of two bands, ribs and a tip."""

    length: Length = Field(gt=0.0, description="From the base to the end of the tip [m]")
    width: Length = Field(description="Along y [m]")
    clamped_z: Length = Field(0.0, description="Height up to which the finger is clamped [m]")
    inner_band: BandEntry = Field(description="Band whose outer face touches objects")
    outer_band: BandEntry = Field(description="Slanted band")
    ribs: RibsEntry | None = Field(None, description="Ribs between the bands")
    tip: Annotated[SolidTip | None, BeforeValidator(_refuse_other_tips)] = Field(
        description="rigid, or where it is solid"
    )
    joints: Literal["stiff", "hinged"] = Field("stiff", description="How ribs are joined to bands")
    bars: Literal["elastic", "rigid"] = Field("elastic", description="Whether ribs bend")

    def build(self) -> Drawing:
        """Return the finger.

        Raises:
            JawFileError: It cannot be drawn.
        """
        inner, outer = self.inner_band.build(self.length, -1), self.outer_band.build(self.length, 1)
        return Drawing(
            length=self.length,
            width=self.width,
            inner=inner,
            outer=outer,
            ribs=() if self.ribs is None else self.ribs.build(inner, outer, self.bars),
            tip_z=None if self.tip is None else self.tip.solid_from_z,
            clamped_z=self.clamped_z,
            joints=self.joints,
            bars=self.bars,
        )


class SectionClamp(FileModel):
    """The clamped region of the finger: all below a height, circles about bolts, or both."""

    z_below: Length | None = Field(None, description="All up to this height at x = 0 [m]")
    slope: Number = Field(0.0, gt=-2.0, lt=2.0, description="Rise of that height with x [-], of a tilted base")
    circles: tuple[Point, ...] = Field((), description="Circles [x, z, radius] [m]")

    @model_validator(mode="after")
    def _check(self) -> "SectionClamp":
        if self.z_below is None and not self.circles:
            raise ValueError("expected z_below, or circles, a list of [x, z, radius]")
        return self


Taper = Annotated[Number, Field(gt=-1.0, lt=1.0)]


class SectionEntry(FileModel):
    """A finger of one section all along its width."""

    file: Text = Field(description="Path of the section's loops, relative to the folder of the jaw file")
    width: Length | None = Field(None, gt=0.0, description="Width at x = z = 0 [m]; that of the file without")
    taper: tuple[Taper, Taper] = Field((0.0, 0.0), description="Change of the width by x and by z [-]")
    size: Thickness | None = Field(None, gt=0.0, description="Size of elements [m]")
    clamped: SectionClamp = Field(description="What the holder keeps from moving")

    def build(self, folder: Path) -> Section:
        """Return the section.

        Raises:
            JawFileError: Its file is missing or describes none.
        """
        path = folder / self.file
        content = read_section_file(path)
        try:
            rings = order_rings(join_loops(content.loops))
        except JawFileError as error:
            raise JawFileError(f"{path.name}: {error}") from error
        width = self.width or content.width
        if not (width and width > 0.0):
            raise JawFileError(f"section.width: got {width}, expected a positive length in metres")
        section = Section(
            rings=rings,
            width=width,
            taper=np.array(self.taper),
            clamped_z=self.clamped.z_below,
            clamp_slope=self.clamped.slope,
            clamped_circles=np.array(self.clamped.circles).reshape(-1, 3),
            size=self.size,
            layers=content.layers,
        )
        least = np.inf if section.layers else float(section.read_width(rings[0]).min())
        if not least > 0.0:
            raise JawFileError(f"section.taper: leaves a width of {1e3 * least:.3g} mm somewhere, expected any")
        return section


class JunctionRule(FileModel):
    """Key points at the rib ends on the inner band, then on the outer band, base to tip, then at the tip."""

    rule: Literal["rib_junctions"] = Field(description="Where ribs of a drawing meet bands")
    side_y: Length = Field(description="Their y [m], on the side that the camera sees")
    tip: StrictBool | None = Field(None, description="Whether the tip is one; without, that of a solid tip")

    def build(self, drawing: Drawing | None) -> dict[str, NDArray]:
        """Return the points of a drawing: name -> (3,) [m]."""
        if drawing is None:
            raise JawFileError("keypoints.rule: rib_junctions needs a drawing; list the points as name: [x, y, z]")
        points = {}
        for name, ends in zip(("inner", "outer"), drawing.junctions, strict=True):
            for number, (x, z) in enumerate(ends, start=1):
                points[f"{name}_{number}"] = np.array([x, self.side_y, z])
        if drawing.tip_z is not None if self.tip is None else self.tip:
            x = 0.5 * (drawing.inner.face_x(drawing.length) + drawing.outer.face_x(drawing.length))
            points["tip"] = np.array([x, self.side_y, drawing.length])
        if not points:
            raise JawFileError("keypoints: rib_junctions gives none, because the drawing has no ribs")
        return points


class CandidateRule(FileModel):
    """Contact candidates on the inner face at even heights."""

    first_z: Length = Field(description="Height of the lowest [m]")
    step_z: Length = Field(description="Distance to the next [m]")
    count: Count = Field(description="Their number")
    y: Length = Field(0.0, description="Their y [m]")

    def build(self, face: FaceLine) -> NDArray:
        """Return the candidates (C, 3) [m]."""
        z = self.first_z + self.step_z * np.arange(self.count)
        return np.column_stack([face.read(z), np.full(self.count, self.y), z])


KeypointsEntry = Annotated[
    Annotated[dict[Annotated[str, BeforeValidator(str)], Point], Field(min_length=1), Tag(LIST)]
    | Annotated[JunctionRule, Tag(MAPPING)],
    Discriminator(lambda value: MAPPING if isinstance(value, dict) and "rule" in value else LIST),
]
CandidatesEntry = Annotated[
    Annotated[tuple[Point, ...], Field(min_length=1), Tag(LIST)] | Annotated[CandidateRule, Tag(MAPPING)],
    Discriminator(lambda value: LIST if isinstance(value, list) else MAPPING),
]


class JawEntry(FileModel):
    """A jaw file. Lengths in metres, in the jaw frame."""

    name: Text | None = Field(None, description="What the finger is called; without, as its file")
    model: Literal["solid", "frame", "plane"] | None = Field(None, description="Recommended mechanics")
    drawing: DrawingEntry | None = Field(None, description="Finger of bands, ribs and a tip")
    section: SectionEntry | None = Field(None, description="Finger of one section all along its width")
    mesh: MeshFile | None = Field(None, description="Finger as a volume mesh")
    inner_face_x: Length | None = Field(None, description="Plane of the inner face [m]; of a section or a mesh")
    material: Annotated[Material, BeforeValidator(_look_up)] = Field(description="Name in MATERIALS, or numbers")
    keypoints: KeypointsEntry = Field(description="Points by name: [x, y, z] [m], or rule: rib_junctions")
    reference_point: Point = Field(np.zeros(3), description="Dot on the rigid holder [m]")
    candidates: CandidatesEntry = Field(description="Contact candidates: points [m], or first_z, step_z, count")

    @model_validator(mode="after")
    def _check(self) -> "JawEntry":
        source = self.expect_one_of("drawing", "section", "mesh")
        if source == "drawing" and self.inner_face_x is not None:
            raise ValueError("inner_face_x: a drawing has its own, expected none")
        if source == "mesh" and self.inner_face_x is None:
            raise ValueError("inner_face_x is missing; it is required with a mesh")
        return self
