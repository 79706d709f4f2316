"""Changes of pictures for a rig to fit them: turned over, zoomed, shifted, turned.

A zoom is another focal length, a shift another principal point, and a turn one of the camera about its axis. As in
`placement`, the outlines say whether jaws are there, and how large; key points then say where exactly. A shift along
the closing axis is not looked for: jaws move there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import OpeningRange, jaw_in_camera
from finforce_keypoints.geometry.side_picture import find_side
from finforce_keypoints.placement import LEAST_CONTRAST, OutlineContrast, find_points

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw
    from finforce_keypoints.detectors.side_plane import AnyFinger
    from finforce_keypoints.parameters import JawMount

# What pictures that are turned over are called, and what to do, by the signs of columns and rows.
FLIPS = {
    (1, 1): "",
    (-1, -1): "the pictures are upside down: if turned, rotate them by 180 degrees; if flipped from top to bottom, "
    "flip them, which looks the same where left and right jaw are alike: writing in the picture, or tags, tell",
    (-1, 1): "the pictures are mirrored from left to right: give them as the camera of the rig took its own",
    (1, -1): "the pictures are mirrored from top to bottom: give them as the camera of the rig took its own",
}
SURE = 0.7  # likelihood of points in pictures that show the jaws
PLAIN = 0.75  # contrast of the outlines of such jaws
FLIPPED = 0.2  # of likelihood and contrast that turning over wins: networks dream, outlines look like something else
ZOOMS = 1.1 ** np.arange(-6.0, 7.0)  # tried; outlines are found from half as far away
STEP, SEARCH = 4e-3, 8e-3  # [m] between the openings tried, likewise, by outlines and by key points
ROUNDS = 4  # of finding key points with the change found before
SCALE = (0.02, 2.0, 0.02, 2e-3)  # of a change: log of the zoom, shift [px], turn [rad], origins [m]
# Pictures of which less than this many, or this share, show key points say nothing of their camera.
FEWEST, FEWEST_SHARE = 2, 0.25
# What is named. A camera is placed to 4 % of its distance, and holders give by 1.5 mm, 3 px of 640, under load.
ZOOMED, SHIFTED, TURNED = 0.06, 5.0 / 640.0, np.radians(1.5)  # [-], [widths of the image], [rad]
UNSTEADY = (2.0 / 640.0, np.radians(1.5))  # [widths of the image], [rad] from picture to picture, in the median
STEADY = 4  # pictures that tell whether all of them move


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureChange:
    """The change of one picture.

    Attributes:
        zoom: factor on the focal length.
        shift: across the closing axis [px].
        turn: about the camera's axis [rad].
        likelihood: mean likelihood of the points that a holder does not cover.
        contrast: of the outlines, in the mean.
    """

    zoom: float
    shift: float
    turn: float
    likelihood: float
    contrast: float = 0.0


class PictureChanges:
    """Finds how pictures of the jaws of a rig were changed, by x: log of the zoom, shift, turn, origins of the jaws.

    Args:
        camera: intrinsics of the rig.
        T_gripper_camera: (4, 4).
        jaws: by side.
        mounts: by side.
        opening: where the jaws can be.
        locator: finds the points in pictures of their sides.
    """

    def __init__(
        self,
        camera: CameraIntrinsics,
        T_gripper_camera: NDArray,
        jaws: Mapping[str, Jaw],
        mounts: Mapping[str, JawMount],
        opening: OpeningRange,
        locator: AnyFinger,
    ) -> None:
        self._camera, self._T, self._jaws, self._mounts, self._locator = camera, T_gripper_camera, jaws, mounts, locator
        self._outlines = {side: OutlineContrast(jaw) for side, jaw in jaws.items()}
        self._edges = {side: self._find_edge(side) for side in jaws}
        self._planes = {side: find_side(jaw) for side, jaw in jaws.items()}
        self._signs = np.array([-1.0 if side == "left" else 1.0 for side in jaws])
        self._origins = np.arange(opening.nearest, opening.farthest + STEP, STEP)
        self._points = {side: np.vstack((jaw.keypoints, jaw.reference_point)) for side, jaw in jaws.items()}
        along = project(
            np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]]) @ T_gripper_camera[:3, :3] + (0.0, 0.0, 1.0), camera
        )
        self._across = np.array([-1.0, 1.0]) * (along[1] - along[0])[::-1] / np.linalg.norm(along[1] - along[0])

    def _find_edge(self, side: str) -> int:
        """Return the number of the edge that parts the key points which a holder covers from the others best."""
        jaw = self._jaws[side]
        seen, places = self._mounts[side].seen_points(jaw)[:-1], jaw.keypoints[:, ::2]
        edges = self._outlines[side].edges
        return int(np.argmax([((places @ across > edge) == seen).sum() for _, across, edge in edges]))

    def _look_from(self, x: NDArray) -> tuple[CameraIntrinsics, dict[str, NDArray]]:
        """Return the camera of a changed picture, and T_camera_jaw (4, 4) by side."""
        zoom, camera, T = np.exp(x[0]), self._camera, self._T.copy()
        cx, cy = (camera.cx, camera.cy) + x[1] * self._across
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, -x[2]]).as_matrix()
        poses = {
            side: jaw_in_camera(T, side, origin, self._mounts[side].turn)
            for side, origin in zip(self._jaws, x[3:], strict=True)
        }
        return replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy, cx=float(cx), cy=float(cy)), poses

    def contrasts(self, color: NDArray, x: NDArray) -> NDArray:
        """Return the contrast of each jaw's outline in an image (h, w, 3) with a change."""
        camera, poses = self._look_from(x)
        return np.array([self._contrast(color, side, T, camera) for side, T in poses.items()])

    def _contrast(self, color: NDArray, side: str, T_camera_jaw: NDArray, camera: CameraIntrinsics) -> float:
        """Return the contrast of a jaw's outline up to the edge of its holder."""
        return self._outlines[side].contrasts(color, T_camera_jaw, camera, self._edges[side])[0]

    def _scan(self, color: NDArray, zooms: Sequence[float] = ZOOMS) -> tuple[float, NDArray]:
        """Return contrast and change where outlines in an image show best, with one of the zooms and any opening."""
        found, origins = [], self._signs[:, None] * self._origins
        poses = {
            side: [jaw_in_camera(self._T, side, origin, self._mounts[side].turn) for origin in each]
            for side, each in zip(self._jaws, origins, strict=True)
        }
        for zoom in zooms:
            camera = replace(self._camera, fx=zoom * self._camera.fx, fy=zoom * self._camera.fy)
            shown = np.array([[self._contrast(color, side, T, camera) for T in each] for side, each in poses.items()])
            best = np.take_along_axis(origins, shown.argmax(axis=1)[:, None], axis=1)[:, 0]
            found.append((float(shown.max(axis=1).mean()), np.r_[np.log(zoom), 0.0, 0.0, best]))
        return max(found, key=lambda each: each[0])

    def find(self, color: NDArray, near: PictureChange | None = None) -> PictureChange:
        """Return how an image (h, w, 3) was changed, begun with the outlines or with no change, what is likelier.

        Args:
            color: the image.
            near: answer of `find_near` for it, where that is known.
        """
        starts = self._improve(color, self._scan(color)[1]), near or self.find_near(color)
        return max(starts, key=lambda change: change.likelihood)

    def find_near(self, color: NDArray) -> PictureChange:
        """Return how an image (h, w, 3) was changed, begun with no change."""
        straight = [np.r_[0.0, 0.0, 0.0, self._signs * half] for half in self._origins[:: round(SEARCH / STEP)]]
        return self._improve(color, max(straight, key=lambda x: self._find_points(color, x)[1].sum()))

    def _improve(self, color: NDArray, x: NDArray) -> PictureChange:
        """Return how an image (h, w, 3) was changed, from a change nearby on."""
        scale = np.array([*SCALE[:3], *[SCALE[3]] * len(self._jaws)])
        for _ in range(ROUNDS):
            seen, weights = self._find_points(color, x)
            x = least_squares(self._misses, x, x_scale=scale, loss="soft_l1", args=(seen, weights)).x
        wanted = np.concatenate([self._mounts[side].seen_points(jaw) for side, jaw in self._jaws.items()])
        likelihood = float((weights[wanted] ** 2).mean())
        zoom, shift, turn = float(np.exp(x[0])), float(x[1]), float(x[2])
        contrast = float(self.contrasts(color, x).mean())
        return PictureChange(zoom=zoom, shift=shift, turn=turn, likelihood=likelihood, contrast=contrast)

    def explain(self, colors: Sequence[NDArray]) -> str:
        """Return what was done to pictures (h, w, 3) of one video, and what to do; "" where it is nothing known."""
        near = [self.find_near(color) for color in colors]
        is_plain = all(each.likelihood >= SURE and each.contrast >= PLAIN for each in near)
        if is_plain and not describe_changes(near, self._camera.width):
            return ""
        flip, best, known, ends = (1, 1), -np.inf, near, {}
        for other in FLIPS:
            given = near if other == (1, 1) else [None] * len(colors)
            tried = {n: self.find(_turn_over(colors[n], other), given[n]) for n in {0, len(colors) - 1}}
            shown = float(np.mean([each.likelihood + each.contrast for each in tried.values()]))
            if shown > best + FLIPPED:
                flip, best, known, ends = other, shown, given, tried
        colors = [_turn_over(color, flip) for color in colors]
        changes = [ends.get(n) or self.find(color, known[n]) for n, color in enumerate(colors)]
        changes = [change for change in changes if change.likelihood >= SURE]
        if len(changes) < max(min(FEWEST, len(colors)), FEWEST_SHARE * len(colors)):
            shown = np.median([self._scan(color, (1.0,))[0] for color in colors])
            hidden = "nothing of such jaws shows where the rig has them: hidden, out of the picture, or another rig?"
            return hidden if shown < LEAST_CONTRAST else ""
        return FLIPS[flip] or describe_changes(changes, self._camera.width)

    def _find_points(self, color: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
        """Return the pixels (n, 2) of all jaws' points in an image, and the roots (n,) of their likelihoods."""
        (camera, poses), pixels, weights = self._look_from(x), [], []
        for side, T in poses.items():
            mount, plane = self._mounts[side], self._planes[side]
            (seen,), (likelihood,) = find_points([color], camera, self._locator, side, plane, [T])
            inside = np.isfinite(seen).all(axis=1) & mount.seen_points(self._jaws[side])
            pixels.append(seen)
            weights.append(np.where(inside, np.sqrt(mount.believe(likelihood)), 0.0))
        return np.nan_to_num(np.concatenate(pixels)), np.concatenate(weights)

    def _misses(self, x: NDArray, seen: NDArray, weights: NDArray) -> NDArray:
        """Return what points (n, 2) [px] with weights (n,) are off those of a change."""
        camera, poses = self._look_from(x)
        there = [project(self._points[side] @ T[:3, :3].T + T[:3, 3], camera) for side, T in poses.items()]
        return (np.nan_to_num(seen - np.concatenate(there)) * weights[:, None]).ravel()


def _turn_over(color: NDArray, flip: tuple[int, int]) -> NDArray:
    """Return an image (h, w, 3) with the order of its columns and rows changed, by signs."""
    return np.ascontiguousarray(color[:: flip[1], :: flip[0]])


def describe_changes(changes: Sequence[PictureChange], width: int) -> str:
    """Return what the changes of some pictures, in their order, come from, and what to do; "" for small ones.

    Args:
        changes: of pictures that show jaws.
        width: of the pictures [px].
    """
    zooms, shifts, turns = (np.array([getattr(each, name) for each in changes]) for name in ("zoom", "shift", "turn"))
    zoom, shift, turn = (float(np.median(each)) for each in (zooms, shifts, turns))
    said = []
    steps = [float(np.median(np.abs(np.diff(each)))) if len(each) >= STEADY else 0.0 for each in (shifts, turns)]
    if steps[0] > UNSTEADY[0] * width or steps[1] > UNSTEADY[1]:
        said.append(
            f"the picture moves against the jaws from image to image, by {steps[0]:.1f} px and "
            f"{np.degrees(steps[1]):.1f} degrees in the median: turn off image stabilisation (EIS, HyperSmooth), or "
            "fix the camera"
        )
    elif abs(shift) > SHIFTED * width or abs(turn) > TURNED:
        said.append(
            f"the picture is shifted by {shift:+.1f} px across the closing axis and turned by {np.degrees(turn):+.1f} "
            "degrees from where the rig has the jaws: the camera has moved in its mount, or the picture was cropped; "
            "run finforce camera again"
        )
    if abs(np.log(zoom)) > ZOOMED:
        said.append(
            f"the picture is {zoom:.2f} times as large as the rig's camera has it ({zooms.min():.2f} to "
            f"{zooms.max():.2f}): record with the lens, field of view and resolution of the calibration and without "
            "digital zoom, or run finforce camera for this one"
        )
    return "; ".join(said)
