"""Small files from anywhere, YAML and JSON, read within bounds.

What is no plain file, too large, nested too deeply or blown up by references is refused before it costs memory or time.
Links are followed, pipes and devices are not waited for.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from finforce.errors import FinforceError, one_line

LARGEST = 16 << 20  # [bytes], of a file
LARGEST_YAML = 1 << 19  # [bytes], of a YAML file
_MOST_BUDGET = 10_000.0
DEEPEST = 50  # levels of nesting
MOST_VALUES = 50_000  # values, those behind references counted each time
MOST_DIGITS = 400  # digits of a number
BUDGET = "FINFORCE_BUDGET"  # of the environment: a factor on what files may cost
_POINTER = b"version https://git-lfs.github.com/spec/"
_OPEN = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


class FileError(FinforceError, ValueError):
    """A file cannot be read, or holds what no such file does; the message says what, without the file's name."""


def raise_budget(limit: int) -> int:
    """Return a limit times the factor in FINFORCE_BUDGET, from 1 to 10,000; as it is without one."""
    try:
        factor = float(os.environ.get(BUDGET, "1"))
    except ValueError:
        factor = 1.0
    return int(limit * factor) if 1.0 <= factor <= _MOST_BUDGET else limit


def read_bytes(path: str | Path, largest: int = LARGEST) -> bytes:
    """Return the content of a plain file.

    Raises:
        FileError: it is missing, no plain file, or larger than `largest` bytes.
    """
    allowed = raise_budget(largest)
    content = _read_start(path, allowed + 1)
    if len(content) > allowed:
        raise FileError(f"has more than {allowed >> 10} KiB; {BUDGET}=10 would allow ten times as many")
    return content


def check_plain(path: Path) -> None:
    """Refuse what a reader of content would wait for or stumble over.

    Raises:
        FileError: it is missing, no plain file, or stands for a file that Git LFS has not fetched.
    """
    if _read_start(path, len(_POINTER)) == _POINTER:
        raise FileError("is the pointer of a file that Git LFS has not fetched: run `git lfs pull` in its repository")


def _read_start(path: str | Path, most: int) -> bytes:
    """Return the first bytes of a plain file, at most so many; raises FileError where it is none."""
    try:
        handle = os.open(path, _OPEN)
        with os.fdopen(handle, "rb") as file:
            state = os.fstat(handle)
            if not stat.S_ISREG(state.st_mode):
                raise FileError("is not a plain file")
            return file.read(min(most, state.st_size + 1))
    except (OSError, ValueError) as error:  # a name with a null byte is a ValueError
        if isinstance(error, FileError):
            raise
        raise FileError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error


def check_inside(path: Path, folder: Path) -> Path:
    """Return a path that lies in a folder, links followed.

    A snapshot of Hugging Face's cache consists of links to the blobs next to it, which are taken for part of it.

    Raises:
        FileError: it leads out of the folder.
    """
    roots = [folder.resolve()]
    if roots[0].parent.name == "snapshots":
        roots.append(roots[0].parents[1] / "blobs")
    try:
        place = path.resolve()
    except (OSError, RuntimeError) as error:  # a link to itself, by the version of Python
        raise FileError(f"{path.name} cannot be read: {one_line(error)}") from error
    if not any(place.is_relative_to(root) for root in roots):
        raise FileError(
            f"{path.name} leads out of the folder {folder.name}; expected what lies in it, no link elsewhere"
        )
    return path


def read_text(path: str | Path, largest: int = LARGEST) -> str:
    """Return the text of a plain file in UTF-8; raises FileError where it is none, or larger than `largest` bytes."""
    try:
        return read_bytes(path, largest).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileError(f"is not UTF-8 text: {error.reason} at byte {error.start}") from error


def read_yaml(path: str | Path, *, text_keys: bool = True) -> Any:
    """Return the content of a YAML file.

    Args:
        path: of the file.
        text_keys: True if keys that are no texts are refused.

    Raises:
        FileError: it cannot be read, is no YAML, or is out of bounds; a key stands twice, or is no text.
    """
    return parse_yaml(read_text(path, LARGEST_YAML), text_keys=text_keys)


def parse_yaml(text: str, *, text_keys: bool = True) -> Any:
    """Return the content of a YAML text; see `read_yaml`."""
    try:
        loader = _BoundedLoader(text)
        loader.text_keys = text_keys
        return loader.get_single_data()
    except FileError:
        raise
    except (yaml.YAMLError, TypeError, ValueError, OverflowError, RecursionError, AttributeError) as error:
        raise FileError(f"is not valid YAML: {one_line(error)}") from error


def read_json(path: str | Path) -> Any:
    """Return the content of a JSON file; raises FileError where it cannot be read, is no JSON, or is out of bounds."""
    return parse_json(read_text(path))


def parse_json(text: str) -> Any:
    """Return the content of a JSON text; raises FileError where it is none, or out of bounds."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileError(f"is not valid JSON: {one_line(error)}") from error


class _BoundedLoader(yaml.SafeLoader):
    """The safe loader, which counts what it builds and refuses a key that stands twice.

    Attributes:
        text_keys: True if keys have to be texts.
    """

    text_keys = True

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth, self._values = 0, 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Build a node; of one that is referred to, as many values as it holds are counted once more."""
        if self.check_event(yaml.AliasEvent):
            node = super().compose_node(parent, index)
            if id(node) not in self._sizes:
                raise FileError(f"refers to what it is itself part of, in line {self._line()}")
            self._count(self._sizes[id(node)])
            return node
        self._depth += 1
        if self._depth > DEEPEST:
            raise FileError(f"is nested more than {DEEPEST} deep, in line {self._line()}")
        before = self._values
        self._count(1)
        node = super().compose_node(parent, index)
        self._sizes[id(node)] = self._values - before
        self._depth -= 1
        return node

    def _line(self) -> int:
        return self.line + 1

    def _count(self, values: int) -> None:
        self._values += values
        if self._values > MOST_VALUES:
            raise FileError(f"has more than {MOST_VALUES} values, those that references repeat included")

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        """Build a mapping and refuse double keys, and such as are no texts."""
        line = node.start_mark.line + 1
        keys: set[Hashable] = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if self.text_keys and not isinstance(key, str):
                raise FileError(f"the key {str(key)[:40]!r} in the mapping from line {line} on is not text")
            if isinstance(key, Hashable) and key in keys:
                raise FileError(f"the key {key!r} stands twice in the mapping from line {line} on")
            if isinstance(key, Hashable):
                keys.add(key)
        return super().construct_mapping(node, deep)

    def construct_scalar(self, node: yaml.ScalarNode) -> Any:
        """Return a scalar; of a number no more digits than one has."""
        value = super().construct_scalar(node)
        if node.tag.endswith((":int", ":float")) and len(value) > MOST_DIGITS:
            raise FileError(f"a number in line {node.start_mark.line + 1} has {len(value)} digits")
        return value
