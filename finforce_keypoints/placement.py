"""Where a camera is and how jaws are mounted, from a few pictures of open, unloaded jaws and no guess.

A network that is shown the wrong place finds a finger there, too. What a picture shows of the finger's outline does not
depend on it: by how much colours tell the inside of the drawn outline from what surrounds it. The outline finds the
camera; the network's key points then say how each jaw is turned, where it stands in each picture, and which of its
points are never seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import SIDES, jaw_in_camera, look_at
from finforce.optional import import_cv2
from finforce.transforms import move_pose
from finforce_keypoints.detectors.side_plane import AnyFinger
from finforce_keypoints.errors import GeometryError
from finforce_keypoints.geometry.side_picture import PlaneGrid, find_side, map_picture, project_plane, take_picture
from finforce_keypoints.geometry.template import find_shape, fit_grid
from finforce_keypoints.parameters import REFERENCE, JawMount

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

COARSER, FINER = 4, 2  # times as large as those of the network's pictures are the pixels of outlines, first and last
AROUND = 0.1  # of the finger's length: what surrounds the outline
UNHELD = 0.35  # of the finger's length: what is below is likely to be covered by a holder
DARK = 30.0  # of 255: what is added to the brightness by which colours are divided
BEYOND = 0.3  # share of the compared pixels outside the image, from which on nothing is said
# Where wrist cameras are, in the gripper: y, z [m], tilt down [rad], half opening of the jaws [m].
LOW, HIGH = np.array([0.04, -0.15, -0.2, 0.015]), np.array([0.18, 0.05, 0.9, 0.08])
STARTS, KEPT, STEPS = 3000, 6, 300  # places that are tried, improved, and in how many steps
POLISHED, POLISH = 3, 15  # of these, places whose jaws are turned, too, and in how many steps
SIMPLEX = np.array([0.008, 0.008, 0.05, 0.008, 0.006, 0.02, 0.05])  # [m, m, rad, m, m, rad, rad]
# Least contrast of outlines that are there, in the mean: where they were searched for, the best of thousands of places
# explains some picture of no jaw to 0.77. With a guess, a grey finger before a textured ground shows with 0.44.
LEAST_FOUND, LEAST_GUESSED = 0.8, 0.3
ROUNDS = 12  # of finding key points with the place found before
ALIKE = 8.0  # independent points that all the points of a jaw in a picture are worth: what they err by is shared
PIXEL = 1.0  # [px] standard deviation of one of those
# How far outlines may be off the camera's place: three in m, three in rad; and how far jaws are mounted askew [rad].
OUTLINE_STDDEV = np.array([0.015, 0.015, 0.015, 0.06, 0.06, 0.06])
TURN_STDDEV = 0.05
MIDDLE_STDDEV = 1e-3  # [m] of the middle between the jaws, which says where the gripper's middle is
CUTS = 48  # directions in which a holder may cover a jaw up to a straight edge
HIDDEN = 0.1  # likelihood of a point that is never seen, wherever it lies
LEAST_SEEN = 8  # key points of a jaw
LEAST_LIKELIHOOD = 0.5  # mean likelihood of points that are not covered


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraPlacement:
    """Where a camera is and how jaws stand before it.

    Attributes:
        T_gripper_camera: (4, 4).
        mounts: side -> turn and covered points.
        origins: side -> place of the jaw's origin on the closing axis in each picture (n,) [m].
        contrast: of the outlines, 0 to 1.
        residual: root mean square distance of the points seen from where they should be [px].
        seen: side -> pixels of the points in each picture (n, K + 1, 2), NaN where one was not seen.
    """

    T_gripper_camera: NDArray
    mounts: Mapping[str, JawMount]
    origins: Mapping[str, NDArray]
    contrast: float
    residual: float
    seen: Mapping[str, NDArray]

    def pose(self, side: str, number: int) -> NDArray:
        """Return T_camera_jaw (4, 4) in a picture."""
        return jaw_in_camera(self.T_gripper_camera, side, self.origins[side][number], self.mounts[side].turn)


class OutlineContrast:
    """What tells the outline of a jaw from its surroundings.

    Args:
        jaw: whose side is drawn.
        coarser: times as large as those of the network's pictures are its pixels.
    """

    def __init__(self, jaw: Jaw, coarser: int = COARSER) -> None:
        cv2, shape = import_cv2(), find_shape(jaw)
        fine = fit_grid(shape)
        self._grid = PlaneGrid(
            scale=fine.scale * coarser, x=fine.x, z=fine.z, width=fine.width // coarser, height=fine.height // coarser
        )
        self._side = find_side(jaw)
        (_, low), (_, high) = shape.bounds
        filled = np.zeros((self._grid.height, self._grid.width), np.uint8)
        for ring in shape.rings:
            cv2.fillPoly(filled, [np.round(16.0 * self._grid.pixels(ring)).astype(np.int32)], 1, shift=4)
        reach = max(round(AROUND * (high - low) / self._grid.scale), 1)
        near = cv2.dilate(filled, np.ones((3, 3), np.uint8), iterations=reach) > 0
        heights = self._grid.z + self._grid.scale * np.arange(self._grid.height)
        self._near = near & (heights > low + UNHELD * (high - low))[:, None]
        inside = cv2.GaussianBlur(filled.astype(float), (0, 0), 0.7)[self._near]
        self._inside = inside - inside.mean()

    def contrast(self, color: NDArray, T_camera_jaw: NDArray, camera: CameraIntrinsics) -> float:
        """Return which share of the outline's variance the colours of an image explain, 0 to 1.

        R^2 of the regression of inside or outside on red, green, blue, and the shares of red and green in them.
        """
        mapping = map_picture(self._grid, self._side, T_camera_jaw, camera)
        colours = take_picture(color, mapping)[self._near].astype(float)
        brightness = colours.sum(axis=1, keepdims=True)
        if (brightness == 0.0).mean() > BEYOND:
            return 0.0
        values = np.hstack((colours, 100.0 * colours[:, :2] / (brightness + DARK)))
        values -= values.mean(axis=0)
        covariance, along = values.T @ values + len(values) * 1e-2 * np.eye(5), values.T @ self._inside
        return float(along @ np.linalg.solve(covariance, along) / (self._inside @ self._inside))


def place_camera(x: NDArray, right: float) -> NDArray:
    """Return T_gripper_camera (4, 4) of a wrist camera.

    Args:
        x: y, z [m], tilt down [rad], half opening (not used); perhaps x [m], turn to the side and about its axis [rad].
        right: direction of the image's rows along the gripper's x, 1 or -1.
    """
    y, z, tilt, _, aside, turned, rolled = np.pad(x, (0, 7 - len(x)))
    ahead = np.array([np.sin(turned), -np.sin(tilt), np.cos(tilt)])
    T = look_at((aside, y, z), np.array([aside, y, z]) + ahead, (right, 0.0, 0.0))
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, rolled]).as_matrix()
    return T


def search_camera(
    images: Sequence[NDArray], camera: CameraIntrinsics, jaws: Mapping[str, Jaw], progress: Callable[[int], Any]
) -> list[tuple[NDArray, float]]:
    """Return T_gripper_camera (4, 4) and half the distance of the jaws' origins [m] where outlines show, best first.

    Args:
        images: (h, w, 3) uint8 RGB.
        camera: intrinsics.
        jaws: by side.
        progress: called with the number of places tried since its last call.
    """
    outlines = {side: OutlineContrast(jaw) for side, jaw in jaws.items()}

    def compare(x: NDArray, right: float, colors: Sequence[NDArray]) -> float:
        T = place_camera(x, right)
        poses = {side: jaw_in_camera(T, side, _origin(side, x[3])) for side in jaws}
        return float(
            np.mean([outlines[side].contrast(color, pose, camera) for side, pose in poses.items() for color in colors])
        )

    rng, tried = np.random.default_rng(0), []
    for number in range(STARTS):
        x, right = rng.uniform(LOW, HIGH), -1.0 if number % 2 else 1.0
        tried.append((compare(x, right, images[:1]), right, x))
        progress(1)
    tried.sort(key=lambda each: each[0], reverse=True)
    best = []
    for _, right, start in tried[:KEPT]:
        begin = np.r_[start, 0.0, 0.0, 0.0]
        fit = minimize(
            lambda x, right=right: -compare(x, right, images),
            begin,
            method="Nelder-Mead",
            options={"maxfev": STEPS, "initial_simplex": np.vstack((begin, begin + np.diag(SIMPLEX)))},
        )
        best.append((fit.fun, right, fit.x))
        progress(STEPS)
    best.sort(key=lambda each: each[0])
    return [(place_camera(x, right), float(x[3])) for _, right, x in best[:POLISHED]]


def _origin(side: str, half: float) -> float:
    return -half if side == "left" else half


def find_placement(
    images: Sequence[NDArray],
    camera: CameraIntrinsics,
    jaws: Mapping[str, Jaw],
    locator: AnyFinger,
    guess: NDArray | None = None,
    half: float = 0.045,
    progress: Callable[[int], Any] = lambda steps: None,
) -> CameraPlacement:
    """Return where the camera is and how the jaws are mounted.

    Args:
        images: (h, w, 3) uint8 RGB, of open and unloaded jaws that may stand elsewhere in each.
        camera: intrinsics.
        jaws: by side.
        locator: finds the points in pictures of their sides.
        guess: T_gripper_camera (4, 4); None: it is searched for.
        half: guess of half the distance of the jaws' origins [m].
        progress: called with the number of steps done since its last call.

    Raises:
        GeometryError: there are no such jaws in the pictures.
    """
    starts = [(guess, half)] if guess is not None else search_camera(images, camera, jaws, progress)
    least = LEAST_FOUND if guess is None else LEAST_GUESSED
    fits = [_Refinement(images, camera, jaws, locator, *start, least) for start in starts]
    for fit in fits:
        fit.polish()
    fit = max(fits, key=lambda each: each.contrast())
    for _ in range(ROUNDS):
        fit.improve()
        progress(len(images))
    return fit.describe()


def find_covered(likelihood: NDArray, places: NDArray) -> NDArray[np.bool_]:
    """Return which points (n,) are covered: those beyond the straight edge that parts likely and unlikely ones best.

    Args:
        likelihood: of the points to be seen (n,).
        places: of the points on the jaw's side (n, 2) [m].
    """
    best, covered = float((likelihood - 0.5).sum()), np.zeros(len(likelihood), dtype=bool)
    for angle in np.linspace(0.0, 2.0 * np.pi, CUTS, endpoint=False):
        order = np.argsort(places @ (np.cos(angle), np.sin(angle)))
        # what is won by taking the first points for covered: twice what they are less likely than even
        gains = np.cumsum(1.0 - 2.0 * likelihood[order])
        number = int(np.argmax(gains))
        total = float((likelihood - 0.5).sum() + gains[number])
        if total > best + 1e-9:
            best, covered = total, np.isin(np.arange(len(likelihood)), order[: number + 1])
    return covered | (likelihood < HIDDEN)


class _Refinement:
    """Camera, turns and origins by least squares over the pixels that a network finds, again and again."""

    def __init__(
        self,
        images: Sequence[NDArray],
        camera: CameraIntrinsics,
        jaws: Mapping[str, Jaw],
        locator: AnyFinger,
        T: NDArray,
        half: float,
        least_contrast: float,
    ) -> None:
        self._least_contrast = least_contrast
        self._images, self._camera, self._jaws, self._locator = images, camera, jaws, locator
        self._points = {side: np.vstack((jaw.keypoints, jaw.reference_point)) for side, jaw in jaws.items()}
        self._planes = {side: find_side(jaw) for side, jaw in jaws.items()}
        self._outlines = {side: OutlineContrast(jaw, FINER) for side, jaw in jaws.items()}
        self._start, count, sides = T, len(images), len(jaws)
        origins = [np.full(count, _origin(side, half)) for side in jaws]
        # step of the camera, turns of the jaws, origins by jaw and picture
        self._x = np.concatenate((np.zeros(6 + 3 * sides), *origins))
        self._scale = np.full(len(self._x), 5e-3)  # [m]
        self._scale[3 : 6 + 3 * sides] = 0.03  # [rad]
        self._best = (-1.0, self._x)

    def _split(self, x: NDArray) -> tuple[NDArray, dict[str, NDArray], dict[str, NDArray]]:
        """Return the camera's pose (4, 4), and by side the turn (3,) and the origins (n,)."""
        sides, count = len(self._jaws), len(self._images)
        turns = dict(zip(self._jaws, x[6 : 6 + 3 * sides].reshape(sides, 3), strict=True))
        origins = dict(zip(self._jaws, x[6 + 3 * sides :].reshape(sides, count), strict=True))
        return move_pose(self._start, x[:6]), turns, origins

    def contrast(self, x: NDArray | None = None) -> float:
        """Return the mean contrast of the outlines."""
        T, turns, origins = self._split(self._x if x is None else x)
        return float(
            np.mean(
                [
                    self._outlines[side].contrast(color, jaw_in_camera(T, side, place, turns[side]), self._camera)
                    for side in self._jaws
                    for color, place in zip(self._images, origins[side], strict=True)
                ]
            )
        )

    def polish(self) -> None:
        """Move camera and jaws until the outlines show best."""
        start = self._x / self._scale

        def judge(x: NDArray) -> float:
            turns = x[6 : 6 + 3 * len(self._jaws)] * 0.03 / TURN_STDDEV
            return 0.01 * float(turns @ turns) - self.contrast(x * self._scale)

        fit = minimize(judge, start, method="L-BFGS-B", options={"maxiter": POLISH, "eps": 0.02})
        self._start, self._x = self._split(fit.x * self._scale)[0], fit.x * self._scale
        self._x[:6] = 0.0

    def _look(self) -> None:
        """Find the points of every jaw in every picture."""
        T, turns, origins = self._split(self._x)
        self._seen, self._likelihood = {}, {}
        for side in self._jaws:
            grid, plane = self._locator.grids[side], self._planes[side]
            poses = [jaw_in_camera(T, side, x, turns[side]) for x in origins[side]]
            pictures = [
                take_picture(color, map_picture(grid, plane, pose, self._camera))
                for color, pose in zip(self._images, poses, strict=True)
            ]
            found = self._locator.locate(np.stack(pictures), [side] * len(pictures))
            pixels = [
                project_plane(grid.places(each), plane, pose, self._camera)
                for each, pose in zip(found.pixels, poses, strict=True)
            ]
            self._seen[side] = np.array(pixels)
            inside = np.isfinite(self._seen[side]).all(axis=2)
            inside &= (self._seen[side] >= 0.0).all(axis=2)
            inside &= (self._seen[side] < (self._camera.width, self._camera.height)).all(axis=2)
            self._likelihood[side] = np.where(inside, found.likelihood, 0.0)

    def _misses(self, x: NDArray) -> NDArray:
        """Return what is off, in standard deviations."""
        T, turns, origins = self._split(x)
        parts = [x[:6] / OUTLINE_STDDEV, np.concatenate([*turns.values()]) / TURN_STDDEV]
        for side in self._jaws:
            away = self._away(side, T, turns[side], origins[side])
            share = np.minimum(1.0, ALIKE / np.maximum(self._likelihood[side].sum(axis=1), 1e-9))
            weight = np.sqrt(self._likelihood[side] * share[:, None])
            parts.append((away * weight[:, :, None] / PIXEL).ravel())
        middles = sum(origins.values()) / 2.0 if len(origins) == len(SIDES) else np.zeros(1)
        return np.concatenate((*parts, [middles.mean() / MIDDLE_STDDEV]))

    def _away(self, side: str, T: NDArray, turn: NDArray, origins: NDArray) -> NDArray:
        """Return by how many columns and rows the points seen are off their places (n, K + 1, 2) [px]."""
        away = []
        for x, seen in zip(origins, self._seen[side], strict=True):
            pose = jaw_in_camera(T, side, x, turn)
            away.append(seen - project(self._points[side] @ pose[:3, :3].T + pose[:3, 3], self._camera))
        return np.nan_to_num(np.array(away))

    def improve(self) -> None:
        """Find the points, and with them camera, turns and origins."""
        self._look()
        self._keep_best()
        self._x = least_squares(self._misses, self._x, x_scale=self._scale, loss="soft_l1").x

    def _keep_best(self) -> None:
        """Remember where the points were most likely so far."""
        score = float(np.mean([each.mean() for each in self._likelihood.values()]))
        if score > self._best[0]:
            self._best = (score, self._x)

    def describe(self) -> CameraPlacement:
        """Return what was found, and which points are never seen.

        Raises:
            GeometryError: outlines do not show, or too few points are seen.
        """
        self._look()
        self._keep_best()
        self._x = self._best[1]
        self._look()
        (T, turns, origins), contrast = self._split(self._x), self.contrast()
        usual = np.array([np.median(each, axis=0) for each in self._likelihood.values()]).mean(axis=0)
        first = next(iter(self._jaws))
        visible = ~find_covered(usual, self._points[first][:, ::2])
        count, likely = int(visible[:-1].sum()), float(usual[visible].mean()) if visible.any() else 0.0
        if count < LEAST_SEEN or likely < LEAST_LIKELIHOOD or contrast < self._least_contrast:
            raise GeometryError(
                f"no such jaws: outlines of '{self._jaws[first].name}' show with a contrast of {contrast:.2f} (least: "
                f"{self._least_contrast:g}), {count} key points are seen (at least {LEAST_SEEN}) with a "
                f"likelihood of {likely:.2f} (at least {LEAST_LIKELIHOOD:g}): another finger, other intrinsics, loaded "
                "jaws, or none in view? Jaws that look like their background need a guess of T_gripper_camera"
            )
        mounts, away, kept = {}, [], {}
        for side, jaw in self._jaws.items():
            names = np.array([*jaw.keypoint_names, REFERENCE])
            mounts[side] = JawMount(turn=turns[side], covered=frozenset(names[~visible].tolist()))
            sure = (self._likelihood[side] >= 0.5) & visible
            kept[side] = np.where(sure[:, :, None], self._seen[side], np.nan)
            away.append(self._away(side, T, turns[side], origins[side])[sure])
        return CameraPlacement(
            T_gripper_camera=T,
            mounts=mounts,
            origins=origins,
            contrast=contrast,
            residual=float(np.sqrt((np.concatenate(away) ** 2).sum(axis=1).mean())),
            seen=kept,
        )
