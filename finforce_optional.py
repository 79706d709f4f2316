"""Libraries that not everybody installs, imported where they are used; their absence says what to install."""

from importlib import import_module
from types import ModuleType

from finforce_errors import MissingDependencyError


def import_library(name: str, purpose: str, package: str = "") -> ModuleType:
    """Return a library.

    Args:
        name: of the module.
        purpose: what needs it, for the message.
        package: what `pip install` calls it; empty: the module's name.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingDependencyError(f"{purpose} needs {name}: pip install {package or name} ({error})") from error
