"""Claims about the models of gripper and arm."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from finforce.gripper_frames import SIDES, jaw_in_gripper
from finforce_driver.settings import DriverParameters, GripperSettings
from finforce_ifea.jaw.jaw import load_jaw

URDF = Path(__file__).resolve().parents[2] / "urdf"
GRIPPER, ARM = URDF / "finray_gripper.urdf", URDF / "gen3_finray.urdf.xacro"
# what kortex_control.launch.py of ros2_kortex 1fdbef3 hands to its description
HANDED = {
    "robot_ip": "10.0.0.2",
    "name": "arm",
    "arm": "gen3",
    "dof": "7",
    "prefix": "",
    "use_fake_hardware": "false",
    "fake_sensor_commands": "false",
    "gripper": "",
    "use_internal_bus_gripper_comm": "true",
    "gripper_max_velocity": "100.0",
    "gripper_max_force": "100.0",
    "gripper_joint_name": "finger_joint",
}
KORTEX = """<robot xmlns:xacro="http://ros.org/wiki/xacro">
<xacro:macro name="load_robot" params="parent *origin prefix arm gripper gripper_joint_name dof vision robot_ip
  username password port port_realtime session_inactivity_timeout_ms connection_inactivity_timeout_ms
  use_internal_bus_gripper_comm use_fake_hardware fake_sensor_commands initial_positions">
  <link name="${prefix}end_effector_link"/>
  <joint name="${prefix}arm${dof}" type="fixed">
    <xacro:insert_block name="origin"/><parent link="${parent}"/><child link="${prefix}end_effector_link"/>
  </joint>
  <told vision="${vision}" gripper="${gripper}" address="${robot_ip}" start="${initial_positions['joint_1']}"/>
</xacro:macro></robot>"""


def numbers(element, name):
    return np.array([float(word) for word in (element.get(name) or "0 0 0").split()])


def place_joint(joint, value):
    """Return T_parent_child (4, 4) of a URDF joint at a value [m]."""
    origin, T = joint.find("origin"), np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", numbers(origin, "rpy")).as_matrix()
    T[:3, 3] = numbers(origin, "xyz")
    if joint.get("type") == "prismatic":
        T[:3, 3] += T[:3, :3] @ (value * numbers(joint.find("axis"), "xyz"))
    return T


@pytest.fixture(scope="module")
def gripper():
    return ElementTree.parse(GRIPPER).getroot()


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("opening", [0.0, 0.010, 0.048])
def test_the_jaws_frames_are_those_of_the_interfaces_at_every_opening(gripper, side, opening):
    (joint,) = [joint for joint in gripper.findall("joint") if joint.get("name") == f"{side}_jaw_joint"]
    assert (joint.find("parent").get("link"), joint.find("child").get("link")) == ("gripper_base", f"{side}_jaw")
    place = 0.5 * opening + load_jaw("bench", side).inner_face_x
    expected = jaw_in_gripper(side, -place if side == "left" else place)
    np.testing.assert_allclose(place_joint(joint, 0.5 * opening), expected, atol=1e-12)


def test_the_joints_are_those_that_the_driver_publishes(gripper):
    joints = {joint.get("name"): joint.find("limit") for joint in gripper.findall("joint")}
    assert tuple(joints) == DriverParameters().joint_names
    for limit in joints.values():
        assert (float(limit.get("lower")), float(limit.get("upper"))) == (0.0, 0.5 * GripperSettings().stroke)


def test_the_models_are_one_tree(gripper):
    links = [link.get("name") for link in gripper.findall("link")]
    children = [joint.find("child").get("link") for joint in gripper.findall("joint")]
    assert sorted(links) == sorted([*children, "gripper_base"])


@pytest.mark.parametrize("path", [GRIPPER, ARM], ids=lambda path: path.name)
def test_a_model_read_as_yaml_is_still_a_text(path):
    assert isinstance(yaml.safe_load(path.read_text(encoding="utf-8")), str)


@pytest.fixture
def described(tmp_path, monkeypatch):
    """The arm's model with a stand-in for kortex_description; needs xacro."""
    xacro = pytest.importorskip("xacro")
    share = tmp_path / "share" / "kortex_description"
    for folder in (share / "robots", share / "config", tmp_path / "share" / "ament_index/resource_index/packages"):
        folder.mkdir(parents=True)
    (share / "robots" / "kortex_robot.xacro").write_text(KORTEX)
    (share / "config" / "initial_positions.yaml").write_text("joint_1: 0.5\n")
    (tmp_path / "share" / "ament_index/resource_index/packages/kortex_description").touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    return xacro.process_file(str(ARM), mappings=dict(HANDED)).toprettyxml(indent="  ")  # as the program prints it


def test_the_gripper_hangs_on_the_flange_of_the_arm(described):
    model = ElementTree.fromstring(described)
    parents = {joint.find("child").get("link"): joint.find("parent").get("link") for joint in model.findall("joint")}
    assert parents["left_jaw"] == parents["right_jaw"] == "gripper_base"
    assert (parents["gripper_base"], parents["end_effector_link"]) == ("end_effector_link", "world")
    told = model.find("told")
    assert (told.get("vision").lower(), told.get("gripper"), told.get("address")) == ("false", "", "10.0.0.2")
    assert isinstance(yaml.safe_load(described), str)
