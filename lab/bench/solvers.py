"""Run time against force error of every solver tier: nine presses of an independent program, one thread, one run.

data/pressed_bench.npz holds key points [mm] and forces [N] of CalculiX 2.20 (20-node hexahedra, large displacements,
frictionless contact, St. Venant-Kirchhoff, 30 MPa, 0.45) for nine cylinders at depths of 1 to 10 mm. Noise, gross
errors, holes and points behind the object are those of the bench recordings' measurement model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from gc import collect, disable, enable
from pathlib import Path
from time import perf_counter, thread_time
from timeit import repeat
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from finforce.errors import FinforceError
from finforce_eval.evaluation.scoring import rms
from finforce_eval.tasks import progress_bar
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.observation import Contact, ObjectOutline, Observation
from finforce_ifea.settings import SOLVERS, EstimatorSettings
from lab.harness import Figures, percentiles
from lab.presses import PressHistory, circle

TRUTH = Path(__file__).parents[1] / "data" / "pressed_bench.npz"
YOUNG_MODULUS = 30e6  # [Pa]
POISSON_RATIO = 0.45
HEIGHTS = {"lower": 0.020, "middle": 0.040, "upper": 0.060}
QUICK_RADIUS = 0.0125  # of the three cases that do where time is short [m]
LEVELS = (0.002, 0.004, 0.006, 0.008, 0.010)
PERIOD = 1.0 / 30.0
REST_FRAMES = 60
HOLD_FRAMES = 45
SCORED_FRAMES = 30
SPEED = 2e-3
# Constant errors of a tracked object's origin [m] and turn [rad], as the contact estimator expects them.
_POSE_ERROR = np.array([0.5e-3, 0.5e-3, 5e-3])


@dataclass(frozen=True, kw_only=True, eq=False)
class ReplayedPress:
    """One case as a sequence of images.

    Attributes:
        case: object and height of the press.
        observations: n images.
        contacts: image by image, with the "height" of first touch and with the object's "outline".
        force: true forces on the jaw (n, 3) [N].
        held: images in the last second of a level (n,) bool.
    """

    case: PressHistory
    observations: Sequence[Observation]
    contacts: Mapping[str, Sequence[Contact]]
    force: NDArray
    held: NDArray

    @property
    def ends(self) -> NDArray:
        """The last image of each level (levels,)."""
        return np.flatnonzero(self.held & ~np.append(self.held[1:], False))


def load_cases(path: Path | str = TRUTH) -> tuple[PressHistory, ...]:
    """Return the nine cases."""
    data, rest, cases = np.load(path), bench_finger().keypoints, []
    for key in sorted(name.removesuffix("_depth") for name in data if name.endswith("_depth")):
        diameter, height = key.split("_")
        depths = 1e-3 * np.r_[0.0, data[f"{key}_depth"].astype(float)]
        moved = 1e-3 * (data[f"{key}_keypoints"].astype(float) - data["keypoints0"])
        cases.append(
            PressHistory(
                radius=5e-4 * float(diameter),
                height=HEIGHTS[height],
                depth=float(depths[-1]),
                keypoints=PchipInterpolator(depths, rest + np.concatenate([np.zeros_like(moved[:1]), moved])),
                forces=PchipInterpolator(depths, np.concatenate([np.zeros((1, 3)), data[f"{key}_force"]])),
            )
        )
    return tuple(cases)


def bench_finger() -> Jaw:
    """Return the bench jaw with the material of the truth."""
    jaw = load_jaw("bench")
    return replace(jaw, material=Material(young_modulus=YOUNG_MODULUS, poisson_ratio=POISSON_RATIO))


def record_press(case: PressHistory, jaw: Jaw, camera: NoisyCamera | None = None, seed: int = 0) -> ReplayedPress:
    """Return a press to all levels at 2 mm/s, each held for 1.5 s, after two seconds at rest.

    Args:
        case: object and height of the press.
        jaw: the finger, whose key points are those of the truth.
        camera: makes noise and hides points; None sees everything exactly.
        seed: of the noise.
    """
    depth, held = _build_motion()
    points, force = case.keypoints(depth), case.forces(depth)
    axes = np.stack([jaw.inner_face_x + case.radius - depth, np.full(len(depth), case.height)], axis=1)
    random = np.random.default_rng([seed, round(1e4 * case.radius), round(1e3 * case.height)])
    likelihood = np.ones(points.shape[:2])
    if camera is not None:
        points, likelihood = camera.observe(points, axes, case.radius, random)
    contact = Contact.fixed(jaw, case.height)
    outlines = _outlines(contact, axes, case.radius, 0.0 if camera is None else random.standard_normal(3))
    return ReplayedPress(
        case=case,
        observations=[
            Observation(stamp=1.0 + PERIOD * index, points=points[index], likelihood=likelihood[index])
            for index in range(len(depth))
        ],
        contacts={"height": [contact] * len(depth), "outline": outlines},
        force=force,
        held=held,
    )


def _build_motion() -> tuple[NDArray, NDArray]:
    """Return depths (n,) [m]: rest, then ramps to the levels, and holds; and in which images a level is held (n,)."""
    parts, held = [np.zeros(REST_FRAMES)], [np.zeros(REST_FRAMES, bool)]
    for level in LEVELS:
        steps = max(round((level - parts[-1][-1]) / SPEED / PERIOD), 1)
        parts += [np.linspace(parts[-1][-1], level, steps + 1)[1:], np.full(HOLD_FRAMES, level)]
        held.append(np.arange(-steps, HOLD_FRAMES) >= HOLD_FRAMES - SCORED_FRAMES)
    return np.concatenate(parts), np.concatenate(held)


def _outlines(contact: Contact, axes: NDArray, radius: float, error: NDArray | float) -> list[Contact]:
    """Return the contact with a round outline at axes (n, 2) [m], its pose off by `error` standard deviations (3,)."""
    polygons, wrong = (circle(radius),), _POSE_ERROR * error
    return [
        replace(
            contact,
            free=False,
            outline=ObjectOutline(polygons=polygons, origin=axis + wrong[:2], tilt=float(wrong[2]), stddev=_POSE_ERROR),
        )
        for axis in axes
    ]


# Half the length of the pressed cylinders [m].
_HALF_LENGTH = 0.03
_SEEN_LIKELIHOOD, _HIDDEN_LIKELIHOOD = (0.6, 1.0), (0.02, 0.55)


@dataclass(frozen=True, kw_only=True)
class NoisyCamera:
    """A fixed RGB-D camera next to the finger.

    Attributes:
        position: in the jaw frame [m].
        noise: standard deviation of a point in every direction [m].
        depth_noise: the same along its line of sight, in addition [m].
        offset: constant error of each point of a recording [m].
        depth_scale: constant relative error of the depth.
        gross: share of points that are somewhere else and keep a high likelihood.
        gross_size: standard deviation of a gross error along each axis [m].
        holes: share of points without depth.
        hidden_trusted: share of hidden points whose likelihood is high.
    """

    position: tuple[float, float, float] = (0.055, 0.095, -0.045)
    noise: float = 0.20e-3
    depth_noise: float = 0.45e-3
    offset: float = 0.35e-3
    depth_scale: float = 0.005
    gross: float = 0.01
    gross_size: float = 0.025
    holes: float = 0.01
    hidden_trusted: float = 0.05

    def observe(
        self, points: NDArray, axes: NDArray, radius: float, random: np.random.Generator
    ) -> tuple[NDArray, NDArray]:
        """Return key points (n, K, 3) [m] next to a cylinder as seen, NaN without depth, and likelihoods (n, K).

        Args:
            points: true key points, jaw frame.
            axes: x and z of the cylinder's axis (n, 2) [m].
            radius: of the cylinder [m].
            random: where all chance comes from.
        """
        shape = points.shape[:2]
        reach = self._find_cover(points, axes, radius)
        hidden = np.isfinite(reach)
        rays = points - self.position
        seen = np.where(hidden[..., None], self.position + np.where(hidden, reach, 1.0)[..., None] * rays, points)
        sight = rays / np.linalg.norm(rays, axis=2, keepdims=True)
        constant = self.offset / np.sqrt(3.0) * random.standard_normal(points.shape[1:])
        scale = 1.0 + self.depth_scale * random.standard_normal()
        seen = self.position + scale * (seen - self.position) + constant
        seen = seen + self.noise * random.standard_normal(points.shape)
        seen += self.depth_noise * random.standard_normal((*shape, 1)) * sight
        gross = random.random(shape) < self.gross
        seen += np.where(gross[..., None], self.gross_size * random.standard_normal(points.shape), 0.0)
        seen[random.random(shape) < self.holes] = np.nan
        doubted = hidden & (random.random(shape) >= self.hidden_trusted)
        likelihood = np.where(
            doubted, random.uniform(*_HIDDEN_LIKELIHOOD, shape), random.uniform(*_SEEN_LIKELIHOOD, shape)
        )
        return seen, likelihood

    def _find_cover(self, points: NDArray, axes: NDArray, radius: float) -> NDArray:
        """Return which share of the way to each point (n, K) a cylinder lets the sight go; NaN when all of it."""
        ray = points - self.position
        start = np.array(self.position)[[0, 2]] - axes[:, None]
        a = (ray[..., [0, 2]] ** 2).sum(-1)
        b = (start * ray[..., [0, 2]]).sum(-1)
        inside = b**2 - a * ((start**2).sum(-1) - radius**2)
        wall = (-b - np.sqrt(np.maximum(inside, 0.0))) / a
        on_wall = (inside > 0.0) & (wall > 0.0) & (wall < 1.0)
        on_wall &= np.abs(self.position[1] + wall * ray[..., 1]) < _HALF_LENGTH
        end = (_HALF_LENGTH - self.position[1]) / ray[..., 1]
        met = start + end[..., None] * ray[..., [0, 2]]
        on_end = (end > 0.0) & (end < 1.0) & ((met**2).sum(-1) < radius**2)
        return np.where(on_end, end, np.where(on_wall, wall, np.nan))


SEED = 1
FACTORISATIONS = 20
WARM_UP_FRAMES = 150
# Every tier that tells what it does not know leaves a few deep presses next to the base unanswered; a tier that leaves
# more than this share is not compared [%].
LEAST_ANSWERED = 90.0
# Quoted: SOFA v25.06 with SoftRobots.Inverse on the same 522 vertices and 45 shapes, and its yardstick.
SOFA = {"step_ms": 3.9, "yardstick_ms": 3.0, "rmse_N": 20.9, "factor_per_height_N": 0.74}


@dataclass(frozen=True, kw_only=True)
class Tier:
    """One way to solve.

    Attributes:
        name: for tables.
        solver: `EstimatorSettings.solver`.
        mesh: `EstimatorSettings.mesh`.
        contact: known property of the object: its "height" of first touch, or its "outline".
        slow: True if it sees noisy key points alone, and is left out where time is short.
    """

    name: str
    solver: str
    mesh: str = "default"
    contact: str = "height"
    slow: bool = False

    def settings(self) -> EstimatorSettings:
        """Return the estimator's settings; raises ObservationError where there is no such solver."""
        return EstimatorSettings(solver=self.solver, mesh=self.mesh)


PAPER = "paper's setting"
TIERS = (
    Tier(name="reduced", solver="reduced"),
    Tier(name="frame", solver="frame"),
    Tier(name="solid, 522 vertices", solver="solid", mesh="coarse"),
    Tier(name="solid, default mesh", solver="solid"),
    Tier(name="solid, fine mesh", solver="solid", mesh="fine", slow=True),
    Tier(name=PAPER, solver="paper"),
    Tier(name="reduced, outline known", solver="reduced", contact="outline"),
    Tier(name="frame, outline known", solver="frame", contact="outline"),
    Tier(name="solid, default mesh, outline known", solver="solid", contact="outline"),
)


def list_tiers(*, slow: bool = True) -> tuple[Tier, ...]:
    """Return the tiers, those that take long too if `slow`, with one for each solver that the list does not name."""
    named = {tier.solver for tier in TIERS} | {"default", "plane"}  # the plane is for fingers without a drawing
    others = tuple(Tier(name=name, solver=name) for name in SOLVERS if name not in named)
    return tuple(tier for tier in TIERS + others if slow or not tier.slow)


def measure(quick: bool) -> Figures:
    """Return times and errors of every tier.

    Args:
        quick: three cases instead of nine, and no slow tier.
    """
    finger, tiers = bench_finger(), list_tiers(slow=not quick)
    cases = [case for case in load_cases() if case.radius == QUICK_RADIUS or not quick]
    presses = {
        "noise-free": [record_press(case, finger) for case in cases],
        "noisy": [record_press(case, finger, NoisyCamera(), SEED) for case in cases],
    }
    rows, shapes, notes = [], [], []
    with progress_bar(sum(1 if tier.slow else 2 for tier in tiers) * len(cases), "press") as bar:
        for tier in tiers:
            bar.set_description(tier.name)
            try:
                yardstick = time_factorisation()
                kinds = ["noisy"] if tier.slow else presses
                runs = {kind: run_tier(tier, finger, presses[kind], bar.update) for kind in kinds}
                yardstick = float(np.median(yardstick + time_factorisation()))
            except FinforceError as error:
                notes.append(f"{tier.name}: not measured: {error}")
                continue
            rows += [tier_row(tier, kind, found, yardstick) for kind, found in runs.items()]
            if not tier.slow:
                shapes.append({"tier": tier.name, **score_shapes(runs["noise-free"]), **compare_with_sofa(rows[-1])})
    quoted = {"nothing fitted/N": SOFA["rmse_N"], "a factor per height/N": SOFA["factor_per_height_N"]}
    quoted |= {"shapes": 45, "solved": 45, "rate in SOFA's": 1.0, "by the yardstick": 1.0}
    shapes.append({"tier": "SOFA, quoted", **quoted})
    return Figures(tables={"tiers": pd.DataFrame(rows), "shapes": pd.DataFrame(shapes)}, notes=notes)


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """The answers of a tier to one press.

    Attributes:
        press: that it was given.
        force: (n, 3) [N], NaN where none is trusted.
        seconds: wall time of the steps that gave a force (m,).
        cpu: processor time of the same steps (m,) [s].
    """

    press: ReplayedPress
    force: NDArray
    seconds: NDArray
    cpu: NDArray

    @property
    def errors(self) -> NDArray:
        """Errors of the magnitude (n,) [N]; NaN where there is no estimate."""
        return np.linalg.norm(self.force, axis=1) - np.linalg.norm(self.press.force, axis=1)


def run_tier(
    tier: Tier, jaw: Jaw, presses: Sequence[ReplayedPress], progress: Callable[[], object] = lambda: None
) -> list[Run]:
    """Run one estimator over presses, each from the start; what compiles is compiled before.

    Raises:
        FinforceError: the tier does not exist, or cannot describe the jaw.
    """
    estimator = ForceEstimator(jaw, settings=tier.settings())
    estimator.warm_up()
    _run_press(tier, estimator, presses[0], WARM_UP_FRAMES)
    runs = []
    for press in presses:
        runs.append(_run_press(tier, estimator, press))
        progress()
    return runs


def _run_press(tier: Tier, estimator: ForceEstimator, press: ReplayedPress, frames: int | None = None) -> Run:
    """Return what an estimator that starts anew makes of the first frames of a press."""
    estimator.reset()
    force = np.full(press.force.shape, np.nan)
    seconds, cpu = [], []
    contacts = press.contacts[tier.contact]
    # a collection in the middle of a step is not the step's own time
    collect()
    disable()
    try:
        for index, observation in enumerate(press.observations[:frames]):
            begin, begin_cpu = perf_counter(), thread_time()
            solution = estimator.update(observation, contacts[index])
            passed, used = perf_counter() - begin, thread_time() - begin_cpu
            if solution.trusted:
                force[index] = solution.force
            # an unloaded or unsolved frame may be cheaper: it is not what a user waits for
            if solution.status == "ok":
                seconds.append(passed)
                cpu.append(used)
    finally:
        enable()
    return Run(press=press, force=force, seconds=np.array(seconds), cpu=np.array(cpu))


def tier_row(tier: Tier, kind: str, runs: Sequence[Run], yardstick: float) -> dict[str, Any]:
    """Return times and errors of a tier over its presses.

    Args:
        tier: the way to solve.
        kind: of key points.
        runs: over presses.
        yardstick: processor time of a factorisation of the whole jaw's stiffness matrix, 522 vertices [s].
    """
    held = np.concatenate([run.errors[run.press.held] for run in runs])
    step = percentiles(np.concatenate([run.seconds for run in runs]), "step")
    cpu = percentiles(np.concatenate([run.cpu for run in runs]), "CPU")
    known = held[np.isfinite(held)]
    return {
        "tier": tier.name,
        "key points": kind,
        **{name: value for name, value in step.items() if "p95" not in name},
        **{name: cpu[name] for name in ("CPU p50/ms", "CPU p99/ms")},
        "SuperLU/ms": 1e3 * yardstick,
        "RMSE/N": rms(held),
        "bias/N": float(known.mean()) if known.size else np.nan,
        "largest/N": float(np.abs(known).max()) if known.size else np.nan,
        "answered/%": 100.0 * known.size / held.size,
        "a factor per height/N": score_shapes(runs)["a factor per height/N"],
    }


def score_shapes(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the errors at the end of each level of noise-free runs, one number per shape.

    Two of them are after fitting: nothing, and the best factor on the estimates for each height.
    """
    estimated = np.concatenate([np.linalg.norm(run.force[run.press.ends], axis=1) for run in runs])
    true = np.concatenate([np.linalg.norm(run.press.force[run.press.ends], axis=1) for run in runs])
    heights = np.concatenate([[run.press.case.height] * len(run.press.ends) for run in runs])
    factors = {height: _best_factor(estimated[heights == height], true[heights == height]) for height in set(heights)}
    scaled = estimated * np.array([factors[height] for height in heights])
    return {
        "shapes": len(true),
        "solved": int(np.isfinite(estimated).sum()),
        "nothing fitted/N": rms(estimated - true),
        "a factor per height/N": rms(scaled - true),
    }


def _best_factor(estimated: NDArray, true: NDArray) -> float:
    """Return the factor on the estimates with the least squared error."""
    known = np.isfinite(estimated)
    return float(true[known] @ estimated[known] / max(estimated[known] @ estimated[known], 1e-300))


def time_factorisation() -> list[float]:
    """Return the processor times [s] of a SuperLU factorisation of the whole jaw's stiffness matrix."""
    from scipy.sparse.linalg import splu

    jaw = load_jaw("bench")
    model = SolidModel(jaw.build_mesh("coarse"), jaw.material, symmetric=False)
    stiffness = model.sparse_tangent(model.linearize(np.zeros(model.size)).tangent).tocsc()
    options = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    return repeat(lambda: splu(stiffness, **options), timer=thread_time, repeat=FACTORISATIONS, number=1)


def compare_with_sofa(row: dict[str, Any]) -> dict[str, float]:
    """Return the rate of a tier in SOFA's, as measured and with SOFA's step scaled to this machine by the yardstick."""
    scaled = SOFA["step_ms"] * row["SuperLU/ms"] / SOFA["yardstick_ms"]
    return {"rate in SOFA's": SOFA["step_ms"] / row["step p50/ms"], "by the yardstick": scaled / row["CPU p50/ms"]}


def find_front(tiers: pd.DataFrame) -> pd.DataFrame:
    """Return the tiers that answer and have none both as fast and better beside them; the fastest first."""
    known = tiers[tiers["answered/%"] >= LEAST_ANSWERED].sort_values(["step p50/ms", "RMSE/N"])
    return known[known["RMSE/N"] < known["RMSE/N"].cummin().shift(fill_value=np.inf)]


def draw_tiers(tiers: pd.DataFrame, path: Path) -> None:
    """Draw time against error with noise, and the front; hollow tiers leave more than a tenth without an answer.

    The paper's setting stands there twice: with one ε, and as the paper tunes it, which a factor per height equals.
    """
    from finforce_eval.figures.figures import new_figure, style_axes

    figure, tiers = new_figure(9.5, 5.2), tiers[tiers["key points"] == "noisy"]
    axes, front = figure.subplots(), find_front(tiers)
    style_axes(axes)
    axes.step(front["step p50/ms"], front["RMSE/N"], where="post", color="0.8", linewidth=5, zorder=0)
    for tier in tiers.to_dict("records"):
        place, answers = (tier["step p50/ms"], tier["RMSE/N"]), tier["answered/%"] >= LEAST_ANSWERED
        axes.plot(*place, "o", color="tab:blue", fillstyle="full" if answers else "none")
        axes.annotate(tier["tier"], place, xytext=(6, 3), textcoords="offset points", fontsize=8)
        if tier["tier"] == PAPER:
            tuned = tier["step p50/ms"], tier["a factor per height/N"]
            axes.plot(*tuned, "o", color="tab:orange")
            axes.annotate(
                f"{PAPER}, ε tuned per height", tuned, xytext=(6, -11), textcoords="offset points", fontsize=8
            )
    axes.set(xscale="log", yscale="log", xlabel="Time of a step (median) [ms]", ylabel="RMSE of the force [N]")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set(major_formatter="{x:g}", minor_formatter=lambda x, _: f"{x:g}" if f"{x:e}"[0] in "235" else "")
    figure.savefig(path)
