"""Claims about the launch files; those that run them need ROS 2's launch."""

import runpy
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted((ROOT / "launch").glob("*.launch.py"))


class Recorder:
    """Stands for a launch action and keeps what it was made of."""

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs


@pytest.fixture
def recorded_launch(monkeypatch):
    """Put stand-ins in the place of launch and launch_ros, which only a full ROS 2 has."""
    names = ("launch", "launch.actions", "launch_ros", "launch_ros.actions")
    modules = {name: ModuleType(name) for name in names}
    modules["launch"].LaunchDescription = list
    for name in ("DeclareLaunchArgument", "OpaqueFunction", "Shutdown"):
        setattr(modules["launch.actions"], name, type(name, (Recorder,), {}))
    modules["launch_ros.actions"].Node = type("Node", (Recorder,), {})
    for name, module in modules.items():
        monkeypatch.setitem(__import__("sys").modules, name, module)


def start(path, **texts):
    """Describe a launch file's system with arguments; the keyword arguments of its nodes, by name."""
    *arguments, opaque = runpy.run_path(str(path))["generate_launch_description"]()
    values = {action.args[0]: action.kwargs["default_value"] for action in arguments} | texts
    actions = opaque.kwargs["function"](SimpleNamespace(launch_configurations=values))
    return {action.kwargs["name"]: action.kwargs for action in actions}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
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
    assert solver["name"] == "right_ifea_solver"


def test_an_object_mesh_starts_the_contact_estimator(recorded_launch):
    nodes = start(ROOT / "launch" / "bench.launch.py", object_mesh="can.stl", contact="paper", jaw="right")
    estimator = nodes["contact_estimator"]
    assert (estimator["package"], estimator["executable"]) == ("finforce", "contact_estimator")
    assert estimator["parameters"][1]["object_mesh"] == "can.stl" and estimator["parameters"][1]["jaws"] == "right"


def test_images_start_the_detector_with_the_configuration(recorded_launch):
    nodes = start(ROOT / "launch" / "bench.launch.py", images="true", finder="dots", jaw="right")
    detector = nodes["keypoint_detector"]
    configuration, parameters = detector["parameters"]
    assert (detector["package"], detector["executable"]) == ("finforce", "keypoint_detector")
    assert Path(configuration).name == "bench.yaml"
    assert (parameters["jaws"], parameters["finder"]) == ("right", "dots")


def test_the_end_of_the_player_ends_the_launch(recorded_launch):
    nodes = start(ROOT / "launch" / "replay.launch.py", bag="somewhere", jaws="both")
    assert set(nodes) == {"left_ifea_solver", "right_ifea_solver", "recording_player"}
    assert nodes["recording_player"]["on_exit"] is not None
    assert nodes["left_ifea_solver"]["on_exit"] is None


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_argument_is_described(recorded_launch, path):
    *arguments, _ = runpy.run_path(str(path))["generate_launch_description"]()
    assert all(action.kwargs["description"] for action in arguments)
