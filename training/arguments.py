"""Settings records as options of a command; knows no record."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import fields
from typing import Any


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
