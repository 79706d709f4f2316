"""Claims about the processes of bench and robot, with hardware and without."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from keypoint_node_fakes import FakeDetector
from node_fakes import FakeEstimator
from rclpy.parameter import Parameter

from finforce.errors import RigError
from finforce.gripper_frames import ROBOT_CAMERA
from finforce.rig import Rig, RigCamera, RigJaw, write_rig
from finforce.ros.transport import CHOICES, PROFILES, TRANSPORT, free_domain
from finforce.systems.processes import (
    BenchOptions,
    Include,
    Process,
    ReplayOptions,
    RobotOptions,
    replay_processes,
)
from finforce.systems.setups import (
    SIM_OBJECT,
    bench_processes,
    camera_pose,
    robot_processes,
)
from finforce_contact.mesh.object_mesh import load_object_mesh
from finforce_contact.node import ContactEstimatorNode
from finforce_contact.parameters import ContactParameters
from finforce_driver.settings import DriverParameters
from finforce_eval.cli.pipeline import pipeline_process
from finforce_ifea.node import IfeaSolverNode
from finforce_keypoints.node import KeypointDetectorNode
from finforce_keypoints.parameters import DetectorParameters
from finforce_sim.node import TwinParameters

ROOT = Path(__file__).resolve().parents[2]
NODES = {
    "gripper_driver": DriverParameters,
    "twin_camera": TwinParameters,
    "contact_estimator": ContactParameters,
    "keypoint_detector": DetectorParameters,
}
HAND_EYE = "0.01 0.09 -0.04 0 0 0 1"


def by_name(parts):
    return {part.package if isinstance(part, Include) else part.name: part for part in parts}


def robot(**options):
    return by_name(robot_processes(RobotOptions(composed=False, **options), ROOT))


def test_a_robot_has_two_solvers_detector_contacts_gripper_camera_and_frames():
    parts = robot()
    assert list(parts) == [
        "realsense2_camera",
        "left_ifea_solver",
        "right_ifea_solver",
        "contact_estimator",
        "keypoint_detector",
        "gripper_driver",
        "robot_state_publisher",
        "static_transform_publisher",
    ]
    assert parts["left_ifea_solver"].parameters["peer"] == "right"
    assert all(parts[name].parameters["jaws"] == "both" for name in ("contact_estimator", "keypoint_detector"))


def test_what_was_not_asked_for_is_not_started():
    parts = robot(gripper=False, camera=False, images=False, contact_height=0.04)
    assert set(parts) == {"left_ifea_solver", "right_ifea_solver", "robot_state_publisher"}


@pytest.mark.parametrize("options", [{}, {"sim": True}, {"camera_name": "", "camera": False}])
def test_every_parameter_of_a_setup_is_one_of_its_node(options):
    parts = robot(gripper_port="/dev/x", gripper_interface="slcan", **options)
    for name in NODES.keys() & parts.keys():
        known = {entry.name for entry in fields(NODES[name])} | {"use_sim_time"}
        assert {key for key in parts[name].parameters if not key.startswith("contact.")} <= known


def test_the_gripper_has_the_port_that_was_asked_for():
    assert robot(gripper_port="/dev/ttyUSB1")["gripper_driver"].parameters["port"] == "/dev/ttyUSB1"
    assert "port" not in robot()["gripper_driver"].parameters
    can = robot(gripper_port="can0", gripper_interface="socketcan")["gripper_driver"].parameters
    assert (can["port"], can["interface"]) == ("can0", "socketcan")


def test_detector_and_contacts_read_the_camera_that_is_started():
    parts = robot(camera_name="hand")
    assert parts["realsense2_camera"].arguments["camera_name"] == "hand"
    detector, contacts = (parts[name].parameters for name in ("keypoint_detector", "contact_estimator"))
    assert detector["color_topics"] == ["camera/hand/color/image_raw", "camera/hand/color/image_rect_raw"]
    assert detector["info_topic"] == "camera/hand/color/camera_info"
    depth = "camera/hand/aligned_depth_to_color/image_raw"
    assert detector["depth_topic"] == contacts["depth_topic"] == depth


def test_poses_of_another_program_come_from_its_topic_beside_those_of_the_camera():
    asked = {"object_mesh": "c.stl", "pose_source": "detections"}
    contacts = robot(camera_name="hand", pose_topic="/pose_estimation/output", **asked)["contact_estimator"]
    assert contacts.remappings["object_detections"] == contacts.remappings["object_pose"] == "/pose_estimation/output"
    assert contacts.parameters["info_topic"] == "camera/hand/color/camera_info"
    assert contacts.parameters["pose_source"] == "detections"
    assert "object_pose" not in robot(**asked)["contact_estimator"].remappings


def test_a_camera_without_a_name_leaves_topics_and_frame_to_the_parameter_file():
    parts = robot(camera_name="", camera=False)
    assert "camera_frame" not in parts["keypoint_detector"].parameters
    assert not parts["contact_estimator"].remappings
    with pytest.raises(ValueError, match="camera_name"):
        robot(camera_name="")


def test_the_cameras_frames_are_not_those_of_the_arms_own_camera():
    names = {"camera_link", "camera_depth_frame", "camera_color_frame"}  # of kortex_description with vision
    frame = robot(sim=True)["twin_camera"].parameters["camera_frame"]
    assert not any(frame.startswith(name.removesuffix("link")) for name in names)


def test_two_robots_in_one_domain_share_neither_topics_nor_frames():
    parts = robot(sim=True, namespace="r1", frame_prefix="r1/")
    ours = [part for part in parts.values() if part.package == "finforce"]
    assert {part.namespace for part in parts.values()} == {"r1"}
    assert all(part.words[2:4] == ["-r", "__ns:=/r1"] for part in ours)
    nodes = [part for part in ours if part.executable != "twin_camera"]
    assert {part.parameters["frame_prefix"] for part in nodes} == {"r1/"}
    color = "camera/wrist_camera/color/image_raw"  # relative: in the namespace of each
    assert parts["keypoint_detector"].parameters["color_topics"][0] == color
    twin = parts["twin_camera"]
    assert twin.remappings["camera/camera/color/image_raw"] == color
    assert twin.parameters["camera_frame"] == "r1/wrist_camera_color_optical_frame"
    assert parts["robot_state_publisher"].parameters["frame_prefix"] == "r1/"
    assert {"r1/gripper_base", twin.parameters["camera_frame"]} < set(parts["static_transform_publisher"].arguments)
    camera = robot(namespace="r1", frame_prefix="r1/")["realsense2_camera"].arguments
    assert (camera["camera_namespace"], camera["tf_prefix"]) == ("r1/camera", "r1/")


@pytest.mark.parametrize("processes", [bench_processes, robot_processes, replay_processes])
def test_no_system_names_a_camera_topic_outside_of_its_namespace(processes):
    record = {bench_processes: BenchOptions, robot_processes: RobotOptions, replay_processes: ReplayOptions}[processes]
    parts = processes(record(composed=False, images=True, object_mesh="can.stl", namespace="r2"), ROOT)
    words = [word for part in parts if isinstance(part, Process) for word in part.command()]
    assert not [word for word in words if ":=" in word and '"/camera' in word or ":=/camera" in word]
    for kind in (DetectorParameters, ContactParameters):
        topics = [entry.default for entry in fields(kind) if entry.metadata.get("topic")]
        assert topics and "'/" not in repr(topics)


COMMON = {"/tf", "/tf_static", "/diagnostics", "/parameter_events", "/rosout", "/clock"}


def test_every_topic_of_a_robot_in_a_namespace_is_in_it(probe):
    options = {"context": probe.context, "namespace": "r2"}
    peer = [Parameter("peer", value="right")]
    nodes = [
        IfeaSolverNode(lambda *_: FakeEstimator(), parameter_overrides=peer, **options),
        ContactEstimatorNode(parameter_overrides=[Parameter("jaws", value="both")], **options),
        KeypointDetectorNode(
            lambda jaws, *_, **__: FakeDetector(tuple(jaws)),
            parameter_overrides=[Parameter("skip_off", value=["all"])],
            **options,
        ),
    ]
    ends = {end.topic_name for node in nodes for end in (*node.subscriptions, *node.publishers)} - COMMON
    services = {node.resolve_service_name(service.srv_name) for node in nodes for service in node.services}
    for node in nodes:
        node.destroy_node()
    assert len(ends) > 20 and services
    assert not [name for name in ends | services if not name.startswith("/r2/")]


def test_every_stage_of_a_pipeline_in_a_namespace_is_told_so():
    process = pipeline_process(["namespace:=r2", "frame_prefix:=r2/", "object_mesh:=can.stl", "gripper:=true"])
    parts = [json.loads(part) for part in process.arguments]
    assert [part[0] for part in parts].count("ifea_solver") == 2 and len(parts) == 5
    for part in parts:
        assert {"__ns:=/r2", 'frame_prefix:="r2/"'} <= set(part)
        assert not [word for word in part if ":=/" in word and not word.startswith("__ns")]


def test_the_camera_gets_the_transport_of_our_nodes_unless_somebody_chose_one(monkeypatch):
    for name in CHOICES:
        monkeypatch.delenv(name, raising=False)
    assert robot()["realsense2_camera"].environment == {PROFILES: str(TRANSPORT)}
    monkeypatch.setenv(CHOICES[2], "UDPv4")
    assert not robot()["realsense2_camera"].environment


def test_the_camera_is_a_d405_whose_images_belong_together():
    (file,) = {robot()["realsense2_camera"].arguments["config_file"]}
    told = yaml.safe_load(Path(file).read_text(encoding="utf-8"))
    assert told["depth_module.color_profile"] == told["depth_module.depth_profile"]
    assert told["enable_sync"] is told["align_depth.enable"] is True
    # the launch file takes names of parameters, no sections of nodes
    assert not any(isinstance(value, dict) for value in told.values())
    assert told["publish_tf"] is False


def test_the_published_camera_is_where_the_detector_is_told_that_it_is(tmp_path):
    words = robot(T_gripper_camera=HAND_EYE)["static_transform_publisher"].arguments
    told = dict(zip(words[::2], words[1::2], strict=True))
    assert [told[f"--{axis}"] for axis in "xyz"] == ["0.01", "0.09", "-0.04"]
    assert (told["--qx"], told["--qw"]) == ("0.0", "1.0")
    assert (told["--frame-id"], told["--child-frame-id"]) == ("gripper_base", "wrist_camera_color_optical_frame")
    file = tmp_path / "lab.yaml"
    file.write_text("keypoint_detector: {ros__parameters: {T_gripper_camera: [0, 0, 0.5, 0, 0, 0, 1]}}")
    options = RobotOptions(composed=False, parameter_file=str(file))
    assert camera_pose(options)[2] == 0.5
    assert camera_pose(replace(options, T_gripper_camera=HAND_EYE))[2] == -0.04
    default = DetectorParameters(
        T_gripper_camera=tuple(camera_pose(RobotOptions(composed=False, parameter_file=options_file())))
    )
    np.testing.assert_allclose(default.camera_pose, ROBOT_CAMERA, atol=1e-12)


def test_a_rig_says_jaws_mounts_and_camera(tmp_path):
    camera = RigCamera(width=640, height=480, fx=430.0, fy=430.0, cx=320.0, cy=240.0, model="plumb_bob")
    left = RigJaw(turn=(0.0, 0.01, 0.0), stddev=(1e-3, 0.01))
    rig = tmp_path / "rig.yaml"
    write_rig(Rig(jaw="umi", camera=camera, T_gripper_camera=(0.0, 0.1, -0.03, 0.0, 0.0, 0.0, 1.0), left=left), rig)
    parts = robot(rig=str(rig))
    assert {parts[name].parameters["jaw_file"] for name in ("keypoint_detector", "left_ifea_solver")} == {"umi"}
    detector = parts["keypoint_detector"].parameters
    assert detector["left_turn"] == [0.0, 0.01, 0.0] and detector["left_stddev"] == [1e-3, 0.01]
    assert detector["T_gripper_camera"][1] == 0.1 and "0.1" in parts["static_transform_publisher"].arguments
    assert robot(rig=str(rig), T_gripper_camera=HAND_EYE)["keypoint_detector"].parameters["T_gripper_camera"][1] == 0.09
    with pytest.raises(RigError, match="rig.yaml is of the jaws 'umi'"):
        robot(rig=str(rig), jaw_file="bench")
    played = by_name(replay_processes(ReplayOptions(composed=False, rig=str(rig), images=True), ROOT))
    assert played["left_ifea_solver"].parameters["jaw_file"] == "umi"


def options_file():
    return str(ROOT / "config" / "robot.yaml")


def test_the_camera_of_somebody_else_publishes_its_own_frames():
    assert "static_transform_publisher" not in robot(camera=False)


@pytest.mark.parametrize(
    ("options", "frame"), [({}, None), ({"arm": True}, "world"), ({"gravity_frame": "map"}, "map")]
)
def test_solvers_follow_the_posture_of_an_arm_that_is_there(options, frame):
    parts = robot(**options)
    for side in ("left", "right"):
        assert parts[f"{side}_ifea_solver"].parameters.get("gravity_frame") == frame


def test_the_arm_comes_with_our_description_and_its_own_frames():
    parts = robot(arm=True, robot_ip="10.0.0.2", dof=6)
    told = parts["kortex_bringup"].arguments
    assert (told["robot_ip"], told["dof"], told["gripper"], told["use_fake_hardware"]) == ("10.0.0.2", "6", "", "false")
    assert Path(told["description_file"]).is_absolute() and Path(told["description_file"]).is_file()
    # kortex_description stays the package, since controllers are looked for there, too
    assert "description_package" not in told
    assert "robot_state_publisher" not in parts


def test_without_hardware_no_camera_and_no_arm_are_touched():
    parts = robot(sim=True, arm=True)
    assert "realsense2_camera" not in parts
    assert parts["kortex_bringup"].arguments["use_fake_hardware"] == "true"


@pytest.mark.parametrize(
    "build", [robot, lambda **options: by_name(bench_processes(BenchOptions(composed=False, **options), ROOT))]
)
def test_without_hardware_the_driver_opens_the_port_that_the_twin_makes(build):
    parts = build(sim=True)
    twin = parts["twin_camera"].parameters
    driver = parts["gripper_driver"].parameters
    assert driver["port"] == twin["gripper_link"] != "" and driver["interface"] == "slcan"
    assert build(sim=True, gripper_port="/tmp/p")["twin_camera"].parameters["gripper_link"] == "/tmp/p"


@pytest.mark.parametrize(
    "build", [robot, lambda **options: by_name(bench_processes(BenchOptions(composed=False, **options), ROOT))]
)
def test_without_hardware_the_twins_object_is_the_one_whose_contact_is_estimated(build):
    parts = build(sim=True)
    assert parts["twin_camera"].parameters["object"] == parts["contact_estimator"].parameters["object_mesh"]
    assert parts["contact_estimator"].parameters["calibration_file"] == "twin"
    other = build(sim=True, object_mesh="can.stl", calibration_file="c")
    assert other["twin_camera"].parameters["object"] == "can.stl"
    assert other["contact_estimator"].parameters["calibration_file"] == "c"
    with pytest.raises(ValueError, match="meshes in m"):
        build(sim=True, object_mesh="can.stl", object_mesh_unit="mm")


def test_without_hardware_any_finger_is_seen_in_the_twins_images():
    for jaw in ("", "bench", "umi", "mine.yaml"):
        parts = robot(sim=True, jaw_file=jaw)
        assert "keypoint_detector" in parts and "detects" not in parts["twin_camera"].parameters
        assert all(parts[name].parameters.get("jaw_file", "") == jaw for name in ("twin_camera", "left_ifea_solver"))


def test_the_object_of_the_twin_is_a_cylinder_of_25_mm_along_y_in_metres():
    vertices = load_object_mesh(SIM_OBJECT, unit="m").vertices
    # 1e-6: the file holds single precision
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [0.025, 0.060, 0.025], atol=1e-6)


def test_the_twin_films_under_the_cameras_name():
    twin = robot(sim=True)["twin_camera"]
    assert twin.remappings["camera/camera/color/image_raw"] == "camera/wrist_camera/color/image_raw"
    assert twin.parameters["camera_frame"] == "wrist_camera_color_optical_frame"


def test_robot_and_twin_have_a_configuration_each():
    assert Path(robot()["left_ifea_solver"].parameter_file).name == "robot.yaml"
    parts = robot(sim=True).values()
    assert {part.parameter_file for part in parts if part.package == "finforce"} == {
        str(ROOT / "config" / "robot_sim.yaml")
    }
    assert robot(sim=True, parameter_file=options_file())["gripper_driver"].parameter_file == options_file()


def test_the_gripper_of_a_bench_runs_when_it_has_a_port():
    assert "gripper_driver" not in by_name(bench_processes(BenchOptions(composed=False), ROOT))
    driver = by_name(bench_processes(BenchOptions(composed=False, gripper_port="/dev/x"), ROOT))["gripper_driver"]
    assert driver.parameters["port"] == "/dev/x"


def test_the_simulated_bench_has_the_left_jaw_only():
    with pytest.raises(ValueError, match="jaw:=right"):
        bench_processes(BenchOptions(composed=False, sim=True, jaw="right"), ROOT)


def test_only_the_frames_can_be_done_without():
    parts = robot(arm=True, rviz=True) | robot(sim=True)
    assert {name for name, part in parts.items() if getattr(part, "optional", False)} == {
        "robot_state_publisher",
        "static_transform_publisher",
    }
    assert all(part.advice for part in parts.values() if part.package != "finforce")


@pytest.mark.parametrize(
    ("key", "namespace", "advice"),
    [
        (
            "keypoint_detector",
            "r2",
            "'keypoint_detector' is no node of this system in the namespace /r2.*write /\\*\\*/key",
        ),
        ("/r1/keypoint_detector", "r2", r"write /\*\*/keypoint_detector"),
        ("keypoint_detctor", "", "without a namespace.*did you mean keypoint_detector"),
        ("ifea_solver", "", "did you mean left_ifea_solver"),
        ("/*/keypoint_detector", "", r"write /\*\*/keypoint_detector"),
    ],
)
def test_a_section_of_a_parameter_file_that_no_node_would_read_is_refused(tmp_path, key, namespace, advice):
    file = parameter_file(tmp_path, key)
    for processes, record in ((bench_processes, BenchOptions), (robot_processes, RobotOptions)):
        with pytest.raises(ValueError, match=advice):
            processes(record(parameter_file=file, namespace=namespace), ROOT)


@pytest.mark.parametrize("namespace", ["robot-1", "1r", "r 1", "rö", "r1//left"])
def test_a_namespace_that_ros_does_not_allow_is_refused_with_what_it_allows(namespace):
    with pytest.raises(ValueError, match=f"namespace '{namespace}': expected letters, digits and underscores"):
        robot_processes(RobotOptions(namespace=namespace), ROOT)
    for allowed in ("", "r1", "/lab/robot_1", "r1/"):
        robot_processes(RobotOptions(namespace=allowed), ROOT)


@pytest.mark.parametrize("own", ["/r2/keypoint_detector", "r2/keypoint_detector", "/**/keypoint_detector"])
def test_one_parameter_file_may_serve_several_robots(tmp_path, own):
    file = Path(parameter_file(tmp_path, own))
    file.write_text(f"{file.read_text()}\n/r1/keypoint_detector: {{ros__parameters: {{T_gripper_camera: [0.0]}}}}\n")
    options = RobotOptions(parameter_file=str(file), namespace="r2")
    assert robot_processes(options, ROOT) and camera_pose(options)[2] == 0.5
    file.write_text(f"{file.read_text()}/r1/ifea_solver: {{ros__parameters: {{jaw: left}}}}\n")
    with pytest.raises(ValueError, match="'/r1/ifea_solver' is no node of this system in the namespace /r2"):
        robot_processes(options, ROOT)


def parameter_file(folder, key):
    file = folder / "lab.yaml"
    file.write_text(f"{key}: {{ros__parameters: {{T_gripper_camera: [0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]}}}}")
    return str(file)


KEYS = (
    "/**",
    "/**/keypoint_detector",
    "r2/keypoint_detector",
    "/r2/keypoint_detector",
    "/*/keypoint_detector",
    "/r2/*",
)


@pytest.mark.parametrize("key", [*KEYS, "r2: {keypoint_detector"])
def test_the_tool_reads_a_parameter_file_as_the_node_does(tmp_path, key):
    file = parameter_file(tmp_path, key)
    if "{" in key:
        Path(file).write_text(Path(file).read_text() + "}")
    options = RobotOptions(parameter_file=file, namespace="r2")
    assert camera_pose(options)[2] == 0.5
    assert robot_processes(options, ROOT)
    context = rclpy.Context()
    rclpy.init(context=context, args=[], domain_id=free_domain())
    words = ["--ros-args", "--params-file", file]
    node = rclpy.create_node("keypoint_detector", context=context, namespace="r2", cli_args=words)
    assert "T_gripper_camera" in node._parameter_overrides
    node.destroy_node()
    rclpy.shutdown(context=context)
