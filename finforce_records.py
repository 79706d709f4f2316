"""Values of frozen records against the bounds in their fields' metadata; knows no record and no ROS."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import Field, fields, replace
from typing import Any, TypeVar

from finforce_ifea.errors import FinforceError

RecordT = TypeVar("RecordT")


class ParameterError(FinforceError, ValueError):
    """A ROS parameter has a value or a type that its record does not allow."""


def describe(entry: Field) -> str:
    """Return what a field means, with its unit."""
    unit = entry.metadata.get("unit")
    return entry.metadata.get("description", "") + (f" [{unit}]" if unit else "")


def constraints(entry: Field) -> str:
    """Return in words what a range cannot say of a field; empty when there is no such thing."""
    choices, low, high = (entry.metadata.get(key) for key in ("choices", "min", "max"))
    if choices:
        return f"one of {', '.join(map(repr, choices))}"
    return f"from {low} to {high}, or NaN" if _may_be_nan(entry) and (low, high) != (None, None) else ""


def bounds_of(entry: Field) -> tuple[float, float] | None:
    """Return the least and the largest value of a field, those of its type where one is open; None without both."""
    low, high = entry.metadata.get("min"), entry.metadata.get("max")
    if (low is None and high is None) or _may_be_nan(entry):
        return None
    largest = sys.float_info.max if isinstance(entry.default, float) else 2**63 - 1
    return -largest if low is None else low, largest if high is None else high


def _may_be_nan(entry: Field) -> bool:
    """Whether a field's default is NaN, which a range would refuse."""
    return entry.default != entry.default


def check_value(name: str, value: Any, entry: Field) -> None:
    """Refuse what a ROS range cannot: other choices, and numbers out of bounds where NaN is allowed.

    Raises:
        ParameterError: the value is one of these.
    """
    choices, low, high = (entry.metadata.get(key) for key in ("choices", "min", "max"))
    if choices and value not in choices:
        raise ParameterError(f"parameter {name} is {value!r}; expected one of {choices}")
    if (low is not None and value < low) or (high is not None and value > high):
        raise ParameterError(f"parameter {name} is {value!r}; expected {low} to {high}")


def refresh_record(record: RecordT, read: Callable[[str], Any]) -> RecordT:
    """Return a record whose settable fields have the values that `read` gives for their names.

    Raises:
        ParameterError: a value is out of bounds.
    """
    values = {}
    for entry in fields(record):
        if entry.metadata.get("settable"):
            values[entry.name] = read(entry.name)
            check_value(entry.name, values[entry.name], entry)
    return replace(record, **values)
