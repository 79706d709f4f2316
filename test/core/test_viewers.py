"""Claims about the RViz and Foxglove configurations: every topic they name is there, as they expect, when nodes run."""

import importlib
import json
from pathlib import Path

import pytest
import yaml
from contact_node_fakes import start_contact_estimator
from geometry_msgs.msg import WrenchStamped
from keypoint_node_fakes import start_detector
from node_fakes import FakeEstimator, start_solver
from rclpy.qos import (
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from std_msgs.msg import String

from finforce.systems.processes import RobotOptions
from finforce.systems.setups import robot_processes

ROOT = Path(__file__).resolve().parents[2]
TYPES = {
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "Image": "sensor_msgs/msg/Image",
    "RobotModel": "std_msgs/msg/String",
    "Wrench": "geometry_msgs/msg/WrenchStamped",
}
SHOWN_IN_3D = ("visualization_msgs/msg/MarkerArray", "sensor_msgs/msg/PointCloud2")
FOREIGN = {  # published by a recording or by robot_state_publisher, not by our nodes
    "/left/ground_truth_wrench": WrenchStamped,
    "/right/ground_truth_wrench": WrenchStamped,
    "/robot_description": String,
}


@pytest.fixture
def graph(probe):
    """The nodes of a robot, and what else stands on its graph: publishers by topic."""
    start_solver(probe, peer="right")
    start_solver(probe, FakeEstimator(), jaw_name="right")
    start_contact_estimator(probe)
    start_detector(probe)
    for topic, kind in FOREIGN.items():
        durable = DurabilityPolicy.TRANSIENT_LOCAL if topic == "/robot_description" else DurabilityPolicy.VOLATILE
        probe.create_publisher(kind, topic, QoSProfile(depth=1, durability=durable))
    probe.wait_for(lambda: probe.get_publishers_info_by_topic("/right/ground_truth_wrench"))
    return probe


def publisher_of(graph, topic):
    found = graph.get_publishers_info_by_topic(topic)
    assert found, f"nobody publishes {topic}"
    return found[0]


@pytest.mark.parametrize("name", ["finforce", "robot"])
def test_every_display_of_rviz_hears_its_topic(graph, name):
    manager = yaml.safe_load((ROOT / "rviz" / f"{name}.rviz").read_text(encoding="utf-8"))["Visualization Manager"]
    heard = 0
    for display in manager["Displays"]:
        topic = display.get("Topic") or display.get("Description Topic")
        if not topic:
            continue
        there = publisher_of(graph, topic["Value"])
        assert there.topic_type == TYPES[display["Class"].split("/")[1]], topic["Value"]
        asked = QoSProfile(
            depth=topic["Depth"],
            reliability=ReliabilityPolicy[topic["Reliability Policy"].upper().replace(" ", "_")],
            durability=DurabilityPolicy[topic["Durability Policy"].upper().replace(" ", "_")],
        )
        match, why = qos_check_compatible(there.qos_profile, asked)
        assert match != QoSCompatibility.ERROR, f"{topic['Value']}: {why}"
        # what is said once is heard by a viewer that comes later
        latched = there.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert not latched or asked.durability == DurabilityPolicy.TRANSIENT_LOCAL, topic["Value"]
        heard += 1
    assert heard >= 5


def test_every_panel_of_foxglove_finds_its_topic_and_field(graph):
    panels = json.loads((ROOT / "rviz" / "foxglove_layout.json").read_text(encoding="utf-8"))["configById"]
    found = set()
    for panel, content in panels.items():
        for topic in content.get("topics", {}):
            assert publisher_of(graph, topic).topic_type in SHOWN_IN_3D
            found.add(topic)
        for path in content.get("paths", ()):
            topic, *fields = path["value"].split(".")
            package, _, kind = publisher_of(graph, topic).topic_type.split("/")
            message = getattr(importlib.import_module(f"{package}.msg"), kind)()
            for field in fields:
                message = getattr(message, field)
            assert isinstance(message, float | int), path["value"]
            found.add(topic)
        image = content.get("imageMode", {}).get("imageTopic")
        if image:
            assert publisher_of(graph, image).topic_type == TYPES["Image"]
            found.add(image)
        if panel.startswith("DiagnosticSummary"):
            assert publisher_of(graph, content["topicToRender"]).topic_type == "diagnostic_msgs/msg/DiagnosticArray"
            found.add(content["topicToRender"])
    forces = {"/left/wrench", "/right/wrench", "/grasp_wrench", "/manipulation_wrench"}
    assert forces | {"/keypoint_detector/annotated", "/diagnostics"} <= found


def test_every_panel_of_the_layout_stands_somewhere():
    layout = json.loads((ROOT / "rviz" / "foxglove_layout.json").read_text(encoding="utf-8"))

    def leaves(tree):
        return {tree} if isinstance(tree, str) else leaves(tree["first"]) | leaves(tree["second"])

    assert leaves(layout["layout"]) == set(layout["configById"])


def test_rviz_shows_the_topics_of_a_namespace_and_the_frames_of_a_prefix():
    parts = robot_processes(RobotOptions(rviz=True, namespace="r1", frame_prefix="r1/"), ROOT)
    (rviz,) = [part for part in parts if getattr(part, "executable", "") == "rviz2"]
    manager = yaml.safe_load(Path(rviz.arguments[1]).read_text(encoding="utf-8"))["Visualization Manager"]
    told = [display.get("Topic") or display.get("Description Topic") for display in manager["Displays"]]
    topics = {topic["Value"] for topic in told if topic}
    assert "/r1/grasp_wrench" in topics and all(topic.startswith("/r1/") for topic in topics)
    assert manager["Global Options"]["Fixed Frame"] == "r1/gripper_base"
    (model,) = [display for display in manager["Displays"] if "TF Prefix" in display]
    assert model["TF Prefix"] == "r1/"
    plain = robot_processes(RobotOptions(rviz=True), ROOT)
    assert plain[-1].arguments[1] == str(ROOT / "rviz" / "robot.rviz")


def test_every_diagnosis_has_one_heading_in_the_aggregator(graph):
    file = ROOT / "config" / "diagnostics" / "aggregator.yaml"
    tree = yaml.safe_load(file.read_text(encoding="utf-8"))["/**"]["ros__parameters"]
    words = [group["contains"] for group in tree["finforce"]["analyzers"].values()]
    graph.wait_for(lambda: len({s.name for a in graph.got["/diagnostics"] for s in a.status}) >= 5)
    names = {status.name for array in graph.got["/diagnostics"] for status in array.status} | {"finforce: gripper"}
    for name in names:
        assert sum(any(word in name for word in group) for group in words) == 1, name
