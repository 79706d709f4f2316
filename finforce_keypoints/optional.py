"""Libraries that only finding key points needs, imported where they are used; their absence says what to install."""

from importlib import import_module
from types import ModuleType

from finforce_ifea.errors import MissingDependencyError


def import_onnxruntime() -> ModuleType:
    """Return onnxruntime, networks; raises MissingDependencyError where it is not installed."""
    return _import("onnxruntime", "onnxruntime", "running a key point network")


def import_cv2() -> ModuleType:
    """Return cv2, image processing; raises MissingDependencyError where it is not installed."""
    return _import("cv2", "opencv-contrib-python-headless", "image processing of key points")


def _import(name: str, package: str, purpose: str) -> ModuleType:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingDependencyError(f"{purpose} needs {name}: pip install {package} ({error})") from error
