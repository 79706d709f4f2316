"""What a force-controlled grasp says and asks for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum


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
            image has shown yet [N].
        peak: largest force measured while loaded [N]; 0 before.
        resolution: change of the force with one step of the gripper [N].
        target: opening that the jaws were told to go to [m]; NaN before the first move.
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
    refused: Mapping[str, int] = field(default_factory=dict)


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
