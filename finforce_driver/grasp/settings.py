"""What a force-controlled grasp is asked for, what can be set on it, and what it says."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from finforce.settings import check_bounds, setting
from finforce_driver.errors import BackOffError, GraspError, TargetError, UnseenForceError

MOTOR_MARGIN = 4.0  # [N] of the motor's force above the camera's, friction included, at which a grasp backs off


@dataclass(frozen=True, kw_only=True)
class GraspGoal:
    """One grasp.

    Attributes:
        force: to be reached and held, by vision [N].
        speed: greatest of the opening while closing [m/s].
        least_opening: below which the jaws never go [m].
        time_limit: to reach the force in [s]; holding has none.
    """

    force: float = setting(description="Set force", unit="N", low=0.1, high=30.0)
    speed: float = setting(0.004, "Maximum speed of the opening while closing", "m/s", 1e-4, 0.1)
    least_opening: float = setting(0.0, "Minimum opening of the jaws", "m", 0.0, 0.5)
    time_limit: float = setting(20.0, "Maximum time to reach the set force", "s", 0.1, 3600.0)

    def __post_init__(self) -> None:
        """Refuse what no grasp can be.

        Raises:
            TargetError: a value is no number or out of bounds.
        """
        check_bounds(self, TargetError)


@dataclass(frozen=True, kw_only=True)
class GraspSettings:
    """Settings of `ForceGrasp`; each field's metadata says unit, bounds and meaning."""

    force_limit: float = setting(8.0, "Grasp force that ends a grasp, and maximum set force", "N", 0.2, 30.0)
    largest_stiffness: float = setting(
        1400.0, "Maximum stiffness of jaws and object per opening, assumed until it is learnt", "N/m", 50.0, 1e5
    )
    approach_speed: float = setting(0.004, "Maximum speed of the opening before contact", "m/s", 1e-4, 0.1)
    reaction: float = setting(0.05, "Delay from a command to the motion of the gripper", "s", 0.0, 1.0)
    stale_after: float = setting(0.25, "Maximum age of the newest force; a grasp ends beyond it", "s", 0.05, 2.0)
    force_timeout: float = setting(
        1.0,
        "Maximum wait for a force once the jaws touch; twice as long before",
        "s",
        0.1,
        10.0,
        alias="touch_timeout",
    )
    slip_raise: float = setting(
        0.0, "Share of the set force that is added while the object slides; 0: none", "", 0.0, 1.0
    )
    motor_force: float = setting(
        7.5, "Motor limit as grip force by the maker's curve; 2.5 times the set force if that is more", "N", 7.0, 62.0
    )

    def __post_init__(self) -> None:
        """Refuse values out of bounds.

        Raises:
            TargetError: a value is out of its bounds.
        """
        check_bounds(self, TargetError)

    def check_force(self, force: float) -> float:
        """Return a set force [N] that may be held.

        Raises:
            TargetError: it is no number, not above zero, or above the force limit.
        """
        if not 0.1 <= force <= self.force_limit:
            raise TargetError(
                f"set force: got {force:g} N, expected 0.1 to {self.force_limit:g} N, the force limit of the grasp"
            )
        return float(force)


class GraspPhase(Enum):
    """Where a grasp is."""

    APPROACH = "approach"  # nothing presses yet
    LOADING = "loading"  # on the way to the set force
    HOLDING = "holding"  # as near to the set force as the gripper's steps allow, and following it
    STOPPED = "stopped"  # ended; the jaws stay where they are, and a new grasp is needed


@dataclass(frozen=True, kw_only=True)
class GripperMove:
    """An opening [m] to go to, with the speed of the opening [m/s] and the motor's limit [N], by the maker's curve."""

    opening: float
    speed: float
    force: float


@dataclass(frozen=True, kw_only=True)
class GraspStatus:
    """A grasp at one instant.

    Attributes:
        phase: where it is.
        reason: one sentence: what it does, or why it ended.
        goal: set force [N].
        force: last one measured [N]; NaN before the first.
        predicted: force now, over the latency [N]; NaN without load.
        stiffness: change of the force per metre of closing [N/m]; as expected until it is learnt.
        stiffness_stddev: of it [N/m].
        latency: from image to arrival of a force, median [s].
        period: between two images with a force, median [s].
        overshoot_bound: by which the set force is passed at most if the stiffness at most doubles on the way that no
            image has shown yet, and the force is off by two of its stated deviations [N].
        peak: largest force measured while loaded [N]; 0 before.
        resolution: change of the force with one step of the gripper [N].
        target: opening that the jaws were told to go to [m]; NaN before the first move.
        stddev: of the newest force, as its source states it [N].
        failure: how it failed; None: it did not, it was ended by a command, or something has been commanded since.
        refused: forces and touches that were set aside, by reason.
    """

    phase: GraspPhase
    reason: str
    goal: float
    force: float = math.nan
    predicted: float = math.nan
    stiffness: float = math.nan
    stiffness_stddev: float = math.nan
    latency: float = math.nan
    period: float = math.nan
    overshoot_bound: float = math.nan
    peak: float = 0.0
    resolution: float = math.nan
    target: float = math.nan
    stddev: float = 0.0
    failure: type[GraspError] | None = None
    refused: Mapping[str, int] = field(default_factory=dict)

    @property
    def failed(self) -> bool:
        """Whether it failed."""
        return self.failure is not None

    @property
    def backs_off(self) -> bool:
        """Whether it failed, and the jaws go back to where it began."""
        return self.failed and issubclass(self.failure, BackOffError)

    @property
    def unseen(self) -> bool:
        """Whether it failed because the motor pressed much harder than the camera said."""
        return self.failed and issubclass(self.failure, UnseenForceError)


@dataclass(frozen=True, kw_only=True)
class GraspStep:
    """What is to be done now.

    Attributes:
        move: to be sent to the gripper; None to leave it as it is.
        stop: the gripper is to hold where it is, once.
        status: of the grasp.
    """

    move: GripperMove | None
    stop: bool
    status: GraspStatus
