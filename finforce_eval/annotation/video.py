"""Forces drawn into the images of a recording, as a video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project
from finforce.messages import NANOSECONDS
from finforce.optional import import_cv2, import_library
from finforce.transforms import pose_from_quaternion
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.check import draw_points
from finforce_eval.evaluation.forces import no_force_reasons
from finforce_eval.recordings.tracks import JawTrack, Recording
from finforce_eval.table import ForceSeries
from finforce_eval.tasks import progress_bar
from finforce_ifea.messages import CONTACT, FORCE, NEWTONS_PER_METRE

USED, REFUSED, INK = (25, 204, 51), (230, 51, 25), (255, 255, 255)
LEAST_HEIGHT = 480  # [px] of the video; smaller images are enlarged, so that words can be read
LINE = 0.045  # of the height, for each jaw's words
_QUALITY = "20"  # of H.264, constant rate factor


def write_video(path: Path, recording: Recording, jaws: Mapping[str, ForceSeries]) -> None:
    """Write the images of a recording with key points, force arrows and forces, at their own times.

    Args:
        path: of the new file, MP4 with H.264.
        recording: with images.
        jaws: the forces, by side.

    Raises:
        RecordingError: the recording has no images, or they cannot be read.
        MissingDependencyError: PyAV is not installed.
    """
    av = import_library("av", "writing videos", "'finforce[video]'")
    if recording.images is None or not len(recording.images):
        raise RecordingError(f"{recording.name}: no images to draw forces into; expected color images")
    images, camera, overlay = recording.images.all_colors(), recording.images.camera, ForceOverlay(recording, jaws)
    first = int(images.stamps_ns[0])
    with av.open(str(path), "w") as file, progress_bar(len(images), "image", path.name) as bar:
        stream = file.add_stream("libx264", rate=30, options={"crf": _QUALITY})
        # the format has two pixels by two for each colour
        stream.width, stream.height = (2 * (overlay.scale * size // 2) for size in (camera.width, camera.height))
        stream.pix_fmt, stream.codec_context.time_base = "yuv420p", Fraction(1, 1000)
        for stamp, image in images:
            picture = overlay.draw(stamp, image.color)
            frame = av.VideoFrame.from_ndarray(picture[: stream.height, : stream.width], format="rgb24")
            frame.pts, frame.time_base = round((stamp - first) / NANOSECONDS * 1000), Fraction(1, 1000)
            file.mux(stream.encode(frame))
            bar.update()
        file.mux(stream.encode())


class ForceOverlay:
    """Draws key points and forces of both jaws into the images of a recording.

    Args:
        recording: with images.
        jaws: the forces, by side.

    Attributes:
        scale: by which images are enlarged.
    """

    def __init__(self, recording: Recording, jaws: Mapping[str, ForceSeries]) -> None:
        camera = recording.images.camera
        self.scale = -(-LEAST_HEIGHT // camera.height)
        self._jaws = [_Overlay(recording.jaw(side), forces, camera, self.scale) for side, forces in jaws.items()]

    def draw(self, stamp: int, color: NDArray) -> NDArray:
        """Return the picture (h, w, 3) of the image of a stamp [ns]; small images are enlarged."""
        picture = np.ascontiguousarray(color.repeat(self.scale, axis=0).repeat(self.scale, axis=1))
        picture[: round(LINE * len(self._jaws) * len(picture))] //= 3  # words are white
        for line, jaw in enumerate(self._jaws, start=1):
            jaw.draw(picture, stamp, line)
        return picture


class _Overlay:
    """The drawing of one jaw."""

    def __init__(self, track: JawTrack, forces: ForceSeries, camera: CameraIntrinsics, scale: int) -> None:
        self._track, self._forces, self._camera, self._scale = track, forces, camera, scale
        self._reasons = no_force_reasons(forces)
        self._stated = forces.column("magnitude_stddev")
        self._points = forces.column("contact_point")
        self._rows = [
            {stamp: row for row, stamp in enumerate(each.stamps_ns.tolist())} if each is not None else {}
            for each in (forces, track.detection, track.pose)
        ]

    def draw(self, picture: NDArray, stamp: int, line: int) -> None:
        """Draw what was found in an image [ns] into its picture (h, w, 3), with words in a line, the first is 1."""
        row, found, at = (rows.get(stamp) for rows in self._rows)
        if found is not None:
            pixels, used = self._place(self._track.detection.pixels[found]), self._track.detection.accepted[found]
            draw_points(picture, pixels[used], USED)
            draw_points(picture, pixels[~used], REFUSED)
        words = "no key points" if row is None else self._reasons[row]
        if row is not None and not words:
            words = f"{self._forces.magnitude[row]:.2f} N +- {self._stated[row]:.2f}"
            self._draw_arrow(picture, row, at)
        cv2, height, text = import_cv2(), picture.shape[0], f"{self._forces.side}: {words}"
        place = 8, round(LINE * height * (line - 0.3))
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, height / 1000.0, INK, 1, cv2.LINE_AA)

    def _draw_arrow(self, picture: NDArray, row: int, at: int | None) -> None:
        """Draw the force where it acts, on a jaw whose pose is known."""
        cv2, force, point = import_cv2(), self._forces.force[row], self._points[row]
        known = at is not None and force.any() and np.isfinite([*point, *self._track.pose.position[at]]).all()
        if not known:
            return
        T = pose_from_quaternion(self._track.pose.position[at], self._track.pose.quaternion[at])
        ends = np.array([point - force / NEWTONS_PER_METRE, point]) @ T[:3, :3].T + T[:3, 3]
        start, end = np.round(8.0 * self._place(project(ends, self._camera))).astype(int).tolist()
        cv2.arrowedLine(picture, start, end, to_bytes(FORCE), 2, cv2.LINE_AA, 3)
        cv2.circle(picture, end, 4 * 8, to_bytes(CONTACT), -1, cv2.LINE_AA, 3)

    def _place(self, pixels: NDArray) -> NDArray:
        """Return where pixels (n, 2) of the image are in its picture."""
        return np.clip(self._scale * (pixels + 0.5) - 0.5, -1e4, 1e4)


def to_bytes(colour: Sequence[float]) -> list[int]:
    """Return red, green and blue of a colour, and its opacity if given, as 0 to 255."""
    return [round(255 * part) for part in colour]
