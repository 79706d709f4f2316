"""Claims about the gripper under ros2_control and under MoveIt: what is started, and that the files belong together."""

from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

from finforce.errors import MissingDependencyError
from finforce.optional import import_library
from finforce.systems.processes import Process
from finforce.systems.stacks import StackOptions, control_processes, describe, flatten, moveit_processes
from finforce_driver.settings import DriverParameters

ROOT = Path(__file__).resolve().parents[2]
JOINTS = DriverParameters().joint_names


def by_name(processes):
    return {process.executable: process for process in processes}


@pytest.fixture(scope="module")
def control():
    pytest.importorskip("xacro")
    return by_name(control_processes(StackOptions(gripper_port="/dev/ttyACM7"), ROOT))


@pytest.fixture(scope="module")
def moveit():
    return by_name(moveit_processes(StackOptions(), ROOT))


def test_ros2_control_has_driver_manager_and_controllers(control):
    assert set(control) == {"gripper_driver", "robot_state_publisher", "ros2_control_node", "spawner"}
    assert control["gripper_driver"].parameters == {"port": "/dev/ttyACM7"}
    controllers = yaml.safe_load(Path(control["ros2_control_node"].parameter_file).read_text())
    declared = [
        name for name, value in controllers["controller_manager"]["ros__parameters"].items() if name != "update_rate"
    ]
    assert control["spawner"].arguments[:2] == tuple(declared)
    assert controllers["finray_gripper_controller"]["ros__parameters"]["joint"] == JOINTS[0]


def test_processes_with_several_nodes_leave_them_their_names(control, moveit):
    for process in (control["ros2_control_node"], control["spawner"], moveit["move_group"]):
        assert process.name == "" and not any("__node" in word for word in process.command())


def test_the_hardware_interface_has_the_joints_and_topics_of_the_driver(control):
    model = ElementTree.fromstring(control["robot_state_publisher"].parameters["robot_description"])
    system = model.find("ros2_control")
    assert system.find("hardware/plugin").text == "joint_state_topic_hardware_interface/JointStateTopicSystem"
    parameters = {entry.get("name"): entry.text for entry in system.findall("hardware/param")}
    assert parameters["joint_commands_topic"] == "/gripper_driver/command"
    assert parameters["joint_states_topic"] == "/" + control["gripper_driver"].remappings["joint_states"]
    joints = {joint.get("name"): joint for joint in system.findall("joint")}
    assert tuple(joints) == JOINTS
    assert [entry.get("name") for entry in joints[JOINTS[0]].findall("command_interface")] == ["position"]
    assert not joints[JOINTS[1]].findall("command_interface")
    for joint in joints.values():
        assert [entry.get("name") for entry in joint.findall("state_interface")] == ["position", "velocity", "effort"]
    assert system.find(".//param[@name='initial_value']") is None  # a controller would command it


def test_limits_of_commands_are_those_of_the_joints(control):
    model = ElementTree.fromstring(control["robot_state_publisher"].parameters["robot_description"])
    limit = model.find(f"joint[@name='{JOINTS[0]}']/limit")
    command = model.find(f"ros2_control/joint[@name='{JOINTS[0]}']/command_interface")
    given = {entry.get("name"): float(entry.text) for entry in command.findall("param")}
    assert given == {"min": float(limit.get("lower")), "max": float(limit.get("upper"))}


def test_moveit_moves_the_jaws_by_the_drivers_action(moveit):
    assert set(moveit) == {"gripper_driver", "robot_state_publisher", "move_group"}
    assert moveit["gripper_driver"].remappings == {}  # /joint_states are the driver's own
    given = moveit["move_group"].parameters
    (name,) = given["moveit_simple_controller_manager.controller_names"]
    prefix = f"moveit_simple_controller_manager.{name}."
    controller = {key.removeprefix(prefix): value for key, value in given.items() if key.startswith(prefix)}
    assert (name, controller["action_ns"]) == ("gripper_driver", "gripper_cmd")
    # the action's number is the opening, the sum of the joints
    assert controller["parallel"] is True and tuple(controller["joints"]) == JOINTS


def test_groups_and_states_name_what_the_description_has(moveit):
    given = moveit["move_group"].parameters
    model = ElementTree.fromstring(given["robot_description"])
    semantics = ElementTree.fromstring(given["robot_description_semantic"])
    joints = {joint.get("name"): joint.find("limit") for joint in model.findall("joint")}
    links = {link.get("name") for link in model.findall("link")}
    assert model.get("name") == semantics.get("name")
    assert {joint.get("name") for joint in semantics.findall("group/joint")} == set(JOINTS)
    states = {state.get("name"): state for state in semantics.findall("group_state")}
    for name, bound in (("open", "upper"), ("closed", "lower")):
        values = {joint.get("name"): float(joint.get("value")) for joint in states[name]}
        assert values == {joint: float(joints[joint].get(bound)) for joint in JOINTS}
    for pair in semantics.findall("disable_collisions"):
        assert {pair.get("link1"), pair.get("link2")} <= links
    assert not model.findall("joint/mimic")  # with one, MoveIt would send half the opening


def test_plans_are_no_faster_than_the_driver_moves(moveit):
    given = moveit["move_group"].parameters
    limits = {name: given[f"robot_description_planning.joint_limits.{name}.max_velocity"] for name in JOINTS}
    assert limits == dict.fromkeys(JOINTS, 0.01)  # half of gripper.default_speed


@pytest.mark.parametrize("processes", [control_processes, moveit_processes])
def test_an_emulated_gripper_stands_in(processes):
    if processes is control_processes:
        pytest.importorskip("xacro")
    parts = by_name(processes(StackOptions(sim=True), ROOT))
    assert isinstance(parts["emulated_gripper"], Process)
    _, link = parts["emulated_gripper"].arguments
    assert parts["gripper_driver"].parameters == {"port": link, "interface": "slcan"}
    assert "gripper_driver" not in by_name(processes(StackOptions(gripper=False), ROOT))


def test_a_description_without_xacro_needs_none(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "xacro", None)
    assert describe(ROOT / "urdf" / "finray_gripper.urdf").startswith("<?xml")
    with pytest.raises(MissingDependencyError, match="a description with xacro needs xacro"):
        describe(ROOT / "urdf" / "finray_gripper_control.urdf.xacro")


def test_messages_that_the_wheels_lack_come_from_apt(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "control_msgs", None)
    with pytest.raises(
        MissingDependencyError, match=r"^the action needs ROS 2 from apt with ros-jazzy-control-msgs \("
    ):
        import_library("control_msgs.action", "the action")


def test_nested_parameters_have_dots():
    assert flatten({"a": {"b": 1, "c": {"d": [2]}}, "e": 3}) == {"a.b": 1, "a.c.d": [2], "e": 3}
