"""Claims about following an object in depth images; images and true poses come from a renderer."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sequence_fakes import Motion, render_sequence
from table_fakes import build_d405

from finforce.camera import CameraIntrinsics, ImageError
from finforce.errors import FinforceError, PoseError
from finforce.transforms import invert_pose, move_pose, rotation_between, step_between
from finforce_contact.errors import PoseLostError
from finforce_contact.parameters import TrackerSettings
from finforce_contact.pose.tracker import PoseTracker
from finforce_sim.objects import build_object

CAMERA = build_d405(step=2)
# The aim is 1 mm and 2 degrees in the median; at this noise it is 0.2 mm and 0.5 degrees, the worst three times that.
NEAR, TURNED = 1e-3, np.deg2rad(2.0)
NUDGE = np.array([0.002, -0.002, 0.002, 0.03, -0.02, 0.03])


def sequence(name, seed=0, camera=CAMERA, **motion):
    return list(render_sequence(build_object(name), camera, Motion(**motion), seed))


@pytest.fixture(scope="module")
def frames():
    return sequence("asymmetric", frames=6)


def started(mesh, frame, camera=CAMERA, **settings):
    tracker = PoseTracker(mesh, camera, TrackerSettings(**settings))
    tracker.locate(frame.stamp, frame.depth, frame.mask, [move_pose(frame.T_camera_object, NUDGE)])
    return tracker


@pytest.fixture
def tracker(frames):
    return started(build_object("asymmetric"), frames[0])


def assert_right(pose, frame):
    assert np.linalg.norm(pose.T_camera_object[:3, 3] - frame.T_camera_object[:3, 3]) < NEAR
    assert rotation_between(pose.T_camera_object, frame.T_camera_object) < TURNED


def tilt_between(T_a, T_b):
    return np.arccos(np.clip(T_a[:3, 2] @ T_b[:3, 2], -1.0, 1.0))


def test_object_is_followed_without_a_mask(tracker, frames):
    for frame in frames[1:]:
        pose = tracker.track(frame.stamp, frame.depth)
        assert_right(pose, frame)
        assert pose.fitness > 0.9
        assert pose.stamp == frame.stamp
    assert tracker.counts == {"located": 1, "tracked": len(frames) - 1}


def test_object_is_followed_with_a_mask(tracker, frames):
    assert_right(tracker.track(frames[1].stamp, frames[1].depth, frames[1].mask), frames[1])


def test_lens_distortion_is_taken_into_account():
    camera = build_d405(distorted=True, step=2)
    frames = sequence("asymmetric", camera=camera, frames=3)
    tracker = started(build_object("asymmetric"), frames[0], camera)
    assert_right(tracker.track(frames[2].stamp, frames[2].depth), frames[2])


def test_pose_does_not_depend_on_the_origin_of_the_mesh(tracker, frames):
    mesh, shift = build_object("asymmetric"), np.array([0.2, -0.1, 0.05])
    other = PoseTracker(replace(mesh, vertices=mesh.vertices + shift), CAMERA)
    back = np.eye(4)
    back[:3, 3] = -shift
    guess = move_pose(frames[0].T_camera_object, NUDGE) @ back
    other.locate(frames[0].stamp, frames[0].depth, frames[0].mask, [guess])
    # single precision of the ray caster lets a pixel at the rim be seen or not
    assert np.allclose(other.latest.T_camera_object, tracker.latest.T_camera_object @ back, atol=2e-4)
    x, y, z = tracker.latest.T_camera_object[:3, :3] @ -shift
    lever = np.eye(6)
    lever[:3, 3:] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    expected = lever @ tracker.latest.covariance @ lever.T
    size = np.sqrt(np.diag(expected))
    assert np.allclose(other.latest.covariance / np.outer(size, size), expected / np.outer(size, size), atol=0.1)


@pytest.mark.parametrize("name", ["cylinder", "bottle"])
def test_round_objects_do_not_spin_and_say_so(name):
    frames = sequence(name, seed=1, frames=12)
    tracker = started(build_object(name), frames[0])
    first, turn = tracker.latest.T_camera_object, 0.0
    for frame in frames[1:]:
        pose = tracker.track(frame.stamp, frame.depth)
        turn += Rotation.from_matrix(first[:3, :3].T @ pose.T_camera_object[:3, :3]).as_rotvec()[2]
        first = pose.T_camera_object
        assert tilt_between(pose.T_camera_object, frame.T_camera_object) < TURNED
    axis, rotations = first[:3, 2], tracker.latest.covariance[3:, 3:]
    across = np.linalg.svd(axis[None])[2][1:]
    assert abs(turn) < np.deg2rad(0.5)  # the axis itself tilts by 6 degrees meanwhile
    assert np.sqrt(axis @ rotations @ axis) > 0.1
    assert np.sqrt(np.diag(across @ rotations @ across.T)).max() < 0.02


def test_what_turns_visibly_is_turned(tracker, frames):
    rotations = tracker.latest.covariance[3:, 3:]
    assert np.sqrt(np.linalg.eigvalsh(rotations)).max() < 0.03


def test_object_is_followed_behind_plates_that_hide_half_of_it():
    frames = sequence("bottle", seed=2, hidden=0.6, frames=54)
    tracker = started(build_object("bottle"), frames[0])
    off = []
    for frame in frames[1::2]:  # 15 images a second
        pose = tracker.track(frame.stamp, frame.depth)
        off.append(np.linalg.norm(pose.T_camera_object[:3, 3] - frame.T_camera_object[:3, 3]))
        assert tilt_between(pose.T_camera_object, frame.T_camera_object) < TURNED
    assert max(frame.hidden for frame in frames) > 0.5
    assert max(off) < 2.0 * NEAR


def test_errors_are_as_large_as_the_covariance_says(tracker, frames):
    ratios = []
    for frame in frames[1:]:
        pose = tracker.track(frame.stamp, frame.depth)
        step = step_between(frame.T_camera_object, pose.T_camera_object)
        ratios.append(step @ np.linalg.solve(pose.covariance, step) / 6.0)
    assert 0.1 < np.mean(ratios) < 4.0  # one, were the errors of neighbouring pixels as modelled


def test_a_face_that_slides_between_plates_is_known_to_slide():
    frames = sequence("cube", seed=3, hidden=0.5, frames=90)[::2]
    tracker, off = started(build_object("cube"), frames[0]), []
    for frame in frames[1:27]:
        pose = tracker.track(frame.stamp, frame.depth)
        error = pose.T_camera_object[:3, 3] - frame.T_camera_object[:3, 3]
        way = error / np.linalg.norm(error)
        off.append(np.linalg.norm(error))
        # half a millimetre of bias is no slide
        assert off[-1] < 5e-4 + 3.0 * np.sqrt(way @ pose.covariance[:3, :3] @ way)
    assert max(off) > 5e-3


def test_a_hidden_object_is_lost_and_found_again(tracker, frames):
    """FoundationPose 325."""
    kept = tracker.latest
    with pytest.raises(PoseLostError, match="'asymmetric' is not found"):
        tracker.track(frames[1].stamp, np.full_like(frames[1].depth, 0.1))
    assert tracker.latest is kept
    assert_right(tracker.track(frames[2].stamp, frames[2].depth), frames[2])
    assert tracker.counts["lost"] == 1


def test_an_object_that_has_left_is_lost(tracker, frames):
    table = np.where(frames[1].mask, 0.5, frames[1].depth)
    with pytest.raises(PoseLostError):
        tracker.track(frames[1].stamp, table)


def test_an_object_that_jumped_is_found_near_by():
    before, after = sequence("asymmetric", speed=0.8, frames=2)
    assert np.linalg.norm(after.T_camera_object[:3, 3] - before.T_camera_object[:3, 3]) > 0.025
    tracker = started(build_object("asymmetric"), before)
    for image in range(9):
        try:
            pose = tracker.track(after.stamp + image / 30.0, after.depth)
        except PoseLostError:
            continue
        break
    assert_right(pose, after)
    assert tracker.counts["recovered"] == 1


def test_first_pose_needs_no_guess(frames):
    tracker = PoseTracker(build_object("asymmetric"), CAMERA)
    assert_right(tracker.locate(1.0, frames[3].depth, frames[3].mask), frames[3])


def test_another_object_is_not_located():
    frame, tracker = sequence("cube", frames=1)[0], PoseTracker(build_object("cylinder"), CAMERA)
    with pytest.raises(PoseLostError, match="no pose of it agrees"):
        tracker.locate(1.0, frame.depth, frame.mask)
    assert tracker.latest is None


@pytest.mark.parametrize("limit", [{"least_fitness": 1.0}, {"least_visible": 1.0}])
def test_a_pose_that_fits_less_than_asked_for_is_none(frames, limit, monkeypatch):
    monkeypatch.setattr("finforce_contact.pose.tracker.search_pose", lambda *_: [])  # near the guess alone
    with pytest.raises(PoseLostError):
        started(build_object("asymmetric"), frames[0], **limit)


def test_camera_without_focal_length_is_refused():
    with pytest.raises(FinforceError, match="finite"):
        CameraIntrinsics(width=424, height=240, fx=np.nan, fy=215.0, cx=212.0, cy=120.0)


def _empty(frame):
    return frame.depth, np.zeros_like(frame.mask)


def _dark(frame):
    return np.zeros_like(frame.depth), frame.mask


def _unmeasured(frame):
    return np.full_like(frame.depth, np.nan), frame.mask


def _masked_hole(frame):
    return np.where(frame.mask, 0.0, frame.depth), frame.mask


def _cropped(frame):
    return frame.depth[:-1], frame.mask[:-1]


def _other_mask(frame):
    return frame.depth, frame.mask[:, :-1]


@pytest.mark.parametrize("spoil", [_empty, _dark, _unmeasured, _masked_hole, _cropped, _other_mask])
def test_an_image_that_cannot_be_used_is_refused_and_changes_nothing(tracker, frames, spoil):
    kept = tracker.latest
    depth, mask = spoil(frames[1])
    with pytest.raises(ImageError):
        tracker.track(frames[1].stamp, depth, mask)
    with pytest.raises(ImageError):
        tracker.locate(frames[1].stamp, depth, mask)
    assert tracker.latest is kept
    assert_right(tracker.track(frames[1].stamp, frames[1].depth), frames[1])


def test_a_guess_around_the_camera_is_refused(tracker, frames):
    with pytest.raises(PoseError, match="camera inside"):
        tracker.locate(2.0, frames[1].depth, frames[1].mask, [np.eye(4)])
    with pytest.raises(PoseError, match="camera inside"):
        tracker.locate(2.0, frames[1].depth, frames[1].mask, [invert_pose(np.eye(4))])


def test_nothing_is_tracked_before_it_was_located(frames):
    with pytest.raises(PoseLostError, match="no pose yet"):
        PoseTracker(build_object("cube"), CAMERA).track(1.0, frames[0].depth)


def test_an_image_of_the_past_is_refused_until_a_reset(tracker, frames):
    for stamp in (frames[0].stamp, np.nan):
        with pytest.raises(PoseError, match="stamp"):
            tracker.track(stamp, frames[1].depth)
    with pytest.raises(PoseError, match="stamp"):
        tracker.locate(np.inf, frames[0].depth, frames[0].mask)
    tracker.reset()
    assert tracker.latest is None
    tracker.locate(0.5, frames[0].depth, frames[0].mask, [frames[0].T_camera_object])
    assert tracker.latest.stamp == 0.5


@pytest.mark.parametrize("wrong", [{"points": 10}, {"noise": np.nan}, {"speed": 0.0}])
def test_settings_out_of_bounds_are_refused_by_name(wrong):
    with pytest.raises(PoseError, match=next(iter(wrong))):
        TrackerSettings(**wrong)
