"""Small meshes, and the bench finger's mechanics, built once for all tests."""

from dataclasses import replace
from functools import cache

import numpy as np

from finforce_ifea.contact_mechanics.forward_press import RigidCylinder, press_jaw
from finforce_ifea.fem.solid import find_mirror_nodes
from finforce_ifea.fem.tetrahedra import to_tet4, to_tet10
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.jaw.mesh import build_volume_mesh
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings

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
    return KINDS[kind](build_volume_mesh(nodes=nodes, hexes=hexes, clamped=np.flatnonzero(clamp(nodes))))


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
