"""`finforce reconstruct`: a masked depth image in, the object's mesh and its pose out."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.camera import MILLIMETRE
from finforce.errors import PoseError
from finforce.files import read_json
from finforce.optional import import_trimesh
from finforce_contact.mesh.object_mesh import POSE_ENDING
from finforce_contact.mesh.views import MeshView
from finforce_contact.reconstruction.evidence import GeneratedMesh, ImageEvidence, Reconstruction, collect_evidence
from finforce_contact.reconstruction.generated import affine_from_generator
from finforce_contact.reconstruction.generated import read_generated as read_mesh
from finforce_contact.reconstruction.reconstruction import FROM_GENERATED, reconstruct
from finforce_eval.cli.parser import CommandResult, picture_file
from finforce_eval.errors import OptionError
from finforce_eval.figures.figures import BLUE, ORANGE, new_figure
from finforce_eval.recordings.image_files import read_depth, read_image, read_intrinsics, read_mask

OUTPUTS = (".stl", ".ply", ".glb")
POSE_FORMS = (
    '{"rotation": [w, x, y, z], "translation": [x, y, z], "scale": s, "axes": "glb" or "canonical"}, '
    '{"matrix": 4x4}, {"T_camera_object": 4x4} as reconstruct writes it, a bare 4x4 list, or such lines as .txt'
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("--depth", required=True, metavar="FILE", help="16-bit PNG [mm], or .npy [m]")
    text = "unit of a 16-bit depth image [m]: 0.0002 for TUM, 0.0001 for many BOP sets (0.001)"
    parser.add_argument("--depth-scale", type=float, default=MILLIMETRE, metavar="METRES", help=text)
    parser.add_argument("--mask", required=True, metavar="FILE", help="mask of the object: image or .npy")
    intrinsics = "fx fy cx cy [k1 k2 p1 p2 k3] in pixels, or a file of ROS, OpenCV, kalibr, BOP or OpenICC"
    parser.add_argument("--intrinsics", required=True, nargs="+", metavar="NUMBER", help=intrinsics)
    parser.add_argument("--color", metavar="FILE", help="colour image, shown in --picture")
    parser.add_argument(
        "--mesh", metavar="FILE", help="generated mesh (STL, OBJ, PLY, GLB) or splats (PLY), in any unit"
    )
    pose = "JSON with its pose: rotation (w x y z), translation and scale as from SAM-3D, or a 4x4 matrix, also as .txt"
    parser.add_argument("--pose", metavar="FILE", help=pose)
    method = "method (robust with a generated mesh; otherwise primitive if one fits, else completion)"
    parser.add_argument("--method", choices=("robust", "paper", "primitive", "completion"), help=method)
    parser.add_argument(
        "-o", "--output", required=True, metavar="FILE", help="mesh to write: .stl, .ply or .glb, in metres"
    )
    parser.add_argument("--picture", type=picture_file, metavar="PNG", help="draw the mesh over the depth image")


def run(options: argparse.Namespace) -> CommandResult:
    """Reconstruct, write mesh, pose and picture, and print what came out.

    Raises:
        FinforceError: an input cannot be used, or nothing explains the image.
    """
    check_options(options)
    evidence, color = read_evidence(options)
    generated = read_generated(options) if options.mesh else None
    form = "{desc:28s} {percentage:3.0f}%|{bar:30}| {elapsed}"
    with tqdm(total=1.0, bar_format=form, leave=False, disable=None) as bar:

        def show(stage: str, share: float) -> None:
            bar.set_description_str(stage, refresh=False)
            bar.update(share - bar.n)

        result = reconstruct(evidence, generated, options.method or "", show)
    write_result(result, Path(options.output))
    print(describe_result(result))
    print(f"Mesh: {options.output} (metres); pose: {pose_path(Path(options.output))}")
    if options.picture:
        Path(options.picture).parent.mkdir(parents=True, exist_ok=True)
        draw_reconstruction(result, evidence, color).savefig(options.picture)
        print(f"Picture: {options.picture}")
    return CommandResult(_as_json(result))


def check_options(options: argparse.Namespace) -> None:
    """Refuse options that do not go together, before anything is read.

    Raises:
        OptionError: they do not.
    """
    if not 1e-6 <= options.depth_scale <= 1.0:
        raise OptionError(f"--depth-scale {options.depth_scale:g}: expected metres for a step, 0.001 of most cameras")
    if Path(options.output).suffix.lower() not in OUTPUTS:
        raise OptionError(f"-o {options.output}: expected a name that ends in {', '.join(OUTPUTS)}")
    if bool(options.mesh) != bool(options.pose):
        raise OptionError("--mesh and --pose go together: the generated mesh, and where its generator puts it")
    if options.method in FROM_GENERATED and not options.mesh:
        raise OptionError(f"--method {options.method} needs --mesh and --pose; without them: primitive or completion")
    if options.method and options.method not in FROM_GENERATED and options.mesh:
        raise OptionError(f"--method {options.method} uses no generated mesh; leave out --mesh and --pose")


def read_evidence(options: argparse.Namespace) -> tuple[ImageEvidence, NDArray | None]:
    """Return what the images say, and the colour picture where one was given.

    Raises:
        FinforceError: an image cannot be used.
    """
    depth, mask = read_depth(options.depth, options.depth_scale), read_mask(options.mask)
    color = read_image(options.color) if options.color else None
    if color is not None and (color.ndim != 3 or color.shape[:2] != depth.shape):
        raise OptionError(f"{options.color}: shape {color.shape}; expected colour of the depth's size, {depth.shape}")
    return collect_evidence(depth, mask, read_intrinsics(options.intrinsics, depth.shape)), color


def read_generated(options: argparse.Namespace) -> GeneratedMesh:
    """Return the generated mesh with its guessed pose.

    Raises:
        FinforceError: mesh or pose cannot be used.
    """
    vertices, triangles = read_mesh(options.mesh)
    affine = read_generated_pose(options.pose)
    return GeneratedMesh(vertices=vertices, triangles=triangles, affine=affine, name=Path(options.mesh).stem)


def read_generated_pose(path: Path | str) -> NDArray:
    """Return the map (4, 4) of a generated mesh into the camera frame.

    Raises:
        OptionError: the file is none of `POSE_FORMS`.
        PoseError: its numbers are no pose.
    """
    path = Path(path)
    try:
        content = np.loadtxt(path).tolist() if path.suffix == ".txt" else read_json(path)
        if isinstance(content, list):
            content = {"matrix": content}
        for key in ("matrix", "T_camera_object"):
            if key in content:
                return _check_matrix(np.array(content[key], dtype=float), path.name)
        parts = [content[name] for name in ("rotation", "translation", "scale")]
        return affine_from_generator(*parts, mesh_axes=content.get("axes", "glb"))
    except PoseError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise OptionError(f"{path.name}: {error!r}; expected {POSE_FORMS}") from None


def _check_matrix(matrix: NDArray, name: str) -> NDArray:
    """Refuse what is no map (4, 4)."""
    if matrix.shape != (4, 4):
        raise OptionError(f"{name}: a matrix of shape {matrix.shape}; expected {POSE_FORMS}")
    return matrix


def write_result(result: Reconstruction, output: Path) -> None:
    """Write the mesh in metres, and next to it the pose with all that is known of its quality, as JSON."""
    output.parent.mkdir(parents=True, exist_ok=True)
    trimesh = import_trimesh()
    mesh = trimesh.Trimesh(result.mesh.vertices, result.mesh.triangles, process=False)
    mesh.export(output, file_type=output.suffix[1:].lower())
    pose_path(output).write_text(json.dumps(_as_json(result), indent=2) + "\n", encoding="utf-8")


def pose_path(output: Path) -> Path:
    """Return where the pose of a mesh file goes."""
    return output.with_suffix(POSE_ENDING)


def _as_json(result: Reconstruction) -> dict[str, Any]:
    """Return pose and quality."""
    return {
        "T_camera_object": result.T_camera_object.tolist(),
        "scale": result.scale.tolist(),
        "method": result.method,
        "watertight": result.mesh.watertight,
        "triangles": len(result.mesh.triangles),
        "extent_m": np.ptp(result.mesh.vertices, axis=0).tolist(),
        "score": asdict(result.score),
        "unseen_stddev_m": result.mesh.unseen_stddev,
        "notes": list(result.mesh.notes),
    }


def describe_result(result: Reconstruction) -> str:
    """Return size, agreement and notes as lines."""
    size = " x ".join(f"{1e3 * side:.1f}" for side in np.ptp(result.mesh.vertices, axis=0))
    kind = "watertight" if result.mesh.watertight else "NOT watertight"
    lines = [
        f"{result.method}: {size} mm, {len(result.mesh.triangles)} triangles, {kind}",
        f"distance of the measured surface {1e3 * result.score.residual:.2f} mm (median), outline and mask overlap "
        f"{100.0 * result.score.overlap:.1f} %",
    ]
    return "\n".join([*lines, *(f"note: {note}" for note in result.mesh.notes)])


MARGIN = 0.25  # of the object's size, shown around it
DIFFERENCE_RANGE = 5.0  # [mm]


def draw_reconstruction(result: Reconstruction, evidence: ImageEvidence, color: NDArray | None = None) -> Figure:
    """Draw the image, and the difference of measured depth and mesh, with the outlines of mask and mesh.

    Args:
        result: mesh and pose.
        evidence: the image.
        color: (h, w, 3) picture; the depth in grey when absent.
    """
    depth = MeshView(result.mesh).render(result.T_camera_object, evidence.camera).depth
    outline, (near, far) = np.isfinite(depth), np.percentile(evidence.points[:, 2], (0, 100))
    difference = np.where(evidence.mask, 1e3 * (evidence.depth - depth), np.nan)
    figure = new_figure(9.0, 4.6)
    axes = figure.subplots(1, 2)
    axes[0].imshow(evidence.depth if color is None else color[..., :3], cmap="gray_r", vmin=near - 0.02, vmax=far + 0.1)
    shown = axes[1].imshow(difference, cmap="RdBu", vmin=-DIFFERENCE_RANGE, vmax=DIFFERENCE_RANGE)
    figure.colorbar(shown, ax=axes[1], shrink=0.8, label="measured depth beyond the mesh [mm]")
    rows, columns = (np.flatnonzero((evidence.mask | outline).any(axis=axis)) for axis in (1, 0))
    margin = int(MARGIN * max(np.ptp(rows), np.ptp(columns))) + 2
    for panel in axes:
        for mask, colour in ((evidence.mask, BLUE), (outline, ORANGE)):
            panel.contour(mask.astype(float), levels=[0.5], colors=[colour], linewidths=1.2)
        panel.set(xticks=[], yticks=[], xlim=(columns[0] - margin, columns[-1] + margin))
        panel.set(ylim=(rows[-1] + margin, rows[0] - margin))
    figure.suptitle(describe_result(result).split("\nnote")[0] + "   (blue: mask, orange: mesh)", fontsize=9)
    return figure
