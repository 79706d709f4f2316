"""A short way back before a grasp goes on: while an object sticks, its force turns, which tells how rough it is."""

from __future__ import annotations

import math

from finforce_driver.grasp.force_monitor import ForceMonitor
from finforce_driver.grasp.plan import GraspPlan

# Share of the set force from which on the jaws go back, and the share of their force that they keep.
_SHARE = 0.5
_KEPT = 0.4
# Least stiffness that is reckoned with [N/m].
_LEAST_STIFFNESS = 1000.0


class FrictionProbe:
    """The targets of the jaws until the object was probed.

    Attributes:
        is_due: True if that has still to be done.

    Args:
        length: by which the jaws open on the way back [m]; 0 for no probe.
    """

    def __init__(self, length: float) -> None:
        self.is_due = length > 0.0
        self._length, self._back = length, math.nan
        self._begin = self._kept = math.nan

    @property
    def goes_back(self) -> bool:
        """True if the jaws are on their way back."""
        return not math.isnan(self._back)

    def find_target(self, plan: GraspPlan, load: ForceMonitor, set_force: float) -> float:
        """Return the opening to go to [m]; the one commanded last to go on as before.

        Args:
            plan: of the grasp.
            load: force, stiffness, contact.
            set_force: of the grasp [N].
        """
        if self.goes_back:
            # of what turns out stiffer, not so far
            self._back = min(self._back, self._reach(plan, load))
            self.is_due = not (load.resting and abs(load.opening - self._back) < 0.5 * plan.step)
            return self._back
        target = plan.limit(plan.ideal_target(set_force))
        if not load.loaded or load.pressing < _SHARE * set_force:
            stands = load.loaded and load.resting and abs(target - plan.target) < 0.5 * plan.step
            self.is_due = not stands  # what cannot be pressed so far is not probed
            return target
        self._kept, self._begin = _KEPT * load.pressing, load.opening
        self._back = self._reach(plan, load)
        self.is_due = self._back > load.opening + 0.5 * plan.step
        return self._back

    def _reach(self, plan: GraspPlan, load: ForceMonitor) -> float:
        """Return how far the jaws may open [m] so that they keep what they have to, by the newest force."""
        way = (load.pressing - self._kept) / max(load.model.safe_stiffness, _LEAST_STIFFNESS)
        opening = min(load.opening + way, self._begin + self._length, plan.widest)
        return plan.snap_closed(max(opening, self._begin))
