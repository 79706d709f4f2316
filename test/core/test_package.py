"""Claims about the package: what is installed, what it needs, and who may know ROS."""

import ast
import configparser
import re
import sys
import xml.etree.ElementTree as ElementTree
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
import setuptools

from finforce.ros import start

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(ROOT.glob("finforce*/**/*.py"))
ROS = {"rclpy", "builtin_interfaces", "rcl_interfaces", "rosgraph_msgs", "std_srvs"}
ROS |= {f"{name}_msgs" for name in ("diagnostic", "geometry", "sensor", "std", "visualization")}
LAUNCH = {"launch", "launch_ros", "ament_index_python"}  # only where a full ROS 2 is
ADAPTERS = {"dask": "cluster.py", "distributed": "cluster.py"}  # of extras
MODULES = {"PIL": "pillow", "serial": "pyserial", "yaml": "pyyaml", "cv2": "opencv-contrib-python-headless"}


@pytest.fixture(scope="module")
def described():
    """What setup.py tells setuptools."""
    found = {}
    original, setuptools.setup = setuptools.setup, found.update
    try:
        code = compile((ROOT / "setup.py").read_text(encoding="utf-8"), "setup.py", "exec")
        exec(code, {"__name__": "setup"})
    finally:
        setuptools.setup = original
    return found


@pytest.fixture(scope="module")
def manifest():
    return ElementTree.parse(ROOT / "package.xml").getroot()


@cache
def imported(path):
    """The top names of what a file imports; optional libraries by their adapters' calls."""
    names = set()
    if path.name == "optional.py":
        names |= set(re.findall(r'import_library\("(\w+)"', path.read_text(encoding="utf-8")))
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names.add(node.module.split(".")[0])
    return names


def is_ros_file(path):
    return path.name == "node.py" or path.parent == ROOT / "finforce" / "ros"


def test_only_nodes_and_their_shared_module_import_ros():
    strangers = {path.name: imported(path) & ROS for path in SOURCES if not is_ros_file(path)}
    assert not {name: found for name, found in strangers.items() if found}


def test_the_linter_bans_every_ros_package_that_is_used():
    used = set().union(*(imported(path) & ROS for path in SOURCES))
    banned = set(re.findall(r'^(\w+)\.msg = "only node', (ROOT / "pyproject.toml").read_text(), re.MULTILINE))
    assert used <= banned


def test_name_version_and_licence_agree(described, manifest):
    assert manifest.findtext("name") == described["name"] == "finforce"
    assert manifest.findtext("version") == described["version"]
    assert manifest.findtext("license") == described["license"] == "Apache-2.0"
    assert manifest.findtext("export/build_type") == "ament_python"
    assert "Apache License" in (ROOT / "LICENSE").read_text(encoding="utf-8")


def test_every_library_that_is_imported_is_required_and_no_other(described):
    ours = {path.stem for path in ROOT.glob("finforce*")}
    names = set().union(*(imported(path) for path in SOURCES))
    libraries = names - set(sys.stdlib_module_names) - ours - ROS - LAUNCH - set(ADAPTERS)
    listed = [*described["install_requires"], *described["extras_require"]["mesh"]]
    required = {re.split(r"[<>=\[; ]", text)[0] for text in listed} - {"open3d-cpu"}
    assert {MODULES.get(name, name) for name in libraries} == required


@pytest.mark.parametrize("library", ADAPTERS)
def test_an_optional_library_is_imported_in_its_adapter_alone(library):
    assert [path.name for path in SOURCES if library in imported(path)] == [ADAPTERS[library]]


def test_every_ros_package_that_is_imported_is_in_the_manifest(manifest):
    used = set().union(*(imported(path) & ROS for path in SOURCES))
    assert used <= {entry.text for entry in manifest.iter("exec_depend")}


def test_every_module_is_installed(described):
    folders = {".".join(path.parent.relative_to(ROOT).parts) for path in SOURCES}
    assert set(described["packages"]) == folders


def test_the_description_of_the_wheel_has_no_link_into_the_repository(described):
    targets = re.findall(r"\]\(([^)]*)\)", described["long_description"])
    assert all(target.startswith(("https://", "#")) for target in targets)
    assert (
        "[calibrated]" not in described["long_description"] and "calibrated, the force" in described["long_description"]
    )


def test_every_package_says_that_it_is_typed(described):
    for package in (name for name in described["packages"] if "." not in name):
        assert (ROOT / package / "py.typed").is_file()


def test_the_driver_imports_none_of_the_other_packages():
    own = {"finforce_driver"}
    strangers = {
        path.name: {name for name in imported(path) if name.startswith("finforce_")} - own
        for path in SOURCES
        if "finforce_driver" in path.parts and not is_ros_file(path)
    }
    assert not {name: found for name, found in strangers.items() if found}


def test_executables_land_where_ros_looks_and_point_at_functions(described):
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    assert parser["install"]["install_scripts"] == parser["develop"]["script_dir"] == "$base/lib/finforce"
    for script in described["entry_points"]["console_scripts"]:
        module, function = script.split(" = ")[1].split(":")
        assert callable(getattr(import_module(module), function))


def test_an_executable_runs_the_node_of_its_name(monkeypatch):
    started = []
    monkeypatch.setattr(start, "start", lambda name: started.append((name, sys.argv[1:])) or 0)
    for words in (["/opt/lib/finforce/ifea_solver", "-x"], [start.__file__, "twin_camera", "-x"]):
        monkeypatch.setattr(sys, "argv", words)
        assert start.main() == 0
    assert started == [("ifea_solver", ["-x"]), ("twin_camera", ["-x"])]


def test_launch_configuration_and_marker_files_are_installed(described):
    files = {folder: set(names) for folder, names in described["data_files"]}
    for folder in ("launch", "config", "rviz", "urdf"):
        there = {str(path.relative_to(ROOT)) for path in (ROOT / folder).iterdir() if path.is_file()}
        assert {str(Path(name)) for name in files[f"share/finforce/{folder}"]} == there
    assert files["share/ament_index/resource_index/packages"] == {"resource/finforce"}


def test_shipped_data_are_installed(described):
    everywhere = described["package_data"].pop("")
    for package, patterns in described["package_data"].items():
        folder = ROOT / package.replace(".", "/")
        matched = {path for pattern in [*patterns, *everywhere] for path in folder.glob(pattern) if path.is_file()}
        shipped = {
            path
            for path in folder.rglob("*")
            if path.is_file() and path.suffix not in (".py", ".pyc") and "__pycache__" not in path.parts
        }
        assert shipped == matched
