"""Errors of recordings and commands; every one is reported as one line and exit status 2."""

from finforce.errors import FinforceError


class RecordingError(FinforceError, ValueError):
    """A recording cannot be read, or lacks what the command needs; in one line, whatever names are in it."""

    def __init__(self, text: str) -> None:
        super().__init__(" ".join(text.split()))


class DamagedError(RecordingError):
    """A recording breaks off, or part of it is no longer what was written."""


class UnseenError(RecordingError):
    """A detector found no jaw in any image."""


class SilentReplayError(RecordingError):
    """The nodes gave no force for a recording that was played to them."""


class OutOfBoundsError(RecordingError):
    """A recording would take more memory or time than one of its size does."""


class ClusterError(FinforceError, RuntimeError):
    """A cluster cannot be reached, has no worker that can do a task, or was lost."""


class OptionError(FinforceError, ValueError):
    """A command-line option has a value that means nothing here."""
