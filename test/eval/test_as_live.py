"""Claims about `evaluate --as-live`: offline the images are left out that the nodes leave out."""

from dataclasses import replace
from time import time_ns

import numpy as np
import pytest
from eval_fakes import PERIOD, START, FakeContactEstimator, FakeJaw, make_recording
from keypoint_node_fakes import CameraBench
from node_fakes import KEYPOINTS, FakeEstimator, keypoint_cloud, start_solver
from rgbd_fakes import FakeDetector, make_fake_recording

from finforce.health import IDLE, Idling
from finforce.messages import stamp_of
from finforce_contact.loop import GivenContact
from finforce_eval.cli.main import parse
from finforce_eval.cli.twin import write_simulated_recording
from finforce_eval.evaluation.contact_source import RecordedContact
from finforce_eval.evaluation.forces import ImageRun, find_forces
from finforce_eval.evaluation.keypoint_source import detect_keypoints, parse_source
from finforce_eval.evaluation.setup import make_setup
from finforce_eval.recordings.objects import ObjectTrack
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import KeypointTrack
from finforce_ifea.observation import Contact

TENTH = 100_000_000
CONTACT = Contact(points=np.array([[0.014, 0.0, 0.042]]), weights=np.ones(1), free=True)


class IdleAt(FakeEstimator):
    """Finds the jaw at rest in some images, numbered from a stamp [ns] on at thirty a second."""

    def __init__(self, first, images):
        super().__init__(force=(-1.0, 0.0, 0.0))
        self.first, self.images = first, images

    def update(self, observation, contact):
        self.is_idle = round((observation.stamp * 1e9 - self.first) / PERIOD) in self.images
        solution = super().update(observation, contact)
        solution.contact_location = (0.014, 0.0, 0.04)
        return solution


def passed_over(node):
    """How many images a node has passed over."""
    return int(node.skips.describe()[f"skipped: {IDLE}"])


def test_images_that_the_solver_passes_over_have_no_row(probe):
    probe.hear("left/wrench")
    first = (time_ns() // TENTH + 1) * TENTH
    stamps, idle = first + PERIOD * np.arange(18), range(4, 14)
    node = start_solver(probe, IdleAt(first, idle), max_age=10.0)
    out = probe.speak("left/keypoints")
    probe.connected(out)
    for number, stamp in enumerate(stamps.tolist(), 1):
        out.publish(keypoint_cloud(stamp))
        probe.wait_for(lambda n=number: len(probe.got["left/wrench"]) + passed_over(node) == n)
    live = [stamp_of(message) for message in probe.got["left/wrench"]]
    points = np.tile(KEYPOINTS, (len(stamps), 1, 1))
    keypoints = KeypointTrack(stamps_ns=stamps, points=points, likelihood=np.ones(points.shape[:2]))
    recording = make_recording(phases=False)
    recording = replace(recording, jaws={"left": replace(recording.jaw("left"), keypoints=keypoints, truth=None)})
    jaw, source = FakeJaw(keypoints=KEYPOINTS), GivenContact(CONTACT)
    found = find_forces(recording, jaw, source, IdleAt(first, idle), "left", ImageRun(strict=True, as_live=True))
    assert found.stamps_ns.tolist() == live
    assert len(live) < 14 and found.solved.all()
    assert len(find_forces(recording, jaw, source, IdleAt(first, idle), "left", ImageRun(strict=True))) == 18


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return read_recording(write_simulated_recording(make_fake_recording(), tmp_path_factory.mktemp("bags") / "twin"))


class StillAt(FakeDetector):
    """Sees nothing move in some images."""

    still = range(3, 10)

    def detect(self, image):
        self.was_still = len(self.stamps) in self.still
        return super().detect(image)


def test_images_that_the_detector_does_not_send_have_no_key_points(probe, recording):
    stamps = recording.images.stamps_ns
    bench = CameraBench(probe, max_age=10.0)
    shift = time_ns() // TENTH * TENTH - stamps[-1] // TENTH * TENTH  # whole periods
    for number, stamp in enumerate((stamps + shift).tolist()):
        bench.node.detector.was_still = number in StillAt.still
        bench.shoot(stamp)
        probe.wait_for(lambda number=number: len(bench.node.detector.images) > number)
    bench.wait_for_clouds(12 - 5)
    live = [stamp_of(cloud) - shift for cloud in bench.clouds()]
    found = detect_keypoints(recording, StillAt(recording), as_live=True).jaws["left"]
    assert (
        found.keypoints.stamps_ns.tolist()
        == found.pose.stamps_ns.tolist()
        == found.detection.stamps_ns.tolist()
        == live
    )
    assert len(detect_keypoints(recording, StillAt(recording)).jaws["left"].keypoints.stamps_ns) == 12


def test_of_an_object_out_of_reach_the_contact_of_a_tenth_of_a_second_is_kept(monkeypatch):
    monkeypatch.setattr(RecordedContact, "is_out_of_reach", True)
    poses = ObjectTrack(stamps_ns=START + PERIOD * np.arange(12), poses=np.tile(np.eye(4), (12, 1, 1)))
    estimator = FakeContactEstimator()
    source = RecordedContact(estimator, poses, idling=Idling())
    contacts = [source.contact_at(int(stamp)) for stamp in poses.stamps_ns]
    calls = [name for name, *_ in estimator.calls]
    assert calls.count("pose") == 12  # those of images that are passed over, too
    assert calls.count("update") == len(set((poses.stamps_ns // TENTH).tolist())) == len(set(map(id, contacts)))


def test_the_option_reaches_detector_contact_and_solver():
    options = parse(["evaluate", "BAG", "--as-live"])
    assert parse_source(options).as_live and make_setup(options).as_live
    plain = parse(["evaluate", "BAG"])
    assert not parse_source(plain).as_live and not make_setup(plain).as_live
