"""The mechanics of a jaw by name: mesh, model and contact surface; and whether its elements are too stiff."""

import logging
import warnings
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.pressed_jaw import (
    Mechanics,
    RigidContact,
    build_contact_surface,
    measure_compliances,
)
from finforce_ifea.errors import ContactError, JawFileError
from finforce_ifea.fem.model import JawModel
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.mesh import VolumeMesh, shape_gradients, to_tet4, to_tet10
from finforce_ifea.settings import EstimatorSettings

# Compliances (2, 3) of the solid finger and of its section in plane strain, by shape, Poisson's ratio and size of
# elements.
_COMPLIANCES: dict[tuple, NDArray] = {}


def build_mechanics(jaw: Jaw, settings: EstimatorSettings) -> Mechanics:
    """Build the mechanics that the settings name; "default" is the full one that the jaw file recommends.

    Raises:
        JawFileError: The jaw cannot be described by that model.
        MeshError: The mesh cannot be built.
    """
    if settings.solver == "reduced":
        return _reduce(jaw, settings)
    name = jaw.model if settings.solver == "default" else settings.solver
    density = settings.mesh if jaw.mesh_file is None else None
    mesh = jaw.build_mesh(density)
    if name == "paper":
        mesh = to_tet4(jaw.build_mesh("coarse")) if jaw.mesh_file is None else mesh
    if name == "plane":
        model: JawModel = build_plane_model(jaw, mesh, density)
    elif name == "frame":
        if jaw.drawing is None:
            raise JawFileError(
                f"the jaw {jaw.name!r} is not a drawing, which a frame needs; expected solver {jaw.model}"
            )
        from finforce_ifea.fem.frame import FrameModel

        model = FrameModel(jaw.drawing, jaw.material, mesh=mesh)
    else:
        if jaw.drawing is not None and not jaw.drawing.is_solid:
            raise JawFileError(f"the jaw {jaw.name!r} has hinges or rigid bars; only the frame describes it")
        if name != "paper":
            warn_of_locking(jaw, mesh)
        model = SolidModel(mesh, jaw.material, symmetric=settings.force_axes == "normal")
    surface = build_contact_surface(jaw, mesh, model, across=model.across)
    return Mechanics(mesh=mesh, model=model, contact=RigidContact(model, surface, jaw.face))


def build_plane_model(jaw: Jaw, mesh: VolumeMesh, density: str | None = None) -> JawModel:
    """Return the plane model of a jaw's section, as stiff as the solid finger.

    Plane strain holds the width, which is free at both sides: the modulus is lowered by what the solid is softer at
    rest, both with the coarse mesh, 2 to 4 % for fingers ten and more times as wide as their walls are thick.

    Raises:
        JawFileError: The jaw is no section.
        MeshError: The section cannot be divided.
    """
    from finforce_ifea.fem.plane import PlaneModel

    if jaw.section is None:
        raise JawFileError(
            f"the jaw {jaw.name!r} is not a section, which solver plane needs; expected solver {jaw.model}"
        )
    solid, held = _compare_width(jaw).mean(axis=1)
    material = jaw.material.model_copy(update={"young_modulus": jaw.material.young_modulus * held / solid})
    return PlaneModel(mesh, jaw.build_plane(density), jaw.section, material)


def _compare_width(jaw: Jaw) -> NDArray:
    """Return the compliances (2, 3) [m/N] of a section's coarse solid and of its plane model at three heights."""
    from finforce_ifea.fem.plane import PlaneModel

    key = (jaw.digest, jaw.material.poisson_ratio, jaw.section.size)
    if key not in _COMPLIANCES:
        coarse, unit = jaw.build_mesh("coarse"), jaw.material.model_copy(update={"young_modulus": 1e6})
        models = SolidModel(coarse, unit), PlaneModel(coarse, jaw.build_plane("coarse"), jaw.section, unit)
        _COMPLIANCES[key] = np.array(
            [
                measure_compliances(model, build_contact_surface(jaw, coarse, model, across=model.across))
                for model in models
            ]
        )
    return _COMPLIANCES[key]


def measure_warping(jaw: Jaw) -> float:
    """Return by how much the stiffness of a section's solid over that of its plane model changes along the finger.

    As a share of the least. A finger of which one side is stiffer twists, which no plane model does.
    """
    solid, held = _compare_width(jaw)
    return float(np.ptp(held / solid) / (held / solid).min())


def build_chosen(jaw: Jaw, settings: EstimatorSettings) -> Mechanics:
    """Build the mechanics of an estimator; a jaw of which no equilibria can be stored is described in full by default.

    Raises:
        JawFileError: The jaw cannot be described by the model that is named.
        MeshError: The mesh cannot be built.
        ContactError: The jaw cannot be pressed, and "reduced" was asked for.
    """
    chosen = settings
    if settings.solver == "default" and settings.force_axes == "normal":
        chosen = replace(settings, solver="reduced")
    try:
        return build_mechanics(jaw, chosen)
    except ContactError as error:
        if chosen is settings:
            raise
        logging.getLogger(__name__).warning("no stored equilibria for %s (%s); every step is slower", jaw.name, error)
        return build_mechanics(jaw, settings)


def choose_full(settings: EstimatorSettings) -> EstimatorSettings:
    """Return settings with the full mechanics behind the solver that they name."""
    return replace(settings, solver="default") if settings.solver == "reduced" else settings


def _reduce(jaw: Jaw, settings: EstimatorSettings) -> Mechanics:
    """Build stored equilibria of what the jaw file recommends."""
    from finforce_ifea.reduced.cache import reduce_mechanics

    if settings.force_axes != "normal":
        raise JawFileError("solver reduced supports only forces in the jaw's plane; expected force_axes normal")
    return reduce_mechanics(build_mechanics(jaw, choose_full(settings)), jaw)


# At this Poisson's ratio 10-node tetrahedra do not lock; the stiffness of bands at others follows from plane strain.
_EASY_RATIO = 0.3
# What is said, and where it is measured at all: 10-node tetrahedra above a ratio, hexahedra below a scaled Jacobian.
_TOLERATED = {"distorted hexahedra": 1.05, "4-node tetrahedra": 1.1, "10-node tetrahedra": 1.1}
_HARD_RATIO, _DISTORTED = 0.4, 0.8
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


class LockingWarning(UserWarning):
    """The elements of a mesh are too stiff."""


def measure_locking(jaw: Jaw, mesh: VolumeMesh) -> float:
    """Return the stiffness k of a mesh over what 10-node tetrahedra on the same nodes say that it should be.

    With nu_0 = min(nu, 0.3), where these do not lock, that is k_10(nu_0) (1 - nu_0^2) / (1 - nu^2): bands bend in plane
    strain. The load acts along -x at the middle contact candidate.
    """
    material = jaw.material
    easy = material.model_copy(update={"poisson_ratio": min(material.poisson_ratio, _EASY_RATIO)})
    plane = (1.0 - easy.poisson_ratio**2) / (1.0 - material.poisson_ratio**2)
    return _measure_point_stiffness(jaw, mesh, material) / (_measure_point_stiffness(jaw, to_tet10(mesh), easy) * plane)


def _measure_point_stiffness(jaw: Jaw, mesh: VolumeMesh, material: Material) -> float:
    """Return force over motion [N/m] at the middle contact candidate."""
    model = SolidModel(mesh, material)
    probe, rest = model.attach(jaw.candidates[[len(jaw.candidates) // 2]], 1e-3), np.zeros(model.size)
    load = model.load(probe, rest, np.array([[-1.0, 0.0, 0.0]]))
    return 1.0 / float(load @ model.factorise(model.linearize(rest).tangent).solve(load))


def measure_shape(mesh: VolumeMesh) -> float:
    """Return the least scaled Jacobian of a mesh of hexahedra: det J over the lengths of its columns, 1 in a box."""
    gradients = shape_gradients(8, _CORNERS)
    jacobians = np.einsum("mni,pnj->mpij", mesh.nodes[mesh.elements], gradients)
    return float((np.linalg.det(jacobians) / np.linalg.norm(jacobians, axis=2).prod(axis=2)).min())


def warn_of_locking(jaw: Jaw, mesh: VolumeMesh) -> None:
    """Warn when a jaw's elements are too stiff, and say by how much and what would do.

    What cannot lock is not measured: hexahedra of a drawing or of good shape, and 10-node tetrahedra of a material that
    changes its volume.
    """
    if mesh.is_hexahedral:
        suspect, kind = jaw.drawing is None and measure_shape(mesh) < _DISTORTED, "distorted hexahedra"
    elif mesh.elements.shape[1] == 4:
        suspect, kind = True, "4-node tetrahedra"
    else:
        suspect, kind = jaw.material.poisson_ratio > _HARD_RATIO, "10-node tetrahedra"
    factor = measure_locking(jaw, mesh) if suspect else 1.0
    if factor > _TOLERATED[kind]:
        advice = {
            "distorted hexahedra": "Use hexahedra nearer to boxes, more of them, or 10-node tetrahedra",
            "4-node tetrahedra": "Use 10-node tetrahedra or hexahedra",
            "10-node tetrahedra": f"nu = {jaw.material.poisson_ratio:g} asks for hexahedra, or more tetrahedra",
        }
        warnings.warn(
            f"jaw {jaw.name!r}: its {kind} lock, they are {factor:.2g} times as stiff as they should be; forces are "
            f"too large accordingly. {advice[kind]}",
            LockingWarning,
            stacklevel=3,
        )
