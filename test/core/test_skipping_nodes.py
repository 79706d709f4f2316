"""Claims about what solver and contact estimator leave out while they run, and that all of it comes back in time."""

from time import time_ns

import numpy as np
import pytest
from contact_node_fakes import (
    T_CAMERA_JAW,
    ContactBench,
    cylinder_before_jaw,
    diagnosis,
    pose,
    start_contact_estimator,
)
from geometry_msgs.msg import WrenchStamped
from keypoint_node_fakes import start_detector
from node_fakes import FakeEstimator, keypoint_cloud, ros_domain, start_solver
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger

from finforce.health import ALL, IDLE, UNHEARD, Level
from finforce.ros.topics import Pipeline

TENTH = 100_000_000
AWAY_GAP, NEAR_GAP = 0.03, 0.001
TENTHS = 10  # of a second that the object is away


class Resting(FakeEstimator):
    """Answers as an unloaded jaw whose object is out of reach, and counts how often its surface is asked for."""

    def __init__(self, is_idle=True):
        super().__init__(status="unloaded", force=(0.0, 0.0, 0.0))
        self.is_idle, self.shown = is_idle, 0

    def surface(self):
        self.shown += 1
        return super().surface()


def counted(node, rule):
    return node.skips.describe()[f"skipped: {rule}"]


class TestSolver:
    def send(self, probe, node, out, stamps):
        for stamp in stamps:
            before = node.health["left"]._arrived
            out.publish(keypoint_cloud(stamp))
            probe.wait_for(lambda before=before: node.health["left"]._arrived > before)

    def begin(self, probe, estimator, *topics, **parameters):
        for topic in topics:
            probe.hear(topic, PointCloud2 if topic.endswith("surface") else WrenchStamped)
        node = start_solver(probe, estimator, max_age=10.0, **parameters)
        out = probe.speak("left/keypoints")
        probe.connected(out)
        # from the beginning of a period on
        return node, out, (time_ns() // TENTH + 1) * TENTH

    def test_an_idle_jaw_answers_ten_images_a_second_with_their_own_stamps(self, probe):
        node, out, first = self.begin(probe, Resting(), "left/wrench")
        stamps = [first + TENTH * k // 3 for k in range(9)]
        self.send(probe, node, out, stamps)
        probe.wait_for(lambda: len(probe.got["left/wrench"]) == 3)
        heard = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in probe.got["left/wrench"]]
        assert heard == stamps[::3]
        assert counted(node, IDLE) == "6"

    @pytest.mark.parametrize(("is_idle", "off"), [(False, ""), (True, IDLE), (True, ALL)])
    def test_a_jaw_that_is_not_idle_or_may_not_be_answers_every_image(self, probe, is_idle, off):
        node, out, first = self.begin(probe, Resting(is_idle), "left/wrench", skip_off=[off])
        self.send(probe, node, out, [first + TENTH * k // 3 for k in range(9)])
        probe.wait_for(lambda: len(probe.got["left/wrench"]) == 9)

    def test_the_first_image_in_which_something_happens_ends_it(self, probe):
        estimator = Resting()
        node, out, first = self.begin(probe, estimator, "left/wrench")
        self.send(probe, node, out, [first, first + TENTH // 3])
        estimator.is_idle = False
        self.send(probe, node, out, [first + TENTH + TENTH * k // 3 for k in range(3)])
        probe.wait_for(lambda: len(probe.got["left/wrench"]) == 4)

    def test_a_surface_is_made_when_somebody_subscribes(self, probe):
        estimator = Resting(is_idle=False)
        node, out, first = self.begin(probe, estimator)
        self.send(probe, node, out, [first])
        assert estimator.shown == 0 and int(counted(node, UNHEARD)) >= 2
        probe.hear("left/surface", PointCloud2)
        probe.connected(node.out.surface)
        self.send(probe, node, out, [first + TENTH])
        probe.wait_for(lambda: probe.got["left/surface"])
        assert estimator.shown == 1

    def test_without_the_rule_it_is_made_for_nobody(self, probe):
        estimator = Resting(is_idle=False)
        node, out, first = self.begin(probe, estimator, skip_off=[UNHEARD])
        self.send(probe, node, out, [first])
        assert estimator.shown == 1 and counted(node, UNHEARD) == "off"

    def start_tared(self, probe, **parameters):
        """A solver that has its tare, before which somebody says key points."""
        estimator = FakeEstimator()
        node = start_solver(probe, estimator, **{"max_age": 10.0, **parameters})
        estimator.is_taring = False
        return node, probe.speak("left/keypoints")

    def test_it_rests_from_its_tare_on_until_somebody_hears_a_force(self, probe):
        node, out = self.start_tared(probe, peer="right", max_age=1.0)
        probe.wait_for(lambda: not out.get_subscription_count())
        probe.spin(1.5)  # a peer would be missed by now
        probe.got["/diagnostics"].clear()
        probe.diagnosis(level=bytes([Level.OK])[0], word="idle: no subscriber on the wrench")
        probe.hear("grasp_wrench", WrenchStamped)
        probe.connected(out)
        probe.spin(0.3)
        states = [status for array in probe.got["/diagnostics"][-2:] for status in array.status]
        assert not any("no wrench of the right jaw" in status.message for status in states)
        out.publish(keypoint_cloud())
        probe.wait_for(lambda: node.estimator.observations)

    def test_a_reset_begins_a_tare_for_which_it_wakes(self, probe):
        node, out = self.start_tared(probe)
        probe.wait_for(lambda: not out.get_subscription_count())
        node.estimator.is_taring = True
        probe.connected(out)

    def test_a_tare_that_is_asked_for_at_rest_is_made_of_images_that_come_then(self, probe, monkeypatch):
        monkeypatch.setattr("finforce_ifea.node._TARE_TIME", 1.0)
        node, out = self.start_tared(probe)
        probe.wait_for(lambda: not out.get_subscription_count())
        assert node.estimator.interruptions == 1  # when its rest began
        answer = probe.create_client(Trigger, "left/tare").call_async(Trigger.Request())
        probe.connected(out)
        while not answer.done():
            out.publish(keypoint_cloud())
            probe.spin(0.02)
        assert answer.result().success and len(node.estimator.observations) >= 5
        probe.wait_for(lambda: not out.get_subscription_count())

    def test_without_the_rule_it_solves_for_nobody(self, probe):
        node, out = self.start_tared(probe, skip_off=[UNHEARD])
        probe.connected(out)
        probe.spin(0.5)
        out.publish(keypoint_cloud())
        probe.wait_for(lambda: node.estimator.observations)


def test_a_process_hears_no_camera_from_its_tare_on_until_somebody_hears_a_force(probe):
    pipeline, estimator = Pipeline(), FakeEstimator()
    detector = start_detector(probe, pipeline=pipeline, jaws="left")
    solver = start_solver(probe, estimator, pipeline=pipeline, completes_grasp=True)
    pipeline.open()

    def is_filmed():
        return any(subscription.msg_type is Image for subscription in detector.subscriptions)

    probe.spin(0.5)
    assert is_filmed()  # for the tare
    estimator.is_taring = False
    probe.wait_for(lambda: not is_filmed())
    assert not solver.stage.is_needed
    listener = probe.hear("grasp_wrench", WrenchStamped)
    probe.wait_for(is_filmed)
    probe.destroy_subscription(listener)
    probe.wait_for(lambda: not is_filmed())


class TestContactEstimator:
    @pytest.mark.parametrize(("source", "hears"), [("topic", False), ("tracker", True)])
    def test_it_rests_while_nobody_hears_a_contact_unless_it_would_lose_the_object(self, probe, source, hears):
        node = start_contact_estimator(probe, jaws="left", pose_source=source)
        assert not node.stage.is_needed
        probe.wait_for(lambda: probe.count_subscribers("object_mask" if hears else "object_pose") == hears)
        assert probe.count_subscribers("left/jaw_pose") == 0
        diagnosis(probe, "left contact", level=bytes([Level.OK])[0], word="idle: no subscriber on the contact")
        probe.hear("left/contact", PointCloud2)
        probe.wait_for(lambda: probe.count_subscribers("left/jaw_pose") == 1)

    def image(self, bench, gap, stamp, *, tracked=True, late=False):
        """Send an image in which the object's pose may be known, and wait until the node has it."""
        before = bench.node.health["left"]._arrived
        found = pose(stamp, T_CAMERA_JAW @ cylinder_before_jaw(gap=gap))
        if tracked and not late:
            bench.object_out.publish(found)
            bench.probe.spin(0.02)
        bench.jaw_out.publish(pose(stamp, T_CAMERA_JAW))
        bench.probe.wait_for(lambda: bench.node.health["left"]._arrived > before)
        if tracked and late:
            bench.object_out.publish(found)
            bench.probe.spin(0.02)

    def rest(self, bench, images, first, *, late=False):
        """Send images of an object out of reach, 30 a second by their stamps, every third with its pose."""
        for k in range(images):
            self.image(bench, AWAY_GAP, first + TENTH * k // 3, tracked=k % 3 == 1, late=late)
        return first + TENTH * images // 3

    def start(self, probe, **parameters):
        bench = ContactBench(probe, max_age=10.0, **parameters)
        return bench, (time_ns() // TENTH + 1) * TENTH

    @pytest.mark.parametrize("late", [False, True])
    def test_an_object_out_of_reach_is_looked_at_ten_times_a_second(self, probe, late):
        bench, first = self.start(probe)
        self.rest(bench, 3 * TENTHS, first, late=late)
        assert len(bench.contacts) < 1.5 * TENTHS
        assert int(counted(bench.node, IDLE)) > 1.5 * TENTHS
        # its poses are used, though they belong to images that were passed over
        assert bench.node.session.jaws["left"].loop.pose_age() < 0.15

    def test_without_the_rules_every_image_has_its_contact(self, probe):
        bench, first = self.start(probe, skip_off=[ALL])
        self.rest(bench, 12, first)
        bench.wait_for_contacts(11)

    def test_an_object_that_comes_near_is_noticed_within_a_tenth_of_a_second(self, probe):
        bench, first = self.start(probe)
        now = self.rest(bench, 3 * TENTHS, first)
        known = len(bench.contacts)
        for k in range(6):
            self.image(bench, NEAR_GAP, now + TENTH * k // 3)
        bench.probe.spin(0.05)
        assert len(bench.contacts) - known >= 3
        assert not bench.node.session.jaws["left"].loop.is_out_of_reach

    def find_place(self, off):
        """The height [m] at which an object touches that came from afar."""
        with ros_domain() as probe:
            bench, first = self.start(probe, skip_off=[off])
            now = self.rest(bench, 12, first)
            for k in range(15):
                self.image(bench, NEAR_GAP, now + TENTH * k // 3)
            bench.probe.spin(0.05)
            found = bench.node.session.jaws["left"].loop.last.estimate
        return float(np.average(found.contact.points[:, 2], weights=found.contact.weights))

    def test_the_place_is_the_same_with_the_rules_and_without(self):
        places = [self.find_place(off) for off in ("", ALL)]
        # the bound is what the pose filter remembers of poses that it was not asked about in between
        assert places[0] == pytest.approx(places[1], abs=0.2e-3)


def test_one_jaw_alone_has_nothing_of_the_other(probe):
    bench = ContactBench(probe)
    solver = start_solver(probe)
    topics = [name for node in (bench.node, solver) for name, _ in node.get_topic_names_and_types()]
    assert not [name for name in topics if name.startswith("/right")]
    assert [name for name in topics if name.startswith("/left")]
