"""Jaw files made for tests."""

import copy

import meshio
import numpy as np
import yaml

from finforce_ifea.jaw.jaw import load_jaw

BENCH = load_jaw("bench")


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
    mesh = mesh or BENCH.build_mesh("coarse")
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
