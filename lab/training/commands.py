"""Shared parts of the training commands: errors, libraries that only they need, settings as options."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from types import ModuleType
from typing import Any

from finforce.errors import FinforceError
from finforce.optional import import_library

PURPOSE = "training of key point networks"


def import_torch() -> ModuleType:
    """Return torch, networks and their gradients; raises MissingDependencyError where it is not installed."""
    return import_library("torch", PURPOSE, "torch --index-url https://download.pytorch.org/whl/cpu")


def import_onnx() -> ModuleType:
    """Return onnx, which the export needs; raises MissingDependencyError where it is not installed."""
    return import_library("onnx", PURPOSE)


class TrainingError(FinforceError, ValueError):
    """Labels, shards, a checkpoint or a setting of the training cannot be used."""


def add_settings(parser: ArgumentParser, record: type) -> None:
    """Add an option for every field of a settings record."""
    for item in fields(record):
        unit = f" [{item.metadata['unit']}]" if item.metadata["unit"] else ""
        parser.add_argument(
            f"--{item.name.replace('_', '-')}",
            type=type(item.default),
            default=item.default,
            help=f"{item.metadata['description']}{unit} (default {item.default})",
        )


def settings_from(arguments: Namespace, record: type) -> Any:
    """Return the settings record that the options make; what it raises is its own."""
    return record(**{item.name: getattr(arguments, item.name) for item in fields(record)})


@contextmanager
def one_line_errors() -> Iterator[None]:
    """End the process with one line and status 1 where an error of ours leaves the `with` block."""
    try:
        yield
    except FinforceError as error:
        raise SystemExit(f"training: {error}") from error


def read_share(text: str) -> float:
    """Return an option as a number from 0 to 1."""
    try:
        number = float(text)
    except ValueError:
        number = -1.0
    if not 0.0 <= number <= 1.0:
        raise ArgumentTypeError(f"{text[:40]!r}: expected a number from 0 to 1")
    return number
