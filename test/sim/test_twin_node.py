"""Claims about the twin as a camera: what it publishes is what a camera driver would, at its pace."""

from dataclasses import fields
from pathlib import Path
from time import monotonic, sleep

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, WrenchStamped
from node_fakes import ros_domain
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rgbd_fakes import FakeGripper, FakeLens, make_fake_recording
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import String

from finforce.messages import decode_columns, stamp_of
from finforce.ros import node as ros
from finforce_sim import node as twin_node
from finforce_sim.gripper import PressedGrasp
from finforce_sim.node import TwinCameraNode, TwinParameters
from finforce_sim.scenarios import ScenarioError, build_scenario
from finforce_sim.simulated_recording import encode_depth, parse_size
from finforce_sim.stored_grasp import LiveScene

COLOR = "/camera/camera/color/image_raw"
DEPTH = "/camera/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/camera/color/camera_info"
KINDS = {
    COLOR: Image,
    DEPTH: Image,
    INFO: CameraInfo,
    "/object_pose": PoseStamped,
    "/left/ground_truth_wrench": WrenchStamped,
    "/left/ground_truth_keypoints": PointCloud2,
    "/bench/phase": String,
}


@pytest.fixture
def probe():
    with ros_domain() as probe:
        for topic, kind in KINDS.items():
            probe.hear(topic, kind)
        yield probe


def start(probe, simulated=None, **parameters):
    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    simulated = simulated or make_fake_recording(FakeGripper(count=6))
    node = TwinCameraNode(lambda *_, **__: simulated, context=probe.context, parameter_overrides=overrides)
    probe.spinner.add_node(node)
    return node


def play(probe, node):
    """Start the stream, and wait for the listeners before the first image leaves."""
    node.render()
    outputs = node._outputs.values()
    probe.wait_for(lambda: all(output.get_subscription_count() for output in outputs))


def test_a_scene_is_published_once_as_it_was_rendered(probe):
    node = start(probe, loop=False)
    play(probe, node)
    probe.wait_for(lambda: len(probe.got[COLOR]) == 6 and node.is_over)
    frames = list(make_fake_recording(FakeGripper(count=6)))
    for frame, color, depth in zip(frames, probe.got[COLOR], probe.got[DEPTH], strict=True):
        np.testing.assert_array_equal(np.frombuffer(color.data, np.uint8).reshape(48, 64, 3), frame.color)
        np.testing.assert_array_equal(np.frombuffer(depth.data, "<u2").reshape(48, 64), encode_depth(frame.depth))
        assert (color.encoding, color.step, depth.encoding, depth.step) == ("rgb8", 192, "16UC1", 128)
    forces = [message.wrench.force.x for message in probe.got["/left/ground_truth_wrench"]]
    assert forces == [frame.jaws["left"].force[0] for frame in frames]
    columns = decode_columns(probe.got["/left/ground_truth_keypoints"][0], ("u", "visible"))
    assert columns["visible"].tolist() == [1, 1, 1, 0]
    np.testing.assert_allclose(columns["u"], frames[0].jaws["left"].pixels[:, 0], atol=1e-4)
    assert [message.data for message in probe.got["/bench/phase"]] == ["0:load:0:record", "0:load:1:record"]


def test_the_parts_of_an_image_have_one_stamp_and_stamps_are_those_of_now(probe):
    node = start(probe, loop=False)
    play(probe, node)
    probe.wait_for(lambda: node.is_over and len(probe.got[INFO]) == 6)
    stamps = {topic: [stamp_of(message) for message in probe.got[topic]] for topic in (COLOR, DEPTH, INFO)}
    assert stamps[COLOR] == stamps[DEPTH] == stamps[INFO]
    assert (np.diff(stamps[COLOR]) > 0).all()
    now = node.get_clock().now().nanoseconds
    assert 0 <= now - stamps[COLOR][-1] < 10 * ros.NANOSECONDS  # of a run that may have been held up
    assert {message.header.frame_id for message in probe.got[COLOR]} == {"camera_color_optical_frame"}
    assert len(probe.got["/object_pose"]) == 2
    info = probe.got[INFO][0]
    assert (info.width, info.height, info.k[0], info.k[5], info.d[0]) == (64, 48, 43.0, 23.5, 0.01)


@pytest.fixture(scope="module")
def grasp():
    return PressedGrasp(build_scenario("grasp_cylinder"), 3, "coarse", step=1e-3)


class EndingLens(FakeLens):
    """Has the context of a node end, as Ctrl-C does, once the first images have become messages."""

    node = None

    def look(self, state):
        if self.looks == 10:
            until = monotonic() + 5.0
            while len(self.node._outputs) < 5 and monotonic() < until:
                sleep(1e-3)
            self.node.context.try_shutdown()
        return super().look(state)


def start_live(probe, grasp, link, lens=None, **parameters):
    """Add a node that plays what an emulated gripper does."""
    overrides = [Parameter(name, value=value) for name, value in {"gripper_link": str(link), **parameters}.items()]
    node = TwinCameraNode(
        build_live=lambda *_, **__: LiveScene(grasp, lens or FakeLens(), 5),
        context=probe.context,
        parameter_overrides=overrides,
    )
    probe.spinner.add_node(node)
    return node


def test_images_and_forces_are_those_of_the_gripper_at_the_link(probe, grasp, tmp_path):
    node = start_live(probe, grasp, tmp_path / "gripper")
    node.render()
    assert (tmp_path / "gripper").is_char_device()
    probe.wait_for(lambda: len(probe.got[COLOR]) > 3)
    assert {message.wrench.force.x for message in probe.got["/left/ground_truth_wrench"]} == {0.0}
    jaws = node.gripper.jaws
    jaws.load = None  # which would push limp jaws open
    jaws.ticks = jaws.ticks_at(0.013)
    probe.wait_for(lambda: probe.got["/left/ground_truth_wrench"][-1].wrench.force.x < -1.0)
    held = len(probe.got["/left/ground_truth_wrench"])
    probe.wait_for(lambda: len(probe.got["/left/ground_truth_wrench"]) > held + 30)
    forces = [-message.wrench.force.x for message in probe.got["/left/ground_truth_wrench"][held:]]
    assert forces[-1] < forces[0] and forces[-1] > grasp.elastic_force(0.013)  # it relaxes, and takes seconds
    shown = decode_columns(probe.got["/left/ground_truth_keypoints"][-1], ("x", "z"))
    state = grasp.state(node.scene.openings[node.scene.find(jaws.opening)])
    np.testing.assert_allclose(shown["x"], state.jaws["left"].keypoints[:, 0], atol=1e-6)
    assert probe.got["/bench/phase"] == []


def test_images_of_a_gripper_are_stamped_as_those_of_a_script_and_never_alike(probe, grasp, tmp_path):
    node = start_live(probe, grasp, tmp_path / "gripper")
    node.render()
    probe.wait_for(lambda: min(len(probe.got[topic]) for topic in (COLOR, DEPTH, INFO)) >= 8)
    stamps = [[stamp_of(message) for message in probe.got[topic][:8]] for topic in (COLOR, DEPTH)]
    assert stamps[0] == stamps[1] and (np.diff(stamps[0]) > 0).all()
    for topic in (COLOR, DEPTH):  # nor when some images between are lost
        assert len({message.data.tobytes() for message in probe.got[topic]}) == len(probe.got[topic])
    pictures = probe.got[COLOR]
    assert {message.header.frame_id for message in probe.got["/object_pose"]} == {"camera_color_optical_frame"}
    assert len(probe.got["/object_pose"]) < len(pictures) / 2
    probe.spinner.remove_node(node)
    node.destroy_node()
    assert not (tmp_path / "gripper").is_symlink()


def test_rendering_ends_with_the_node(probe, grasp, tmp_path):
    lens = EndingLens()
    node = lens.node = start_live(probe, grasp, tmp_path / "gripper", lens)
    with pytest.raises(ExternalShutdownException):
        node.render()
    assert lens.looks < 80  # of 169
    assert not (tmp_path / "gripper").exists()


def test_a_scene_begins_again(probe):
    node = start(probe)
    play(probe, node)
    probe.wait_for(lambda: len(probe.got[COLOR]) > 7)
    assert not node.is_over
    assert probe.got[COLOR][6].data == probe.got[COLOR][0].data
    assert stamp_of(probe.got[COLOR][6]) > stamp_of(probe.got[COLOR][5])


@pytest.mark.parametrize(
    ("parameters", "reason"), [({"scene": "nothing"}, "nothing"), ({"size": "huge"}, "WIDTHxHEIGHT")]
)
def test_a_scene_that_does_not_exist_is_a_start_up_error(probe, parameters, reason):
    with pytest.raises(ScenarioError, match=reason):
        start(probe, **parameters)


def test_the_scene_takes_what_the_parameters_change():
    scenario = TwinParameters(scene="grasp_cylinder", light="dim", object="block").scenario
    assert (scenario.light, scenario.object) == ("dim", "block")
    assert TwinParameters(scene="weight_turn_dim").scenario.light == "dim"
    for light in ("bright", "dim", "any"):
        assert TwinParameters(light=light).scenario.light == light
    with pytest.raises(ScenarioError, match="light: got 'moonlight', expected one of bright, dim, any"):
        TwinParameters(light="moonlight").scenario  # noqa: B018 - the property checks


def test_every_parameter_is_read():
    text = Path(twin_node.__file__).read_text(encoding="utf-8")
    unread = [entry.name for entry in fields(TwinParameters) if f"parameters.{entry.name}" not in text]
    assert [name for name in unread if f"self.{name}" not in text] == []


def test_other_sizes_see_the_same_along_the_rows():
    whole, half, wide = parse_size("640x480"), parse_size("320x240"), parse_size("640x400")
    # the same ray: 100 pixels of the whole image are 50 of the half one
    assert (100.0 - whole.cx) / whole.fx == pytest.approx((49.75 - half.cx) / half.fx)
    assert (wide.fx, wide.cx) == (whole.fx, whole.cx) and wide.cy == whole.cy - 40.0
    for text in ("640", "640x", "8x8", "-640x480"):
        with pytest.raises(ScenarioError):
            parse_size(text)
