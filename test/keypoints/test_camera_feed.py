"""Claims about which of several colour topics is the camera's; no ROS runs."""

from contextlib import suppress
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pytest
from keypoint_node_fakes import COLOR, HEIGHT, OLD_COLOR, TOPICS, WIDTH, camera_info, image_of
from packet_fakes import KEY_EVERY, draw_pictures, encode_packets, packet_message

from finforce.camera import ImageError
from finforce.errors import ObservationError
from finforce.video_packets import MissingFrameError
from finforce_keypoints.errors import SyncError
from finforce_keypoints.images import COLOR as COLORS
from finforce_keypoints.images import DEPTH as DEPTHS
from finforce_keypoints.images import SILENCE, RgbdFeed, check_image
from finforce_keypoints.parameters import DetectorParameters

PERIOD = 0.03  # s


@dataclass
class Camera:
    """Feeds images of one topic at a time, on a clock of its own."""

    now: float = 0.0
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    depth: str = "aligned"

    def __post_init__(self):
        self.feed = RgbdFeed(replace(TOPICS, depth=self.depth), lambda: self.now)
        self.feed.stream.take_info(camera_info())

    def shoot(self, topic, picture=None):
        """Whether an image of a topic became a whole one."""
        self.now += PERIOD
        stamp = round(1e9 * self.now)
        if picture is None:
            picture = self.rng.integers(90, 160, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        self.feed.take_depth(image_of(stamp, np.full((HEIGHT, WIDTH), 120, dtype=np.uint16), "16UC1"))
        return bool(self.feed.take_color(topic, image_of(stamp, picture, "rgb8")))


def test_a_camera_that_comes_back_under_the_other_name_is_taken_after_a_silence():
    camera = Camera()
    assert camera.feed.source == f"{COLOR} or {OLD_COLOR}"
    assert camera.shoot(COLOR) and camera.feed.source == COLOR
    camera.now += SILENCE + PERIOD
    assert camera.shoot(OLD_COLOR) and camera.feed.source == OLD_COLOR
    assert not camera.shoot(COLOR)
    camera.now += SILENCE + PERIOD
    assert camera.shoot(COLOR)


def test_while_one_topic_speaks_the_other_is_not_listened_to_however_long():
    camera = Camera()
    for _ in range(round(3 * SILENCE / PERIOD)):
        assert camera.shoot(COLOR) and not camera.shoot(OLD_COLOR)


def color_of(camera, number):
    picture = camera.rng.integers(90, 160, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return image_of(round(1e9 * PERIOD * number), picture, "rgb8")


def depth_of(number, value=120):
    plane = np.full((HEIGHT, WIDTH), value, dtype=np.uint16)
    plane[0] += number
    return image_of(round(1e9 * PERIOD * number), plane, "16UC1")


def test_of_depth_that_was_used_none_but_the_last_is_kept():
    camera = Camera()
    for _ in range(20):
        assert camera.shoot(COLOR)
    assert len(camera.feed._images.entries(DEPTHS)) == 1


def test_intrinsics_are_read_again_only_when_their_numbers_change():
    camera, info = Camera(), camera_info()
    stream = camera.feed.stream
    first = stream.camera
    assert not stream.take_info(info) and stream.camera is first
    info.k = [1.01 * number if index < 6 else number for index, number in enumerate(info.k)]
    assert stream.take_info(info) and stream.camera.fx == pytest.approx(1.01 * first.fx)
    info.header.frame_id = "elsewhere"
    with pytest.raises(ObservationError, match="elsewhere"):
        stream.take_info(info)


def test_without_depth_every_colour_image_is_whole():
    camera = Camera(depth="none")
    for number in range(1, 5):
        image = camera.feed.take_color(COLOR, color_of(camera, number))[0].value
        assert image.depth is None and image.stamp == pytest.approx(PERIOD * number)


def test_depth_that_comes_and_goes_is_used_while_it_comes():
    camera, had = Camera(depth="auto"), []

    def shoot(number, with_depth):
        whole = camera.feed.take_depth(depth_of(number)) if with_depth else []
        whole += camera.feed.take_color(COLOR, color_of(camera, number))
        had.extend((number, taken.value.depth is not None) for taken in whole)

    for number in range(1, 16):
        shoot(number, with_depth=number < 4 or number > 11)
    # three images wait in vain when depth ends, then none does; with the first depth they have it again
    assert had == [(n, True) for n in (1, 2, 3)] + [(n, False) for n in range(7, 12)] + [
        (n, True) for n in range(12, 16)
    ]


def pair_up(camera, events):
    """Images (number, whether with depth, delay of the depth [ms]) that become whole, of events in their order."""
    whole = []
    for kind, number, shift in events:
        if kind == "depth":
            image = depth_of(number)
            image.header.stamp.nanosec += round(1e6 * shift)
            found = camera.feed.take_depth(image)
        else:
            found = camera.feed.take_color(COLOR, color_of(camera, number))
        whole += found
    return [(round(w.stamp / (1e9 * PERIOD)), w.value.depth is not None, 1e3 * w.value.depth_delay) for w in whole]


@pytest.mark.parametrize("shift", [-9.0, 9.0, 12.0, 13.4])
def test_depth_of_an_unsynchronised_camera_is_paired_and_its_delay_known(shift):
    first = ("color", "depth") if shift > 0 else ("depth", "color")
    found = pair_up(Camera(), [(kind, n, shift) for n in range(1, 20) for kind in first])
    assert [number for number, _, _ in found][-15:] == list(range(5, 20))
    assert all(has and abs(delay) <= 16.5 for _, has, delay in found)
    assert np.median([delay for _, _, delay in found]) == pytest.approx(shift, abs=0.01)


def test_a_stated_tolerance_is_kept():
    camera = Camera()
    camera.feed = RgbdFeed(DetectorParameters(sync_tolerance=0.005, depth="aligned"))
    camera.feed.stream.take_info(camera_info())
    with pytest.raises(SyncError, match="within 5 ms"):
        pair_up(camera, [(kind, n, 9.0) for n in range(1, 9) for kind in ("color", "depth")])


def pair_late(camera, late, jitter=lambda n: 0):
    """Images (number, whether with depth, age in periods) that become whole when depth is so many periods late."""
    whole = []
    for n in range(1, 120):
        for kind, number in (("color", n), ("depth", n - late - jitter(n))):
            if number > 0:
                with suppress(SyncError):
                    whole += [(found, has, n - found) for found, has, _ in pair_up(camera, [(kind, number, 0.0)])]
    return whole


@pytest.mark.parametrize(("depth", "late"), [("auto", 3), ("aligned", 5)])
def test_late_depth_is_waited_for_while_its_images_are_fresh(depth, late):
    camera = Camera(depth=depth)
    answered = [number for number, has, _ in pair_late(camera, late) if has]
    assert answered[-100:] == list(range(120 - late - 100, 120 - late))
    assert len(camera.feed._images.entries(COLORS)) <= late + 1 and not camera.feed.delay_of_depth


@pytest.mark.parametrize("late", [5, 8, 17])
@pytest.mark.parametrize("jitter", [lambda n: 0, lambda n: n % 2])
def test_images_whose_depth_comes_too_late_are_taken_alone_while_they_are_fresh(late, jitter):
    camera = Camera(depth="auto")
    whole = pair_late(camera, late, jitter)
    # half of max_age is left for what comes after
    assert sum(age * PERIOD <= 0.1 for _, _, age in whole) >= 0.9 * 119
    assert len({number for number, *_ in whole}) == len(whole)
    assert f"{1e3 * late * PERIOD:.0f} ms" in camera.feed.delay_of_depth or jitter(1)
    assert "without depth" in camera.feed.delay_of_depth


def test_depth_that_comes_in_time_again_is_used_again():
    camera = Camera(depth="auto")
    whole = pair_late(camera, 8, lambda n: -7 if n > 60 else 0)
    assert not any(has for number, has, _ in whole if number < 60)
    assert all(has for number, has, _ in whole if number > 75) and not camera.feed.delay_of_depth


def test_depth_that_is_too_late_for_any_answer_is_named_where_every_image_needs_it():
    camera = Camera()
    with pytest.raises(SyncError, match="depth images come 240 ms after .* max_age is 0.2 s"):
        for n in range(1, 60):
            try:
                pair_up(camera, [("color", n, 0.0)])
            except SyncError:
                if n > 30:
                    raise
            if n > 8:
                pair_up(camera, [("depth", n - 8, 0.0)])


def test_images_whose_depth_was_lost_are_taken_alone_in_their_order():
    events = [(kind, n, 0.0) for n in range(1, 31) for kind in ("color", "depth") if kind == "color" or n % 3]
    assert [(number, has) for number, has, _ in pair_up(Camera(depth="auto"), events)] == [
        (n, bool(n % 3)) for n in range(1, 30)
    ]


def test_the_frame_is_that_of_the_first_message_and_no_other_is_taken_then():
    camera = Camera(depth="none")
    camera.feed = RgbdFeed(DetectorParameters(depth="none"))
    info, image = camera_info(), color_of(camera, 1)
    info.header.frame_id = image.header.frame_id = "my_cam_optical"
    camera.feed.stream.take_info(info)
    assert camera.feed.take_color(COLOR, image) and camera.feed.stream.frame == "my_cam_optical"
    with pytest.raises(ObservationError, match="expected 'my_cam_optical'"):
        camera.feed.take_color(COLOR, color_of(camera, 2))


def test_an_empty_depth_image_counts_as_none_only_where_none_is_needed():
    for depth, is_taken in (("auto", True), ("aligned", False)):
        camera = Camera(depth=depth)
        camera.feed.take_depth(depth_of(0, value=0))
        image = camera.feed.take_color(COLOR, color_of(camera, 0))[0].value
        if is_taken:
            assert image.depth is None
        else:
            with pytest.raises(ImageError, match="empty"):
                check_image(image)


def test_where_every_image_needs_its_depth_one_without_is_refused():
    camera = Camera()
    with pytest.raises(SyncError, match="depth:=none"):
        for number in range(6):
            camera.feed.take_color(COLOR, color_of(camera, number))


class Picture:
    """A sensor_msgs/CompressedImage."""

    def __init__(self, header, data):
        self.header, self.format, self.data = header, "rgb8; jpeg compressed bgr8", data


def test_a_jpeg_stream_is_decoded_and_a_damaged_one_refused():
    camera = Camera(depth="none")
    raw = color_of(camera, 1)
    picture = cv2.GaussianBlur(np.frombuffer(raw.data, np.uint8).reshape(HEIGHT, WIDTH, 3), (0, 0), 3.0)
    _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    topic = f"{COLOR}/compressed"
    image = camera.feed.take_color(topic, Picture(raw.header, data.tobytes()))[0].value
    assert np.abs(image.color.astype(int) - picture).mean() < 3.0
    for broken in (b"", b"no picture", data.tobytes()[:40]):
        later = color_of(camera, 2)
        with pytest.raises(ImageError, match="neither jpeg nor png|damaged"):
            camera.feed.take_color(topic, Picture(later.header, broken))
    huge = data.tobytes().replace(bytes([0xFF, 0xC0, 0, 17, 8, *divmod(HEIGHT, 256)]), b"\xff\xc0\0\x11\x08\xff\xff")
    huge = huge[: huge.index(b"\xff\xff") + 2] + b"\xff\xff" + huge[huge.index(b"\xff\xff") + 4 :]
    with pytest.raises(ImageError, match="expected at most 50000000 pixels"):
        camera.feed.take_color(topic, Picture(raw.header, huge))


def test_packets_of_a_video_give_images_from_a_key_frame_on_and_again_after_a_pause():
    camera, packets = Camera(depth="none"), encode_packets(draw_pictures(2 * KEY_EVERY))

    def send(number, topic=COLOR):
        camera.now += PERIOD
        (taken,) = camera.feed.take_color(topic, packet_message(packets[number], round(1e9 * camera.now)))
        return taken.value

    with pytest.raises(MissingFrameError, match="a packet of H.264 .* expected a key frame"):
        send(1)
    assert send(0).is_video and send(1).color.shape == (96, 128, 3)
    camera.feed.pause()
    with pytest.raises(MissingFrameError):
        send(2)
    assert send(KEY_EVERY).is_video
    camera.now += SILENCE + PERIOD
    with pytest.raises(MissingFrameError):  # another camera's, whose frame number would fit
        send(KEY_EVERY + 1, OLD_COLOR)
