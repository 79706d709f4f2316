"""The shipped fingers: sizes, stiffness, time until a force can be had, and errors against an independent program.

    python -m lab.benchmarks.fingers [--truth FOLDER] [--json report/fingers.json]

FOLDER holds NAME_cyl25_zHEIGHT.npz of shipped fingers: forces and surfaces of the section pressed on a cylinder of
25 mm, E = 30 MPa, nu = 0.45, judged at 1 to 3 mm. Stiffness is that of the finger at rest against a force along -x on
its inner face.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce_eval.machine import describe_machine, write_figures
from finforce_ifea.contact_mechanics.indenter import RoundIndenter
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics, limit_step
from finforce_ifea.jaw.jaw import Jaw, list_shipped_jaws, load_jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings

SOLVERS = ("solid", "plane", "reduced")
TRUE_MATERIAL = Material(young_modulus=30.0e6, poisson_ratio=0.45)
TRUE_FACE, TRUE_RADIUS = 0.014, 12.5e-3
DEPTHS = np.arange(0.5, 3.01, 0.5) * 1e-3
JUDGED = slice(1, None, 2)
HEIGHTS = (0.25, 0.5, 0.75)


def press_cylinder(mechanics: Mechanics, height: float, depths: NDArray) -> tuple[NDArray, list[NDArray]]:
    """Return the forces (d, 3) [N] and the unknowns in equilibrium with a cylinder at rising depths [m]."""
    contact, model = mechanics.contact, mechanics.model
    contact.set_indenter(RoundIndenter())
    place = np.array([0.0, np.log(TRUE_RADIUS), height])
    q, forces, states = contact.begin(height), [], []
    for depth in depths:
        place[0] = depth
        for _ in range(80):
            state = contact.linearize(q, place)
            if not state.touches:
                q = q + contact.approach(q, state.correction, place)
                continue
            step = limit_step(model, state.correction)
            q = q + step
            if np.abs(step / model.reach).max() < 1e-6:
                break
        forces.append(contact.linearize(q, place).force)
        states.append(q)
    return np.array(forces), states


def measure_errors(jaw: Jaw, solver: str, truths: list[Path]) -> dict:
    """Return the errors of forces [%] by file and depth, and of the inner face [mm], of one solver."""
    jaw = replace(jaw, material=TRUE_MATERIAL)
    mechanics = build_mechanics(jaw, EstimatorSettings(solver=solver))
    shift = np.array([jaw.inner_face_x - TRUE_FACE, 0.0, 0.0])
    errors, faces = {}, []
    for path in truths:
        truth, height = np.load(path), 1e-3 * float(path.stem.rsplit("_z", 1)[1])
        forces, states = press_cylinder(mechanics, height, DEPTHS)
        true = truth["force"][: len(DEPTHS) // 2]
        errors[path.stem] = (
            100.0 * np.linalg.norm(forces[JUDGED] - true, axis=1) / np.linalg.norm(true, axis=1)
        ).tolist()
        rest = 1e-3 * truth["vertices0"]
        held = mechanics.contact.surface.low[1]
        rows = np.flatnonzero((np.abs(rest[:, 0] - TRUE_FACE) < 1e-6) & (rest[:, 2] > held))
        model = mechanics.full.model if mechanics.full is not None else mechanics.model
        probe = model.attach(rest[rows] + shift, 1e-3)
        for state, vertices in zip(states[JUDGED], 1e-3 * truth["vertices"], strict=False):
            unknowns = state if mechanics.full is None else None
            if unknowns is None:
                continue
            off = np.linalg.norm(model.positions(probe, unknowns) - shift - vertices[rows], axis=1)
            faces.append([1e3 * float(np.sqrt(np.mean(off**2))), 1e3 * float(off.max())])
    return {"force": errors, "face": np.array(faces).reshape(-1, 2).max(axis=0).tolist() if faces else None}


def describe(name: str) -> dict:
    """Return size, material and stiffness of a shipped finger."""
    jaw = load_jaw(name)
    began = time.perf_counter()
    mechanics = build_mechanics(jaw, EstimatorSettings(solver="default"))
    seconds = time.perf_counter() - began
    low, high = mechanics.mesh.nodes.min(axis=0), mechanics.mesh.nodes.max(axis=0)
    model, face = mechanics.model, mechanics.contact.surface
    rest, stiffness = np.zeros(model.size), []
    factor = model.factorise(model.linearize(rest).tangent)
    for share in HEIGHTS:
        row = int(share * (len(face.heights) - 1))
        forces = np.zeros_like(face.points)
        forces[row * face.across : (row + 1) * face.across, 0] = -1.0 / face.across
        load = model.load(face.probe, rest, forces)
        stiffness.append(1e-3 / float(load @ factor.solve(load)))
    return {
        "size_mm": (1e3 * (high - low)).tolist(),
        "modulus_MPa": 1e-6 * jaw.material.young_modulus,
        "keypoints": len(jaw.keypoints),
        "stiffness_N_mm": stiffness,
        "unknowns": model.size,
        "built_s": seconds,
    }


def main() -> None:
    """Describe the fingers, compare them with the truth, print tables, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truth", type=Path, help="folder of the independent program's shapes")
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    options = parser.parse_args()
    figures: dict = {"fingers": {}, "truth": {}}
    names = list_shipped_jaws()
    with tqdm(names, unit="finger", disable=None, leave=False) as bar:
        for name in bar:
            figures["fingers"][name] = describe(name)
    print("| finger | size/mm | key points | modulus/MPa | N/mm at 1/4, 1/2, 3/4 | unknowns |")
    print("|---|---|---:|---:|---|---:|")
    for name, row in figures["fingers"].items():
        size = " x ".join(f"{value:.1f}" for value in row["size_mm"])
        stiffness = " / ".join(f"{value:.2f}" for value in row["stiffness_N_mm"])
        modulus = f"{row['modulus_MPa']:.3g}"
        print(f"| {name} | {size} | {row['keypoints']} | {modulus} | {stiffness} | {row['unknowns']} |")
    for name in names if options.truth else ():
        truths = sorted(options.truth.glob(f"{name}_cyl25_z*.npz"))
        if not truths:
            continue
        print(
            f"\n| {name} | force at 1, 2, 3 mm, off by % | mean | inner face, RMS / largest, mm |\n|---|---|---:|---|"
        )
        for solver in SOLVERS:
            found = measure_errors(load_jaw(name), solver, truths)
            figures["truth"][f"{name}/{solver}"] = found
            rows = "; ".join(", ".join(f"{value:.1f}" for value in row) for row in found["force"].values())
            mean = np.mean(list(found["force"].values()))
            face = "-" if found["face"] is None else f"{found['face'][0]:.3f} / {found['face'][1]:.3f}"
            print(f"| {solver} | {rows} | {mean:.1f} | {face} |", flush=True)
    print(describe_machine())
    if options.json:
        write_figures(options.json, figures)


if __name__ == "__main__":
    main()
