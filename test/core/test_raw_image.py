"""Claims about images read from the bytes of a message; the other end is the serialisation of ROS itself."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from keypoint_node_fakes import image_of
from rclpy.serialization import serialize_message

from finforce.camera import ImageError
from finforce.ros.raw_image import read_image

STAMP = 1_700_000_000_123_456_789
PICTURE = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)


@settings(max_examples=40)
@given(frame=st.text(st.characters(codec="utf-8", exclude_characters="\0", exclude_categories=("Cs",)), max_size=9))
@pytest.mark.parametrize("encoding", ["rgb8", "mono8", "16UC1", ""])
def test_a_message_is_read_as_ros_has_written_it(frame, encoding):
    message = image_of(STAMP, PICTURE, encoding, frame=frame)
    read = read_image(serialize_message(message))
    assert (read.header.frame_id, read.encoding) == (frame, encoding)
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == divmod(STAMP, 10**9)
    assert (read.height, read.width, read.step, read.is_bigendian) == (5, 7, 21, 0)
    assert bytes(read.data) == PICTURE.tobytes()


def test_the_data_are_a_view_of_the_bytes_that_came():
    data = serialize_message(image_of(STAMP, PICTURE, "rgb8"))
    seen = np.frombuffer(read_image(data).data, dtype=np.uint8)
    assert np.shares_memory(seen, np.frombuffer(data, dtype=np.uint8))


def test_the_other_byte_order_is_read_too():
    words = [b"\x00\x00\x00\x00", np.array([1, 2, 3], ">u4").tobytes(), b"ab\0\0", np.array([5, 7, 5], ">u4").tobytes()]
    words += [b"rgb8\0", b"\x01", b"\0\0", np.array([21, 2], ">u4").tobytes(), b"xy"]
    read = read_image(b"".join(words))
    assert (read.header.stamp.sec, read.header.stamp.nanosec, read.header.frame_id) == (1, 2, "ab")
    assert (read.height, read.width, read.encoding, read.step, bytes(read.data)) == (5, 7, "rgb8", 21, b"xy")


@settings(max_examples=60)
@given(cut=st.integers(0, 160))
def test_a_message_that_is_cut_off_is_no_image(cut):
    data = serialize_message(image_of(STAMP, PICTURE, "rgb8"))
    cut = min(cut, PICTURE.nbytes + 40)
    with pytest.raises(ImageError, match="bytes are no image"):
        read_image(data[: len(data) - 4 - cut])


@settings(max_examples=60)
@given(data=st.binary(max_size=80))
def test_garbage_is_refused_or_read_but_never_breaks(data):
    with suppress(ImageError):
        read_image(data)
