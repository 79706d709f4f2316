"""Stress of volume meshes: slivers, inverted and repeated elements, loose parts, wrong units, single precision."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics, RigidContact, build_contact_surface
from finforce_ifea.fem.locking import warn_of_locking
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.fem.tetrahedra import to_tet10
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.mesh import VolumeMesh, build_volume_mesh, check_connection
from lab.forward_press import PressState
from lab.stress.mechanics import Rig, build_jaw, measure_condition
from lab.stress.stress import Family, Plan, Trial, attempt

# What elements of any accepted shape may be off by, and what single precision may: 80 mm have 4e-9 m of rounding.
RIGHT, SINGLE = 0.10, 1e-4
DEPTH, HEIGHT = 0.5e-3, 0.04


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts:
    """What a mesh is built from: nodes (n, 3) [m], elements (m, 8 | 10), clamped nodes (c,)."""

    nodes: NDArray
    elements: NDArray
    clamped: NDArray

    def build(self) -> VolumeMesh:
        """Return the mesh as a reader of files does, checks included."""
        kind = "hexes" if np.shape(self.elements)[1] == 8 else "tets"
        mesh = build_volume_mesh(nodes=self.nodes, clamped=self.clamped, **{kind: self.elements})
        check_connection(mesh)
        return mesh


Change = Callable[[Parts, np.random.Generator], Parts]


def thin_layer(thickness: float) -> Change:
    """Return a change that moves the middle layer of nodes to within a `thickness` [m] of a side."""

    def change(parts: Parts, random: np.random.Generator) -> Parts:
        nodes = parts.nodes.copy()
        width = nodes[:, 1].max()
        inner = np.abs(nodes[:, 1]) < width * (1.0 - 1e-9)
        # what lies between the sides keeps its share of the room that is left on its side
        share = nodes[inner, 1] / width
        nodes[inner, 1] = np.where(
            share <= 0.0, -width + (1.0 + share) * (2 * width - thickness), width - (1.0 - share) * thickness
        )
        return replace(parts, nodes=nodes)

    return change


def skew(share: float) -> Change:
    """Return a change that moves inner nodes of hexahedra across the width by up to a share of their room."""

    def change(parts: Parts, random: np.random.Generator) -> Parts:
        nodes, width = parts.nodes.copy(), parts.nodes[:, 1].max()
        middle = np.flatnonzero(np.abs(nodes[:, 1]) < 1e-9)
        nodes[middle, 1] += share * width * random.uniform(-1.0, 1.0, len(middle))
        return replace(parts, nodes=nodes)

    return change


def pull_corner(share: float) -> Change:
    """Return a change that moves the corner of one element towards the opposite one, through it above 1."""

    def change(parts: Parts, random: np.random.Generator) -> Parts:
        nodes, element = parts.nodes.copy(), parts.elements[int(random.integers(len(parts.elements)))]
        opposite = element[6] if len(element) == 8 else element[1:4]
        nodes[element[0]] += share * (np.mean(nodes[np.atleast_1d(opposite)], axis=0) - nodes[element[0]])
        return replace(parts, nodes=nodes)

    return change


def add_element(way: tuple[float, float, float], shared: int) -> Change:
    """Return a change that adds a copy of the first element, moved by `way` [m], with some nodes of the original."""

    def change(parts: Parts, random: np.random.Generator) -> Parts:
        first, count = parts.elements[0], len(parts.nodes)
        copy = np.arange(count - shared, count - shared + len(first))
        copy[:shared] = first[:shared]
        nodes = np.concatenate([parts.nodes, parts.nodes[first[shared:]] + way])
        return replace(parts, nodes=nodes, elements=np.vstack([parts.elements, copy]))

    return change


def _repeat_element(parts: Parts, random: np.random.Generator) -> Parts:
    index = int(random.integers(len(parts.elements)))
    return replace(parts, elements=np.vstack([parts.elements, np.roll(parts.elements[index], 1)]))


def _repeat_exactly(parts: Parts, random: np.random.Generator) -> Parts:
    return replace(parts, elements=np.vstack([parts.elements, parts.elements[-1]]))


def _double_node(parts: Parts, random: np.random.Generator) -> Parts:
    index = int(parts.elements[-1, 0])
    elements = parts.elements.copy()
    elements[-1, 0] = len(parts.nodes)
    return replace(parts, nodes=np.vstack([parts.nodes, parts.nodes[index]]), elements=elements)


def _swap_nodes(parts: Parts, random: np.random.Generator) -> Parts:
    elements = parts.elements.copy()
    index = int(random.integers(len(elements)))
    elements[index, [0, 1]] = elements[index, [1, 0]]
    return replace(parts, elements=elements)


def _clamp_line(parts: Parts, random: np.random.Generator) -> Parts:
    at = parts.nodes[parts.clamped]
    return replace(parts, clamped=parts.clamped[np.abs(at[:, 0] - at[0, 0]) < 1e-9])


CHANGES: dict[str, Change] = {
    "as it is": lambda parts, random: parts,
    "nodes in another order": lambda parts, random: _permute(parts, random),
    "aspect ratio 1e2": thin_layer(5e-5),
    "aspect ratio 1e4": thin_layer(5e-7),
    "aspect ratio 1e6": thin_layer(5e-9),
    "skewed by 0.3": skew(0.3),
    "skewed by 0.6": skew(0.6),
    "skewed by 0.95": skew(0.95),
    "a corner pulled in by 0.3": pull_corner(0.3),
    "a corner pulled in by 0.45": pull_corner(0.45),
    "nearly inverted": pull_corner(0.66),
    "inverted": pull_corner(1.2),
    "two nodes swapped": _swap_nodes,
    "element twice": _repeat_exactly,
    "element twice, turned": _repeat_element,
    "node twice": _double_node,
    "node of no element": lambda parts, random: replace(parts, nodes=np.vstack([parts.nodes, [0.0, 0.0, 0.05]])),
    "loose element": add_element((0.0, 0.05, 0.0), 0),
    "overlapping element": add_element((1e-4, 1e-4, 1e-4), 0),
    "element on one node": add_element((-0.001, -0.003, -0.002), 1),
    "element on one edge": add_element((-0.001, -0.003, -0.002), 2),
    "element on one face": add_element((-0.001, -0.003, -0.002), 4),
    "clamped along a line": _clamp_line,
    "clamped at a point": lambda parts, random: replace(parts, clamped=parts.clamped[:1]),
    "clamped by a mask": lambda parts, random: replace(parts, clamped=np.ones(len(parts.nodes), bool)),
    "millimetres": lambda parts, random: replace(parts, nodes=1e3 * parts.nodes),
    "a thousandth": lambda parts, random: replace(parts, nodes=1e-3 * parts.nodes),
    "not a number": lambda parts, random: replace(parts, nodes=np.where(parts.nodes > 0.0139, np.nan, parts.nodes)),
    "index too large": lambda parts, random: replace(parts, elements=parts.elements + 1),
    "index not whole": lambda parts, random: replace(parts, elements=parts.elements + 0.5),
}


def _permute(parts: Parts, random: np.random.Generator) -> Parts:
    order = random.permutation(len(parts.nodes))
    place = np.argsort(order)
    rows = random.permutation(len(parts.elements))
    return Parts(nodes=parts.nodes[order], elements=place[parts.elements[rows]], clamped=place[parts.clamped])


SHAPES = tuple(change for name, change in CHANGES.items() if name.startswith(("aspect", "skewed")))


def split_parts(parts: Parts) -> Parts:
    """Return hexahedra as 10-node tetrahedra."""
    return parts_of(to_tet10(parts.build()))


def keep_parts(parts: Parts) -> Parts:
    """Return hexahedra as they are."""
    return parts


KINDS = {"hexahedra": keep_parts, "10-node": split_parts}


def parts_of(mesh: VolumeMesh) -> Parts:
    """Return what a mesh was built from."""
    return Parts(nodes=mesh.nodes, elements=mesh.elements, clamped=mesh.clamped)


def build_rig(jaw: Jaw, mesh: VolumeMesh) -> Rig:
    """Return a jaw of a given mesh, ready to be pressed."""
    model = SolidModel(mesh, jaw.material)
    surface = build_contact_surface(jaw, mesh, model, across="half" if model.symmetric else "both")
    contact = RigidContact(model, surface, jaw.face)
    return Rig(mechanics=Mechanics(mesh=mesh, model=model, contact=contact), jaw=jaw, height=HEIGHT)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tried:
    """A mesh that was accepted: its presses, and whether it is warned of."""

    rig: Rig
    presses: list[PressState]
    warned: bool


def try_mesh(jaw: Jaw, parts: Parts) -> Tried:
    """Return what becomes of a mesh; raises what the package says of a bad one."""
    mesh = parts.build()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_locking(replace(jaw, drawing=None), mesh)
    rig = build_rig(jaw, mesh)
    return Tried(rig=rig, presses=rig.press(DEPTH), warned=bool(said))


def run_meshes(plan: Plan) -> Iterator[Trial]:
    """Yield meshes with one fault each: refused in our words, or with the force of the mesh without it."""
    for kind in KINDS:
        yield from run_kind(plan, kind)


def run_kind(plan: Plan, kind: str) -> Iterator[Trial]:
    """Yield the faulty meshes of one kind of element."""
    # at this ratio no element locks by its volume, so that only shape is at stake
    jaw, into = build_jaw(ratio=0.3), KINDS[kind]
    boxes = parts_of(jaw.build_mesh("coarse"))
    right = try_mesh(jaw, into(boxes)).presses[1].force
    for seed in range(plan.share(1)):
        random = plan.random("meshes", seed)
        for name, change in CHANGES.items():
            # 10-node tetrahedra are skewed as hexahedra, or their middle nodes would stay behind
            order = (change, into) if change in SHAPES else (into, change)
            yield attempt(
                seed,
                lambda o=order, r=random: try_mesh(jaw, _apply(o, boxes, r)),
                lambda got: _judge(got, right, RIGHT),
                level=f"{kind}: {name}",
            )


def _apply(order: tuple, parts: Parts, random: np.random.Generator) -> Parts:
    """Return parts after two steps, of which a change takes random numbers and a split does not."""
    for step in order:
        parts = step(parts) if step in KINDS.values() else step(parts, random)
    return parts


def _judge(tried: Tried, right: NDArray, tolerance: float) -> Trial:
    trial = tried.rig.judge(tried.presses, right, tolerance)
    press = tried.presses[1]
    return replace(
        trial,
        sure=not tried.warned,
        stddev=tolerance * float(np.linalg.norm(right)) / 3.0,
        condition=measure_condition(tried.rig.mechanics.model, press.q),
        note=trial.note + ", warned of" * tried.warned,
    )


def run_single(plan: Plan) -> Iterator[Trial]:
    """Yield meshes in single precision, whose forces are those of double precision to its rounding."""
    jaw = build_jaw()
    for density in ("coarse", "default"):
        for kind, change in (("hexahedra", lambda m: m), ("10-node", to_tet10))[: 2 if density == "coarse" else 1]:
            parts = parts_of(change(jaw.build_mesh(density)))
            right = try_mesh(jaw, parts).presses[1].force
            single = replace(parts, nodes=parts.nodes.astype(np.float32), elements=parts.elements.astype(np.int32))
            yield attempt(
                plan.seed,
                lambda p=single: try_mesh(jaw, p),
                lambda got, f=right: _judge(replace(got, warned=False), f, SINGLE),
                level=f"{kind} {density}",
            )


FAMILIES = (
    Family(name="meshes", what="volume meshes with one fault each", run=run_meshes, least_sure=0.2, timed=False),
    Family(name="single", what="meshes in single precision", run=run_single, least_sure=1.0, timed=False),
)
