from dataclasses import replace

import numpy as np
import pytest
from keypoint_scene_fakes import CAMERA, bare_image

from finforce.camera import ImageError, ImageLayout, decode_color
from finforce_keypoints.errors import BlackImageError, FrozenImageError
from finforce_keypoints.images import ImageWatch, check_image, lie_inside

RGB = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
ENCODED = {
    "rgb8": RGB,
    "bgr8": RGB[:, :, ::-1],
    "rgba8": np.concatenate((RGB, np.full((2, 3, 1), 255, np.uint8)), axis=2),
    "bgra8": np.concatenate((RGB[:, :, ::-1], np.full((2, 3, 1), 255, np.uint8)), axis=2),
}


@pytest.mark.parametrize("encoding", ENCODED)
@pytest.mark.parametrize("padding", [0, 5])
def test_every_encoding_gives_the_same_picture_with_and_without_padding(encoding, padding):
    rows = np.ascontiguousarray(ENCODED[encoding]).reshape(2, -1)
    step = rows.shape[1] + padding
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=7).tobytes()
    decoded = decode_color(data, encoding, ImageLayout(height=2, width=3, step=step))
    np.testing.assert_array_equal(decoded, RGB)
    np.testing.assert_array_equal(decode_color(ENCODED[encoding], encoding), RGB)


def test_grey_pictures_become_three_equal_channels():
    grey = np.array([[1, 2], [3, 4]], dtype=np.uint8)
    np.testing.assert_array_equal(decode_color(grey.tobytes(), "mono8", ImageLayout(height=2, width=2))[..., 2], grey)
    assert decode_color(grey, "mono8").shape == (2, 2, 3)


PATCHES = np.repeat(
    np.repeat(np.array([[[200, 60, 40], [30, 160, 90]], [[40, 70, 210], [120, 120, 120]]], np.uint8), 8, 0), 8, 1
)


def luma_and_chroma(rgb):
    """Y, Cb and Cr of BT.601 in video range."""
    r, g, b = np.moveaxis(rgb.astype(float), -1, 0)
    y = 16 + 0.257 * r + 0.504 * g + 0.098 * b
    cb, cr = 128 - 0.148 * r - 0.291 * g + 0.439 * b, 128 + 0.439 * r - 0.368 * g - 0.071 * b
    return [np.rint(part).astype(np.uint8) for part in (y, cb, cr)]


def interleave(order):
    """Patches as 4:2:2, with colour before or after brightness."""
    y, cb, cr = luma_and_chroma(PATCHES)
    chroma = np.where(np.arange(16) % 2, cr, cb)
    return np.stack((chroma, y) if order == "uyvy" else (y, chroma), axis=-1)


def planes(order):
    """Patches as 4:2:0: all brightness, then colour of every second row and column in pairs."""
    y, cb, cr = (part if n == 0 else part[::2, ::2] for n, part in enumerate(luma_and_chroma(PATCHES)))
    pairs = np.stack((cb, cr) if order == "nv12" else (cr, cb), axis=-1)
    return np.vstack((y, pairs.reshape(8, 16)))


def mosaic(tiles):
    """Patches as seen through a Bayer filter."""
    channel = np.array([["rgb".index(tiles[0]), "rgb".index(tiles[1])], ["rgb".index(tiles[2]), "rgb".index(tiles[3])]])
    return np.take_along_axis(PATCHES, np.tile(channel, (8, 8))[..., None], axis=2)[..., 0]


SENT = {
    **dict.fromkeys(("uyvy", "yuv422"), interleave("uyvy")),
    **dict.fromkeys(("yuyv", "yuv422_yuy2"), interleave("yuyv")),
    **{name: planes(name) for name in ("nv12", "nv21")},
    **{f"bayer_{tiles}8": mosaic(tiles) for tiles in ("rggb", "bggr", "gbrg", "grbg")},
    "rgb16": (PATCHES.astype(int) * 256 + 99).astype(">u2"),
    "bgr16": (PATCHES[..., ::-1].astype(int) * 256 + 99).astype(">u2"),
    "8UC3": PATCHES[..., ::-1],
}
GREY = PATCHES[..., 1]


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_images_of_infrared_cameras_become_rgb(encoding):
    found = decode_color(GREY.tobytes(), encoding, ImageLayout(height=16, width=16, step=16, is_bigendian=False))
    np.testing.assert_array_equal(found, np.repeat(GREY[..., None], 3, axis=-1))


@pytest.mark.parametrize("encoding", SENT)
def test_what_cameras_send_becomes_rgb(encoding):
    sent = np.ascontiguousarray(SENT[encoding])
    layout = ImageLayout(height=16, width=16, step=sent[0].nbytes, is_bigendian=True)
    inside = np.s_[2:6, 2:6], np.s_[2:6, 10:14], np.s_[10:14, 2:6], np.s_[10:14, 10:14]
    for found in (decode_color(sent.tobytes(), encoding, layout), decode_color(sent, encoding)):
        assert found.shape == (16, 16, 3) and found.dtype == np.uint8
        for patch in inside:
            assert np.abs(found[patch].astype(int) - PATCHES[patch]).max() <= 3


@pytest.mark.parametrize(("said", "sent"), [("yuv422", "yuyv"), ("uyvy", "yuyv"), ("yuv422_yuy2", "uyvy")])
def test_brightness_and_colours_the_other_way_round_are_named(said, sent):
    """A grey texture with noise, in the order of bytes of another encoding than is said; flat and dark ones pass."""
    noise = np.random.default_rng(0)
    y = np.clip(128 + 40 * np.sin(np.arange(64) / 3.0) + noise.normal(0, 2, (48, 64)), 0, 255)
    chroma = np.broadcast_to(np.where(np.arange(64) % 2, 120, 135), y.shape) + noise.normal(0, 1, y.shape)
    for scale, is_named in ((1.0, True), (0.0, False)):
        parts = [scale * y, scale * chroma]
        image = np.stack(parts if sent == "yuyv" else parts[::-1], axis=-1).astype(np.uint8)
        assert decode_color(image, sent).shape == (48, 64, 3)
        if is_named:
            with pytest.raises(ImageError, match=f"said to be {said}, its bytes are those of {sent} or "):
                decode_color(image, said)
        else:
            decode_color(image, said)


def test_half_a_pair_of_columns_is_refused():
    with pytest.raises(ImageError, match="even"):
        decode_color(bytes(2 * 3 * 2), "yuyv", ImageLayout(height=2, width=3))


@pytest.mark.parametrize("encoding", ["yuv444", "16UC1", "", "RGB8"])
def test_an_unknown_encoding_is_refused_by_name(encoding):
    with pytest.raises(ImageError, match=f"'{encoding}'.*rgb8"):
        decode_color(RGB, encoding)


@pytest.mark.parametrize(
    "layout", [ImageLayout(height=2, width=4), ImageLayout(height=2, width=3, step=8), ImageLayout(height=0, width=3)]
)
def test_bytes_that_do_not_fill_the_layout_are_refused(layout):
    with pytest.raises(ImageError, match="18 bytes"):
        decode_color(RGB.tobytes(), "rgb8", layout)
    with pytest.raises(ImageError, match="at least 9 bytes"):
        decode_color(bytes(16), "rgb8", ImageLayout(height=2, width=3, step=8))


def test_an_array_of_another_shape_or_type_is_refused():
    for wrong in (RGB[:, :, :2], RGB.astype(float), RGB[0]):
        with pytest.raises(ImageError, match="uint8"):
            decode_color(wrong, "rgb8")


def test_an_image_whose_parts_agree_passes_and_others_are_refused():
    good = bare_image(0.0, np.ones((480, 640), np.float32))
    check_image(good)
    check_image(replace(good, depth=None))
    for change, message in (
        ({"depth": good.depth[1:]}, "depth image"),
        ({"depth": np.ones((480, 640), np.uint16)}, "expected metres"),
        ({"color": good.color[:, 1:]}, "colour image"),
        ({"color": good.color.astype(float)}, "colour image"),
        ({"stamp": float("nan")}, "stamp"),
        ({"camera": replace(CAMERA, width=848)}, "camera_info"),
    ):
        with pytest.raises(ImageError, match=message):
            check_image(replace(good, **change))


def noisy(rng, level):
    return replace(bare_image(0.0, None), color=rng.poisson(level, (480, 640, 3)).clip(0, 255).astype(np.uint8))


def test_a_black_picture_is_refused_and_a_dim_one_is_not():
    rng, watch = np.random.default_rng(0), ImageWatch()
    with pytest.raises(BlackImageError, match="lens"):
        watch.check(noisy(rng, 1.0))
    watch.check(noisy(rng, 12.0))


def test_a_frozen_camera_is_noticed_after_a_few_pictures_and_forgiven_when_it_goes_on():
    rng, watch = np.random.default_rng(0), ImageWatch(frozen_after=3)
    still = noisy(rng, 90.0)
    for _ in range(3):
        watch.check(still)
    for _ in range(2):
        with pytest.raises(FrozenImageError, match="identical"):
            watch.check(still)
    watch.check(noisy(rng, 90.0))
    watch.check(still)


def test_a_video_of_a_scene_at_rest_repeats_itself_and_a_black_one_is_refused():
    rng, watch = np.random.default_rng(0), ImageWatch(frozen_after=1)
    still = replace(noisy(rng, 90.0), is_video=True)
    for _ in range(5):
        watch.check(still)
    with pytest.raises(BlackImageError):
        watch.check(replace(noisy(rng, 1.0), is_video=True))


def test_pictures_of_a_scene_at_rest_are_not_frozen():
    rng, watch = np.random.default_rng(0), ImageWatch(frozen_after=1)
    for _ in range(5):
        watch.check(noisy(rng, 90.0))


def test_pixels_lie_inside_up_to_the_border_of_the_outer_pixels():
    image = bare_image(0.0, None)
    pixels = np.array([[-0.4, -0.4], [639.4, 479.4], [640.0, 3.0], [3.0, -0.6], [np.nan, 3.0]])
    np.testing.assert_array_equal(lie_inside(image, pixels), [True, True, False, False, False])
