"""A claim about the page of interfaces: its tables of topics and its services are those of the nodes."""

import re
from importlib import import_module
from pathlib import Path

from finforce.ros.composition import CLASSES
from finforce.ros.start import NODES
from finforce_ifea.estimator import ForceEstimator
from finforce_keypoints.detector import KeypointDetector

PAGE = Path(__file__).resolve().parents[2] / "docs" / "interfaces.md"
WORDS = {
    "keypoint_detector": ("-p", "skip_off:=[all]"),  # else it rests
    "contact_estimator": ("-p", "jaws:=both", "-p", "skip_off:=[all]"),
    "ifea_solver": ("-p", "peer:=right"),
    "gripper_driver": ("-p", "port:=/dev/null"),
}
EVERY_NODE = {"/diagnostics", "/parameter_events", "/rosout", "/tf", "/clock"}
# with another pose_source, and with contact.mode paper
OPTIONAL = {("in", "object_detections"), ("in", "object_mask"), ("in", "<jaw>/surface")}
OWN = re.compile("parameter|type_description")


def spell(name, node):
    """A topic as the page has it: relative, of the node, or of either jaw."""
    own = f"/{node.get_name()}/"
    name = f"~/{name.removeprefix(own)}" if name.startswith(own) else name.removeprefix("/")
    return re.sub("^(left|right)/", "<jaw>/", name)


def listed():
    """(direction, topic) of all rows; a row that names no direction stands for both."""
    found, whole = set(), ""
    for names, kind in re.findall(r"^\| (`.*?) \| ([^|]*) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE):
        ways = re.match("(in|out)(?=,|$)", kind)
        if not (ways or kind == "PoseStamped"):
            continue
        for name in re.findall("`([^`]+)`", names):
            whole = name.replace("…", whole.rpartition("/")[0])
            spelt = re.sub("^(<peer>|left|right)/", "<jaw>/", whole.removeprefix("/"))
            found |= {(way, spelt) for way in ([ways[0]] if ways else ("in", "out"))}
    return found


def test_the_topics_and_services_on_the_page_are_those_of_the_nodes(probe, monkeypatch):
    for estimator in (ForceEstimator, KeypointDetector):  # no image comes
        monkeypatch.setattr(estimator, "warm_up", lambda self: None)
    topics, page = set(), PAGE.read_text(encoding="utf-8")
    for executable, words in WORDS.items():
        kind = getattr(import_module(NODES[executable]), CLASSES[executable])
        node = kind(context=probe.context, cli_args=["--ros-args", *words])
        topics |= {
            ("out", spell(each.topic_name, node)) for each in node.publishers if each.topic_name not in EVERY_NODE
        }
        topics |= {
            ("in", spell(each.topic_name, node)) for each in node.subscriptions if each.topic_name not in EVERY_NODE
        }
        services = {spell(each.srv_name, node) for each in node.services if not OWN.search(each.srv_name)}
        assert not [name for name in services if f"`{name.removeprefix('~/')}`" not in page and f"`{name}`" not in page]
        node.destroy_node()
    assert topics - listed() == set()
    assert listed() - topics - OPTIONAL == {("out", "object_pose")}  # of the tracker
