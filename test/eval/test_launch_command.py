"""Claims about `finforce launch`: the systems of the launch files, without `ros2`."""

import re
import sys
from dataclasses import dataclass

import pytest

from finforce import optional
from finforce.errors import MissingDependencyError
from finforce.optional import check_middleware
from finforce.systems.processes import executables_of
from finforce_eval.cli import demo, launch
from finforce_eval.cli.main import main
from finforce_eval.replay import process_group


@pytest.fixture(autouse=True)
def no_ros2(monkeypatch):
    """Only wheels, as after the recommended set-up."""
    monkeypatch.setattr(launch, "which", lambda program: None)
    monkeypatch.setattr(demo, "which", lambda program: None)


def test_the_simulated_robot_needs_nothing_but_the_wheels(capsys):
    processes = launch.startable(launch.list_parts("robot", ["sim:=true"]))
    assert {process.package for process in processes} == {"finforce"}
    stages = ["keypoint_detector", "contact_estimator", "ifea_solver", "ifea_solver"]
    assert sorted(executables_of(processes)) == sorted(["twin_camera", "gripper_driver", *stages])
    assert "robot_state_publisher is not installed" in capsys.readouterr().err
    assert all("/config/robot_sim.yaml" in str(process.command()) for process in processes)


@pytest.mark.parametrize(("words", "package"), [([], "realsense2_camera"), (["camera:=false", "rviz:=true"], "rviz2")])
def test_what_the_wheels_have_not_is_said(words, package):
    with pytest.raises(MissingDependencyError, match=f"^{package} .*; or "):
        launch.startable(launch.list_parts("robot", words))


def test_with_ros_from_apt_nodes_of_other_packages_are_started_too(monkeypatch):
    monkeypatch.setattr(launch, "which", lambda program: program)
    monkeypatch.setattr(launch, "find_share", lambda package: package)
    started = [process.command() for process in launch.startable(launch.list_parts("robot", ["sim:=true"]))]
    assert ["ros2", "run", "robot_state_publisher", "robot_state_publisher"] in [command[:4] for command in started]


@pytest.mark.parametrize(
    ("word", "reason"),
    [
        ("simm:=true", "'simm' is not an option: did you mean sim?"),
        ("sim", "'sim': expected sim:=VALUE"),
        ("contact_height:=40", "contact_height: got 40.0, expected 0 to 0.5 m; 40 mm are 0.04 m"),
        ("dof:=5", "expected one of 6, 7"),
    ],
)
def test_a_word_that_cannot_be_used_is_one_line(word, reason, capsys):
    assert main(["launch", "robot", word]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert reason in line


def test_the_home_folder_is_found_where_the_shell_leaves_it_and_names_of_topics_stay(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    words = ["sim:=true", "object_mesh:=~/can.stl", "pose_topic:=~/pose"]
    commands = str([process.command() for process in launch.startable(launch.list_parts("robot", words))])
    assert "/home/me/can.stl" in commands and "~/pose" in commands and "~/can.stl" not in commands


@pytest.mark.parametrize("words", [("launch", "robot", "sim:=true"), ("echo", "grasp_wrench")])
def test_a_middleware_that_is_not_installed_is_named_before_any_node_exits(words, monkeypatch, tmp_path, capsys):
    index = tmp_path / "share/ament_index/resource_index/rmw_typesupport"
    index.mkdir(parents=True)
    (index / "rmw_mine_cpp").touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_mine_cpp")
    check_middleware()
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_other_cpp")
    monkeypatch.setattr(process_group.ProcessGroup, "_start", lambda *_: pytest.fail("a node was started"))
    monkeypatch.setattr(optional, "import_library", lambda *_: pytest.fail("ROS 2 was loaded"))
    assert main(list(words)) == 2
    assert re.search(
        "RMW_IMPLEMENTATION=rmw_other_cpp is not installed, .*rmw_mine_cpp.*unset", capsys.readouterr().err
    )


def test_every_argument_is_listed_with_its_default(capsys):
    assert main(["launch", "replay", "--show-args"]) == 0
    assert "rate:=1.0\n    Speed of playing\n" in capsys.readouterr().out


@dataclass(frozen=True)
class Script:
    """A process that runs a line of Python."""

    code: str
    ends_all: bool = False
    label: str = "script"
    respawns: bool = False

    def command(self):
        return [sys.executable, "-c", self.code]


def launch_scripts(monkeypatch, *scripts):
    monkeypatch.setattr(launch, "startable", lambda parts: scripts)
    return main(["launch", "replay"])


WAIT = "import time; time.sleep(60)"


def test_the_end_of_the_player_ends_all(monkeypatch):
    assert launch_scripts(monkeypatch, Script(WAIT), Script("", ends_all=True)) == 0


def test_a_process_whose_settings_cannot_be_used_ends_all_and_is_named(monkeypatch, capsys):
    assert launch_scripts(monkeypatch, Script(WAIT), Script("raise SystemExit(2)", label="solver")) == 2
    assert capsys.readouterr().err == "finforce: solver ended with status 2\n"


def test_a_node_that_dies_is_started_again_and_a_driver_is_not(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(process_group, "RESPAWN_DELAY", 0.0)
    code = "import pathlib; file = pathlib.Path({!r}); file.open('a').write('x'); raise SystemExit({})"
    solver, driver = tmp_path / "solver", tmp_path / "driver"
    wait = f"import pathlib, time\nwhile not pathlib.Path({str(solver)!r}).exists() or "
    wait += f"pathlib.Path({str(solver)!r}).stat().st_size < 3: time.sleep(0.05)"
    scripts = (
        Script(code.format(str(driver), 1), label="gripper_driver"),
        Script(code.format(str(solver), -9), label="solver", respawns=True),
        Script(wait, ends_all=True),
    )
    assert launch_scripts(monkeypatch, *scripts) == 0
    assert driver.read_text() == "x" and len(solver.read_text()) >= 3
    said = capsys.readouterr().err
    assert said.count("gripper_driver ended with status 1: the others go on") == 1
    assert "solver ended with status" in said and "it is started again" in said


def test_the_demo_ends_with_the_command_that_comes_next(monkeypatch):
    assert demo.next_command().endswith("finforce launch robot sim:=true")
    monkeypatch.setattr(demo, "which", lambda program: program)
    monkeypatch.setattr(demo, "find_share", lambda package: package)
    assert demo.next_command() == "ros2 launch finforce robot.launch.py sim:=true"
