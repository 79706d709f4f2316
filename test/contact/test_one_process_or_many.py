"""The claim that one process finds what many find: the same forces, bit for bit, of the same messages."""

from time import time_ns

import numpy as np
from contact_node_fakes import T_CAMERA_JAW, header, pose
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2

import finforce as ff
from finforce.ros import node as ros
from finforce.ros.topics import Pipeline
from finforce_contact.node import ContactEstimatorNode
from finforce_ifea.node import IfeaSolverNode

IMAGES = 116
PATIENT = {"max_age": 60.0, "skip_off": ["idle image", "nobody subscribes"]}


class Detector(Node):
    """Says the poses and key points of the left jaw, as a key point detector does."""

    def __init__(self, pipeline, context):
        super().__init__("detector", context=context)
        self.stage = ros.Stage(self, pipeline)
        self.pose = self.stage.publisher(PoseStamped, "left/jaw_pose", ros.RESULT)
        self.cloud = self.stage.publisher(PointCloud2, "left/keypoints", ros.RESULT)

    def say(self, stamp, image):
        self.pose.publish(pose(stamp, T_CAMERA_JAW))
        columns = {**ros.xyz_columns(image.points), "likelihood": image.likelihood.astype(np.float32)}
        ros.send_cloud(self.cloud, header(stamp, "left_jaw"), columns)


def read_images():
    """The demo's grasp as seen by the left jaw: poses of the object that came before each image, and the image."""
    recording = ff.read_recording(ff.DEMO)
    return ff.find_mesh(recording), list(ff.iter_frames(recording, side="left"))[:IMAGES]


def solve(probe, composed, mesh, images, shift):
    """Force, torque and their deviations of every image, by one process or by many."""
    pipeline = Pipeline()

    def build(kind, **given):
        overrides = [Parameter(name, value=value) for name, value in (PATIENT | given).items()]
        return kind(pipeline=pipeline if composed else None, context=probe.context, parameter_overrides=overrides)

    detector = Detector(pipeline if composed else None, probe.context)
    contact = build(
        ContactEstimatorNode,
        jaws="left",
        calibration_file="bench",
        object_mesh=str(mesh),
    )
    solver = build(IfeaSolverNode, contact_timeout=1.0, calibration_file="bench")
    pipeline.open()
    nodes = (detector, contact, solver)
    for node in nodes:
        probe.spinner.add_node(node)
    objects = probe.speak("object_pose", PoseStamped)
    probe.connected(objects)
    probe.wait_for(lambda: detector.cloud.get_subscription_count() and detector.pose.get_subscription_count())
    probe.wait_for(lambda: contact.out.contact["left"].get_subscription_count())
    found = []
    for poses, image in images:
        for stamp, T_jaw_object in poses:
            due = round(1e9 * stamp) + shift
            objects.publish(pose(due, T_CAMERA_JAW @ T_jaw_object))
            probe.wait_for(lambda due=due: (pose := contact.session.pose) and abs(pose.stamp - 1e-9 * due) < 1e-6)
        solver.last = None
        detector.say(round(1e9 * image.stamp) + shift, image)
        probe.wait_for(lambda: solver.last is not None)
        last = solver.last
        found.append([*last.force, *last.torque, *last.force_stddev, last.residual])
    for node in nodes:
        probe.spinner.remove_node(node)
        node.destroy_node()
    return np.array(found)


def test_one_process_and_many_find_the_same_bit_for_bit(probe):
    mesh, images = read_images()
    shift = time_ns() - round(1e9 * images[0][1].stamp)  # the same for both: a force depends on the time between images
    together, apart = (solve(probe, composed, mesh, images, shift) for composed in (True, False))
    assert np.nanmax(np.abs(together[:, 0])) > 0.5  # something is pressed
    np.testing.assert_array_equal(together, apart)
