"""ArUco and AprilTags on what carries the jaws: seen in the images, and where their corners are in a jaw's frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, rays_from_pixels
from finforce.optional import import_cv2
from finforce.transforms import invert_pose
from finforce_keypoints.errors import GeometryError

FAMILIES = ("4x4_50", "5x5_50", "6x6_50", "apriltag_16h5", "apriltag_25h9", "apriltag_36h11")
CORNERS = 4
CORNER_STDDEV = 0.3  # [px] of a corner
_MARGIN = 1.0  # widths of a tag around the last ones, within which they are looked for first
_UNSEEN = 30  # images without one of the tags: the first of so many is also looked at enlarged and mirrored
_LARGER, _LEGIBLE = 4, 60  # times as large small tags are looked for; length of an edge [px] from which this is in vain
_SCATTER = 2e-3  # [m] by which a corner may move in the frame of a jaw: more of it, and the tag is not on its holder
# A calibrated camera's pictures of a tag fit it to this [px].
_MISFIT = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Tag:
    """A tag that moves with a jaw.

    Attributes:
        id: its number.
        corners: (4, 3) in the jaw frame, in the order in which it is decoded [m].
    """

    id: int
    corners: NDArray


class TagFinder:
    """Finds tags of some numbers in the images of one camera.

    Attributes:
        mirrored: corners (4, 2) [px] by number of those in the mirrored image, looked for while no tag is seen.
    """

    def __init__(self, family: str, ids: Sequence[int] | None = None) -> None:
        """Look for tags of a family, of some numbers or of all."""
        cv2 = import_cv2()
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family.upper()}"))
        self._ids = range(len(dictionary.bytesList)) if ids is None else ids
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        self.reset()

    def reset(self) -> None:
        """Forget where they were."""
        self._last: dict[int, NDArray] = {}
        self._unseen, self.mirrored = 0, {}

    def find(self, color: NDArray) -> dict[int, NDArray]:
        """Return the corners (4, 2) [px] by number of the tags seen in an image (h, w, 3)."""
        cv2 = import_cv2()
        grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        found = self._detect_near(grey) if len(self._last) == len(self._ids) else {}
        if len(found) < len(self._ids):
            found = self._detect(grey)
        is_missing = len(found) < len(self._ids)
        is_first = is_missing and self._unseen % _UNSEEN == 0
        if is_first:
            found = self._detect(grey, _LARGER) | found
        self._last, self._unseen = found, self._unseen + 1 if is_missing else 0
        if found:
            self.mirrored = {}
        elif is_first:
            self.mirrored = self._detect(cv2.flip(grey, 1))
        return found

    def _detect_near(self, grey: NDArray) -> dict[int, NDArray]:
        """Return what is seen near the last tags."""
        found = {}
        for corners in self._last.values():
            margin = (1.0 + _MARGIN) * np.ptp(corners, axis=0).max()
            first = np.maximum((corners.mean(axis=0) - margin).astype(int), 0)
            last = (corners.mean(axis=0) + margin).astype(int)
            part = np.ascontiguousarray(grey[first[1] : last[1], first[0] : last[0]])
            larger = int(np.clip(_LEGIBLE * (2.0 + 2.0 * _MARGIN) / max(*part.shape, 1), 1, _LARGER))
            found |= {number: there + first for number, there in self._detect(part, larger).items()}
        return found

    def _detect(self, grey: NDArray, larger: int = 1) -> dict[int, NDArray]:
        """Return the corners (4, 2) of the wanted tags in a picture, enlarged, of none whose number is seen twice."""
        cv2 = import_cv2()
        if larger > 1:
            grey = cv2.resize(grey, None, fx=larger, fy=larger, interpolation=cv2.INTER_CUBIC)
        corners, numbers, _ = self._detector.detectMarkers(grey)
        seen = [] if numbers is None else numbers.ravel().tolist()
        return {
            number: (there[0].astype(float) + 0.5) / larger - 0.5
            for number, there in zip(seen, corners, strict=True)
            if number in self._ids and seen.count(number) == 1
        }


def place_corners(corners: NDArray, size: float, camera: CameraIntrinsics) -> NDArray:
    """Return the corners (4, 3) [m] of a square tag in the camera frame.

    Args:
        corners: (4, 2) [px].
        size: length of an edge [m].
        camera: intrinsics.

    Raises:
        GeometryError: they are those of no square.
    """
    cv2: Any = import_cv2()
    half = 0.5 * size
    square = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    rays = np.ascontiguousarray(rays_from_pixels(corners, camera)[:, None, :2])
    _, turn, shift = cv2.solvePnP(square, rays, np.eye(3), None, flags=cv2.SOLVEPNP_ITERATIVE)
    placed = square @ cv2.Rodrigues(turn)[0].T + shift.ravel()
    off = np.hypot(*(placed[:, :2] / placed[:, 2:] - rays[:, 0]).T)
    if not camera.fx * off.max() < _MISFIT:
        raise GeometryError(f"corners {corners.round(1).tolist()} px, expected those of a square tag")
    return placed


def find_tag(
    number: int, seen: Sequence[NDArray], poses: Mapping[str, Sequence[NDArray]], size: float, camera: CameraIntrinsics
) -> tuple[str, Tag]:
    """Return on which jaw a tag is, the one that it is nearer to, and where.

    Args:
        number: of the tag.
        seen: its corners (4, 2) [px] in each picture that shows it.
        poses: side -> T_camera_jaw (4, 4) in each of these pictures.
        size: length of an edge [m].
        camera: intrinsics.

    Raises:
        GeometryError: it is seen in none, or not at one place of the jaw.
    """
    if not seen:
        raise GeometryError(f"tag {number} is in none of the pictures")
    corners = np.array([place_corners(pixels, size, camera) for pixels in seen])
    places = {}
    for side, Ts in poses.items():
        inverse = np.array([invert_pose(T) for T in Ts])
        places[side] = np.einsum("nij,ncj->nci", inverse[:, :3, :3], corners) + inverse[:, None, :3, 3]
    side = min(places, key=lambda side: abs(float(np.median(places[side][:, :, 0]))))
    middle = np.median(places[side], axis=0)
    scatter = float(np.abs(places[side] - middle).max())
    if scatter > _SCATTER:
        raise GeometryError(
            f"tag {number} moves by {1e3 * scatter:.1f} mm against the {side} jaw, expected one fixed to its holder"
        )
    return side, Tag(id=number, corners=middle)


def read_tag(numbers: Sequence[float]) -> Tag | None:
    """Return the tag of a parameter: its number and twelve coordinates, or a single NaN for none.

    Raises:
        GeometryError: the parameter is something else.
    """
    values = np.array(numbers, dtype=float)
    if values.size == 1 and np.isnan(values[0]):
        return None
    if values.size != 1 + 3 * CORNERS or not np.isfinite(values).all() or values[0] < 0.0 or values[0] % 1.0:
        raise GeometryError(f"got {list(numbers)}, expected a tag's number and x, y, z [m] of its four corners")
    return Tag(id=int(values[0]), corners=values[1:].reshape(CORNERS, 3))
