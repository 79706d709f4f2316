"""Claims about the key point detector node: what it publishes, when it is silent, and what it says about it."""

import json
from time import time_ns

import cv2
import numpy as np
import pytest
from contact_node_fakes import call
from geometry_msgs.msg import PoseStamped
from keypoint_node_fakes import (
    COLOR,
    COUNT,
    FRAME,
    HEIGHT,
    JAW,
    MILLISECOND,
    OLD_COLOR,
    WIDTH,
    CameraBench,
    FakeKeypoints,
    camera_info,
    header,
    info_of,
    start_detector,
    start_real_detector,
)
from keypoint_scene_fakes import CAMERA, Bend, FakeScene, draw_dots
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import String

from finforce.camera_topics import COLOR_TOPIC, INFO_TOPIC
from finforce.health import Level
from finforce.messages import decode_columns, pose_from_message, stamp_of
from finforce.ros import node as ros
from finforce.systems.processes import Process
from finforce_eval.replay.node_run import awaited_topics
from finforce_keypoints.errors import DetectionError
from finforce_keypoints.node import KeypointDetectorNode

COLUMNS = (
    *("x", "y", "z", "likelihood", "u", "v", "valid", "reason", "stddev_x", "stddev_y", "stddev_z"),
    *("shared", "shared_height", "shared_scale", "shared_closing"),
)


def columns(cloud):
    return decode_columns(cloud, COLUMNS)


def test_key_points_and_pose_carry_the_stamp_of_the_image_and_all_columns(probe):
    bench = CameraBench(probe)
    keypoints = bench.node.detector.answer["left"]
    keypoints.valid[3], keypoints.reasons[3], keypoints.points[4] = False, "workspace", np.nan
    stamp = bench.shoot(time_ns() - 3)  # odd: seconds in a float would lose it
    cloud = bench.wait_for_clouds()
    assert stamp_of(cloud) == stamp and cloud.header.frame_id == "left_jaw"
    assert (cloud.height, cloud.width, [entry.name for entry in cloud.fields]) == (1, COUNT, list(COLUMNS))
    found = columns(cloud)
    np.testing.assert_array_equal(np.stack([found[name] for name in "xyz"], axis=1), np.float32(keypoints.points))
    np.testing.assert_array_equal(np.stack([found["u"], found["v"]], axis=1), np.float32(keypoints.pixels))
    np.testing.assert_array_equal(found["likelihood"], np.float32(keypoints.likelihood))
    np.testing.assert_array_equal(found["stddev_z"], np.float32(keypoints.stddev[:, 2]))
    assert found["valid"].dtype == np.uint8 and found["valid"].tolist() == [int(k != 3) for k in range(COUNT)]
    assert found["reason"].dtype == np.uint8 and found["reason"].tolist() == [4 * (k == 3) for k in range(COUNT)]
    pose = bench.poses()[-1]
    assert stamp_of(pose) == stamp
    # 1e-9: of a quaternion in double precision
    np.testing.assert_allclose(pose_from_message(pose, FRAME, "pose"), keypoints.T_camera_jaw, atol=1e-9)


def test_both_jaws_are_found_in_one_pass(probe):
    bench = CameraBench(probe)
    bench.shoot()
    assert bench.wait_for_clouds(side="right").header.frame_id == "right_jaw"
    bench.wait_for_clouds(side="left")
    assert len(bench.node.detector.images) == 1


def test_the_detector_sees_the_images_as_they_were_sent(probe):
    bench = CameraBench(probe)
    depth = np.full((HEIGHT, WIDTH), 123, dtype=np.uint16)
    depth[3, 5] = 0
    color = bench.picture()
    stamp = bench.shoot(color=color, depth=depth)
    bench.wait_for_clouds()
    (image,) = bench.node.detector.images
    np.testing.assert_array_equal(image.color, color)
    assert np.isnan(image.depth[3, 5]) and image.depth[0, 0] == pytest.approx(0.123)
    assert image.camera.width == WIDTH and image.camera.distortion[0] == pytest.approx(-0.05)
    assert image.stamp == pytest.approx(1e-9 * stamp, abs=1e-6)


@pytest.mark.parametrize("first", ["color", "depth"])
def test_the_order_of_colour_and_depth_does_not_matter(probe, first):
    bench = CameraBench(probe)
    stamp = time_ns()
    for send in (bench.color, bench.depth) if first == "color" else (bench.depth, bench.color):
        send(stamp)
    bench.wait_for_clouds()


def test_stamps_within_the_tolerance_belong_together_and_others_do_not(probe):
    bench = CameraBench(probe, sync_tolerance=0.005)
    stamp = time_ns()
    bench.depth(stamp - 6 * MILLISECOND)
    bench.color(stamp)
    assert not bench.clouds()
    bench.depth(stamp + 4 * MILLISECOND)
    assert stamp_of(bench.wait_for_clouds()) == stamp


def test_a_colour_image_is_looked_at_before_its_depth_comes(probe):
    bench, stamp = CameraBench(probe), time_ns()
    bench.color(stamp)
    (seen,) = bench.node.detector.looks
    assert seen.depth is None and not bench.node.detector.images
    bench.depth(stamp)
    bench.wait_for_clouds()
    (whole,) = bench.node.detector.images
    assert whole.depth is not None and whole.color is seen.color


def test_depth_that_is_an_image_late_is_waited_for(probe):
    bench = CameraBench(probe)
    stamps = [time_ns(), time_ns() + 20 * MILLISECOND]
    for stamp in stamps:
        bench.color(stamp)
    for stamp in stamps:
        bench.depth(stamp)
    bench.wait_for_clouds(2)
    assert [stamp_of(cloud) for cloud in bench.clouds()] == stamps


def test_a_newer_whole_image_passes_over_those_that_wait(probe):
    bench = CameraBench(probe, depth="aligned")
    old = time_ns()
    bench.color(old)
    new = bench.shoot()
    bench.depth(old)
    bench.wait_for_clouds()
    assert [stamp_of(cloud) for cloud in bench.clouds()] == [new]
    assert bench.node.feed.passed == 1
    values = {entry.key: entry.value for entry in bench.diagnosis(level=Level.OK).values}
    assert values["overtaken while waiting for depth"] == "1" and values["refused"] == "none"


def test_the_old_name_of_the_colour_topic_is_heard_too(probe):
    bench = CameraBench(probe, color_topic=OLD_COLOR)
    bench.shoot()
    bench.wait_for_clouds()


def test_only_one_colour_topic_is_used(probe):
    bench = CameraBench(probe)
    other = probe.speak(OLD_COLOR, Image)
    probe.connected(other)
    bench.shoot()
    bench.wait_for_clouds()
    bench.color_out = other
    bench.shoot()
    assert len(bench.clouds()) == 1


def test_names_reach_those_who_come_late(probe):
    start_detector(probe)
    probe.spin(0.2)
    probe.hear("/keypoint_detector/keypoint_names", String, ros.LATCHED)
    probe.wait_for(lambda: probe.got["/keypoint_detector/keypoint_names"])
    said = json.loads(probe.got["/keypoint_detector/keypoint_names"][0].data)
    assert tuple(said["names"]) == JAW.keypoint_names
    assert (said["model"], said["sha256"]) == ("fake", "ab12")
    joined = {tuple(said["names"][row] for row in pair) for pair in said["skeleton"]}
    assert {("inner_1", "inner_2"), ("outer_7", "tip"), ("inner_4", "outer_4")} <= joined


def test_names_are_a_parameter_that_nobody_changes(probe):
    node = start_detector(probe, keypoint_names=["nonsense"])
    assert tuple(node.get_parameter("keypoint_names").value) == JAW.keypoint_names
    assert node.describe_parameter("keypoint_names").read_only


def test_an_annotated_image_is_made_only_for_those_who_listen(probe, monkeypatch):
    from finforce_keypoints import node as outputs

    drawn = []
    draw = outputs.draw_keypoints
    monkeypatch.setattr(outputs, "draw_keypoints", lambda *given: drawn.append(1) or draw(*given))
    bench = CameraBench(probe)
    bench.shoot()
    bench.wait_for_clouds()
    assert not drawn
    probe.hear("/keypoint_detector/annotated", Image)
    probe.wait_for(lambda: bench.node.out.annotated.get_subscription_count() == 1)
    color = bench.picture()
    stamp = bench.shoot(color=color)
    probe.wait_for(lambda: probe.got["/keypoint_detector/annotated"])
    (image,) = probe.got["/keypoint_detector/annotated"]
    shown = np.frombuffer(image.data, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3)
    assert (image.encoding, image.step, stamp_of(image)) == ("rgb8", 3 * WIDTH, stamp)
    changed = (shown != color).any(axis=2)
    assert changed.any() and not changed[:, -5:].any()


def test_results_and_images_are_reliable_and_names_are_kept(probe):
    node = start_detector(probe, skip_off=["all"])

    def published(topic):
        return probe.get_publishers_info_by_topic(topic)[0].qos_profile

    def heard(topic):
        # discovery may still list nodes that have gone
        return {info.qos_profile.reliability for info in probe.get_subscriptions_info_by_topic(topic)}

    def known():
        return all(probe.get_publishers_info_by_topic(f"/{name}") for name in ("left/keypoints", "right/jaw_pose"))

    probe.wait_for(lambda: known() and probe.get_publishers_info_by_topic("/keypoint_detector/keypoint_names"))
    for topic in ("/left/keypoints", "/right/keypoints", "/left/jaw_pose", "/keypoint_detector/annotated"):
        assert published(topic).reliability == ReliabilityPolicy.RELIABLE
    assert published("/keypoint_detector/keypoint_names").durability == DurabilityPolicy.TRANSIENT_LOCAL
    # lost pieces of an image come again
    for topic in (*node.parameters.color_topics, node.parameters.depth_topic):
        probe.wait_for(lambda name=topic: ReliabilityPolicy.RELIABLE in heard(name))
    assert ReliabilityPolicy.BEST_EFFORT in heard(node.parameters.info_topic)


def test_a_camera_that_sends_with_best_effort_is_heard_too(probe):
    bench = CameraBench(probe, qos=ros.SENSOR)
    for count in (1, 2):
        bench.shoot()
        bench.wait_for_clouds(count)
    bench.diagnosis(level=Level.OK)


def test_a_jaw_that_is_not_found_is_silent_and_the_other_is_not(probe):
    bench = CameraBench(probe)
    bench.node.detector.answer = {"right": FakeKeypoints()}
    bench.shoot()
    bench.wait_for_clouds(side="right")
    bench.diagnosis(level=Level.WARN, word="left jaw was not found")
    assert not bench.clouds("left") and not bench.poses("left")


@pytest.mark.parametrize("lost", [False, True])
def test_what_the_detector_warns_of_is_said_and_refuses_nothing(probe, lost):
    bench = CameraBench(probe)
    bench.node.detector.warnings = {"left": "the key points at rest lie 3.1 mm from the jaw file"}
    if lost:
        del bench.node.detector.answer["left"]
    bench.shoot()
    bench.diagnosis(level=Level.WARN, word="; the key points at rest lie 3.1 mm from the jaw file")
    bench.diagnosis("right", level=Level.OK, word="visible")
    if not lost:
        bench.wait_for_clouds()


def test_hidden_key_points_are_counted_by_reason(probe):
    bench = CameraBench(probe)
    hidden = bench.node.detector.answer["left"]
    hidden.valid[2:], hidden.reasons[2:] = False, "likelihood"
    bench.shoot()
    state = bench.diagnosis(level=Level.WARN, word=f"2 of {COUNT}")
    values = {entry.key: entry.value for entry in state.values}
    assert values["hidden"] == f"{COUNT - 2} likelihood" and values["camera"] == f"{WIDTH} x {HEIGHT}"


def test_what_the_detector_refuses_is_said_and_not_published(probe):
    bench = CameraBench(probe)
    bench.node.detector.error = DetectionError("the image is 64 x 48; expected 640 x 480")
    bench.shoot()
    bench.refused("expected 640 x 480", Level.ERROR)
    bench.node.detector.error = None
    bench.shoot()
    bench.wait_for_clouds()


def test_the_detector_is_warm_before_the_first_image_can_come(probe, monkeypatch):
    seen = []
    subscribe = KeypointDetectorNode._subscribe
    monkeypatch.setattr(
        KeypointDetectorNode, "_subscribe", lambda node: seen.append(node.detector.warmed) or subscribe(node)
    )
    start_detector(probe)
    assert seen == [True]


def test_reset_forgets_the_jaws(probe):
    bench = CameraBench(probe)
    answer = call(probe, "/keypoint_detector/reset")
    assert answer.success and bench.node.detector.resets == 1


def test_a_new_recording_begins_anew(probe):
    bench = CameraBench(probe, max_age=10.0)
    now = bench.shoot()
    bench.wait_for_clouds()
    bench.shoot(now - 3_000 * MILLISECOND)
    bench.wait_for_clouds(2)
    assert bench.node.detector.resets == 1


@pytest.mark.parametrize("side", ["left", "right"])
def test_dots_on_the_jaws_become_key_points_in_the_jaw_frame(probe, side):
    scene = FakeScene("robot", Bend(push=0.004))
    rng = np.random.default_rng(3)
    color = rng.integers(60, 70, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    for jaw, T in scene.poses().items():
        draw_dots(color, scene.keypoints(jaw), T, CAMERA, (30, 220, 60))
    depth = np.rint(np.nan_to_num(1000.0 * scene.image(0.0, rng).depth)).astype(np.uint16)
    bench = CameraBench(probe, start=start_real_detector, info=False, detection_method="dots", max_age=5.0)
    bench.info_out.publish(info_of(CAMERA))
    probe.spin(0.05)
    for _ in range(3):
        noise, depth[:4] = rng.integers(0, 3, color.shape, dtype=np.uint8), rng.integers(340, 360, (4, CAMERA.width))
        bench.shoot(color=color + noise, depth=depth)
    bench.wait_for_clouds(3, side)
    found = columns(bench.clouds(side)[-1])
    used = found["valid"] == 1
    error = np.stack([found[name] for name in "xyz"], axis=1) - scene.keypoints(side)[:-1]
    assert used.sum() >= 10
    # 1.5 mm: depth in steps of 1 mm, and dots that are not all whole; a wrong frame or side is off by centimetres
    assert np.linalg.norm(error[used], axis=1).max() < 1.5e-3


def test_what_a_cloud_says_against_each_key_point_is_what_the_detector_said():
    from keypoint_node_fakes import FakeKeypoints

    from finforce_eval.replay.answers import heard_keypoints
    from finforce_keypoints.geometry.jaw_localizer import REASONS
    from finforce_keypoints.node import keypoint_columns

    said = FakeKeypoints()
    said.reasons[: len(REASONS)] = REASONS
    said.valid[: len(REASONS)] = False
    cloud = ros.cloud_message(ros.Header(frame_id="left_jaw"), keypoint_columns(said))
    heard = heard_keypoints(cloud, said.T_camera_jaw)
    assert heard.reasons.tolist() == said.reasons.tolist() and heard.valid.tolist() == said.valid.tolist()


def test_a_jpeg_stream_without_depth_is_seen_as_it_was_sent(probe):
    topic = f"{COLOR}/compressed"
    node = start_detector(probe, depth="none", color_topics=[topic])
    probe.hear("left/keypoints", PointCloud2)
    probe.hear("left/jaw_pose", PoseStamped)
    color_out, info_out = (
        probe.speak(topic, CompressedImage, ros.RESULT),
        probe.speak(INFO_TOPIC, CameraInfo, ros.RESULT),
    )
    for publisher in (color_out, info_out):
        probe.connected(publisher)
    probe.wait_for(lambda: node.out.keypoints["left"].get_subscription_count() == 1)
    info_out.publish(camera_info())
    probe.spin(0.05)
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8), (0, 0), 3.0)
    data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    stamp = time_ns()
    color_out.publish(CompressedImage(header=header(stamp), format="rgb8; jpeg compressed bgr8", data=list(data)))
    probe.wait_for(lambda: len(probe.got["left/keypoints"]) >= 1)
    assert stamp_of(probe.got["left/keypoints"][-1]) == stamp
    (seen,) = node.detector.images
    assert seen.depth is None and np.abs(seen.color.astype(int) - picture).mean() < 3.0
    assert node.get_parameter("depth").value == "none"


def test_depth_that_comes_too_late_is_said_and_the_images_are_answered(probe):
    bench = CameraBench(probe, max_age=3.0)
    first = time_ns()
    for n in range(20):
        stamp = first + n * 100 * MILLISECOND
        bench.probe.spin(max(0.0, 1e-9 * (stamp - time_ns())))
        bench.color(stamp)
        if n >= 8:
            bench.depth(stamp - 800 * MILLISECOND)
    bench.wait_for_clouds(12)
    bench.diagnosis(level=Level.WARN, word="depth images come 800 ms after their colour image, which waits 500 ms")


def test_images_that_get_lost_are_reported_with_a_remedy(probe):
    bench = CameraBench(probe)
    began, arrivals = bench.shoot(), bench.node.feed.arrivals["colour"]
    for number in filter(lambda number: number % 4 != 3, range(1, 120)):  # as they would arrive in four seconds
        arrivals.take(began + number * 33 * MILLISECOND, 1.0)
    status = bench.diagnosis(level=Level.WARN, word="do not arrive")
    assert "24 % (29 of 119) of the colour images" in status.message and ros.PROFILES in status.message
    values = {entry.key: entry.value for entry in status.values}
    assert "lost on the way" in values["missing colour images"] and values["missing depth images"] == "none"


def test_images_that_nobody_asked_for_are_not_missed(probe):
    node, listener = start_detector(probe), probe.hear("left/keypoints", PointCloud2)
    probe.wait_for(lambda: node.stage.is_needed)
    arrivals = node.feed.arrivals["colour"]
    for number in filter(lambda number: number % 4, range(120)):
        arrivals.take(number * 33 * MILLISECOND, 1.0)
    assert arrivals.count_losses().arrived
    probe.destroy_subscription(listener)
    probe.wait_for(lambda: not arrivals.count_losses().arrived)


@pytest.mark.parametrize("depth", ["none", "auto"])
def test_a_replay_awaits_no_camera_topic_that_the_detector_does_not_listen_to(probe, depth):
    start_detector(probe, depth=depth)
    probe.hear("left/keypoints", PointCloud2)
    awaited = awaited_topics([Process(executable="keypoint_detector", name="keypoint_detector")], ("left",))
    cameras = [topic for topic in awaited if topic.startswith("/camera")]
    assert {COLOR_TOPIC, INFO_TOPIC} <= set(cameras)
    for topic in cameras:
        probe.connected(probe.speak(topic, CameraInfo if topic == INFO_TOPIC else Image, ros.RESULT))
