"""From a jaw's full mechanics to its stored equilibria, built once and found again; knows no estimator."""

from dataclasses import replace

from tqdm import tqdm

from finforce_ifea import manifold_build
from finforce_ifea.frame import FrameModel
from finforce_ifea.jaw import Jaw
from finforce_ifea.manifold import Manifold
from finforce_ifea.manifold_build import build_manifold, build_rest
from finforce_ifea.manifold_cache import fetch_manifold, hash_parts
from finforce_ifea.mechanics import Mechanics
from finforce_ifea.reduced import ReducedModel
from finforce_ifea.reduced_contact import ReducedContact


def reduce_mechanics(full: Mechanics, jaw: Jaw, *, linear: bool = False) -> Mechanics:
    """Returns the mechanics by stored equilibria.

    Args:
        full: the mechanics that is to be reduced.
        jaw: what it describes.
        linear: the unloaded jaw's compliance alone, without the equilibria.

    Raises:
        ContactError: The jaw cannot be pressed.
    """
    modulus = jaw.material.young_modulus
    if linear:
        manifold = build_rest(full, modulus)
    else:
        manifold = fetch_manifold(name_manifold(full, jaw), lambda: _build_watched(full, jaw))
    model = ReducedModel(manifold, full.model, modulus, full.contact.face_x)
    surface = full.contact.surface
    middle = surface.points[:: surface.across].copy()
    middle[:, 1] = 0.0
    stiffness = surface.stiffness.reshape(-1, surface.across).sum(1)
    surface = replace(surface, points=middle, across=1, stiffness=stiffness, probe=None)
    return Mechanics(mesh=full.mesh, model=model, contact=ReducedContact(model, surface, full.contact.face_x))


def name_manifold(full: Mechanics, jaw: Jaw) -> str:
    """Returns the hash of all that the equilibria of a jaw depend on; its modulus is none of it."""
    mesh = full.mesh
    parts = [mesh.nodes, mesh.elements, mesh.clamped, jaw.material.poisson_ratio, full.contact.face_x]
    if isinstance(full.model, FrameModel):
        parts.append(repr(jaw.drawing))
    return hash_parts(type(full.model).__name__, *map(str, manifold_build.GRID), *parts)


def _build_watched(full: Mechanics, jaw: Jaw) -> Manifold:
    """Builds the manifold under a progress bar."""
    with tqdm(total=100, desc=f"equilibria of {jaw.name}, once", unit="%", disable=None, leave=False) as bar:
        return build_manifold(full, jaw.material.young_modulus, lambda share: bar.update(int(100 * share) - bar.n))
