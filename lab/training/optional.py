"""Libraries that only training needs; their absence says what to install."""

from types import ModuleType

from finforce.optional import import_library

PURPOSE = "training of key point networks"


def import_torch() -> ModuleType:
    """Return torch, networks and their gradients; raises MissingDependencyError where it is not installed."""
    return import_library("torch", PURPOSE, "torch --index-url https://download.pytorch.org/whl/cpu")


def import_onnx() -> ModuleType:
    """Return onnx, which the export needs; raises MissingDependencyError where it is not installed."""
    return import_library("onnx", PURPOSE)
