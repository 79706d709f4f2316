"""Claims about what a contact estimator refuses, what it says of it, and that good data serve again afterwards."""

from types import SimpleNamespace

import numpy as np
import pytest
from contact_fakes import FACE, JAW, bent, box, cylinder, opened, pose

from finforce.errors import ObservationError, PoseError
from finforce_contact.contact_session import ContactSession
from finforce_contact.errors import ObjectMeshError
from finforce_contact.estimator import ContactEstimator
from finforce_contact.parameters import MODES, ContactParameters, ContactSettings, TrackerSettings
from finforce_contact.reconstruction import evidence as image_evidence
from finforce_contact.reconstruction import reconstruction
from finforce_ifea.errors import MeshError

RADIUS = 0.0125
NODES = JAW.build_mesh("default").nodes
TOUCHING = pose(FACE + RADIUS - 1e-3, 0.04)
BENT = bent(NODES, 1e-3, 0.04)
FRAME = 1.0 / 30.0


def estimator(mode="estimate"):
    return ContactEstimator(JAW, mesh=cylinder(), settings=ContactSettings(mode=mode))


def serves(estimator, start):
    """Whether a few good images give the contact again."""
    for k in range(5):
        estimator.take_pose(start + k * FRAME, TOUCHING)
        estimate = estimator.update(start + k * FRAME, BENT)
    return estimate.touching and abs(estimate.contact.points[0, 2] - 0.04) < 0.003  # candidates are 5 mm apart


@pytest.mark.parametrize("stamp", [np.nan, np.inf])
def test_stamp_that_is_not_finite_is_refused_and_stops_no_clock(stamp):
    tested = estimator()
    tested.take_pose(0.0, TOUCHING)
    with pytest.raises(PoseError, match="stamp"):
        tested.take_pose(stamp, TOUCHING)
    with pytest.raises(ObservationError, match="stamp"):
        tested.update(stamp, BENT)
    assert serves(tested, FRAME)


def test_pose_far_ahead_of_the_image_gives_no_contact():
    tested = estimator()
    tested.take_pose(3600.0, TOUCHING)
    estimate = tested.update(0.0, BENT)
    assert (estimate.status, estimate.contact) == ("no_pose", None)
    assert "3600.0 s ahead; reset" in estimate.message
    assert serves(tested, 3600.0 + FRAME)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("distance", [1.5, 10.0, 1e6])
def test_object_out_of_reach_gives_no_contact_and_no_error(mode, distance):
    tested = estimator(mode)
    tested.take_pose(0.0, pose(FACE + distance, 0.04))
    estimate = tested.update(0.0, NODES)
    assert (estimate.status, len(estimate.contact.points), estimate.contact.outline) == ("apart", 0, None)
    assert "does not stand before" in estimate.message
    assert serves(tested, 5.0)


def test_object_that_leaves_the_finger_gives_no_outline():
    tested = ContactEstimator(JAW, mesh=box((0.03, 0.03, 0.03)))
    edge = 0.015 + tested.face.half_width
    # all steps together are worth a new outline
    shifts, seen = (-1.0e-3, -0.2e-3, 0.05e-3), []
    for k, shift in enumerate(shifts):
        tested._poses.reset()
        tested.take_pose(k * FRAME, pose(0.2, 0.04, y=edge + shift))
        seen.append(tested.update(k * FRAME, NODES))
    assert len(seen[1].contact.points) and seen[1].contact.outline is not None
    assert (seen[2].status, len(seen[2].contact.points), seen[2].contact.outline) == ("apart", 0, None)


SURFACES = {
    "millimetres": (1e3 * NODES, "in metres"),
    "zeros": (0.0 * NODES, "from its place at rest"),
    "order": (NODES[::-1], "order of the mesh"),
    "nan": (NODES * np.nan, "not finite"),
    "short": (NODES[:-1], "expected"),
}


@pytest.mark.parametrize("name", SURFACES)
def test_surface_of_no_jaw_is_refused(name):
    surface, word = SURFACES[name]
    tested = estimator("paper")
    tested.take_pose(0.0, TOUCHING)
    with pytest.raises(MeshError, match=word):
        tested.update(0.0, surface)
    assert serves(tested, FRAME)


@pytest.mark.parametrize("covariance", [np.zeros((6, 6)), np.full((6, 6), np.nan), -np.eye(6), np.eye(3)])
def test_covariance_that_is_none_is_refused(covariance):
    tested = estimator()
    with pytest.raises(PoseError, match="covariance"):
        tested.take_pose(0.0, TOUCHING, covariance)
    assert serves(tested, FRAME)


@pytest.mark.parametrize("mode", MODES)
def test_same_input_gives_the_same_bits(mode):
    def run():
        random, tested, said = np.random.default_rng(0), estimator(mode), []
        for k in range(60):
            T = TOUCHING.copy()
            T[:3, 3] += 3e-4 * random.standard_normal(3)
            tested.take_pose(k * FRAME, T)
            estimate = tested.update(k * FRAME, BENT)
            said += [estimate.status.encode(), estimate.contact.points.tobytes(), estimate.T_jaw_object.tobytes()]
        return b"".join(said)

    assert run() == run()


def test_reconstructed_mesh_that_the_mode_cannot_use_leaves_the_object_as_it_was(monkeypatch):
    parameters = ContactParameters(pose_source="tracker")
    session = ContactSession(parameters, ContactSettings(mode="paper"), TrackerSettings())
    session._set_object(cylinder())
    found = SimpleNamespace(mesh=opened(cylinder()), T_camera_object=np.eye(4), method="paper")
    monkeypatch.setattr(session.camera, "view", lambda: SimpleNamespace(depth=None, mask=None, camera=None))
    monkeypatch.setattr(image_evidence, "collect_evidence", lambda *_: None)
    monkeypatch.setattr(reconstruction, "reconstruct", lambda *_: found)
    with pytest.raises(ObjectMeshError, match="watertight"):
        session.reconstruct(parameters)
    assert session.mesh.name == "cylinder"
    tested = session.jaws["left"].loop.estimator
    assert serves(tested, 0.0)
