"""What must hold for a grasp to go on, and the sentence where it does not."""

from __future__ import annotations

import math

from finforce_driver.errors import GraspError
from finforce_driver.grasp.force_feed import ForceFeed
from finforce_driver.grasp.settings import GraspSettings
from finforce_driver.state import GripperState, Phase

_WORKING = (Phase.READY, Phase.MOVING)
_SILENT = 0.3  # [s] after which a gripper without a reply is not the one that is known


def check_force_value(force: float) -> None:
    """Refuse what no grasp force is.

    Raises:
        GraspError: the force is no finite number, or negative.
    """
    if not math.isfinite(force) or force < 0.0:
        raise GraspError(f"a grasp force of {force} N came, expected a number from 0: holds in place")


def is_working(state: GripperState) -> bool:
    """Whether the gripper takes commands to move."""
    return state.phase in _WORKING and not state.estopped


def check_gripper(state: GripperState, now: float) -> None:
    """Refuse a gripper that cannot be told to move.

    Raises:
        GraspError: it is stopped, faulty, not calibrated, or out of reach.
    """
    if state.estopped:
        raise GraspError("emergency stop of the gripper")
    if state.phase not in _WORKING or not math.isfinite(state.opening):
        raise GraspError(f"the gripper is {state.phase.value}{': ' if state.message else ''}{state.message}")
    if not now - state.stamp <= _SILENT:
        raise GraspError(f"no reply of the gripper for {now - state.stamp:.2f} s")


def check_silence(feed: ForceFeed, now: float, started: float, settings: GraspSettings) -> None:
    """Refuse to go on without fresh news of the camera.

    Before the first force a word on touching will do: an estimator that waits for its first contact has no force yet.

    Args:
        feed: what came.
        now: time [s].
        started: when the grasp began [s].
        settings: with the time limits.

    Raises:
        GraspError: forces have become stale, or did not come when they were due.
    """
    if feed.heard:
        if feed.age(now) > settings.stale_after:
            raise GraspError(
                f"the newest force is {feed.age(now):.2f} s old, at most {settings.stale_after:g} s are allowed: "
                "is the camera there, and the solver sure of itself?"
            )
        return
    touched = feed.touched_since
    if now - touched > settings.touch_timeout:
        raise GraspError(f"the jaws are said to touch, but no force came for {now - touched:.2f} s")
    heard = max(started, feed.touch.stamp if feed.touch else started)
    if now - heard > settings.silence_timeout:
        raise GraspError(
            f"no force came for {now - heard:.2f} s: is the camera there, are the solvers tared (30 unloaded images)?"
        )
