"""Diagnostics of a key point detector: words, and key points drawn into a picture."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finforce.health import Level, Outcome
from finforce.optional import import_cv2
from finforce_keypoints.images import COLOR

if TYPE_CHECKING:
    from finforce_keypoints.detector import KeypointDetector
    from finforce_keypoints.geometry.jaw_localizer import JawKeypoints
    from finforce_keypoints.images import RgbdFeed

LEAST_VISIBLE = 3  # key points; a solver gives no force with fewer


def outcome_of_keypoints(found: JawKeypoints | None, side: str, warning: str = "") -> Outcome:
    """Return how well a jaw was seen, None: it was not found; with what the detector warns of, "" for nothing."""
    more = f"; {warning}" if warning else ""
    if found is None:
        return Outcome(level=Level.WARN, reason="lost", text=f"the {side} jaw was not found in the image{more}")
    visible, total = int(np.sum(found.valid)), len(found.valid)
    text = f"{visible} of {total} key points visible{more}"
    enough = visible >= LEAST_VISIBLE
    level = Level.OK if enough and not warning else Level.WARN
    return Outcome(level=level, reason="visible" if enough else "hidden", text=text)


def describe(feed: RgbdFeed, method: str, found: JawKeypoints | None) -> dict[str, str]:
    """Return what is known of the camera, the pixel_detector and a jaw's last key points, as text."""
    camera = feed.stream.camera
    known = {
        "detection_method": method,
        "colour images": feed.topic or "none yet",
        "camera": "no camera_info yet" if camera is None else f"{camera.width} x {camera.height}",
        "stamps of colour images": feed.arrivals[COLOR].rhythm,
        **{f"missing {name} images": str(arrivals.count_losses()) for name, arrivals in feed.arrivals.items()},
        "overtaken while waiting for depth": str(feed.passed),
        "taken without depth": str(feed.alone),
    }
    return known if found is None else known | _describe_jaw(found)


def _describe_jaw(found: JawKeypoints) -> dict[str, str]:
    """Return the figures of a jaw's last key points."""
    hidden = Counter(str(reason) for reason in found.reasons if reason)
    spread = found.stddev[found.valid]
    x, y, z = found.T_camera_jaw[:3, 3]
    return {
        "visible": f"{int(found.valid.sum())} of {len(found.valid)}",
        "hidden": ", ".join(f"{count} {reason}" for reason, count in hidden.most_common()) or "none",
        "likelihood median": f"{float(np.median(found.likelihood)):.2f}",
        "stddev median [mm]": f"{1e3 * float(np.median(spread)):.2f}" if len(spread) else "-",
        "jaw origin in the camera [mm]": f"{1e3 * x:.1f} {1e3 * y:.1f} {1e3 * z:.1f}",
    }


def describe_names(names: Sequence[str], detector: KeypointDetector) -> str:
    """Return, as JSON, what the rows of the key point clouds are, which of them to join, and who finds them."""
    said: Mapping[str, object] = {
        "names": list(names),
        "skeleton": build_skeleton(names),
        "model": detector.name,
        "sha256": detector.sha256,
    }
    return json.dumps(said)


def build_skeleton(names: Sequence[str]) -> list[list[int]]:
    """Return pairs of rows to be joined in a picture: neighbours along a band, and the two ends of a rib.

    Names end with their number along the band (inner_1, inner_2, outer_1, ...); `tip` ends every band.
    """
    bands: dict[str, dict[int, int]] = {}
    for row, name in enumerate(names):
        if match := re.fullmatch(r"(.+)_(\d+)", name):
            bands.setdefault(match[1], {})[int(match[2])] = row
    pairs = []
    for band in bands.values():
        rows = [band[number] for number in sorted(band)] + ([list(names).index("tip")] if "tip" in names else [])
        pairs += [[one, other] for one, other in zip(rows, rows[1:], strict=False)]
    if len(bands) == 2:
        one, other = bands.values()
        pairs += [[one[number], other[number]] for number in sorted(one.keys() & other.keys())]
    return pairs


RADIUS, FREE = 4, 1  # [px] of a disc, and of what it leaves free in its middle
COLORS = {  # by the reason why a key point is not used
    "": (40, 220, 60),
    "likelihood": (230, 60, 50),
    "depth": (60, 120, 255),
    "workspace": (250, 170, 30),
    "image": (160, 160, 160),
}
LINE = (250, 230, 60)
_FAR = 1e4  # [px] outside any picture, where nothing is drawn


def draw_keypoints(
    color: NDArray[np.uint8],
    jaws: Iterable[JawKeypoints],
    skeleton: Sequence[Sequence[int]] = (),
) -> NDArray[np.uint8]:
    """Return a copy of a picture (h, w, 3) with a disc per key point, and lines between used neighbours.

    Green is used; red, blue, orange and grey say why not: likelihood, depth, workspace, outside the image.
    """
    cv2, picture = import_cv2(), color.copy()

    def place(pixel: NDArray) -> tuple[int, int]:
        return tuple(np.rint(np.clip(pixel, -_FAR, _FAR)).astype(int).tolist())

    for jaw in jaws:
        for one, other in skeleton:
            if jaw.valid[one] and jaw.valid[other]:
                cv2.line(picture, place(jaw.pixels[one]), place(jaw.pixels[other]), LINE)
        for pixel, reason in zip(jaw.pixels, jaw.reasons, strict=True):
            if np.isfinite(pixel).all():
                centre = place(pixel)
                cv2.circle(picture, centre, RADIUS, (0, 0, 0), cv2.FILLED)
                cv2.circle(picture, centre, RADIUS - 1, COLORS.get(str(reason), COLORS["image"]), cv2.FILLED)
                seen = tuple(slice(max(middle - FREE, 0), max(middle + FREE + 1, 0)) for middle in reversed(centre))
                picture[seen] = color[seen]
    return picture
