"""Claims about messages as observations, contacts and forces."""

from types import SimpleNamespace

import numpy as np
import pytest

from finforce.errors import ObservationError
from finforce.messages import encode_cloud
from finforce_ifea.errors import ContactError
from finforce_ifea.messages import contact_from_cloud, observation_from_cloud

FRAME = "left_jaw"


def cloud_of(frame=FRAME, **columns):
    """What a subscription or a bag gives, as plain attributes."""
    encoded = encode_cloud(columns)
    header = SimpleNamespace(frame_id=frame, stamp=SimpleNamespace(sec=7, nanosec=250_000_000))
    return SimpleNamespace(
        header=header,
        height=1,
        width=len(columns["x"]),
        fields=encoded.fields,
        point_step=encoded.point_step,
        row_step=len(encoded.data),
        is_bigendian=False,
        data=encoded.data,
    )


def xyz(points):
    return dict(zip("xyz", np.asarray(points, dtype=np.float32).reshape(-1, 3).T, strict=True))


def test_key_points_become_an_observation():
    observation = observation_from_cloud(cloud_of(**xyz([[1, 2, 3], [4, np.nan, 6]]), likelihood=[0.5, 0.25]), FRAME)
    assert observation.stamp == 7.25
    np.testing.assert_array_equal(observation.points, [[1, 2, 3], [4, np.nan, 6]])
    np.testing.assert_array_equal(observation.likelihood, [0.5, 0.25])


def test_another_frame_is_refused_by_both_names():
    with pytest.raises(ObservationError, match="'camera'.*'left_jaw'"):
        observation_from_cloud(cloud_of("camera", **xyz([[1, 2, 3]])), FRAME)


def test_several_rows_are_refused():
    cloud = cloud_of(**xyz(np.zeros((4, 3))))
    cloud.height, cloud.width = 2, 2
    with pytest.raises(ObservationError, match="2 x 2"):
        observation_from_cloud(cloud, FRAME)


def test_a_contact_has_places_weights_and_touch():
    rows = {
        **xyz([[0.014, 0, 0.03], [0.014, 0, 0.04]]),
        "weight": [0.25, 0.75],
        "touching": np.array([0, 1], np.uint8),
    }
    contact = contact_from_cloud(cloud_of(**rows), FRAME, free=True)
    np.testing.assert_allclose(contact.points[:, 2], [0.03, 0.04], atol=1e-8)
    np.testing.assert_array_equal(contact.weights, [0.25, 0.75])
    assert contact.touching is True and contact.free is True


def test_a_contact_without_weights_counts_its_rows_alike_and_does_not_say_whether_it_touches():
    contact = contact_from_cloud(cloud_of(**xyz([[0.014, 0, 0.03], [0.014, 0, 0.04]])), FRAME, free=False)
    np.testing.assert_array_equal(contact.weights, [1.0, 1.0])
    assert contact.touching is None and contact.free is False


def test_no_rows_are_no_contact_and_no_error():
    contact = contact_from_cloud(cloud_of(**xyz(np.empty((0, 3)))), FRAME, free=False)
    assert contact.points.shape == (0, 3) and contact.touching is False


@pytest.mark.parametrize("rows", [{**xyz([[0.014, np.nan, 0.03]])}, {**xyz([[0.014, 0, 0.03]]), "weight": [np.inf]}])
def test_a_contact_that_is_not_finite_is_refused(rows):
    with pytest.raises(ContactError, match="not finite"):
        contact_from_cloud(cloud_of(**rows), FRAME, free=False)
