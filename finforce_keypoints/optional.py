"""Libraries that only finding key points needs, imported where they are used; their absence says what to install."""

from types import ModuleType

from finforce_optional import import_library


def import_onnxruntime() -> ModuleType:
    """Return onnxruntime, networks; raises MissingDependencyError where it is not installed."""
    return import_library("onnxruntime", "running a key point network")


def import_cv2() -> ModuleType:
    """Return cv2, image processing; raises MissingDependencyError where it is not installed."""
    return import_library("cv2", "image processing of key points", "opencv-contrib-python-headless")
