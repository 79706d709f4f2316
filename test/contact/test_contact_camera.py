"""Claims about the contact estimator that finds the object's pose itself, in depth images with masks."""

from time import sleep, time_ns

import numpy as np
import pytest
from contact_node_fakes import CAMERA, MESH, ContactBench, call, cylinder_before_jaw, header, pose
from geometry_msgs.msg import PoseStamped
from rclpy.qos import ReliabilityPolicy
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image
from table_fakes import build_d405

from finforce.health import Level
from finforce.messages import depth_from_message, mask_from_message, stamp_of
from finforce.ros import node as ros
from finforce_contact.mesh.object_mesh import load_object_mesh
from finforce_contact.mesh.views import MeshView

# from above and the side, 0.22 m away, so that the cylinder shows its wall and a lid
T_CAMERA_JAW = np.eye(4)
T_CAMERA_JAW[:3, :3] = Rotation.from_euler("x", 50.0, degrees=True).as_matrix()
T_CAMERA_JAW[:3, 3] = -0.02, 0.0, 0.22
BACKGROUND = 0.5
MAX_AGE = 60.0  # s


@pytest.fixture(scope="module")
def camera():
    return build_d405(step=2)


@pytest.fixture(scope="module")
def scene(camera):
    """Depth [m] and mask of the cylinder before the jaw."""
    view = MeshView(load_object_mesh(MESH)).render(T_CAMERA_JAW @ cylinder_before_jaw(), camera)
    return np.where(np.isnan(view.depth), BACKGROUND, view.depth), np.isfinite(view.depth)


def image(stamp, values, encoding, padding=0):
    rows = np.pad(np.ascontiguousarray(values).view(np.uint8), ((0, 0), (0, padding)))
    height, width = values.shape
    return Image(
        header=header(stamp, CAMERA),
        height=height,
        width=width,
        encoding=encoding,
        step=rows.shape[1],
        data=rows.tobytes(),
    )


def depth_image(stamp, depth):
    return image(stamp, np.round(1e3 * depth).astype(np.uint16), "16UC1")


def mask_image(stamp, mask):
    return image(stamp, 255 * mask.astype(np.uint8), "mono8")


def camera_info(stamp, camera):
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    size = {"width": camera.width, "height": camera.height}
    return CameraInfo(header=header(stamp, CAMERA), distortion_model="plumb_bob", k=k, d=[0.0] * 5, **size)


class TrackingBench(ContactBench):
    """A contact estimator that is fed with images."""

    def __init__(self, probe, camera, *, qos=ros.RESULT, **parameters):
        probe.hear("object_pose", PoseStamped)
        # the first image loads libraries, which takes seconds where other programs have the processor
        super().__init__(probe, pose_source="tracker", max_age=MAX_AGE, **parameters)
        self.camera = camera
        self.info = probe.speak("/camera/camera/color/camera_info", CameraInfo)
        self.depth = probe.speak("/camera/camera/aligned_depth_to_color/image_raw", Image, qos)
        self.mask = probe.speak("object_mask", Image, qos)
        for out in (self.info, self.depth, self.mask):
            probe.connected(out)
        probe.wait_for(lambda: self.node.out.pose.get_subscription_count() == 1)

    def see(self, scene, *, masked):
        """Send one image, each part when the one before has come, the mask last; return its stamp."""
        depth, mask = scene
        feed, stamp = self.node.session.camera, time_ns()
        self.info.publish(camera_info(stamp, self.camera))
        self.probe.wait_for(lambda: self.node.session.stream.camera is not None)
        self.depth.publish(depth_image(stamp, depth))
        self.probe.wait_for(lambda: any(kept.stamp == stamp for kept in feed._images.entries("depth images")))
        if masked:
            self.mask.publish(mask_image(stamp, mask))
        return stamp

    def see_at_once(self, scene, count):
        """Send images while the node is busy with something else; return their stamps once the node had its time."""
        stamps, before = [time_ns() + k * 1_000_000 for k in range(count)], len(self.poses)
        for stamp in stamps:
            self.depth.publish(depth_image(stamp, scene[0]))
        sleep(0.5)  # until they have arrived
        self.probe.wait_for(lambda: len(self.poses) > before)
        self.probe.spin(0.2)
        return stamps

    @property
    def poses(self):
        return self.probe.got["object_pose"]


def test_the_object_is_found_with_a_mask_and_followed_without_until_it_leaves(probe, camera, scene):
    bench = TrackingBench(probe, camera)
    bench.see(scene, masked=False)
    probe.spin(0.2)
    assert not bench.poses
    bench.see((np.zeros_like(scene[0]), scene[1]), masked=True)
    bench.diagnosis(level=Level.ERROR, word="depth")
    assert not bench.poses
    stamp = bench.see(scene, masked=True)
    probe.wait_for(lambda: bench.poses, MAX_AGE)
    found = bench.poses[0]
    assert stamp_of(found) == stamp and found.header.frame_id == CAMERA
    place = found.pose.position
    expected = (T_CAMERA_JAW @ cylinder_before_jaw())[:3, 3]
    np.testing.assert_allclose([place.x, place.y, place.z], expected, atol=1.5e-3)  # 1 mm steps of the depth
    stamp = bench.see(scene, masked=False)
    probe.wait_for(lambda: len(bench.poses) == 2)
    assert stamp_of(bench.poses[1]) == stamp
    bench.jaw_out.publish(pose(stamp, T_CAMERA_JAW))
    assert bench.wait_for_contacts().width > 0
    values = {entry.key: entry.value for entry in bench.diagnosis(level=Level.OK).values}
    assert values["pose source"] == "tracker" and 0.5 < float(values["pose fitness"]) <= 1.0
    assert bench.see_at_once(scene, 4)[-1:] == [stamp_of(found) for found in bench.poses[2:]]
    bench.see((np.full_like(scene[0], BACKGROUND), scene[1]), masked=False)
    bench.diagnosis(level=Level.ERROR, word="not found")
    assert len(bench.poses) == 3


def test_a_mask_with_nothing_in_it_is_named(probe, camera, scene):
    bench = TrackingBench(probe, camera)
    bench.see((scene[0], np.zeros_like(scene[1])), masked=True)
    bench.diagnosis(level=Level.ERROR, word="mask")
    assert not bench.poses and not bench.contacts


def test_images_before_their_camera_are_named(probe, camera, scene):
    bench = TrackingBench(probe, camera)
    stamp = time_ns()
    bench.depth.publish(depth_image(stamp, scene[0]))
    probe.spin(0.1)
    bench.mask.publish(mask_image(stamp, scene[1]))
    bench.diagnosis(level=Level.ERROR, word="camera_info")


def test_reconstruct_finds_the_object_in_the_image(probe, camera, scene):
    bench = TrackingBench(probe, camera, object_mesh="")
    answer = call(probe, "contact_estimator/reconstruct")
    assert not answer.success and "no depth image" in answer.message
    bench.see(scene, masked=True)
    probe.wait_for(lambda: bench.node.session.camera._images.entries("masks"))
    answer = call(probe, "contact_estimator/reconstruct")
    assert answer.success and "primitive" in answer.message, answer.message
    size = np.sort(np.ptp(bench.node.session.mesh.vertices, axis=0))
    # the lid that is seen gives the diameter; the far end of the wall is beyond the outline
    np.testing.assert_allclose(size[:2], 0.025, atol=3e-3)
    bench.see(scene, masked=True)
    probe.wait_for(lambda: bench.poses, MAX_AGE)


def test_reconstruct_without_a_camera_says_so(probe):
    ContactBench(probe)
    answer = call(probe, "contact_estimator/reconstruct")
    assert not answer.success and "pose_source" in answer.message


def test_padded_rows_and_metres_decode_alike(camera, scene):
    depth, mask = scene
    plain = depth_from_message(depth_image(0, depth))
    metres = depth_from_message(image(0, depth.astype(np.float32), "32FC1", padding=12))
    np.testing.assert_allclose(plain, metres, atol=5.1e-4)  # half a step
    padded = mask_from_message(image(0, 255 * mask.astype(np.uint8), "mono8", padding=5))
    np.testing.assert_array_equal(padded, mask)


@pytest.mark.parametrize(("encoding", "word"), [("rgb8", "rgb8"), ("mono8", "rows")])
def test_a_mask_of_another_kind_is_refused(scene, encoding, word):
    message = image(0, scene[1].astype(np.uint8), encoding)
    message.height += 1
    with pytest.raises(ValueError, match=word):
        mask_from_message(message)


def test_images_are_asked_for_reliably_and_those_of_best_effort_are_taken_too(probe, camera, scene):
    bench = TrackingBench(probe, camera, qos=ros.SENSOR, object_mesh="")
    topics = ("/camera/camera/aligned_depth_to_color/image_raw", "/object_mask")

    def reliability(topic):
        return probe.get_subscriptions_info_by_topic(topic)[0].qos_profile.reliability

    probe.wait_for(lambda: all(reliability(topic) == ReliabilityPolicy.BEST_EFFORT for topic in topics))
    bench.see(scene, masked=True)
    probe.wait_for(lambda: bench.node.session.camera._images.entries("masks"))


def test_large_images_come_again_where_their_publisher_keeps_them(probe, camera):
    TrackingBench(probe, camera)
    for topic in ("/camera/camera/aligned_depth_to_color/image_raw", "/object_mask"):
        (heard,) = probe.get_subscriptions_info_by_topic(topic)
        assert heard.qos_profile.reliability == ReliabilityPolicy.RELIABLE


class ComparedBench(ContactBench):
    """A contact estimator whose poses come by topic, before a depth camera."""

    def __init__(self, probe, camera, **parameters):
        super().__init__(probe, max_age=MAX_AGE, **parameters)
        self.info = probe.speak("/camera/camera/color/camera_info", CameraInfo)
        self.depth = probe.speak("/camera/camera/aligned_depth_to_color/image_raw", Image)
        probe.connected(self.info)
        self.camera = camera

    def show(self, depth, until):
        """Send images with their poses until something is so."""

        def shown():
            stamp = time_ns()
            self.info.publish(camera_info(stamp, self.camera))
            self.depth.publish(depth_image(stamp, depth))
            self.object_out.publish(pose(stamp, T_CAMERA_JAW @ cylinder_before_jaw()))
            self.jaw_out.publish(pose(stamp, T_CAMERA_JAW))
            self.probe.spin(0.05)
            return until()

        self.probe.wait_for(shown, 60.0)


@pytest.fixture(scope="module")
def lying_mesh(tmp_path_factory):
    """The cylinder with its axes turned."""
    import trimesh

    mesh = trimesh.load(MESH)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    path = tmp_path_factory.mktemp("meshes") / "lying.stl"
    mesh.export(path)
    return str(path)


def test_a_mesh_with_turned_axes_gives_no_contact_and_is_named(probe, camera, scene, lying_mesh):
    bench = ComparedBench(probe, camera, object_mesh=lying_mesh)
    session = bench.node.session
    loop = session.jaws["left"].loop
    bench.show(scene[0], lambda: loop.estimate is not None and loop.estimate.status == "contradicted")
    state = bench.diagnosis(level=Level.WARN, word="turned by")
    assert "the camera contradicts the mesh" in {value.key: value.value for value in state.values}["mesh"]
    bench.contacts.clear()
    bench.image(cylinder_before_jaw())
    probe.spin(0.3)
    assert not bench.contacts


def test_the_right_mesh_is_compared_and_goes_on_giving_contacts(probe, camera, scene):
    bench = ComparedBench(probe, camera)
    bench.show(scene[0], lambda: bench.node.session.check.compared >= 3)
    assert bench.node.session.check.contradiction == ""
    bench.diagnosis(level=Level.OK)
    bench.wait_for_contacts()


def test_the_comparison_can_be_turned_off(probe, lying_mesh):
    assert ContactBench(probe, object_mesh=lying_mesh, compare_mesh=False).node.session.check is None
