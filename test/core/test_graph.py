"""Claims about the description of the processes, and about the launch files that are made from it."""

import ast
import math
import re
from dataclasses import fields
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from finforce.errors import PoseError
from finforce.gripper_frames import BENCH_CAMERA
from finforce.settings import TimeParameters, is_parameter
from finforce.systems.launch import options_from_texts
from finforce.systems.processes import BenchOptions, Process, ReplayOptions, RobotOptions, replay_processes
from finforce.systems.setups import bench_processes
from finforce_contact.parameters import ContactParameters, ContactSettings
from finforce_driver.node import LINKS
from finforce_driver.settings import DriverParameters, GraspSettings, GripperSettings, JointSettings
from finforce_eval.replay.node import PlayerParameters
from finforce_ifea.parameters import NodeParameters
from finforce_ifea.settings import EstimatorSettings
from finforce_keypoints.detectors.dots import DotSettings
from finforce_keypoints.parameters import DetectorParameters, DetectorSettings
from finforce_sim.node import TwinParameters

ROOT = Path(__file__).resolve().parents[2]
SOLVER_PARAMETERS = {entry.name for entry in fields(NodeParameters)}
SOLVER_PARAMETERS |= {f"estimator.{entry.name}" for entry in fields(EstimatorSettings) if is_parameter(entry)} | {
    "use_sim_time"
}
CONTACT_PARAMETERS = {entry.name for entry in fields(ContactParameters)} | {"use_sim_time"}
CONTACT_PARAMETERS |= {f"contact.{entry.name}" for entry in fields(ContactSettings)}
DETECTOR_PARAMETERS = {entry.name for entry in fields(DetectorParameters)} | {"use_sim_time"}
PLAYER_PARAMETERS = {entry.name for entry in fields(PlayerParameters)}


def by_name(processes):
    return {process.name: process for process in processes}


def test_one_jaw_completes_the_grasp_by_itself():
    (solver,) = bench_processes(BenchOptions(composed=False, jaw="right", contact_height=0.04), ROOT)
    assert solver.name == "right_ifea_solver"
    assert solver.parameters["jaw_name"] == "right"
    assert solver.parameters["completes_grasp"] is True
    assert solver.parameters["contact_height"] == 0.04


def test_of_two_jaws_exactly_one_completes_the_grasp():
    solvers = by_name(replay_processes(ReplayOptions(composed=False, jaws="both"), ROOT))
    assert solvers["left_ifea_solver"].parameters["peer"] == "right"
    assert "peer" not in solvers["right_ifea_solver"].parameters
    assert solvers["right_ifea_solver"].parameters["paired"] is True
    assert not any("completes_grasp" in solver.parameters for solver in solvers.values())


def test_the_player_runs_only_with_a_bag_and_its_end_ends_all():
    assert len(replay_processes(ReplayOptions(composed=False), ROOT)) == 1
    player = by_name(replay_processes(ReplayOptions(composed=False, bag="x", rate=2.0), ROOT))["recording_player"]
    assert player.parameters == {"bag": "x", "rate": 2.0} and player.ends_all
    waiting = by_name(replay_processes(ReplayOptions(composed=False, bag="x", object_mesh="can.stl"), ROOT))[
        "recording_player"
    ]
    assert waiting.parameters["awaits_poses"] is True
    assert "awaits_images" not in waiting.parameters
    seeing = by_name(replay_processes(ReplayOptions(composed=False, bag="x", images=True), ROOT))["recording_player"]
    assert seeing.parameters["awaits_images"] is True


def test_what_was_not_asked_for_stays_the_nodes_own():
    (solver,) = replay_processes(ReplayOptions(composed=False), ROOT)
    assert set(solver.parameters) == {"jaw_name", "completes_grasp", "use_sim_time"}


def test_every_parameter_of_the_graph_is_one_of_the_node():
    given = {
        "jaw_file": "a",
        "calibration_file": "b",
        "contact_height": 0.1,
        "solver": "frame",
        "object_mesh": "c",
        "object_mesh_unit": "mm",
        "pose_source": "tracker",
        "images": True,
        "detection_method": "frame",
        "model": "d",
        "depth": "auto",
        "T_gripper_camera": "0 0 0.1, 0 0 0 1",
    }
    known = {
        "ifea_solver": SOLVER_PARAMETERS,
        "contact_estimator": CONTACT_PARAMETERS,
        "keypoint_detector": DETECTOR_PARAMETERS,
        "finforce_recording_player": PLAYER_PARAMETERS,
    }
    processes = replay_processes(ReplayOptions(composed=False, jaws="both", bag="x", **given), ROOT)
    assert {process.executable for process in processes} == set(known)
    for process in processes:
        assert set(process.parameters) <= known[process.executable]


@pytest.mark.parametrize(("asked", "told"), [("", ""), ("aligned", "aligned"), ("auto", ""), ("none", "none")])
def test_depth_is_asked_of_the_detector_in_its_own_words_and_its_default_left_to_it(asked, told):
    (detector,) = [
        process
        for process in replay_processes(ReplayOptions(composed=False, images=True, depth=asked, bag="x"), ROOT)
        if process.executable == "keypoint_detector"
    ]
    assert detector.parameters.get("depth", "") == told


def test_an_object_mesh_brings_one_contact_estimator_and_its_contacts_go_to_the_solvers():
    options = ReplayOptions(composed=False, jaws="both", object_mesh="can.stl", contact_height=0.04)
    processes = by_name(replay_processes(options, ROOT))
    estimator = processes["contact_estimator"]
    assert estimator.executable == "contact_estimator" and estimator.parameters["jaws"] == "both"
    assert estimator.parameters["object_mesh"] == "can.stl"
    assert "recording_player" not in processes
    # NaN overrules the height of a parameter file, too
    assert all(math.isnan(processes[f"{side}_ifea_solver"].parameters["contact_height"]) for side in ("left", "right"))


def test_without_an_object_mesh_no_contact_is_estimated():
    processes = bench_processes(BenchOptions(composed=False, contact_height=0.04), ROOT)
    assert [process.executable for process in processes] == ["ifea_solver"]


@pytest.mark.parametrize(("solver", "seen"), [("paper", "coarse"), ("", None)])
def test_solver_and_contact_estimator_have_the_same_mesh_of_the_jaw(solver, seen):
    options = BenchOptions(composed=False, object_mesh="can.stl", solver=solver, jaw_file="j", calibration_file="k")
    _, estimator = bench_processes(options, ROOT)
    assert estimator.parameters.get("contact.mesh") == seen
    assert (estimator.parameters["jaw_file"], estimator.parameters["calibration_file"]) == ("j", "k")


def test_images_start_one_detector_for_all_jaws():
    options = ReplayOptions(
        composed=False,
        jaws="both",
        images=True,
        detection_method="dots",
        jaw_file="j",
        T_gripper_camera="0 0 0.1 0 0 0 1",
    )
    detector = by_name(replay_processes(options, ROOT))["keypoint_detector"]
    assert detector.parameters["jaws"] == "both" and detector.parameters["use_sim_time"] is True
    assert detector.parameters["detection_method"] == "dots" and detector.parameters["jaw_file"] == "j"
    assert detector.parameters["T_gripper_camera"] == [0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]
    assert "keypoint_detector" in by_name(bench_processes(BenchOptions(composed=False, images=True), ROOT))


def test_without_images_key_points_come_by_topic():
    processes = replay_processes(ReplayOptions(composed=False, jaws="both", detection_method="dots", model="m"), ROOT)
    assert "keypoint_detector" not in by_name(processes)


@pytest.mark.parametrize("text", ["bench", "0 0 0", "0 0 0 0 0 0 x"])
def test_a_camera_pose_that_is_not_seven_numbers_is_named(text):
    with pytest.raises(ValueError, match="T_gripper_camera.*7 numbers"):
        bench_processes(BenchOptions(composed=False, images=True, T_gripper_camera=text), ROOT)


@pytest.mark.parametrize("name", ["bench", "bench_sim"])
def test_the_bench_configuration_has_the_camera_of_the_bench(name):
    bench = yaml.safe_load((ROOT / "config" / f"{name}.yaml").read_text(encoding="utf-8"))
    numbers = tuple(bench["/**/keypoint_detector"]["ros__parameters"]["T_gripper_camera"])
    # 1e-7: of the printed digits
    np.testing.assert_allclose(DetectorParameters(T_gripper_camera=numbers).camera_pose, BENCH_CAMERA, atol=1e-7)


def test_a_camera_pose_that_is_a_matrix_is_refused_with_what_is_expected():
    with pytest.raises(PoseError, match=r"expected \(3,\) and \(4,\) as x, y, z, w"):
        DetectorParameters(T_gripper_camera=np.eye(4)).camera_pose  # noqa: B018


def test_rviz_is_started_with_a_configuration_that_is_there():
    viewer = by_name(bench_processes(BenchOptions(composed=False, rviz=True), ROOT))["rviz"]
    assert Path(viewer.arguments[1]).is_file()


def test_a_command_line_carries_values_with_their_types():
    parameters = {"jaw_file": "1e3", "max_age": 0.5, "completes_grasp": True, "peer": "", "places": [1.0, 2.0]}
    words = Process(executable="e", name="n", parameters=parameters, remappings={"left/keypoints": "k"}).command()
    given = dict(word.split(":=") for word in words if ":=" in word)
    assert {name: yaml.safe_load(given[name]) for name in parameters} == parameters
    assert given["__node"] == "n" and given["left/keypoints"] == "k"
    assert words[1:4] == ["-m", "finforce.ros.start", "e"]


def test_a_command_line_says_nan_as_yaml_does():
    words = Process(executable="e", name="n", parameters={"contact_height": math.nan}).command()
    assert math.isnan(yaml.safe_load(words[-1].split(":=")[1]))


def test_launch_arguments_become_options():
    texts = {entry.name: str(entry.default) for entry in fields(ReplayOptions)}
    options = options_from_texts(ReplayOptions, texts)
    assert math.isnan(options.contact_height) and options.use_sim_time is True
    texts |= {"contact_height": "0.04", "use_sim_time": "false", "jaws": "both"}
    options = options_from_texts(ReplayOptions, texts)
    assert (options.contact_height, options.use_sim_time, options.jaws) == (0.04, False, "both")


@pytest.mark.parametrize(("name", "text"), [("contact_height", "forty"), ("rviz", "yes"), ("rate", "")])
def test_a_launch_argument_that_means_nothing_is_named(name, text):
    texts = {entry.name: str(entry.default) for entry in fields(ReplayOptions)} | {name: text}
    with pytest.raises(ValueError, match=name):
        options_from_texts(ReplayOptions, texts)


def defaults_of(record, prefix=""):
    return {prefix + entry.name: entry.default for entry in fields(record)}


SOLVER = defaults_of(NodeParameters) | defaults_of(EstimatorSettings, "estimator.")
PARAMETERS = {
    "left_ifea_solver": SOLVER,
    "right_ifea_solver": SOLVER,
    "contact_estimator": defaults_of(ContactParameters) | defaults_of(ContactSettings, "contact."),
    "keypoint_detector": defaults_of(DetectorParameters) | defaults_of(DetectorSettings, "detector."),
    "gripper_driver": defaults_of(DriverParameters)
    | defaults_of(GripperSettings, "gripper.")
    | defaults_of(GraspSettings, "grasp.")
    | defaults_of(JointSettings, "joint."),
    "twin_camera": defaults_of(TwinParameters),
    "/**": defaults_of(TimeParameters),
}
NODE_FILES = [path for path in sorted((ROOT / "config").glob("*.yaml")) if path.name != "d405.yaml"]
GRIPPER_FILES = sorted((ROOT / "config" / "grippers").glob("*.yaml"))


@pytest.mark.parametrize("path", NODE_FILES, ids=lambda path: path.name)
def test_every_key_of_a_configuration_is_a_parameter_and_differs_from_its_default(path):
    for node, section in yaml.safe_load(path.read_text(encoding="utf-8")).items():
        defaults = PARAMETERS[node if node == "/**" else node.removeprefix("/**/")]
        for name, value in section["ros__parameters"].items():
            value = tuple(value) if isinstance(value, list) else value
            assert name in defaults
            assert value != defaults[name]
            assert type(value) is type(defaults[name])


@pytest.mark.parametrize("path", GRIPPER_FILES, ids=lambda path: path.name)
def test_what_says_how_another_gripper_is_can_be_set_on_the_driver(path):
    ((node, section),) = yaml.safe_load(path.read_text(encoding="utf-8")).items()
    for name, value in section["ros__parameters"].items():
        value = tuple(value) if isinstance(value, list) else value
        assert type(value) is type(PARAMETERS[node][name])
    given = section["ros__parameters"]
    joint = {name.removeprefix("joint."): value for name, value in given.items() if name.startswith("joint.")}
    settings = JointSettings(**joint | {"names": tuple(joint["names"])})
    assert given["interface"] in LINKS and 0.0 < settings.resolution < 0.01 * given["gripper.stroke"]
    GraspSettings(reaction=given["grasp.reaction"])


@pytest.mark.parametrize("path", NODE_FILES, ids=lambda path: path.name)
def test_a_configuration_has_no_aliases_which_ros_cannot_read(path):
    tokens = yaml.scan(path.read_text(encoding="utf-8"))
    assert not any(isinstance(token, yaml.tokens.AliasToken) for token in tokens)


@pytest.mark.parametrize("path", sorted((ROOT / "config").glob("*.yaml")), ids=lambda path: path.name)
def test_every_value_of_a_configuration_has_its_unit_or_reason_beside_it(path):
    lines = path.read_text(encoding="utf-8").splitlines()
    values = [number for number, line in enumerate(lines) if re.match(r"\s*[\w.]+: *[^\s#]", line)]
    assert values
    # a repeated value has the comment of the first, and a long one that of the line above
    known = {lines[number].split("#")[0].strip() for number in values if "#" in lines[number]}
    assert all(lines[n].split("#")[0].strip() in known or "#" in lines[n - 1] for n in values)


@cache
def attributes(place):
    """The names of all attributes in a file, or in the files of a folder."""
    paths = [place] if place.is_file() else place.rglob("*.py")
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in paths]
    return {node.attr for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute)}


@pytest.mark.parametrize(
    ("record", "folder"),
    [
        (NodeParameters, "finforce_ifea"),
        (PlayerParameters, "finforce_eval"),
        (ContactParameters, "finforce_contact"),
        (ContactSettings, "finforce_contact"),
        (DetectorParameters, "finforce_keypoints"),
        (DetectorSettings, "finforce_keypoints"),
        (DotSettings, "finforce_keypoints"),
        (ReplayOptions, "finforce"),
        (BenchOptions, "finforce"),
        (RobotOptions, "finforce"),
    ],
)
def test_every_field_is_read(record, folder):
    read = attributes(ROOT / folder) | attributes(ROOT / "finforce" / "settings.py")
    assert {entry.name for entry in fields(record)} <= read


@pytest.mark.parametrize(("name", "frame"), [("finforce", "left_jaw"), ("robot", "gripper_base")])
def test_the_rviz_configuration_shows_our_topics_in_the_setups_frame(name, frame):
    manager = yaml.safe_load((ROOT / "rviz" / f"{name}.rviz").read_text(encoding="utf-8"))["Visualization Manager"]
    topics = {display["Topic"]["Value"] for display in manager["Displays"] if "Topic" in display}
    assert {"/left/markers", "/left/keypoints", "/left/object_outline", "/right/markers"} <= topics
    assert manager["Global Options"]["Fixed Frame"] == frame
