"""A moving picture of a recording: the key points in its images, and the force as it comes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce_eval.errors import RecordingError
from finforce_eval.figures.figures import BLACK, BLUE, ORANGE, new_figure, style_axes
from finforce_eval.figures.images import (
    RADIUS,
    Region,
    detected_jaws,
    enlarge,
    find_region,
    found_at,
    known_pixels,
    moved,
)
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import ForceSeries
from finforce_keypoints.diagnostics import draw_keypoints

RATE = 10.0  # images a second
SIZE = (4.6, 3.9)  # [in], at 120 px
QUALITY = 45  # of WebP
SIDES = {"left": BLUE, "right": ORANGE}


class _Curve(NamedTuple):
    """A force [N] over time [s], and its line."""

    line: Any
    time: NDArray
    magnitude: NDArray


def write_movie(
    recording: Recording, results: Sequence[ForceSeries], path: str | Path, skeleton: Sequence[Sequence[int]] = ()
) -> None:
    """Write what a detector and the solvers made of a recording as an animated WebP or GIF, in its own time.

    Args:
        recording: with images and detections.
        results: of its jaws.
        path: of the file; its ending says which.
        skeleton: pairs of key points to be joined.

    Raises:
        RecordingError: there are no images, or one is damaged; the ending is neither .webp nor .gif.
    """
    path = Path(path)
    if path.suffix not in (".webp", ".gif"):
        raise RecordingError(f"movie {path}: expected a name that ends in .webp or .gif")
    if recording.images is None:
        raise RecordingError(f"{recording.name}: no images to make a movie of")
    first, *others = _draw(recording, results, skeleton)
    path.parent.mkdir(parents=True, exist_ok=True)
    first.save(path, save_all=True, append_images=others, duration=round(1e3 / RATE), loop=0, quality=QUALITY, method=6)


def _draw(recording: Recording, results: Sequence[ForceSeries], skeleton: Sequence[Sequence[int]]) -> list:
    """Return the pictures of the movie."""
    from PIL import Image
    from tqdm import tqdm

    stamps = _thin(recording.images.stamps)
    region = find_region(known_pixels(recording, stamps), recording.images.camera.width, recording.images.camera.height)
    figure = new_figure(*SIZE)
    image, force = figure.subplots(2, 1, height_ratios=[1.6, 1.0])
    image.set_axis_off()
    style_axes(force)
    shown, start = image.imshow(_blank(region)), stamps[0]
    curves = _prepare_curves(force, results, stamps)
    pictures = []
    for taken in tqdm(recording.images.at(stamps), total=len(stamps), desc="movie", leave=False, disable=None):
        found = [found_at(track.detection, taken.stamp) for track in detected_jaws(recording).values()]
        picture, scale = enlarge(taken.image.color, region)
        picture = draw_keypoints(picture, [moved(entry, region, scale) for entry in found], skeleton, radius=RADIUS)
        shown.set_data(picture)
        for line, time, magnitude in curves:
            past = time <= 1e-9 * (taken.stamp - start)
            line.set_data(time[past], magnitude[past])
        figure.canvas.draw()
        pictures.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()))
    return pictures


def _prepare_curves(force: Any, results: Sequence[ForceSeries], stamps: NDArray[np.int64]) -> list[_Curve]:
    """Draw the true forces and return the curves that will grow."""
    start, curves = stamps[0], []
    for result in results:
        time = 1e-9 * (result.stamps - start)
        force.plot(time, result.true_magnitude, color=BLACK, linewidth=0.9, alpha=0.6, dashes=(4, 1.5))
        (curve,) = force.plot([], [], color=SIDES[result.side], linewidth=1.6, label=f"{result.side} jaw")
        known = np.isfinite(result.magnitude)  # images that need no answer of their own leave no gap
        curves.append(_Curve(curve, time[known], result.magnitude[known]))
    highest = max(float(np.nanmax(np.r_[result.magnitude, result.true_magnitude, 0.1])) for result in results)
    force.plot([], [], color=BLACK, linewidth=0.9, alpha=0.6, dashes=(4, 1.5), label="true")
    force.set(xlabel="time [s]", ylabel="force [N]", ylim=(0, 1.1 * highest), xlim=(0, 1e-9 * (stamps[-1] - start)))
    force.legend(loc="upper left", frameon=False, fontsize=8)
    return curves


def _blank(region: Region) -> NDArray[np.uint8]:
    """Return an empty picture of a region, as large as an enlarged one."""
    return enlarge(np.zeros((region.top + region.height, region.left + region.width, 3), np.uint8), region)[0]


def _thin(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the stamps [ns] nearest to even steps of the movie's rate."""
    count = max(2, round(1e-9 * (stamps[-1] - stamps[0]) * RATE))
    return stamps[np.unique(np.linspace(0, len(stamps) - 1, count).round().astype(int))]
