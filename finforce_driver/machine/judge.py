"""What follows from a believed reply, and from a link that is lost."""

from __future__ import annotations

from finforce_driver.can.protocol import Reply
from finforce_driver.machine.calibration import CalibrationStep
from finforce_driver.machine.commands import USABLE, hold
from finforce_driver.machine.core import Core
from finforce_driver.machine.echo import Echo
from finforce_driver.machine.stop import RecoveryStep, Stage
from finforce_driver.state import OTHER_MASTER, REBOOTED, Outcome

NO_FAULTS = (False, False, False, False)


def judge_reply(core: Core, before: Reply | None, reply: Reply, now: float) -> None:
    """Draw the conclusions from a reply that is believed.

    Args:
        core: what the gripper is doing and shall do; changed.
        before: the reply believed before, None without one.
        reply: the new one.
        now: when it came [s].
    """
    if core.silent or before is None:
        core.silent, core.note = False, ""
    core.stop.take(reply)
    _follow_recovery(core, reply, now)
    _follow_fault(core, before, reply, now)
    if core.calibration is not None:
        _follow_calibration(core, reply, now)
    elif before is not None and before.calibrated and not reply.calibrated:
        core.abort(REBOOTED)
        core.known.half_calibrated = False
    elif not reply.error:
        _follow_orders(core, reply, now)
    if core.hold_wanted and core.phase in USABLE:
        hold(core, now)


def overrule(core: Core, what: str) -> None:
    """Yield to another program: the gripper has its order, and gets none of ours until one is asked for."""
    if core.calibration is not None:
        core.calibration, core.known.half_calibrated = None, True
    core.abort(OTHER_MASTER.format(what=what))


def lose_link(core: Core, reason: str) -> None:
    """Forget what may have changed by the time the link is back."""
    if core.calibration is not None:
        # without an earlier calibration the gripper's flag will say whether it was completed
        core.known.half_calibrated |= core.known.calibrated
        core.calibration = None
    core.recovery = None
    core.stop.end_clearing(False)
    core.abort(reason)
    core.known.forget()
    core.exchange.reset()
    core.joined, core.silent = False, False


def _follow_recovery(core: Core, reply: Reply, now: float) -> None:
    """Let the clearing of errors go on."""
    recovery = core.recovery
    if recovery is None:
        return
    recovery.take(reply, now)
    if recovery.over:
        cleared = recovery.step is RecoveryStep.DONE
        core.recovery = None
        core.stop.end_clearing(cleared)
        core.abort()
        if not cleared:
            core.known.telemetry.ask_errors(now)


def _follow_fault(core: Core, before: Reply | None, reply: Reply, now: float) -> None:
    """End what a fault ends, and have its name asked for."""
    if _faults(reply) == (_faults(before) if before is not None else NO_FAULTS):
        return
    core.known.telemetry.ask_errors(now)
    if reply.error and core.recovery is None and core.stop.stage is not Stage.CLEARING:
        core.abort()


def _faults(reply: Reply) -> tuple[bool, ...]:
    """Return what a reply says of faults."""
    return reply.error, reply.overheated, reply.watchdog, reply.estopped


def _follow_calibration(core: Core, reply: Reply, now: float) -> None:
    """Let the calibration go on, and end it."""
    run = core.calibration
    run.take(reply, now)
    if not run.over:
        return
    core.calibration = None
    core.known.half_calibrated = run.step is CalibrationStep.FAILED
    core.known.restart_places()
    core.outcome = Outcome.NONE
    core.abort(run.reason)


def _follow_orders(core: Core, reply: Reply, now: float) -> None:
    """Judge the move, and whether the gripper has our order."""
    echo = core.echo.take(reply, now)
    if echo is Echo.OVERRULED:
        core.counts["foreign commands"] += 1
        overrule(core, "it does not do what it was told last")
    elif echo is Echo.UNHEARD and not (core.moving and core.orders.repeat()):
        core.echo.forget()
    job = core.job
    if job is None:
        return
    job.take(reply, now)
    if job.outcome is Outcome.TIMED_OUT and core.orders.pending:
        core.orders.drop()
