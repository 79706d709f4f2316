"""Typed reading of a jaw file's YAML, with errors that say what would do; knows nothing of jaws."""

import contextlib
import difflib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from finforce_ifea.errors import JawFileError

_LARGEST_COUNT = 10_000


class _Loader(yaml.SafeLoader):
    """The safe loader, which also refuses a key that stands twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        """Build a mapping and refuse double keys."""
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for number, key in enumerate(keys):
            if key in keys[:number]:
                line = node.start_mark.line + 1
                raise JawFileError(f"the key {key!r} stands twice in the mapping from line {line} on")
        return super().construct_mapping(node, deep)


def read_table(path: Path) -> "Table":
    """Read a YAML file whose content is a mapping.

    Raises:
        JawFileError: The file is missing, empty, no YAML, or no mapping.
    """
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except OSError as error:
        raise JawFileError(f"cannot be read: {error.strerror}") from error
    except JawFileError:
        raise
    except UnicodeDecodeError as error:
        raise JawFileError("is no text file, expected YAML in UTF-8") from error
    except (yaml.YAMLError, TypeError, ValueError, RecursionError) as error:
        raise JawFileError(f"is no valid YAML: {' '.join(str(error).split())}") from error
    if content is None:
        raise JawFileError("is empty, expected drawing or mesh, material, keypoints, candidates")
    if not isinstance(content, dict):
        raise JawFileError(f"got {_describe(content)} at the top, expected a mapping")
    return Table(prefix="", values=content)


@dataclass(frozen=True, kw_only=True)
class Table:
    """A mapping of the file.

    Attributes:
        prefix: the full name of its key, such as "drawing.ribs"; empty at the top.
        values: its content.
    """

    prefix: str
    values: dict[str, Any]

    def __contains__(self, key: str) -> bool:
        """Whether a key is given."""
        return key in self.values

    def name(self, key: str) -> str:
        """Return the full name of a key."""
        return f"{self.prefix}.{key}" if self.prefix else str(key)

    def expect_keys(self, required: Iterable[str], optional: Iterable[str] = ()) -> None:
        """Refuse missing and unknown keys, suggesting the nearest valid key.

        Raises:
            JawFileError: A key is missing or unknown.
        """
        required, valid = list(required), [*required, *optional]
        for key in self.values:
            if key not in valid:
                near = difflib.get_close_matches(str(key), valid, n=1, cutoff=0.5)
                hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(valid)}"
                raise JawFileError(f"unknown key {self.name(key)!r}; {hint}")
        for key in required:
            if key not in self.values:
                raise JawFileError(f"{self.name(key)} is missing; expected {', '.join(required)}")

    def expect_one_of(self, *keys: str) -> str:
        """Return which one of some keys is given.

        Raises:
            JawFileError: None or several are given.
        """
        given = [key for key in keys if key in self.values]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            table = self.prefix or "the file"
            raise JawFileError(f"{table}: got {found}, expected exactly one of {', '.join(keys)}")
        return given[0]

    def table(self, key: str) -> "Table":
        """Return the mapping under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        value = self.values[key]
        if not isinstance(value, dict):
            raise JawFileError(f"{self.name(key)}: got {_describe(value)}, expected a mapping")
        return Table(prefix=self.name(key), values=value)

    def choice(self, key: str, options: tuple[str, ...], default: str) -> str:
        """Return the word under a key, one of some options.

        Raises:
            JawFileError: Something else stands there.
        """
        value = self.values.get(key, default)
        if value not in options:
            raise JawFileError(f"{self.name(key)}: got {_describe(value)}, expected {' or '.join(options)}")
        return value

    def text(self, key: str, default: str) -> str:
        """Return the text under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        value = self.values.get(key, default)
        if not isinstance(value, str) or not value.strip():
            raise JawFileError(f"{self.name(key)}: got {_describe(value)}, expected a text")
        return value

    def switch(self, key: str, default: bool) -> bool:
        """Return the true or false under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        value = self.values.get(key, default)
        if not isinstance(value, bool):
            raise JawFileError(f"{self.name(key)}: got {_describe(value)}, expected true or false")
        return value

    def count(self, key: str) -> int:
        """Return the whole number from 1 to 10000 under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        value = self.values[key]
        if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= _LARGEST_COUNT:
            raise JawFileError(
                f"{self.name(key)}: got {_describe(value)}, expected a whole number >= 1 and <= {_LARGEST_COUNT}"
            )
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """Return the finite number under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        return _parse_number(self.values.get(key, default), self.name(key))

    def length(self, key: str, default: float | None = None, largest: float = 1.0) -> float:
        """Return the length [m] under a key.

        Raises:
            JawFileError: Something else stands there, or more than the largest that makes sense.
        """
        return _parse_length(self.values.get(key, default), self.name(key), largest)

    def lengths(self, key: str, largest: float = 1.0) -> list[float]:
        """Return the list of lengths [m] under a key; a single one is a list of one.

        Raises:
            JawFileError: Something else stands there, or more than the largest that makes sense.
        """
        value = self.values[key]
        if not isinstance(value, list):
            return [_parse_length(value, self.name(key), largest)]
        return [_parse_length(item, f"{self.name(key)}[{i}]", largest) for i, item in enumerate(value)]

    def point(self, key: str, default: tuple[float, float, float] | None = None) -> NDArray:
        """Return the point (3,) [m] under a key.

        Raises:
            JawFileError: Something else stands there.
        """
        return parse_point(self.values.get(key, default), self.name(key))


def parse_point(value: Any, name: str) -> NDArray:
    """Return a point (3,) [m] from a list of three lengths.

    Raises:
        JawFileError: It is something else.
    """
    if not isinstance(value, (list, tuple)) or len(value) != 3:
        raise JawFileError(f"{name}: got {_describe(value)}, expected a point [x, y, z] in metres")
    return np.array([_parse_length(item, f"{name}[{axis}]") for item, axis in zip(value, "xyz", strict=True)])


def _parse_number(value: Any, name: str) -> float:
    """Return a finite number; texts such as 26e6, which YAML does not take for numbers, are read too."""
    number = value
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            number = float(value)
    if not isinstance(number, (int, float)) or isinstance(number, bool):
        raise JawFileError(f"{name}: got {_describe(value)}, expected a number")
    if not math.isfinite(number):
        raise JawFileError(f"{name}: got {number}, expected a finite number")
    return float(number)


def _parse_length(value: Any, name: str, largest: float = 1.0) -> float:
    """Return a length [m] that is not larger than makes sense."""
    length = _parse_number(value, name)
    if abs(length) > largest:
        raise JawFileError(
            f"{name}: got {length:g}, which looks like millimetres; expected metres, such as {length / 1000:g}"
        )
    return length


def _describe(value: Any) -> str:
    """Return a short description of a value that was not expected."""
    if value is None:
        return "nothing"
    kinds = {dict: "a mapping", list: "a list", str: "the text", bool: "the switch"}
    text = repr(value)
    text = text if len(text) <= 60 else text[:57] + "..."
    return f"{kinds.get(type(value), 'the ' + type(value).__name__)} {text}"
