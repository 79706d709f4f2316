"""Generated meshes as SAM 3D Objects writes them, brought to scale and place by one depth image."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from finforce.camera import deproject
from finforce.errors import one_line
from finforce.optional import import_trimesh
from finforce_contact.errors import ReconstructionError
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import compute_chamfer, sample_surface
from finforce_contact.reconstruction.evidence import GeneratedMesh, collect_evidence
from finforce_contact.reconstruction.generated import (
    CAMERA_FROM_PYTORCH3D,
    CANONICAL_FROM_GLB,
    read_generated,
    scale_coarsely,
)
from finforce_contact.reconstruction.reconstruction import reconstruct
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.image_files import read_generated_pose
from finforce_sim.objects import OBJECT_NAMES, build_object
from finforce_sim.sensor import build_d405
from lab.experiments.experiment import Case, Findings, ResultTable, average, tabulate
from lab.experiments.runs import RunOptions
from lab.table_scenes import GuessError, draw_guess, draw_scene, place_mesh, roughen_mask

FORMS = ("glb", "ply")
IMAGES, QUICK_OBJECTS = 2, ("cube", "bottle")
DISTANCES = (13e-3, 16e-3)  # [m] of the raw mesh from the true one, as the paper's
HIDDEN, MASK_ERROR = 0.2, 1.0  # share of the object's pixels, [px] of the mask's outline
ERROR = GuessError(stretch=0.03, bend=0.5e-3)
SPLATS, SPREAD, STRAYS = 20000, 3e-3, 300  # count, of the mesh's size, count of faint ones
# of the paper: its raw mesh, scaled coarsely, reconstructed [mm]
PAPER = {
    name: {"raw/mm": raw, "scaled coarsely/mm": coarse, "as the paper/mm": fine}
    for name, raw, coarse, fine in (
        ("cylinder", 13.39, 2.80, 2.36),
        ("cube", 14.69, 6.69, 3.53),
        ("asymmetric", 15.69, 3.26, 3.35),
    )
}


@dataclass(frozen=True, kw_only=True)
class ShapeExperiment:
    """Objects on a table, each with a generated mesh in two file formats."""

    options: RunOptions
    name: str = "shape"
    title: str = "Generated meshes brought to scale"
    about: str = (
        "The paper has SAM 3D Objects make a mesh from one image and brings it to scale by depth. That needs a large "
        "GPU and is not run: here a mesh with wrong proportions and dents is written as SAM 3D Objects writes its own, "
        "normalised, in its axes, with its layout: as GLB, and as Gaussian splats in a PLY file. Both go through the "
        "same functions as `finforce reconstruct`. A fifth of the object is hidden, the mask's outline off by a pixel."
    )

    def list_cases(self) -> Sequence[Case]:
        """Return an image of each object; see `Experiment`.

        Raises:
            RecordingError: recordings are named.
        """
        if self.options.bags:
            raise RecordingError(
                "experiment shape needs the true mesh beside the image, and renders both; for an image of your own: "
                "finforce reconstruct"
            )
        names, count = (QUICK_OBJECTS, 1) if self.options.quick else (OBJECT_NAMES, IMAGES)
        cases = []
        for name, form, number in product(names, FORMS, range(count)):
            words = {"object": name, "form": form}
            settings = {**words, "seed": self.options.seed + number, "words": words}
            cases.append(Case(name=f"{name}_{form}_{number}", settings=settings))
        return cases

    def run(self, case: Case, folder: Path) -> dict[str, Any]:
        """Return the distances of a generated mesh before and after; see `Experiment`."""
        settings = case.settings
        rng = np.random.default_rng([settings["seed"], OBJECT_NAMES.index(settings["object"])])
        scene = draw_scene(build_object(settings["object"]), build_d405(), rng, hidden=HIDDEN)
        mask = roughen_mask(scene.mask, rng, MASK_ERROR)
        guess = draw_guess(scene, rng, rng.uniform(*DISTANCES), ERROR)
        file, layout = write_generated(guess, folder / f"{case.name}.{settings['form']}", rng)
        vertices, triangles = read_generated(file)
        affine = read_generated_pose(layout)
        generated = GeneratedMesh(vertices=vertices, triangles=triangles, affine=affine, name=file.stem)
        file.unlink()
        layout.unlink()
        true = place_mesh(scene.mesh, scene.T_camera_object)
        raw = generated.mesh
        coarse = scale_coarsely(raw, affine, deproject(scene.depth, scene.camera, mask))
        figures = {name: _distance(place_mesh(raw, A), true) for name, A in (("raw_mm", affine), ("coarse_mm", coarse))}
        evidence = collect_evidence(scene.depth, mask, scene.camera)
        for method in ("robust", "paper"):
            try:
                found = reconstruct(evidence, generated, method)
                figures[f"{method}_mm"] = _distance(place_mesh(found.mesh, found.T_camera_object), true)
            except ReconstructionError as error:
                figures[f"{method}_mm"], figures[f"{method}_refused"] = None, one_line(error)
        return figures

    def find(self, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Findings:
        """Return the distances by object and format; see `Experiment`."""
        images = tabulate(figures)
        shapes = average(images, ("object", "form"), COLUMNS)[["object", "form", *COLUMNS.values()]]
        told = [{"object": name, "form": "paper", **PAPER[name]} for name in PAPER if name in set(images.object)]
        note = (
            "Mean Chamfer distance from the true mesh in the camera's frame; blank: refused. The paper's objects and "
            "raw meshes are its own."
        )
        rows = pd.concat([shapes, pd.DataFrame(told)]).sort_values("object", kind="stable")
        return Findings(tables=[ResultTable(title="Distance from the true mesh", rows=rows, note=note)])


COLUMNS = {
    "raw_mm": "raw/mm",
    "coarse_mm": "scaled coarsely/mm",
    "robust_mm": "robust/mm",
    "paper_mm": "as the paper/mm",
}


def _distance(mesh: ObjectMesh, true: ObjectMesh) -> float:
    """Return the mean Chamfer distance [mm] of two meshes."""
    return 1e3 * compute_chamfer(mesh, true).mean


def write_generated(guess: GeneratedMesh, path: Path, rng: np.random.Generator) -> tuple[Path, Path]:
    """Write a mesh as SAM 3D Objects does: `.glb` with y up or `.ply` of splats with z up, and its layout as JSON.

    Returns:
        Both files.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    scale = float(np.cbrt(np.linalg.det(guess.affine[:3, :3])))
    # row vectors in PyTorch3D's camera: p = s (p_canonical R(q)) + t
    R = (CAMERA_FROM_PYTORCH3D @ guess.affine[:3, :3] / scale).T
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    is_glb = path.suffix == ".glb"
    layout = {
        "rotation": [w, x, y, z],
        "translation": (CAMERA_FROM_PYTORCH3D @ guess.affine[:3, 3]).tolist(),
        "scale": [scale] * 3,
        "axes": "glb" if is_glb else "canonical",
    }
    if is_glb:
        turned = guess.vertices @ CANONICAL_FROM_GLB
        import_trimesh().Trimesh(turned, guess.triangles, process=False).export(path)
    else:
        path.write_bytes(_encode_splats(guess, rng))
    place = path.with_suffix(".json")
    place.write_text(json.dumps(layout), encoding="utf-8")
    return path, place


def _encode_splats(guess: GeneratedMesh, rng: np.random.Generator) -> bytes:
    """Return a PLY file of Gaussian splats on a mesh, some of them faint and astray."""
    places = sample_surface(guess.mesh, SPLATS, rng) + SPREAD * rng.standard_normal((SPLATS, 3))
    places = np.vstack((places, rng.uniform(-0.6, 0.6, (STRAYS, 3))))
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rows = np.zeros((len(places), len(names)), dtype="<f4")
    rows[:, :3] = places
    rows[:, names.index("opacity")] = np.r_[np.full(SPLATS, 3.0), np.full(STRAYS, -4.0)]
    rows[:, names.index("scale_0") : names.index("rot_0")] = np.log(SPREAD)
    rows[:, names.index("rot_0")] = 1.0
    properties = "".join(f"property float {name}\n" for name in names)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(places)}\n{properties}end_header\n"
    return head.encode("ascii") + rows.tobytes()
