"""How the cost of solving and of finding the contact grows with its size: curves, slopes, and their pictures.

Costs are processor times, to which other processes on the machine add nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from finforce.errors import FinforceError
from finforce.optional import import_trimesh
from finforce_contact.estimator import ContactEstimator
from finforce_contact.mesh.object_mesh import prepare_object_mesh
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_eval.evaluation.tables import align_rows
from finforce_ifea.contact_mechanics.forward_press import RigidCylinder, press_jaw
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.fem.model import JawModel
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.drawing import MeshDensity
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw
from finforce_ifea.jaw.mesh import VolumeMesh
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.quadratic_program import solve_program
from finforce_ifea.settings import SOLVERS, EstimatorSettings
from lab.bench.bench import time_calls
from lab.bench.cases import PERIOD, bench_finger, load_cases, record_press

# The slope at the end is that of the sizes within this factor of the largest.
_END = 12.0


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Median processor times of one kind of work over its size.

    Attributes:
        name: of the work.
        sizes: rising.
        seconds: median time [s] at each size.
        detail: whether it is a share of another curve, drawn thin.
    """

    name: str
    sizes: Sequence[float]
    seconds: Sequence[float]
    detail: bool = False

    @property
    def slope(self) -> float:
        """Exponent of the power law through all sizes."""
        return fit_slope(self.sizes, self.seconds)

    @property
    def end_slope(self) -> float:
        """Exponent through the largest sizes, where constant costs no longer show."""
        sizes = np.asarray(self.sizes, float)
        last = sizes >= sizes.max() / _END
        return fit_slope(sizes[last], np.asarray(self.seconds)[last])


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Curves over one kind of size."""

    name: str
    unit: str
    curves: Sequence[Curve]


@dataclass(frozen=True, kw_only=True)
class GrowthFigures:
    """Everything of one run."""

    growths: Sequence[Growth]


def fit_slope(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Returns the exponent p of seconds ~ sizes^p by least squares of the logarithms; NaN below two sizes."""
    if len(sizes) < 2:
        return float("nan")
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def measure(quick: bool) -> GrowthFigures:
    """Measures all curves, under a progress bar.

    Args:
        quick: fewer and smaller sizes.
    """
    from tqdm import tqdm

    jobs = list(_list_jobs(quick))
    growths = []
    with tqdm(jobs, unit="growth", disable=None, leave=False) as bar:
        for job in bar:
            growths.append(job())
    return GrowthFigures(growths=growths)


def _list_jobs(quick: bool) -> Iterator[Callable[[], Growth]]:
    """Yields what measures each growth."""
    yield lambda: grow_vertices(quick)
    yield lambda: grow_vertices(quick, solid=True)
    yield lambda: grow_keypoints(quick)
    yield lambda: grow_candidates(quick)
    yield lambda: grow_triangles(quick)


def format_table(figures: GrowthFigures) -> str:
    """Returns the times and slopes in Markdown, one table per kind of size."""
    return "\n\n".join(_format_growth(growth) for growth in figures.growths)


def _format_growth(growth: Growth) -> str:
    sizes = sorted({size for curve in growth.curves for size in curve.sizes})
    rows = []
    for curve in growth.curves:
        known = dict(zip(curve.sizes, curve.seconds, strict=True))
        cells = [f"{1e3 * known[size]:.3g}" if size in known else "" for size in sizes]
        rows.append([curve.name, *cells, f"{curve.slope:.2f}", f"{curve.end_slope:.2f}"])
    return align_rows([f"{growth.name}, ms", *(f"{size:,.0f}" for size in sizes), "slope", "at the end"], rows)


def as_json(figures: GrowthFigures) -> dict[str, Any]:
    """Returns the figures as plain values."""
    return {
        "growths": [
            {
                "name": growth.name,
                "unit": growth.unit,
                "table": _format_growth(growth),
                "curves": [
                    {**asdict(curve), "slope": curve.slope, "end_slope": curve.end_slope} for curve in growth.curves
                ],
            }
            for growth in figures.growths
        ]
    }


def draw(figures: GrowthFigures, path: Path | str) -> None:
    """Draws a log-log panel per kind of size and writes the picture."""
    from finforce_eval.figures.figures import new_figure, style_axes

    columns = 2
    rows = -(-len(figures.growths) // columns)
    figure = new_figure(6.2 * columns, 4.2 * rows)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, growth in zip(panels, figures.growths, strict=False):
        style_axes(axes)
        for curve in growth.curves:
            width, line = (1.0, "--") if curve.detail else (1.8, "-")
            label = f"{curve.name}: slope {curve.slope:.2f}, at the end {curve.end_slope:.2f}"
            axes.plot(curve.sizes, 1e3 * np.array(curve.seconds), line, marker="o", linewidth=width, markersize=3.5,
                      label=label)  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel=growth.unit, ylabel="processor time, median [ms]")
        axes.set_title(growth.name, loc="left", fontsize=10)
        axes.legend(frameon=False, fontsize=7)
    for axes in panels[len(figures.growths) :]:
        axes.set_visible(False)
    figure.savefig(path)


KEYPOINTS = (5, 10, 20, 50, 100, 200)
CANDIDATES = (1, 2, 5, 10, 20, 50, 100, 200)
KEYPOINT_SOLVERS = ("solid", "frame", "reduced", "linear")
_TARE_FRAMES = 10
_HEIGHT, _RADIUS = 0.040, 0.0125
_REGULARISED = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshedJaw(Jaw):
    """A jaw whose drawing is divided by a density of its own, whatever preset is asked for."""

    density: MeshDensity

    def build_mesh(self, density: MeshDensity | str | None = None) -> VolumeMesh:
        """Builds the volume mesh of the jaw's own density."""
        return super().build_mesh(self.density)


def mesh_jaw(jaw: Jaw, density: MeshDensity) -> MeshedJaw:
    """Returns a jaw with a mesh density of its own."""
    return MeshedJaw(**{field.name: getattr(jaw, field.name) for field in fields(Jaw)}, density=density)


def list_densities(quick: bool, *, solid: bool) -> list[MeshDensity]:
    """Returns densities from 200 to 20,000 vertices.

    Args:
        quick: those below 3,000 alone.
        solid: refined in all directions; else along bands and ribs alone, one element thick.
    """
    if not solid:
        steps = (1, 2, 3, 6, 12, 24, 48, 96, 128)
        chosen = [_density(step, max(1, 4 * step // 3), 1, 2) for step in steps]
        return chosen[:5] if quick else chosen
    shapes = ((3, 4, 1, 2), (6, 8, 1, 2), (8, 10, 2, 2), (8, 10, 2, 4), (12, 16, 2, 4), (12, 16, 3, 6), (16, 20, 3, 6))
    chosen = [_density(*shape) for shape in (*shapes, (20, 24, 3, 8))]
    return chosen[:3] if quick else chosen


def _density(between: int, along: int, through: int, across: int) -> MeshDensity:
    return MeshDensity(
        between_ribs=between,
        through_band=through,
        along_rib=along,
        through_rib=through,
        tip=through,
        across_width=across,
    )


def grow_vertices(quick: bool, *, solid: bool = False) -> Growth:
    """Measures a step of the full solver, its shares, and SuperLU on the same matrix, over the mesh's vertices."""
    rows = [_measure_density(density) for density in list_densities(quick, solid=solid)]
    sizes = [row.pop("vertices") for row in rows]
    whole = {"a step of the full solver", "SuperLU on its matrix"}
    curves = [
        Curve(name=name, sizes=sizes, seconds=[row[name] for row in rows], detail=name not in whole) for name in rows[0]
    ]
    how = "refined in all directions" if solid else "refined along bands and ribs"
    return Growth(name=f"vertices, {how}", unit="vertices", curves=curves)


def _measure_density(density: MeshDensity) -> dict[str, float]:
    """Returns the number of vertices and the median times [s] on one mesh."""
    jaw = mesh_jaw(bench_finger(), density)
    press = record_press(next(case for case in load_cases() if case.name == "Ø25 middle"), jaw)
    start = int(np.argmax(np.linalg.norm(press.force, axis=1) > 0.0)) - _TARE_FRAMES - 1
    settings = EstimatorSettings(solver="solid", tare_frames=_TARE_FRAMES)
    estimator = JawEstimator(jaw, settings=settings)
    step = time_steps(estimator, press.observations[start : start + 3 * _TARE_FRAMES], press.heights[0])
    model = estimator.mechanics.model
    assert isinstance(model, SolidModel)
    tangent = model.linearize(np.zeros(model.size)).tangent
    factor, loads = model.factorise(tangent), np.random.default_rng(0).standard_normal((model.size, 4))
    matrix = model.sparse_tangent(tangent)
    count = int(np.clip(0.3 / max(step, 1e-4), 3, 30))
    return {
        "vertices": len(estimator.mechanics.mesh.nodes),
        "a step of the full solver": step,
        "SuperLU on its matrix": time_median(lambda: factorise_sparse(matrix), count),
        "assembly": time_median(lambda: model.linearize(np.zeros(model.size)), count),
        "factorisation": time_median(lambda: model.factorise(tangent), count),
        "four right-hand sides": time_median(lambda: factor.solve(loads), count),
    }


def time_median(call: Callable[[], Any], count: int) -> float:
    """Returns the median processor time [s] of so many calls, to which other processes add nothing."""
    return float(np.median(time_calls(call, count, process_time)))


def factorise_sparse(matrix: Any) -> Any:
    """Factorises a symmetric sparse matrix with SuperLU in a fill-reducing order."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def time_steps(estimator: JawEstimator, observations: Sequence[Observation], contact: Contact) -> float:
    """Returns the median processor time [s] of the steps that gave a force; what compiles is compiled before.

    Raises:
        FinforceError: No step gave one.
    """
    estimator.warm_up()
    times = []
    for observation in observations:
        begin = process_time()
        solution = estimator.update(observation, contact)
        passed = process_time() - begin
        if solution.status == "ok":
            times.append(passed)
    if not times:
        raise FinforceError(f"no step gave a force: {solution.message or solution.status}")
    return float(np.median(times))


def grow_keypoints(quick: bool) -> Growth:
    """Measures a step of each kind of solver over the number of key points."""
    curves = []
    for solver in KEYPOINT_SOLVERS:
        if solver in SOLVERS:
            sizes = KEYPOINTS[:3] if quick else KEYPOINTS
            seconds = [_measure_keypoints(solver, count) for count in sizes]
            curves.append(Curve(name=f"a step, {solver}", sizes=sizes, seconds=seconds))
    return Growth(name="key points", unit="key points", curves=curves)


def _measure_keypoints(solver: str, count: int) -> float:
    """Returns the median time [s] of a step with so many key points, whose history is that of the solid."""
    jaw = spread_keypoints(bench_finger(), count)
    settings = EstimatorSettings(solver=solver, tare_frames=_TARE_FRAMES)
    history = _press_keypoints(jaw)
    observations = [
        Observation(stamp=PERIOD * index, points=points, likelihood=np.ones(count))
        for index, points in enumerate(history)
    ]
    return time_steps(JawEstimator(jaw, settings=settings), observations, Contact.fixed(jaw, _HEIGHT))


def spread_keypoints(jaw: Jaw, count: int) -> Jaw:
    """Returns a jaw with so many key points, spread over its side face from the clamp to the tip."""
    nodes = jaw.build_mesh("default").nodes
    side = nodes[np.isclose(nodes[:, 1], nodes[:, 1].max()) & (nodes[:, 2] > 0.005)]
    side = side[np.argsort(side[:, 2], kind="stable")]
    chosen = side[np.linspace(0, len(side) - 1, count).round().astype(int)]
    return replace(jaw, keypoints=chosen, keypoint_names=tuple(f"point_{index}" for index in range(count)))


def _press_keypoints(jaw: Jaw) -> NDArray:
    """Returns key points (n, K, 3) [m] of the solid: at rest for the tare, then pressed to 3 mm."""
    mechanics = build_mechanics(jaw, EstimatorSettings(solver="solid"))
    probe = mechanics.model.attach(jaw.keypoints, KEYPOINT_DISTANCE)
    depths = np.linspace(0.0, 0.003, 41)[1:]
    presses = press_jaw(
        mechanics.model, mechanics.contact.surface, jaw.inner_face_x, RigidCylinder(radius=_RADIUS), _HEIGHT, depths
    )
    pressed = [mechanics.model.positions(probe, press.q) for press in presses]
    rest = mechanics.model.positions(probe, np.zeros(mechanics.model.size))
    return np.array([rest] * (_TARE_FRAMES + 2) + pressed)


def grow_candidates(quick: bool) -> Growth:
    """Measures a jaw linearised with a force at each candidate, their program, and a step with rows of one contact."""
    sizes = CANDIDATES[:4] if quick else CANDIDATES
    jaw = bench_finger()
    history = _press_keypoints(jaw)
    rows = [{**_measure_program(jaw, count), **_measure_rows(jaw, history, count)} for count in sizes]
    curves = [Curve(name=name, sizes=sizes, seconds=[row[name] for row in rows]) for name in rows[0]]
    return Growth(name="contact candidates", unit="candidates", curves=curves)


def _candidate_points(jaw: Jaw, count: int) -> NDArray:
    """Returns so many places on the inner surface (n, 3) [m]; one stands in the middle."""
    heights = np.linspace(0.008, 0.072, count) if count > 1 else np.array([_HEIGHT])
    return np.stack([np.full(count, jaw.inner_face_x), np.zeros(count), heights], axis=1)


def _measure_program(jaw: Jaw, count: int) -> dict[str, float]:
    """Returns the median times [s] of linearising the jaw with a force at each place, and of the program alone.

    The program's matrix is W_ea' W_ea with a share of its size on the diagonal: so many neighbouring forces cannot be
    told apart by key points, which `solve_inverse` refuses.
    """
    model, points = build_mechanics(jaw, EstimatorSettings(solver="solid")).model, _candidate_points(jaw, count)
    effectors = model.attach(jaw.keypoints, KEYPOINT_DISTANCE)
    contacts, rest = model.attach(points, 1e-3), np.zeros(model.size)
    moved = _linearise(model, effectors, contacts, rest).reshape(-1, count)
    hessian = moved.T @ moved
    hessian += _REGULARISED * np.abs(hessian).sum(1).max() * np.eye(count)
    gradient, lower = -moved.sum(0), np.zeros(count)
    return {
        "a force at each, linearised": time_median(lambda: _linearise(model, effectors, contacts, rest), 15),
        "their quadratic program": time_median(lambda: solve_program(hessian, gradient, lower), 50),
    }


def _linearise(model: JawModel, effectors: Any, contacts: Any, q: NDArray) -> NDArray:
    """Returns the key points' motions (K, 3, n) [m/N] for a unit force along -x at each of n contacts."""
    count = len(contacts.points)
    forces = np.zeros((count, count, 3))
    forces[np.arange(count), np.arange(count), 0] = -1.0
    loads = np.stack([model.load(contacts, q, force) for force in forces], axis=1)
    return model.project(effectors, q, model.factorise(model.linearize(q).tangent).solve(loads))


def _measure_rows(jaw: Jaw, history: NDArray, count: int) -> dict[str, float]:
    """Returns the median time [s] of an estimator's step with rows of one contact, given with weights."""
    points = _candidate_points(jaw, count)
    near = 0.005 / max(1, count - 1) * np.arange(count) - 0.0025 * (count > 1)
    points[:, 2] = _HEIGHT + near
    contact = Contact(points=points, weights=np.full(count, 1.0 / count))
    observations = [
        Observation(stamp=PERIOD * index, points=shape, likelihood=np.ones(len(shape)))
        for index, shape in enumerate(history)
    ]
    estimator = JawEstimator(jaw, settings=EstimatorSettings(solver="solid", tare_frames=_TARE_FRAMES))
    return {"rows of one contact, one step": time_steps(estimator, observations, contact)}


# 20 * 4^n triangles: 80 to 1.3 million.
SUBDIVISIONS = tuple(range(1, 9))
_SPHERE_RADIUS = 0.02
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
    sphere = import_trimesh().creation.icosphere(subdivisions=level, radius=_SPHERE_RADIUS)
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
    for index, T in enumerate(_poses(estimator.face.front, count + 2, tipped)):
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
        T[:3, 3] = [face_x + _SPHERE_RADIUS - 1e-3, 0.0, 0.04] + _JITTER * random.standard_normal(3)
        yield T
