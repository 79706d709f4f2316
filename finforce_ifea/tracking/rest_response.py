"""How an unloaded jaw answers a force at any height, and what key points at rest leave room for."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.indenter import DEPTH
from finforce_ifea.contact_mechanics.pressed_jaw import RollingContact
from finforce_ifea.tracking.track import fit_load

_HEIGHTS = 13
_TOUCH = 3e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class RestResponse:
    """Answers of the unloaded jaw to objects at several heights.

    Attributes:
        heights: where they touch (m,) [m], rising.
        motions: of the key points in the plane per force (m, K, 2) [m/N].
        stiffness: force over depth (m,) [N/m].
        fits: what `bound_force` has found for the key points that it saw last.
    """

    heights: NDArray
    motions: NDArray
    stiffness: NDArray
    fits: dict = field(default_factory=dict, repr=False)

    def at(self, height: float) -> NDArray:
        """Returns the motions per force (K, 2) [m/N] at a height [m]."""
        return self._interpolate(self.motions, height)

    def slope_at(self, height: float) -> NDArray:
        """Returns the derivative of the motions by the height (K, 2) [1/N]."""
        return self._interpolate(np.gradient(self.motions, self.heights, axis=0), height)

    def stiffness_at(self, height: float) -> float:
        """Returns force over depth [N/m] at a height [m]; below and above, that of the nearest one."""
        return float(np.interp(height, self.heights, self.stiffness))

    def _interpolate(self, values: NDArray, height: float) -> NDArray:
        """Returns values (m, ...) between their heights."""
        upper = int(np.clip(np.searchsorted(self.heights, height), 1, len(self.heights) - 1))
        low, high = self.heights[upper - 1], self.heights[upper]
        share = np.clip((height - low) / (high - low), 0.0, 1.0)
        return (1.0 - share) * values[upper - 1] + share * values[upper]

    def bound_force(self, deviations: NDArray, offset_stddev: float) -> float:
        """Returns the standard deviation [N] of a force that key points seen at rest leave room for, at any height.

        At each height, the force that explains the deviations best and its own standard deviation are taken together;
        all heights are alike.

        Args:
            deviations: of the key points from their places at rest (K, 3) [m], NaN where unseen.
            offset_stddev: by which each is off by chance [m].
        """
        seen = np.isfinite(deviations[:, 0])
        fit = self._fit(seen.tobytes(), offset_stddev)
        loads = fit.gains @ deviations[seen][:, ::2].ravel()
        return float(np.sqrt((np.maximum(loads, 0.0) ** 2 + fit.stddevs**2).mean()))

    def _fit(self, seen: bytes, offset_stddev: float) -> "_PointFit":
        """Returns the fits for the key points that are seen, (K,) bool as bytes; kept, for they are mostly the same."""
        if (seen, offset_stddev) not in self.fits:
            rows = np.frombuffer(seen, bool)
            fits = [fit_load(motions[rows], np.full(int(rows.sum()), offset_stddev)) for motions in self.motions]
            self.fits.clear()
            self.fits[seen, offset_stddev] = _PointFit(
                gains=np.stack([fit.gain for fit in fits]), stddevs=np.array([fit.stddev for fit in fits])
            )
        return self.fits[seen, offset_stddev]


@dataclass(frozen=True, kw_only=True, eq=False)
class _PointFit:
    """Gains (m, 2 n) [N/m] of the seen key points' deviations at each height, and standard deviations (m,) [N]."""

    gains: NDArray
    stddevs: NDArray


def measure_rest(contact: RollingContact, probe: Any, keypoints: int) -> RestResponse:
    """Returns the answers of a contact's model, whose `probe` is that of the key points.

    Args:
        contact: model and contact surface, see `RollingContact`.
        probe: of the key points.
        keypoints: how many they are.
    """
    low, high = contact.surface.heights[[0, -1]]
    # the ends of the surface are left out: next to the clamp a force moves hardly anything
    heights = np.linspace(low + 0.12 * (high - low), high - 0.05 * (high - low), _HEIGHTS)
    motions, stiffness = np.zeros((_HEIGHTS, keypoints, 2)), np.zeros(_HEIGHTS)
    shape = 0.5 * (contact.indenter.shape_range.low + contact.indenter.shape_range.high)
    for row, height in enumerate(heights):
        q = contact.begin(height)
        state = contact.linearize(q, np.array([_TOUCH, shape, height]))
        stiffness[row] = np.linalg.norm(state.force_modes[:, DEPTH])
        modes = contact.model.project(probe, q, state.modes)
        motions[row] = modes[:, ::2, DEPTH] / stiffness[row]
    return RestResponse(heights=heights, motions=motions, stiffness=stiffness)
