"""Claims about the decoding of point clouds."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from finforce.errors import ObservationError
from finforce.messages import PointField, decode_columns, decode_keypoints, encode_cloud

NAMES = ("x", "y", "z", "likelihood", "candidate")
TYPES = ("i1", "u1", "<i2", "<u2", "<i4", "<u4", "<f4", "<f8")


def packed(columns):
    """A cloud of one row."""
    encoded = encode_cloud(columns)
    rows = len(next(iter(columns.values())))
    return SimpleNamespace(
        fields=encoded.fields,
        data=encoded.data,
        width=rows,
        height=1,
        point_step=encoded.point_step,
        row_step=encoded.point_step * rows,
        is_bigendian=False,
    )


@st.composite
def tables(draw):
    rows = draw(st.integers(1, 6))
    names = draw(st.permutations(NAMES))
    return {name: draw(hnp.arrays(draw(st.sampled_from(TYPES)), rows)) for name in names}


@given(tables())
def test_decode_inverts_encode(columns):
    decoded = decode_columns(packed(columns), NAMES)
    for name, values in columns.items():
        assert decoded[name].dtype == values.dtype.newbyteorder("=")
        np.testing.assert_array_equal(decoded[name], values)


def test_order_offset_type_padding_rows_and_byte_order_do_not_matter():
    layout = np.dtype(
        {"names": ["z", "x", "y"], "formats": [">f8", ">f4", ">i2"], "offsets": [16, 3, 8], "itemsize": 29}
    )
    table = np.zeros((2, 3), dtype=layout)
    table["x"] = [[1, 2, 3], [4, 5, 6]]
    table["y"], table["z"] = 7, -0.25
    data = b"".join(row.tobytes() + b"padding" for row in table)[:-7]
    fields = [PointField("y", 8, 3), PointField("rgb", 24, 6), PointField("z", 16, 8), PointField("x", 3, 7)]
    cloud = SimpleNamespace(fields=fields, data=data, width=3, height=2, point_step=29, row_step=94, is_bigendian=True)
    decoded = decode_columns(cloud, ("x", "y", "z"))
    np.testing.assert_array_equal(decoded["x"], [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(decoded["y"], [7] * 6)
    np.testing.assert_array_equal(decoded["z"], [-0.25] * 6)
    assert decoded["x"].dtype.isnative


def test_several_elements_per_field_are_refused():
    with pytest.raises(ObservationError, match="field 'x' has 3 numbers a point; expected count 1"):
        decode_columns(packed({"x": np.arange(6.0).reshape(2, 3)}), ["x"])


def test_empty_cloud_gives_empty_columns():
    empty = SimpleNamespace(fields=(), data=b"", width=0, height=1, point_step=0, row_step=0, is_bigendian=False)
    decoded = decode_columns(empty, ("x", "y"))
    assert decoded["x"].shape == decoded["y"].shape == (0,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"data": b"\0" * 15}, "holds 15 bytes; 16 were announced"),
        ({"data": b""}, "holds 0 bytes"),
        ({"names": ("x", "w")}, "no field w"),
        ({"point_step": 4}, "leaves a point"),
        ({"fields": (PointField("x", 0, 9),), "names": ("x",)}, "unknown datatype 9"),
        ({"height": 2, "row_step": 8}, "row_step is 8"),
    ],
)
def test_malformed_cloud_is_refused_with_the_reason(change, message):
    cloud = {
        "fields": (PointField("x", 0, 7), PointField("y", 4, 7)),
        "data": b"\0" * 16,
        "width": 2,
        "height": 1,
        "point_step": 8,
        "row_step": 16,
        "is_bigendian": False,
        "names": ("x", "y"),
    } | change
    with pytest.raises(ObservationError, match=message):
        decode_columns(SimpleNamespace(**cloud), cloud["names"])


def test_columns_of_different_length_or_unknown_type_are_refused():
    with pytest.raises(ObservationError, match="differ in length"):
        encode_cloud({"x": np.zeros(2), "y": np.zeros(3)})
    with pytest.raises(ObservationError, match="is not a field"):
        encode_cloud({"x": np.zeros(2, dtype=np.int64)})


def test_key_points_without_likelihood_are_certain():
    cloud = packed({"x": np.float32([1, np.nan]), "y": np.float32([2, 2]), "z": np.float32([3, 3])})
    points, likelihood, stddev, shared = decode_keypoints(cloud)
    np.testing.assert_array_equal(points, [[1, 2, 3], [np.nan, 2, 3]])
    np.testing.assert_array_equal(likelihood, [1, 1])
    assert stddev is None and not any(shared)


def test_rows_that_the_detector_calls_invalid_are_not_used():
    columns = {name: np.arange(3, dtype="<f4") for name in ("x", "y", "z", "likelihood")}
    cloud = packed({**columns, "valid": np.array([1, 0, 1], dtype="u1")})
    points, *_ = decode_keypoints(cloud)
    assert np.isnan(points[1]).all()
    np.testing.assert_array_equal(points[[0, 2]], [[0, 0, 0], [2, 2, 2]])


def keypoint_cloud(**columns):
    return packed({name: np.arange(3, dtype="<f4") for name in "xyz"} | columns)


def stated(*values):
    return {f"stddev_{axis}": np.float32(values) for axis in "xyz"}


def test_stated_deviations_come_with_the_points():
    columns = {f"stddev_{axis}": np.float32([i + 1, i + 2, i + 3]) for i, axis in enumerate("xyz")}
    found = decode_keypoints(keypoint_cloud(**columns))
    np.testing.assert_array_equal(found.stddev, [[1, 2, 3], [2, 3, 4], [3, 4, 5]])


def test_a_row_that_is_not_valid_need_not_state_a_deviation():
    cloud = keypoint_cloud(**stated(1, np.nan, 1), valid=np.array([1, 0, 1], dtype="u1"))
    found = decode_keypoints(cloud)
    assert np.isnan(found.points[1]).all() and np.isfinite(found.points[[0, 2]]).all()


@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan, np.inf])
def test_a_valid_row_with_a_deviation_that_is_none_is_refused(value):
    cloud = keypoint_cloud(**stated(1, value, 1), valid=np.array([1, 1, 1], dtype="u1"))
    with pytest.raises(ObservationError, match="key point 1 states the standard deviation .* along x"):
        decode_keypoints(cloud)


def test_some_of_the_deviations_without_the_others_are_refused():
    columns = stated(1, 1, 1)
    del columns["stddev_y"]
    with pytest.raises(ObservationError, match="stddev_x, stddev_z; expected all of stddev_x, stddev_y, stddev_z"):
        decode_keypoints(keypoint_cloud(**columns))
