"""How preparing an object's mesh and finding its contact in an image grow with its triangles."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from time import process_time

import numpy as np
from numpy.typing import NDArray

from finforce.optional import import_trimesh
from finforce_contact.estimator import ContactEstimator
from finforce_contact.mesh.object_mesh import prepare_object_mesh
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_eval.bench.cases import bench_finger
from finforce_eval.bench.growth import Curve, Growth

# 20 * 4^n triangles: 80 to 1.3 million.
SUBDIVISIONS = tuple(range(1, 9))
_RADIUS = 0.02
_IMAGES = 60
_JITTER = 0.05e-3
# Turn out of the finger's plane [rad] from which the outline is cut anew.
_TIPPED = 0.03


def grow_triangles(quick: bool) -> Growth:
    """Measures preparation, an image as it comes, and an image that needs a new outline, over a sphere's triangles."""
    levels = SUBDIVISIONS[:4] if quick else SUBDIVISIONS
    _measure_sphere(build_sphere(levels[0]))  # the first one loads libraries
    rows = [_measure_sphere(build_sphere(level)) for level in levels]
    sizes = [row.pop("triangles") for row in rows]
    curves = [Curve(name=name, sizes=sizes, seconds=[row[name] for row in rows]) for name in rows[0]]
    return Growth(name="object triangles", unit="triangles", curves=curves)


def build_sphere(level: int) -> ObjectMesh:
    """Returns a sphere of radius 20 mm with 20 * 4^level triangles."""
    sphere = import_trimesh().creation.icosphere(subdivisions=level, radius=_RADIUS)
    return ObjectMesh(
        vertices=np.array(sphere.vertices), triangles=np.array(sphere.faces, np.int32), watertight=True, name="sphere"
    )


def _measure_sphere(mesh: ObjectMesh) -> dict[str, float]:
    """Returns the number of triangles and median times [s]; the images are of the mesh as it is, not cut down."""
    begin = process_time()
    prepare_object_mesh(mesh.vertices, mesh.triangles)
    prepared = process_time() - begin
    begin = process_time()
    estimator = ContactEstimator(bench_finger(), mesh=mesh)
    built = process_time() - begin
    few = 6 if len(mesh.triangles) > 1e5 else 20
    return {
        "triangles": len(mesh.triangles),
        "checked, repaired, cut down to 20,000": prepared,
        "taken into the estimator": built,
        "an image, the object moves": _time_images(estimator, _IMAGES, tipped=0.0),
        "an image with a new outline": _time_images(estimator, few, tipped=_TIPPED),
    }


def _time_images(estimator: ContactEstimator, count: int, *, tipped: float) -> float:
    """Returns the median time [s] of an image with a new pose; the first two, which compile and cut, are left out."""
    estimator.reset()
    times = []
    for index, T in enumerate(_poses(estimator.face.x, count + 2, tipped)):
        begin = process_time()
        estimator.take_pose(index / 30.0, T)
        estimator.update(index / 30.0)
        times.append(process_time() - begin)
    return float(np.median(times[2:]))


def _poses(face_x: float, count: int, tipped: float) -> Iterator[NDArray]:
    """Yields poses (4, 4) of a sphere in slight contact that moves a little and tips to and fro about x [rad]."""
    random = np.random.default_rng(1)
    turn: Callable[[float], NDArray] = lambda a: np.array(  # noqa: E731
        [[1.0, 0.0, 0.0], [0.0, np.cos(a), -np.sin(a)], [0.0, np.sin(a), np.cos(a)]]
    )
    for index in range(count):
        T = np.eye(4)
        T[:3, :3] = turn(tipped * index)
        T[:3, 3] = [face_x + _RADIUS - 1e-3, 0.0, 0.04] + _JITTER * random.standard_normal(3)
        yield T
