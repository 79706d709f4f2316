"""Fields of settings records with unit, bounds, choices and meaning, and the check of their values; knows no record."""

from dataclasses import field, fields
from typing import Any


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
