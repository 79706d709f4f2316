"""Claims about the detector node with other people's cameras, frames, transports, namespaces and thresholds."""

from time import time_ns

import cv2
import numpy as np
import pytest
from keypoint_node_fakes import (
    COLOR,
    FRAME,
    HEIGHT,
    TOPICS,
    WIDTH,
    CameraBench,
    FakeDetector,
    camera_info,
    header,
    start_detector,
)
from rclpy import create_node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image

from finforce.health import Level
from finforce.messages import stamp_of
from finforce.transforms import pose_from_quaternion
from finforce_eval.recordings.images import compress_depth
from finforce_keypoints import node as detector_node
from finforce_keypoints.errors import GeometryError
from finforce_keypoints.node import KeypointDetectorNode

CAMERA = pose_from_quaternion((0.1, -0.2, 0.3), (0.0, 0.6, 0.0, 0.8))


def test_the_cameras_pose_is_that_of_tf_unless_one_was_given(probe, tf):
    tf["r1/gripper_base", FRAME] = CAMERA
    bench = CameraBench(probe, frame_prefix="r1/")
    first = bench.node.detector
    stamp = bench.shoot()
    cloud = bench.wait_for_clouds()
    assert stamp_of(cloud) == stamp and cloud.header.frame_id == "r1/left_jaw"
    assert bench.node.detector is not first
    np.testing.assert_allclose(bench.node.parameters.camera_pose, CAMERA, atol=1e-9)
    assert {(sent.header.frame_id, sent.child_frame_id) for sent in tf["sent"]} == {
        (FRAME, "r1/left_jaw"),
        (FRAME, "r1/right_jaw"),
    }


def test_a_pose_that_was_given_is_kept_and_jaws_stay_off_tf_where_they_are_not_wanted(probe, tf):
    tf["gripper_base", FRAME] = CAMERA
    given = TOPICS.T_gripper_camera
    bench = CameraBench(probe, T_gripper_camera=list(given), publish_tf=False)
    bench.shoot()
    bench.wait_for_clouds()
    assert bench.node.parameters.T_gripper_camera == list(given) and not tf["sent"]


def test_while_tf_may_still_tell_the_cameras_pose_nothing_is_answered(probe, tf, monkeypatch):
    bench = CameraBench(probe)
    bench.shoot()
    bench.refused("gripper_base <- camera_color_optical_frame", Level.ERROR)
    monkeypatch.setattr(detector_node, "TF_WAIT", 0.0)
    bench.shoot()
    bench.wait_for_clouds()
    assert bench.node.parameters.T_gripper_camera == TOPICS.T_gripper_camera


@pytest.mark.parametrize("is_tared", [False, True])
def test_a_pose_on_tf_that_comes_late_is_taken_before_the_tare_and_not_after_it(probe, tf, monkeypatch, is_tared):
    monkeypatch.setattr(detector_node, "TF_WAIT", 0.0)
    bench = CameraBench(probe)
    default = bench.node.parameters.T_gripper_camera
    bench.shoot()
    bench.wait_for_clouds()
    assert bench.diagnosis(level=Level.WARN, word="using the default T_gripper_camera")
    if is_tared:
        solver = probe.speak("left/wrench", detector_node.ros.WrenchStamped)
        probe.connected(solver)
        solver.publish(detector_node.ros.WrenchStamped())
        probe.wait_for(lambda: not solver.get_subscription_count())  # it has heard what it listened for
    tf["gripper_base", FRAME] = CAMERA
    probe.got["/diagnostics"].clear()
    bench.shoot()
    bench.wait_for_clouds(2)
    if is_tared:
        assert bench.diagnosis(level=Level.WARN, word="only since the tare")
        assert bench.node.parameters.T_gripper_camera == default
    else:
        np.testing.assert_allclose(bench.node.parameters.camera_pose, CAMERA, atol=1e-9)
        bench.diagnosis(level=Level.OK)


@pytest.mark.parametrize(("y", "reason"), [(95.0, "is it in millimetres?"), (0.2, "on the other side")])
def test_a_pose_on_tf_that_is_refused_is_not_replaced_by_the_default(probe, tf, monkeypatch, y, reason):
    def refuse(*arguments, **options):
        raise GeometryError("on the other side")

    tf["gripper_base", FRAME] = pose_from_quaternion((0.0, y, 0.0), (0.0, 0.6, 0.0, 0.8))
    bench = CameraBench(probe)
    monkeypatch.setattr(bench.node, "_build", refuse)
    for _ in range(3):
        bench.shoot()
        bench.refused(reason, Level.ERROR)
        probe.got["/diagnostics"].clear()


@pytest.mark.parametrize("transport", ["compressed", "auto"])
def test_compressed_images_are_taken_where_nobody_sends_raw_ones(probe, transport):
    node = start_detector(probe, image_transport=transport)
    probe.hear("left/keypoints", detector_node.ros.PointCloud2)
    color = probe.speak(f"{COLOR}/compressed", CompressedImage)
    depth = probe.speak(f"{TOPICS.depth_topic}/compressedDepth", CompressedImage)
    info = probe.speak(TOPICS.info_topic, detector_node.CameraInfo)
    for publisher in (color, depth, info):
        probe.connected(publisher)
    info.publish(camera_info())
    probe.wait_for(lambda: node.feed.stream.camera is not None)
    picture = cv2.imencode(".png", np.random.default_rng(0).integers(90, 160, (HEIGHT, WIDTH, 3), np.uint8))[1]
    stamp = time_ns()
    color.publish(CompressedImage(header=header(stamp), format="rgb8; png compressed bgr8", data=picture.tobytes()))
    plane = compress_depth(np.full((HEIGHT, WIDTH), 120, np.uint16))
    depth.publish(CompressedImage(header=header(stamp), format="16UC1; compressedDepth png", data=plane))
    probe.wait_for(lambda: probe.got["left/keypoints"])
    assert stamp_of(probe.got["left/keypoints"][0]) == stamp


def test_thresholds_can_be_set_while_the_node_runs_within_their_bounds(probe):
    bench = CameraBench(probe)
    set_one = lambda name, value: bench.node.set_parameters([Parameter(name, value=value)])[0]  # noqa: E731
    assert set_one("detector.likelihood", 0.8).successful and set_one("detector.rest_tolerance", 2e-3).successful
    assert (bench.node.detector.settings.likelihood, bench.node.detector.settings.rest_tolerance) == (0.8, 2e-3)
    assert not set_one("detector.likelihood", 1.5).successful and not set_one("detector.quantum", 1e-3).successful
    assert bench.node.detector.settings.likelihood == 0.8
    assert set_one("max_age", 0.001).successful
    bench.shoot()
    bench.refused("old", Level.STALE)


def test_diagnostics_of_robots_in_namespaces_are_told_apart(probe):
    node = KeypointDetectorNode(
        lambda jaws, *_, **__: FakeDetector(tuple(jaws)),
        context=probe.context,
        namespace="r1",
        parameter_overrides=[Parameter("diagnostics_period", value=0.1)],
    )
    probe.spinner.add_node(node)

    def seen():
        return {(s.name, s.hardware_id) for array in probe.got["/diagnostics"] for s in array.status}

    wanted = {(f"r1/finforce: {side} key points", "r1/keypoint_detector") for side in ("left", "right")}
    probe.wait_for(lambda: wanted <= seen())


def test_quality_of_service_of_images_can_be_overridden(probe):
    name = f"qos_overrides.{TOPICS.color_topics[0]}.subscription.reliability"
    bench = CameraBench(probe, **{name: "best_effort"})
    ends = bench.node.get_subscriptions_info_by_topic(COLOR)
    assert [end.qos_profile.reliability.name for end in ends] == ["BEST_EFFORT"]
    ends = bench.node.get_subscriptions_info_by_topic(TOPICS.color_topics[1])
    assert [end.qos_profile.reliability.name for end in ends] == ["RELIABLE"]  # of the others nothing was asked


@pytest.mark.parametrize("stream", ["color", "depth", "info"])
def test_a_camera_topic_that_two_nodes_publish_is_refused_with_their_names(probe, stream):
    bench = CameraBench(probe)
    bench.shoot()
    bench.wait_for_clouds()
    own = {"color": bench.color_out, "depth": bench.depth_out, "info": bench.info_out}[stream]
    second = create_node("second_camera", context=probe.context)
    rival = second.create_publisher(own.msg_type, own.topic_name, detector_node.ros.RESULT)
    probe.wait_for(lambda: bench.node.count_publishers(own.topic_name) == 2)
    before = len(bench.clouds())
    for _ in range(3):
        bench.send_info()
        bench.shoot()
    names = f"{own.topic_name} is published by /probe and /second_camera; expected one"
    assert bench.diagnosis(level=Level.ERROR, word=names)
    assert stream != "color" or len(bench.clouds()) == before
    second.destroy_publisher(rival)
    probe.wait_for(lambda: bench.node.count_publishers(own.topic_name) == 1)
    probe.got["/diagnostics"].clear()
    bench.send_info()
    bench.shoot()
    bench.wait_for_clouds(before + 1)
    assert "is published by" not in bench.diagnosis().message
    second.destroy_node()


def test_a_detector_hears_the_camera_of_its_own_namespace_and_one_that_was_named(probe):
    def start(name, **parameters):
        parameters["skip_off"] = ["all"]  # nobody listens
        node = KeypointDetectorNode(
            lambda jaws, *_, **__: FakeDetector(tuple(jaws)),
            context=probe.context,
            namespace=name,
            parameter_overrides=[Parameter(key, value=value) for key, value in parameters.items()],
        )
        probe.spinner.add_node(node)
        return node

    def camera_topics(node):
        return {port.topic_name for port in node.subscriptions if "camera" in port.topic_name}

    mine = camera_topics(start("r2"))
    assert len(mine) == 4 and all(topic.startswith("/r2/camera/camera/") for topic in mine)
    node = start("r3", depth_topic="/camera/depth", color_topics=["hand/color"], info_topic="/camera/info")
    assert camera_topics(node) == {"/camera/depth", "/camera/info"}
    assert node.feed.source == "/r3/hand/color"


def test_compressed_images_are_returned_to_when_raw_ones_are_gone(probe):
    node = start_detector(probe, depth="none")
    probe.hear("left/keypoints", detector_node.ros.PointCloud2)
    probe.speak(f"{COLOR}/compressed", CompressedImage)
    raw = probe.speak(COLOR, Image)
    kinds = lambda: {sub.msg_type for sub in node.subscriptions if sub.topic_name.startswith(COLOR)}  # noqa: E731
    probe.wait_for(lambda: kinds() == {Image})
    probe.destroy_publisher(raw)
    probe.wait_for(lambda: kinds() == {CompressedImage})
