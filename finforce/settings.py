"""Fields of nodes' parameters, what all nodes have of them, and their values against their bounds.

Fields of settings records with unit, bounds, choices and meaning, and the check of their values.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import Field, dataclass, field, fields, replace
from typing import Any, TypeVar

from finforce.errors import FinforceError

RecordT = TypeVar("RecordT")


class ParameterError(FinforceError, ValueError):
    """A ROS parameter has a value or a type that its record does not allow."""


def parameter(default: Any, description: str, **metadata: Any) -> Any:
    """Return a dataclass field that says what it is; `metadata` are unit, min, max, choices, topic and settable."""
    return field(default=default, metadata={"description": description, **metadata})


@dataclass(frozen=True, kw_only=True)
class TimeParameters:
    """What every node that answers images is told about time; units stand in the metadata."""

    max_age: float = parameter(0.2, "greatest age of data at the time of publishing", unit="s", min=0.001, max=60.0)
    restart_gap: float = parameter(
        1.0, "stamps that go back by more than this begin a new recording", unit="s", min=0.001, max=3600.0
    )
    diagnostics_period: float = parameter(1.0, "time between diagnostics", unit="s", min=0.05, max=60.0)


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


def setting(default: Any, unit: str, low: float | None, high: float | None, description: str) -> Any:
    """Returns a dataclass field of a value in a unit, from low to high unless these are None."""
    return field(default=default, metadata={"unit": unit, "min": low, "max": high, "description": description})


def choice(default: str, choices: tuple[str, ...], description: str) -> Any:
    """Returns a dataclass field of one of several words."""
    return field(default=default, metadata={"unit": "", "choices": choices, "description": description})


def check_bounds(record: Any, error: type[Exception]) -> None:
    """Refuses a record with a value that is not among its field's choices or outside its bounds, by raising `error`."""
    for item in fields(record):
        value, rule = getattr(record, item.name), item.metadata
        if "choices" in rule and value not in rule["choices"]:
            raise error(f"{item.name}: got {value!r}, expected one of {', '.join(rule['choices'])}")
        low, high = rule.get("min"), rule.get("max")
        if low is not None and not low <= value <= high:
            raise error(f"{item.name}: got {value!r}, expected {low:g} to {high:g} {rule['unit']}")
