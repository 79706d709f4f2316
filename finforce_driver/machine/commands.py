"""What can be asked of a gripper, refused by name where it cannot be done."""

from __future__ import annotations

from finforce_driver.can.protocol import Flag
from finforce_driver.errors import GripperStateError, TargetError
from finforce_driver.machine.calibration import CalibrationRun
from finforce_driver.machine.core import Core
from finforce_driver.machine.move import Goal, MoveJob
from finforce_driver.machine.stop import Recovery
from finforce_driver.state import HALF_CALIBRATED, OTHER_NODE, Outcome, Phase
from finforce_driver.units import is_number

GO = Flag.ACTIVATE | Flag.GO
OLD = 0.1  # [s] after which a reply does not tell where moving jaws are
STANDING = 2.0  # [counts/s], below which an unknown order is taken to hold
REFUSALS = {
    Phase.DISCONNECTED: "no gripper answers",
    Phase.PROBING: "the gripper has not answered yet: wait for its first reply",
    Phase.UNCALIBRATED: "the gripper is not calibrated: calibrate it first",
    Phase.CALIBRATING: "the gripper calibrates, which another command would cut short: wait",
    Phase.FAULT: "a fault or an emergency stop is latched: clear the errors first",
}
CONNECTED = (Phase.UNCALIBRATED, Phase.READY, Phase.MOVING)
USABLE = (Phase.READY, Phase.MOVING)


def make_goal(core: Core, opening: float, speed: float | None, force: float | None) -> Goal:
    """Return a move in the gripper's units.

    Raises:
        TargetError: a value is no number or out of bounds.
    """
    values = {"opening": opening, "speed": speed, "force": force}
    for name, value in values.items():
        if value is not None and not is_number(value):
            raise TargetError(f"{name}: got {value!r}, expected a number; the gripper stays as it was")
    settings = core.settings
    current = round(1e3 * settings.default_current) if force is None else core.scale.current_of(force)
    return Goal(
        opening=float(opening),
        position=core.scale.position_of(opening),
        pace=core.scale.pace_of(settings.default_speed if speed is None else speed),
        current_mA=current,
    )


def require(core: Core, what: str, phases: tuple[Phase, ...]) -> None:
    """Refuse what cannot be done in the present phase.

    Raises:
        GripperStateError: the phase is none of these.
    """
    phase = core.phase
    if phase not in phases:
        raise GripperStateError(f"{what}: {REFUSALS[phase]}" + (f" ({core.note})" if core.note else ""))


def move(core: Core, goal: Goal, now: float) -> None:
    """Go to a goal; the same goal again changes nothing.

    Raises:
        GripperStateError: the gripper could not move.
    """
    require(core, "move", USABLE)
    if not core.enabled:
        raise GripperStateError("move: the gripper was switched off: activate it first")
    job = core.job
    if job is not None and job.goal == goal and job.outcome in (Outcome.NONE, Outcome.REACHED):
        return
    start = core.setpoint(now)
    core.hold_wanted = False
    core.end_job(Outcome.REPLACED)
    core.note, core.outcome = goal.pace.note, Outcome.NONE
    core.job = MoveJob(goal, start=start, rate=goal.pace.speed / core.scale.resolution, now=now)
    want_position(core)


def want_position(core: Core) -> None:
    """Have the gripper get the order that the present move wants."""
    job = core.job
    order = core.order(position=job.position, flags=GO, speed=job.goal.pace.byte, current_mA=job.goal.current_mA)
    core.orders.want(order)


def hold(core: Core, now: float) -> None:
    """Stop in place and hold, or end a calibration, limp; a gripper that stands or was let go stays as it is.

    Raises:
        GripperStateError: the jaws are limp, or unknown.
    """
    require(core, "hold", (*USABLE, Phase.CALIBRATING))
    if core.calibration is not None:
        core.known.half_calibrated, core.calibration, core.note = True, None, HALF_CALIBRATED
        core.orders.want(core.order(position=0, flags=Flag.ACTIVATE), urgent=True)
        return
    stepping = core.job is not None and core.job.steps is not None and core.job.stepping
    # a hold that had to wait comes with the first reply after a gap, which tells no speed
    still = abs(core.known.history.speed()) <= STANDING and not core.hold_wanted
    standing = still and not core.moving and not stepping
    core.end_job(Outcome.REPLACED)
    core.note, core.hold_wanted = "", False
    if now - core.known.stamp > OLD and (core.known.driving or core.orders.pending):
        core.postpone_hold()
        return
    if standing or not (core.known.driving or core.orders.pending):
        return
    kept, place = core.orders.wanted, core.place_now(now)
    if kept is not None and (not kept.drives or abs(kept.position - place) <= 1.0):
        return
    core.orders.want(core.order(position=core.place_for_order(now), flags=GO), urgent=True)


def calibrate(core: Core) -> None:
    """Find the end stops.

    Raises:
        GripperStateError: the gripper is absent or faulty, or calibrates already.
    """
    require(core, "calibrate", CONNECTED)
    core.end_job(Outcome.REPLACED)
    core.orders.drop()
    core.echo.forget()
    core.note = ""
    core.enabled = True
    core.calibration = CalibrationRun(calibrated=core.known.calibrated, reset=core.known.half_calibrated)


def clear_errors(core: Core) -> None:
    """Clear what is latched; without a fault nothing is sent, since clearing lets go.

    Raises:
        GripperStateError: the gripper is absent, or calibrates.
    """
    require(core, "clear_errors", (*CONNECTED, Phase.FAULT))
    core.note = ""
    if core.phase is not Phase.FAULT or core.recovery is not None:
        return
    core.abort()
    core.recovery = Recovery(unflag=core.stop.active or bool(core.known.reply and core.known.reply.estopped))
    core.stop.begin_clearing()


def demand_stop(core: Core) -> None:
    """Stop at once, in whichever state."""
    if core.calibration is not None:
        core.known.half_calibrated = True
    core.calibration = core.recovery = None
    core.abort()
    core.stop.demand()


def activate(core: Core, on: bool, now: float) -> None:
    """Switch the power stage on, holding in place, or off.

    Raises:
        GripperStateError: the gripper is absent, faulty or calibrates.
    """
    require(core, "activate", CONNECTED)
    core.note = ""
    core.enabled = on
    if not on:
        _let_go(core, Flag.OFF, now)
    elif not core.known.calibrated:
        core.orders.want(core.order(position=0, flags=Flag.ACTIVATE))
    elif not core.known.driving:
        core.end_job(Outcome.REPLACED)
        core.orders.want(core.order(position=core.place_for_order(now), flags=GO))


def release_power(core: Core, now: float) -> None:
    """Let the jaws go limp.

    Raises:
        GripperStateError: the gripper is absent, faulty or calibrates.
    """
    require(core, "release_power", CONNECTED)
    core.note = ""
    _let_go(core, Flag.ACTIVATE, now)


def _let_go(core: Core, flags: Flag, now: float) -> None:
    """Want an order that moves nothing and holds nothing."""
    core.end_job(Outcome.REPLACED)
    core.hold_wanted = False
    core.orders.want(core.order(position=core.place_for_order(now), flags=flags), urgent=True)


def explain_other_node(core: Core, node: int) -> None:
    """Say that a gripper answers, but at another node."""
    core.note = OTHER_NODE.format(node=core.settings.node_id, other=node)
