"""One jaw of the twin against an outline: Newton steps, contact forces and what the jaw looks like."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import OutlineIndenter, flat_profile
from finforce_ifea.contact_mechanics.penalty import PenaltyContact, press_field
from finforce_ifea.contact_mechanics.pressed_jaw import build_contact_surface, profile_surface
from finforce_ifea.fem.model import JawModel
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.drawing import MeshDensity
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.mechanics import build_plane_model

# Finer along bands and ribs than the mesh that the estimator takes by default.
TWIN_DENSITY = MeshDensity(between_ribs=10, through_band=1, along_rib=10, through_rib=1, tip=2, across_width=2)


@dataclass(frozen=True, kw_only=True, eq=False)
class Load:
    """What acts on a jaw from outside; all in the jaw frame.

    Attributes:
        origin: x and z of the outline's origin (2,) [m].
        tilt: of the outline [rad].
        pull: force along the surface (3,) [N], spread over the contact as the pressure is.
    """

    origin: NDArray
    tilt: float
    pull: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class JawStep:
    """A Newton step of one jaw.

    Attributes:
        correction: of the unknowns towards equilibrium (size,).
        mode: motion of the unknowns as the object moves along x (size,) [per m].
        force: of the pressure (3,) [N] before the step.
        push: its x component after the correction [N].
        slope: derivative of that by the object's x [N/m].
        smallest_det: smallest det F of all elements [-].
    """

    correction: NDArray
    mode: NDArray
    force: NDArray
    push: float
    slope: float
    smallest_det: float


@dataclass(frozen=True, kw_only=True, eq=False)
class JawShape:
    """One jaw as it stands.

    Attributes:
        vertices: (n, 3) [m], in mesh order.
        keypoints: (K, 3) [m].
        force: elastic, of pressure and pull (3,) [N].
        torque: of the same about the jaw frame's origin (3,) [N m].
    """

    vertices: NDArray
    keypoints: NDArray
    force: NDArray
    torque: NDArray


class PressedJaw:
    """The mechanics of one jaw, and the outline that is pressed into it without friction."""

    def __init__(self, jaw: Jaw, material: Material, density: MeshDensity | str | None, *, lateral: bool) -> None:
        """Builds mesh, model and contact surface.

        Args:
            jaw: the jaw, of its own side.
            material: what this one is made of.
            density: of the mesh of a drawing.
            lateral: whether loads along y will come; else a mesh that mirrors itself is halved.
        """
        self.jaw = jaw
        self.mesh = jaw.build_mesh(density if jaw.drawing is not None else None)
        self.model = _build_model(jaw, self.mesh, material, lateral=lateral)
        self.surface = build_contact_surface(jaw, self.mesh, self.model, across=self.model.across)
        self.half_width = float(np.abs(self.mesh.nodes[:, 1]).max())
        self._keypoints = self.model.attach(jaw.keypoints, KEYPOINT_DISTANCE)
        self._indenter: OutlineIndenter | None = None

    def meet(self, polygons: tuple[NDArray, ...]) -> None:
        """Takes the outline of the object, polygons (n, 2) [m] about its origin; raises ContactError if too small."""
        self._indenter = OutlineIndenter(polygons)

    def find_touch(self, height: float, tilt: float) -> float:
        """Returns the x [m] of an outline's origin at the given height [m] where it first touches the jaw at rest."""
        place = np.array([0.0, tilt, height])
        if self.jaw.face.is_flat:
            profile = flat_profile(float(self.surface.low[1]), float(self.surface.high[1]), self.jaw.inner_face_x)
        else:
            profile = profile_surface(self.surface, self.jaw.face)
        depth = self._indenter.find_touch(place, profile)
        return self.jaw.inner_face_x + self._indenter.field.front - depth

    def find_pressure(self, q: NDArray, load: Load) -> NDArray:
        """Returns the force of the pressure alone (3,) [N] at unknowns q (size,)."""
        return self._press(q, load).forces.sum(0)

    def linearize(self, q: NDArray, load: Load) -> JawStep:
        """Returns the Newton step of f_int(q) = J^T (p(J q, origin) + pull shares) at unknowns q (size,).

        With S the springs of the points, the load by the object's x is J^T S e_x; as S is symmetric, the same load
        tells the push that the jaw's motion takes away.
        """
        model, probe = self.model, self.surface.probe
        contact = self._press(q, load)
        state = model.linearize(q)
        model.stiffen(state.tangent, probe, q, contact.springs)
        along_x = np.ascontiguousarray(contact.springs[:, :, 0])
        by_x = model.load(probe, q, along_x)
        forces = contact.forces + _share_pull(contact.forces, load.pull)
        imbalance = model.load(probe, q, forces) - state.force
        steps = model.factorise(state.tangent).solve(np.stack([imbalance, by_x], axis=1))
        force = contact.forces.sum(0)
        return JawStep(
            correction=steps[:, 0],
            mode=steps[:, 1],
            force=force,
            push=float(force[0] - by_x @ steps[:, 0]),
            slope=float(along_x[:, 0].sum() - by_x @ steps[:, 1]),
            smallest_det=state.smallest_det,
        )

    def describe(self, q: NDArray, load: Load | None) -> JawShape:
        """Returns shape and elastic wrench at equilibrium; without a load nothing touches."""
        points = self.model.positions(self.surface.probe, q)
        forces = np.zeros_like(points)
        if load is not None:
            forces = self._press(q, load).forces
            forces = forces + _share_pull(forces, load.pull)
        if getattr(self.model, "symmetric", False):
            # each point stands for its mirror image, too
            points, forces = points * [1.0, 0.0, 1.0], forces * [1.0, 0.0, 1.0]
        return JawShape(
            vertices=self.model.vertices(q),
            keypoints=self.model.positions(self._keypoints, q),
            force=forces.sum(0),
            torque=np.cross(points, forces).sum(0),
        )

    def _press(self, q: NDArray, load: Load) -> PenaltyContact:
        points = self.model.positions(self.surface.probe, q)
        return press_field(points, self.surface.stiffness, self._indenter.field, load.origin, load.tilt)


def _share_pull(forces: NDArray, pull: NDArray) -> NDArray:
    """Returns the pull (3,) [N] divided among points (p, 3) as the sizes of their forces (p, 3) are; none without."""
    size = np.linalg.norm(forces, axis=1)
    total = size.sum()
    return size[:, None] / total * pull if total > 0.0 else np.zeros_like(forces)


def _build_model(jaw: Jaw, mesh: Any, material: Material, *, lateral: bool) -> JawModel:
    """Returns a solid, the plane model of a section without loads along y, or the frame of what no solid describes."""
    if jaw.section is not None and not lateral:
        return build_plane_model(replace(jaw, material=material), mesh)
    if jaw.drawing is None or jaw.drawing.is_solid:
        return SolidModel(mesh, material, symmetric=not lateral)
    from finforce_ifea.fem.frame import FrameModel

    return FrameModel(jaw.drawing, material, mesh=mesh)
