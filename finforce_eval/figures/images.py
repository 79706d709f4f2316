"""What the key point detector made of a recording's images, as pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce_eval.figures.figures import GREY, new_figure
from finforce_eval.recordings.tracks import DetectionTrack, JawTrack, Recording
from finforce_eval.table import ForceSeries
from finforce_keypoints.diagnostics import COLORS

COUNT, COLUMNS = 6, 2
WIDTH = 11.0  # [in] of a figure
MARGIN = 0.08  # of the jaws' extent in the image that is left on each side of them
LEAST_MARGIN = 12  # [px]
MEANING = {
    "": "used",
    "likelihood": "likelihood too low",
    "depth": "no depth",
    "workspace": "outside the workspace",
    "image": "outside the image",
}
COLOURS = {reason: np.array(COLORS[reason]) / 255.0 for reason in MEANING}
WHITE, BLACK = "white", "black"


class Region(NamedTuple):
    """A part of an image: first column and row, width and height [px]."""

    left: int
    top: int
    width: int
    height: int


def choose_images(stamps: NDArray[np.int64], largest: int | None = None) -> NDArray[np.int64]:
    """Return the stamps of six images, evenly spread; the one nearest to `largest` is taken in place of its neighbour.

    Args:
        stamps: (n,) of all images [ns], rising.
        largest: time of the largest force [ns]; None without any.
    """
    count = min(COUNT, len(stamps))
    # the middles of equal parts: first and last image show the least
    rows = ((np.arange(count) + 0.5) * len(stamps) / count).astype(int)
    if largest is not None:
        row = int(np.argmin(np.abs(stamps - largest)))
        rows[np.argmin(np.abs(rows - row))] = row
    return stamps[rows]


def stamp_of_largest(results: Sequence[ForceSeries]) -> int | None:
    """Return the time of the largest force of all jaws [ns] in the images that are to be scored; None without any."""
    chosen = [each.at(each.scored & each.solved) for each in results]
    known = [(each.magnitude.max(), each.stamps[each.magnitude.argmax()]) for each in chosen if len(each)]
    return int(max(known)[1]) if known else None


def find_region(pixels: NDArray[np.float64], width: int, height: int) -> Region:
    """Return the part of an image in which pixels (n, 2) lie, with a margin; the whole image without any."""
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    size = np.array([width, height])
    seen = seen[((seen >= 0) & (seen < size)).all(axis=1)]
    if not len(seen):
        return Region(0, 0, width, height)
    low, high = seen.min(axis=0), seen.max(axis=0)
    margin = np.maximum(MARGIN * (high - low), LEAST_MARGIN)
    first = np.maximum(np.floor(low - margin), 0).astype(int)
    last = np.minimum(np.ceil(high + margin) + 1, size).astype(int)
    return Region(*first.tolist(), *(last - first).tolist())


def draw_images(recording: Recording, results: Sequence[ForceSeries], skeleton: Sequence[Sequence[int]] = ()) -> Any:
    """Draw six images where the jaws are, with the key points found, the true ones, and the forces.

    Args:
        recording: with images and detections.
        results: of its jaws.
        skeleton: pairs of key points to be joined.

    Returns:
        A matplotlib figure.

    Raises:
        RecordingError: an image is damaged.
    """
    largest = stamp_of_largest(results)
    stamps = choose_images(recording.images.stamps, largest)
    camera = recording.images.camera
    region = find_region(known_pixels(recording, stamps), camera.width, camera.height)
    lines = -(-len(stamps) // COLUMNS)
    figure = new_figure(WIDTH, lines * (WIDTH / COLUMNS * region.height / region.width + 0.3) + 0.4)
    panels = figure.subplots(lines, COLUMNS, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    reasons: set[str] = set()
    for axes, taken in zip(panels, recording.images.at(stamps), strict=False):
        axes.imshow(taken.image.color)
        for track in detected_jaws(recording).values():
            reasons |= _draw_found(axes, track.detection, taken.stamp, skeleton)
            _draw_truth(axes, track, taken.stamp)
        axes.set_xlim(region.left - 0.5, region.left + region.width - 0.5)
        axes.set_ylim(region.top + region.height - 0.5, region.top - 0.5)
        title = describe_image(recording, results, taken.stamp, taken.stamp == largest)
        axes.set_title(title, loc="left", fontsize=9)
    _explain(figure, reasons, has_truth=any(track.sight is not None for track in detected_jaws(recording).values()))
    return figure


def detected_jaws(recording: Recording) -> Mapping[str, JawTrack]:
    """Return the jaws that a detector looked for."""
    return {side: track for side, track in recording.jaws.items() if track.detection is not None}


def known_pixels(recording: Recording, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return where the key points truly are, where that is known, else where they were found and used (n, 2) [px]."""
    pixels = [np.zeros((0, 2))]
    for track in detected_jaws(recording).values():
        known = track.sight or track.detection
        chosen = np.isin(known.stamps, stamps)[:, None] & (track.sight.visible if track.sight else known.accepted)
        pixels.append(known.pixels[chosen])
    return np.concatenate(pixels)


def _draw_found(axes: Any, detection: DetectionTrack, stamp: int, skeleton: Sequence[Sequence[int]]) -> set[str]:
    """Draw the key points found in the image at a stamp [ns], coloured by why they are not used; return these words."""
    row = int(np.searchsorted(detection.stamps, stamp))
    pixels, reasons = detection.pixels[row], detection.reasons[row]
    for pair in skeleton:
        if detection.accepted[row][list(pair)].all():
            axes.plot(*pixels[list(pair)].T, color=COLOURS[""], linewidth=0.8)
    found = np.isfinite(pixels).all(axis=1)
    for reason in set(reasons[found].tolist()):
        style = {"markeredgecolor": BLACK, "markeredgewidth": 0.6, "markersize": 5}
        axes.plot(*pixels[found & (reasons == reason)].T, "o", color=COLOURS[reason], **style)
    return set(reasons[found].tolist())


def _draw_truth(axes: Any, track: JawTrack, stamp: int) -> None:
    """Draw a cross at each true key point, black where it is hidden."""
    if track.sight is None:
        return
    for row in np.flatnonzero(track.sight.stamps == stamp):
        visible = track.sight.visible[row]
        for chosen, color in ((visible, WHITE), (~visible, BLACK)):
            axes.plot(*track.sight.pixels[row][chosen].T, "+", color=color, markersize=4, markeredgewidth=0.8)


def describe_image(recording: Recording, results: Sequence[ForceSeries], stamp: int, is_largest: bool = False) -> str:
    """Return the time of an image in its recording, and the forces that were estimated and measured then."""
    seconds = (stamp - int(recording.images.stamps[0])) * 1e-9
    words = [f"t = {seconds:.2f} s", *(_describe_force(result, stamp, len(results) > 1) for result in results)]
    return ",  ".join(word for word in words if word) + ("  (largest)" if is_largest else "")


def _describe_force(result: ForceSeries, stamp: int, is_named: bool) -> str:
    """Return the force on one jaw in words."""
    rows = np.flatnonzero(result.stamps == stamp)
    if not rows.size:
        return ""
    force, truth = float(result.magnitude[rows[0]]), float(result.true_magnitude[rows[0]])
    estimate = f"{force:.2f} N" if np.isfinite(force) else "no estimate"
    known = f" (true {truth:.2f} N)" if np.isfinite(truth) else ""
    return f"{result.side} {estimate}{known}" if is_named else estimate + known


def _explain(figure: Any, reasons: Iterable[str], *, has_truth: bool) -> None:
    """Say below the pictures what the marks mean."""
    from matplotlib.lines import Line2D

    style = {"linestyle": "", "markeredgecolor": "black", "markeredgewidth": 0.6}
    entries = [
        Line2D([], [], marker="o", color=COLOURS[reason], label=label, **style)
        for reason, label in MEANING.items()
        if reason in reasons
    ]
    if has_truth:
        for color, label in ((WHITE, "true pixel, visible"), (BLACK, "true pixel, hidden")):
            entries.append(Line2D([], [], marker="+", color=color, linestyle="", label=label))
    if entries:
        style = {"facecolor": GREY, "edgecolor": "none", "framealpha": 1.0, "fontsize": 9}
        figure.legend(handles=entries, loc="outside lower left", ncols=len(entries), **style)
