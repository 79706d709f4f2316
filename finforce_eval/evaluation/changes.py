"""`NAME=VALUE` texts of a command line as values of the types of a record's defaults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from finforce_eval.errors import OptionError

TRUTH_VALUES = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def parse_changes(option: str, kind: str, texts: Sequence[str], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return `NAME=VALUE` texts as values by name, each of the type of the default that it changes.

    Args:
        option: of the command line, for messages.
        kind: what a name is the name of, for messages.
        texts: as they were given.
        defaults: by name; a list takes its values with commas between.

    Raises:
        OptionError: a name is not known, or a value is not of its type.
    """
    changes = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in defaults:
            raise OptionError(f"{option} {text}: unknown {kind}; expected one of {', '.join(defaults)}")
        changes[name] = _parse_value(f"{option} {text}", value, defaults[name])
    return changes


def _parse_value(given: str, text: str, default: Any) -> Any:
    """Return a text as a value of the type of a default."""
    if isinstance(default, tuple | list):
        kind = type(default[0]) if default else str
        return [_parse_value(given, part, kind()) for part in text.split(",")]
    try:
        return TRUTH_VALUES[text.lower()] if isinstance(default, bool) else type(default)(text)
    except (KeyError, ValueError):
        raise OptionError(f"{given}: '{text}' is no {type(default).__name__}") from None
