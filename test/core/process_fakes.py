"""Processes that tests start, none of which outlives its test."""

import subprocess
from contextlib import contextmanager

END = 10.0  # [s] in which the system takes a killed process away


@contextmanager
def running(command, **options):
    """A process that is killed at the end of the block where it still runs."""
    process = subprocess.Popen(command, **options)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.wait(END)
        for stream in (process.stdin, process.stdout, process.stderr):
            if stream is not None:
                stream.close()
