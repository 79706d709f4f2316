"""Libraries that only the object's side needs, imported where they are used; their absence says what to install."""

from types import ModuleType

from finforce_optional import import_library


def import_manifold3d() -> ModuleType:
    """Return manifold3d, booleans of solids; raises MissingDependencyError where it is not installed."""
    return import_library("manifold3d", "contact of meshes")


def import_open3d() -> ModuleType:
    """Return open3d, repair and registration; raises MissingDependencyError where it is not installed."""
    return import_library("open3d", "repair and registration of meshes")


def import_trimesh() -> ModuleType:
    """Return trimesh, mesh files; raises MissingDependencyError where it is not installed."""
    return import_library("trimesh", "reading of mesh files")
