"""What a careful driver does not send, judged order by order."""

from __future__ import annotations

from collections.abc import Iterator

from finforce_sim.emulator.control import Mode, MoveControl, Order

_WEAK_CURRENT, _STRONG_CURRENT = 150, 1500  # [mA] that the maker advises against going beyond
_SLOW_SPEED = 3  # byte below which contact is felt while the jaws still move


def list_violations(order: Order, control: MoveControl, mode: Mode) -> Iterator[str]:
    """Yield what is wrong with an order, given the control that has not taken it yet, and the present mode."""
    if mode is Mode.CALIBRATE and not order.estop:
        yield "order during calibration"
    if not _WEAK_CURRENT <= order.current <= _STRONG_CURRENT:
        yield "current out of range"
    if not (order.activated and order.action) or order.estop:
        return
    if order.speed < _SLOW_SPEED:
        yield "too slow"
    if order == control.order and mode is Mode.GRIPPER:
        yield "repeated order"
    if order == control.order and mode is not Mode.GRIPPER and control.latched:
        yield "stale latch"
