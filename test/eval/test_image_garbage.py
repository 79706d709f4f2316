"""Claims about damaged recordings of images: what cannot be a picture is named, briefly, and takes no memory."""

import struct
import zlib

import numpy as np
import pytest

from finforce.camera import ImageError
from finforce.messages import color_from_message, depth_from_message
from finforce_eval.evaluation.keypoint_source import count_reasons
from finforce_eval.recordings.images import compress_depth, encode_color

DEPTH = np.random.default_rng(1).integers(100, 200, (48, 64), dtype=np.uint16)
COLOR = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)


class Compressed:
    def __init__(self, data, format="jpeg"):
        self.data, self.format = data, format


def claim_size(width, height):
    """A png of a few bytes that says it is of some size."""

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(12_000, 12_000), (60_000, 60_000), (2**31 - 1, 2**31 - 1)])
def test_a_small_file_that_claims_to_be_a_huge_picture_is_refused(size):
    for read in (color_from_message, depth_from_message):
        with pytest.raises(ImageError, match="expected at most|damaged"):
            read(Compressed(claim_size(*size), "png"))


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.3, 0.9])
def test_a_picture_that_was_cut_short_is_named_in_one_line(share):
    for read, data, said in (
        (color_from_message, encode_color(COLOR), "rgb8; jpeg compressed bgr8"),
        (depth_from_message, compress_depth(DEPTH), "16UC1; compressedDepth png"),
    ):
        with pytest.raises(ImageError) as caught:
            read(Compressed(data[: int(share * len(data))], said))
        assert said in str(caught.value) and "0x" not in str(caught.value) and "\n" not in str(caught.value)


def test_other_kinds_of_pictures_and_odd_words_are_named():
    gif = b"GIF89a" + bytes(100)
    with pytest.raises(ImageError, match="neither jpeg nor png") as caught:
        color_from_message(Compressed(gif, "a\x00\nb"))
    assert "\n" not in str(caught.value)
    with pytest.raises(ImageError, match="a packet of a video.*or H.264 of colours: record raw or compressed images"):
        color_from_message(Compressed(b"\0\0\0\1\x67" + bytes(100), "h265"))


def test_inverse_depths_of_float_images_are_not_taken_for_millimetres():
    data = compress_depth(DEPTH)
    for said in ("16UC1; compressedDepth png", "mono16; compressedDepth", "png", ""):
        np.testing.assert_allclose(depth_from_message(Compressed(data, said)), DEPTH * 1e-3, rtol=1e-6)
    with pytest.raises(ImageError, match="32FC1"):
        depth_from_message(Compressed(data, "32FC1; compressedDepth png"))
    with pytest.raises(ImageError, match="no png in it; expected .*depth=none"):
        depth_from_message(Compressed(data[40:], "16UC1; jpeg compressed mono8"))


def test_reasons_that_differ_in_numbers_are_one_note():
    texts = [f"frozen camera: {number} identical pictures" for number in range(6, 100)]
    assert count_reasons([*texts, "black image: 3 of 255"]) == {
        "frozen camera: 6 identical pictures": 94,
        "black image: 3 of 255": 1,
    }
    assert count_reasons([]) == {}
