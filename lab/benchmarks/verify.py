"""Verifies the mechanics of the bench finger against an independent program.

    python -m lab.benchmarks.verify [--json report/verification.json]

The finger is pressed on cylinders as the truth was (CalculiX: 20-node hexahedra, large displacements, frictionless
contact, St. Venant-Kirchhoff with E = 30 MPa and nu = 0.45, which the models get as they are): nothing is fitted.
`tools/fill_pages.py` puts the tables into docs/verification.md.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce_eval.evaluation.tables import align_rows
from finforce_eval.machine import write_figures
from finforce_ifea.contact_mechanics.forward_press import RigidCylinder, press_jaw
from finforce_ifea.errors import ContactError
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw, load_jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings
from lab.bench.cases import HEIGHTS, TRUTH

ROOT = Path(__file__).resolve().parents[2]
YOUNG_MODULUS, POISSON_RATIO = 30e6, 0.45  # of the truth
SHOWN = (2, 5, 10)  # [mm]


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
    Model(title="solid, thicknesses and clamp of the calibration", solver="solid", calibration="bench"),
)


@dataclass(frozen=True, kw_only=True)
class ForwardCase:
    """One case of one model, depth by depth.

    Attributes:
        case: its name.
        height: "lower", "middle" or "upper".
        depth_mm: depths that the model reached [mm].
        force: relative errors of the force.
        keypoints_mm: largest errors of a key point [mm].
        turn_mrad: of the finger above the contact towards the object at the last depth, model's and truth's [mrad].
    """

    case: str
    height: str
    depth_mm: tuple[float, ...]
    force: tuple[float, ...]
    keypoints_mm: tuple[float, ...]
    turn_mrad: tuple[float, float]


def load_truth(path: Path) -> list[TruePress]:
    """Returns the cases of an extract: lengths in it are in millimetres, forces in newtons."""
    data = np.load(path)
    cases = []
    for key in sorted(name.removesuffix("_depth") for name in data if name.endswith("_depth")):
        diameter, height = key.split("_")
        cases.append(
            TruePress(
                name=f"Ø{diameter} {height}",
                height=height,
                radius=5e-4 * float(diameter),
                depth=1e-3 * data[f"{key}_depth"].astype(float),
                force=np.linalg.norm(data[f"{key}_force"].astype(float), axis=1),
                moved=1e-3 * (data[f"{key}_keypoints"].astype(float) - data["keypoints0"]),
            )
        )
    return cases


def press_model(model: Model, cases: Sequence[TruePress], progress: Callable[[], object]) -> list[ForwardCase]:
    """Returns the errors of a model pressed as the truth was."""
    jaw = load_calibration(model.calibration).apply(load_jaw("bench")) if model.calibration else load_jaw("bench")
    jaw = replace(jaw, material=replace(jaw.material, young_modulus=YOUNG_MODULUS, poisson_ratio=POISSON_RATIO))
    mechanics = build_mechanics(jaw, EstimatorSettings(solver=model.solver, mesh=model.mesh))
    probe = mechanics.model.attach(jaw.keypoints, KEYPOINT_DISTANCE)
    rest = mechanics.model.positions(probe, np.zeros(mechanics.model.size))
    results = []
    for truth in cases:
        presses = _press_as_deep_as_it_goes(mechanics, jaw.inner_face_x, truth)
        count = len(presses)
        moved = np.stack([mechanics.model.positions(probe, press.q) - rest for press in presses])
        forces = np.array([np.linalg.norm(press.force) for press in presses])
        results.append(
            ForwardCase(
                case=truth.name,
                height=truth.height,
                depth_mm=tuple((1e3 * truth.depth[:count]).round(3).tolist()),
                force=tuple((forces / truth.force[:count] - 1.0).tolist()),
                keypoints_mm=tuple((1e3 * np.linalg.norm(moved - truth.moved[:count], axis=2).max(1)).tolist()),
                turn_mrad=(_turn(jaw, truth, moved[-1]), _turn(jaw, truth, truth.moved[count - 1])),
            )
        )
        progress()
    return results


def _press_as_deep_as_it_goes(mechanics: Any, face_x: float, truth: TruePress) -> Any:
    """Returns the equilibria up to the depth at which the model buckles."""
    cylinder, height = RigidCylinder(radius=truth.radius), HEIGHTS[truth.height]
    for count in range(len(truth.depth), 0, -1):
        try:
            return press_jaw(mechanics.model, mechanics.contact.surface, face_x, cylinder, height, truth.depth[:count])
        except ContactError:
            continue
    raise ContactError(f"{truth.name}: no equilibrium at any depth")


def _turn(jaw: Jaw, truth: TruePress, moved: NDArray) -> float:
    """Returns the turn of the finger above the contact towards the object [mrad], from displacements (K, 3) [m]."""
    names, height = jaw.keypoint_names, HEIGHTS[truth.height]
    above = [k for k, name in enumerate(names) if name.startswith("inner") and jaw.keypoints[k, 2] > height]
    ends = [above[0], names.index("tip")]
    rest, now = np.diff(jaw.keypoints[ends], axis=0)[0], np.diff((jaw.keypoints + moved)[ends], axis=0)[0]
    return 1e3 * float(np.arctan2(now[0], now[2]) - np.arctan2(rest[0], rest[2]))


def list_tables(forward: dict[str, list[ForwardCase]]) -> dict[str, str]:
    """Returns the tables of the page: a summary by height, each model's cases, and the turn at the lower height."""
    rows = []
    for title, cases in forward.items():
        parts = [cases, *([case for case in cases if case.height == height] for height in HEIGHTS)]
        forces = [f"{max(max(map(abs, case.force)) for case in part):.1%}" for part in parts]
        misses = [f"{max(max(case.keypoints_mm) for case in part):.2f}" for part in parts]
        rows.append([title, *forces, *misses])
    heads = ("all", *HEIGHTS)
    head = ("model", *(f"force, {name}" for name in heads), *(f"key points, {name}, mm" for name in heads))
    tables = {"summary": align_rows(head, rows)}
    for number, cases in enumerate(forward.values(), 1):
        tables[f"model_{number}"] = align_rows(
            ("case", "force, worst", *(f"at {d} mm" for d in SHOWN), "key points, worst, mm", "at 5 mm"),
            [_case_cells(case) for case in cases],
        )
    turns = [
        [column[0].case, f"{column[0].turn_mrad[1]:.1f}", *(f"{case.turn_mrad[0]:.1f}" for case in column)]
        for column in zip(*forward.values(), strict=True)
        if column[0].height == "lower"
    ]
    return {**tables, "turn": align_rows(("turn, mrad", "truth", *forward), turns)}


def _case_cells(case: ForwardCase) -> list[str]:
    force = dict(zip(case.depth_mm, case.force, strict=True))
    points = dict(zip(case.depth_mm, case.keypoints_mm, strict=True))
    shown = [f"{force[d]:+.1%}" if d in force else "buckled" for d in SHOWN]
    at_5 = f"{points[5]:.3f}" if 5 in points else "buckled"
    return [case.case, f"{max(case.force, key=abs):+.1%}", *shown, f"{max(case.keypoints_mm):.3f}", at_5]


def main() -> None:
    """Presses, prints and writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", default=str(ROOT / "report" / "verification.json"), metavar="OUT")
    options = parser.parse_args()
    cases = load_truth(TRUTH)
    forward = {}
    with tqdm(total=len(MODELS) * len(cases), unit="case", disable=None, leave=False) as bar:
        for model in MODELS:
            bar.set_description(model.title)
            forward[model.title] = press_model(model, cases, bar.update)
    tables = list_tables(forward)
    print("\n\n".join(tables.values()))
    write_figures(options.json, {"forward": {k: [asdict(c) for c in v] for k, v in forward.items()}, "tables": tables})


if __name__ == "__main__":
    main()
