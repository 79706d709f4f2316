"""Printed dots painted into rendered images, on the key points that the camera sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce.camera import project
from finforce.transforms import pose_from_quaternion
from finforce_eval.recordings.tracks import JawTrack
from finforce_ifea.jaw.jaw import Jaw
from finforce_keypoints.images import RgbdImage

DIAMETER = 0.003  # [m]
COLOUR = np.array([40.0, 200.0, 60.0])  # of 255, where the image is of medium brightness
_MEDIUM = 120.0
_REACH = 20  # [px] around a dot that are painted at most
_STEP = 1e-4  # [m], of the differences that give a dot's shape in the image


@dataclass(frozen=True, kw_only=True, eq=False)
class _Disc:
    """A dot in the image: its centre [px], and what maps pixels from it onto the jaw's side (2, 2) [m/px]."""

    centre: NDArray
    onto_side: NDArray


def paint_dots(image: RgbdImage, stamp: int, jaws: Mapping[str, Jaw], tracks: Mapping[str, JawTrack]) -> RgbdImage:
    """Return an image with a dot on every visible key point and on the reference points.

    A dot is as bright as what it is printed on, with the image's own noise.

    Args:
        image: rendered.
        stamp: of it [ns].
        jaws: by side.
        tracks: the truth by side.
    """
    color = image.color.astype(np.float32)
    for side, track in tracks.items():
        row = int(np.searchsorted(track.sight.stamps, stamp))
        pose = pose_from_quaternion(track.true_pose.position[row], track.true_pose.quaternion[row])
        points = track.sight.points[row][track.sight.visible[row]]
        for point in (*points, jaws[side].reference_point):
            _paint(color, _place(point, pose, image))
    return replace(image, color=np.round(np.clip(color, 0.0, 255.0)).astype(np.uint8))


def _place(point: NDArray, pose: NDArray, image: RgbdImage) -> _Disc:
    """Return the disc about a point (3,) [m] of the jaw's side, y = const."""
    places = point + np.array([[0.0, 0.0, 0.0], [_STEP, 0.0, 0.0], [0.0, 0.0, _STEP]])
    pixels = project(places @ pose[:3, :3].T + pose[:3, 3], image.camera)
    return _Disc(centre=pixels[0], onto_side=np.linalg.inv((pixels[1:] - pixels[0]).T / _STEP))


def _paint(color: NDArray, disc: _Disc) -> None:
    """Paint a disc into an image (h, w, 3), its rim's pixels by the part that is covered."""
    column, row = (int(value) for value in np.round(disc.centre))
    rows = slice(max(row - _REACH, 0), max(row + _REACH + 1, 0))
    columns = slice(max(column - _REACH, 0), max(column + _REACH + 1, 0))
    part = color[rows, columns]
    if not part.size:
        return
    grid = np.stack(np.meshgrid(np.arange(part.shape[1]), np.arange(part.shape[0])), axis=-1)
    away = (grid + (columns.start, rows.start) - disc.centre) @ disc.onto_side.T
    pitch = np.sqrt(abs(np.linalg.det(disc.onto_side)))
    cover = np.clip(0.5 + (0.5 * DIAMETER - np.linalg.norm(away, axis=-1)) / pitch, 0.0, 1.0)[..., None]
    brightness = part.mean(axis=2, keepdims=True) / _MEDIUM
    part += cover * (COLOUR * brightness - part)
