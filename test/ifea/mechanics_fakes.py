"""Small meshes, jaw files, the bench finger's mechanics built once for all tests, and objects pressed into it."""

import copy
from dataclasses import replace
from functools import cache

import meshio
import numpy as np
import trimesh
import yaml

from finforce_ifea.contact_mechanics.indenter import flat_profile
from finforce_ifea.contact_mechanics.pressed_jaw import limit_step
from finforce_ifea.fem.solid import find_mirror_nodes
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.mesh import build_volume_mesh, to_tet4, to_tet10
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings
from lab.presses import RigidCylinder, press_jaw

SHIPPED_BENCH = load_jaw("bench")
MODULUS, RATIO = 30e6, 0.45


def build_jaw(modulus=MODULUS, ratio=RATIO):
    """The bench jaw of a material, Young's modulus [Pa] and Poisson's ratio, softer than a jaw file may have it."""
    material = SHIPPED_BENCH.material.model_copy(update={"young_modulus": modulus, "poisson_ratio": ratio})
    return replace(SHIPPED_BENCH, material=material)


def compute_volume(mesh) -> float:
    """Return the volume [m^3] that the surface of a volume mesh encloses."""
    return trimesh.Trimesh(mesh.nodes, mesh.surface, process=False).volume


def shoelace_area(corners):
    """The area of a polygon (n, 2)."""
    x, z = np.asarray(corners).T
    return 0.5 * abs(np.dot(x, np.roll(z, -1)) - np.dot(z, np.roll(x, -1)))


def content_of(jaw):
    return yaml.safe_load(jaw.path.read_text())


def write_jaw(folder, content):
    path = folder / "finger.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content, sort_keys=False))
    return path


def changed(content, place, value):
    """A copy of a file's content with the value at a place ("a.b") replaced, or removed by Ellipsis."""
    content = copy.deepcopy(content)
    *tables, key = place.split(".")
    table = content
    for name in tables:
        table = table[name]
    if value is ...:
        del table[key]
    else:
        table[key] = value
    return content


def write_mesh_jaw(folder, mesh=None, **changes):
    """A jaw file around a mesh file in millimetres."""
    mesh = mesh or SHIPPED_BENCH.build_mesh("coarse")
    kind = {8: "hexahedron", 4: "tetra", 10: "tetra10"}[mesh.elements.shape[1]]
    meshio.write(folder / "finger.vtu", meshio.Mesh(1e3 * mesh.nodes, [(kind, mesh.elements)]))
    content = {
        "mesh": {"file": "finger.vtu", "scale": 0.001, "clamped": {"z_below": 0.0005}},
        "inner_face_x": 0.014,
        "material": {"young_modulus": 26.0e6, "poisson_ratio": 0.45},
        "keypoints": {"low": [0.0132, 0.010, 0.009], "tip": [0.012, 0.010, 0.080]},
        "candidates": {"first_z": 0.008, "step_z": 0.005, "count": 14},
    }
    for place, value in changes.items():
        content = changed(content, place.replace("__", "."), value)
    return write_jaw(folder, content)


PENALTY = 1.5e5  # N/m per contact point, one every 0.5 mm


class Press:
    """A rigid cylinder pressed into the inner face by a penalty, step by step."""

    def __init__(self, model, jaw, radius, height):
        self.model, self.radius, self.height, self.face = model, radius, height, jaw.inner_face_x
        z = np.arange(0.5e-3, jaw.drawing.length - 0.4e-3, 0.5e-3)
        self.probe = model.attach(np.stack([np.full_like(z, self.face), 0 * z, z], axis=1), 1e-3)
        self.q, self.depth, self.force = np.zeros(model.size), 0.0, np.zeros(3)

    def to(self, depth, step=1e-3):
        for current in np.linspace(self.depth, depth, int(np.ceil((depth - self.depth) / step)) + 1)[1:]:
            self._settle(np.array([self.face + self.radius - current, 0.0, self.height]))
        self.depth = depth
        return self

    def _settle(self, axis):
        model = self.model
        for _ in range(100):
            away = model.positions(self.probe, self.q) - axis
            distance = np.linalg.norm(away, axis=1)
            normal, inside = away / distance[:, None], np.maximum(self.radius - distance, 0.0)
            forces, across = PENALTY * inside[:, None] * normal, normal[:, [2, 1, 0]] * [1, 0, -1]
            springs = np.einsum("pi,pj->pij", normal, normal) * (PENALTY * (inside > 0))[:, None, None]
            springs -= np.einsum("pi,pj->pij", across, across) * (PENALTY * inside / distance)[:, None, None]
            state = model.linearize(self.q)
            model.stiffen(state.tangent, self.probe, self.q, springs)
            load = model.load(self.probe, self.q, forces) - state.force
            step = model.factorise(state.tangent).solve(load)
            largest = np.abs(np.where(model.rotations, 7e-3 * step, step)).max()
            self.q = self.q + step * min(1.0, 2e-3 / max(largest, 1e-12))
            if largest < 1e-8:
                self.force = forces.sum(axis=0)
                return
        raise AssertionError(f"no equilibrium at {axis}")


def line_stiffness(model, height):
    """N/m of the unloaded finger under a force along -x on its inner face."""
    probe = model.attach(np.array([[model.drawing.inner_face_x, 0.0, height]]), 1e-3)
    q = np.zeros(model.size)
    load = model.load(probe, q, np.array([[-1.0, 0.0, 0.0]]))
    step = model.factorise(model.linearize(q).tangent).solve(load)
    return -1.0 / model.project(probe, q, step[:, None])[0, 0, 0]


STEP = 0.5e-3


def settle(contact, q, place):
    """The equilibrium of a place by Newton's method, and its linearisation; None when there is none."""
    for _ in range(40):
        state = contact.linearize(q, place)
        if not state.touches:
            q = q + contact.approach(q, state.correction, place)
            continue
        q = q + state.correction
        if state.size < 1e-6:
            return q, contact.linearize(q, place)
    return None


def press(contact, indenter, shape, height, depths):
    """Unknowns and linearisations at rising depths [m] below first touch."""
    contact.indenter = indenter
    touch = indenter.find_touch(np.array([0.0, shape, height]), flat_profile(*contact.surface.heights[[0, -1]]))
    q, state, reached, results = contact.begin(height), None, 0.0, []
    for depth in depths:
        for deeper in np.linspace(reached, depth, max(1, round((depth - reached) / STEP)) + 1)[1:]:
            if state is not None:
                q = q + limit_step(contact.model, state.modes[:, 0] * (deeper - reached))
            q, state = settle(contact, q, np.array([touch + deeper, shape, height]))
            reached = deeper
        results.append((q, state))
    return results


def rounded_box(size, edge=1e-3):
    """The outline (n, 2) [m] of a square with rounded edges."""
    middle = 0.5 * size - edge
    turns = np.arange(4) * 0.5 * np.pi
    arcs = turns[:, None] + np.linspace(0.0, 0.5 * np.pi, 6)
    centres = middle * np.sign(np.stack([np.cos(turns + 0.25 * np.pi), np.sin(turns + 0.25 * np.pi)], axis=1))
    return (centres[:, None] + edge * np.stack([np.cos(arcs), np.sin(arcs)], axis=2)).reshape(-1, 2)


MODULUS = 30e6
# Of the small blocks [m].
EDGE = (0.004, 0.006, 0.008)
TPU = Material(young_modulus=MODULUS, poisson_ratio=0.45)
BENCH = replace(load_jaw("bench"), material=TPU)
HEIGHTS = {"lower": 0.020, "middle": 0.040, "upper": 0.060}
KINDS = {"hex": lambda mesh: mesh, "tet4": to_tet4, "tet10": to_tet10}


def block(counts, size, *, kind="hex", distort=0.0, clamp=lambda nodes: nodes[:, 2] < 1e-9, seed=0):
    """A block [0, size] of counts elements, y about 0, inner nodes moved by a share `distort` of their spacing."""
    axes = [np.linspace(0.0, length, count + 1) for length, count in zip(size, counts, strict=True)]
    axes[1] = axes[1] - 0.5 * size[1]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    if distort:
        random = np.random.default_rng(seed)
        spacing = np.array(size) / counts
        inner = tuple(slice(1, -1) if count > 1 else slice(None) for count in counts)
        grid[inner] += distort * spacing * random.uniform(-1, 1, grid[inner].shape)
    number = np.arange(grid[..., 0].size).reshape(grid.shape[:3])
    corner = [
        number[i : i + counts[0], j : j + counts[1], k : k + counts[2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)
    ]
    order = [0, 4, 6, 2, 1, 5, 7, 3]
    hexes = np.stack([corner[i].ravel() for i in order], axis=1)
    nodes = grid.reshape(-1, 3)
    return KINDS[kind](build_volume_mesh(nodes=nodes, elements=hexes, clamped=np.flatnonzero(clamp(nodes))))


@cache
def bench_mechanics(mesh="coarse", solver="solid", axes="normal"):
    return build_mechanics(BENCH, EstimatorSettings(solver=solver, mesh=mesh, force_axes=axes))


@cache
def bench_press(mesh, solver, diameter, height, depths):
    """Equilibria of the bench finger, mm for diameter, height and depths."""
    mechanics = bench_mechanics(mesh, solver)
    return press_jaw(
        mechanics.model, mechanics.contact.surface, BENCH.inner_face_x, RigidCylinder(radius=0.5e-3 * diameter),
        1e-3 * height, tuple(1e-3 * depth for depth in depths),
    )  # fmt: skip


def unknowns_from_displacements(model, u):
    """The unknowns of a solid for displacements (nodes, 3) that its clamp and its symmetry allow."""
    q = np.zeros(model.size + 1)
    q[model.dof.ravel()] = (model.sign * u).ravel()
    return q[:-1]


def tangent_matrix(model, q):
    return model.sparse_tangent(model.linearize(q).tangent).toarray()


def solve_linear(model, load):
    """The unknowns of the linear problem K(0) q = load."""
    return model.factorise(model.linearize(np.zeros(model.size)).tangent).solve(load)


def rotation(axis, angle):
    """The matrix of a rotation by `angle` [rad] about `axis`."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.cross(np.eye(3), -axis)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def wobble(model, size, seed=0):
    """Displacements [m] of every node but the clamped ones, mirrored where the model is."""
    nodes, random = model.mesh.nodes, np.random.default_rng(seed)
    u = random.normal(size=nodes.shape)
    if model.symmetric:
        mirror = find_mirror_nodes(model.mesh)
        u = 0.5 * (u + u[mirror] * [1, -1, 1])
    u[model.mesh.clamped] = 0.0
    return size * u
