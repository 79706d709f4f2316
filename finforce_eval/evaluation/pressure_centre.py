"""The point at which the measured force meets a jaw, as a height on the undeformed inner surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_eval.evaluation.scoring import match_samples
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.jaw.section import FaceLine

# A vertex farther than this from the plane of the inner surface is not on it [m]; rows closer than this are one.
_ON_FACE = 1e-4
# Below it the direction of a force says nothing of its location [N].
_LEAST_FORCE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class ForceLines:
    """Lines of action of a force, image by image, in the plane of the finger (x, z of the jaw frame).

    Attributes:
        points: (n, 2) a point of each line [m], NaN where the line is not known.
        directions: (n, 2) unit vectors along the force on the jaw.
    """

    points: NDArray[np.float64]
    directions: NDArray[np.float64]


class InnerSurface:
    """The middle line of a jaw's inner surface, undeformed and deformed.

    Args:
        surface0: undeformed vertices (n, 3) [m], jaw frame.
        face: the undeformed inner face.
    """

    def __init__(self, surface0: NDArray[np.float64], face: FaceLine) -> None:
        """Gather the vertices of each height."""
        self.face_x = face.plane
        self._rows = np.flatnonzero(face.holds(surface0))
        steps = np.round(surface0[self._rows, 2] / _ON_FACE).astype(np.int64)
        _, self._group, self._count = np.unique(steps, return_inverse=True, return_counts=True)
        self.heights = self._average(surface0[:, 2])

    def _average(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mean over the width of a value per vertex."""
        return np.bincount(self._group, weights=values[self._rows], minlength=len(self._count)) / self._count

    def cut(self, surface: NDArray[np.float64], point: NDArray[np.float64], direction: NDArray[np.float64]) -> float:
        """Return the height on the undeformed surface [m] of the point where a line first meets the deformed one.

        Args:
            surface: deformed vertices (n, 3) [m], in the order of the undeformed ones.
            point: x, z of a point of the line (2,) [m].
            direction: x, z of its unit vector (2,); of several crossings the first along it counts.

        Returns:
            NaN where the line meets no part of the surface, or is not known.
        """
        if not np.isfinite([*point, *direction]).all():
            return float("nan")
        offset = np.stack([self._average(surface[:, axis]) for axis in (0, 2)], axis=1) - point
        side = direction[0] * offset[:, 1] - direction[1] * offset[:, 0]
        crossed = np.flatnonzero((side[:-1] <= 0) != (side[1:] <= 0))
        if not crossed.size:
            return float("nan")
        share = side[crossed] / (side[crossed] - side[crossed + 1])
        along = offset @ direction
        first = int(np.argmin(along[crossed] + share * (along[crossed + 1] - along[crossed])))
        low, high = self.heights[crossed[first]], self.heights[crossed[first] + 1]
        return float(low + share[first] * (high - low))


def true_lines(recording: Recording, side: str, stamps: NDArray[np.int64], inner_face_x: float) -> ForceLines:
    """Return the lines of action of the measured force at the given stamps.

    With a measured torque T about the jaw's origin the line is that of all x with x cross F = T. A recording without
    torque (all of them zero) tells the line only if a cylinder was pressed on without friction: the force then passes
    through the axis, at x = face + radius - displacement, z = height of the `case.json`, and the displacement of the
    phases is linear over a ramp. Else nothing is known, nor from a force that is along x throughout: it stands for a
    magnitude without direction.

    Args:
        recording: with ground truth of that side.
        side: "left" or "right".
        stamps: (n,) [ns].
        inner_face_x: plane of the undeformed inner surface [m].
    """
    truth = recording.truth(side)
    force = match_samples(truth.stamps_ns, truth.force, stamps)[:, [0, 2]]
    square = (force**2).sum(axis=1, keepdims=True)
    square[square < _LEAST_FORCE**2] = np.nan
    directions = force / np.sqrt(square)
    if np.abs(np.nan_to_num(truth.torque)).max(initial=0.0) > 0.0:
        turn = match_samples(truth.stamps_ns, truth.torque, stamps)[:, 1:2]
        # of z Fx - x Fz = Ty the point nearest to the origin
        return ForceLines(points=turn * np.stack([-force[:, 1], force[:, 0]], axis=1) / square, directions=directions)
    axis = _cylinder_axis(recording, stamps, inner_face_x)
    has_direction = np.nan_to_num(truth.force[:, 2]).any()
    return ForceLines(points=axis if has_direction else np.full_like(axis, np.nan), directions=directions)


def _cylinder_axis(recording: Recording, stamps: NDArray[np.int64], inner_face_x: float) -> NDArray[np.float64]:
    """Return x, z of the axis of the bench's cylinder (n, 2) [m], NaN where it is not known."""
    shape = recording.case.get("object")
    if recording.phases is None or not isinstance(shape, Mapping) or shape.get("kind") != "cylinder":
        return np.full((len(stamps), 2), np.nan)
    radius, z = 0.5e-3 * _number(shape, "diameter"), 1e-3 * _number(shape, "z")
    x = inner_face_x + radius - 1e-3 * recording.phases.displacement_at(stamps)
    return np.stack([x, np.full(len(stamps), z)], axis=1)


def _number(values: Mapping[str, Any], name: str) -> float:
    """Return a number of the case, NaN when it holds none."""
    value = values.get(name)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number else float("nan")
