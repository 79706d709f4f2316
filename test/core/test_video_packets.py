"""Claims about pictures of H.264 that come packet by packet: each is right, or there is none."""

import re

import numpy as np
import pytest
from packet_fakes import KEY_EVERY, draw_pictures, encode_packets, packet_message

from finforce.camera import ImageError
from finforce.messages import CameraStream, color_from_message
from finforce.video_packets import MissingFrameError, PacketDecoder

PERIOD = 33_333_333  # [ns]
PICTURES = draw_pictures(3 * KEY_EVERY)
START = re.compile(b"\0\0\0?\1")  # of a unit


@pytest.fixture(scope="module")
def packets():
    return encode_packets(PICTURES)


def decode_all(packets, numbers=None, decoder=None):
    """The pictures by number that packets, None for one that does not come, give."""
    decoder, found = decoder or PacketDecoder(), {}
    for number, data in zip(numbers or range(len(packets)), packets, strict=True):
        try:
            found[number] = decoder.decode(data, number * PERIOD, "image") if data else None
        except MissingFrameError:
            found[number] = None
    return found


def is_right(picture, number):
    return np.abs(picture.astype(int) - PICTURES[number]).mean() < 5.0  # of 255, by compression


def known(found):
    """Numbers of the pictures that there are, each of which has to be right."""
    numbers = [number for number, picture in found.items() if picture is not None]
    assert all(is_right(found[number], number) for number in numbers)
    return numbers


def test_every_packet_gives_its_picture(packets):
    assert known(decode_all(packets)) == list(range(len(PICTURES)))
    assert not is_right(PICTURES[0], 5)


def test_there_is_no_picture_before_the_first_key_frame(packets):
    assert known(decode_all(packets[3:], range(3, len(packets)))) == list(range(KEY_EVERY, len(packets)))


@pytest.mark.parametrize("slices", [1, 3])
@pytest.mark.parametrize("options", [{}, {"profile": "baseline"}, {"profile": "high"}], ids=str)
@pytest.mark.parametrize("lost", [1, 5, 8])
def test_behind_a_lost_packet_there_is_no_picture_up_to_the_next_key_frame(options, slices, lost):
    packets = encode_packets(PICTURES, **options, **{"x264-params": f"slices={slices}"})
    packets[lost] = None
    assert known(decode_all(packets)) == [*range(lost), *range(KEY_EVERY, len(packets))]


def test_a_lost_key_frame_takes_those_behind_it_with_it(packets):
    lost = [*packets[:KEY_EVERY], None, *packets[KEY_EVERY + 1 :]]
    assert known(decode_all(lost)) == [*range(KEY_EVERY), *range(2 * KEY_EVERY, len(packets))]


def cut_in_half(data):
    return data[: len(data) // 2]


def drop_last_slice(data):
    return data[: [each.start() for each in START.finditer(data)][-1]]


def drop_first_slice(data):
    starts = [each.start() for each in START.finditer(data)]
    return data[: starts[-3]] + data[starts[-2] :]


@pytest.mark.parametrize("damage", [cut_in_half, drop_last_slice, drop_first_slice, lambda data: data[:7]])
@pytest.mark.parametrize("number", [4, KEY_EVERY])
def test_a_damaged_packet_gives_no_picture_nor_do_those_behind_it(number, damage):
    packets = encode_packets(PICTURES, **{"x264-params": "slices=3"})
    packets[number] = damage(packets[number])
    following = number - number % KEY_EVERY + KEY_EVERY
    assert known(decode_all(packets)) == [*range(number), *range(following, len(packets))]


def test_packets_of_a_stream_that_begins_anew_wait_for_its_key_frame(packets):
    decoder = PacketDecoder()
    decode_all(packets[:4], decoder=decoder)
    with pytest.raises(MissingFrameError, match="expected a key frame"):  # its frame number would be the next one
        decoder.decode(packets[4], 0, "image")


def test_a_decoder_that_was_reset_waits_for_a_key_frame(packets):
    decoder = PacketDecoder()
    decode_all(packets[:4], decoder=decoder)
    decoder.reset()
    assert known(decode_all(packets[4:], range(4, len(packets)), decoder)) == [*range(KEY_EVERY, len(packets))]


def test_pictures_that_come_later_than_their_packets_are_refused():
    packets = encode_packets(PICTURES, tune="film", bf="2")
    with pytest.raises(ImageError, match="expected H.264 without B-frames"):
        decode_all(packets)


@pytest.mark.parametrize("form", ["h265", "hevc", "video/h265"])
def test_packets_of_h265_are_named(packets, form):
    with pytest.raises(ImageError, match=r"a packet of a video, no picture by itself; expected JPEG or PNG, or H\.264"):
        color_from_message(packet_message(packets[0], 0, form))


@pytest.mark.parametrize("form", ["h264", "video/h264", "rgb8; h264 packet", "H264"])
def test_a_camera_brings_packets_as_compressed_images(packets, form):
    stream = CameraStream()
    found = [stream.read_color(packet_message(data, number * PERIOD, form)) for number, data in enumerate(packets[:5])]
    assert all(is_right(picture, number) for number, picture in enumerate(found))
    with pytest.raises(MissingFrameError):
        color_from_message(packet_message(packets[5], 0, form))  # whose predecessors nobody remembers


def test_random_bytes_behind_a_start_code_are_no_picture():
    rng = np.random.default_rng(0)
    for size in [0, 1, 2, 40, 4000] * 20:
        with pytest.raises(ImageError):
            PacketDecoder().decode(b"\0\0\0\1" + rng.bytes(size), 0, "image")
