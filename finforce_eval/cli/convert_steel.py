"""`finforce convert-steel`: the images of the measured steel finger as a recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from finforce.files import FileError, read_json
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.steel import SHIPPED, recording_from_measurement
from finforce_eval.recordings.writer import write_recording


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("output", metavar="FOLDER", help="recording to be written")
    parser.add_argument("--source", metavar="FILE", help="measurement; without it the shipped one")
    parser.add_argument("--storage", default="mcap", choices=("mcap", "sqlite3"), help="its format")


def run(options: argparse.Namespace) -> None:
    """Convert the measurement and write the recording."""
    source = Path(options.source) if options.source else SHIPPED
    try:
        measurement = read_json(source)
    except FileError as error:
        raise RecordingError(f"{source}: {error}") from error
    output = Path(options.output)
    folder = write_recording(recording_from_measurement(measurement), output, storage=options.storage)
    print(f"Recording: {folder}")
    print(f"Score it with: finforce evaluate {folder} --jaw steel")
