"""The base of the errors that finforce raises on purpose, and of missing libraries."""

from collections.abc import Iterable
from difflib import get_close_matches


class FinforceError(Exception):
    """The base of every error that finforce raises on purpose."""


class MissingDependencyError(FinforceError, ImportError):
    """An optional library is needed and not installed."""


class ObservationError(FinforceError, ValueError):
    """Key points came in the wrong shape, frame or number."""


class PoseError(FinforceError, ValueError):
    """Numbers that were given as a pose are none."""


class RigError(FinforceError, ValueError):
    """A rig file cannot be used, or is of another camera than the images."""


class ServiceError(FinforceError, RuntimeError):
    """A service of a node is not there, does not answer, or could not do what was asked; the message says which."""


class SilentTopicError(FinforceError, RuntimeError):
    """Nobody publishes a topic that is listened to; the message says what is published."""


def one_line(error: BaseException, longest: int = 1000) -> str:
    """Return what an error says as one line of so many characters, or its class where it says nothing.

    Of a longer one the middle is left out: libraries say at the end what is wrong, after where in their code.
    """
    said = " ".join(str(error).split()) or type(error).__name__
    half = longest // 2 - 2
    return said if len(said) <= longest else f"{said[:half]} .. {said[len(said) - half :]}"


def suggest(word: str, known: Iterable[str]) -> str:
    """Return "did you mean NAME?" for a word that resembles a known one, else "expected one of" all of them."""
    names = list(known)
    close = get_close_matches(word, names, n=1)
    return f"did you mean {close[0]}?" if close else f"expected one of {', '.join(names)}"
