"""Claims about what every node shares: messages, parameters from records, start and stop."""

import gc
import math
import os
import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from hypothesis import given
from hypothesis import strategies as st
from node_fakes import ros_domain
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from finforce.errors import FinforceError, ObservationError
from finforce.health import Level, Report
from finforce.messages import decode_keypoints, stamp_of
from finforce.ros import node as ros
from finforce.ros.messages import MarkerStyle
from finforce_contact.parameters import ContactParameters, ContactSettings, TrackerSettings
from finforce_driver.settings import DriverParameters, GraspSettings, GripperSettings
from finforce_eval.replay.node import PlayerParameters
from finforce_ifea.parameters import NodeParameters
from finforce_ifea.settings import EstimatorSettings
from finforce_keypoints.detectors.dots import DotSettings
from finforce_keypoints.parameters import DetectorParameters, DetectorSettings

RECORDS = (
    NodeParameters,
    EstimatorSettings,
    PlayerParameters,
    ContactParameters,
    ContactSettings,
    TrackerSettings,
    DetectorParameters,
    DetectorSettings,
    DotSettings,
    DriverParameters,
    GripperSettings,
    GraspSettings,
)


@given(st.integers(0, 2**31 * ros.NANOSECONDS - 1))
def test_stamps_survive_to_the_nanosecond(stamp):
    assert stamp_of(Image(header=Header(stamp=ros.stamp_message(stamp)))) == stamp


def test_a_cloud_message_is_read_back_by_the_decoder():
    points = np.array([[1.0, 2.0, 3.0], [np.nan, 5.0, 6.0]])
    likelihood = np.array([0.25, 1.0], dtype=np.float32)
    cloud = ros.cloud_message(Header(), {**ros.xyz_columns(points), "likelihood": likelihood})
    read = decode_keypoints(cloud)
    np.testing.assert_array_equal(read.points, points)
    np.testing.assert_array_equal(read.likelihood, likelihood)
    assert (cloud.height, cloud.width, cloud.row_step, cloud.is_dense) == (1, 2, 2 * cloud.point_step, False)


def test_an_empty_cloud_has_its_fields():
    cloud = ros.cloud_message(Header(), ros.xyz_columns(np.empty((0, 3))))
    assert (cloud.width, [entry.name for entry in cloud.fields]) == (0, ["x", "y", "z"])


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_wrench_that_is_not_finite_cannot_be_made(bad):
    assert ros.wrench_message(Header(), (1, 2, 3), (4, 5, 6)).wrench.torque.z == 6.0
    with pytest.raises(ObservationError, match="not finite"):
        ros.wrench_message(Header(), (1, 2, 3), (4, bad, 6))


def test_a_cloud_touches_if_any_of_its_contacts_does():
    points = np.zeros((2, 3))
    for touching in ([0, 0], [0, 1]):
        columns = {**ros.xyz_columns(points), "touching": np.array(touching, dtype=np.uint8)}
        assert ros.is_touching(ros.cloud_message(Header(frame_id="a"), columns), "a") is any(touching)
    assert ros.is_touching(ros.cloud_message(Header(frame_id="a"), ros.xyz_columns(points)), "a") is False


def test_a_report_is_a_status_of_its_node():
    report = Report(level=Level.WARN, message="warm", values={"temperature": "60"})
    status = ros.status_message("gripper", "driver", report)
    assert (status.level, status.name, status.hardware_id, status.message) == (b"\x01", "gripper", "driver", "warm")
    assert [(entry.key, entry.value) for entry in status.values] == [("temperature", "60")]


def test_a_marker_without_points_is_deleted():
    look = (1.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0)
    assert ros.points_marker(Header(), "m", MarkerStyle("spheres", *look), ()).action == Marker.DELETE
    marker = ros.points_marker(Header(), "m", MarkerStyle("arrow", *look), [[0, 0, 0], [0, 0, 1]])
    assert (marker.action, marker.type, marker.points[1].z) == (Marker.ADD, Marker.ARROW, 1.0)


@dataclass(frozen=True, kw_only=True)
class Example:
    """A record with a field of every kind."""

    limit: float = field(default=0.5, metadata={"description": "a limit", "unit": "s", "min": 0.0, "max": 1.0})
    height: float = field(default=math.nan, metadata={"description": "a height", "unit": "m", "min": 0.0})
    count: int = field(default=3, metadata={"description": "a count", "min": 1})
    mode: str = field(default="a", metadata={"description": "a mode", "choices": ("a", "b")})
    flag: bool = field(default=False, metadata={"description": "a flag"})
    scale: float = field(
        default=1.0, metadata={"description": "a scale", "unit": "m", "min": 0.0, "max": 2.0, "settable": True}
    )


@pytest.fixture
def declare():
    """Declare the example on a node with given values; the record, and the node for its descriptors."""
    with ros_domain() as probe:

        def declare(**given):
            overrides = [Parameter(f"group.{name}", value=value) for name, value in given.items()]
            node = Node("example", context=probe.context, parameter_overrides=overrides)
            probe.spinner.add_node(node)
            return SimpleNamespace(node=node, record=ros.declare_record(node, Example, "group"))

        yield declare


def test_a_record_takes_its_values_from_parameters_and_else_its_defaults(declare):
    assert declare(limit=0.25, mode="b", height=0.04).record == Example(limit=0.25, mode="b", height=0.04)


def test_descriptors_carry_description_unit_range_and_choices(declare):
    node = declare().node
    limit = node.describe_parameter("group.limit")
    assert (limit.description, limit.read_only) == ("a limit [s]", True)
    assert (limit.floating_point_range[0].from_value, limit.floating_point_range[0].to_value) == (0.0, 1.0)
    assert node.describe_parameter("group.count").integer_range[0].from_value == 1
    assert "'a', 'b'" in node.describe_parameter("group.mode").additional_constraints
    assert not node.describe_parameter("group.scale").read_only
    # a range would refuse NaN, which says here that there is none
    assert not node.describe_parameter("group.height").floating_point_range


@pytest.mark.parametrize(
    ("name", "value"),
    [("limit", 1.5), ("limit", 1), ("count", 0), ("mode", "c"), ("flag", "yes"), ("height", -1.0)],
)
def test_a_value_that_does_not_fit_is_refused_by_name(declare, name, value):
    with pytest.raises(ros.ParameterError, match=f"group.{name}"):
        declare(**{name: value})


@pytest.mark.parametrize("record", RECORDS)
def test_every_parameter_has_a_default_and_a_description_and_every_number_a_unit(record):
    for entry in filter(lambda entry: entry.metadata, fields(record)):  # a plain field is no parameter
        assert entry.metadata["description"], entry.name
        if isinstance(entry.default, int | float) and not isinstance(entry.default, bool):
            assert "unit" in entry.metadata, entry.name
            assert "min" in entry.metadata or "max" in entry.metadata, entry.name


def test_a_node_that_cannot_be_built_ends_with_two_and_one_line(capsys):
    def build():
        raise FinforceError("the jaw file says nothing")

    assert ros.run_node("some_node", build, []) == 2
    assert capsys.readouterr().err == "some_node: the jaw file says nothing\n"
    assert not rclpy.ok()


def test_what_a_node_was_built_of_is_not_looked_through_for_garbage_again():
    class Quiet:
        def destroy_node(self):
            pass

    frozen, before = [], gc.get_freeze_count()
    kept = [[] for _ in range(1000)]
    node = Quiet()
    node.known = kept
    assert ros.run_node("some_node", lambda: node, lambda *_: frozen.append(gc.get_freeze_count())) == 0
    assert frozen[0] >= before + len(kept)


def test_a_defect_is_not_swallowed():
    def build():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        ros.run_node("some_node", build)
    assert not rclpy.ok()


def test_images_are_carried_unless_somebody_has_chosen_how(monkeypatch):
    for name in ros.CHOICES:
        monkeypatch.delenv(name, raising=False)
    ros.provide_transport()
    assert os.environ[ros.PROFILES] == str(ros.TRANSPORT) and ros.TRANSPORT.is_file()
    monkeypatch.setenv(ros.PROFILES, "other.xml")
    ros.provide_transport()
    assert os.environ[ros.PROFILES] == "other.xml"
    monkeypatch.delenv(ros.PROFILES)
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    ros.provide_transport()
    assert ros.PROFILES not in os.environ


def test_images_of_a_megabyte_arrive_with_best_effort():
    picture = np.zeros((480, 640, 3), dtype=np.uint8)
    with ros_domain() as probe:
        probe.hear("picture", Image, ros.SENSOR)
        publisher = probe.speak("picture", Image)
        probe.connected(publisher)
        for count in range(1, 6):
            publisher.publish(ros.image_message(Header(), picture))
            probe.wait_for(lambda count=count: len(probe.got["picture"]) == count)


@pytest.mark.parametrize(
    "path", sorted(Path(ros.__file__).parents[2].glob("finforce*/**/*.py")), ids=lambda path: path.stem
)
def test_what_the_nodes_take_from_here_is_here(path):
    text = path.read_text(encoding="utf-8")
    if "from finforce.ros import node as ros" in text:
        names = set(re.findall(r"(?<![\w.])ros\.([A-Za-z_]\w*)", text))
        assert [name for name in sorted(names) if not hasattr(ros, name)] == []
