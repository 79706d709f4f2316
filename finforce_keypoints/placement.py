"""Where a camera is and how jaws are mounted, from a few pictures of open, unloaded jaws and no guess.

A network that is shown the wrong place finds a finger there, too. What a picture shows of the finger's outline and of
its ribs does not depend on it. Outlines, by how much colours tell their inside from what surrounds them, say roughly
where the camera may be; the pattern of the ribs says where it is, and how sure that is. The network's key points then
refine how each jaw is turned and where it stands in each picture, and say which of its points are never seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import SIDES, OpeningRange, jaw_in_camera, jaw_in_gripper, look_at
from finforce.optional import import_cv2
from finforce.transforms import invert_pose, move_pose
from finforce_keypoints.detectors.side_plane import AnyFinger
from finforce_keypoints.errors import GeometryError
from finforce_keypoints.geometry.rib_pattern import Moments, RibPattern, correlate, subtract_pattern, weigh_evidence
from finforce_keypoints.geometry.side_picture import (
    PlaneGrid,
    SidePlane,
    find_side,
    intersect_plane,
    map_picture,
    project_plane,
    take_picture,
)
from finforce_keypoints.geometry.template import find_shape, fit_grid
from finforce_keypoints.parameters import REFERENCE, JawMount

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

COARSER = 4  # times as large as those of the network's pictures are the pixels of outlines
AROUND = 0.1  # of the finger's length: what surrounds the outline
UNHELD = 0.35  # of the finger's length: what is below is likely to be covered by a holder
DARK = 30.0  # of 255: what is added to the brightness by which colours are divided
# Directions of a holder's edge, none of which leaves the base and covers the tip, shares of the finger beyond it, and
# what a share of it costs in contrast.
EDGES, HELD, HELD_COST = 7, (0.15, 0.3, 0.45), 0.15
BEYOND = 0.3  # share of the compared pixels outside the image, from which on nothing is said
OPENING_STEP = 1e-3  # [m] between the places where jaws are looked for
WHOLE = 0  # the edge beyond which there is nothing
# Where wrist cameras are, in the gripper: y, z [m], tilt down [rad], half opening of the jaws [m].
LOW, HIGH = np.array([0.04, -0.15, -0.2, 0.015]), np.array([0.18, 0.05, 0.9, 0.08])
STARTS, KEPT, STEPS = 3000, 4, 300  # places that are tried; improved, whole and up to an edge; and in how many steps
POLISHED, POLISH = 2, 400  # of each of these, places whose jaws are turned, too, and in how many steps
SIMPLEX = np.array([0.008, 0.008, 0.05, 0.008, 0.006, 0.02, 0.05])  # [m, m, rad, m, m, rad, rad]
NEWTON, DAMPED, STEP, SETTLED = 15, 4, 0.02, 1e-4  # steps to a pattern, trials of each, its [of 5 mm], least gain
PRIOR = 0.003  # of the squares of what is off beforehand, in contrast or correlation
# Where outlines leave a finger, as shares of its length, rise along its width, and ribs along itself.
STRETCHES = np.linspace(0.85, 1.15, 11)
SLANTS = (-0.1, 0.0, 0.1)
SHIFTS = np.arange(-2.0, 2.01, 0.25)
ASIDES = (-1.5e-3, 0.0, 1.5e-3)  # [m] across it
TIPWARDS = 12  # an edge beyond which the tips lie
PLACES = 5  # that fit the pattern best, of all starts
COMPARED = 2  # pictures in which starts are compared, and places that are; all pictures refine the best
# Least correlation of the pattern, and what may be told elsewhere at most, as a share.
LEAST_CORRELATION, MOST_RIVAL = 0.4, 0.85
LEAST_SHOWN = 0.25  # the same of a finger that is there at all
ROUNDS = 6  # of finding key points with the place found before
ALIKE = 8.0  # independent points that all the points of a jaw in a picture are worth: what they err by is shared
PIXEL = 1.0  # [px] standard deviation of one of those
# How far outlines may be off the camera's place: three in m, three in rad; and how far jaws are mounted askew [rad].
START_STDDEV = np.array([0.03, 0.03, 0.03, 0.12, 0.12, 0.12])
TURN_STDDEV = 0.05
MIDDLE_STDDEV = 1e-3  # [m] of the middle between the jaws, which says where the gripper's middle is
CUTS = 48  # directions in which a holder may cover a jaw up to a straight edge
HIDDEN = 0.1  # likelihood of a point that is never seen, wherever it lies
LEAST_SEEN = 8  # key points of a jaw
# Likelihood that a rig makes of that of a typical point: a network is less sure of small and of unusual fingers.
TYPICAL, LEAST_TYPICAL, MOST_ODDS = 0.75, 0.15, 17.0
# [px] Root mean square of points seen off their places, over their likelihood: 0.9 to 2.6 of real fingers in holders,
# 3.1 and more of other fingers, of these one rib off, and of pictures without any.
MOST_LEFT = 2.8
STROKE_STDDEV = 1e-3  # [m] of a stated distance of the jaws
TAG_EDGE = 0.015  # standard deviation of the length of a tag's edge in a picture, as a share
TAG_LEVEL = 4e-3  # [m] by which a holder's tag may be nearer to the camera than the jaw's side, or farther
TAG_PLACE = 1e-3  # [m] standard deviation of where a tag is on its jaw, from picture to picture


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownSizes:
    """What is known of camera and jaws beforehand.

    Attributes:
        guess: T_gripper_camera (4, 4), or None.
        stddev: of the guess, three in m and three in rad (6,).
        stroke: distance of the jaws' inner faces where they are farthest open [m], or None.
        tags: corners (4, 2) [px] by number of tags on the holders, in each picture.
        tag_size: length of an edge of them [m].
    """

    guess: NDArray | None = None
    stddev: NDArray = field(default_factory=lambda: START_STDDEV)
    stroke: float | None = None
    tags: Sequence[Mapping[int, NDArray]] = ()
    tag_size: float = 0.016

    def misses(
        self, origins: Mapping[str, NDArray], poses: Mapping[str, Sequence[NDArray]], scene: _Scene
    ) -> list[float]:
        """Return what sizes are off, in standard deviations.

        Args:
            origins: side -> places of the jaw's origin on the closing axis (n,) [m].
            poses: side -> T_camera_jaw (4, 4) in each picture.
            scene: jaws and camera.
        """
        off: list[float] = []
        if self.stroke is not None and len(origins) == len(SIDES):
            faces = 2.0 * next(iter(scene.jaws.values())).inner_face_x
            off.append((np.max(origins["right"] - origins["left"]) - faces - self.stroke) / STROKE_STDDEV)
        for number in {number for tags in self.tags for number in tags}:
            off += self._tag_misses(number, poses, scene)
        return off

    def _tag_misses(self, number: int, poses: Mapping[str, Sequence[NDArray]], scene: _Scene) -> list[float]:
        """Return by what a tag is larger than it is on the side of its jaw, and where it moves against it."""
        shown = [n for n, tags in enumerate(self.tags) if number in tags]
        best: NDArray | None = None
        for side, plane in scene.planes.items():
            corners = np.array(
                [intersect_plane(self.tags[n][number], plane, poses[side][n], scene.camera) for n in shown]
            )
            if best is None or abs(corners[..., 0].mean()) < abs(best[..., 0].mean()):
                best, height = corners, float(np.mean([abs(poses[side][n][2, 3]) for n in shown]))
                height = float(np.mean([abs((invert_pose(poses[side][n])[1, 3]) - plane.level) for n in shown]))
        edges = np.linalg.norm(np.roll(best, 1, axis=1) - best, axis=2)
        deviation = np.hypot(TAG_EDGE / np.sqrt(edges.size), TAG_LEVEL / height)
        moved = best.mean(axis=1) - best.mean(axis=(0, 1))
        return [(float(edges.mean()) / self.tag_size - 1.0) / deviation, *(moved / TAG_PLACE).ravel()]


@dataclass(frozen=True, kw_only=True)
class PlacementComparison:
    """How well the ribs in pictures fit a place.

    Attributes:
        correlation: of the pictures with the pattern of the ribs there.
        rival: what ribs and outlines tell where they fit best, half a rib away and more, as a share of what they tell
            there; 0 without such a place.
    """

    correlation: float
    rival: float

    @property
    def is_right(self) -> bool:
        """Whether the ribs are there, and nowhere else rather."""
        return self.correlation >= LEAST_CORRELATION and self.rival <= 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraPlacement:
    """Where a camera is and how jaws stand before it.

    Attributes:
        T_gripper_camera: (4, 4).
        mounts: side -> turn and covered points.
        origins: side -> place of the jaw's origin on the closing axis in each picture (n,) [m].
        correlation: of the pictures with the pattern of the ribs, 0 to 1.
        residual: root mean square distance of the points seen from where they should be [px].
        seen: side -> pixels of the points in each picture (n, K + 1, 2), NaN where one was not seen.
        rival: what ribs and outlines tell where they fit next best, half a rib and more away, as a share of this.
    """

    T_gripper_camera: NDArray
    mounts: Mapping[str, JawMount]
    origins: Mapping[str, NDArray]
    correlation: float
    residual: float
    seen: Mapping[str, NDArray]
    rival: float = 0.0

    @property
    def is_sure(self) -> bool:
        """Whether the ribs say that the key points are here and nowhere else."""
        return self.correlation >= LEAST_CORRELATION and self.rival <= MOST_RIVAL

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
        self._inside = cv2.GaussianBlur(filled.astype(float), (0, 0), 0.7)[self._near, None]
        rows, columns = np.nonzero(self._near)
        places = self._grid.places(np.column_stack((columns, rows)))
        self.edges = [(0.0, np.zeros(2), -1.0)]
        for angle in np.linspace(0.0, np.pi, EDGES):
            across = np.array([np.cos(angle), np.sin(angle)])
            beyond = np.quantile(places[filled[self._near] > 0] @ across, HELD)
            self.edges += [(share, across, float(edge)) for share, edge in zip(HELD, beyond, strict=True)]
        self._open = np.array([places @ across > edge for _, across, edge in self.edges], dtype=float)
        self._cost = HELD_COST * np.array([share for share, *_ in self.edges])

    def contrasts(
        self, color: NDArray, T_camera_jaw: NDArray, camera: CameraIntrinsics, edge: int | None = None
    ) -> NDArray:
        """Return which share of the open outline's variance an image's colours explain, for one edge or each (e,).

        R^2 of the regression of inside or outside on red, green, blue, and the shares of red and green in them, less
        what it costs to take part of the outline for held.
        """
        mapping = map_picture(self._grid, self._side, T_camera_jaw, camera)
        colours = take_picture(color, mapping)[self._near].astype(float)
        chosen = slice(None) if edge is None else slice(edge, edge + 1)
        brightness = colours.sum(axis=1, keepdims=True)
        if (brightness == 0.0).mean() > BEYOND:
            return np.zeros(len(self._open[chosen]))
        shares = 100.0 * colours[:, :2] / (brightness + DARK) - 33.0
        values = np.hstack((colours - colours.mean(axis=0), shares, self._inside, np.ones_like(self._inside)))
        first, second = np.triu_indices(7)
        moments = np.empty((len(self._open[chosen]), 7, 7))
        moments[:, first, second] = moments[:, second, first] = self._open[chosen] @ (
            values[:, first] * values[:, second]
        )
        count, sums = moments[:, 6:, 6:], moments[:, :6, 6:]
        spread = moments[:, :6, :6] - sums @ sums.swapaxes(1, 2) / count
        along = spread[:, :5, 5:]
        explained = along.swapaxes(1, 2) @ np.linalg.solve(spread[:, :5, :5] + 1e-2 * count * np.eye(5), along)
        return (explained / spread[:, 5:, 5:])[:, 0, 0] - self._cost[chosen]


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
) -> list[tuple[NDArray, float, int | None]]:
    """Return T_gripper_camera (4, 4), half the distance of the jaws' origins [m] and the edge where outlines show.

    Args:
        images: (h, w, 3) uint8 RGB.
        camera: intrinsics.
        jaws: by side.
        progress: called with the number of places tried since its last call.
    """
    outlines = {side: OutlineContrast(jaw) for side, jaw in jaws.items()}

    def compare(x: NDArray, right: float, colors: Sequence[NDArray], edge: int | None = None) -> NDArray:
        T = place_camera(x, right)
        poses = {side: jaw_in_camera(T, side, _origin(side, x[3])) for side in jaws}
        shown = [
            outlines[side].contrasts(color, pose, camera, edge) for side, pose in poses.items() for color in colors
        ]
        return np.mean(shown, axis=0)

    rng, tried = np.random.default_rng(0), []
    for number in range(STARTS):
        x, right = rng.uniform(LOW, HIGH), -1.0 if number % 2 else 1.0
        tried.append((compare(x, right, images[:1]), right, x))
        progress(1)
    starts = []
    for edge in (WHOLE, None):  # a holder that is not there explains much where something else stands
        best = []
        tried.sort(key=lambda each, edge=edge: each[0].max() if edge is None else each[0][edge], reverse=True)
        for _, right, start in tried[:KEPT]:
            begin = np.r_[start, 0.0, 0.0, 0.0]
            fit = minimize(
                lambda x, right=right, edge=edge: -compare(x, right, images[:COMPARED], edge).max(),
                begin,
                method="Nelder-Mead",
                options={"maxfev": STEPS, "initial_simplex": np.vstack((begin, begin + np.diag(SIMPLEX)))},
            )
            best.append((fit.fun, right, fit.x))
            progress(STEPS)
        best.sort(key=lambda each: each[0])
        starts += [(place_camera(x, right), float(x[3]), edge) for _, right, x in best[:POLISHED]]
    return starts


def _origin(side: str, half: float) -> float:
    return -half if side == "left" else half


def find_placement(
    images: Sequence[NDArray],
    camera: CameraIntrinsics,
    jaws: Mapping[str, Jaw],
    locator: AnyFinger,
    known: KnownSizes | None = None,
    half: float = 0.045,
    progress: Callable[[int], Any] = lambda steps: None,
) -> CameraPlacement:
    """Return where the camera is and how the jaws are mounted.

    Outlines say roughly where the camera may be. From each of these places, and from those where the finger is
    stretched and shifted along itself, camera and jaws move until the pattern of the ribs shows best; the place with
    the best pattern is compared with itself one and two ribs further, and refined by the points that the network finds.

    Args:
        images: (h, w, 3) uint8 RGB, of open and unloaded jaws that may stand elsewhere in each.
        camera: intrinsics.
        jaws: by side.
        locator: finds the points in pictures of their sides.
        known: what is known of the place beforehand.
        half: guess of half the distance of the jaws' origins [m].
        progress: called with the number of steps done since its last call.

    Raises:
        GeometryError: there are no such jaws in the pictures.
    """
    known = known or KnownSizes()
    scene = _Scene(images, camera, jaws, locator, known)
    if known.guess is not None:
        starts: list[tuple[NDArray, float, int | None]] = [(known.guess, half, WHOLE)]
    else:
        starts = search_camera(images, camera, jaws, progress)
    tried: list[_Place] = []
    found: list[_Fit] = []
    for T, opening, edge in starts:
        fit = _Fit(scene, T, opening)
        fit.polish_outline(edge)
        tried += fit.try_places()
        found.append(fit.follow_network())
        progress(STEPS)
    tried.sort(key=lambda each: each.evidence, reverse=True)
    for place in tried[:PLACES]:
        found.append(place.settle())
        progress(STEPS)
    found += max(found, key=lambda each: each.evidence).shift_by_ribs()
    found.sort(key=lambda each: each.evidence, reverse=True)
    agreed: list[tuple[_Fit, CameraPlacement]] = []
    failures: list[GeometryError] = []
    for fit in found:
        for _ in range(ROUNDS):
            fit.improve()
        try:
            agreed.append((fit, fit.describe()))
        except GeometryError as error:
            failures.append(error)
    if not agreed:
        raise failures[0]
    best, placement = max(agreed, key=lambda each: each[0].evidence)
    rivals = [other.evidence / best.evidence for other in found if best.is_elsewhere(other)]
    return replace(placement, rival=max(rivals, default=0.0))


def compare_placement(
    images: Sequence[NDArray],
    camera: CameraIntrinsics,
    jaws: Mapping[str, Jaw],
    T_gripper_camera: NDArray,
    mounts: Mapping[str, JawMount],
    opening: OpeningRange,
) -> PlacementComparison:
    """Return how well the ribs in pictures fit a known place of camera and jaws, and any other.

    Args:
        images: (h, w, 3) uint8 RGB, of open and unloaded jaws.
        camera: intrinsics.
        jaws: by side.
        T_gripper_camera: (4, 4).
        mounts: how the jaws are mounted, by side.
        opening: where the jaws can be.
    """
    fit = _Fit(_Scene(images, camera, jaws, None, KnownSizes()), T_gripper_camera, opening.farthest)
    fit.open_jaws(mounts, opening)
    tried = sorted(fit.try_places(), key=lambda each: each.evidence, reverse=True)
    others = [place.settle() for place in tried[:COMPARED]]
    others += others[0].shift_by_ribs()
    rivals = [each.evidence / max(fit.evidence, 1e-9) for each in others if fit.is_elsewhere(each)]
    return PlacementComparison(correlation=fit.correlation, rival=max(rivals, default=0.0))


def find_points(
    images: Sequence[NDArray],
    camera: CameraIntrinsics,
    locator: AnyFinger,
    side: str,
    plane: SidePlane,
    poses: Sequence[NDArray],
) -> tuple[NDArray, NDArray]:
    """Return pixels (n, K + 1, 2) and likelihoods (n, K + 1) of a jaw's points in images (h, w, 3), one pose each.

    Args:
        images: RGB.
        camera: intrinsics.
        locator: finds the points in pictures of the side.
        side: of the jaw.
        plane: of its side.
        poses: T_camera_jaw (4, 4).
    """
    grid = locator.grids[side]
    pictures = [
        take_picture(color, map_picture(grid, plane, T, camera)) for color, T in zip(images, poses, strict=True)
    ]
    found = locator.locate(np.stack(pictures), [side] * len(pictures))
    pixels = [project_plane(grid.places(each), plane, T, camera) for each, T in zip(found.pixels, poses, strict=True)]
    return np.array(pixels), found.likelihood


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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Place:
    """Where the finger may be on the sides of a fit: stretched and slanted around a tip (2,), shifted along itself [m].

    `edge` is the number of that of the holder, `evidence` what the pattern tells.
    """

    fit: _Fit
    edge: int
    tip: NDArray = field(default_factory=lambda: np.zeros(2))
    stretch: float = 1.0
    slant: float = 0.0
    along: float = 0.0
    evidence: float = 0.0

    def warp(self, places: NDArray, aside: float = 0.0) -> NDArray:
        """Return where places (n, 2) of the finger are on the side, shifted aside, too [m]."""
        x, z = (places - self.tip).T
        return self.tip + np.column_stack((x + aside, self.stretch * z + self.slant * x + self.along))

    def is_near(self, other: _Place, pitch: float) -> bool:
        """Say whether the way between two places is less than half a rib, and leads to the same fit."""
        return abs(self.stretch - other.stretch) < 0.05 and abs(self.along - other.along) < 0.6 * pitch

    def settle(self) -> _Fit:
        """Return the fit to it."""
        return self.fit.settle(self)


def find_pitch(points: NDArray) -> float:
    """Return the distance [m] from one rib to the next, the median of key points (n, 2) to their neighbours."""
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    return float(np.median(np.sort(apart, axis=1)[:, 1]))


class _Scene:
    """Pictures, jaws, and what tells them."""

    def __init__(
        self,
        images: Sequence[NDArray],
        camera: CameraIntrinsics,
        jaws: Mapping[str, Jaw],
        locator: AnyFinger | None,
        known: KnownSizes,
    ) -> None:
        self.images, self.camera, self.jaws, self.locator, self.known = images, camera, jaws, locator, known
        self.points = {side: np.vstack((jaw.keypoints, jaw.reference_point)) for side, jaw in jaws.items()}
        self.planes = {side: find_side(jaw) for side, jaw in jaws.items()}
        self.outlines = {side: OutlineContrast(jaw) for side, jaw in jaws.items()}
        self.edges = next(iter(self.outlines.values())).edges
        lines = [(across, edge) for _, across, edge in self.edges]
        self.patterns = {side: RibPattern(jaw, lines) for side, jaw in jaws.items()}
        self.pitch = find_pitch(next(iter(self.points.values()))[:-1, ::2])


class _Fit:
    """Camera, turns and origins: by outlines, by the pattern of the ribs, and by the pixels that a network finds."""

    def __init__(self, scene: _Scene, T: NDArray, half: float) -> None:
        self._scene, self._start, self._edge = scene, T, WHOLE
        count, sides = len(scene.images), len(scene.jaws)
        origins = [np.full(count, _origin(side, half)) for side in scene.jaws]
        # step of the camera, turns of the jaws, origins by jaw and picture
        self._x = np.concatenate((np.zeros(6 + 3 * sides), *origins))
        self._scale = np.full(len(self._x), 5e-3)  # [m]
        self._scale[3 : 6 + 3 * sides] = 0.03  # [rad]
        self._stddev = START_STDDEV if scene.known.guess is None else scene.known.stddev
        self.correlation = self.evidence = 0.0

    def _at(self, x: NDArray, edge: int) -> _Fit:
        """Return the same elsewhere."""
        other = copy(self)
        other._x, other._edge = x, edge
        return other

    def _split(self, x: NDArray) -> tuple[NDArray, dict[str, NDArray], dict[str, NDArray]]:
        """Return the camera's pose (4, 4), and by side the turn (3,) and the origins (n,)."""
        jaws = self._scene.jaws
        sides, count = len(jaws), len(self._scene.images)
        turns = dict(zip(jaws, x[6 : 6 + 3 * sides].reshape(sides, 3), strict=True))
        origins = dict(zip(jaws, x[6 + 3 * sides :].reshape(sides, count), strict=True))
        return move_pose(self._start, x[:6]), turns, origins

    def _poses(self, x: NDArray) -> dict[str, NDArray]:
        """Return T_camera_jaw (n, 4, 4) in the pictures by side."""
        T, turns, origins = self._split(x)
        back, poses = invert_pose(T), {}
        for side, places in origins.items():
            poses[side] = np.tile(jaw_in_gripper(side, 0.0, turns[side]), (len(places), 1, 1))
            poses[side][:, 0, 3] = places
            poses[side] = back @ poses[side]
        return poses

    def _contrasts(self, x: NDArray, edge: int | None = None) -> NDArray:
        """Return the mean contrast of the outlines up to an edge of the holder, or each (e,)."""
        scene, poses = self._scene, self._poses(x)
        shown = [
            scene.outlines[side].contrasts(color, pose, scene.camera, edge)
            for side in poses
            for color, pose in zip(scene.images, poses[side], strict=True)
        ]
        return np.mean(shown, axis=0)

    def _compare(self, x: NDArray, edge: int) -> list[Moments]:
        """Return what the pictures have in common with the pattern of the ribs."""
        scene, poses = self._scene, self._poses(x)
        return [
            scene.patterns[side].compare(color, pose, scene.camera, edge)
            for side in poses
            for color, pose in zip(scene.images, poses[side], strict=True)
        ]

    def polish_outline(self, edge: int | None) -> None:
        """Move camera and jaws until the outlines show best up to an edge, without one up to the best."""
        self._edge = int(np.argmax(self._contrasts(self._x))) if edge is None else edge
        self._climb(lambda x, edge: float(self._contrasts(x, edge)[0]), POLISH)

    def polish_pattern(self) -> None:
        """Move camera and jaws until the ribs show best."""
        for _ in range(2):
            self._match_pattern()
            self._weigh()

    def _match_pattern(self, first: int = 0) -> None:
        """Move what begins with the first number until the pattern leaves least, by damped Gauss-Newton steps."""
        x, damping, left = self._x / self._scale, 1e-2, self._left_over(self._x)
        for _ in range(NEWTON):
            slopes = np.zeros((len(left), len(x)))
            for number in range(first, len(x)):
                beside = x.copy()
                beside[number] += STEP
                slopes[:, number] = (self._left_over(beside * self._scale) - left) / STEP
            normal = slopes.T @ slopes
            for _ in range(DAMPED):
                size = normal + damping * (np.diag(np.diag(normal)) + 1e-6 * np.eye(len(x)))
                moved = x - np.linalg.solve(size, slopes.T @ left)
                there = self._left_over(moved * self._scale)
                if there @ there < left @ left:
                    break
                damping *= 10.0
            else:
                break
            gain = left @ left - there @ there
            x, left, damping = moved, there, 0.1 * damping
            if gain < SETTLED:
                break
        self._x = x * self._scale

    def _left_over(self, x: NDArray) -> NDArray:
        """Return what the pattern leaves in the pictures, and what is off what is known beforehand."""
        scene, poses = self._scene, self._poses(x)
        samples = [
            scene.patterns[side].sample(color, pose, scene.camera, self._edge)
            for side in poses
            for color, pose in zip(scene.images, poses[side], strict=True)
        ]
        return np.concatenate((subtract_pattern(samples), np.sqrt(PRIOR) * self._known_misses(x)))

    def _weigh(self) -> None:
        """Take that edge of a holder beyond which ribs and outline tell most."""
        opens = next(iter(self._scene.patterns.values())).opens
        told = [self._compare(self._x, edge) for edge in range(len(opens))]
        outlines = self._contrasts(self._x)
        evidence = [
            weigh_evidence(each, len(part.places), float(outline))
            for each, part, outline in zip(told, opens, outlines, strict=True)
        ]
        self._edge = int(np.argmax(evidence))
        self.correlation, self.evidence = correlate(told[self._edge]), max(evidence)

    def _climb(self, measure: Callable[[NDArray, int], float], steps: int, first: int = 0) -> None:
        """Move what begins with the first number until a measure is best."""
        whole = self._x / self._scale

        def judge(part: NDArray) -> float:
            x = np.concatenate((whole[:first], part)) * self._scale
            off = self._known_misses(x)
            return PRIOR * float(off @ off) - measure(x, self._edge)

        fit = minimize(judge, whole[first:], method="L-BFGS-B", options={"maxfun": steps, "eps": 0.02})
        self._x = np.concatenate((whole[:first], fit.x)) * self._scale

    def open_jaws(self, mounts: Mapping[str, JawMount], opening: OpeningRange) -> None:
        """Find where the jaws stand in each picture, camera and turns being known."""
        scene, first = self._scene, 6 + 3 * len(mounts)
        self._x[6:first] = np.concatenate([mounts[side].turn for side in scene.jaws])
        T, turns, origins = self._split(self._x)
        for side, places in origins.items():
            poses = opening.place_jaw(T, side, OPENING_STEP, turns[side])
            for n, color in enumerate(scene.images):
                shown = [scene.outlines[side].contrasts(color, pose, scene.camera).max() for pose in poses]
                places[n] = (T @ poses[int(np.argmax(shown))])[0, 3]
        self._edge = int(np.argmax(self._contrasts(self._x)))
        self._climb(lambda x, edge: float(self._contrasts(x, edge)[0]), POLISH, first)
        self._weigh()
        self._match_pattern(first)
        self._weigh()

    def try_places(self) -> list[_Place]:
        """Return where the pattern shows best, the finger stretched, slanted and shifted along itself on its side."""
        points = next(iter(self._scene.points.values()))[:, ::2]
        tip = np.array([points[:, 0].max(), points[:, 1].max()])
        tried = [
            self._try(_Place(fit=self, edge=edge, tip=tip, stretch=stretch, slant=slant, along=along))
            for stretch in STRETCHES
            for slant in SLANTS
            for along in SHIFTS * self._scene.pitch
            for edge in {self._edge, TIPWARDS}
        ]
        tried.sort(key=lambda each: each.evidence, reverse=True)
        chosen: list[_Place] = []  # of places that are near each other the best one is enough
        for each in tried:
            if len(chosen) < PLACES and not any(each.is_near(other, self._scene.pitch) for other in chosen):
                chosen.append(each)
        return chosen

    def _try(self, place: _Place) -> _Place:
        """Return a place with what the pattern tells there."""
        scene, poses, moments = self._scene, self._poses(self._x), []
        for side in poses:
            pattern = scene.patterns[side]
            for color, pose in list(zip(scene.images, poses[side], strict=True))[:COMPARED]:
                each = [
                    pattern.compare(color, pose, scene.camera, place.edge, lambda p, x=x: place.warp(p, x))
                    for x in ASIDES
                ]
                moments.append(max(each, key=lambda one: correlate([one])))
        samples = len(next(iter(scene.patterns.values())).opens[place.edge].places)
        return replace(place, evidence=weigh_evidence(moments, samples))

    def settle(self, place: _Place) -> _Fit:
        """Return the fit of camera and jaws to a place, and from there to the pattern."""
        fit, scene, poses = self._at(self._x, place.edge), self._scene, self._poses(self._x)
        fit._seen, fit._likelihood = {}, {}
        for side in poses:
            points = scene.points[side][:, ::2]
            moved = place.warp(points)
            fit._seen[side] = np.array(
                [project_plane(moved, scene.planes[side], pose, scene.camera) for pose in poses[side]]
            )
            fit._likelihood[side] = np.isfinite(fit._seen[side]).all(axis=2) * (points[:, 1] > points[:, 1].mean())
        fit._x = least_squares(fit._misses, fit._x, x_scale=fit._scale).x
        fit.polish_pattern()
        return fit

    def shift_by_ribs(self) -> list[_Fit]:
        """Return the fits to the pattern that begin one and two ribs from here."""
        shifts = self._scene.pitch * np.array([-2.0, -1.0, 1.0, 2.0])
        return [self.settle(_Place(fit=self, edge=self._edge, along=shift)) for shift in shifts]

    def is_elsewhere(self, other: _Fit) -> bool:
        """Say whether the key points of another fit lie further off than half the way to the next rib, in the mean."""
        own, others = self._poses(self._x), other._poses(other._x)
        away, step = [], []
        for side, plane in self._scene.planes.items():
            places = self._scene.points[side][:-1, ::2]
            places = places[places[:, 1] > np.median(places[:, 1])]
            for pose, another in zip(own[side], others[side], strict=True):
                here, next_rib, there = (
                    project_plane(places + (0.0, far), plane, T, self._scene.camera)
                    for T, far in ((pose, 0.0), (pose, self._scene.pitch), (another, 0.0))
                )
                away.append(np.linalg.norm(there - here, axis=1))
                step.append(np.linalg.norm(next_rib - here, axis=1))
        return bool(np.nanmean(away) > 0.5 * np.nanmean(step))

    def _look(self) -> None:
        """Find the points of every jaw in every picture."""
        scene = self._scene
        self._seen, self._likelihood = {}, {}
        for side, poses in self._poses(self._x).items():
            found = find_points(scene.images, scene.camera, scene.locator, side, scene.planes[side], poses)
            self._seen[side], likelihood = found
            inside = np.isfinite(self._seen[side]).all(axis=2)
            inside &= (self._seen[side] >= 0.0).all(axis=2)
            inside &= (self._seen[side] < (scene.camera.width, scene.camera.height)).all(axis=2)
            self._likelihood[side] = np.where(inside, likelihood, 0.0)

    def _known_misses(self, x: NDArray) -> NDArray:
        """Return what camera, turns and sizes are off what is known of them beforehand, in standard deviations."""
        _, turns, origins = self._split(x)
        parts = [x[:6] / self._stddev, np.concatenate([*turns.values()]) / TURN_STDDEV]
        if len(origins) == len(SIDES):
            parts.append(np.array([sum(origins.values()).mean() / 2.0 / MIDDLE_STDDEV]))
        return np.concatenate((*parts, self._scene.known.misses(origins, self._poses(x), self._scene)))

    def _misses(self, x: NDArray) -> NDArray:
        """Return what is off, in standard deviations."""
        parts, poses = [self._known_misses(x)], self._poses(x)
        for side in poses:
            away = self._away(side, poses[side])
            share = np.minimum(1.0, ALIKE / np.maximum(self._likelihood[side].sum(axis=1), 1e-9))
            weight = np.sqrt(self._likelihood[side] * share[:, None])
            parts.append((away * weight[:, :, None] / PIXEL).ravel())
        return np.concatenate(parts)

    def _away(self, side: str, poses: Sequence[NDArray]) -> NDArray:
        """Return by how many columns and rows the points seen are off their places (n, K + 1, 2) [px]."""
        away = []
        for pose, seen in zip(poses, self._seen[side], strict=True):
            away.append(seen - project(self._scene.points[side] @ pose[:3, :3].T + pose[:3, 3], self._scene.camera))
        return np.nan_to_num(np.array(away))

    def improve(self) -> None:
        """Find the points, and with them camera, turns and origins; where the ribs show less, nothing moves."""
        moved = self._at(self._x, self._edge)
        moved._follow_points()
        moved._weigh()
        if moved.evidence > self.evidence:
            self._x, self._edge = moved._x, moved._edge
            self.correlation, self.evidence = moved.correlation, moved.evidence

    def follow_network(self) -> _Fit:
        """Return the fit to the points that the network finds from here, and to the pattern from there."""
        fit = self._at(self._x, self._edge)
        best = fit
        for _ in range(ROUNDS):
            fit = fit._at(fit._x, fit._edge)
            fit._follow_points()
            fit._weigh()
            best = max(best, fit, key=lambda each: each.evidence)
        return best

    def _follow_points(self) -> None:
        """Find the points, and with them camera, turns and origins."""
        self._look()
        self._x = least_squares(self._misses, self._x, x_scale=self._scale, loss="soft_l1").x

    def describe(self) -> CameraPlacement:
        """Return what was found, and which points are never seen.

        Raises:
            GeometryError: the pattern does not show, or too few points are seen.
        """
        self._look()
        scene, poses = self._scene, self._poses(self._x)
        T, turns, origins = self._split(self._x)
        first = next(iter(scene.jaws))
        places, names = scene.points[first][:, ::2], (*scene.jaws[first].keypoint_names, REFERENCE)
        usual = np.array([np.median(each, axis=0) for each in self._likelihood.values()]).mean(axis=0)
        # a typical point is one that neither the edge of a holder nor that of the image covers
        _, across, edge = scene.edges[self._edge]
        there = usual[(places @ across > edge) & (usual > 0.0)]
        typical = float(np.clip(np.median(there), 1e-6, TYPICAL)) if there.size else 1e-6
        mount = JawMount(odds=float(np.clip(TYPICAL / (1.0 - TYPICAL) * (1.0 - typical) / typical, 1.0, MOST_ODDS)))
        visible = ~find_covered(mount.believe(usual), places)
        sure = {side: visible & (mount.believe(each) >= 0.5) for side, each in self._likelihood.items()}
        away = np.concatenate([self._away(side, poses[side])[sure[side]] for side in poses])
        residual = float(np.sqrt((away**2).sum() / max(len(away), 1)))
        count, most = int(visible[:-1].sum()), MOST_LEFT * typical
        if count < LEAST_SEEN or typical < LEAST_TYPICAL or self.correlation < LEAST_SHOWN or residual > most:
            raise GeometryError(
                f"the images do not show the finger '{scene.jaws[first].name}': make the jaw file of another one with "
                "finforce jaw PHOTO or STL; else check --lens, that the image is not mirrored and that open jaws are "
                "in view, or give --extrinsics where jaws look like their background "
                f"(ribs {self.correlation:.2f} of {LEAST_SHOWN:g}, {count} of {LEAST_SEEN} key points, likelihood "
                f"{typical:.2f} of {LEAST_TYPICAL:g}, {residual:.1f} px off of {most:.1f})"
            )
        covered = frozenset(np.array(names)[~visible].tolist())
        return CameraPlacement(
            T_gripper_camera=T,
            mounts={side: replace(mount, turn=turns[side], covered=covered) for side in poses},
            origins=origins,
            correlation=self.correlation,
            residual=residual,
            seen={side: np.where(sure[side][:, :, None], seen, np.nan) for side, seen in self._seen.items()},
        )
