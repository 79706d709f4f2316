"""A key point detector node on a probe's domain, a camera that feeds it, and a detector that answers by rule."""

import array
from dataclasses import dataclass, field
from time import sleep, time_ns

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_msgs.msg import Header

from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC, OLD_COLOR_TOPIC
from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce.messages import NOTHING_SHARED, SharedStddev
from finforce.ros import node as ros
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.images import ImageWatch, check_image
from finforce_keypoints.node import KeypointDetectorNode
from finforce_keypoints.parameters import DetectorParameters

FRAME = "camera_color_optical_frame"
TOPICS = DetectorParameters(color_topics=(COLOR_TOPIC, OLD_COLOR_TOPIC), depth_topic=DEPTH_TOPIC, info_topic=INFO_TOPIC)
COLOR, OLD_COLOR = TOPICS.color_topics
WIDTH, HEIGHT = 64, 48
MILLISECOND = 1_000_000
JAW = load_jaw("bench")
COUNT = len(JAW.keypoints)


@dataclass
class FakeKeypoints:
    """Key points of one jaw, with the attributes of `JawKeypoints`."""

    stamp: float = 0.0
    points: np.ndarray = field(default_factory=lambda: JAW.keypoints.copy())
    likelihood: np.ndarray = field(default_factory=lambda: np.linspace(0.7, 0.98, COUNT))
    pixels: np.ndarray = field(default_factory=lambda: np.linspace((5.0, 6.0), (50.0, 40.0), COUNT))
    valid: np.ndarray = field(default_factory=lambda: np.ones(COUNT, dtype=bool))
    stddev: np.ndarray = field(default_factory=lambda: np.tile((1e-4, 2e-4, 3e-4), (COUNT, 1)))
    T_camera_jaw: np.ndarray = field(default_factory=lambda: jaw_in_camera(ROBOT_CAMERA, "left", -0.04))
    reasons: np.ndarray = field(default_factory=lambda: np.full(COUNT, "", dtype=object))
    shared: SharedStddev = NOTHING_SHARED


class FakeDetector:
    """Finds the same key points in every image, or raises what it is told to."""

    def __init__(self, sides):
        self.answer = {side: FakeKeypoints() for side in sides}
        self.images, self.looks, self.resets, self.error, self.delay = [], [], 0, None, 0.0
        self.warnings, self.warmed, self.was_still = {}, False, False
        self.name, self.sha256 = "fake", "ab12"
        self.watch = ImageWatch()

    def detect_color(self, image):
        self.looks.append(image)

    def detect(self, image):
        check_image(image)
        self.watch.check(image)
        self.images.append(image)
        sleep(self.delay)
        if self.error is not None:
            raise self.error
        return self.answer

    def reset(self):
        self.resets += 1

    def warm_up(self):
        self.warmed = True

    def adjust(self, settings):
        self.settings = settings


def start_detector(probe, pipeline=None, **parameters):
    """Add a detector node around a fake detector, of a pipeline or alone, to the probe's executor."""
    # a loaded machine is late: neither is an image old then, nor a node silent
    given = {"diagnostics_period": 0.1, "max_age": 3.0, **parameters}
    overrides = [Parameter(name, value=value) for name, value in given.items()]

    def build(jaws, *_, **__):
        return FakeDetector(tuple(jaws))

    node = KeypointDetectorNode(build, pipeline, context=probe.context, parameter_overrides=overrides)
    probe.spinner.add_node(node)
    return node


def start_real_detector(probe, **parameters):
    """Add a detector node with all its parts to the probe's executor."""
    given = {"diagnostics_period": 0.1, "max_age": 3.0, **parameters}
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    node = KeypointDetectorNode(context=probe.context, parameter_overrides=overrides)
    probe.spinner.add_node(node)
    return node


def info_of(camera):
    """The CameraInfo of intrinsics."""
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    return CameraInfo(
        header=header(0),
        width=camera.width,
        height=camera.height,
        distortion_model="plumb_bob",
        d=list(camera.distortion),
        k=k,
    )


def header(stamp, frame=FRAME):
    return Header(stamp=ros.stamp_message(stamp), frame_id=frame)


def camera_info(width=WIDTH, height=HEIGHT, **changes):
    k = [60.0, 0.0, width / 2, 0.0, 60.0, height / 2, 0.0, 0.0, 1.0]
    given = {"distortion_model": "plumb_bob", "d": [-0.05, 0.06, 0.001, 0.0003, -0.02], **changes}
    return CameraInfo(header=header(0), width=width, height=height, k=k, **given)


def image_of(stamp, picture, encoding, frame=FRAME):
    """An Image of an array, whatever its encoding says."""
    height, width = picture.shape[:2]
    return Image(
        header=header(stamp, frame),
        height=height,
        width=width,
        encoding=encoding,
        step=picture.nbytes // height,
        data=array.array("B", picture.tobytes()),
    )


class CameraBench:
    """A camera before a detector node, and what the node says."""

    def __init__(
        self, probe, *, color_topic=COLOR, info=True, heard=True, start=start_detector, qos=ros.RESULT, **parameters
    ):
        self.probe = probe
        self.rng = np.random.default_rng(7)
        self.node = start(probe, **parameters)
        sides = self.node.parameters.sides
        for side in sides if heard else ():
            probe.hear(f"{side}/keypoints", PointCloud2)
            probe.hear(f"{side}/jaw_pose", PoseStamped)
        self.color_out = probe.speak(color_topic, Image, qos)
        self.depth_out = probe.speak(TOPICS.depth_topic, Image, qos)
        self.info_out = probe.speak(TOPICS.info_topic, CameraInfo, qos)
        for publisher in (self.color_out, self.depth_out, self.info_out):
            probe.connected(publisher)
        outputs = [*self.node.out.keypoints.values(), *self.node.out.pose.values()]
        probe.wait_for(lambda: all(output.get_subscription_count() == heard for output in outputs))
        if info:
            self.send_info()

    def send_info(self, **changes):
        self.info_out.publish(camera_info(**changes))
        self.probe.spin(0.05)

    def picture(self):
        """Another noisy picture each time, as a sensor gives it."""
        return self.rng.integers(90, 160, (HEIGHT, WIDTH, 3), dtype=np.uint8)

    def color(self, stamp, picture=None, encoding="rgb8", **options):
        self.color_out.publish(image_of(stamp, self.picture() if picture is None else picture, encoding, **options))
        self.probe.spin(0.03)

    def depth(self, stamp, picture=None, encoding="16UC1", **options):
        picture = np.full((HEIGHT, WIDTH), 120, dtype=np.uint16) if picture is None else picture
        self.depth_out.publish(image_of(stamp, picture, encoding, **options))
        self.probe.spin(0.03)

    def burst(self, stamps):
        """Send images of several stamps at once, while the node is busy with something else."""
        for stamp in stamps:
            self.color_out.publish(image_of(stamp, self.picture(), "rgb8"))
            self.depth_out.publish(image_of(stamp, np.full((HEIGHT, WIDTH), 120, dtype=np.uint16), "16UC1"))
        sleep(0.05)  # until they have arrived

    def shoot(self, stamp=None, *, color=None, depth=None):
        """Send colour and depth of one stamp, by default now, and return it."""
        stamp = time_ns() if stamp is None else stamp
        self.color(stamp, color)
        self.depth(stamp, depth)
        return stamp

    def clouds(self, side="left"):
        return self.probe.got[f"{side}/keypoints"]

    def poses(self, side="left"):
        return self.probe.got[f"{side}/jaw_pose"]

    def wait_for_clouds(self, count=1, side="left"):
        self.probe.wait_for(lambda: len(self.clouds(side)) >= count and len(self.poses(side)) >= count)
        return self.clouds(side)[-1]

    def diagnosis(self, side="left", level=None, word=""):
        """Wait for a state of a side at a level, with a word in its message."""
        found = []

        def matches():
            states = [s for array in self.probe.got["/diagnostics"] for s in array.status]
            found[:] = [
                s
                for s in states
                if f"{side} key points" in s.name and (level is None or s.level[0] == level) and word in s.message
            ]
            return bool(found)

        self.probe.wait_for(matches)
        return found[-1]

    def refused(self, word, level):
        """Check that nothing was published, that the diagnostics say why, and that the camera can recover."""
        state = self.diagnosis(level=level, word=word)
        assert not self.clouds() and not self.poses()
        return state
