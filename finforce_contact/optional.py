"""Libraries that only the object's side needs, imported where they are used; their absence says what to install."""

from importlib import import_module
from types import ModuleType

from finforce_ifea.errors import MissingDependencyError


def import_manifold3d() -> ModuleType:
    """Return manifold3d, booleans of solids; raises MissingDependencyError where it is not installed."""
    return _import("manifold3d", "contact of meshes")


def import_open3d() -> ModuleType:
    """Return open3d, repair and registration; raises MissingDependencyError where it is not installed."""
    return _import("open3d", "repair and registration of meshes")


def import_trimesh() -> ModuleType:
    """Return trimesh, mesh files; raises MissingDependencyError where it is not installed."""
    return _import("trimesh", "reading of mesh files")


def _import(name: str, purpose: str) -> ModuleType:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingDependencyError(f"{purpose} needs {name}: pip install {name} ({error})") from error
