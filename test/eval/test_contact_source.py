"""Claims about the order in which contact estimator and solver are fed offline."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from eval_fakes import PERIOD, START, FakeContactEstimator, FakeEstimator, FakeJaw, evaluate_recording, make_recording

from finforce.errors import PoseError
from finforce_contact.loop import ForceLoop
from finforce_contact.pose.mesh_check import LEAST_IMAGES, MOST_IMAGES
from finforce_eval.cli.main import parse
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation import check, contact_source
from finforce_eval.evaluation.contact_source import (
    OUTLINED,
    UNCOMPARED,
    UNSEEN,
    RecordedCheck,
    RecordedContact,
    build_source,
)
from finforce_eval.evaluation.setup import read_contacts
from finforce_eval.recordings.objects import ObjectTrack, track_object

CYLINDER = Path(contact_source.__file__).parents[1] / "data" / "objects" / "cylinder_25.stl"


def make_track(*frames):
    """One pose per frame, 40 mm above the clamp and a millimetre higher each."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, 2, 3] = 0.04 + 1e-3 * np.arange(len(frames))
    return ObjectTrack(stamps_ns=START + PERIOD * np.array(frames), poses=poses)


def run(track, *, lost=(), touching=lambda update: True, delay=0):
    recording = make_recording()
    forces = [None if k in lost else force for k, force in enumerate(recording.jaws["left"].truth.force)]
    solver, fake = FakeEstimator(forces), FakeContactEstimator(touching)
    jaw = FakeJaw(keypoints=np.zeros((4, 3)))
    source = RecordedContact(fake, track, delay=delay)
    result = evaluate_recording(recording, jaw, source, solver)
    return result, solver, fake


def kinds(calls):
    return [name for name, *_ in calls]


def test_poses_up_to_an_image_come_before_its_contact_and_later_ones_wait():
    _, _, fake = run(make_track(-2, 0, 2))
    assert kinds(fake.calls)[:6] == ["pose", "pose", "update", "update", "pose", "update"]
    assert len(fake.calls) == 3 + 60


def test_late_poses_come_with_their_own_stamps():
    _, _, fake = run(make_track(-2, 0, 2), delay=2 * PERIOD)
    assert kinds(fake.calls)[:7] == ["pose", "update", "update", "pose", "update", "update", "pose"]
    poses = [call[1] for call in fake.calls if call[0] == "pose"]
    assert poses == pytest.approx([1e-9 * (START + PERIOD * frame) for frame in (-2, 0, 2)], abs=1e-6)


def test_update_is_given_the_surface_of_the_image_before():
    _, solver, fake = run(make_track(0))
    updates = [call for call in fake.calls if call[0] == "update"]
    for count, (_, stamp, surface) in enumerate(updates):
        assert stamp == pytest.approx((START + PERIOD * count) * 1e-9, abs=1e-6)
        # the fake's surface moves by 1 mm with every image that it has seen
        np.testing.assert_allclose(surface[:, 0].max(), 0.014 + 1e-3 * count)
    assert len(solver.contacts) == 60


def test_surface_is_left_alone_where_nobody_looks_at_it(monkeypatch):
    monkeypatch.setattr(FakeContactEstimator, "needs_surface", False)
    _, _, fake = run(make_track(0))
    assert all(call[2] is None for call in fake.calls if call[0] == "update")


def test_image_is_solved_with_the_contact_of_its_own_pose():
    _, solver, _ = run(make_track(0, 5))
    heights = [float(np.average(c.points[:, 2], weights=c.weights)) for c in solver.contacts]
    np.testing.assert_allclose(heights[:7], [0.04] * 5 + [0.041] * 2)


def test_nothing_is_given_to_the_solver_before_the_first_pose():
    result, solver, _ = run(make_track(10))
    assert solver.contacts[:10] == [None] * 10
    assert solver.contacts[10] is not None
    assert result.column("contact_status")[9:11].tolist() == ["no_pose", "touching"]
    assert np.isnan(result.column("contact_height")[:10]).all()
    assert np.isfinite(result.column("contact_height")[10:]).all()


class BentJaw(FakeEstimator):
    """Has no force without a contact, as a jaw that is bent."""

    def update(self, observation, contact):
        solution = super().update(observation, contact)
        return solution if contact is not None else replace(solution, status="no_contact", message="bent")


def test_why_a_bent_jaw_has_no_contact_is_what_the_contact_estimator_says(monkeypatch):
    monkeypatch.setitem(globals(), "FakeEstimator", BentJaw)
    result, *_ = run(make_track(10))
    assert result.column("status")[:10].tolist() == ["no_contact"] * 10
    assert result.column("message")[:10].tolist() == ["no pose yet"] * 10
    assert result.column("message")[10:].tolist() == [""] * 50


def test_touching_is_what_the_solver_says():
    result, *_ = run(make_track(0), lost=range(20), touching=lambda update: update > 40)
    assert result.column("touching").tolist() == [False] * 20 + [True] * 40


def test_times_of_solver_and_contact_are_kept_apart():
    result, *_ = run(make_track(0))
    assert (result.column("contact_ms") > 0).all()
    assert (result.column("step_ms") > 0).all()


def test_late_poses_are_taken_in_their_place():
    recording = make_recording()
    order = np.r_[1, 0, 2 : len(recording.object_pose.stamps_ns)]
    poses = recording.object_pose
    late = replace(
        poses,
        stamps_ns=poses.stamps_ns[order],
        position=poses.position[order] + 1e-3 * order[:, None],
        quaternion=poses.quaternion,
    )
    track = track_object(replace(recording, object_pose=late), "left")
    _, _, fake = run(track)
    stamps = [call[1] for call in fake.calls if call[0] == "pose"]
    assert stamps == sorted(stamps)
    given = [call[2][2, 3] for call in fake.calls if call[0] == "pose"]
    np.testing.assert_allclose(given, 1e-3 * np.arange(len(given)), atol=1e-12)


def test_pose_that_the_estimator_refuses_is_named():
    class Strict(FakeContactEstimator):
        def take_pose(self, stamp, T_jaw_object, covariance=None, *, camera=None):
            raise PoseError(f"the camera at {camera} is inside")

    recording = make_recording()
    source = RecordedContact(Strict(), track_object(recording, "left"))
    jaw = FakeJaw(keypoints=np.zeros((4, 3)))
    with pytest.raises(RecordingError, match=r"case: object pose at 1000.000 s: the camera at \[.*\] is inside"):
        evaluate_recording(recording, jaw, source, FakeEstimator([]))


def test_a_pose_of_the_image_itself_is_used_with_it_whatever_the_date():
    recording = make_recording()
    shift = 1_790_000_000_123_456_789 - START
    track = ObjectTrack(stamps_ns=START + shift + PERIOD * np.arange(9), poses=np.tile(np.eye(4), (9, 1, 1)))
    fake = FakeContactEstimator()
    loop = ForceLoop(RecordedContact(fake, track), FakeEstimator(np.zeros((9, 3))))
    for count in range(9):
        observation = recording.jaws["left"].keypoints.observation(count)
        loop.update(replace(observation, stamp=1e-9 * (START + shift + PERIOD * count)))
        assert kinds(fake.calls).count("pose") == count + 1


@pytest.mark.parametrize(("words", "compared"), [([], 1), (["--no-compare-mesh"], 0)])
def test_the_mesh_is_compared_with_the_images_unless_that_is_switched_off(words, compared, monkeypatch):
    calls = []
    estimator = FakeContactEstimator()
    estimator.mesh = None
    monkeypatch.setattr(contact_source, "build_estimator", lambda *arguments: estimator)
    monkeypatch.setattr(contact_source, "check_mesh", lambda *arguments: calls.append(arguments))
    choice = read_contacts(parse(["evaluate", "bag", "--contact", "estimate", *words]))
    build_source(choice, make_recording(), FakeJaw())
    assert len(calls) == compared


class Images:
    """Stamps of images with depth, or without."""

    frame_id = "camera"

    def __init__(self, has_depth):
        self.has_depth = has_depth
        self.stamps_ns = START + PERIOD * np.arange(20)
        self.depth_stamps = self.stamps_ns


def record_with(images, frame="camera"):
    recording = make_recording()
    return replace(recording, images=images, object_pose=replace(recording.object_pose, frame_id=frame))


@pytest.mark.parametrize(
    ("recording", "words", "expected"),
    [
        (record_with(None), ["--contact", "estimate"], [UNCOMPARED]),
        (record_with(Images(has_depth=False)), ["--contact", "estimate"], [OUTLINED]),
        (record_with(Images(has_depth=True), frame="world"), ["--contact", "estimate"], [UNCOMPARED]),
        (record_with(Images(has_depth=True)), ["--contact", "estimate"], []),
        (record_with(None), ["--contact", "estimate", "--no-compare-mesh"], []),
        (record_with(None), ["--contact", "fixed:40"], []),
    ],
)
def test_a_mesh_that_cannot_be_compared_with_the_images_is_noted(recording, words, expected):
    notes = read_contacts(parse(["evaluate", "bag", *words])).describe_comparison(recording)
    assert notes == [f"the object's mesh {each}; a wrong one gives wrong forces" for each in expected]


@pytest.mark.parametrize(("sees", "severity"), [(True, "ok"), (False, "fault")])
def test_a_mesh_of_which_nothing_is_seen_does_not_fit(sees, severity, monkeypatch):
    compared = SimpleNamespace(is_sure=True, at=lambda stamp: "", sees_mesh=sees)
    monkeypatch.setattr(check, "check_mesh", lambda *arguments, **options: compared)
    (found,) = check.check_object(record_with(Images(has_depth=True)), CYLINDER, "m")
    assert found.severity == severity and (UNSEEN in found.text) != sees
    assert "not inverted" in UNSEEN


@pytest.mark.parametrize(("has_depth", "expected"), [(True, LEAST_IMAGES), (False, MOST_IMAGES)])
def test_edges_in_colour_need_more_images_than_depth_for_a_verdict_at_once(has_depth, expected, monkeypatch):
    images = Images(has_depth=has_depth)
    images.camera, images.at = None, lambda stamps: iter(stamps)
    for kind in ("mesh_check.MeshCheck", "edge_check.EdgeCheck"):
        monkeypatch.setattr(f"finforce_contact.pose.{kind}", lambda mesh, camera: None)
    track = make_track(*range(20))
    asked = RecordedCheck(record_with(images), None, track, at_once=True)
    assert len(asked._poses) == expected and {*track.stamps_ns[[0, -1]]} < {*asked._poses}
