"""Claims about volume meshes with faults: refused in our words, warned of, or right."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from mechanics_fakes import build_jaw
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_ifea.contact_mechanics.pressed_jaw import build_contact_surface
from finforce_ifea.errors import MeshError
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.drawing import PRESETS
from finforce_ifea.jaw.mesh import VolumeMesh, build_volume_mesh, check_connection, to_tet10
from finforce_ifea.mechanics import LockingWarning, measure_shape, warn_of_locking
from lab.presses import RigidCylinder, press_jaw


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts:
    """What a mesh is built from: nodes (n, 3) [m], elements (m, 8 | 10), clamped nodes (c,)."""

    nodes: NDArray
    elements: NDArray
    clamped: NDArray

    def build(self) -> VolumeMesh:
        """Return the mesh as a reader of files does, checks included."""
        mesh = build_volume_mesh(nodes=self.nodes, elements=self.elements, clamped=self.clamped)
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


def _permute(parts: Parts, random: np.random.Generator) -> Parts:
    order = random.permutation(len(parts.nodes))
    place = np.argsort(order)
    rows = random.permutation(len(parts.elements))
    return Parts(nodes=parts.nodes[order], elements=place[parts.elements[rows]], clamped=place[parts.clamped])


CHANGES: dict[str, Change] = {
    "as it is": lambda parts, random: parts,
    "nodes in another order": _permute,
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


FEW = replace(PRESETS["coarse"], between_ribs=2, along_rib=2)
SHAPES = tuple(change for name, change in CHANGES.items() if name.startswith(("aspect", "skewed")))


def parts_of(mesh):
    return Parts(nodes=mesh.nodes, elements=mesh.elements, clamped=mesh.clamped)


def press(jaw, parts):
    """The force [N] of a mesh that is pressed half a millimetre deep, and whether the mesh is warned of."""
    mesh = parts.build()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_locking(replace(jaw, drawing=None), mesh)
    model = SolidModel(mesh, jaw.material)
    surface = build_contact_surface(jaw, mesh, model, across="half" if model.symmetric else "both")
    (state,) = press_jaw(model, surface, jaw.inner_face_x, RigidCylinder(radius=0.0125), 0.04, [0.5e-3])
    return state.force, bool(said)


@pytest.mark.parametrize(
    "split", [lambda parts: parts, lambda parts: parts_of(to_tet10(parts.build()))], ids=["hexahedra", "10-node"]
)
def test_every_faulty_mesh_is_refused_or_right(split):
    """One fault each; right within a tenth, or warned of. At this ratio no element locks by its volume."""
    jaw = build_jaw(ratio=0.3)
    boxes, random = parts_of(jaw.build_mesh(FEW)), np.random.default_rng(2)
    right, _ = press(jaw, split(boxes))
    kept = set()
    for name, change in CHANGES.items():
        try:
            # 10-node tetrahedra are skewed as hexahedra, or their middle nodes would stay behind
            parts = split(change(boxes, random)) if change in SHAPES else change(split(boxes), random)
            force, warned = press(jaw, parts)
        except FinforceError:
            continue
        kept.add(name)
        assert warned or np.linalg.norm(force - right) <= 0.1 * np.linalg.norm(right), name
    assert {"as it is", "aspect ratio 1e4", "nodes in another order"} <= kept


@pytest.mark.parametrize("split", [lambda mesh: mesh, to_tet10], ids=["hexahedra", "10-node"])
def test_a_mesh_in_single_precision_has_the_force_of_double(split):
    """1e-4: 80 mm have 4e-9 m of rounding."""
    parts = parts_of(split(build_jaw().build_mesh("coarse")))
    single = replace(parts, nodes=parts.nodes.astype(np.float32), elements=parts.elements.astype(np.int32))
    right, _ = press(build_jaw(), parts)
    assert np.linalg.norm(press(build_jaw(), single)[0] - right) <= 1e-4 * np.linalg.norm(right)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("element twice", "occur twice"),
        ("loose element", "falls into 2 pieces"),
        ("element on one edge", "nodes on one line"),
        ("clamped along a line", "lie on one line"),
        ("clamped by a mask", "got bool"),
        ("index not whole", "not whole"),
        ("node twice", "duplicate"),
        ("millimetres", "millimetres"),
        ("nearly inverted", "inverted"),
    ],
)
def test_a_fault_is_called_by_its_name(fault, words):
    parts = parts_of(build_jaw().build_mesh("coarse"))
    with pytest.raises(MeshError, match=words):
        CHANGES[fault](parts, np.random.default_rng(0)).build()


def test_distorted_hexahedra_are_warned_of():
    parts = parts_of(build_jaw().build_mesh("coarse"))
    skewed = CHANGES["skewed by 0.95"](parts, np.random.default_rng(0)).build()
    assert measure_shape(skewed) < 0.8 < measure_shape(parts.build())
    with pytest.warns(LockingWarning, match="distorted hexahedra"):
        warn_of_locking(replace(build_jaw(ratio=0.3), drawing=None), skewed)


def test_refusals_are_ours():
    """Whatever is done to a mesh, nothing but this package's errors comes out."""
    parts, random = parts_of(build_jaw().build_mesh("coarse")), np.random.default_rng(7)
    for _ in range(40):
        elements = parts.elements.copy()
        rows = random.integers(len(elements), size=3)
        elements[rows] = random.integers(len(parts.nodes), size=(3, 8))
        with pytest.raises(FinforceError):
            replace(parts, elements=elements).build()
