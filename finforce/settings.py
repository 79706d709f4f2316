"""Settings as frozen dataclasses: fields with unit, bounds and meaning, declared and checked in one way."""

from __future__ import annotations

import sys
from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Any, ClassVar, TypeVar

from finforce.errors import FinforceError

RecordT = TypeVar("RecordT")


class ParameterError(FinforceError, ValueError):
    """A ROS parameter has a value or a type that its record does not allow."""


def setting(
    default: Any = MISSING,
    description: str = "",
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    **flags: Any,
) -> Any:
    """Return a dataclass field of a value in a unit, from `low` to `high` unless these are None.

    Args:
        default: the default value; without one the field has to be given.
        description: its meaning, for `ros2 param describe` and error messages.
        unit: of value and bounds.
        low: least value.
        high: largest value.
        flags: `choices` (one of several words), `topic` (names one, or several), `settable` (while a node runs),
            `parameter` (False: no ROS parameter).
    """
    bounds = {"min": low, "max": high}
    return field(default=default, metadata={"description": description, "unit": unit, **bounds, **flags})


@dataclass(frozen=True, kw_only=True)
class TimeParameters:
    """Parameters of time and frames of every node that answers images; units stand in the metadata."""

    max_age: float = setting(0.2, "Maximum age of data when a result is published", "s", 0.001, 60.0, settable=True)
    diagnostics_period: float = setting(1.0, "Period of the diagnostics", "s", 0.05, 60.0)
    frame_prefix: str = setting("", "Prefix of the frames of gripper and jaws, such as robot1/")

    def jaw_frame(self, side: str) -> str:
        """Return the name of a jaw's frame."""
        return f"{self.frame_prefix}{side}_jaw"


@dataclass(frozen=True, kw_only=True)
class GripperParameters(TimeParameters):
    """The same of a node that knows the gripper's frame."""

    gripper_frame: str = setting("gripper_base", "Frame of the gripper, without prefix")

    @property
    def base_frame(self) -> str:
        """The name of the gripper's frame."""
        return self.frame_prefix + self.gripper_frame


def is_parameter(entry: Field) -> bool:
    """Return whether a field is a setting that a node declares as a parameter."""
    return bool(entry.metadata) and entry.metadata.get("parameter", True)


def describe(entry: Field) -> str:
    """Return what a field means, with its unit."""
    unit = entry.metadata.get("unit")
    return entry.metadata.get("description", "") + (f" [{unit}]" if unit else "")


def constraints(entry: Field) -> str:
    """Return in words what a range of ROS cannot say of a field; empty when there is no such thing."""
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
    """Return True if a field's default is NaN, which a range would refuse."""
    return entry.default != entry.default


def check_value(entry: Field, value: Any, error: type[Exception] = ParameterError, name: str = "") -> None:
    """Refuse a value that is not among a field's choices or outside its bounds.

    Raises:
        error: the value is one of these; NaN is allowed where it is the default.
    """
    choices, low, high = (entry.metadata.get(key) for key in ("choices", "min", "max"))
    name = name or entry.name
    if choices and value not in choices:
        raise error(f"{name}: got {value!r}, expected one of {', '.join(filter(None, map(str, choices)))}")
    if _may_be_nan(entry) and value != value:
        return
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        unit = entry.metadata.get("unit") or "1"
        unit = "" if unit == "1" else f" {unit}"
        bounds = f"at least {low:g}" if high is None else f"at most {high:g}" if low is None else f"{low:g} to {high:g}"
        raise error(f"{name}: got {value!r}, expected {bounds}{unit}{_millimetres(entry, value)}")


def _millimetres(entry: Field, value: Any) -> str:
    """Return what a length would be in metres where it is in bounds only if it was meant in millimetres."""
    low, high = (entry.metadata.get(key) for key in ("min", "max"))
    likely = (
        entry.metadata.get("unit") == "m" and high is not None and high < value and (low or 0.0) <= value / 1e3 <= high
    )
    return f"; {value:g} mm are {value / 1e3:g} m" if likely else ""


def check_bounds(record: Any, error: type[Exception]) -> None:
    """Refuse a record with a value that `check_value` refuses, by raising `error`."""
    for entry in fields(record):
        check_value(entry, getattr(record, entry.name), error)


@dataclass(frozen=True, kw_only=True)
class Bounded:
    """A record of settings that refuses, by raising its `error`, a value that `check_value` refuses."""

    error: ClassVar[type[Exception]] = ParameterError

    def __post_init__(self) -> None:
        """Refuse what is not among its choices, or outside its bounds; NaN is, unless it is the default."""
        check_bounds(self, self.error)
