"""Draw the picture on the front page: a grasp of the twin from its images to forces.

    python -m tools.hero docs/images/demo.webp

A scene with plain materials on a wooden table is rendered, key points are found in its images, and the forces of both
jaws are estimated with them: beside the wrist view the left jaw as it bends, below the forces over time.
"""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from numpy.typing import NDArray
from PIL import Image

from finforce_eval.cli.main import parse
from finforce_eval.cli.twin import write_footage
from finforce_eval.evaluation.forces import Estimator, estimate_forces
from finforce_eval.evaluation.setup import make_setup, read_keypoints
from finforce_eval.figures.figures import BLACK, BLUE, ORANGE, new_figure, outline_edges, style_axes
from finforce_eval.figures.images import FoundPixels
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import ForceSeries
from finforce_keypoints.diagnostics import draw_keypoints
from finforce_sim.footage import build_footage
from finforce_sim.photographer import Wardrobe
from finforce_sim.render import TEXTURE_SIZE, Light, Lighting, Paint, smooth_field
from finforce_sim.scenarios import build_scenario

SEED = 4
EVERY = 3  # image that is shown
SHOWN = (slice(60, 345), slice(105, 535))  # rows and columns of the image around the jaws
SIDE, NEWTON = "left", 9.0  # the jaw that is drawn; length of a newton there [mm]


def build_look(look: Lighting) -> Lighting:
    """Return the light of a workshop, above a wooden table."""
    rng = np.random.default_rng(SEED)
    rows = np.arange(TEXTURE_SIZE)[:, None]
    rings = 0.5 + 0.5 * np.sin(0.35 * rows + 2.5 * smooth_field((TEXTURE_SIZE,) * 2, 40.0, rng))
    grain = 1.0 + 0.03 * smooth_field((TEXTURE_SIZE,) * 2, 1.0, rng)
    wood = np.array([0.42, 0.27, 0.14]) * ((0.85 + 0.15 * rings) * grain)[..., None]
    lamp = Light(direction=np.array([-0.45, 0.75, -0.48]), color=np.full(3, 0.75), casts_shadow=True)
    return replace(look, ambient=np.full(3, 0.45), lights=(lamp,), background=wood, background_distance=0.2)


WARDROBE = {
    "jaw": Paint(color=np.array([0.55, 0.58, 0.62]), second=np.array([0.50, 0.53, 0.57]), pattern="layers", gloss=0.15),
    "holder": Paint(color=np.array([0.05, 0.05, 0.06]), gloss=0.3),
    "palm": Paint(color=np.array([0.08, 0.08, 0.09]), gloss=0.3),
    "thing": Paint(color=np.array([0.62, 0.10, 0.06]), gloss=0.45, sharpness=40.0),
}


def record(folder: Path) -> Path:
    """Render the grasp as a recording."""
    footage = build_footage(build_scenario("grasp_cylinder", light="bright"), SEED)
    taker = footage._photographer
    wardrobe: Wardrobe = replace(taker._wardrobe, dot_color=np.full(3, 0.8), **WARDROBE)
    exposure = replace(taker._look.exposure, brightness=1.0, read_noise=3.0, vignetting=0.1, white=np.ones(3))
    taker._wardrobe, taker._look = wardrobe, replace(build_look(taker._look), exposure=exposure)
    return write_footage(footage, folder)


def draw(recording: Recording, jaws: dict[str, ForceSeries], surfaces: dict[int, tuple]) -> list[Image.Image]:
    """Return the frames: wrist view, bending jaw, forces until then."""
    stamps = jaws[SIDE].stamps
    taken = {each.stamp: each.image.color for each in recording.images.at(stamps[::EVERY])}
    return [_draw_frame(recording, jaws, surfaces[stamp], stamp, color) for stamp, color in taken.items()]


def _draw_frame(recording: Recording, jaws: dict[str, ForceSeries], surface: tuple, stamp: int, color: NDArray):
    figure = new_figure(7.4, 5.0)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.7, 1.0), width_ratios=(1.95, 1.0))
    view, jaw, curve = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, :])
    found = [track.detection for track in recording.jaws.values()]
    rows = [int(np.flatnonzero(each.stamps == stamp)[0]) for each in found]
    points = [
        FoundPixels(each.pixels[row], each.accepted[row], each.reasons[row])
        for each, row in zip(found, rows, strict=True)
    ]
    view.imshow(draw_keypoints(color.copy(), points, (), radius=3.0)[SHOWN])
    view.set_axis_off()
    _draw_jaw(jaw, surface, jaws[SIDE], stamp)
    _draw_curve(curve, jaws, stamp)
    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())


def _draw_jaw(axes, surface: tuple, forces: ForceSeries, stamp: int) -> None:
    rest, bent, triangles = surface
    edges = outline_edges(bent, triangles)
    for vertices, fill, line in ((rest, "#eeeeee", "#c4c4c4"), (bent, "#cfe3f1", BLACK)):
        flat = 1e3 * vertices[:, ::2]
        axes.add_collection(PolyCollection(flat[triangles], facecolors=fill, edgecolors=fill))
        axes.add_collection(LineCollection(flat[edges], colors=line, linewidths=0.8))
    row = int(np.flatnonzero(forces.stamps == stamp)[0])
    force, point = forces.force[row][::2], 1e3 * forces.column("contact_point")[row][::2]
    if np.isfinite([*force, *point]).all() and np.hypot(*force) > 0.05:
        arrow = {"arrowstyle": "-|>", "color": ORANGE, "linewidth": 2.4, "mutation_scale": 16}
        axes.annotate("", point, point - NEWTON * force, arrowprops={**arrow, "shrinkA": 0, "shrinkB": 0})
    size = float(np.linalg.norm(forces.force[row]))
    axes.set_title("waits for the tare" if np.isnan(size) else f"{size:.1f} N", fontsize=12, color=ORANGE)
    axes.set(aspect="equal", xlim=(-18, 42), ylim=(84, -3))
    axes.set_axis_off()


def _draw_curve(axes, jaws: dict[str, ForceSeries], stamp: int) -> None:
    style_axes(axes)
    for (side, forces), colour in zip(jaws.items(), (BLUE, ORANGE), strict=True):
        done = forces.stamps <= stamp
        axes.plot(forces.seconds[done], forces.magnitude[done], color=colour, linewidth=2.0, label=f"{side} jaw")
    own = jaws[SIDE]
    axes.plot(own.seconds, own.true_magnitude, color=BLACK, linewidth=0.9, dashes=(4, 2), label="true")
    axes.set(xlim=(0.0, own.seconds[-1]), ylim=(0.0, 1.15 * np.nanmax(own.true_magnitude)))
    axes.set(xlabel="time [s]", ylabel="force [N]")
    axes.legend(loc="upper left", frameon=False, fontsize=9)


def main() -> None:
    """Render, estimate, draw and write."""
    surfaces: dict[int, tuple] = {}

    def keep(side: str, stamp: int, estimator: Estimator) -> None:
        if side == SIDE:
            bent = np.array(estimator.surface())
            rest = next(iter(surfaces.values()))[0] if surfaces else bent
            surfaces[stamp] = (rest, bent, np.asarray(estimator.surface_triangles))

    with TemporaryDirectory() as scratch:
        bag = record(Path(scratch) / "grasp")
        options = parse(["view", str(bag), "--from", "images", "--calibration", "twin", "--contact", "estimate"])
        (recording,) = read_keypoints(options)
        frames = draw(recording, estimate_forces(recording, make_setup(options), watch=keep), surfaces)
    rate = round(1e3 * EVERY / 30)
    frames[0].save(sys.argv[1], save_all=True, append_images=frames[1:], duration=rate, loop=0, quality=55, method=6)


if __name__ == "__main__":
    main()
