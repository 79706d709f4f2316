"""One jaw: its shape, material, key points and contact candidates."""

import hashlib
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from finforce.errors import suggest
from finforce.typed_yaml import read_model
from finforce_ifea.errors import JawFileError, MeshError
from finforce_ifea.jaw.attachment import attach_points, attach_surface_points, check_distances
from finforce_ifea.jaw.drawing import Drawing, MeshDensity, mesh_drawing
from finforce_ifea.jaw.jaw_file import CandidateRule, JawEntry, JunctionRule, Material
from finforce_ifea.jaw.mesh import VolumeMesh
from finforce_ifea.jaw.mesh_file import MeshFile, read_volume_mesh
from finforce_ifea.jaw.section import FaceLine, Section, find_face
from finforce_ifea.jaw.section_mesh import SHARES, PlaneMesh, extrude_section, mesh_section

__all__ = ["Jaw", "Material", "list_shipped_jaws", "load_jaw"]

# How far a key point may lie outside the jaw, and a candidate off its surface [m].
KEYPOINT_DISTANCE = 3e-3
_CANDIDATE_DISTANCE = 1e-4
_SHAPES = (".stl", ".obj", ".3mf", ".step", ".stp", ".dxf", ".svg")  # taken for jaw files by mistake


@dataclass(frozen=True, kw_only=True, eq=False)
class Jaw:
    """One jaw, undeformed, in its jaw frame.

    Attributes:
        name: of the finger.
        path: the file it was read from.
        side: "left" as in the file, or "right", its mirror image.
        drawing: the parametric finger, or None.
        section: the section of a prismatic finger of any shape, or None.
        mesh_file: the volume mesh file and how to read it, or None.
        material: its material.
        keypoint_names: (K,), in the order of the key point messages.
        keypoints: (K, 3) [m].
        reference_point: (3,) [m], the point by which the jaw is found in an image.
        candidates: (C, 3) [m], possible contact places on the inner surface.
        inner_face_x: [m], the plane of the inner surface.
        model: recommendation of the file: "solid", "frame" or "plane".
    """

    name: str
    path: Path
    side: Literal["left", "right"] = "left"
    drawing: Drawing | None
    section: Section | None = None
    mesh_file: MeshFile | None
    material: Material
    keypoint_names: tuple[str, ...]
    keypoints: NDArray
    reference_point: NDArray
    candidates: NDArray
    inner_face_x: float
    model: Literal["solid", "frame", "plane"]

    def build_mesh(self, density: MeshDensity | str | None = None) -> VolumeMesh:
        """Build the volume mesh.

        Args:
            density: the number of elements of a drawing, or a preset's name ("coarse", "default", "fine"), which
                does for a section, too. A mesh file has its own density: leave it out, or "default".

        Returns:
            The checked mesh, mirrored for a right jaw.

        Raises:
            MeshError: The density is unknown, or the mesh file is bad.
        """
        if self.drawing is not None:  # its own mirror image, as an extruded section is
            return mesh_drawing(self.drawing, density or "default")
        if self.section is not None:
            return extrude_section(self.section, _find_share(density))
        if density in (None, "default"):
            file = self.mesh_file
            mesh = read_volume_mesh(self.path.parent / file.file, scale=file.scale, clamp=file.clamped)
        else:
            raise MeshError(f"mesh density {density!r}: {self.mesh_file.file} has its own; use 'default'")
        return mesh if self.side == "left" else mesh.mirrored()

    def build_plane(self, density: str | None = None) -> PlaneMesh:
        """Divide the section into triangles, those that `build_mesh` extrudes with the same density.

        Raises:
            MeshError: The density is unknown, or the section cannot be divided.
            JawFileError: The jaw is no section.
        """
        if self.section is None:
            raise JawFileError(f"the jaw {self.name!r} is not a section; only one has a plane mesh")
        return mesh_section(self.section, _find_share(density))

    @cached_property
    def face(self) -> FaceLine:
        """The inner face at rest."""
        return FaceLine.flat(self.inner_face_x) if self.section is None else find_face(self.section, self.inner_face_x)

    @cached_property
    def contact_range(self) -> tuple[float, float]:
        """Heights [m] at which an object may touch: half of the candidates' distance beyond the outermost of them.

        Nearer to the clamp no key point shows a force, and at the tip the face ends.
        """
        heights = np.sort(self.candidates[:, 2])
        half = 0.5 * float(np.diff(heights).max(initial=0.0))
        return float(heights[0] - half), float(heights[-1] + half)

    @cached_property
    def digest(self) -> str:
        """The identifier of the finger's shape: 12 hexadecimal digits of its content, the same for both sides."""
        shape = self.drawing or self.section
        if shape is None:
            file = self.mesh_file
            content = (self.path.parent / file.file).read_bytes() + repr((file.scale, file.clamped)).encode()
        else:
            content = repr(self.drawing).encode() if self.section is None else self.section.content
        return hashlib.sha256(content).hexdigest()[:12]

    def mirrored(self) -> "Jaw":
        """Return the other side's jaw, the mirror image y -> -y."""
        mirror = np.array([1.0, -1.0, 1.0])
        return replace(
            self,
            side="right" if self.side == "left" else "left",
            keypoints=self.keypoints * mirror,
            reference_point=self.reference_point * mirror,
            candidates=self.candidates * mirror,
        )


def _find_share(density: MeshDensity | str | None) -> float:
    """Return the size of a section's elements that a preset stands for, as a share of the usual one."""
    if density is None:
        return 1.0
    if density not in SHARES:
        raise MeshError(f"mesh density of a section: got {density!r}, expected one of {', '.join(SHARES)}")
    return SHARES[density]


def list_shipped_jaws() -> tuple[str, ...]:
    """Return the names of the jaws that come with the package."""
    files = resources.files("finforce_ifea.jaw").joinpath("jaws").iterdir()
    return tuple(sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml")))


def load_jaw(name_or_path: str | Path | Jaw, side: Literal["left", "right"] = "left") -> Jaw:
    """Load a jaw from its YAML file, see docs/your_finger.md.

    Args:
        name_or_path: a shipped name ("bench", "steel"), the path of a file, or a jaw.
        side: a file describes the left jaw; "right" gives its mirror image.

    Returns:
        The checked jaw.

    Raises:
        JawFileError: The file is missing or says something that cannot be a jaw.
        MeshError: The mesh file that it names is bad.
        MissingDependencyError: It names a mesh file, and meshio is not installed.
    """
    if side not in ("left", "right"):
        raise JawFileError(f"side: got {side!r}, expected 'left' or 'right'")
    if isinstance(name_or_path, Jaw):
        return name_or_path if name_or_path.side == side else name_or_path.mirrored()
    if str(name_or_path) in list_shipped_jaws():
        return _load_shipped(str(name_or_path), side)
    jaw = _read_jaw(Path(name_or_path))
    return jaw if side == "left" else jaw.mirrored()


@cache
def _load_shipped(name: str, side: str) -> Jaw:
    """Return a shipped jaw, whose files stay as they are."""
    jaw = _read_jaw(Path(str(resources.files("finforce_ifea.jaw").joinpath("jaws", f"{name}.yaml"))))
    return jaw if side == "left" else jaw.mirrored()


def _read_jaw(path: Path) -> Jaw:
    """Return the left jaw of a file."""
    if not path.is_file():
        raise JawFileError(f"there is no jaw file '{path}', {suggest(str(path), list_shipped_jaws())} (or give a path)")
    if path.suffix.lower() in _SHAPES:
        raise JawFileError(f"{path.name} is a shape, not a jaw file; make one: finforce jaw {path} -o {path.stem}.yaml")
    try:
        return _build_jaw(read_model(path, JawEntry, JawFileError), path)
    except (JawFileError, MeshError) as error:
        raise type(error)(f"{path.name}: {error}") from error


def _build_jaw(entry: JawEntry, path: Path) -> Jaw:
    """Build the jaw from the content of its file."""
    drawing = entry.drawing and entry.drawing.build()
    section = entry.section and entry.section.build(path.parent)
    inner_face_x = entry.inner_face_x
    if inner_face_x is None:
        inner_face_x = (drawing or section).inner_face_x
    points, candidates = entry.keypoints, entry.candidates
    if isinstance(points, JunctionRule):
        points = points.build(drawing)
    if isinstance(candidates, CandidateRule):
        candidates = candidates.build(
            FaceLine.flat(inner_face_x) if section is None else find_face(section, inner_face_x)
        )
    jaw = Jaw(
        name=entry.name or path.stem,
        path=path,
        drawing=drawing,
        section=section,
        mesh_file=entry.mesh,
        material=entry.material,
        keypoint_names=tuple(points),
        keypoints=np.array(list(points.values())),
        reference_point=entry.reference_point,
        candidates=np.array(candidates),
        inner_face_x=inner_face_x,
        model=_choose_model(entry, drawing),
    )
    _check_candidates(jaw)
    _check_points(jaw)
    return jaw


def _choose_model(entry: JawEntry, drawing: Drawing | None) -> Literal["solid", "frame", "plane"]:
    """Return the recommended model, and refuse one that cannot describe the jaw."""
    valid = ("plane", "solid") if entry.section else ("frame",) if drawing and not drawing.is_solid else ("solid",)
    if drawing and drawing.is_solid:
        valid = ("solid", "frame")
    model = entry.model or valid[0]
    if model not in valid:
        which = "a section" if entry.section else "a mesh file" if drawing is None else "this drawing"
        raise JawFileError(f"model: got {model}, expected {' or '.join(valid)} for {which}")
    return model


def _check_candidates(jaw: Jaw) -> None:
    """Refuse candidates off the inner face."""
    shape = jaw.drawing or jaw.section
    for number, point in enumerate(jaw.candidates):
        x, expected = jaw.face.read(point[2]), ""
        if abs(point[0] - x) > _CANDIDATE_DISTANCE:
            expected = f"x = {x:g} m"
        elif shape is not None and (abs(point[1]) > 0.5 * shape.widest or not 0.0 <= point[2] <= shape.length):
            half = 0.5 * shape.widest
            expected = f"y from {-half:g} to {half:g} m and z from 0 to {shape.length:g} m"
        if expected:
            place = ", ".join(f"{1e3 * value:.3f}" for value in point)
            raise JawFileError(f"candidates[{number}] at ({place}) mm lies off the inner surface; expected {expected}")


def _check_points(jaw: Jaw) -> None:
    """Refuse key points off the jaw and, of a mesh, candidates off its surface."""
    names, shape = [f"keypoints.{name}" for name in jaw.keypoint_names], jaw.drawing or jaw.section
    mesh = jaw.build_mesh() if shape is None else None
    try:
        if shape is not None:
            check_distances(jaw.keypoints, shape.distance_to(jaw.keypoints), KEYPOINT_DISTANCE, "jaw", names)
            return
        attach_points(mesh, jaw.keypoints, KEYPOINT_DISTANCE, names)
        candidates = [f"candidates[{number}]" for number in range(len(jaw.candidates))]
        attach_surface_points(mesh, jaw.candidates, _CANDIDATE_DISTANCE, candidates)
    except MeshError as error:
        raise JawFileError(str(error)) from error
