"""Claims about the object's mesh file and its poses in the jaw frame."""

from dataclasses import replace

import numpy as np
import pytest
from eval_fakes import PERIOD, START, make_poses, make_recording
from scipy.spatial.transform import Rotation

from finforce.transforms import invert_pose
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.contact_source import parse_contacts
from finforce_eval.recordings.objects import find_mesh, has_object, mean_pose, require_mesh, track_object
from finforce_eval.recordings.tracks import PoseTrack
from finforce_eval.recordings.writer import write_recording

CAMERA = "camera_color_optical_frame"


def track_of(T, stamps, frame=CAMERA):
    """The same pose at every stamp."""
    count = len(stamps)
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return PoseTrack(
        stamps_ns=np.asarray(stamps),
        position=np.tile(T[:3, 3], (count, 1)),
        quaternion=np.tile(quaternion, (count, 1)),
        frame_id=frame,
    )


def pose(rotation, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), position
    return T


T_CAMERA_JAW = pose([0.3, -2.0, 0.5], [0.03, 0.02, 0.11])
T_JAW_OBJECT = pose([0.1, 0.2, -0.3], [0.026, 0.001, 0.04])


def seen(jaw_stamps, object_stamps, **frames):
    recording = make_recording()
    jaw = replace(recording.jaws["left"], pose=track_of(T_CAMERA_JAW, jaw_stamps, frames.get("jaw", CAMERA)))
    objects = track_of(T_CAMERA_JAW @ T_JAW_OBJECT, object_stamps, frames.get("object", CAMERA))
    return replace(recording, jaws={"left": jaw}, object_pose=objects)


def test_object_is_found_in_the_jaw_frame_from_two_poses_in_the_camera_frame():
    stamps = START + PERIOD * np.arange(5)
    track = track_object(seen(stamps, stamps), "left")
    np.testing.assert_array_equal(track.stamps_ns, stamps)
    np.testing.assert_allclose(track.poses, np.tile(T_JAW_OBJECT, (5, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(track.camera.at(int(stamps[2])), invert_pose(T_CAMERA_JAW), atol=1e-12)
    assert track.camera.at(int(stamps[-1]) + 60_000_000) is None


def test_poses_in_another_frame_than_the_jaws_are_to_be_transformed():
    with pytest.raises(RecordingError, match="the images, is in 'camera.*in 'base_link'.*transform .* with /tf"):
        track_object(seen([START], [START], object="base_link"), "left")


def test_pose_in_the_jaw_frame_needs_no_pose_of_the_jaw():
    recording = seen([START], [START])
    alone = replace(recording.jaws["left"], pose=None)
    direct = replace(
        recording, jaws={"left": alone}, object_pose=track_of(T_JAW_OBJECT, [START, START + 1], frame="/left_jaw")
    )
    assert has_object(direct, "left")
    np.testing.assert_allclose(track_object(direct, "left").poses, np.tile(T_JAW_OBJECT, (2, 1, 1)), atol=1e-12)
    with pytest.raises(RecordingError, match="no jaw poses"):
        track_object(replace(direct, object_pose=replace(direct.object_pose, frame_id=CAMERA)), "left")


def test_nearest_pose_of_the_jaw_within_50_ms_counts():
    ms = 1_000_000
    recording = seen(START + ms * np.array([100, 0]), START + ms * np.array([-51, 49, 51, 149, 151]))
    jaw = recording.jaws["left"]
    # the jaw has moved by 10 mm at its later pose, which came first
    moved = replace(jaw.pose, position=jaw.pose.position + [[0.01, 0.0, 0.0], [0.0, 0.0, 0.0]])
    track = track_object(replace(recording, jaws={"left": replace(jaw, pose=moved)}), "left")
    assert ((track.stamps_ns - START) // ms).tolist() == [49, 51, 149]
    shift = T_CAMERA_JAW[:3, :3].T @ [0.01, 0.0, 0.0]
    expected = T_JAW_OBJECT[:3, 3] - np.array([[0.0], [1.0], [1.0]]) * shift
    np.testing.assert_allclose(track.poses[:, :3, 3], expected, atol=1e-12)


def test_poses_of_another_time_are_refused():
    with pytest.raises(RecordingError, match="/object_pose is at least 1 s from any image.*expected 50 ms at most"):
        track_object(seen([START], [START + 10**9]), "left")


def test_poses_of_two_cameras_are_refused():
    with pytest.raises(RecordingError, match="/left/jaw_pose .* is in 'other' and /object_pose in 'camera_color"):
        track_object(seen([START], [START], jaw="other"), "left")


def test_recording_without_object_poses_is_refused():
    recording = replace(make_recording(), object_pose=None)
    assert not has_object(recording, "left")
    with pytest.raises(RecordingError, match="case: no object poses: /object_pose is absent"):
        track_object(recording, "left")


@pytest.mark.parametrize("topic", ["/object_pose", "/left/jaw_pose"])
@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [("position", np.nan, "finite"), ("quaternion", np.nan, "finite"), ("quaternion", 0.0, "norm 0")],
)
def test_pose_that_is_none_is_refused_with_its_message(topic, column, value, reason):
    recording = make_recording()
    bad = make_poses(recording.object_pose.stamps_ns)
    getattr(bad, column)[7] = value
    if topic == "/object_pose":
        recording = replace(recording, object_pose=bad)
    else:
        recording = replace(recording, jaws={"left": replace(recording.jaws["left"], pose=bad)})
    with pytest.raises(RecordingError, match=rf"case: {topic} message 7: .*{reason}"):
        track_object(recording, "left")


def test_message_of_a_bad_pose_is_counted_as_recorded_even_when_it_came_late():
    recording = make_recording()
    poses = recording.object_pose
    stamps = poses.stamps_ns[::-1].copy()
    position = poses.position.copy()
    position[2] = np.nan
    with pytest.raises(RecordingError, match="message 2:"):
        track_object(replace(recording, object_pose=replace(poses, stamps_ns=stamps, position=position)), "left")


def test_mean_pose_is_the_middle_of_symmetric_noise():
    turns = [[0.0, 0.01, 0.0], [0.0, -0.01, 0.0], [0.02, 0.0, 0.0], [-0.02, 0.0, 0.0]]
    poses = np.stack([T_JAW_OBJECT @ pose(turn, [0, 0, 0]) for turn in turns])
    poses[:, 2, 3] += [1e-3, -1e-3, 2e-3, -2e-3]
    np.testing.assert_allclose(mean_pose(poses), T_JAW_OBJECT, atol=1e-9)


@pytest.fixture
def recorded(tmp_path):
    """A recording on disk whose case names a mesh beside its folder."""
    recording = replace(make_recording("pressed"), case={"mesh": "objects/thing.stl"})
    path = write_recording(recording, tmp_path / "recordings" / "pressed")
    mesh = tmp_path / "recordings" / "objects" / "thing.stl"
    mesh.parent.mkdir()
    mesh.write_bytes(b"solid")
    return replace(recording, path=path), mesh


def test_mesh_of_the_case_stands_in_the_folder_that_holds_the_recordings(recorded):
    recording, mesh = recorded
    assert find_mesh(recording) == mesh
    assert find_mesh(replace(recording, path=recording.path / "pressed.mcap")) == mesh


def test_mesh_of_a_lone_bag_file_stands_in_its_folder(recorded):
    recording, mesh = recorded
    lone = recording.path.parent / "lone.mcap"
    lone.write_bytes(b"")
    assert find_mesh(replace(recording, path=lone)) == mesh


def test_mesh_that_was_given_goes_before_that_of_the_case(recorded):
    assert str(find_mesh(recorded[0], "other.ply")) == "other.ply"


def test_absent_mesh_is_refused_with_what_would_do(recorded):
    recording, mesh = recorded
    mesh.unlink()
    assert find_mesh(recording) is None
    with pytest.raises(RecordingError, match=r"'objects/thing.stl' of its case.json is not there; give --object MESH"):
        require_mesh(recording)
    with pytest.raises(RecordingError, match="no mesh in a case.json next to it"):
        require_mesh(replace(recording, case={}))


def test_contact_is_estimated_by_itself_only_with_mesh_and_poses(recorded):
    recording, mesh = recorded
    automatic = parse_contacts([])
    assert automatic.mode_for(recording, "left") == "estimate"
    assert automatic.mode_for(replace(recording, object_pose=None), "left") == "fixed"
    blind = {"left": replace(recording.jaws["left"], pose=None)}
    assert automatic.mode_for(replace(recording, jaws=blind), "left") == "fixed"
    assert parse_contacts(["fixed:case"]).mode_for(recording, "left") == "fixed"
    mesh.unlink()
    assert automatic.mode_for(recording, "left") == "fixed"
    assert parse_contacts([], object_file="other.ply").mode_for(recording, "left") == "estimate"
    assert parse_contacts(["paper"]).mode_for(recording, "left") == "paper"


def test_object_poses_in_millimetres_are_refused():
    recording = make_recording("pressed")
    poses = replace(recording.object_pose, position=1e3 * recording.object_pose.position)
    with pytest.raises(RecordingError, match="/object_pose .* in millimetres?"):
        track_object(replace(recording, object_pose=poses), "left")
