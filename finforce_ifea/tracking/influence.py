"""Influence coefficients of an unloaded jaw, and a test for an object out of its reach.

Key points say of an unloaded jaw how deep d [m] something would press it. With the modes m_k [m/m] by which a depth
moves the points, their deviations e_k [m] from the tared jaw and the covariance N of one of them,

    d = sum m_k . e_k / sum m_k . m_k,    Var d = sum m_k . N m_k / (sum m_k . m_k)^2.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import DEPTH
from finforce_ifea.contact_mechanics.pressed_jaw import PressedState, RigidContact
from finforce_ifea.observation import Contact, is_out_of_reach
from finforce_ifea.tare import OFFSET_STDDEV, Tare

_HEIGHTS = 13
_TOUCH = 3e-5
# Distance to either side over which the rotation of the face is computed [m].
_BESIDE = 2e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class InfluenceCoefficients:
    """Answers of the unloaded jaw to objects at several heights.

    Attributes:
        heights: where they touch (m,) [m], rising.
        motions: of the key points in the plane per force (m, K, 2) [m/N].
        stiffness: force over depth (m,) [N/m].
        turns: of the inner face where they touch, by the depth (m,) [rad/m].
        fits: results of `bound_force` for the key points that it saw last.
    """

    heights: NDArray
    motions: NDArray
    stiffness: NDArray
    turns: NDArray
    fits: dict = field(default_factory=dict, repr=False)

    def at(self, height: float) -> NDArray:
        """Return the motions per force (K, 2) [m/N] at a height [m]."""
        return self._interpolate(self.motions, height)

    def slope_at(self, height: float) -> NDArray:
        """Return the derivative of the motions by the height (K, 2) [1/N]."""
        return self._interpolate(np.gradient(self.motions, self.heights, axis=0), height)

    def stiffness_at(self, height: float | NDArray) -> float | NDArray:
        """Return force over depth [N/m] at heights [m]; below and above, that of the nearest one."""
        return np.interp(height, self.heights, self.stiffness)

    def turn_at(self, height: float) -> float:
        """Return the turn of the inner face by the depth [rad/m] at a height [m]; beyond, that of the nearest one."""
        return float(np.interp(height, self.heights, self.turns))

    def _interpolate(self, values: NDArray, height: float) -> NDArray:
        """Return values (m, ...) between their heights."""
        upper = int(np.clip(np.searchsorted(self.heights, height), 1, len(self.heights) - 1))
        low, high = self.heights[upper - 1], self.heights[upper]
        share = np.clip((height - low) / (high - low), 0.0, 1.0)
        return (1.0 - share) * values[upper - 1] + share * values[upper]

    def bound_force(self, deviations: NDArray) -> float:
        """Return the standard deviation [N] of a force that key points seen at rest leave room for, at any height.

        At each height, the force that explains the deviations best and its own standard deviation are taken together;
        all heights are alike.

        Args:
            deviations: of the key points from their places at rest (K, 3) [m], NaN where unseen.
        """
        seen = np.isfinite(deviations[:, 0])
        gains, stddevs = self.fit_forces(seen)
        loads = gains @ deviations[seen][:, ::2].ravel()
        return float(np.sqrt((np.maximum(loads, 0.0) ** 2 + stddevs**2).mean()))

    def fit_forces(self, seen: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
        """Return gains (m, 2 n) [N/m] of the key points (K,) that are seen, and standard deviations (m,) [N].

        They are kept, for the same points are seen most of the time.
        """
        key = seen.tobytes()
        if key not in self.fits:
            fits = [_fit_load(motions[seen], np.full(int(seen.sum()), OFFSET_STDDEV)) for motions in self.motions]
            gains, stddevs = zip(*fits, strict=True)
            self.fits.clear()
            self.fits[key] = np.stack(gains), np.array(stddevs)
        return self.fits[key]


def measure_influence(contact: RigidContact, probe: Any, keypoints: int) -> InfluenceCoefficients:
    """Return the answers of a contact's model, whose `probe` is that of the key points.

    Args:
        contact: model and contact surface, see `RigidContact`.
        probe: of the key points.
        keypoints: their number.
    """
    low, high = contact.surface.heights[[0, -1]]
    # the ends of the surface are left out: next to the clamp a force moves hardly anything
    heights = np.linspace(low + 0.12 * (high - low), high - 0.05 * (high - low), _HEIGHTS)
    motions, (stiffness, turns) = np.zeros((_HEIGHTS, keypoints, 2)), np.zeros((2, _HEIGHTS))
    radius = float(np.sqrt(contact.indenter.lowest * contact.indenter.highest))
    for row, height in enumerate(heights):
        q, state = press_lightly(contact, radius, height)
        stiffness[row] = np.linalg.norm(state.force_modes[:, DEPTH])
        modes = contact.model.project(probe, q, state.modes)
        motions[row] = modes[:, ::2, DEPTH] / stiffness[row]
        turns[row] = _measure_turn(contact, q, state, height)
    return InfluenceCoefficients(heights=heights, motions=motions, stiffness=stiffness, turns=turns)


def _measure_turn(contact: RigidContact, q: NDArray, state: PressedState, height: float) -> float:
    """Return by how much the inner face turns at a height [m], by the depth of an object there [rad/m]."""
    moved = contact.place_points(q + _TOUCH * state.modes[:, DEPTH]) - contact.place_points(q)
    heights = contact.surface.points[:, 2]
    beside = np.abs(heights - height) < _BESIDE
    return abs(float(np.polyfit(heights[beside] - height, moved[beside, 0] / _TOUCH, 1)[0]))


def press_lightly(contact: RigidContact, shape: float, height: float) -> tuple[NDArray, PressedState]:
    """Return unknowns (size,) and linearisation of the unloaded jaw that an object of a shape just touches."""
    q, place = contact.begin(height), np.array([0.0, shape, height])
    place[DEPTH] = _TOUCH if contact.face.is_flat else contact.find_touch(place) + _TOUCH
    return q, contact.linearize(q, place)


# Standard deviation of an offset common to all key points [m]: a depth scale wrong by 1 % at 0.15 m.
_COMMON_OFFSET = 1.5e-3


def _fit_load(modes: NDArray, deviation: NDArray) -> tuple[NDArray, float]:
    """Return the gain (2 n,) of the least squares of one mode (n, 2) on offsets of n key points, and its deviation.

    Each is off by chance by its deviation (n,) [m]; all together are, too, as a wrong depth scale moves them alike.
    """
    common = np.broadcast_to(np.eye(2), (len(modes), 2, 2))
    design = np.concatenate([modes[:, :, None], common], axis=2) / deviation[:, None, None]
    design = np.concatenate([design.reshape(-1, 3), np.diag([0.0, 1.0, 1.0]) / _COMMON_OFFSET])
    covariance = np.linalg.pinv(design.T @ design)
    gain = (covariance @ design.T)[0, :-3] / np.repeat(deviation, 2)
    return gain, float(np.sqrt(max(covariance[0, 0], 1e-300)))


def explain_offsets(modes: NDArray, tare: Tare, offset_stddev: float) -> float:
    """Return by how many standard deviations one mode (K, 2) explains the offsets of a tare; see `_fit_load`."""
    seen = tare.counts > 0
    gain, stddev = _fit_load(modes[seen], np.sqrt(offset_stddev**2 + tare.offset_variance(0.0)[seen]))
    return float(gain @ tare.offsets[seen][:, [0, 2]].ravel() / stddev)


class OffsetChange(NamedTuple):
    """Root mean square over the key points of what a load explains of a change of offsets, and of the rest [m]."""

    bend: float
    shift: float


def split_change(modes: NDArray, change: NDArray) -> OffsetChange:
    """Return what one mode (K, 2), in x and z, explains of a change (K, 3) [m] of the places of key points."""
    mode, plane = modes.ravel(), change[:, [0, 2]].ravel()
    bend = mode * (mode @ plane) / (mode @ mode)
    rest = np.r_[plane - bend, change[:, 1]]
    return OffsetChange(*(float(np.sqrt(np.sum(part**2) / len(change))) for part in (bend, rest)))


# Largest apparent depth of an unloaded jaw in one image [m].
LARGEST_DEPTH = 0.3e-3
# The same on average over `_AVERAGED` images [m].
LARGEST_MEAN_DEPTH = 0.15e-3
# The same in one image, and on average [sigma].
_CHANCE = 4.0
_AVERAGED = 30
# Distance from its position at rest from which a key point is ignored [m].
_FARTHEST = 3e-3
# Least number of key points.
_FEWEST = 4
# Largest standard deviation of the depth [m].
_VAGUE = 0.3e-3
_NEARER, _REST_REACH = 0.75, 1e-3


class UnloadedCheck:
    """Checks that a jaw is unloaded while its object is out of reach.

    Args:
        keypoints: drawn (K, 3) [m].
        face_x: of the undeformed inner surface [m].
        modes: gives the motion of the key points in x and z by the depth (K, 2) [m/m].
    """

    def __init__(self, keypoints: NDArray, face_x: float, modes: Callable[[], NDArray]) -> None:
        self._keypoints, self._face_x, self._find_modes = keypoints, face_x, modes
        self.reset()

    def reset(self) -> None:
        """Forget what was seen."""
        self._contact: Contact | None = None
        self._is_out_of_reach = False
        self._modes: NDArray | None = None
        self._mean, self._count = 0.0, 0

    def is_idle(self, contact: Contact, points: NDArray, tare: Tare) -> bool:
        """Return True if the contact's object is away and the key points (K, 3) [m] show the unloaded jaw."""
        if contact is not self._contact:
            self._contact, self._is_out_of_reach = contact, is_out_of_reach(contact, self._face_x)
        if not self._is_out_of_reach:
            self._modes, self._count = None, 0
            return False
        if self._modes is None:
            self._modes = self._find_modes()
        return self._is_at_rest(points - self._keypoints - tare.offsets, tare)

    def _is_at_rest(self, deviations: NDArray, tare: Tare) -> bool:
        """Return True if deviations (K, 3) [m] from the tared jaw are chance."""
        distances = np.sqrt((deviations * deviations).sum(axis=1))
        near = (distances < _FARTHEST) & (tare.counts > 0)
        known = int(np.isfinite(distances).sum())
        if near.sum() < max(_FEWEST, _NEARER * known):
            return False
        if np.mean(np.sort(distances[near])[: int(_NEARER * known) + 1] ** 2) > _REST_REACH**2:
            return False
        modes, deviations = self._modes[near], deviations[near][:, [0, 2]]
        gain = float((modes * modes).sum()) + 1e-12
        depth = float((modes * deviations).sum()) / gain
        stddev = float(np.sqrt((modes @ tare.noise[::2, ::2] * modes).sum())) / gain
        self._count = min(self._count + 1, _AVERAGED)
        self._mean += (depth - self._mean) / self._count
        return (
            stddev < _VAGUE
            and abs(depth) < max(LARGEST_DEPTH, _CHANCE * stddev)
            and abs(self._mean) < max(LARGEST_MEAN_DEPTH, _CHANCE * stddev / np.sqrt(self._count))
        )
