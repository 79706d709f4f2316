"""What a machine knows of its gripper, in SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from finforce_driver.machine.move import CLEAR_CURRENT, CONTACT_TIME, push_direction
from finforce_driver.machine.stop import StopStage
from finforce_driver.state import HALF_CALIBRATED, STOP_PENDING, GripperState, Phase, describe

if TYPE_CHECKING:
    from finforce_driver.machine.machine import GripperMachine

DIRECTIONS = {1: "closing", -1: "opening", 0: ""}


def build_state(machine: GripperMachine, link_counts: Mapping[str, int]) -> GripperState:
    """Return what is known now."""
    known, phase = machine.known, machine.phase
    reply, telemetry = known.reply, known.telemetry
    placed = known.calibrated and machine.calibration is None
    current = math.nan if reply is None else 1e-3 * reply.current_mA
    stopped = machine.stop.active or bool(reply and reply.estopped)
    faults = known.faults(stopped)
    return GripperState(
        phase=phase,
        stamp=known.stamp,
        opening=machine.scale.opening_of(known.place) if placed else math.nan,
        velocity=-machine.scale.resolution * known.history.speed() if placed else math.nan,
        current=current,
        force=-machine.scale.force_of(current),
        target=_target(machine),
        contact=DIRECTIONS[_push(machine)],
        at_target=known.driving and bool(reply and reply.at_target) and placed and machine.settled,
        calibrated=placed,
        activated=bool(reply and reply.activated),
        faults=faults,
        stop_pending=machine.stop.stage is StopStage.WANTED,
        estopped=stopped or "E-stop" in faults,
        outcome=machine.outcome,
        message=_sentence(machine, phase, faults),
        temperature=telemetry.temperature,
        voltage=telemetry.voltage,
        latency=machine.exchange.latency,
        counts={**link_counts, **machine.counts},
    )


def _target(machine: GripperMachine) -> float:
    """Return the opening that the gripper was told to go to [m]; NaN without one."""
    order = machine.orders.wanted
    if order is None or not order.drives:
        return math.nan
    return machine.scale.opening_of(order.position) if machine.job is None else machine.job.goal.opening


def _push(machine: GripperMachine) -> int:
    """Return 1 or -1 for what the motor pushes against closing or opening, else 0."""
    reply = machine.known.reply
    placed = machine.known.driving and machine.known.calibrated and machine.calibration is None
    if not placed or machine.known.contact_time < CONTACT_TIME:
        return 0
    order = machine.orders.taken
    if abs(reply.current_mA) < CLEAR_CURRENT and order is None:
        return 0
    return push_direction(reply, order is not None and order.position > reply.position)


def _sentence(machine: GripperMachine, phase: Phase, faults: tuple[str, ...]) -> str:
    """Return how the gripper is, and what would help."""
    if machine.stop.stage is StopStage.WANTED:
        return STOP_PENDING
    if machine.note and phase is not Phase.FAULT:
        return machine.note
    if phase is Phase.UNCALIBRATED and machine.known.half_calibrated:
        return HALF_CALIBRATED
    return describe(phase, machine.outcome, faults)
