"""Claims about what installs finforce: every dependency has a rosdep key or stands in requirements.txt, files agree."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).parents[2]
KEYS = {
    "pandas": "python3-pandas",
    "numpy": "python3-numpy",
    "scipy": "python3-scipy",
    "pyyaml": "python3-yaml",
    "pillow": "python3-pil",
    "rosbags": "python3-rosbags-pip",
    "trimesh": "python3-trimesh-pip",
    "open3d": "python3-open3d-pip",
    "open3d-cpu": "python3-open3d-pip",
    "onnxruntime": "python3-onnxruntime-pip",
    "opencv-contrib-python-headless": "python3-opencv",
    "pyserial": "python3-serial",
    "shapely": "python3-shapely",
    "matplotlib": "python3-matplotlib",
    "tqdm": "python3-tqdm",
    "psutil": "python3-psutil",
}
# packages of ROS that launch files start, and that a user asks for by an argument
OPTIONAL = {"controller_manager", "kortex_bringup", "moveit_ros_move_group", "realsense2_camera", "rviz2"}


def setup_arguments():
    tree = ast.parse((ROOT / "setup.py").read_text())
    call = next(
        node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "setup"
    )
    return {keyword.arg: keyword.value for keyword in call.keywords}


def bare(requirement):
    return re.split(r"[\s;<>=!\[]", requirement.strip(), maxsplit=1)[0]


def package():
    return ElementTree.parse(ROOT / "package.xml").getroot()


def test_every_library_has_a_key_or_stands_in_the_requirements():
    given, mesh = setup_arguments(), None
    for key, value in zip(given["extras_require"].keys, given["extras_require"].values, strict=True):
        mesh = ast.literal_eval(value) if key.value == "mesh" else mesh
    needed = {bare(entry) for entry in [*ast.literal_eval(given["install_requires"]), *mesh]}
    keys = {entry.text for entry in package().findall("exec_depend")}
    listed = {bare(line) for line in (ROOT / "requirements.txt").read_text().splitlines() if line[:1] not in ("#", "")}
    assert {name for name in needed if KEYS.get(name) not in keys and name not in listed} == set()
    assert listed <= needed  # nothing is left behind


def test_every_package_of_ros_that_is_imported_is_declared():
    keys = {entry.text for entry in package().findall("exec_depend")}
    found = set()
    for path in [*ROOT.glob("finforce*/**/*.py"), *ROOT.glob("examples/*.py")]:
        found |= set(
            re.findall(r"^(?:from|import) (\w+_msgs|\w+_srvs|rclpy|\w+_interfaces|ament_\w+)\b", path.read_text(), re.M)
        )
    assert found - {"composition_interfaces"} <= keys
    assert "control_msgs" in keys


def test_packages_that_launch_files_start_are_declared_or_asked_for():
    keys = {entry.text for entry in package().findall("exec_depend")}
    started = set()
    for path in ROOT.glob("finforce/systems/*.py"):
        started |= set(re.findall(r'package="(\w+)"', path.read_text()))
    assert started - keys - OPTIONAL - {"finforce"} == set()


def test_name_version_and_licence_agree_everywhere():
    given, xml = setup_arguments(), package()
    version = given["version"].value
    assert xml.findtext("version") == version
    assert (xml.findtext("name"), xml.findtext("license")) == ("finforce", given["license"].value)
    assert f"## [{version}]" in (ROOT / "CHANGELOG.md").read_text()
    assert f"version: {version}" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.parametrize(
    "path", [*sorted((ROOT / ".github").glob("*/*.yml")), ROOT / ".readthedocs.yaml"], ids=lambda path: path.name
)
def test_workflows_call_what_there_is(path):
    text = path.read_text()
    assert yaml.safe_load(text)
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M))
    assert set(re.findall(r"(?:run:|-) make (\w+)", text)) <= targets
    for tool in re.findall(r"(tools/\w+\.\w+)", text):
        assert (ROOT / tool).is_file()


def test_the_container_for_work_names_a_stage_that_there_is():
    given = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text())
    stages = set(re.findall(r"^FROM \S+ AS (\w+)", (ROOT / "Dockerfile").read_text(), re.M))
    assert given["build"]["target"] in stages
    assert (ROOT / given["postCreateCommand"].split()[0]).is_file()


def test_every_module_can_be_imported():
    done = subprocess.run(
        [sys.executable, ROOT / "tools/check_imports.py"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_notes_of_a_release_are_its_section_of_the_changelog():
    sys.path.insert(0, str(ROOT / "tools"))
    from release_notes import notes_of

    text = "# C\n\n## [0.2.0] - 2026-01-02\n\n### Added\n- a\n\n## [0.1.0] - 2025-01-01\n- b\n"
    assert notes_of("0.2.0", text) == "### Added\n- a"
    assert notes_of("0.1.0", text) == "- b"
    with pytest.raises(SystemExit, match="no section"):
        notes_of("3.0.0", text)
    with pytest.raises(SystemExit, match="expected YYYY-MM-DD"):
        notes_of("0.2.0", text.replace("2026-01-02", "Unreleased"))
