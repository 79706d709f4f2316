"""Claims about poses that another program publishes."""

from types import SimpleNamespace

import numpy as np
import pytest

from finforce.errors import ObservationError, PoseError
from finforce.messages import CameraStream
from finforce_contact.contact_session import ContactSession
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.parameters import ContactParameters, ContactSettings, TrackerSettings
from finforce_contact.pose.source import ExternalPoseSource
from finforce_contact.pose.tracker import check_camera_outside
from finforce_sim.objects import build_object

FRAME = "camera_color_optical_frame"
CORNERS = np.array([[x, y, z] for x in (-0.03, 0.03) for y in (-0.03, 0.03) for z in (-0.03, 0.03)])
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
TRIANGLES = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])
BOX = ObjectMesh(vertices=CORNERS, triangles=TRIANGLES, watertight=True, name="box")
UNSET = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def pose_message(position=(0.0, 0.01, 0.3), quaternion=(0.0, 0.0, 0.6, 0.8)):
    return SimpleNamespace(
        position=SimpleNamespace(**dict(zip("xyz", position, strict=True))),
        orientation=SimpleNamespace(**dict(zip("xyzw", quaternion, strict=True))),
    )


def header(stamp=12.5, frame=FRAME):
    seconds = int(stamp)
    return SimpleNamespace(frame_id=frame, stamp=SimpleNamespace(sec=seconds, nanosec=round((stamp - seconds) * 1e9)))


def stamped(stamp=12.5, frame=FRAME, **pose):
    return SimpleNamespace(header=header(stamp, frame), pose=pose_message(**pose))


def detections(center=UNSET, results=()):
    result_list = [SimpleNamespace(pose=SimpleNamespace(pose=pose_message(*result))) for result in results]
    detection = SimpleNamespace(bbox=SimpleNamespace(center=pose_message(*center)), results=result_list)
    return SimpleNamespace(header=header(), detections=[detection])


@pytest.fixture
def source():
    return ExternalPoseSource(CameraStream(FRAME), mesh=BOX)


def test_a_pose_is_taken_as_it_is_with_its_stamp(source):
    pose = source.take(stamped())
    assert source.latest is pose
    assert np.allclose(pose.T_camera_object[:3, 3], [0.0, 0.01, 0.3])
    assert np.allclose(pose.T_camera_object[:3, 0], [0.28, 0.96, 0.0])  # cos and sin of 2 atan(0.6 / 0.8)
    assert pose.stamp == pytest.approx(12.5, abs=1e-9)


def test_the_box_of_a_detection_comes_before_its_results(source):
    place = ((0.0, 0.0, 0.4), (0.0, 0.0, 0.0, 1.0))
    other = ((0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0))
    assert source.take(detections(place, [other])).T_camera_object[2, 3] == 0.4


def test_results_of_a_detection_stand_in_for_an_unset_box(source):
    other = ((0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0))
    assert source.take(detections(results=[other])).T_camera_object[2, 3] == 0.5


def test_a_box_that_is_turned_but_not_moved_is_not_unset():
    turned = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
    source = ExternalPoseSource(CameraStream(FRAME))
    assert source.take(detections(turned)).T_camera_object[0, 0] == pytest.approx(-1.0)


def test_no_detection_is_a_valid_empty_result(source):
    assert source.take(SimpleNamespace(header=header(), detections=[])) is None
    assert source.latest is None


@pytest.mark.parametrize("results", [(), (UNSET,)])
def test_a_detection_without_any_pose_is_refused(source, results):
    with pytest.raises(PoseError, match="neither"):
        source.take(detections(results=results))


@pytest.mark.parametrize(
    "message",
    [
        stamped(frame="base_link"),
        stamped(position=(np.nan, 0.0, 0.3)),
        stamped(quaternion=(0.0, 0.0, 0.0, 0.0)),
        stamped(quaternion=(0.0, 0.0, 0.6, 0.9)),
        stamped(position=(0.0, 0.0, 0.01)),
    ],
)
def test_a_refused_pose_does_not_replace_the_last_one(source, message):
    kept = source.take(stamped(stamp=11.0))
    with pytest.raises((PoseError, ObservationError)):
        source.take(message)
    assert source.latest is kept


def test_a_pose_must_be_newer_than_the_last_until_a_reset(source):
    source.take(stamped(stamp=12.0))
    with pytest.raises(PoseError, match="reset"):
        source.take(stamped(stamp=12.0))
    source.reset()
    assert source.latest is None
    assert source.take(stamped(stamp=12.0)).stamp == 12.0


def test_only_a_pose_around_the_camera_is_refused():
    T = np.eye(4)
    T[:3, 3] = 0.0, 0.0, 0.0301  # the camera is 0.1 mm in front of the box
    assert np.allclose(check_camera_outside(T, BOX), T)
    T[2, 3] = 0.0299
    with pytest.raises(PoseError, match="inside the object 'box'"):
        check_camera_outside(T, BOX)


def test_a_camera_that_looks_into_a_mug_is_outside_of_it():
    mug, T = build_object("mug"), np.eye(4)
    assert np.allclose(check_camera_outside(T, mug), T)
    T[:3, 3] = -mug.vertices[mug.vertices[:, 2].argmin()] * (0.5, 0.5, 0.97)  # within the bottom
    with pytest.raises(PoseError, match="inside the object 'mug'"):
        check_camera_outside(T, mug)


def test_a_jaw_says_the_frame_where_nobody_has_named_it():
    """What had come of the object in another frame, before, is forgotten."""
    session = ContactSession(ContactParameters(), ContactSettings(), TrackerSettings())
    session.read_pose(stamped(stamp=1.0, frame="map"))
    assert session.stream.frame == "map" and session.pose is not None
    session.take_jaw_pose("left", stamped(stamp=1.1, frame="my_cam_optical"))
    assert session.stream.frame == "my_cam_optical" and session.pose is None
    for take in (session.read_pose, lambda message: session.take_jaw_pose("left", message)):
        with pytest.raises(ObservationError, match="'map'; expected 'my_cam_optical'"):
            take(stamped(stamp=1.2, frame="map"))
    assert session.read_pose(stamped(stamp=1.3, frame="my_cam_optical")) is not None
