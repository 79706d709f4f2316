"""Compares ways to find the contact place, in time and in error, on bench recordings with ground truth.

    python benchmarks/localization.py [RECORDING...] [--json report/localization.json]

Without recordings the one that comes with the package is used. The error is the distance, on the undeformed surface,
from the place to where the line of action of the true force cuts the deformed surface.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from localization_methods import METHODS, Method, Setup
from numpy.typing import NDArray
from tqdm import tqdm

from finforce_contact.estimator import ContactEstimator
from finforce_contact.object_mesh import ObjectMesh, load_object_mesh
from finforce_contact.settings import ContactSettings
from finforce_eval.bench import row_from_times, write_figures
from finforce_eval.demo import RECORDING
from finforce_eval.objects import track_object
from finforce_eval.places import InnerSurface, true_lines
from finforce_eval.recording import read_recording
from finforce_eval.scoring import match_truth
from finforce_eval.tracks import Recording
from finforce_ifea.calibration import load_calibration
from finforce_ifea.errors import MissingDependencyError
from finforce_ifea.estimator import JawEstimator, Observation
from finforce_ifea.jaw import load_jaw

LEAST_FORCE = 0.1  # N, below which the line of a measured force says nothing of its place
EVERY = 5  # images between two that the slow ways look at
GRIDS = ((48, 9), (100, 24), (200, 49))  # triangles around and along: 1, 5 and 20 thousand
REPEATS = 300
JITTER = 0.05e-3  # m, so that no two calls are alike


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """One image in true contact: pose (4, 4), deformed surface (n, 3) [m], force and torque, true height [m]."""

    T: NDArray
    surface: NDArray
    wrench: tuple[NDArray, NDArray] | None
    true: float


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """Errors of one way [mm], and the share of images in contact on which it found a place."""

    method: str
    n: int
    found: float
    median: float
    p95: float
    max: float


def main() -> None:
    """Measures, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="*", default=[str(RECORDING)], metavar="RECORDING")
    parser.add_argument("--json", default="", metavar="OUT")
    options = parser.parse_args()
    accuracies, pressed = measure_errors(options.recordings)
    times = measure_times(pressed)
    print(format_accuracies(accuracies), format_times(times), sep="\n\n")
    if options.json:
        write_figures(options.json, {"errors_mm": [asdict(row) for row in accuracies], "times_ms": times})


def measure_errors(paths: list[str]) -> tuple[list[Accuracy], Frame]:
    """Returns the errors of every way over the recordings, and the frame with the largest force of the last one."""
    errors: dict[str, list[float]] = {}
    for path in paths:
        recording = read_recording(path)
        mesh = load_object_mesh(Path(path).parent / recording.case["mesh"])
        methods = build_methods(mesh)
        frames = list(follow(recording, mesh))
        for frame in tqdm(frames, desc=recording.name, unit="image", leave=False):
            for name, method in methods.items():
                found = method(frame.T, frame.surface, frame.wrench)
                errors.setdefault(name, []).append(np.nan if found is None else 1e3 * abs(found - frame.true))
    return [summarise(name, np.array(values)) for name, values in errors.items()], max(frames, key=load_on)


def load_on(frame: Frame) -> float:
    """Returns the force that the solver found in a frame [N]."""
    return 0.0 if frame.wrench is None else float(np.linalg.norm(frame.wrench[0]))


def build_methods(mesh: ObjectMesh) -> dict[str, Method]:
    """Returns the ways to find a place whose libraries are installed, by name."""
    jaw = load_calibration("bench").apply(load_jaw("bench"))
    methods = {}
    for name, build in METHODS.items():
        try:
            methods[name] = build(Setup(jaw=jaw, mesh=mesh))
        except MissingDependencyError as error:
            print(f"{name}: {error}")
    return methods


def follow(recording: Recording, mesh: ObjectMesh) -> Iterator[Frame]:
    """Yields images in true contact; surface and wrench are the solver's, with the contact that was estimated."""
    track = recording.jaw("left")
    solver = JawEstimator(load_jaw("bench"), calibration=load_calibration("bench"))
    estimator = ContactEstimator(solver.jaw, mesh=mesh)
    lines = true_lines(recording, "left", track.keypoints.stamps, solver.jaw.inner_face_x)
    force = np.linalg.norm(match_truth(recording.truth("left"), track.keypoints.stamps), axis=1)
    inner = InnerSurface(solver.surface(), solver.jaw.inner_face_x)
    seen_object = track_object(recording, "left")
    poses = list(zip(seen_object.stamps, seen_object.poses, strict=True))
    wrench = None
    for index, stamp in enumerate(track.keypoints.stamps):
        while poses and poses[0][0] <= stamp:
            when, T = poses.pop(0)
            estimator.take_pose(1e-9 * when, T)
        surface = solver.surface()
        estimate = estimator.update(1e-9 * stamp, surface, wrench)
        if index % EVERY == 0 and force[index] > LEAST_FORCE and estimate.T_jaw_object is not None:
            true = inner.cut(surface, lines.points[index], lines.directions[index])
            if np.isfinite(true):
                yield Frame(T=estimate.T_jaw_object, surface=surface, wrench=wrench, true=true)
        points, likelihood = track.keypoints.points[index], track.keypoints.likelihood[index]
        solution = solver.update(
            Observation(stamp=1e-9 * stamp, points=points, likelihood=likelihood), estimate.contact
        )
        wrench = (solution.force, solution.torque) if solution.status == "ok" else None


def measure_times(frame: Frame) -> list[dict]:
    """Returns the times [ms] of every way by the number of triangles, in contact and 50 mm apart."""
    rows = []
    for around, along in GRIDS:
        mesh = build_cylinder(0.0125, 0.06, around, along)
        methods: dict[str, Callable] = dict(build_methods(mesh))
        methods["estimator, its pose filter included"] = time_estimator(mesh)
        for distance, where in ((0.0, "in contact"), (0.05, "50 mm apart")):
            for name, method in methods.items():
                T = frame.T.copy()
                T[0, 3] += distance
                row = asdict(row_from_times(name, list(_time(method, frame, T))))
                rows.append({"triangles": len(mesh.triangles), "where": where, **row})
    return rows


def _time(method: Method, frame: Frame, T: NDArray) -> Iterator[float]:
    """Yields the durations of calls [s]; the first ones, which compile and cut, are left out."""
    random = np.random.default_rng(1)
    for repeat in range(REPEATS + 5):
        moved = T.copy()
        moved[:3, 3] += JITTER * random.standard_normal(3)
        begin = perf_counter()
        method(moved, frame.surface, frame.wrench)
        if repeat >= 5:
            yield perf_counter() - begin


def time_estimator(mesh: ObjectMesh) -> Method:
    """Returns the whole estimator with its filter and its outline as a method that finds a place."""
    jaw = load_calibration("bench").apply(load_jaw("bench"))
    estimator, stamps = ContactEstimator(jaw, mesh=mesh, settings=ContactSettings()), iter(range(10**9))

    def locate(T: NDArray, surface: NDArray, wrench: tuple[NDArray, NDArray] | None) -> float | None:
        stamp = next(stamps) / 30.0
        estimator.take_pose(stamp, T)
        estimate = estimator.update(stamp, surface, wrench)
        return float(estimate.points[:, 2] @ estimate.weights) if len(estimate.points) else None

    return locate


def build_cylinder(radius: float, length: float, around: int, along: int) -> ObjectMesh:
    """Returns a closed cylinder about y [m] with 2 `around` (`along` + 1) triangles."""
    angle = 2.0 * np.pi * np.arange(around) / around
    y = np.linspace(-0.5 * length, 0.5 * length, along + 1)
    rings = np.stack(
        [
            np.tile(radius * np.cos(angle), along + 1),
            np.repeat(y, around),
            np.tile(radius * np.sin(angle), along + 1),
        ],
        axis=1,
    )
    a, b = np.arange(around), (np.arange(around) + 1) % around
    side = np.concatenate([np.stack([a, a + around, b, b, a + around, b + around], axis=1).reshape(-1, 3)])
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


def summarise(name: str, errors: NDArray) -> Accuracy:
    """Returns the statistics of errors (n,) [mm], NaN where nothing was found."""
    found = errors[np.isfinite(errors)]
    median, p95, largest = np.percentile(found, [50, 95, 100]).tolist() if len(found) else [float("nan")] * 3
    return Accuracy(method=name, n=len(errors), found=len(found) / len(errors), median=median, p95=p95, max=largest)


def format_accuracies(rows: list[Accuracy]) -> str:
    """Returns the errors as a table."""
    lines = ["| place error, mm | images | found | median | p95 | max |", "|---|---|---|---|---|---|"]
    lines += [
        f"| {row.method} | {row.n} | {row.found:.0%} | {row.median:.2f} | {row.p95:.2f} | {row.max:.2f} |"
        for row in rows
    ]
    return "\n".join(lines)


def format_times(rows: list[Mapping]) -> str:
    """Returns the times as a table."""
    lines = ["| time, ms | triangles | | p50 | p95 | p99 | max | n |", "|---|---|---|---|---|---|---|---|"]
    lines += [
        f"| {row['name']} | {row['triangles']} | {row['where']} | {row['p50']:.3f} | {row['p95']:.3f} | "
        f"{row['p99']:.3f} | {row['max']:.3f} | {row['n']} |"
        for row in rows
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
