"""Claims about the launch files; those that run them need ROS 2's launch."""

import runpy
import sys
from dataclasses import fields
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from finforce.errors import MissingDependencyError
from finforce.ros.composition import read_part
from finforce.systems import launch as launch_module
from finforce.systems.processes import BenchOptions, ReplayOptions, RobotOptions, StackOptions

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "launch").glob("*.launch.py"))
SYSTEMS = [path for path in FILES if path.name.split(".")[0] in ("bench", "replay", "robot")]
ROBOT = ROOT / "launch" / "robot.launch.py"
ACTIONS = ("DeclareLaunchArgument", "GroupAction", "IncludeLaunchDescription", "LogInfo", "OpaqueFunction")
STAND_INS = {
    "launch": (),
    "launch.actions": (*ACTIONS, "SetEnvironmentVariable", "Shutdown"),
    "launch.launch_description_sources": ("PythonLaunchDescriptionSource",),
    "launch.substitutions": ("LaunchConfiguration",),
    "launch_ros": (),
    "launch_ros.actions": ("Node",),
    "launch_ros.parameter_descriptions": (),
}


class Recorder:
    """Stands for a launch action and keeps what it was made of."""

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs


class Text(str):
    """Stands for a parameter's value whose type is beyond doubt."""

    def __new__(cls, value, value_type):
        return super().__new__(cls, value_type(value))


@pytest.fixture
def recorded_launch(monkeypatch):
    """Put stand-ins in the place of launch and launch_ros, which only a full ROS 2 has."""
    for name, members in STAND_INS.items():
        module = ModuleType(name)
        for member in members:
            setattr(module, member, type(member, (Recorder,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    sys.modules["launch"].LaunchDescription = list
    sys.modules["launch_ros.parameter_descriptions"].ParameterValue = Text
    monkeypatch.setattr(launch_module, "find_share", lambda package: Path("/share") / package)


def act(path, **texts):
    """Describe a launch file's system with arguments; its actions."""
    *arguments, opaque = runpy.run_path(str(path))["generate_launch_description"]()
    defaults = {action.args[0]: action.kwargs["default_value"] for action in arguments}
    values = {**defaults, **({"composed": "false"} if "composed" in defaults else {}), **texts}
    values = {name: values[text.args[0]] if isinstance(text, Recorder) else text for name, text in values.items()}
    return opaque.kwargs["function"](SimpleNamespace(launch_configurations=values))


def start(path, **texts):
    """Describe a launch file's system with arguments; the keyword arguments of its nodes, by name."""
    return {action.kwargs["name"]: action.kwargs for action in act(path, **texts) if "name" in action.kwargs}


@pytest.mark.parametrize("path", SYSTEMS, ids=lambda path: path.name)
def test_detector_and_solver_are_one_process_unless_it_is_said_otherwise(recorded_launch, path):
    arguments = runpy.run_path(str(path))["generate_launch_description"]()[:-1]
    assert {a.args[0]: a.kwargs["default_value"] for a in arguments}["composed"] == "true"
    apart = [action.kwargs["executable"] for action in act(path, images="true") if "executable" in action.kwargs]
    (pipeline, *others) = [a.kwargs for a in act(path, images="true", composed="true") if "executable" in a.kwargs]
    assert pipeline["executable"] == "finforce_pipeline" and pipeline["name"] is None  # which would be all nodes' name
    parts = [read_part(word) for word in pipeline["arguments"]]
    together = [part.executable for part in parts]
    assert together[0] == "keypoint_detector" and "ifea_solver" in together
    assert sorted([*together, *(other["executable"] for other in others)]) == sorted(apart)
    assert "__node:=left_ifea_solver" in parts[-2 if together.count("ifea_solver") == 2 else -1].words


@pytest.mark.parametrize("path", SYSTEMS, ids=lambda path: path.name)
def test_a_launch_file_starts_a_solver_with_its_configuration(recorded_launch, path):
    nodes = start(path)
    solver = nodes["left_ifea_solver"]
    configuration, parameters = solver["parameters"]
    assert Path(configuration).is_file()
    assert (solver["package"], solver["executable"]) == ("finforce", "ifea_solver")
    assert parameters["use_sim_time"] is (path.name == "replay.launch.py")


def test_an_argument_reaches_the_node_with_its_type(recorded_launch):
    (solver,) = start(ROOT / "launch" / "bench.launch.py", contact_height="0.04", jaw="right").values()
    assert solver["parameters"][1]["contact_height"] == 0.04
    assert "estimator.friction" not in solver["parameters"][1]
    assert solver["name"] == "right_ifea_solver"


def test_friction_of_the_object_is_an_argument(recorded_launch):
    (solver,) = start(ROOT / "launch" / "bench.launch.py", friction="0.3", friction_stddev="0.05").values()
    assert solver["parameters"][1]["estimator.friction"] == 0.3
    assert solver["parameters"][1]["estimator.friction_stddev"] == 0.05


def test_an_object_mesh_starts_the_contact_estimator(recorded_launch):
    nodes = start(ROOT / "launch" / "bench.launch.py", object_mesh="can.stl", contact="paper", jaw="right")
    estimator = nodes["contact_estimator"]
    assert (estimator["package"], estimator["executable"]) == ("finforce", "contact_estimator")
    assert estimator["parameters"][1]["object_mesh"] == "can.stl" and estimator["parameters"][1]["jaws"] == "right"


def test_images_start_the_detector_with_the_configuration(recorded_launch):
    nodes = start(ROOT / "launch" / "bench.launch.py", images="true", detection_method="dots", jaw="right")
    detector = nodes["keypoint_detector"]
    configuration, parameters = detector["parameters"]
    assert (detector["package"], detector["executable"]) == ("finforce", "keypoint_detector")
    assert Path(configuration).name == "bench.yaml"
    assert (parameters["jaws"], parameters["detection_method"]) == ("right", "dots")


def test_the_end_of_the_player_ends_the_launch(recorded_launch):
    nodes = start(ROOT / "launch" / "replay.launch.py", bag="somewhere", jaws="both")
    assert set(nodes) == {"left_ifea_solver", "right_ifea_solver", "recording_player"}
    well, bad, killed = (SimpleNamespace(returncode=status) for status in (0, 2, -9))
    assert all(nodes["recording_player"]["on_exit"](ended, None) for ended in (well, bad, killed))
    solver = nodes["left_ifea_solver"]
    assert [bool(solver["on_exit"](ended, None)) for ended in (well, bad, killed)] == [False, True, False]
    assert solver["respawn"] and not nodes["recording_player"]["respawn"]


def test_whatever_holds_something_is_not_started_again(recorded_launch):
    nodes = start(ROBOT, sim="true")
    respawned = {name for name, node in nodes.items() if node["respawn"]}
    assert not {"gripper_driver", "twin_camera"} & respawned and {"keypoint_detector", "right_ifea_solver"} < respawned


RECORDS = {"bench": BenchOptions, "replay": ReplayOptions, "robot": RobotOptions}
RECORDS |= dict.fromkeys(("ros2_control", "moveit"), StackOptions)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_declared_arguments_are_the_options_with_their_defaults(recorded_launch, path):
    *arguments, _ = runpy.run_path(str(path))["generate_launch_description"]()
    record = RECORDS[path.name.split(".")[0]]
    texts = {action.args[0]: action.kwargs["default_value"] for action in arguments}
    assert len(texts) == len(arguments)
    assert set(texts) == {entry.name for entry in fields(record)}
    options = launch_module.options_from_texts(record, texts)
    expected = record(parameter_file=options.parameter_file)
    assert repr(options) == repr(expected)  # nan is not nan
    assert "" not in texts.values()  # nobody can type it


def test_none_is_an_empty_value(recorded_launch):
    detector = start(ROBOT, camera="false", camera_name="none", detection_method="none")["keypoint_detector"]
    assert not {"camera_frame", "detection_method"} & set(detector["parameters"][1])
    with pytest.raises(ValueError, match="camera_name:=none: camera:=true needs a name"):
        act(ROBOT, camera_name="none")
    with pytest.raises(ValueError, match="dof:=none: expected a int"):
        act(ROBOT, dof="none")


def test_none_is_itself_where_it_is_one_of_the_choices(recorded_launch):
    for depth in ("none", "aligned"):
        assert start(ROBOT, camera="false", depth=depth)["keypoint_detector"]["parameters"][1]["depth"] == depth
    assert "depth" not in start(ROBOT, camera="false")["keypoint_detector"]["parameters"][1]
    entries = [entry for record in RECORDS.values() for entry in fields(record)]
    choices = [entry for entry in entries if launch_module.NONE in entry.metadata.get("choices", ())]
    assert choices and all(entry.default for entry in choices)  # an empty default could not be typed


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_argument_is_described(recorded_launch, path):
    *arguments, _ = runpy.run_path(str(path))["generate_launch_description"]()
    assert all(action.kwargs["description"] for action in arguments)


def group_of(actions):
    (group,) = [action for action in actions if type(action).__name__ == "GroupAction"]
    return group


def test_an_included_file_sees_its_own_arguments_only(recorded_launch):
    group = group_of(act(ROBOT, namespace="r1"))
    # an argument of ours, such as "gripper", means something else there
    assert group.kwargs == {"scoped": True, "forwarding": False}
    *_, included = group.args[0]
    assert included.args[0].args[0] == "/share/realsense2_camera/launch/rs_launch.py"
    assert dict(included.kwargs["launch_arguments"])["camera_namespace"] == "r1/camera"


def test_the_environment_of_an_included_file_is_set_in_its_scope(recorded_launch, monkeypatch):
    monkeypatch.setattr("os.environ", {"PATH": ""})
    variable, _ = group_of(act(ROBOT)).args[0]
    assert type(variable).__name__ == "SetEnvironmentVariable"
    assert variable.args[0] == "FASTRTPS_DEFAULT_PROFILES_FILE" and Path(variable.args[1]).is_file()


def lack(monkeypatch, *packages):
    monkeypatch.setattr(
        launch_module, "find_share", lambda package: None if package in packages else Path("/share") / package
    )


@pytest.mark.parametrize(
    ("texts", "package", "advice"),
    [
        ({}, "realsense2_camera", "ros-jazzy-realsense2-camera; or say camera:=false"),
        ({"camera": "false", "arm": "true"}, "kortex_bringup", "ros-jazzy-kortex-bringup; or leave arm:=true out"),
        ({"camera": "false", "rviz": "true"}, "rviz2", "ros-jazzy-rviz2; or leave rviz:=true out"),
    ],
)
def test_a_package_that_is_asked_for_and_missing_is_one_line_with_advice(
    recorded_launch, monkeypatch, texts, package, advice
):
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    lack(monkeypatch, package)
    with pytest.raises(MissingDependencyError) as caught:
        act(ROBOT, **texts)
    assert str(caught.value).startswith(f"{package} is not installed: sudo apt install {advice}")
    assert "\n" not in str(caught.value)


def test_without_xacro_the_arm_is_refused_before_it_starts(recorded_launch, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda program: None)
    with pytest.raises(MissingDependencyError, match="^xacro is not installed: sudo apt install ros-.*-xacro;"):
        act(ROBOT, camera="false", arm="true")


def test_without_publishers_of_frames_the_rest_starts(recorded_launch, monkeypatch):
    lack(monkeypatch, "robot_state_publisher", "tf2_ros")
    actions = act(ROBOT, sim="true")
    lines = [action.kwargs["msg"] for action in actions if type(action).__name__ == "LogInfo"]
    assert [line.split()[0] for line in lines] == ["robot_state_publisher", "tf2_ros"]
    nodes = {action.kwargs.get("name") for action in actions}
    assert {"left_ifea_solver", "gripper_driver", "twin_camera"} <= nodes


def test_the_model_of_the_gripper_reaches_its_publisher_as_text(recorded_launch):
    publisher = start(ROBOT, sim="true")["robot_state_publisher"]
    (parameters,) = publisher["parameters"]
    assert isinstance(parameters["robot_description"], Text)
    assert parameters["robot_description"].startswith("<?xml")


def test_a_simulated_robot_starts_twin_and_driver_with_the_simulations_configuration(recorded_launch):
    nodes = start(ROBOT, sim="true")
    for name in ("twin_camera", "gripper_driver", "keypoint_detector", "left_ifea_solver"):
        assert Path(nodes[name]["parameters"][0]).name == "robot_sim.yaml"
    assert nodes["twin_camera"]["parameters"][1]["scene"] == "grasp_cylinder"
    bench = start(ROOT / "launch" / "bench.launch.py", sim="true")
    assert bench["twin_camera"]["parameters"][1]["scene"] == "bench_cylinder"
