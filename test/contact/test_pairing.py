"""Claims about pairing the poses of jaw and object by image, and about what one jaw makes of them."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from finforce_contact.contact_session import JawContact, PosePairing, turn_covariance
from finforce_contact.estimator import ContactEstimate
from finforce_contact.parameters import ContactSettings
from finforce_contact.pose.filter import PoseFilter

MS = 1_000_000
FRAME = 33 * MS


def moved(x=0.0, y=0.0, z=0.0, turn=None):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    if turn is not None:
        T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    return T


def due(steps):
    return [step.stamp for step in steps if step.is_due]


def test_the_pose_in_the_jaw_frame_is_that_of_both_poses():
    pairing = PosePairing(MS)
    T_camera_jaw, T_jaw_object = moved(0.1, turn=(0.3, -0.2, 1.0)), moved(0.03, 0.0, 0.04, turn=(0.0, 0.1, 0.0))
    pairing.add_object(5, T_camera_jaw @ T_jaw_object)
    (step,) = pairing.add_jaw(5, T_camera_jaw)
    np.testing.assert_allclose(step.T_jaw_object, T_jaw_object, atol=1e-12)


@pytest.mark.parametrize("object_first", [True, False])
def test_in_step_each_image_is_due_once_with_its_own_pose(object_first):
    pairing = PosePairing(MS)
    answers = []
    for k in range(6):
        stamp = k * FRAME
        calls = [lambda s=stamp: pairing.add_object(s, moved(0.001 * s)), lambda s=stamp: pairing.add_jaw(s, np.eye(4))]
        for add in calls if object_first else calls[::-1]:
            answers += add()
    images = [step for step in answers if step.is_due]
    assert [step.stamp for step in images] == [k * FRAME for k in range(6)]
    # whoever comes first, from the second image on it waits for its own pose
    for step in images[1:]:
        assert step.T_jaw_object[0, 3] == 0.001 * step.stamp


def test_without_object_poses_an_image_is_due_at_once():
    pairing = PosePairing(MS)
    for k in range(4):
        (step,) = pairing.add_jaw(k * FRAME, np.eye(4))
        assert step.is_due and step.T_jaw_object is None


def test_when_object_poses_cease_one_image_waits_and_no_other():
    pairing = PosePairing(MS)
    for k in range(3):
        pairing.add_jaw(k * FRAME, np.eye(4))
        pairing.add_object(k * FRAME, np.eye(4))
    assert due(pairing.add_jaw(3 * FRAME, np.eye(4))) == []
    assert due(pairing.add_jaw(4 * FRAME, np.eye(4))) == [3 * FRAME, 4 * FRAME]
    assert due(pairing.add_jaw(5 * FRAME, np.eye(4))) == [5 * FRAME]


def test_a_slow_tracker_delays_nothing_and_its_poses_are_used():
    pairing = PosePairing(MS)
    for k in range(8):
        assert due(pairing.add_jaw(k * FRAME, np.eye(4))) == [k * FRAME]
        if k >= 2:
            (late,) = pairing.add_object((k - 2) * FRAME, moved(0.001 * k))
            assert late.stamp == (k - 2) * FRAME and not late.is_due
            assert late.T_jaw_object[0, 3] == 0.001 * k


@pytest.mark.parametrize("order", ["in time", "late"])
def test_an_object_pose_between_two_poses_of_a_jaw_that_stands_still_is_used(order):
    pairing, T_camera_jaw = PosePairing(MS), moved(0.1, turn=(0.3, -0.2, 1.0))
    seen = lambda: pairing.add_object(FRAME, T_camera_jaw @ moved(0.03))  # noqa: E731
    steps = pairing.add_jaw(0, T_camera_jaw)
    if order == "in time":
        steps += seen()
    steps += pairing.add_jaw(3 * FRAME, T_camera_jaw)
    if order == "late":
        steps += seen()
    assert due(steps) == [0, 3 * FRAME]  # no contact is said of an image without a jaw pose
    (used,) = [step for step in steps if step.T_jaw_object is not None]
    assert used.stamp == FRAME
    np.testing.assert_allclose(used.T_jaw_object, moved(0.03), atol=1e-12)


@pytest.mark.parametrize(("way", "later"), [(1e-3, 3 * FRAME), (0.0, 10 * FRAME)])
def test_between_two_poses_of_a_jaw_that_moved_or_was_not_seen_for_long_none_is_used(way, later):
    pairing = PosePairing(MS)
    steps = [*pairing.add_jaw(0, moved()), *pairing.add_object(FRAME, moved()), *pairing.add_jaw(later, moved(way))]
    assert all(step.T_jaw_object is None for step in steps)


def test_stamps_farther_apart_than_the_tolerance_do_not_belong_together():
    pairing = PosePairing(5 * MS)
    pairing.add_jaw(0, np.eye(4))
    assert pairing.add_object(6 * MS, np.eye(4)) == []
    assert len(pairing.add_object(5 * MS, np.eye(4))) == 1


def test_a_covariance_turns_with_the_axes():
    T_jaw_camera = moved(turn=(0.0, 0.0, np.pi / 2))  # the camera's x is the jaw's y
    turned = turn_covariance(np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), T_jaw_camera)
    np.testing.assert_allclose(turned, np.diag([2.0, 1.0, 3.0, 5.0, 4.0, 6.0]), atol=1e-12)
    assert turn_covariance(None, T_jaw_camera) is None


class FakeEstimator:
    """Keeps what it is given."""

    needs_surface = True
    face = SimpleNamespace(mesh=SimpleNamespace(nodes=np.zeros((4, 3))))

    def __init__(self):
        self.poses, self.updates = [], []
        self.filter = PoseFilter(ContactSettings())

    def reset(self):
        self.poses.clear()

    def carry(self, T):
        self.filter.carry(T)

    def take_pose(self, stamp, T_jaw_object, covariance=None, *, camera=None):
        self.poses.append((stamp, T_jaw_object, covariance, camera))
        self.filter.update(stamp, T_jaw_object)

    def update(self, stamp, surface=None):
        self.updates.append((stamp, surface))
        return ContactEstimate(stamp=stamp, status="apart", message="")


@pytest.fixture
def jaw():
    return JawContact(FakeEstimator(), tolerance=MS, max_age=200 * MS)


def test_a_surface_is_used_while_it_is_fresh(jaw):
    jaw.keep_surface(0, np.zeros((4, 3)))
    jaw.take_jaw_pose(200 * MS, np.eye(4))
    jaw.take_jaw_pose(201 * MS, np.eye(4))
    (_, first), (_, later) = jaw.loop.estimator.updates
    assert first.shape == (4, 3) and later is None


def test_the_object_stays_where_it_is_while_the_jaw_closes(jaw):
    """Its pose comes once in three images; a jaw that tilts and moves by 2 mm an image meets it there."""
    for number in range(7):
        T_camera_jaw = moved(2e-3 * number, 0.0, 0.2, turn=(0.0, 0.0, 2e-3 * number))
        if number % 3 == 0:
            jaw.take_object_pose(number * FRAME, moved(0.03, 0.0, 0.24))
        jaw.take_jaw_pose(number * FRAME, T_camera_jaw)
        known = T_camera_jaw @ jaw.loop.estimator.filter.at(1e-9 * number * FRAME).T
        np.testing.assert_allclose(known[:3, 3], [0.03, 0.0, 0.24], atol=1e-9)


def test_a_pose_that_comes_late_is_taken_as_the_jaw_is_now(jaw):
    jaw.take_jaw_pose(0, moved(0.0, 0.0, 0.2))
    jaw.take_jaw_pose(FRAME, moved(5e-3, 0.0, 0.2))
    jaw.take_object_pose(0, moved(0.03, 0.0, 0.24))
    np.testing.assert_allclose(jaw.loop.estimator.filter.at(1e-9 * FRAME).T[:3, 3], [0.025, 0.0, 0.04], atol=1e-9)


def test_what_a_jaw_at_rest_is_seen_to_tremble_moves_nothing(jaw):
    jaw.take_object_pose(0, moved(0.03, 0.0, 0.24))
    jaw.take_jaw_pose(0, moved(0.0, 0.0, 0.2))
    jaw.take_jaw_pose(FRAME, moved(0.1e-3, 0.0, 0.2))
    np.testing.assert_array_equal(jaw.loop.estimator.filter.at(1e-9 * FRAME).T, moved(0.03, 0.0, 0.24 - 0.2))


def test_the_camera_stands_where_the_jaw_sees_it(jaw):
    jaw.take_jaw_pose(0, moved(0.0, 0.0, 0.2))
    jaw.take_object_pose(0, moved(0.0, 0.0, 0.23))
    ((stamp, T_jaw_object, covariance, camera),) = jaw.loop.estimator.poses
    np.testing.assert_allclose(camera, [0.0, 0.0, -0.2])
    np.testing.assert_allclose(T_jaw_object, moved(0.0, 0.0, 0.03))
    assert stamp == 0.0 and covariance is None


def test_one_image_is_answered_once(jaw):
    jaw.take_object_pose(0, np.eye(4))
    assert len(jaw.take_jaw_pose(0, np.eye(4))) == 1
    assert jaw.take_jaw_pose(0, np.eye(4)) == []
    assert len(jaw.take_jaw_pose(FRAME, np.eye(4))) == 1


def test_the_age_of_the_pose_is_that_at_the_last_answer(jaw):
    assert np.isnan(jaw.loop.pose_age())
    jaw.take_object_pose(0, np.eye(4))
    jaw.take_jaw_pose(0, np.eye(4))
    jaw.take_jaw_pose(100 * MS, np.eye(4))
    jaw.take_jaw_pose(200 * MS, np.eye(4))
    assert jaw.loop.pose_age() == pytest.approx(0.2)
