"""Pictures of H.264 that come packet by packet, as messages bring them."""

from __future__ import annotations

from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import LARGEST_PICTURE, ImageError
from finforce.optional import import_library

# decoders else paint over what is damaged, and several threads tell less of it
STRICT = "crccheck+bitstream+buffer+explode"
_SLICE, _KEY_SLICE, _SEQUENCE = 1, 5, 7  # types of units, ITU-T H.264 table 7-1
_WITH_CHROMA = (44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244)  # profiles, section 7.3.2.1.1
_HEAD = 32  # bytes of a unit in which what is read of it lies


class MissingFrameError(ImageError):
    """A picture of a video that cannot be made: it, or one that it is predicted from, is damaged or missing."""


class PacketDecoder:
    """Decodes the packets of an H.264 stream, each of one picture, in their order.

    A picture is predicted from those before it. Behind one that is damaged or missing, as numbers of frames in the
    packets tell, there is none up to the next key frame; the decoder itself would make one of what others left.
    """

    def __init__(self) -> None:
        self._codec: Any = None
        self._digits = 0  # binary ones, of frame numbers
        self.reset()

    def reset(self) -> None:
        """Wait for a key frame."""
        self._number, self._stamp, self._is_broken = 0, None, True

    def decode(self, data: bytes, stamp: int, what: str) -> NDArray[np.uint8]:
        """Return the picture (h, w, 3) RGB of a packet.

        Args:
            data: of the packet.
            stamp: of the picture [ns], later than that of the last one.
            what: the picture, for messages.

        Raises:
            MissingFrameError: the packet is damaged, or what it is predicted from is missing.
            ImageError: the packets are of H.265, or of a stream whose pictures come later than their packets.
            MissingDependencyError: PyAV is not installed.
        """
        av = import_library("av", "decoding H.264", "'finforce[video]'")
        is_next = self._follows(data) and (self._stamp is None or stamp > self._stamp)
        self._stamp, was_broken, self._is_broken = stamp, self._is_broken or not is_next, True
        packet = av.Packet(data)
        packet.pts = stamp
        try:
            frames = (self._codec or self._open(av)).decode(packet)
        except av.FFmpegError:
            frames = []
        if any(frame.pts != stamp for frame in frames):
            raise ImageError(f"{what}: pictures that come later than their packets; expected H.264 without B-frames")
        if not frames or frames[0].is_corrupt or (was_broken and not frames[0].key_frame):
            raise MissingFrameError(
                f"{what}: a packet of H.264 that is damaged or follows a damaged or missing one; expected a key frame"
            )
        self._is_broken = False
        return frames[0].to_ndarray(format="rgb24")

    def _open(self, av: Any) -> Any:
        """Return a decoder that gives the picture of each packet at once."""
        self._codec = av.CodecContext.create("h264", "r")
        self._codec.options = {"err_detect": STRICT, "max_pixels": str(LARGEST_PICTURE)}
        self._codec.thread_count = 1
        self._codec.flags |= av.codec.context.Flags.low_delay
        return self._codec

    def _follows(self, data: bytes) -> bool:
        """Say whether the picture of a packet is the next one: frames count those that others are predicted from."""
        for unit in data.split(b"\0\0\1")[1:]:
            kind, bits = unit[:1] and unit[0] & 31, _Bits(unit)
            if kind == _SEQUENCE:
                self._digits = _digits_of_frames(bits)
            elif kind in (_SLICE, _KEY_SLICE):
                *_, number = bits.golomb(), bits.golomb(), bits.golomb(), bits.take(self._digits)
                is_next = kind == _KEY_SLICE or number == (self._number + 1) % (1 << self._digits)
                if unit[0] >> 5:
                    self._number = number
                return is_next and self._digits > 0
        return False


def _digits_of_frames(bits: _Bits) -> int:
    """Return the binary digits of frame numbers by a sequence parameter set; 0 where what precedes them is not read."""
    profile, _, _ = bits.take(8), bits.take(16), bits.golomb()
    if profile in _WITH_CHROMA:
        chroma = bits.golomb()
        *_, has_matrices = bits.golomb(), bits.golomb(), bits.take(1), bits.take(1)
        if chroma == 3 or has_matrices:
            return 0
    return bits.golomb() + 4


class _Bits:
    """The head of a unit, read bit by bit behind its first byte: ITU-T H.264, sections 7.3.1 and 9.1."""

    def __init__(self, unit: bytes) -> None:
        head = unit[1:_HEAD].replace(b"\0\0\3", b"\0\0")
        self._bits = iter("".join(f"{byte:08b}" for byte in head))

    def take(self, count: int) -> int:
        """Return a number of so many bits."""
        return int("".join(islice(self._bits, count)) or "0", 2)

    def golomb(self) -> int:
        """Return a number in exponential Golomb code."""
        zeros = 0
        while next(self._bits, "1") == "0":
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)
