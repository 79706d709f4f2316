"""Travel and speed limits of a force-controlled grasp, and the jaws' opening at the time of an image.

The gripper is only ever told to go where the force cannot be above the set one: from the newest image, with the force F
at the opening o, to

    o - (F_set - F - s_F) / k,

with the stiffness k learnt on the way (before contact: the greatest expected, and a share of F_set). Whatever comes
late, or not at all, the jaws stop there by themselves.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from finforce_driver.errors import GraspError
from finforce_driver.grasp.force_monitor import ForceFilter, ForceMonitor, JawPosition
from finforce_driver.settings import GraspGoal, GraspSettings, GripperSettings
from finforce_driver.state import GripperState

MOTOR_MARGIN = 4.0  # [N] of the motor's force above the camera's, friction included, at which a grasp backs off
_APPROACH_SHARE = 0.7  # of the set force, that may build up before an image can show the contact
_TOLERANCE = 0.08  # [N] by which the set force may be passed to come nearer to it
_LEAST_SPEED = 0.001  # [m/s] slower would only cost time: the target is bounded anyway
_SLOWEST = 1e-4  # [m/s] however uncertain the force is
_FEW_STEPS = 3.5  # by which a target may lie ahead of the one that was sent
_BACK_STEPS = 1.5  # by which it must lie behind while the jaws move, where a step is noise
_SPEED_CHANGE = 1.25  # ratio at which a new speed is worth a command
_CERTAIN = 0.15  # [N] stated deviation of the force above which the jaws go slower
_CONTRADICTED = 0.5  # share of the speed while the contact estimator says that nothing touches
_WITNESS_TIME = 0.15  # [s] from a force to the stop that the motor's current brings about
FRICTION = 1.0  # [N] by which the motor's current, also at its limit, may tell too little
_BEYOND_NOISE = 4.0  # deviations of one force, beyond which a step's change of it is no chance
DEVIATIONS = 2.0  # stated deviations of the force within which it is reckoned with
_HYSTERESIS = 0.3  # [steps] of force beyond the tolerance before jaws at rest open again
SETTLING = 0.03  # [s] in addition to the reaction: the jaws come to rest, and the driver may step them one by one
_NEAR = 2.0  # steps between target and reported opening at rest: the byte is truncated, and flickers by one
_SMALL = 2.5  # steps: fewer are not planned anew on the way
_POWERED_AFTER = 0.3  # [s] of the first command, which switches the power stage on
_LATE = 1.0  # [s] after which jaws that have not come do not follow
# A byte says the opening to a step; between two bytes it is interpolated. At rest the jaws are within 4 ticks.
_MOVING_STDDEV = 0.35  # [steps]
_RESTING_STDDEV = 0.1  # [steps]


class GraspPlan:
    """The gripper's steps, the last command and the openings that follow from it; the next target and its speed.

    At rest the commanded opening says more than the reported byte, which is truncated and flickers.

    Attributes:
        step: of the gripper [m].
        widest: opening at the last step [m].
        target: commanded opening [m]; NaN before the first command.
        speed: commanded [m/s].
        stepping: the last command was a few steps from rest, whose effect is to be seen at rest again.

    Args:
        goal: speed and least opening.
        settings: limits and expectations.
        load: force, stiffness, contact.
        feed: latency and period.
        jaws: closed opening and stroke.
        step: of the gripper [m]; None: that of its position byte.
    """

    def __init__(
        self,
        goal: GraspGoal,
        settings: GraspSettings,
        load: ForceMonitor,
        feed: ForceFilter,
        jaws: GripperSettings,
        step: float | None = None,
    ) -> None:
        self.step, self._closed, self.widest = step or jaws.resolution, jaws.closed_opening, jaws.largest_opening
        self.target, self.speed, self.stepping = math.nan, 0.0, False
        self._goal, self._settings, self._load, self._feed = goal, settings, load, feed
        self._settling = settings.reaction + SETTLING
        self._arrives = self._powered_from = math.inf
        self._least = max(self.snap(goal.least_opening), jaws.closed_opening)
        self._rest = (math.nan, math.nan)  # target [m] and force [N] of the last image at rest
        self._change = 0.0  # [N] of the force with the last step
        self._step_force = 0.0  # [N] the same where it was beyond expectation, or the step was taken back

    @property
    def stiffness(self) -> float:
        """Stiffness that is reckoned with [N/m]."""
        return self._load.model.safe_stiffness if self._load.loaded else self._settings.largest_stiffness

    @property
    def force_per_step(self) -> float:
        """Change of the force with one step of the gripper [N]."""
        return self._load.model.stiffness * self.step

    def ideal_target(self, set_force: float) -> float:
        """Return the opening [m] to go to, on a step of the gripper; it may lie below the least opening."""
        load = self._load
        if not self._load.resting:
            return self.snap(load.opening - self._allowed(set_force) / self.stiffness)
        allowed = self._allowed(set_force, min(0.5 * self.force_per_step, _TOLERANCE))
        if allowed < 0.0:
            return self.target + self._steps_back(-allowed) * self.step
        reach = allowed / self.stiffness
        if self._may_step(allowed):
            reach = max(reach, self.step)
        return self.snap(self.target - reach)

    def note_rest(self) -> None:
        """Look at what a step between two rests did to the force: of stiff things it may be more than was learnt."""
        load = self._load
        if not (load.loaded and load.resting):
            return
        before, self._rest = self._rest, (self.target, load.force)
        steps = abs(before[0] - self.target) / self.step
        if 0.5 < steps < 1.5:
            change = abs(load.force - before[1])
            expected = load.model.likely_stiffness * self.step + _BEYOND_NOISE * load.model.noise
            if self.target > before[0]:  # a step that was taken back is not to be taken again
                self._step_force = max(change, self._change)
            else:
                self._step_force = change if change > expected else 0.0
            self._change = change

    def limit(self, target: float) -> float:
        """Return a target [m] within the least opening and what the gripper can open."""
        return min(max(target, self._least), self.widest)

    def choose_speed(self, target: float) -> float:
        """Return the speed [m/s] at which the next image comes before the jaws are at `target` [m].

        It is less where the force is uncertain, and where contact and force contradict each other.
        """
        travel = abs(self._load.opening - target)
        due = self._feed.latency + 1.5 * self._feed.period + self._settings.reaction
        wanted = self._goal.speed if self._load.loaded else min(self._goal.speed, self._settings.approach_speed)
        return max(_SLOWEST, min(wanted * self._confidence, self._blind_speed, max(_LEAST_SPEED, travel / due)))

    @property
    def _blind_speed(self) -> float:
        """Speed [m/s] at which the motor's current tells early enough that something presses where nothing is seen."""
        spare = max(0.0, self._settings.force_limit - MOTOR_MARGIN - FRICTION)
        return max(_LEAST_SPEED, spare / (self._settings.largest_stiffness * _WITNESS_TIME))

    @property
    def _confidence(self) -> float:
        """Share of the speed that the force's stated deviation and the contact's state leave."""
        load, feed = self._load, self._feed
        share = min(1.0, _CERTAIN / max(load.stddev, 1e-9)) if load.loaded else 1.0
        return _CONTRADICTED * share if load.loaded and feed.touching(feed.stamp) is False else share

    @property
    def _uncertainty(self) -> float:
        """The force's stated deviation beyond the tolerance [N]: so much nearer to the set force it may be."""
        return max(0.0, self._load.stddev - _TOLERANCE)

    def is_worth(self, target: float, speed: float, opening: float) -> bool:
        """Return True if a target [m] with a speed [m/s] is worth a command to jaws that are at `opening` [m] now."""
        if math.isnan(self.target):
            return True
        steps = (self.target - target) / self.step
        if self._load.resting:
            return abs(steps) > 0.5
        if self.stepping and self._load.loaded:
            return False
        if steps < 0.5:
            return steps < -_BACK_STEPS
        left = opening - self.target
        slower, faster = self.speed / _SPEED_CHANGE, self.speed * _SPEED_CHANGE
        is_due = left < 2.0 * self.speed * (self._feed.period + self._settings.reaction)
        return is_due or steps > _FEW_STEPS or not slower < speed < faster

    def overshoot_bound(self, set_force: float) -> float:
        """Return by how much the set force may be passed [N] on the way that no image has shown yet.

        That way is speed x (latency + period), or what is left to the target. Before contact the greatest expected
        stiffness holds on it, later twice the learnt one, or the one that is reckoned with if that is more. The force
        may be off by two of the deviations that its source states.
        """
        load = self._load
        unseen = min(load.opening - self.target, self.speed * (self._feed.latency + self._feed.period))
        unseen = unseen if unseen > 0.0 else 0.0  # also where nothing is known yet
        if not load.loaded:
            return max(0.0, self.stiffness * unseen - set_force)
        stiffness = max(2.0 * load.model.stiffness, self.stiffness)
        margin = load.model.force_stddev + DEVIATIONS * load.stddev
        return max(0.0, load.model.force + margin + stiffness * unseen - set_force)

    def _allowed(self, set_force: float, slack: float = 0.0) -> float:
        """Return by how much the force may rise [N], with `slack` above the set one; negative: by how much to fall."""
        load = self._load
        if not load.loaded:
            return max(0.0, _APPROACH_SHARE * set_force - load.force)
        allowed = set_force + slack - load.model.force
        # an uncertain force keeps the jaws where they are, and opens them no more than it closes them
        return max(0.0, allowed - load.model.force_stddev - self._uncertainty) if allowed > 0.0 else allowed

    def _may_step(self, allowed: float) -> bool:
        """Return True if jaws at rest may close by one step for an allowed rise of the force [N]."""
        load = self._load
        if not load.loaded:
            return load.force < load.onset
        largest = max(self._settings.largest_stiffness, 1.05 * load.model.stiffness)
        return allowed > max(min(load.model.likely_stiffness, largest) * self.step, self._step_force)

    def _steps_back(self, excess: float) -> int:
        """Return by how many steps jaws at rest are to open for an excess of force [N]."""
        half = 0.5 * max(self.force_per_step, self._change)  # of two steps the nearer one is kept
        if excess < max(_HYSTERESIS * self.force_per_step, half - _TOLERANCE) + self._load.model.force_stddev:
            return 0
        return max(1, round(excess / (self.stiffness * self.step)))

    def snap(self, opening: float) -> float:
        """Return the nearest step [m] that is not more closed than `opening` [m]."""
        return self._closed + math.ceil((opening - self._closed) / self.step - 1e-6) * self.step

    def snap_closed(self, opening: float) -> float:
        """Return the nearest step [m] that is not more open than `opening` [m]."""
        return self._closed + math.floor((opening - self._closed) / self.step + 1e-6) * self.step

    def nearest(self, opening: float) -> float:
        """Return the step [m] nearest to a reported opening [m]."""
        return self.snap(opening - 0.5 * self.step)

    def command(self, target: float, speed: float, now: float, here: JawPosition) -> None:
        """Remember a command and when the jaws, now at `here`, will have followed it."""
        self.stepping = here.resting and abs(target - here.opening) < _SMALL * self.step
        if math.isnan(self.target):
            self._powered_from = now + _POWERED_AFTER
        self.target, self.speed = target, speed
        self._arrives = now + abs(target - here.opening) / speed + self._settling

    def check_power(self, state: GripperState) -> None:
        """Refuse jaws that have gone limp since the first command.

        Raises:
            GraspError: the power stage is off.
        """
        if state.stamp > self._powered_from and not state.activated:
            raise GraspError("the gripper's power stage is off: did somebody else switch it off?")

    def rests_at(self, stamp: float, reported: float) -> bool:
        """Return True if the jaws stood at their target at `stamp` [s], when `reported` [m] was their opening."""
        return stamp >= self._arrives and abs(reported - self.target) <= _NEAR * self.step

    def is_late(self, now: float, reported: float) -> bool:
        """Return True if the jaws should have been at their target for long and are not there."""
        return now > self._arrives + _LATE and abs(reported - self.target) > (_NEAR + 1.0) * self.step

    def locate(self, stamp: float, state: GripperState, opening_at: Callable[[float], float]) -> JawPosition:
        """Return where the jaws were at a past time [s]; NaN when it is not known."""
        reported = state.opening if stamp >= state.stamp else opening_at(stamp)
        if self.rests_at(stamp, reported):
            return JawPosition(opening=self.target, resting=True)
        return JawPosition(opening=reported, resting=False)

    def travel_stddev(self, before: JawPosition, after: JawPosition) -> float:
        """Return the standard deviation of the travel between two positions [m]."""
        if before == after:
            return 0.0
        is_exact = before.resting and after.resting
        return (_RESTING_STDDEV if is_exact else _MOVING_STDDEV) * self.step
