"""The mechanics of a jaw by name: mesh, model and contact surface."""

import logging
from dataclasses import replace

from finforce_ifea.contact_mechanics.pressed_jaw import Across, Mechanics, RollingContact, build_contact_surface
from finforce_ifea.errors import ContactError, JawFileError
from finforce_ifea.fem.locking import warn_of_locking
from finforce_ifea.fem.model import JawModel
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.fem.tetrahedra import to_tet4
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.settings import EstimatorSettings

_REDUCED = ("reduced", "linear")


def build_mechanics(jaw: Jaw, settings: EstimatorSettings) -> Mechanics:
    """Builds the mechanics that the settings name; "default" is the full one that the jaw file recommends.

    Raises:
        JawFileError: The jaw cannot be described by that model.
        MeshError: The mesh cannot be built.
    """
    if settings.solver in _REDUCED:
        return _reduce(jaw, settings)
    name = jaw.model if settings.solver == "default" else settings.solver
    mesh = jaw.build_mesh(settings.mesh if jaw.drawing is not None else None)
    if name == "paper":
        mesh = to_tet4(jaw.build_mesh("coarse")) if jaw.drawing is not None else mesh
    if name == "frame":
        if jaw.drawing is None:
            raise JawFileError(f"the jaw {jaw.name!r} is a volume mesh; a frame needs a drawing")
        from finforce_ifea.fem.frame import FrameModel

        model: JawModel = FrameModel(jaw.drawing, jaw.material, mesh=mesh)
        across: Across = "middle"
    else:
        if jaw.drawing is not None and not jaw.drawing.is_solid:
            raise JawFileError(f"the jaw {jaw.name!r} has hinges or rigid bars; only the frame describes it")
        if name != "paper":
            warn_of_locking(jaw, mesh)
        model = SolidModel(mesh, jaw.material, symmetric=settings.force_axes == "normal")
        across = "half" if model.symmetric else "both"
    surface = build_contact_surface(jaw, mesh, model, across=across)
    return Mechanics(mesh=mesh, model=model, contact=RollingContact(model, surface, jaw.inner_face_x))


def choose_solver(settings: EstimatorSettings) -> EstimatorSettings:
    """Returns settings in which "default" has become "reduced", unless forces in three axes are asked for."""
    if settings.solver == "default" and settings.force_axes == "normal":
        return replace(settings, solver="reduced")
    return settings


def build_chosen(jaw: Jaw, settings: EstimatorSettings) -> Mechanics:
    """Builds the mechanics of an estimator; a jaw of which no equilibria can be stored is described in full by default.

    Raises:
        JawFileError: The jaw cannot be described by the model that is named.
        MeshError: The mesh cannot be built.
        ContactError: The jaw cannot be pressed, and "reduced" was asked for.
    """
    chosen = choose_solver(settings)
    try:
        return build_mechanics(jaw, chosen)
    except ContactError as error:
        if chosen is settings:
            raise
        logging.getLogger(__name__).warning("no stored equilibria of %s (%s); every step is slower", jaw.name, error)
        return build_mechanics(jaw, settings)


def choose_full(settings: EstimatorSettings) -> EstimatorSettings:
    """Returns settings with the full mechanics behind the solver that they name."""
    return replace(settings, solver="default") if settings.solver in _REDUCED else settings


def _reduce(jaw: Jaw, settings: EstimatorSettings) -> Mechanics:
    """Builds stored equilibria of what the jaw file recommends."""
    from finforce_ifea.reduced.cache import reduce_mechanics

    if settings.force_axes != "normal":
        raise JawFileError(
            f"solver {settings.solver} knows forces in the jaw's plane alone; expected force_axes normal"
        )
    full = build_mechanics(jaw, choose_full(settings))
    return reduce_mechanics(full, jaw, linear=settings.solver == "linear")
