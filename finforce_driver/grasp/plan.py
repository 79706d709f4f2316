"""How far the jaws of a force-controlled grasp may go, and how fast.

The gripper is only ever told to go where the force cannot be above the set one: from the newest image, with the force F
at the opening o, to

    o - (F_set - F - s_F) / k,

with the stiffness k learnt on the way (before contact: the greatest expected, and a share of F_set). Whatever comes
late, or not at all, the jaws stop there by themselves.
"""

from __future__ import annotations

import math

from finforce_driver.grasp.force_feed import ForceFeed
from finforce_driver.grasp.jaw_history import JawHistory
from finforce_driver.grasp.load_watch import LoadWatch
from finforce_driver.grasp.settings import GraspGoal, GraspSettings

_REACTION = 0.05  # [s] from a command to the motion it asks for
_LEAST_SPEED = 0.001  # [m/s] slower would only cost time: the target is bounded anyway
_FEW_STEPS = 3.5  # by which a target may lie ahead of the one that was sent
_BACK_STEPS = 1.5  # by which it must lie behind while the jaws move, where a step is noise
_SPEED_CHANGE = 1.25  # ratio at which a new speed is worth a command
_HYSTERESIS = 0.3  # [steps] of force beyond the tolerance before jaws at rest open again


class GraspPlan:
    """The next target, its speed and what it may do to the force.

    Args:
        goal: speed and least opening.
        settings: limits and expectations.
        load: force, stiffness, contact.
        jaws: steps and commands of the jaws.
        feed: latency and period.
    """

    def __init__(
        self, goal: GraspGoal, settings: GraspSettings, load: LoadWatch, jaws: JawHistory, feed: ForceFeed
    ) -> None:
        self._goal, self._settings = goal, settings
        self._load, self._jaws, self._feed = load, jaws, feed
        self._least = max(jaws.snap(goal.least_opening), jaws.closed)

    @property
    def stiffness(self) -> float:
        """Stiffness that is reckoned with [N/m]."""
        return self._load.model.safe_stiffness if self._load.loaded else self._settings.largest_stiffness

    @property
    def resolution(self) -> float:
        """Change of the force with one step of the gripper [N]."""
        return self._load.model.stiffness * self._jaws.resolution

    def wish(self, set_force: float) -> float:
        """Return the opening [m] to go to, on a step of the gripper; it may lie below the least opening."""
        load, jaws = self._load, self._jaws
        if not self._load.resting:
            return jaws.snap(load.opening - self._allowed(set_force) / self.stiffness)
        allowed = self._allowed(set_force, min(0.5 * self.resolution, self._settings.tolerance))
        if allowed < 0.0:
            return jaws.target + self._steps_back(-allowed) * jaws.resolution
        reach = allowed / self.stiffness
        if self._may_step(allowed):
            reach = max(reach, jaws.resolution)
        return jaws.snap(jaws.target - reach)

    def limit(self, wish: float) -> float:
        """Return a wish [m] within the least opening and what the gripper can open."""
        return min(max(wish, self._least), self._jaws.widest)

    def choose_speed(self, target: float) -> float:
        """Return the speed [m/s] at which the next image comes before the jaws are at `target` [m]."""
        way = abs(self._load.opening - target)
        due = self._feed.latency + 1.5 * self._feed.period + _REACTION
        return min(self._goal.speed, max(_LEAST_SPEED, way / due))

    def is_worth(self, target: float, speed: float, opening: float) -> bool:
        """Whether a target [m] with a speed [m/s] is worth a command to jaws that are at `opening` [m] now."""
        jaws = self._jaws
        if math.isnan(jaws.target):
            return True
        steps = (jaws.target - target) / jaws.resolution
        if self._load.resting:
            return abs(steps) > 0.5
        if jaws.stepping and self._load.loaded:
            return False
        if steps < 0.5:
            return steps < -_BACK_STEPS
        left = opening - jaws.target
        slower, faster = jaws.speed / _SPEED_CHANGE, jaws.speed * _SPEED_CHANGE
        is_due = left < 2.0 * jaws.speed * (self._feed.period + _REACTION)
        return is_due or steps > _FEW_STEPS or not slower < speed < faster

    def overshoot_bound(self, set_force: float) -> float:
        """Return by how much the set force may be passed [N] on the way that no image has shown yet.

        That way is speed x (latency + period), or what is left to the target. Before contact the greatest expected
        stiffness holds on it, later twice the learnt one, or the one that is reckoned with if that is more.
        """
        load, jaws = self._load, self._jaws
        unseen = min(load.opening - jaws.target, jaws.speed * (self._feed.latency + self._feed.period))
        unseen = unseen if unseen > 0.0 else 0.0  # also where nothing is known yet
        if not load.loaded:
            return max(0.0, self.stiffness * unseen - set_force)
        stiffness = max(2.0 * load.model.stiffness, self.stiffness)
        return max(0.0, load.model.force + load.model.force_stddev + stiffness * unseen - set_force)

    def _allowed(self, set_force: float, slack: float = 0.0) -> float:
        """Return by how much the force may rise [N], with `slack` above the set one; negative: by how much to fall."""
        load = self._load
        if not load.loaded:
            return max(0.0, self._settings.approach_share * set_force - load.force)
        allowed = set_force + slack - load.model.force
        # a doubt about the force keeps the jaws where they are, and opens them no more than it closes them
        return max(0.0, allowed - load.model.force_stddev) if allowed > 0.0 else allowed

    def _may_step(self, allowed: float) -> bool:
        """Whether jaws at rest may close by one step for an allowed rise of the force [N]: its effect will be seen."""
        load = self._load
        if not load.loaded:
            return load.force < load.onset
        return allowed > load.model.likely_stiffness * self._jaws.resolution

    def _steps_back(self, excess: float) -> int:
        """Return by how many steps jaws at rest are to open for an excess of force [N]."""
        if excess < _HYSTERESIS * self.resolution + self._load.model.force_stddev:
            return 0
        return max(1, round(excess / (self.stiffness * self._jaws.resolution)))
