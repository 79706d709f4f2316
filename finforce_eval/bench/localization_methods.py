"""The ways to find a contact place that a benchmark compares."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_library
from finforce_contact.estimator import ContactEstimator
from finforce_contact.localization.closest import ClosestLocalizer
from finforce_contact.localization.inner_face import build_inner_face
from finforce_contact.localization.outline_localizer import ContactScene, Localizer, OutlineLocalizer
from finforce_contact.localization.section import SectionKeeper
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.paper_contact import NearSolid, intersect
from finforce_contact.settings import ContactSettings
from finforce_ifea.jaw.jaw import Jaw

Wrench = tuple[NDArray, NDArray] | None
Method = Callable[[NDArray, NDArray, Wrench], float | None]
MOST_PAIRS = 2000


@dataclass(frozen=True, kw_only=True, eq=False)
class MethodSetup:
    """A jaw and an object."""

    jaw: Jaw
    mesh: ObjectMesh


def by_outline(setup: MethodSetup, *, with_wrench: bool) -> Method:
    """Returns the way of mode "estimate"."""
    settings = ContactSettings()
    face = build_inner_face(setup.jaw, settings.mesh)
    return _by_localizer(setup, OutlineLocalizer(face, settings), with_wrench=with_wrench)


def by_closest(setup: MethodSetup) -> Method:
    """Returns the way of mode "closest"."""
    face = build_inner_face(setup.jaw, ContactSettings().mesh)
    return _by_localizer(setup, ClosestLocalizer(setup.jaw, face), with_wrench=False)


def _by_localizer(setup: MethodSetup, localizer: Localizer, *, with_wrench: bool) -> Method:
    settings = ContactSettings()
    face = build_inner_face(setup.jaw, settings.mesh)
    sections = SectionKeeper(setup.mesh, face.half_width, settings)

    def locate(T: NDArray, surface: NDArray, wrench: Wrench) -> float | None:
        scene = ContactScene(
            T=T,
            section=sections.at(T),
            surface=surface,
            line=face.deform(surface),
            wrench=wrench if with_wrench else None,
        )
        place = localizer.locate(scene)
        return None if place is None else place.rows.mean

    return locate


def by_intersection(setup: MethodSetup, *, cut_down: bool) -> Method:
    """Returns the centre of the intersection with the whole object, or with what of it is near the jaw."""
    settings = ContactSettings()
    jaw = setup.jaw.build_mesh(settings.mesh)
    solid = NearSolid(setup.mesh, settings.margin)

    def locate(T: NDArray, surface: NDArray, wrench: Wrench) -> float | None:
        part = solid.near(T, surface) if cut_down else solid.whole
        centre = intersect(part, T, surface, jaw.surface)
        return None if centre is None else _height_of(centre, surface, jaw.nodes)

    return locate


def by_triangle_pairs(setup: MethodSetup) -> Method:
    """Returns the mean of the points where triangles meet, found by coal.

    Raises:
        MissingDependencyError: coal is not installed.
    """
    coal = import_library("coal", "the test of triangle pairs")
    jaw = setup.jaw.build_mesh(ContactSettings().mesh)
    thing = _build_tree(coal, setup.mesh.vertices, setup.mesh.triangles)
    request, still = coal.CollisionRequest(), coal.Transform3s()
    request.num_max_contacts, request.enable_contact = MOST_PAIRS, True

    def locate(T: NDArray, surface: NDArray, wrench: Wrench) -> float | None:
        result = coal.CollisionResult()
        finger = _build_tree(coal, surface, jaw.surface)
        coal.collide(finger, still, thing, coal.Transform3s(T[:3, :3], T[:3, 3]), request, result)
        count = result.numContacts()
        if not count:
            return None
        centre = np.mean([result.getContact(index).pos for index in range(count)], axis=0)
        return _height_of(centre, surface, jaw.nodes)

    return locate


def _build_tree(coal, vertices: NDArray, triangles: NDArray):
    """Returns the tree of boxes around triangles (m, 3) on vertices (n, 3) [m]."""
    tree = coal.BVHModelOBBRSS()
    tree.beginModel(len(triangles), len(vertices))
    tree.addVertices(np.ascontiguousarray(vertices, dtype=float))
    tree.addTriangles(np.ascontiguousarray(triangles, dtype=np.int64))
    tree.endModel()
    return tree


def _height_of(centre: NDArray, surface: NDArray, nodes: NDArray) -> float:
    """Returns the undeformed height [m] of the deformed vertex nearest to a centre (3,) [m], as the paper does."""
    return float(nodes[((surface - centre) ** 2).sum(axis=1).argmin(), 2])


def by_whole_estimator(setup: MethodSetup) -> Method:
    """Return the estimator with its pose filter and its outline as a way to find a place."""
    estimator, stamps = ContactEstimator(setup.jaw, mesh=setup.mesh, settings=ContactSettings()), iter(range(10**9))

    def locate(T: NDArray, surface: NDArray, wrench: Wrench) -> float | None:
        stamp = next(stamps) / 30.0
        estimator.take_pose(stamp, T)
        estimate = estimator.update(stamp, surface, wrench)
        return float(estimate.points[:, 2] @ estimate.weights) if len(estimate.points) else None

    return locate


METHODS: dict[str, Callable[[MethodSetup], Method]] = {
    "outline and line of action": lambda setup: by_outline(setup, with_wrench=True),
    "outline alone": lambda setup: by_outline(setup, with_wrench=False),
    "manifold3d, whole object": lambda setup: by_intersection(setup, cut_down=False),
    "manifold3d, cut to the jaw": lambda setup: by_intersection(setup, cut_down=True),
    "triangle pairs (coal)": by_triangle_pairs,
    "closest point, undeformed": by_closest,
    "the whole estimator": by_whole_estimator,
}
