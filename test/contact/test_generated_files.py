"""Claims about generated meshes as files: read in their own axes and scale, refused where they are damaged."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from chamfer_fakes import compute_chamfer
from guess_fakes import place_mesh
from scipy.spatial.transform import Rotation

from finforce.transforms import pose_from_quaternion
from finforce_contact.errors import ObjectMeshError
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import sample_surface
from finforce_contact.reconstruction.evidence import GeneratedMesh
from finforce_contact.reconstruction.generated import CAMERA_FROM_PYTORCH3D, CANONICAL_FROM_GLB, read_generated
from finforce_eval.cli.reconstruct import read_generated_pose
from finforce_sim.objects import build_object

SPLATS, SPREAD, STRAYS = 20000, 3e-3, 300  # count, of the mesh's size, count of faint ones


def write_generated(guess: GeneratedMesh, path: Path, rng: np.random.Generator) -> tuple[Path, Path]:
    """A mesh as SAM 3D Objects writes it: `.glb` with y up or `.ply` of splats with z up, and its layout as JSON."""
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
        trimesh.Trimesh(turned, guess.triangles, process=False).export(path)
    else:
        path.write_bytes(_encode_splats(guess, rng))
    place = path.with_suffix(".json")
    place.write_text(json.dumps(layout), encoding="utf-8")
    return path, place


def _encode_splats(guess: GeneratedMesh, rng: np.random.Generator) -> bytes:
    """A PLY file of Gaussian splats on a mesh, some of them faint and astray."""
    places = sample_surface(guess.mesh, SPLATS, rng).points + SPREAD * rng.standard_normal((SPLATS, 3))
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


@pytest.mark.parametrize("form", ["glb", "ply"])
def test_generated_meshes_are_read_in_their_own_axes_and_scale(tmp_path, form):
    pytest.importorskip("open3d", reason="splats become a surface by Open3D: pip install open3d")
    rng = np.random.default_rng(3)
    mesh = build_object("asymmetric")
    size = float(np.ptp(mesh.vertices, axis=0).max())
    affine = pose_from_quaternion([0.02, -0.03, 0.25], [0.1, -0.5, 0.3, 0.8] / np.linalg.norm([0.1, -0.5, 0.3, 0.8]))
    affine[:3, :3] *= size
    guess = GeneratedMesh(vertices=mesh.vertices / size, triangles=mesh.triangles, affine=affine, name="thing")
    file, layout = write_generated(guess, tmp_path / f"thing.{form}", rng)
    vertices, triangles = read_generated(file)
    assert 0.9 < np.ptp(vertices, axis=0).max() < 1.15
    placed = ObjectMesh(vertices=vertices, triangles=triangles, watertight=False, name="thing")
    placed = place_mesh(placed, read_generated_pose(layout))
    true = place_mesh(mesh, affine @ np.diag([1.0 / size] * 3 + [1.0]))
    assert compute_chamfer(placed, true).mean < 1.2e-3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:-4000], "expected as many as the header says"),
        (lambda data: data.replace(b"binary_little_endian", b"binary_big_endian"), "binary_little_endian"),
        (lambda data: data.replace(b"vertex 20300", b"vertex 99999999"), "for 99999999 splats"),
        (lambda data: data.replace(b"vertex 20300", b"vertex 7"), "got 7 splats that can be seen"),
        (lambda data: data.replace(b"property float opacity", b"property float opacit_"), "no triangles"),
    ],
)
def test_damaged_splats_are_refused(tmp_path, change, words):
    mesh = build_object("cube")
    guess = GeneratedMesh(vertices=mesh.vertices / 0.06, triangles=mesh.triangles, affine=np.eye(4), name="cube")
    file, _ = write_generated(guess, tmp_path / "cube.ply", np.random.default_rng(0))
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(ObjectMeshError, match=words):
        read_generated(file)
