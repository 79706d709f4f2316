"""Claims about the contact estimator node: what it publishes, when it is silent, and what it says about it."""

from threading import Event
from time import time_ns

import numpy as np
import pytest
import rclpy
from contact_node_fakes import (
    CAMERA,
    MESH,
    RADIUS,
    SECOND,
    T_CAMERA_JAW,
    ContactBench,
    call,
    cylinder_before_jaw,
    header,
    pose,
)
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from finforce.health import Level
from finforce.messages import decode_columns, stamp_of
from finforce.ros import node as ros
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.messages import contact_from_cloud, outline_from_cloud


def columns(cloud, *names):
    found = decode_columns(cloud, names)
    return [found[name] for name in names]


def test_a_cylinder_before_the_jaw_gives_its_place_of_first_touch(probe):
    bench = ContactBench(probe)
    stamp = bench.image(cylinder_before_jaw())
    cloud = bench.wait_for_contacts()
    assert cloud.header.frame_id == "left_jaw" and stamp_of(cloud) == stamp
    x, y, z, candidate, touching, weight = columns(cloud, "x", "y", "z", "candidate", "touching", "weight")
    jaw = load_jaw("bench")
    # half a millimetre: the spacing of the heights that are looked at
    np.testing.assert_allclose([[*x], [*y], [*z]], [[jaw.inner_face_x], [0.0], [0.04]], atol=5e-4)
    assert candidate[0] == np.abs(jaw.candidates[:, 2] - 0.04).argmin()
    assert touching.tolist() == [0] and weight.tolist() == [1.0]
    assert (candidate.dtype, touching.dtype, weight.dtype) == (np.uint16, np.uint8, np.float32)


def test_a_solver_reads_the_contact_and_the_outline(probe):
    bench = ContactBench(probe)
    for k in range(3):
        bench.image(cylinder_before_jaw(0.001 - 1e-5 * k))
        bench.wait_for_contacts(k + 1)
    contact = contact_from_cloud(bench.contacts[-1], "left_jaw", free=False)
    assert contact.points.shape[1] == 3 and contact.touching is False
    first = outline_from_cloud(bench.outlines[0], "left_jaw", None)
    # a cylinder along y: a circle about the origin, where its axis is
    radii = np.linalg.norm(np.concatenate(first.polygons), axis=1)
    np.testing.assert_allclose(radii, RADIUS, atol=1e-4)  # sagitta of the mesh's facets
    np.testing.assert_allclose(first.origin, [0.014 + RADIUS + 0.001, 0.04], atol=1e-4)
    # an outline that was not cut anew keeps its polygons, to the object
    again = outline_from_cloud(bench.outlines[-1], "left_jaw", first)
    assert again.polygons is first.polygons and again.origin[0] < first.origin[0]


def test_without_an_object_there_are_no_rows_and_a_warning(probe):
    bench = ContactBench(probe, object_mesh="")
    bench.image(cylinder_before_jaw())
    assert bench.wait_for_contacts().width == 0
    state = bench.diagnosis(level=Level.WARN, word="no object mesh")
    assert {entry.key: entry.value for entry in state.values}["object"] == "unknown"


def test_an_object_whose_pose_is_not_known_gives_nothing_and_a_warning(probe):
    bench = ContactBench(probe)
    bench.jaw_out.publish(pose(time_ns(), T_CAMERA_JAW))
    bench.diagnosis(level=Level.WARN, word="no pose")
    assert not bench.contacts


def nan_pose(stamp):
    message = pose(stamp, T_CAMERA_JAW @ cylinder_before_jaw())
    message.pose.position.y = float("nan")
    return message


def unset_quaternion(stamp):
    message = pose(stamp, T_CAMERA_JAW @ cylinder_before_jaw())
    message.pose.orientation.w = message.pose.orientation.x = 0.0
    message.pose.orientation.y = message.pose.orientation.z = 0.0
    return message


WRONG = {
    "nan": (nan_pose, "finite"),
    "quaternion": (unset_quaternion, "norm"),
    "frame": (lambda stamp: pose(stamp, np.eye(4), "base_link"), "base_link"),
    "around the camera": (lambda stamp: pose(stamp, np.eye(4)), "camera"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_bad_object_pose_is_named_and_the_node_lives_on(probe, name):
    make, word = WRONG[name]
    bench = ContactBench(probe)
    bench.object_out.publish(make(time_ns()))
    bench.diagnosis(level=Level.ERROR, word=word)
    assert not bench.contacts
    bench.image(cylinder_before_jaw())
    assert bench.wait_for_contacts().width > 0


@pytest.mark.parametrize("name", ["nan", "quaternion", "frame"])
def test_a_bad_jaw_pose_is_named_and_the_node_lives_on(probe, name):
    make, word = WRONG[name]
    bench = ContactBench(probe)
    bench.jaw_out.publish(make(time_ns()))
    bench.diagnosis(level=Level.ERROR, word=word)
    bench.image(cylinder_before_jaw())
    assert bench.wait_for_contacts().width > 0


def test_an_object_around_the_jaw_gives_no_contact(probe):
    bench = ContactBench(probe)
    around = np.eye(4)
    around[:3, 3] = 0.007, 0.0, 0.04
    around[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # the cylinder along the jaw, half of which is in it
    bench.image(around)
    bench.diagnosis(level=Level.WARN, word="around the jaw")
    assert not bench.contacts


def test_old_poses_give_no_contact(probe):
    bench = ContactBench(probe)
    bench.image(cylinder_before_jaw(), time_ns() - 10 * SECOND)
    bench.diagnosis(level=Level.STALE, word="old")
    assert not bench.contacts


def test_a_contact_that_comes_too_late_is_not_published(probe, monkeypatch):
    bench = ContactBench(probe, max_age=0.1)
    jaw = bench.node.session.jaws["left"]
    take = jaw.take_jaw_pose

    def slow(stamp, T_camera_jaw):
        answer = take(stamp, T_camera_jaw)
        while time_ns() - stamp < 0.15 * SECOND:
            pass
        return answer

    monkeypatch.setattr(jaw, "take_jaw_pose", slow)
    bench.image(cylinder_before_jaw())
    bench.diagnosis(level=Level.STALE, word="old")
    assert jaw.loop.last is not None and not bench.contacts


def test_a_surface_of_another_mesh_is_named(probe):
    bench = ContactBench(probe, **{"contact.mode": "paper"})
    out = probe.speak("left/surface", PointCloud2)
    probe.connected(out)
    stamp = time_ns()
    out.publish(ros.cloud_message(header(stamp, "left_jaw"), ros.xyz_columns(np.zeros((7, 3)))))
    bench.diagnosis(level=Level.ERROR, word="deformed surface of shape (7, 3)")


@pytest.mark.parametrize(("mode", "ears"), [("estimate", 0), ("closest", 0), ("paper", 1)])
def test_only_the_papers_method_hears_the_solver(probe, mode, ears):
    ContactBench(probe, **{"contact.mode": mode})
    surface, wrench = probe.speak("left/surface", PointCloud2), probe.speak("left/wrench", WrenchStamped)
    probe.wait_for(lambda: surface.get_subscription_count() == ears)
    assert wrench.get_subscription_count() == 0


def test_stamps_that_go_back_begin_anew(probe):
    bench = ContactBench(probe, max_age=30.0)
    stamp = bench.image(cylinder_before_jaw())
    bench.wait_for_contacts()
    bench.jaw_out.publish(pose(stamp - 10 * SECOND, T_CAMERA_JAW))
    bench.diagnosis(level=Level.WARN, word="no pose")
    bench.image(cylinder_before_jaw(), stamp - 9 * SECOND)
    assert stamp_of(bench.wait_for_contacts(2)) == stamp - 9 * SECOND


def set_parameter(bench, name, value):
    (answer,) = bench.node.set_parameters([Parameter(name, value=value)])
    return answer


def test_a_mesh_is_loaded_by_service(probe):
    bench = ContactBench(probe, object_mesh="")
    assert set_parameter(bench, "object_mesh", MESH).successful
    answer = call(probe, "contact_estimator/load_mesh")
    assert answer.success and "cylinder_25.stl" in answer.message and "watertight" in answer.message
    bench.image(cylinder_before_jaw())
    assert bench.wait_for_contacts().width > 0


def test_a_mesh_that_cannot_be_loaded_leaves_the_object_unknown(probe, tmp_path):
    bench = ContactBench(probe)
    broken = tmp_path / "broken.stl"
    broken.write_text("solid nothing")
    assert set_parameter(bench, "object_mesh", str(broken)).successful
    answer = call(probe, "contact_estimator/load_mesh")
    assert not answer.success and "broken.stl" in answer.message
    bench.image(cylinder_before_jaw())
    assert bench.wait_for_contacts().width == 0
    bench.diagnosis(level=Level.ERROR, word="broken.stl")


def test_an_empty_name_makes_the_object_unknown(probe):
    bench = ContactBench(probe)
    assert set_parameter(bench, "object_mesh", "").successful
    answer = call(probe, "contact_estimator/load_mesh")
    assert answer.success and "unknown" in answer.message
    bench.image(cylinder_before_jaw())
    assert bench.wait_for_contacts().width == 0


def test_long_work_holds_up_no_contact(probe, monkeypatch):
    bench = ContactBench(probe)
    done = Event()
    monkeypatch.setattr(bench.node.session, "reconstruct", lambda parameters: str(done.wait(30.0)))
    client = probe.create_client(Trigger, "contact_estimator/reconstruct")
    probe.wait_for(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    probe.spin(0.1)
    bench.image(cylinder_before_jaw())
    assert bench.wait_for_contacts().width > 0 and not future.done()
    done.set()
    probe.wait_for(future.done)
    assert future.result().success and future.result().message == "True"


def test_a_wrong_unit_is_refused_with_the_answer(probe):
    bench = ContactBench(probe)
    assert set_parameter(bench, "object_mesh_unit", "furlong").successful
    answer = call(probe, "contact_estimator/load_mesh")
    assert not answer.success and "furlong" in answer.message


def test_a_mesh_that_is_not_there_at_the_start_does_not_end_the_node(probe):
    bench = ContactBench(probe, object_mesh="no_such_file.stl")
    bench.image(cylinder_before_jaw())
    assert bench.wait_for_contacts().width == 0
    bench.diagnosis(level=Level.ERROR, word="no_such_file.stl")


def test_what_is_fixed_cannot_be_set(probe):
    bench = ContactBench(probe)
    assert not set_parameter(bench, "jaw_file", "steel").successful


def test_reset_forgets_the_pose(probe):
    bench = ContactBench(probe)
    bench.image(cylinder_before_jaw())
    bench.wait_for_contacts()
    assert call(probe, "contact_estimator/reset").success
    probe.got["/diagnostics"].clear()
    bench.jaw_out.publish(pose(time_ns(), T_CAMERA_JAW))
    bench.diagnosis(level=Level.WARN, word="no pose")
    assert len(bench.contacts) == 1


def test_work_and_state_are_in_the_diagnostics(probe):
    bench = ContactBench(probe)
    bench.image(cylinder_before_jaw())
    bench.wait_for_contacts()
    probe.got["/diagnostics"].clear()
    values = {entry.key: entry.value for entry in bench.diagnosis(level=Level.OK).values}
    assert values["work"] == "1 solved"
    assert values["status"] == "apart" and float(values["pose age [ms]"]) == 0.0


def test_two_jaws_of_one_object_are_estimated_by_one_node(probe):
    both = ContactBench(probe, jaws="both")
    probe.hear("right/contact", PointCloud2)
    right = probe.speak("right/jaw_pose", PoseStamped)
    probe.connected(right)
    probe.wait_for(lambda: both.node.out.contact["right"].get_subscription_count() == 1)
    # the right jaw stands opposite, turned by 180 degrees about z, 55 mm away: the object is between
    T_left_right = np.diag([-1.0, -1.0, 1.0, 1.0])
    T_left_right[0, 3] = 0.055
    stamp = both.image(cylinder_before_jaw())
    right.publish(pose(stamp, T_CAMERA_JAW @ T_left_right))
    both.wait_for_contacts()
    probe.wait_for(lambda: probe.got["right/contact"])
    assert probe.got["right/contact"][-1].header.frame_id == "right_jaw"
    (z,) = columns(probe.got["right/contact"][-1], "z")
    np.testing.assert_allclose(z, 0.04, atol=5e-4)


def test_detections_without_their_message_type_say_what_to_install(probe):
    with pytest.raises(ImportError, match="ros-jazzy-vision-msgs"):
        ContactBench(probe, pose_source="detections")


def test_the_camera_frame_is_a_parameter(probe):
    bench = ContactBench(probe, camera_frame="wrist")
    bench.jaw_out.publish(pose(time_ns(), T_CAMERA_JAW))
    bench.diagnosis(level=Level.ERROR, word=f"'{CAMERA}'; expected 'wrist'")


def test_object_poses_of_two_nodes_are_refused_with_their_names(probe):
    bench = ContactBench(probe)
    first = bench.image(cylinder_before_jaw())
    bench.wait_for_contacts()
    tracker = rclpy.create_node("tracker", context=probe.context)
    tracker.create_publisher(PoseStamped, "object_pose", 1)
    probe.wait_for(lambda: bench.node.count_publishers("object_pose") == 2)
    for _ in range(3):
        bench.image(cylinder_before_jaw())
    assert bench.diagnosis(Level.ERROR, "/object_pose is published by /probe and /tracker; expected one")
    assert bench.node.session.pose.stamp == pytest.approx(1e-9 * first, abs=1e-3)
    tracker.destroy_node()
