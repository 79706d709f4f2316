"""Claims about outlines as point clouds, and about the feed that joins them with contacts."""

from types import SimpleNamespace

import numpy as np
import pytest

from finforce.errors import ObservationError
from finforce.messages import encode_cloud
from finforce_ifea.errors import ContactError
from finforce_ifea.messages import MOST_CORNERS, MOST_ROWS, ContactFeed, columns_from_outline, outline_from_columns
from finforce_ifea.observation import ObjectOutline

MS = 1_000_000
SQUARE = np.array([[-0.03, -0.02], [0.03, -0.02], [0.03, 0.02], [-0.03, 0.02]])
HOLE = 0.3 * SQUARE[::-1] + 0.001


def outline(origin=(0.05, 0.04), tilt=0.3, polygons=(SQUARE, HOLE)):
    stddev = np.array([3e-4, 4e-4, 5e-3])
    return ObjectOutline(polygons=polygons, origin=np.array(origin), tilt=tilt, stddev=stddev)


@pytest.mark.parametrize("tilt", [0.0, 0.3, -3.1, 2.0])
def test_decoding_inverts_encoding(tilt):
    sent = outline(tilt=tilt)
    got = outline_from_columns(columns_from_outline(sent))
    assert len(got.polygons) == 2
    for one, other in zip(got.polygons, sent.polygons, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8)  # float32 of centimetres
    np.testing.assert_allclose(got.origin, sent.origin, atol=1e-7)
    assert got.tilt == pytest.approx(tilt, abs=1e-6)
    np.testing.assert_allclose(got.stddev, sent.stddev, rtol=1e-6)


def test_the_corners_are_where_the_outline_is_now():
    columns = columns_from_outline(outline())
    np.testing.assert_allclose(columns["x"][:4], outline().placed()[0][:, 0], atol=1e-8)
    np.testing.assert_allclose(columns["z"][4:], outline().placed()[1][:, 1], atol=1e-8)
    assert columns["polygon"].tolist() == [0] * 4 + [1] * 4 and columns["polygon"].dtype == np.uint16


def test_no_outline_has_no_rows_and_back():
    columns = columns_from_outline(None)
    assert all(len(column) == 0 for column in columns.values())
    assert outline_from_columns(columns) is None


def test_polygons_stay_the_same_object_until_they_are_cut_anew():
    first = outline_from_columns(columns_from_outline(outline()))
    moved = outline_from_columns(columns_from_outline(outline((0.049, 0.041), 0.31)), first)
    assert moved.polygons is first.polygons
    anew = outline_from_columns(columns_from_outline(outline(polygons=(SQUARE * 1.01, HOLE))), moved)
    assert anew.polygons is not first.polygons
    fewer = outline_from_columns(columns_from_outline(outline(polygons=(SQUARE,))), anew)
    assert len(fewer.polygons) == 1


def test_corners_that_are_no_turned_copy_are_refused():
    columns = columns_from_outline(outline())
    columns["x"] = -columns["x"]
    with pytest.raises(ContactError, match="turned and shifted"):
        outline_from_columns(columns)


@pytest.mark.parametrize("name", ["x", "u", "stddev_x"])
def test_an_outline_that_is_not_finite_is_refused(name):
    columns = columns_from_outline(outline())
    columns[name] = np.full_like(columns[name], np.nan)
    with pytest.raises(ContactError):
        outline_from_columns(columns)


def cloud(columns, frame="left_jaw"):
    encoded = encode_cloud(columns)
    width = len(next(iter(columns.values())))
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=frame),
        height=1,
        width=width,
        fields=encoded.fields,
        data=encoded.data,
        point_step=encoded.point_step,
        row_step=len(encoded.data),
        is_bigendian=False,
    )


def contact_cloud(rows=1):
    place = np.array([[0.014], [0.0], [0.04]], dtype=np.float32) * np.ones(rows, dtype=np.float32)
    return cloud(dict(zip("xyz", place, strict=True)))


def outline_message(**kwargs):
    return cloud(columns_from_outline(outline(**kwargs)))


@pytest.fixture
def feed():
    return ContactFeed(frame="left_jaw", fixed=None, free=False, max_age=200 * MS)


def test_a_contact_carries_the_outline_while_it_is_fresh(feed):
    feed.take(contact_cloud(), 100 * MS)
    assert feed.at(100 * MS).outline is None
    feed.take_outline(outline_message(), 100 * MS)
    held = feed.at(100 * MS)
    assert held.outline.tilt == pytest.approx(0.3)
    assert feed.at(133 * MS) is held
    feed.take(contact_cloud(), 200 * MS)
    assert feed.at(300 * MS).outline is held.outline
    assert feed.at(301 * MS).outline is None


def test_no_object_has_no_outline(feed):
    feed.take_outline(outline_message(), 100 * MS)
    feed.take(contact_cloud(rows=0), 100 * MS)
    assert feed.at(100 * MS).outline is None
    feed.take(contact_cloud(), 133 * MS)
    assert feed.at(133 * MS).outline is not None
    feed.take_outline(cloud(columns_from_outline(None)), 166 * MS)
    assert feed.at(166 * MS).outline is None


def test_an_outline_that_cannot_be_read_leaves_none(feed):
    feed.take(contact_cloud(), 100 * MS)
    feed.take_outline(outline_message(), 100 * MS)
    with pytest.raises(ObservationError, match="base_link"):
        feed.take_outline(cloud(columns_from_outline(outline()), frame="base_link"), 101 * MS)
    assert feed.at(101 * MS).outline is None
    broken = columns_from_outline(outline())
    del broken["u"]
    with pytest.raises(ObservationError, match="no field u"):
        feed.take_outline(cloud(broken), 102 * MS)


@pytest.mark.parametrize("name", ["x", "stddev_z"])
def test_an_outline_with_infinite_numbers_is_refused(name):
    columns = columns_from_outline(outline())
    columns[name] = np.full_like(columns[name], np.inf)
    with pytest.raises(ContactError, match="not finite"):
        outline_from_columns(columns)


def test_a_polygon_without_a_number_is_refused():
    columns = columns_from_outline(outline())
    columns["polygon"] = np.full(len(columns["x"]), np.nan, np.float32)
    with pytest.raises(ContactError, match="not finite"):
        outline_from_columns(columns)


def test_clouds_that_cannot_be_solved_in_time_are_refused(feed):
    feed.take(contact_cloud(rows=MOST_ROWS), 100 * MS)
    with pytest.raises(ObservationError, match=f"expected {MOST_ROWS} at most"):
        feed.take(contact_cloud(rows=MOST_ROWS + 1), 101 * MS)
    assert feed.at(101 * MS) is None
    angle = np.linspace(0.0, 6.28, MOST_CORNERS + 1)
    circle = 0.0125 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    with pytest.raises(ObservationError, match=f"expected {MOST_CORNERS} at most"):
        feed.take_outline(outline_message(polygons=(circle,)), 102 * MS)


def test_fields_of_several_numbers_are_refused(feed):
    feed.take(contact_cloud(), 100 * MS)
    wide = cloud(
        {"x": np.full((1, 3), 0.014, np.float32), "y": np.zeros(1, np.float32), "z": np.full(1, 0.04, np.float32)}
    )
    with pytest.raises(ObservationError, match="several numbers in the field x"):
        feed.take(wide, 101 * MS)
    assert feed.at(101 * MS) is None
    columns = columns_from_outline(outline())
    columns["u"] = np.stack([columns["u"]] * 2, axis=1)
    with pytest.raises(ObservationError, match="several numbers in the field u"):
        feed.take_outline(cloud(columns), 102 * MS)


def test_the_same_polygons_serve_on_after_an_interruption(feed):
    feed.take(contact_cloud(), 0)
    feed.take_outline(outline_message(), 0)
    polygons = feed.at(0).outline.polygons
    feed.take_outline(cloud(columns_from_outline(None)), MS)
    feed.take_outline(outline_message(origin=(0.051, 0.04)), 2 * MS)
    assert feed.at(2 * MS).outline.polygons is polygons
