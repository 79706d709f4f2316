"""Claims about poses as FoundationPose's ROS nodes publish them; run by test_pose_detections.py, with vision_msgs."""

from time import time_ns

import numpy as np
import pytest
import trimesh
from contact_node_fakes import (
    CAMERA,
    MESH,
    RADIUS,
    SECOND,
    T_CAMERA_JAW,
    cylinder_before_jaw,
    header,
    pose,
    start_contact_estimator,
)
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from vision_msgs.msg import BoundingBox3D, Detection3D, Detection3DArray

from finforce.messages import stamp_of
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.messages import outline_from_cloud

FRAME = SECOND // 30
TRACKED_EVERY = 3  # images: 10 Hz
NOISE = 0.3e-3  # [m]
FLIPS = [Rotation.from_rotvec(turn).as_matrix() for turn in ([np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi], [0, 2.0, 0])]


class Tracker:
    """Publishes as isaac_ros_foundationpose does: reliable, 10 Hz, late, the pose in bbox.center, no results.

    Args:
        probe: that publishes.
        topic: of the detections.
        late: least and greatest delay [s].
        flips: share of the poses that are turned by something that maps the object onto itself.
        lost: between these times [s] nothing is published; after them it comes later for once, as it registers anew.
    """

    def __init__(self, probe, topic="object_detections", late=(0.1, 0.2), flips=0.0, lost=(9.0, 9.0)):
        self._random, self._late, self._flips, self._lost = np.random.default_rng(1), late, flips, lost
        self.out = probe.create_publisher(Detection3DArray, topic, QoSProfile(depth=10))
        self._coming = []

    def see(self, t, stamp, T):
        """See an image at t [s] in which the object is at T (4, 4)."""
        if self._lost[0] <= t < self._lost[1]:
            return
        seen = T.copy()
        seen[:3, 3] += NOISE * self._random.standard_normal(3)
        if self._random.random() < self._flips:
            seen[:3, :3] = seen[:3, :3] @ FLIPS[self._random.integers(len(FLIPS))]
        self._coming.append((t + self._random.uniform(*self._late), stamp, seen))

    def publish(self, t):
        """Publish what is ready at t [s]."""
        for ready in [entry for entry in self._coming if entry[0] <= t]:
            self._coming.remove(ready)
            _, stamp, T = ready
            box = BoundingBox3D(center=pose(stamp, T).pose)
            box.size.x = box.size.z = 2.0 * RADIUS
            box.size.y = 0.06
            self.out.publish(Detection3DArray(header=header(stamp, CAMERA), detections=[Detection3D(bbox=box)]))


class Course:
    """A jaw that nears an object at a speed [m/s], image after image; what the contact estimator says of each.

    `found` and `true` are the object's x and z in the jaw's frame [m], by image, NaN where nothing was said.
    """

    def __init__(
        self, probe, tracker, *, seconds=3.0, speed=0.0, object_at=lambda t: cylinder_before_jaw(0.02), **parameters
    ):
        given = {"pose_source": "detections", "jaws": "left", "max_age": 60.0, "skip_off": ["all"], **parameters}
        self.node, jaw = start_contact_estimator(probe, **given), load_jaw("bench")
        probe.hear("left/contact", PointCloud2)
        probe.hear("left/object_outline", PointCloud2)
        jaw_out = probe.speak("left/jaw_pose", PoseStamped)
        probe.connected(jaw_out)
        probe.connected(tracker.out)
        assert jaw.side == "left"
        count = round(seconds * 30)
        start = time_ns() - count * FRAME  # none is of the future, however fast they follow each other
        self.seconds, self.true, self.found = (
            np.arange(count) / 30.0,
            np.full((count, 2), np.nan),
            np.full((count, 2), np.nan),
        )
        for number, t in enumerate(self.seconds):
            stamp, T_camera_object = start + number * FRAME, T_CAMERA_JAW @ object_at(t)
            T_camera_jaw = T_CAMERA_JAW.copy()
            T_camera_jaw[:3, 3] += T_camera_jaw[:3, 0] * speed * t
            self.true[number] = (np.linalg.inv(T_camera_jaw) @ T_camera_object)[[0, 2], 3]
            if number % TRACKED_EVERY == 0:
                tracker.see(t, stamp, T_camera_object)
            tracker.publish(t)
            probe.spin(0.002)
            jaw_out.publish(pose(stamp, T_camera_jaw))
            probe.spin(0.004)
        heard = -1
        while heard != len(probe.got["left/contact"]):  # a busy machine is late
            heard = len(probe.got["left/contact"])
            probe.spin(0.3)
        outlines = {stamp_of(cloud): cloud for cloud in probe.got["left/object_outline"]}
        last = None
        for number in range(count):
            cloud = outlines.get(start + number * FRAME)
            last = None if cloud is None else outline_from_cloud(cloud, "left_jaw", last)
            if last is not None:
                self.found[number] = last.origin

    @property
    def error(self):
        """Distance of the object from where it is said to be [m], by image."""
        return np.linalg.norm(self.found - self.true, axis=1)


def test_late_poses_are_carried_forward_by_the_jaws_own_motion(probe):
    course = Course(probe, Tracker(probe), speed=0.006)
    said = np.isfinite(course.error)
    assert said[course.seconds > 0.3].mean() > 0.95  # from the first pose that has come
    settled = course.error[course.seconds > 1.5]
    assert np.median(settled) < 0.5e-3  # 200 ms of the jaw's way would be 1.2 mm


def test_flips_of_an_object_that_looks_the_same_turned_do_no_harm(probe):
    course = Course(probe, Tracker(probe, flips=0.5), seconds=4.0)
    assert np.nanmax(course.error[course.seconds > 1.0]) < 1e-3
    counts = course.node.session.jaws["left"].loop.estimator.counts
    assert counts["odd pose"] <= 1  # of forty; half of them are turned


def test_a_tracker_that_lost_the_object_is_waited_for_and_found_again_elsewhere(probe):
    moved = lambda t: cylinder_before_jaw(0.02, 0.03 if t < 2.0 else 0.05)  # noqa: E731 - one line
    course = Course(probe, Tracker(probe, lost=(1.5, 4.0)), seconds=6.0, object_at=moved)
    said = np.isfinite(course.error)
    assert not said[(course.seconds > 2.8) & (course.seconds < 4.0)].any()  # a second after the last pose
    again = course.seconds[(course.seconds > 4.0) & said]
    assert again[0] < 4.5  # the first late pose, and an image
    assert np.nanmedian(course.error[course.seconds > 4.5]) < 1e-3


def test_an_empty_list_is_no_pose(probe):
    tracker = Tracker(probe)
    tracker.publish = lambda t: tracker.out.publish(Detection3DArray(header=header(time_ns(), CAMERA)))
    assert np.isnan(Course(probe, tracker, seconds=0.3).found).all()


@pytest.mark.parametrize(("origin", "times"), [("mesh", 0.0), ("middle", 1.0), ("added", 2.0)])
def test_poses_of_another_origin_are_put_right(probe, tmp_path, origin, times):
    away = np.array([0.01, 0.0, 0.02])
    mesh = trimesh.load(MESH)
    mesh.apply_translation(away)
    mesh.export(tmp_path / "aside.stl")
    tracker = Tracker(probe, late=(0.0, 0.0))

    def place(t):
        T = cylinder_before_jaw(0.02)
        T[:3, 3] -= T[:3, :3] @ away  # of the mesh's own origin
        return T

    see = tracker.see
    tracker.see = lambda t, stamp, T: see(t, stamp, T @ shift(times * away))
    course = Course(
        probe, tracker, seconds=1.0, object_at=place, object_mesh=str(tmp_path / "aside.stl"), pose_origin=origin
    )
    assert np.nanmedian(course.error) < 1e-3


def shift(way):
    T = np.eye(4)
    T[:3, 3] = way
    return T
