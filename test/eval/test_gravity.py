"""Gravity and elevation of the gripper are read from /gravity or from /tf of a bag, and reach the estimator."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from eval_fakes import PERIOD, START, make_recording
from scipy.spatial.transform import Rotation

from finforce.messages import SECOND
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.gripper import with_gripper
from finforce_eval.recordings.gravity import FIXED, MOVING, TRANSFORMS, read_transforms
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import GravityTrack
from finforce_eval.recordings.writer import (
    Entry,
    header,
    make_message,
    recording_entries,
    write_entries,
    write_recording,
)

COUNT = 20
STAMPS = START + PERIOD * np.arange(COUNT)
TURNS = np.linspace(0.0, 1.0, COUNT)  # [rad] about y of the gripper
LIFTS = np.linspace(0.0, 0.05, COUNT)  # [m]


def transform(stamp, parent, child, place=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)):
    quaternion = Rotation.from_rotvec(turn).as_quat()
    translation, rotation = (dict(zip("xyzw", values, strict=False)) for values in (place, quaternion))
    return {
        "header": header(stamp, parent),
        "child_frame_id": child,
        "transform": {"translation": translation, "rotation": rotation},
    }


def arm_entries():
    """An arm on a table 0.8 m high: the wrist rises, then turns about y; the gripper is upside down on it."""
    mounted = transform(0, "wrist", "/gripper_base", (0.0, 0.0, 0.1), (np.pi, 0.0, 0.0))
    table = transform(0, "world", "base_link", (0.0, 0.0, 0.8))
    yield Entry(int(STAMPS[0]), FIXED, make_message(TRANSFORMS, transforms=[mounted, table]))
    for stamp, turn, lift in zip(STAMPS.tolist(), TURNS, LIFTS, strict=True):
        wrist = transform(stamp, "base_link", "wrist", (0.3, 0.0, lift), (0.0, turn, 0.0))
        camera = transform(stamp, "wrist", "camera", (np.nan, 0.0, 0.0))  # of no concern
        yield Entry(stamp, MOVING, make_message(TRANSFORMS, transforms=[wrist, camera]))


def write_arm(folder, recording):
    entries = [*recording_entries(recording), *arm_entries()]
    return write_entries(sorted(entries, key=lambda entry: entry.stamp), folder)


def test_gravity_and_elevation_follow_the_frames_of_the_arm(tmp_path):
    bag = write_arm(tmp_path / "arm", make_recording())
    found = read_recording(bag, gravity_frame="base_link").gravity
    assert np.array_equal(found.stamps_ns, STAMPS)
    assert found.elevation == pytest.approx(LIFTS + 0.1 * np.cos(TURNS))
    down = np.stack([np.sin(TURNS), np.zeros(COUNT), np.cos(TURNS)], axis=1)  # in the gripper, upside down
    assert found.direction == pytest.approx(down, abs=1e-12)
    assert read_recording(bag, gravity_frame="world").gravity.elevation == pytest.approx(found.elevation + 0.8)
    assert read_recording(bag).gravity is None


def test_frames_that_do_not_lead_up_to_the_upright_one_are_named(tmp_path):
    bag = write_arm(tmp_path / "arm", make_recording())
    with pytest.raises(RecordingError, match="--gravity-frame map: /tf connects gripper_base with world at most"):
        read_recording(bag, gravity_frame="map")
    still = write_recording(make_recording(), tmp_path / "still")
    with pytest.raises(RecordingError, match="/tf connects gripper_base with gripper_base at most"):
        read_recording(still, gravity_frame="world")


def given(*transforms):
    """Messages on /tf as they are decoded."""
    return {MOVING: [make_message(TRANSFORMS, transforms=transforms)]}


def test_frames_in_a_ring_and_poses_that_are_none_are_refused():
    ring = given(transform(1, "a", "gripper_base"), transform(1, "gripper_base", "a"))
    with pytest.raises(RecordingError, match="at most"):
        read_transforms(ring, "world", "bag")
    broken = given(transform(1, "world", "gripper_base", (np.nan, 0.0, 0.0)))
    with pytest.raises(RecordingError, match="bag: /tf: the pose of gripper_base"):
        read_transforms(broken, "world", "bag")
    fixed = {FIXED: given(transform(0, "world", "gripper_base"))[MOVING]}
    with pytest.raises(RecordingError, match="/tf does not move gripper_base"):
        read_transforms(fixed, "world", "bag")


def test_the_topic_gravity_is_read_as_it_was_written(tmp_path):
    down = np.stack([np.sin(TURNS), np.zeros(COUNT), np.cos(TURNS)], axis=1)
    track = GravityTrack(stamps_ns=STAMPS, direction=down, elevation=np.full(COUNT, np.nan))
    found = read_recording(write_recording(replace(make_recording(), gravity=track), tmp_path / "bag")).gravity
    assert np.array_equal(found.stamps_ns, STAMPS) and found.direction == pytest.approx(down)
    assert np.isnan(found.elevation).all()


@pytest.mark.parametrize(
    ("frame", "stamps", "reason"),
    [("world", (0,), "'world'.*gripper_base"), ("gripper_base", (1, 0), "the stamps of /gravity.*go back")],
)
def test_gravity_that_cannot_be_used_costs_no_recording(frame, stamps, reason, tmp_path):
    told = [
        make_message("geometry_msgs/msg/Vector3Stamped", header=header(int(START) + stamp, frame), vector={"z": -1.0})
        for stamp in stamps
    ]
    entries = [Entry(int(START) + number, "/gravity", each) for number, each in enumerate(told)]
    found = read_recording(write_entries([*recording_entries(make_recording()), *entries], tmp_path / "bag"))
    assert found.gravity is None and len(found.jaws["left"].keypoints.stamps_ns)
    assert any(re.search(f"gravity is not known: .*{reason}", note) for note in found.notes)


def test_a_posture_counts_as_long_as_the_nodes_accept_it():
    down = np.eye(3)
    track = GravityTrack(stamps_ns=np.array([0, 10**9, 2 * 10**9]), direction=down, elevation=np.zeros(3))
    assert track.at(10**9 + 10**8).gravity.tolist() == [0.0, 1.0, 0.0]
    assert track.at(19 * 10**8).gravity.tolist() == [0.0, 0.0, 1.0]
    assert track.at(15 * 10**8) is None


def test_rows_of_the_jaws_tell_the_posture_of_their_images():
    jaws = {"left": SimpleNamespace(stamps_ns=STAMPS, with_columns=lambda **columns: columns)}
    track = GravityTrack(stamps_ns=STAMPS[:2], direction=np.eye(3)[:2], elevation=LIFTS[:2])
    recording = SimpleNamespace(gravity=track, jaw=lambda side: SimpleNamespace(pose=None, true_pose=None))
    row = with_gripper(jaws, recording)["left"]
    assert row["gravity"][:2].tolist() == np.eye(3)[:2].tolist() and row["elevation"][1] == LIFTS[1]
    late = STAMPS[1] + int(0.2 / SECOND) < STAMPS
    assert np.isnan(row["gravity"][late]).all() and late.any()


def test_only_bags_have_frames(tmp_path):
    (tmp_path / "grasps.mp4").write_bytes(b"")
    with pytest.raises(RecordingError, match="grasps.mp4: --gravity-frame base_link: only bags have /tf"):
        read_recording(tmp_path / "grasps.mp4", gravity_frame="base_link")
