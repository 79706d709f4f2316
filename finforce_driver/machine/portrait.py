"""The state of a gripper in SI units, drawn from what is known of it."""

from __future__ import annotations

import math
from collections.abc import Mapping

from finforce_driver.machine.core import Core
from finforce_driver.machine.move import CLEAR_CURRENT, CONTACT_TIME, push_direction
from finforce_driver.state import HALF_CALIBRATED, GripperState, Phase, describe

DIRECTIONS = {1: "closing", -1: "opening", 0: ""}


def build_state(core: Core, link_counts: Mapping[str, int]) -> GripperState:
    """Return what is known now."""
    known, phase = core.known, core.phase
    reply, telemetry = known.reply, known.telemetry
    placed = known.calibrated and core.calibration is None
    current = math.nan if reply is None else 1e-3 * reply.current_mA
    stopped = core.stop.active or bool(reply and reply.estopped)
    faults = known.faults(stopped)
    outcome = core.outcome if core.job is None else core.job.outcome
    return GripperState(
        phase=phase,
        stamp=known.stamp,
        opening=core.scale.opening_of(known.place) if placed else math.nan,
        velocity=-core.scale.resolution * known.history.speed() if placed else math.nan,
        current=current,
        force=-core.scale.force_of(current),
        target=_target(core),
        contact=DIRECTIONS[_push(core)],
        at_target=known.driving and bool(reply and reply.at_target) and placed and core.settled,
        calibrated=placed,
        activated=bool(reply and reply.activated),
        faults=faults,
        estopped=stopped or "E-stop" in faults,
        outcome=outcome,
        message=_sentence(core, phase, faults),
        temperature=telemetry.temperature,
        voltage=telemetry.voltage,
        latency=core.exchange.latency,
        counts={**link_counts, **core.counts},
    )


def _target(core: Core) -> float:
    """Return the opening that the gripper was told to go to [m]; NaN without one."""
    order = core.orders.wanted
    if order is None or not order.drives:
        return math.nan
    return core.scale.opening_of(order.position) if core.job is None else core.job.goal.opening


def _push(core: Core) -> int:
    """Return 1 or -1 for what the motor pushes against closing or opening, else 0."""
    reply = core.known.reply
    placed = core.known.driving and core.known.calibrated and core.calibration is None
    if not placed or core.known.contact_time < CONTACT_TIME:
        return 0
    order = core.orders.taken
    if abs(reply.current_mA) < CLEAR_CURRENT and order is None:
        return 0
    return push_direction(reply, order is not None and order.position > reply.position)


def _sentence(core: Core, phase: Phase, faults: tuple[str, ...]) -> str:
    """Return how the gripper is, and what would help."""
    if core.note and phase is not Phase.FAULT:
        return core.note
    if phase is Phase.UNCALIBRATED and core.known.half_calibrated:
        return HALF_CALIBRATED
    outcome = core.outcome if core.job is None else core.job.outcome
    return describe(phase, outcome, faults)
