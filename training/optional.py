"""Libraries that only training needs; their absence says what to install."""

from importlib import import_module
from types import ModuleType

from finforce_ifea.errors import MissingDependencyError


def import_torch() -> ModuleType:
    """Return torch, networks and their gradients; raises MissingDependencyError where it is not installed."""
    return _import("torch", "torch --index-url https://download.pytorch.org/whl/cpu")


def import_onnx() -> ModuleType:
    """Return onnx, which the export needs; raises MissingDependencyError where it is not installed."""
    return _import("onnx", "onnx")


def _import(name: str, package: str) -> ModuleType:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingDependencyError(
            f"training of key point networks needs {name}: pip install {package} ({error})"
        ) from error
