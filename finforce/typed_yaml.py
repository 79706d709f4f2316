"""YAML and JSON files of a fixed form as pydantic models; what is wrong with one is told in one sentence."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from reprlib import Repr
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from finforce.errors import FinforceError
from finforce.files import FileError, read_yaml

ModelT = TypeVar("ModelT", bound="FileModel")
_KINDS = {dict: "a mapping", list: "a list", tuple: "a list", str: "the text", bool: "the switch"}


class FileModel(BaseModel):
    """A mapping of a file, which has no other keys than the fields; numbers are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, values: Any) -> Any:
        """Refuse what is no mapping, and unknown keys with the nearest valid one."""
        if isinstance(values, cls):
            return values
        if not isinstance(values, Mapping):
            raise ValueError(f"got {describe(values)}, expected a mapping of {', '.join(cls.model_fields)}")
        unknown = [key for key in values if key not in cls.model_fields]
        if unknown and cls.model_config["extra"] == "forbid":
            near = difflib.get_close_matches(str(unknown[0]), cls.model_fields, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(cls.model_fields)}"
            raise ValueError(f"unknown key {unknown[0]!r}; {hint}")
        return values

    def expect_one_of(self, *names: str) -> str:
        """Return which one of some fields is given.

        Raises:
            ValueError: None or several are given.
        """
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"got {' and '.join(given) or 'none'}, expected exactly one of {', '.join(names)}")
        return given[0]


def read_model(path: Path, kind: type[ModelT], error: type[FinforceError]) -> ModelT:
    """Return the content of a YAML file as a model.

    Raises:
        error: It cannot be read, or something else stands there; the message does not name the file.
    """
    try:
        content = read_yaml(path, text_keys=False)
    except FileError as reason:
        raise error(str(reason)) from reason
    if content is None:
        raise error(f"is empty, expected a mapping of {', '.join(kind.model_fields)}")
    return parse_model(content, kind, error)


def parse_model(content: Any, kind: type[ModelT], error: type[FinforceError]) -> ModelT:
    """Return some content as a model; raises `error` where it is none, see `read_model`."""
    try:
        return kind.model_validate(content)
    except ValidationError as reason:
        raise error(explain(reason)) from reason


def explain(error: ValidationError) -> str:
    """Return the first thing that is wrong: which key, what came, what was expected."""
    found = error.errors(include_url=False)[0]
    parts = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in found["loc"] if part not in TAGS]
    name = "".join(parts).removeprefix(".")
    if found["type"] == "missing":
        return f"{name} is missing"
    if found["type"] == "value_error":
        text = str(found["ctx"]["error"])
    else:  # "Input should be a valid number, unable to parse ...", "Tuple should have at most 2 items after ..."
        expected = re.sub(r"^\w+ should (be|have) |, unable to .*| after validation.*", "", found["msg"])
        text = f"got {describe(found['input'])}, expected {expected}"
    return f"{name}: {text}" if name else text


def describe(value: Any) -> str:
    """Return a short description of a value that was not expected."""
    if value is None or value == [] or value == {}:
        return "nothing" if value is None else "none"
    if isinstance(value, int | float) and not isinstance(value, bool):
        return f"{value:g}" if abs(value) < 1e30 else repr(value)[:20]
    short = Repr()
    short.maxlevel, short.maxstring = 2, 60
    return f"{_KINDS.get(type(value), 'the ' + type(value).__name__)} {' '.join(short.repr(value).split())}"


TAGS = ("<list>", "<mapping>")  # of the members of a union, which are no keys


def _refuse_switch(value: Any) -> Any:
    """Refuse true and false where a number is expected, and texts that are none, such as 26e6 is."""
    if isinstance(value, bool):
        raise ValueError(f"got {describe(value)}, expected a number")
    return value


def refuse_millimetres(largest: float) -> Callable[[float], float]:
    """Return a check of lengths [m], which are no larger than makes sense."""

    def check(length: float) -> float:
        if abs(length) > largest:
            raise ValueError(
                f"got {length:g}, which looks like millimetres; expected metres, such as {length / 1000:g}"
            )
        return length

    return check


def _name_axes(value: Any) -> Any:
    """Refuse what is no list of three."""
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError(f"got {describe(value)}, expected a point [x, y, z] in metres")
    return value


Text = Annotated[str, Field(pattern=r"\S")]
Number = Annotated[float, BeforeValidator(_refuse_switch)]
Count = Annotated[int, Field(strict=True, ge=1, le=10_000)]
Length = Annotated[Number, AfterValidator(refuse_millimetres(1.0))]
Thickness = Annotated[Number, AfterValidator(refuse_millimetres(0.1))]
Point = Annotated[tuple[Length, Length, Length], BeforeValidator(_name_axes), AfterValidator(np.array)]
