"""Picture of a reconstructed mesh over the image that it was made from."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from finforce_contact.mesh.views import MeshView, RenderedMesh
from finforce_contact.reconstruction.evidence import ImageEvidence, Reconstruction
from finforce_eval.figures.figures import BLUE, ORANGE, new_figure

MARGIN = 0.25  # of the object's size, shown around it
DIFFERENCE_RANGE = 5.0  # [mm]


def draw_reconstruction(result: Reconstruction, evidence: ImageEvidence, color: NDArray | None = None) -> Figure:
    """Draw the image, the mesh over it, and the difference of measured depth and mesh.

    Args:
        result: mesh and pose.
        evidence: the image.
        color: (h, w, 3) picture; the depth in grey when absent.
    """
    view = MeshView(result.mesh).render(result.T_camera_object, evidence.camera)
    rows, columns = _window(evidence.mask | np.isfinite(view.depth))
    extent = (columns.start - 0.5, columns.stop - 0.5, rows.stop - 0.5, rows.start - 0.5)
    base = _as_picture(evidence, color)[rows, columns]
    figure = new_figure(12.0, 4.6)
    axes = figure.subplots(1, 3)
    axes[0].imshow(base, extent=extent)
    axes[1].imshow(base, extent=extent)
    axes[1].imshow(_shade(view)[rows, columns], extent=extent)
    difference = 1e3 * (evidence.depth - view.depth)[rows, columns]
    image = axes[2].imshow(
        np.where(evidence.mask[rows, columns], difference, np.nan),
        extent=extent,
        cmap="RdBu",
        vmin=-DIFFERENCE_RANGE,
        vmax=DIFFERENCE_RANGE,
    )
    figure.colorbar(image, ax=axes[2], shrink=0.8, label="measured depth beyond the mesh [mm]")
    outline = np.isfinite(view.depth)
    for panel, title in zip(axes, ("mask and outline of the mesh", "mesh", "difference"), strict=True):
        _draw_outline(panel, evidence.mask, BLUE)
        _draw_outline(panel, outline, ORANGE)
        panel.set(title=title, xticks=[], yticks=[], xlim=extent[:2], ylim=extent[2:])
    size = " x ".join(f"{1e3 * side:.1f}" for side in np.ptp(result.mesh.vertices, axis=0))
    score = result.score
    figure.suptitle(
        f"{result.method}: {size} mm, median distance {1e3 * score.residual:.2f} mm, overlap "
        f"{100.0 * score.overlap:.1f} %   (blue: mask, orange: mesh)",
        fontsize=11,
    )
    return figure


def _window(shown: NDArray) -> tuple[slice, slice]:
    """Return the rows and columns around what is shown (h, w)."""
    slices = []
    for axis in (1, 0):
        pixels = np.flatnonzero(shown.any(axis=axis))
        margin = int(MARGIN * (pixels[-1] - pixels[0])) + 2
        slices.append(slice(max(pixels[0] - margin, 0), min(pixels[-1] + margin, shown.shape[1 - axis])))
    return slices[0], slices[1]


def _as_picture(evidence: ImageEvidence, color: NDArray | None) -> NDArray:
    """Return the picture (h, w, 3), or one of the depth, near is bright."""
    if color is not None:
        return color[..., :3]
    near, far = np.percentile(evidence.points[:, 2], (0, 100)) + (-0.02, 0.1)
    grey = np.clip((far - np.nan_to_num(evidence.depth, nan=far)) / (far - near), 0.0, 1.0)
    return np.repeat(grey[..., None], 3, axis=2)


def _shade(view: RenderedMesh) -> NDArray:
    """Return a picture (h, w, 4) of the mesh, brighter where it faces the camera, clear elsewhere."""
    picture = np.zeros((*view.depth.shape, 4))
    facing = -np.einsum("ij,ij->i", view.normals, view.points) / np.linalg.norm(view.points, axis=1)
    colour = np.array([0.95, 0.55, 0.2])
    picture[view.pixels[:, 1], view.pixels[:, 0], :3] = (0.25 + 0.75 * facing[:, None]) * colour
    picture[view.pixels[:, 1], view.pixels[:, 0], 3] = 0.8
    return picture


def _draw_outline(axes: Any, mask: NDArray, colour: str) -> None:
    """Draw the border of a mask (h, w)."""
    axes.contour(mask.astype(float), levels=[0.5], colors=[colour], linewidths=1.2)
