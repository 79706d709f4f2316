"""Verifies the mechanics of the bench finger against an independent program; writes docs/verification.md.

    python benchmarks/verify.py [--json report/verification.json] [--markdown docs/verification.md]

The truth (test/data) was computed with CalculiX: 20-node hexahedra, large displacements, frictionless contact.
"""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm
from verification_page import ForwardCase, InverseCase, format_page

from finforce_ifea.contact_mechanics.forward_press import RigidCylinder, press_jaw
from finforce_ifea.errors import ContactError
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.jaw.calibration import Calibration, load_calibration
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw, load_jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.settings import EstimatorSettings

ROOT = Path(__file__).resolve().parents[1]
LINEAR = ROOT / "test" / "data" / "pressed_bench.npz"
MOONEY = ROOT / "test" / "data" / "pressed_bench_mooney.npz"
HEIGHTS = {"lower": 0.020, "middle": 0.040, "upper": 0.060}
YOUNG_MODULUS, POISSON_RATIO = 30e6, 0.45  # of the St. Venant-Kirchhoff truth
PERIOD = 1.0 / 30.0
REST_FRAMES, RAMP_FRAMES, HOLD_FRAMES = 60, 15, 45


@dataclass(frozen=True, kw_only=True)
class TruePress:
    """One pressed finger: depths (n,) [m], forces (n,) [N], key point displacements (n, K, 3) [m]."""

    name: str
    height: str
    radius: float
    depth: NDArray
    force: NDArray
    moved: NDArray


@dataclass(frozen=True, kw_only=True)
class Model:
    """One way to describe the finger; `calibration` lends its thicknesses and its clamp, never its modulus."""

    title: str
    solver: str
    mesh: str = "default"
    calibration: str = ""


MODELS = (
    Model(title="solid, default mesh", solver="solid"),
    Model(title="solid, 522 vertices", solver="solid", mesh="coarse"),
    Model(title="solid, fine mesh", solver="solid", mesh="fine"),
    Model(title="frame", solver="frame"),
    Model(title="linear tetrahedra, 522 vertices", solver="paper", mesh="coarse"),
    Model(
        title="solid, default mesh, with thicknesses and clamp of the calibration", solver="solid", calibration="bench"
    ),
)
INVERSE_MODELS = (
    Model(title="--solver reduced", solver="reduced"),
    MODELS[0],
    MODELS[3],
    Model(title="--solver paper", solver="paper"),
)


def load_truth(path: Path) -> list[TruePress]:
    """Returns the cases of an extract: lengths in it are in millimetres, forces in newtons."""
    data = np.load(path)
    cases = []
    for key in sorted(name.removesuffix("_depth") for name in data if name.endswith("_depth")):
        diameter, height = key.split("_")
        moved = 1e-3 * (data[f"{key}_keypoints"].astype(float) - data["keypoints0"])
        force = np.linalg.norm(data[f"{key}_force"].astype(float), axis=1)
        depth = 1e-3 * data[f"{key}_depth"].astype(float)
        name = f"Ø{diameter} {height}"
        cases.append(
            TruePress(name=name, height=height, radius=5e-4 * float(diameter), depth=depth, force=force, moved=moved)
        )
    return cases


def finger(model: Model) -> Jaw:
    """Returns the bench finger of the linear truth as a model sees it."""
    jaw = load_jaw("bench")
    if model.calibration:
        jaw = load_calibration(model.calibration).apply(jaw)
    return replace(jaw, material=replace(jaw.material, young_modulus=YOUNG_MODULUS, poisson_ratio=POISSON_RATIO))


def press_model(model: Model, cases: Sequence[TruePress], progress: Callable[[], object]) -> list[ForwardCase]:
    """Returns the errors of a model pressed as the truth was."""
    jaw = finger(model)
    mechanics = build_mechanics(jaw, EstimatorSettings(solver=model.solver, mesh=model.mesh))
    probe = mechanics.model.attach(jaw.keypoints, KEYPOINT_DISTANCE)
    rest = mechanics.model.positions(probe, np.zeros(mechanics.model.size))
    results = []
    for truth in cases:
        presses = _press_as_deep_as_it_goes(mechanics, jaw.inner_face_x, truth)
        force = np.array([np.linalg.norm(press.force) for press in presses]) / truth.force[: len(presses)] - 1.0
        moved = np.stack([mechanics.model.positions(probe, press.q) - rest for press in presses])
        miss = np.linalg.norm(moved - truth.moved[: len(presses)], axis=2).max(1)
        depth = tuple((1e3 * truth.depth[: len(presses)]).round(3).tolist())
        turn = tuple(_turn(jaw, truth.height, shape) for shape in (moved[-1], truth.moved[len(presses) - 1]))
        results.append(
            ForwardCase(
                case=truth.name, height=truth.height, depth_mm=depth, force=tuple(force.tolist()),
                keypoints=tuple(miss.tolist()), turn=turn,
            )
        )  # fmt: skip
        progress()
    return results


def _turn(jaw: Jaw, height: str, moved: NDArray) -> float:
    """Returns the turn of the finger above the contact towards the object [rad], from displacements (K, 3) [m]."""
    names = jaw.keypoint_names
    above = [k for k, name in enumerate(names) if name.startswith("inner") and jaw.keypoints[k, 2] > HEIGHTS[height]]
    ends = [above[0], names.index("tip")]
    rest, now = np.diff(jaw.keypoints[ends], axis=0)[0], np.diff((jaw.keypoints + moved)[ends], axis=0)[0]
    return float(np.arctan2(now[0], now[2]) - np.arctan2(rest[0], rest[2]))


def _press_as_deep_as_it_goes(mechanics, face_x: float, truth: TruePress):
    """Returns the equilibria up to the depth at which the model buckles."""
    for count in range(len(truth.depth), 0, -1):
        try:
            return press_jaw(
                mechanics.model, mechanics.contact.surface, face_x, RigidCylinder(radius=truth.radius),
                HEIGHTS[truth.height], truth.depth[:count],
            )  # fmt: skip
        except ContactError:
            continue
    raise ContactError(f"{truth.name}: no equilibrium at any depth")


def invert_model(model: Model, cases: Sequence[TruePress], progress: Callable[[], object]) -> list[InverseCase]:
    """Returns the forces that an estimator finds in noise-free shapes, its relaxation switched off."""
    calibration = replace(load_calibration("bench"), relaxation=(), solver="")
    settings = EstimatorSettings(solver=model.solver, mesh=model.mesh)
    results = []
    for truth in cases:
        levels = np.flatnonzero(np.isin((1e3 * truth.depth).round(), (2, 4, 6, 8, 10)))
        found = _hold_levels(settings, calibration, truth, levels)
        results.append(
            InverseCase(
                case=truth.name, height=truth.height, true=tuple(truth.force[levels].tolist()), estimated=tuple(found)
            )
        )
        progress()
    return results


def _hold_levels(
    settings: EstimatorSettings, calibration: Calibration, truth: TruePress, levels: NDArray
) -> list[float]:
    """Returns the forces [N] at the end of each held level; between levels the shapes are interpolated."""
    jaw = load_jaw("bench")
    estimator = JawEstimator(jaw, settings=settings, calibration=calibration)
    contact = Contact.fixed(jaw, HEIGHTS[truth.height])
    depths = np.r_[0.0, truth.depth]
    shapes = np.concatenate([np.zeros((1, *jaw.keypoints.shape)), truth.moved])
    course = [np.zeros(REST_FRAMES)]
    for level in levels:
        ramp = int(RAMP_FRAMES * 1e3 * (truth.depth[level] - course[-1][-1]))
        course += [np.linspace(course[-1][-1], truth.depth[level], ramp), np.full(HOLD_FRAMES, truth.depth[level])]
    ends = np.cumsum([len(part) for part in course])[2::2] - 1
    forces = []
    for number, depth in enumerate(np.concatenate(course)):
        low = min(int(np.searchsorted(depths, depth, side="right")) - 1, len(depths) - 2)
        share = (depth - depths[low]) / (depths[low + 1] - depths[low])
        points = jaw.keypoints + (1.0 - share) * shapes[low] + share * shapes[low + 1]
        observation = Observation(stamp=1.0 + number * PERIOD, points=points, likelihood=np.ones(len(points)))
        solution = estimator.update(observation, contact)
        if number in ends:
            forces.append(float(np.linalg.norm(solution.force)) if solution.trusted else float("nan"))
    return forces


def main() -> None:
    """Presses, inverts, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", default=str(ROOT / "report" / "verification.json"), metavar="OUT")
    parser.add_argument("--markdown", default=str(ROOT / "docs" / "verification.md"), metavar="OUT")
    options = parser.parse_args()
    linear, mooney = load_truth(LINEAR), load_truth(MOONEY)
    total = len(MODELS) * len(linear) + len(INVERSE_MODELS) * len(mooney)
    forward, inverse = {}, {}
    with tqdm(total=total, unit="case", disable=None, leave=False) as bar:
        for model in MODELS:
            bar.set_description(model.title)
            forward[model.title] = press_model(model, linear, bar.update)
        for model in INVERSE_MODELS:
            bar.set_description(f"inverse, {model.title}")
            inverse[model.title] = invert_model(model, mooney, bar.update)
    page = format_page(forward, inverse)
    print(page)
    Path(options.markdown).write_text(page, encoding="utf-8")
    Path(options.json).parent.mkdir(parents=True, exist_ok=True)
    content = {"forward": _plain(forward), "inverse": _plain(inverse)}
    Path(options.json).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _plain(results: Mapping[str, Sequence[ForwardCase | InverseCase]]) -> dict:
    return {title: [asdict(case) for case in cases] for title, cases in results.items()}


if __name__ == "__main__":
    main()
