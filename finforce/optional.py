"""Libraries that not everybody installs, imported where they are used; their absence says what to install."""

import os
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType

from finforce.errors import MissingDependencyError


def import_library(name: str, purpose: str, package: str = "", title: str = "") -> ModuleType:
    """Return a library.

    Args:
        name: of the module.
        purpose: its user, for the message.
        package: its name for `pip install`; empty: the module's name.
        title: its name in the message; empty: the module's name.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        how = f"{title or name}: pip install {package or name}"
        if name.partition(".")[0].endswith("_msgs"):  # which no wheel brings
            how = f"ROS 2 from apt with {_apt_package(name.partition('.')[0])}"
        raise MissingDependencyError(f"{purpose} needs {how} ({error})") from error


def _apt_package(name: str) -> str:
    """Return the name of a package of ROS 2 for apt."""
    return f"ros-{os.environ.get('ROS_DISTRO', 'jazzy')}-{name.replace('_', '-')}"


def import_ros(name: str, purpose: str) -> ModuleType:
    """Return a module of finforce that needs ROS 2; raises MissingDependencyError where that is not installed."""
    check_middleware()
    return import_library(name, purpose, "'finforce[ros]'", "ROS 2")


def check_middleware() -> None:
    """Refuse a middleware that RMW_IMPLEMENTATION names and ROS 2 has not, with which every node would exit.

    Raises:
        MissingDependencyError: it is not installed.
    """
    wanted, prefixes = os.environ.get("RMW_IMPLEMENTATION"), os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    index = [Path(prefix, "share/ament_index/resource_index/rmw_typesupport") for prefix in (*prefixes, sys.prefix)]
    known = {each.name for folder in index if folder.is_dir() for each in folder.iterdir()} - {"rmw_implementation"}
    if wanted and known and wanted not in known:
        raise MissingDependencyError(
            f"RMW_IMPLEMENTATION={wanted} is not installed, {', '.join(sorted(known))} is: unset RMW_IMPLEMENTATION, "
            f"or use ROS 2 from apt with {_apt_package(wanted)}"
        )


def import_manifold3d() -> ModuleType:
    """Return manifold3d, booleans of solids; raises MissingDependencyError where it is not installed."""
    return import_library("manifold3d", "contact of meshes")


class _Deferred(ModuleType):
    """A module that is imported when one of its functions is called."""

    def __getattr__(self, name: str) -> Callable:
        """Return what calls the function of a name."""
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *args, **options: getattr(import_module(self.__name__), name)(*args, **options)


_PLOTS = "open3d.visualization.draw_plotly"  # imports Dash, Plotly and IPython: 44 MB, 0.3 s


def import_open3d() -> ModuleType:
    """Return open3d, repair and registration; raises MissingDependencyError where it is not installed."""
    sys.modules.setdefault(_PLOTS, _Deferred(_PLOTS))
    try:
        return import_library("open3d", "the simulator, or registration or decimation of a mesh,", "'finforce[mesh]'")
    finally:
        if isinstance(sys.modules.get(_PLOTS), _Deferred):
            sys.modules.pop(_PLOTS, None)


def import_trimesh() -> ModuleType:
    """Return trimesh, mesh files; raises MissingDependencyError where it is not installed."""
    return import_library("trimesh", "reading of mesh files")


def import_onnxruntime() -> ModuleType:
    """Return onnxruntime, networks; raises MissingDependencyError where it is not installed."""
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # else it keeps a database of its uses, and sends it
    return import_library("onnxruntime", "running a key point network")


def import_cv2() -> ModuleType:
    """Return cv2, image processing; raises MissingDependencyError where it is not installed."""
    return import_library("cv2", "image processing of key points", "opencv-contrib-python-headless")
