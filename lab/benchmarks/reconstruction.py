"""How near reconstructed object meshes come to the true ones, on synthetic images of a D405.

    python -m lab.benchmarks.reconstruction [--seeds 5] [--json report/reconstruction.json]

The truth is the object's own mesh in the camera frame; an error of the pose counts as one of the mesh does. The guess
is wrong by 13 to 16 mm of Chamfer distance, by scale, turn and shift. That all depths of a real camera may be some per
cent off is left out: it moves the object along the optical axis by as much, and no method sees it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.camera import deproject
from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.chamfer import Chamfer, compute_chamfer
from finforce_contact.mesh.closing import build_poisson_mesh
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.reconstruction.evidence import collect_evidence
from finforce_contact.reconstruction.paper_alignment import scale_coarsely
from finforce_contact.reconstruction.reconstruction import METHODS, reconstruct
from finforce_contact.reconstruction.result import GeneratedMesh
from finforce_eval.machine import write_figures
from finforce_sim.rendering.depth_camera import build_d405
from finforce_sim.scenes.guesses import GuessError, draw_guess, place_mesh
from finforce_sim.scenes.objects import OBJECT_NAMES, build_object
from finforce_sim.scenes.pose_sequences import TableScene, draw_scene, roughen_mask

DISTANCES = (13e-3, 16e-3)  # [m] of the guess from the truth
ALONE = "alone"  # the choice between primitive and completion


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What makes a reconstruction hard."""

    title: str
    hidden: float = 0.0
    mask_error: float = 0.0
    error: GuessError = GuessError()
    methods: tuple[str, ...] = ("robust", "paper")


CONDITIONS = (
    Condition(title="whole object, exact mask", methods=(*METHODS, ALONE)),
    Condition(title="outline of the mask off by 1 px, 40 % hidden", hidden=0.4, mask_error=1.0),
    Condition(title="70 % hidden", hidden=0.7),
    Condition(
        title="generated proportions off by 5 %, dents of 1 mm, outline off by 1 px",
        mask_error=1.0,
        error=GuessError(stretch=0.05, bend=1e-3),
    ),
)


@dataclass(frozen=True, kw_only=True)
class ReconstructionTrial:
    """One result: distances [mm], infinite where the method gave up, and the time it took [s]."""

    condition: str
    target: str
    seed: int
    method: str
    mean_mm: float
    rms_mm: float
    seconds: float


def run_trials(condition: Condition, name: str, seed: int) -> list[ReconstructionTrial]:
    """Return the results of all methods on one image."""
    rng = np.random.default_rng([seed, OBJECT_NAMES.index(name)])
    scene = draw_scene(build_object(name), build_d405(), rng, hidden=condition.hidden)
    mask = roughen_mask(scene.mask, rng, condition.mask_error) if condition.mask_error else scene.mask
    guess = draw_guess(scene, rng, rng.uniform(*DISTANCES), condition.error)
    trials = [
        _make_trial(condition, scene, seed, method, compare(scene, place_mesh(guess.mesh, affine)), 0.0)
        for method, affine in (("raw", guess.affine), ("coarse", scale_guess(scene, mask, guess)))
    ]
    evidence = collect_evidence(scene.depth, mask, scene.camera)
    for method in condition.methods:
        begin = time.process_time()
        try:
            given = None if method == ALONE else guess
            result = reconstruct(evidence, given, "" if method == ALONE else method)
            chamfer = compare(scene, place_mesh(result.mesh, result.T_camera_object))
        except ReconstructionError:
            chamfer = Chamfer(mean=np.inf, rms=np.inf)
        trials.append(_make_trial(condition, scene, seed, method, chamfer, time.process_time() - begin))
    return trials


def compare(scene: TableScene, placed: ObjectMesh) -> Chamfer:
    """Return the distance of a mesh in the camera frame from the true one."""
    return compute_chamfer(placed, place_mesh(scene.mesh, scene.T_camera_object))


def scale_guess(scene: TableScene, mask: NDArray, guess: GeneratedMesh) -> NDArray:
    """Return the guess's map (4, 4) after the paper's coarse scale."""
    cloud = deproject(scene.depth, scene.camera, mask)
    return scale_coarsely(guess.mesh, guess.affine, cloud)


def _make_trial(
    condition: Condition, scene: TableScene, seed: int, method: str, chamfer: Chamfer, seconds: float
) -> ReconstructionTrial:
    return ReconstructionTrial(
        condition=condition.title,
        target=scene.mesh.name,
        seed=seed,
        method=method,
        mean_mm=1e3 * chamfer.mean,
        rms_mm=1e3 * chamfer.rms,
        seconds=seconds,
    )


def summarise(trials: Sequence[ReconstructionTrial]) -> dict[str, float | int | None]:
    """Return median, 95th percentile and largest distance, and how many gave up."""
    mean = np.array([trial.mean_mm for trial in trials])
    known = [trial for trial in trials if np.isfinite(trial.mean_mm)]
    row = {"n": len(trials), "gave_up": len(trials) - len(known)}
    if not known:
        return row
    known_mean = mean[np.isfinite(mean)]
    return {
        **row,
        "median_mm": float(np.median(known_mean)),
        "p95_mm": float(np.percentile(known_mean, 95)),
        "max_mm": float(known_mean.max()),
        "rms_median_mm": float(np.median([trial.rms_mm for trial in known])),
        "cpu_seconds_median": float(np.median([trial.seconds for trial in known])),
    }


def tabulate(trials: Sequence[ReconstructionTrial]) -> list[dict]:
    """Return one row per condition, method and object, and one for all objects together."""
    keys = dict.fromkeys((trial.condition, trial.method) for trial in trials)
    rows = []
    for condition, method in keys:
        chosen = [trial for trial in trials if (trial.condition, trial.method) == (condition, method)]
        for name in (*OBJECT_NAMES, "all"):
            own = [trial for trial in chosen if name in ("all", trial.target)]
            if own:
                rows.append({"condition": condition, "method": method, "object": name, **summarise(own)})
    return rows


def format_rows(rows: Sequence[dict]) -> str:
    """Return a table per condition: methods down, objects across; median / largest mean Chamfer distance [mm]."""
    lines = []
    for condition in dict.fromkeys(row["condition"] for row in rows):
        own = [row for row in rows if row["condition"] == condition]
        names = list(dict.fromkeys(row["object"] for row in own))
        lines += ["", f"{condition}: Chamfer distance, median / largest [mm]"]
        lines.append(f"{'':12s}" + "".join(f"{name:>17s}" for name in names) + "   CPU [s]   gave up")
        for method in dict.fromkeys(row["method"] for row in own):
            cells = {row["object"]: row for row in own if row["method"] == method}
            texts = [f"{c.get('median_mm', np.nan):7.2f} /{c.get('max_mm', np.nan):7.2f}" for c in cells.values()]
            last = cells[names[-1]]
            end = f"{last.get('cpu_seconds_median', 0.0):9.1f}{last['gave_up']:6d} of {last['n']}"
            lines.append(f"{method:12s}" + "".join(f"{text:>17s}" for text in texts) + end)
    return "\n".join(lines)


def measure_poisson() -> dict[str, float]:
    """Return by object how far the Poisson surface of a perfect mesh is from that mesh [mm]."""
    meshes = map(build_object, OBJECT_NAMES)
    return {mesh.name: 1e3 * compute_chamfer(build_poisson_mesh(mesh), mesh).mean for mesh in meshes}


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5, help="images per object and condition (5)")
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    options = parser.parse_args()
    cases = [(c, name, seed) for c in CONDITIONS for name in OBJECT_NAMES for seed in range(options.seeds)]
    trials = [trial for case in tqdm(cases, unit="image", leave=False) for trial in run_trials(*case)]
    rows, poisson = tabulate(trials), measure_poisson()
    print(format_rows(rows))
    print("\nPoisson surface of a perfect mesh, Chamfer distance from it [mm]:")
    print("  ".join(f"{name} {distance:.3f}" for name, distance in poisson.items()))
    if options.json:
        every = [asdict(trial) for trial in trials]
        write_figures(options.json, {"rows": rows, "poisson_mm": poisson, "trials": every})


if __name__ == "__main__":
    main()
