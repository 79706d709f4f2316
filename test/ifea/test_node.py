"""Claims about the solver node: what it publishes, when it is silent, and what it says about it."""

import array
from time import time_ns

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Vector3Stamped, WrenchStamped
from node_fakes import KEYPOINTS, FakeEstimator, keypoint_cloud, start_solver
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce.health import Level
from finforce.messages import stamp_of
from finforce.ros import node as ros
from finforce.transforms import pose_numbers
from finforce_ifea.grasp_force import R_GRIPPER_JAW
from finforce_ifea.node import IfeaSolverNode
from finforce_ifea.payload import Payload

SECOND = 1_000_000_000


def one_jaw(probe, estimator=None, **parameters):
    """A left solver with a publisher of its key points, both ends of every topic found."""
    node = start_solver(probe, estimator, **parameters)
    probe.hear("left/wrench")
    out = probe.speak("left/keypoints")
    probe.connected(out)
    probe.wait_for(lambda: node.out.wrench.get_subscription_count() == 1)
    return node, out


def force_of(message):
    return [message.wrench.force.x, message.wrench.force.y, message.wrench.force.z]


def test_the_image_stamp_travels_unchanged(probe):
    _, out = one_jaw(probe)
    for topic, kind in (("left/wrench_stddev", WrenchStamped), ("left/surface", PointCloud2)):
        probe.hear(topic, kind)
    probe.spin(0.3)
    stamp = time_ns() // 1000 * 1000 + 123
    out.publish(keypoint_cloud(stamp))
    for topic in ("left/wrench", "left/wrench_stddev", "left/surface"):
        probe.wait_for(lambda topic=topic: probe.got[topic])
        message = probe.got[topic][0]
        assert stamp_of(message) == stamp
        assert message.header.frame_id == "left_jaw"


def test_force_and_its_deviation_are_the_estimators(probe):
    _, out = one_jaw(probe)
    probe.hear("left/wrench_stddev")
    probe.spin(0.3)
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: probe.got["left/wrench"] and probe.got["left/wrench_stddev"])
    assert force_of(probe.got["left/wrench"][0]) == [-2.0, 0.0, 0.5]
    assert probe.got["left/wrench"][0].wrench.torque.y == -0.08
    assert force_of(probe.got["left/wrench_stddev"][0]) == [0.05, 0.01, 0.02]


def test_the_estimator_sees_points_and_likelihood_whatever_their_layout(probe):
    estimator = FakeEstimator()
    _, out = one_jaw(probe, estimator)
    other = {"v": np.zeros(15), "valid": np.ones(15, dtype=np.uint8), "likelihood": np.full(15, 0.25)}
    out.publish(keypoint_cloud(**other))
    probe.wait_for(lambda: estimator.observations)
    np.testing.assert_allclose(estimator.observations[0].points, KEYPOINTS, atol=1e-8)
    assert set(estimator.observations[0].likelihood) == {0.25}


def two_rows(cloud):
    cloud.height, cloud.width = 3, 5
    return cloud


def cut_short(cloud):
    cloud.data = array.array("B", bytes(cloud.data)[:-10])
    return cloud


def without_z(cloud):
    cloud.fields = [field for field in cloud.fields if field.name != "z"]
    return cloud


def gravity_message(vector, frame="gripper_base"):
    message = Vector3Stamped(header=Header(stamp=ros.stamp_message(time_ns()), frame_id=frame))
    message.vector.x, message.vector.y, message.vector.z = vector
    return message


class RecordedPayload(Payload):
    """Keeps which posture it was told."""

    def __init__(self):
        super().__init__()
        self.told = []

    def update(self, grasp, stamp, posture):
        self.told.append(posture)
        return super().update(grasp, stamp, posture)


def reported(probe):
    """Values of every diagnosis so far."""
    return [
        {entry.key: entry.value for entry in state.values}
        for message in probe.got["/diagnostics"]
        for state in message.status
    ]


def hold(probe, side="left", **parameters):
    """A solver of one of two jaws, and what gives it an image of both."""
    peer = "left" if side == "right" else "right"
    node = start_solver(probe, jaw_name=side, peer=peer, **parameters)
    node.payload, node.told = RecordedPayload(), []
    update = node.estimator.update
    node.estimator.update = lambda seen, contact: node.told.append(seen.posture) or update(seen, contact)
    prefix = parameters.get("frame_prefix", "")
    out, other = probe.speak(f"{side}/keypoints"), probe.speak(f"{peer}/wrench", WrenchStamped)
    probe.hear("manipulation_wrench")
    probe.connected(out)
    probe.connected(other)

    def show():
        stamp = time_ns()
        out.publish(keypoint_cloud(stamp, frame=f"{prefix}{side}_jaw"))
        other.publish(
            ros.wrench_message(Header(stamp=ros.stamp_message(stamp), frame_id=f"{prefix}{peer}_jaw"), (-2.0, 0.0, 0.5))
        )
        probe.wait_for(lambda: node.payload.told)
        return node.payload.told[-1] and node.payload.told[-1].gravity

    return node, show


@pytest.mark.parametrize("side", ["left", "right"])
def test_which_way_things_fall_reaches_estimator_and_payload(probe, side):
    node, show = hold(probe, side)
    down = probe.speak("gravity", Vector3Stamped)
    probe.connected(down)
    down.publish(gravity_message((0.0, 3.0, -4.0)))
    probe.wait_for(lambda: node.posture.at(time_ns()) is not None)
    np.testing.assert_allclose(show(), [0.0, 0.6, -0.8], atol=1e-12)
    np.testing.assert_allclose(R_GRIPPER_JAW[side] @ node.told[-1].gravity, [0.0, 0.6, -0.8], atol=1e-12)
    assert np.isfinite(node.payload.stddev)
    probe.wait_for(lambda: probe.got["manipulation_wrench"])
    probe.wait_for(lambda: any("payload" in told for told in reported(probe)))


def test_which_way_things_fall_is_told_by_a_frame_that_stands_upright(probe, tf):
    tilt = np.eye(4)
    tilt[1:3, 1:3] = [[0.8, -0.6], [0.6, 0.8]]  # the base's z points along (0, -0.6, 0.8) of the gripper
    tf["r1/gripper_base", "base_link"] = tilt
    tilt[:3, 3] = [0.1, 0.3, -0.4]  # 0.5 m below the gripper
    node, show = hold(probe, gravity_frame="base_link", frame_prefix="r1/")
    np.testing.assert_allclose(show(), [0.0, 0.6, -0.8], atol=1e-12)
    assert node.payload.told[-1].elevation == pytest.approx(0.5)


def test_a_posture_of_long_ago_is_none(probe, tf):
    tf["gripper_base", "world"], tf["stamp"] = np.eye(4), time_ns() - 5 * SECOND
    _, show = hold(probe, gravity_frame="world")
    assert show() is None


@pytest.mark.parametrize(
    ("message", "word"),
    [(((0.0, 0.0, 0.0),), "not all zero"), (((0.0, np.nan, 1.0),), "finite"), (((0, 0, 1.0), "camera"), "camera")],
)
def test_a_direction_that_is_none_is_refused_and_forces_go_on_without(probe, message, word):
    _, show = hold(probe)
    down = probe.speak("gravity", Vector3Stamped)
    probe.connected(down)
    down.publish(gravity_message(*message))
    probe.diagnosis(level=Level.ERROR, word=word)
    assert show() is None


def test_a_direction_of_long_ago_is_no_longer_used(probe):
    _, show = hold(probe, max_age=0.3)
    down = probe.speak("gravity", Vector3Stamped)
    probe.connected(down)
    down.publish(gravity_message((0.0, 0.0, 1.0)))
    probe.spin(0.6)
    assert show() is None


MALFORMED = {
    "frame": (lambda: keypoint_cloud(frame="camera"), "camera"),
    "rows": (lambda: two_rows(keypoint_cloud()), "height"),
    "short": (lambda: cut_short(keypoint_cloud()), "buffer"),
    "field": (lambda: without_z(keypoint_cloud()), "no field z"),
    "count": (lambda: keypoint_cloud(points=KEYPOINTS[:9]), "9 key points"),
    "empty": (lambda: keypoint_cloud(points=KEYPOINTS[:0]), "0 key points"),
    "ahead": (lambda: keypoint_cloud(time_ns() + 5 * SECOND), "ahead of the node's clock"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_a_bad_cloud_gives_an_error_that_names_the_fault_and_no_wrench(probe, name):
    make, word = MALFORMED[name]
    _, out = one_jaw(probe, max_age=1.0)
    out.publish(make())
    probe.diagnosis(level=Level.ERROR, word=word)
    assert not probe.got["left/wrench"]
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: probe.got["left/wrench"])


def test_old_data_are_stale_and_give_no_wrench(probe):
    _, out = one_jaw(probe, max_age=0.2)
    out.publish(keypoint_cloud(time_ns() - SECOND // 2))
    state = probe.diagnosis(level=Level.STALE, word="old")
    assert "0.2 s" in state.message
    assert not probe.got["left/wrench"]


def test_a_result_that_comes_too_late_is_not_published(probe):
    estimator = FakeEstimator()
    update = estimator.update

    def slow(*observed):
        probe_time = time_ns()
        while time_ns() - probe_time < 0.15 * SECOND:
            pass
        return update(*observed)

    estimator.update = slow
    _, out = one_jaw(probe, estimator, max_age=0.1)
    out.publish(keypoint_cloud())
    probe.diagnosis(level=Level.STALE, word="old")
    assert estimator.observations and not probe.got["left/wrench"]


def test_silence_is_stale(probe):
    start_solver(probe)
    probe.diagnosis(level=Level.STALE, word="nothing has arrived on left/keypoints")


def test_stamps_that_stand_still_or_go_back_give_no_wrench(probe):
    _, out = one_jaw(probe, max_age=10.0)
    stamp = time_ns()
    out.publish(keypoint_cloud(stamp))
    probe.wait_for(lambda: probe.got["left/wrench"])
    out.publish(keypoint_cloud(stamp))
    probe.diagnosis(level=Level.ERROR, word="stand still")
    out.publish(keypoint_cloud(stamp - SECOND // 10))
    probe.diagnosis(level=Level.ERROR, word="go back")
    assert len(probe.got["left/wrench"]) == 1


def test_a_restarted_recording_resets_the_estimator(probe):
    estimator = FakeEstimator()
    _, out = one_jaw(probe, estimator, max_age=30.0)
    stamp = time_ns()
    out.publish(keypoint_cloud(stamp))
    probe.wait_for(lambda: len(probe.got["left/wrench"]) == 1)
    out.publish(keypoint_cloud(stamp - 10 * SECOND))
    probe.wait_for(lambda: len(probe.got["left/wrench"]) == 2)
    assert estimator.resets == 1


@pytest.mark.parametrize(("status", "level"), [("not_enough_points", Level.WARN), ("diverged", Level.ERROR)])
def test_an_untrusted_solution_is_not_published_but_explained(probe, status, level):
    _, out = one_jaw(probe, FakeEstimator(status=status, message="3 of 15 key points, 5 are needed"))
    out.publish(keypoint_cloud())
    state = probe.diagnosis(level=level, word="3 of 15")
    assert f"1 {status}" in {entry.key: entry.value for entry in state.values}["refused"]
    assert not probe.got["left/wrench"]


def test_a_nan_never_leaves_in_a_wrench(probe):
    _, out = one_jaw(probe, FakeEstimator(force=(np.nan, 0.0, 0.0)))
    out.publish(keypoint_cloud())
    probe.diagnosis(level=Level.ERROR, word="not finite")
    assert not probe.got["left/wrench"]


def test_only_the_newest_waiting_image_is_solved(probe):
    estimator = FakeEstimator()
    _, out = one_jaw(probe, estimator, max_age=5.0)
    stamps = [time_ns() + k for k in range(4)]
    for stamp in stamps:
        out.publish(keypoint_cloud(stamp))
    probe.wait_for(lambda: probe.got["left/wrench"])
    probe.spin(0.2)
    assert stamp_of(probe.got["left/wrench"][-1]) == stamps[-1]
    state = probe.diagnosis(word="")
    counts = {entry.key: entry.value for entry in state.values}
    assert len(estimator.observations) == int(counts["arrived"]) == int(counts["published"]) < 4


def test_rate_and_latency_are_in_the_diagnostics(probe):
    _, out = one_jaw(probe)
    for _ in range(5):
        out.publish(keypoint_cloud())
        probe.spin(0.05)
    probe.got["/diagnostics"].clear()
    values = {entry.key: entry.value for entry in probe.diagnosis(level=Level.OK).values}
    assert 5.0 < float(values["rate [Hz]"]) < 40.0
    for measure in ("callback to published", "image to published"):
        assert 0.0 < float(values[f"{measure} p50 [ms]"]) <= float(values[f"{measure} p95 [ms]"]) < 200.0
    assert values["key points used"] == "15 of 15"


@pytest.mark.parametrize(
    ("parameters", "held"),
    [
        ({}, "no"),
        ({"completes_grasp": True}, "no"),
        ({"peer": "right"}, "either"),
        ({"paired": True}, "either"),
        ({"paired": True, "estimator.held": "no"}, "no"),
        ({"estimator.held": "yes"}, "yes"),
    ],
)
def test_two_jaws_may_hold_what_they_press_alone_unless_told_otherwise(probe, parameters, held):
    given = {"contact_height": 0.04, **parameters}
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    asked = []

    def build(jaw, parameters, settings):
        asked.append(settings.held)
        return FakeEstimator()

    IfeaSolverNode(build, context=probe.context, parameter_overrides=overrides).destroy_node()
    assert asked == [held]


def two_jaws(probe, right_force=(-3.0, 0.0, 0.5)):
    """A left solver that completes the grasp, and a right one; ready."""
    left = start_solver(probe, peer="right")
    right = start_solver(probe, FakeEstimator(force=right_force), jaw_name="right")
    for topic in ("grasp_wrench", "manipulation_wrench", "left/wrench", "right/wrench"):
        probe.hear(topic)
    outs = {side: probe.speak(f"{side}/keypoints") for side in ("left", "right")}
    for out in outs.values():
        probe.connected(out)
    probe.wait_for(
        lambda: left.out.grasp.get_subscription_count() == 1 and right.out.wrench.get_subscription_count() == 2
    )
    return outs


@pytest.mark.parametrize("order", [("left", "right"), ("right", "left")])
def test_the_peer_completes_the_grasp_whoever_comes_first(probe, order):
    outs = two_jaws(probe)
    stamp = time_ns()
    for side in order:
        outs[side].publish(keypoint_cloud(stamp, frame=f"{side}_jaw"))
        probe.wait_for(lambda side=side: probe.got[f"{side}/wrench"])
    probe.wait_for(lambda: probe.got["grasp_wrench"] and probe.got["manipulation_wrench"])
    grasp, net = probe.got["grasp_wrench"][0], probe.got["manipulation_wrench"][0]
    assert force_of(grasp) == [pytest.approx(np.hypot(2.0, 0.5)), 0.0, 0.0]
    # (-2, 0, 0.5) of the left jaw and (-3, 0, 0.5) of the right one, turned by 180 degrees about z
    assert force_of(net) == pytest.approx([1.0, 0.0, 1.0])
    for message in (grasp, net):
        assert message.header.frame_id == "gripper_base"
        assert stamp_of(message) == stamp


def test_the_net_torque_is_about_the_middle_between_the_jaws(probe):
    outs = two_jaws(probe, right_force=(-3.0, 0.0, 0.1))
    poses = {side: probe.speak(f"{side}/jaw_pose", PoseStamped) for side in outs}
    for out in poses.values():
        probe.connected(out)
    stamp = time_ns()
    for side, x in (("left", -0.03), ("right", 0.03)):
        numbers = pose_numbers(jaw_in_camera(ROBOT_CAMERA, side, x))
        poses[side].publish(ros.pose_message(ros.Header(stamp=ros.stamp_message(stamp), frame_id="camera"), numbers))
    probe.spin(0.3)
    stamp = time_ns()
    for side, out in outs.items():
        out.publish(keypoint_cloud(stamp, frame=f"{side}_jaw"))
    probe.wait_for(lambda: probe.got["manipulation_wrench"])
    torque = probe.got["manipulation_wrench"][0].wrench.torque
    # the right jaw's own torque, turned by half a turn about z, cancels the left one's
    assert torque.y == pytest.approx(0.03 * (0.5 - 0.1))
    assert torque.x == torque.z == 0.0


def test_forces_of_different_images_make_no_grasp(probe):
    outs = two_jaws(probe)
    stamp = time_ns()
    outs["left"].publish(keypoint_cloud(stamp))
    outs["right"].publish(keypoint_cloud(stamp + 1000, frame="right_jaw"))
    probe.wait_for(lambda: probe.got["left/wrench"] and probe.got["right/wrench"])
    probe.spin(0.3)
    assert not probe.got["grasp_wrench"]


def test_a_silent_peer_is_named(probe):
    _, out = one_jaw(probe, peer="right")
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: probe.got["left/wrench"])
    probe.diagnosis(word="no wrench of the right jaw")


def test_one_jaw_alone_completes_the_grasp_only_when_told_to(probe):
    _, out = one_jaw(probe, completes_grasp=True)
    probe.hear("grasp_wrench")
    probe.spin(0.3)
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: probe.got["grasp_wrench"])
    assert force_of(probe.got["grasp_wrench"][0]) == [pytest.approx(np.hypot(2.0, 0.5)), 0.0, 0.0]


def test_without_being_told_one_jaw_offers_no_grasp(probe):
    one_jaw(probe)
    assert not probe.count_publishers("grasp_wrench")


def contact_cloud(points, *, stamp=None, frame="left_jaw", touching=1):
    header = Header(stamp=ros.stamp_message(time_ns() if stamp is None else stamp), frame_id=frame)
    count = len(points)
    columns = {
        "weight": np.ones(count, dtype=np.float32),
        "candidate": np.arange(count, dtype=np.uint16),
        "touching": np.full(count, touching, dtype=np.uint8),
        **ros.xyz_columns(points),
    }
    return ros.cloud_message(header, columns)


def contact_jaw(probe, **parameters):
    estimator = FakeEstimator()
    node, out = one_jaw(probe, estimator, contact_height=float("nan"), **parameters)
    contact = probe.speak("left/contact")
    probe.connected(contact)
    return estimator, node, out, contact


def test_a_contact_by_topic_reaches_the_estimator(probe):
    estimator, node, out, contact = contact_jaw(probe)
    contact.publish(contact_cloud([[0.014, 0.0, 0.038], [0.014, 0.0, 0.043]]))
    probe.wait_for(lambda: node.contacts._contact is not None)
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: estimator.contacts)
    np.testing.assert_allclose(estimator.contacts[0].points[:, 2], [0.038, 0.043], atol=1e-8)
    assert estimator.contacts[0].touching is True


def test_no_rows_say_that_there_is_no_object(probe):
    estimator, node, out, contact = contact_jaw(probe)
    contact.publish(contact_cloud(np.empty((0, 3))))
    probe.wait_for(lambda: node.contacts._contact is not None)
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: estimator.contacts)
    assert estimator.contacts[0].points.shape == (0, 3)
    assert estimator.contacts[0].touching is False


def test_an_old_contact_is_none(probe):
    estimator, node, out, contact = contact_jaw(probe)
    contact.publish(contact_cloud([[0.014, 0.0, 0.038]], stamp=time_ns() - 10 * SECOND))
    probe.wait_for(lambda: node.contacts._contact is not None)
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: estimator.contacts)
    assert estimator.contacts[0] is None


def test_a_contact_that_is_not_finite_is_refused(probe):
    estimator, node, out, contact = contact_jaw(probe)
    contact.publish(contact_cloud([[0.014, 0.0, 0.038]]))
    probe.wait_for(lambda: node.contacts._contact is not None)
    contact.publish(contact_cloud([[0.014, np.nan, 0.038]]))
    probe.diagnosis(level=Level.ERROR, word="contact has coordinates")
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: estimator.contacts)
    assert estimator.contacts == [None]


def test_a_fixed_contact_needs_no_topic(probe):
    estimator = FakeEstimator()
    _, out = one_jaw(probe, estimator)
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: estimator.contacts)
    assert estimator.contacts[0].points[0, 2] == pytest.approx(0.04)
    assert probe.count_subscribers("left/contact") == 0


def test_markers_show_jaw_key_points_contact_and_force_to_listeners_only(probe):
    node, out = one_jaw(probe)
    sent = []
    markers = node.out.markers
    publish, markers.publish = markers.publish, sent.append
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: probe.got["left/wrench"])
    assert not sent
    markers.publish = publish
    probe.hear("left/markers", MarkerArray)
    probe.wait_for(lambda: markers.get_subscription_count() == 1)
    out.publish(keypoint_cloud())
    probe.wait_for(lambda: probe.got["left/markers"])
    shown = {marker.ns: marker for marker in probe.got["left/markers"][0].markers}
    assert shown["surface"].type == Marker.TRIANGLE_LIST and len(shown["surface"].points) == 6
    assert len(shown["keypoints"].points) == len(shown["keypoints"].colors) == 15
    assert len(shown["contact"].points) == 1
    start, end = shown["force"].points
    assert end.x - start.x < 0.0 < end.z - start.z  # along the force, (-2, 0, 0.5)


def call(probe, name):
    client = probe.create_client(Trigger, name)
    probe.wait_for(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    probe.wait_for(future.done)
    return future.result()


def test_tare_answers_with_what_was_done_or_why_not(probe):
    estimator = FakeEstimator()
    start_solver(probe, estimator)
    answer = call(probe, "left/tare")
    assert answer.success and "15 key points" in answer.message
    estimator.under_load = True
    answer = call(probe, "left/tare")
    assert not answer.success and "3.1 N" in answer.message


def test_reset_is_a_service(probe):
    estimator = FakeEstimator()
    start_solver(probe, estimator)
    assert call(probe, "left/reset").success
    assert estimator.resets == 1


def test_a_listener_that_asks_for_other_service_is_named_until_it_leaves(probe):
    start_solver(probe)
    asks_too_much = QoSProfile(
        depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
    )
    listener = probe.hear("left/wrench", qos=asks_too_much)
    state = probe.diagnosis(level=Level.ERROR, word="quality of service of /left/wrench")
    assert "probe" in state.message
    probe.destroy_subscription(listener)
    probe.got["/diagnostics"].clear()
    probe.diagnosis(level=Level.STALE)


def test_a_best_effort_peer_is_named(probe):
    start_solver(probe, peer="right")
    probe.speak("right/wrench", WrenchStamped, QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    probe.diagnosis(level=Level.ERROR, word="quality of service of /right/wrench")
