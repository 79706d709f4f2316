"""`finforce version`."""

import argparse

from finforce_eval.cli.parser import CommandResult
from finforce_eval.machine import version


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add nothing."""


def run(options: argparse.Namespace) -> CommandResult:
    """Print the version."""
    print(f"finforce {version()}")
    return CommandResult({"version": version()})
