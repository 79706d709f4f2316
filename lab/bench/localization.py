"""Time against error of the methods that locate a contact, on the shipped bench recording with ground truth.

The error is the distance, on the undeformed surface, from the contact location found to where the line of action of the
true force cuts the deformed surface. Times and errors are of the same calls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce_contact.estimator import ContactEstimator
from finforce_contact.localization.outline_localizer import (
    ClosestLocalizer,
    ContactScene,
    Localizer,
    OutlineLocalizer,
    build_inner_face,
)
from finforce_contact.localization.section import SectionKeeper
from finforce_contact.loop import ForceLoop
from finforce_contact.mesh.object_mesh import ObjectMesh, load_object_mesh, to_manifold
from finforce_contact.paper_contact import intersect
from finforce_contact.parameters import ContactSettings
from finforce_eval.evaluation.places import InnerSurface, true_lines
from finforce_eval.evaluation.scoring import match_truth
from finforce_eval.recordings.objects import track_object
from finforce_eval.recordings.recording import DEMO as RECORDING
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from lab.harness import Figures, Tradeoff, percentiles

LEAST_FORCE = 0.1  # [N], below which the line of a measured force tells no location
EVERY, EVERY_QUICK = 5, 25  # images from one that is used to the next
GRIDS = ((48, 9), (100, 24), (200, 49))  # triangles around and along a cylinder: 1, 5 and 20 thousand
RADIUS, LENGTH = 0.0125, 0.06  # [m] of the cylinder of the shipped recording
WARM_UP = 5  # calls that compile and cut before any is timed
APART = 0.05  # [m] that the object is moved away, to time a scene without contact
MESH = ContactSettings().mesh
JITTER, SEED = 0.05e-3, 1  # [m], so that no two calls are alike


@dataclass(frozen=True, kw_only=True, eq=False)
class LocatedImage:
    """One image in true contact.

    Attributes:
        T: of the object in the jaw frame (4, 4).
        surface: deformed (n, 3) [m].
        wrench: force (3,) [N] and torque (3,) [N m] of the image before; None when not known.
        true: height of the true location [m].
    """

    T: NDArray
    surface: NDArray
    wrench: tuple[NDArray, NDArray] | None
    true: float


def measure(quick: bool) -> Figures:
    """Return times and location errors of every method with 1, 5 and 20 thousand triangles.

    Args:
        quick: use fewer images, for a first impression.
    """
    meshes = [build_cylinder(RADIUS, LENGTH, *grid) for grid in GRIDS]
    return measure_methods(meshes, EVERY_QUICK if quick else EVERY)


def measure_methods(meshes: Sequence[ObjectMesh], every: int) -> Figures:
    """Return times and location errors on the shipped recording.

    Args:
        meshes: of the object, each for all images.
        every: images from one that is used to the next.
    """
    from tqdm import tqdm

    recording = read_recording(RECORDING)
    images = list(follow(recording, load_object_mesh(RECORDING.parent / recording.case["mesh"]), every))
    rows = []
    jaw = load_calibration("bench").apply(load_jaw("bench"))
    for mesh in tqdm(meshes, desc="contact locations", unit="mesh", disable=None, leave=False):
        for name, build in METHODS.items():
            method = build(jaw, mesh)
            found = np.array(list(_run(method, images, lambda T: T)))
            apart = [spent for spent, _ in _run(method, images, _jittered_apart())]
            rows.append(summarise(name, len(mesh.triangles), found, apart))
    return Figures(
        tables={"localization": pd.DataFrame(rows)},
        picture=Tradeoff(
            table="localization",
            method=("method",),
            text="triangles",
            time="in contact p50/ms",
            slow="in contact p99/ms",
            error="error p95/mm",
            answered="found/%",
            complete=100.0,
            title="Location of the contact: time against error; numbers: triangles of the mesh",
        ),
    )


def follow(recording: Recording, mesh: ObjectMesh, every: int) -> Iterator[LocatedImage]:
    """Yield every so-manieth image in true contact; surface and wrench are the solver's, with the estimated contact."""
    keypoints = recording.jaw("left").keypoints
    solver = JawEstimator(load_jaw("bench"), calibration=load_calibration("bench"))
    estimator = ContactEstimator(solver.jaw, mesh=mesh)
    loop = ForceLoop(estimator, solver)
    lines = true_lines(recording, "left", keypoints.stamps, solver.jaw.inner_face_x)
    force = np.linalg.norm(match_truth(recording.truth("left"), keypoints.stamps), axis=1)
    inner, track = InnerSurface(solver.surface(), solver.jaw.face), track_object(recording, "left")
    poses = list(zip(1e-9 * track.stamps, track.poses, strict=True))
    wrench = None
    for index, stamp in enumerate(keypoints.stamps):
        surface, due = solver.surface(), [pose for pose in poses if pose[0] <= 1e-9 * stamp]
        poses = poses[len(due) :]
        solution = loop.update(keypoints.observation(index), due)
        estimate = loop.contact.estimate
        if index % every == 0 and force[index] > LEAST_FORCE and estimate.T_jaw_object is not None:
            true = inner.cut(surface, lines.points[index], lines.directions[index])
            if np.isfinite(true):
                yield LocatedImage(T=estimate.T_jaw_object, surface=surface, wrench=wrench, true=true)
        wrench = (solution.force, solution.torque) if solution.trusted else None


def _jittered_apart() -> Callable[[NDArray], NDArray]:
    """Return what moves poses (4, 4) away from the jaw, each a little differently."""
    random = np.random.default_rng(SEED)

    def move(T: NDArray) -> NDArray:
        moved = T.copy()
        moved[:3, 3] += np.array([APART, 0.0, 0.0]) + JITTER * random.standard_normal(3)
        return moved

    return move


def _run(
    method: Method, images: Sequence[LocatedImage], move: Callable[[NDArray], NDArray]
) -> Iterator[tuple[float, float]]:
    """Yield the time [s] and the location error [m] of each image, NaN where nothing was found; after a warm-up."""
    for image in images[:WARM_UP]:
        method(move(image.T), image.surface, image.wrench)
    for image in images:
        T = move(image.T)
        begin = perf_counter()
        found = method(T, image.surface, image.wrench)
        yield perf_counter() - begin, np.nan if found is None else abs(found - image.true)


def summarise(method: str, triangles: int, calls: NDArray, apart: Sequence[float]) -> dict[str, Any]:
    """Return the row of calls (n, 2), time [s] and error [m], and of times without contact [s]."""
    errors = 1e3 * calls[np.isfinite(calls[:, 1]), 1]
    median, p95, largest = np.percentile(errors, [50, 95, 100]).tolist() if len(errors) else [float("nan")] * 3
    times = percentiles(calls[:, 0], "in contact") | percentiles(apart, "50 mm apart")
    return {
        "method": method,
        "triangles": triangles,
        "n": len(calls),
        "found/%": 100.0 * len(errors) / len(calls),
        "error median/mm": median,
        "error p95/mm": p95,
        "largest/mm": largest,
        **{name: value for name, value in times.items() if "p50" in name or "p99" in name},
    }


def build_cylinder(radius: float, length: float, around: int, along: int) -> ObjectMesh:
    """Return a closed cylinder about y [m] with 2 `around` (`along` + 1) triangles."""
    angle = 2.0 * np.pi * np.arange(around) / around
    y = np.linspace(-0.5 * length, 0.5 * length, along + 1)
    circle = np.tile(radius * np.array([np.cos(angle), np.sin(angle)]), along + 1)
    rings = np.stack([circle[0], np.repeat(y, around), circle[1]], axis=1)
    a, b = np.arange(around), (np.arange(around) + 1) % around
    side = np.stack([a, a + around, b, b, a + around, b + around], axis=1).reshape(-1, 3)
    sides = np.concatenate([side + around * ring for ring in range(along)])
    last, low, high = around * along, len(rings), len(rings) + 1
    caps = [np.stack([a, b, np.full(around, low)], axis=1), np.stack([b, a, np.full(around, high)], axis=1)]
    caps[1][:, :2] += last
    return ObjectMesh(
        vertices=np.vstack([rings, [0.0, y[0], 0.0], [0.0, y[-1], 0.0]]),
        triangles=np.concatenate([sides, *caps]).astype(np.int32),
        watertight=True,
        name="cylinder",
    )


Wrench = tuple[NDArray, NDArray] | None
Method = Callable[[NDArray, NDArray, Wrench], float | None]


def by_outline(jaw: Jaw, mesh: ObjectMesh, *, with_wrench: bool = True) -> Method:
    """Return the method of mode "estimate"."""
    return _by_localizer(OutlineLocalizer(build_inner_face(jaw, MESH)), jaw, mesh, with_wrench=with_wrench)


def by_closest(jaw: Jaw, mesh: ObjectMesh) -> Method:
    """Return the method of mode "closest"."""
    return _by_localizer(ClosestLocalizer(jaw, build_inner_face(jaw, MESH)), jaw, mesh, with_wrench=False)


def _by_localizer(localizer: Localizer, jaw: Jaw, mesh: ObjectMesh, *, with_wrench: bool) -> Method:
    face = build_inner_face(jaw, MESH)
    sections = SectionKeeper(mesh, face.half_width)

    def locate(T: NDArray, surface: NDArray, wrench: Wrench) -> float | None:
        told, line = wrench if with_wrench else None, face.deform(surface)
        found = localizer.locate(ContactScene(T=T, section=sections.at(T), surface=surface, line=line, wrench=told))
        return None if found is None else found.patch.mean

    return locate


def by_intersection(jaw: Jaw, mesh: ObjectMesh) -> Method:
    """Return the height of the vertex nearest to the centre of the intersection with the object, as the paper does."""
    own, solid = jaw.build_mesh(MESH), to_manifold(mesh)

    def locate(T: NDArray, surface: NDArray, wrench: Wrench) -> float | None:
        centre = intersect(solid, T, surface, own.surface)
        return None if centre is None else float(own.nodes[((surface - centre) ** 2).sum(axis=1).argmin(), 2])

    return locate


def by_whole_estimator(jaw: Jaw, mesh: ObjectMesh) -> Method:
    """Return the estimator with its pose filter and its outline as a method."""
    estimator, stamps = ContactEstimator(jaw, mesh=mesh, settings=ContactSettings()), count()

    def locate(T: NDArray, surface: NDArray, wrench: Wrench) -> float | None:
        stamp = next(stamps) / 30.0
        estimator.take_pose(stamp, T)
        estimate = estimator.update(stamp, surface, wrench)
        return float(estimate.points[:, 2] @ estimate.weights) if len(estimate.points) else None

    return locate


METHODS: dict[str, Callable[[Jaw, ObjectMesh], Method]] = {
    "outline and line of action": by_outline,
    "outline alone": partial(by_outline, with_wrench=False),
    "manifold3d": by_intersection,
    "closest point, undeformed": by_closest,
    "the whole estimator": by_whole_estimator,
}
