"""Packets of H.264 as cameras send them, one for each picture."""

from fractions import Fraction
from types import SimpleNamespace

import av
import numpy as np

KEY_EVERY = 10  # pictures


def draw_pictures(count, shape=(96, 128)):
    """Pictures (h, w, 3) of a box that moves over a background that stands still."""
    height, width = shape
    background = np.random.default_rng(0).integers(0, 255, (height // 8, width // 8, 3), dtype=np.uint8)
    pictures = []
    for number in range(count):
        picture = background.repeat(8, axis=0).repeat(8, axis=1)
        picture[30:60, 4 * number % width : 4 * number % width + 24] = (255, 0, 0)
        pictures.append(picture)
    return pictures


def encode_packets(pictures, codec="libx264", **options):
    """The packets of pictures (h, w, 3) RGB, in the order in which they are sent."""
    context = av.CodecContext.create(codec, "w")
    context.height, context.width = pictures[0].shape[:2]
    context.pix_fmt, context.time_base = "yuv420p", Fraction(1, 30)
    context.options = {"tune": "zerolatency", "g": str(KEY_EVERY), "crf": "16", **options}
    packets = []
    for number, picture in enumerate([*pictures, None]):
        frame = None if picture is None else av.VideoFrame.from_ndarray(picture, format="rgb24")
        if frame is not None:
            frame.pts = number
        packets += map(bytes, context.encode(frame))
    return packets


def packet_message(data, stamp, form="h264"):
    """A sensor_msgs/CompressedImage with a packet, of a stamp [ns]."""
    header = SimpleNamespace(
        stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="camera_color_optical_frame"
    )
    return SimpleNamespace(header=header, format=form, data=np.frombuffer(data, dtype=np.uint8))
