"""Claims about generated meshes as files: read in their own axes and scale."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from chamfer_fakes import compute_chamfer
from guess_fakes import place_mesh
from scipy.spatial.transform import Rotation

from finforce.transforms import pose_from_quaternion
from finforce_contact.mesh.object_mesh import ObjectMesh, read_triangles
from finforce_contact.reconstruction.evidence import GeneratedMesh
from finforce_contact.reconstruction.generated import CAMERA_FROM_PYTORCH3D, CANONICAL_FROM_GLB
from finforce_eval.cli.reconstruct import read_generated_pose
from finforce_sim.objects import build_object


def write_generated(guess: GeneratedMesh, path: Path) -> tuple[Path, Path]:
    """A mesh as SAM 3D Objects writes it: `.glb` with y up, or `.ply` with z up, and its layout as JSON."""
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
    vertices = guess.vertices @ CANONICAL_FROM_GLB if is_glb else guess.vertices
    trimesh.Trimesh(vertices, guess.triangles, process=False).export(path)
    place = path.with_suffix(".json")
    place.write_text(json.dumps(layout), encoding="utf-8")
    return path, place


@pytest.mark.parametrize("form", ["glb", "ply"])
def test_generated_meshes_are_read_in_their_own_axes_and_scale(tmp_path, form):
    mesh = build_object("asymmetric")
    size = float(np.ptp(mesh.vertices, axis=0).max())
    affine = pose_from_quaternion([0.02, -0.03, 0.25], [0.1, -0.5, 0.3, 0.8] / np.linalg.norm([0.1, -0.5, 0.3, 0.8]))
    affine[:3, :3] *= size
    guess = GeneratedMesh(vertices=mesh.vertices / size, triangles=mesh.triangles, affine=affine, name="thing")
    file, layout = write_generated(guess, tmp_path / f"thing.{form}")
    vertices, triangles = read_triangles(file)
    assert 0.9 < np.ptp(vertices, axis=0).max() < 1.15
    placed = ObjectMesh(vertices=vertices, triangles=triangles, watertight=False, name="thing")
    placed = place_mesh(placed, read_generated_pose(layout))
    true = place_mesh(mesh, affine @ np.diag([1.0 / size] * 3 + [1.0]))
    assert compute_chamfer(placed, true).mean < 1.2e-3
