"""Mechanics of the bench finger against an independent program, and stiffness of the shipped fingers.

The finger is pressed on cylinders as the truth was (CalculiX: 20-node hexahedra, large displacements, frictionless
contact, St. Venant-Kirchhoff with E = 30 MPa and nu = 0.45, which the models get as they are): nothing is fitted.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm import tqdm

from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.jaw.jaw import Jaw, list_shipped_jaws, load_jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings
from lab.bench.cases import POISSON_RATIO, YOUNG_MODULUS, BenchCase, load_cases
from lab.forward_press import RigidCylinder, follow_points, press_jaw
from lab.harness import Figures

SHOWN = (2, 5, 10)  # [mm] of depth
SHARES = {"a quarter": 0.25, "half": 0.5, "three quarters": 0.75}  # of the inner face, at which stiffness is measured


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


def measure(quick: bool) -> Figures:
    """Return the errors of every model and the stiffness of every shipped finger.

    Args:
        quick: the cylinder of 25 mm on the first model, and the bench finger.
    """
    cases = [case for case in load_cases() if case.name.startswith("Ø25") or not quick]
    rows = [
        {"model": model.title, **row}
        for model in tqdm(MODELS[:1] if quick else MODELS, unit="model", disable=None, leave=False)
        for row in press_model(model, cases)
    ]
    names = ["bench"] if quick else list_shipped_jaws()
    fingers = [describe_finger(name) for name in tqdm(names, unit="finger", disable=None, leave=False)]
    found = pd.DataFrame(rows)
    return Figures(tables={"summary": summarise(found), "cases": found, "fingers": pd.DataFrame(fingers)})


def press_model(chosen: Model, cases: Sequence[BenchCase]) -> list[dict[str, Any]]:
    """Return a row for each case: errors of a model that is pressed as the truth was."""
    jaw = load_calibration(chosen.calibration).apply(load_jaw("bench")) if chosen.calibration else load_jaw("bench")
    jaw = replace(jaw, material=Material(young_modulus=YOUNG_MODULUS, poisson_ratio=POISSON_RATIO))
    mechanics = build_mechanics(jaw, EstimatorSettings(solver=chosen.solver, mesh=chosen.mesh))
    model, surface, rows = mechanics.model, mechanics.contact.surface, []
    for case in cases:
        rigid = RigidCylinder(radius=case.radius)
        # as deep as it goes before it buckles
        presses = press_jaw(model, surface, jaw.inner_face_x, rigid, case.height, case.depth, partial=True)
        count, places = len(presses), follow_points(model, jaw.keypoints, presses)
        moved = places[1:] - places[0]
        true = np.linalg.norm(case.force[:count], axis=1)
        force = 100.0 * (np.array([np.linalg.norm(press.force) for press in presses]) / true - 1.0)
        points = 1e3 * np.linalg.norm(moved - case.moved[:count], axis=2).max(axis=1)
        at = dict(zip((1e3 * case.depth[:count]).round().astype(int).tolist(), range(count), strict=True))
        rows.append(
            {
                "case": case.name,
                "force, worst/%": float(force[np.abs(force).argmax()]),
                **{f"force at {depth} mm/%": float(force[at[depth]]) if depth in at else np.nan for depth in SHOWN},
                "key points, worst/mm": float(points.max()),
                "key points at 5 mm/mm": float(points[at[5]]) if 5 in at else np.nan,
                "turn/mrad": measure_turn(jaw, case, moved[-1]),
                "true turn/mrad": measure_turn(jaw, case, case.moved[count - 1]),
            }
        )
    return rows


def measure_turn(jaw: Jaw, case: BenchCase, moved: NDArray) -> float:
    """Return the turn of the finger above the contact towards the object [mrad], from displacements (K, 3) [m]."""
    names = jaw.keypoint_names
    above = [k for k, name in enumerate(names) if name.startswith("inner") and jaw.keypoints[k, 2] > case.height]
    ends = [above[0], names.index("tip")]
    rest, now = np.diff(jaw.keypoints[ends], axis=0)[0], np.diff((jaw.keypoints + moved)[ends], axis=0)[0]
    return 1e3 * float(np.arctan2(now[0], now[2]) - np.arctan2(rest[0], rest[2]))


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the largest errors of each model, over all cases and at each height."""
    height = rows["case"].str.split().str[1]
    parts = {"all": rows, **{name: rows[height == name] for name in ("lower", "middle", "upper")}}
    columns = {}
    for column, unit in (("force, worst/%", "force, {}/%"), ("key points, worst/mm", "key points, {}/mm")):
        for name, part in parts.items():
            columns[unit.format(name)] = part[column].abs().groupby(part["model"], sort=False).max()
    return pd.DataFrame(columns).reset_index()


def describe_finger(name: str) -> dict[str, Any]:
    """Return size, material and stiffness of a shipped finger at rest against a force along -x on its inner face."""
    jaw = load_jaw(name)
    began = time.perf_counter()
    mechanics = build_mechanics(jaw, EstimatorSettings(solver="default"))
    seconds = time.perf_counter() - began
    sizes = 1e3 * np.ptp(mechanics.mesh.nodes, axis=0)
    model, face = mechanics.model, mechanics.contact.surface
    rest, stiffness = np.zeros(model.size), {}
    factor = model.factorise(model.linearize(rest).tangent)
    for where, share in SHARES.items():
        row = int(share * (len(face.heights) - 1))
        forces = np.zeros_like(face.points)
        forces[row * face.across : (row + 1) * face.across, 0] = -1.0 / face.across
        load = model.load(face.probe, rest, forces)
        stiffness[f"at {where}/N/mm"] = 1e-3 / float(load @ factor.solve(load))
    return {
        "finger": name,
        "size/mm": " x ".join(f"{size:.1f}" for size in sizes),
        "key points": len(jaw.keypoints),
        "modulus/MPa": 1e-6 * jaw.material.young_modulus,
        **stiffness,
        "unknowns": model.size,
        "built/s": seconds,
    }
