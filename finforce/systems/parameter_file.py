"""Files of ROS parameters: which of their sections are for a node."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from finforce.errors import suggest
from finforce.files import FileError, read_yaml

_PARAMETERS = "ros__parameters"


def parameters_of(file: str, node: str) -> Mapping[str, Any]:
    """Return the parameters that a file gives to a node, by its full name; of several sections the last one counts.

    Raises:
        ValueError: the file cannot be read, or is none of parameters.
    """
    found: dict[str, Any] = {}
    for key, parameters in _read_sections(file):
        if _is_for(key, node):
            found |= parameters
    return found


def check_sections(file: str, namespace: str, names: Iterable[str]) -> None:
    """Refuse a file with a section that ROS would ignore, as no node of a system has its name.

    Sections of nodes in other namespaces, those of other robots, may stand beside sections of nodes in this one.

    Args:
        file: with the parameters.
        namespace: of the nodes.
        names: of the nodes.

    Raises:
        ValueError: there is one, or the file cannot be read, or is none of parameters.
    """
    names, space = list(names), f"/{namespace.strip('/')}".rstrip("/")
    ends = {key: key.rpartition("/")[2] for key, _ in _read_sections(file)}
    has_own = any(name in names and _is_for(key, f"{space}/{name}") for key, name in ends.items())
    for key, name in ends.items():
        is_elsewhere = has_own and name in names and "/" in key.lstrip("/")
        if not is_elsewhere and not any(_is_for(key, f"{space}/{each}") for each in names):
            right = f"write /**/{name}" if name in names else suggest(name, names)
            where = f"in the namespace {space}" if space else "without a namespace"
            raise ValueError(f"{file}: '{key}' is no node of this system {where}, and would be ignored; {right}")


def _is_for(key: str, node: str) -> bool:
    """Return whether a section is for a node: ** stands for any number of names, * for one."""
    pattern = re.escape(f"/{key.lstrip('/')}").replace(r"/\*\*", r"(/\w+)*").replace(r"/\*", r"/\w+")
    return re.fullmatch(pattern, node) is not None


def _read_sections(file: str) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the sections of a file, by their keys with the namespaces around them.

    Raises:
        ValueError: it cannot be read, or is none of parameters.
    """
    try:
        return list(_walk("", read_yaml(file) or {}))
    except (FileError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"{file}: {error}; expected ROS parameters: node, {_PARAMETERS}, names") from error


def _walk(place: str, tree: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for key, value in tree.items():
        if key == _PARAMETERS:
            yield place, dict(value or {})
        else:
            yield from _walk(f"{place}/{key.lstrip('/')}" if place else key, value or {})
