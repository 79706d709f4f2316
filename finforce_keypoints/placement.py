"""Pose of a camera and mounting of jaws, from a few pictures of open, unloaded jaws and no guess.

A network that is shown the wrong place finds a finger there, too. What a picture shows of the finger's outline does not
depend on it: by how much colours tell the inside of the drawn outline from what surrounds it. The outlines of many
random cameras say which of them are worth a look; the network's key points and the pattern of the ribs pull each of
these to the jaws of one picture, and where the points are likeliest all pictures are taken: they say how each jaw is
turned, where it stands in each picture, and which of its points are never seen. Neither outline nor points tell one rib
from the next: the pattern of the ribs moves what was found along the fingers, and of all places the one is taken that
this pattern and the tips make likeliest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import SIDES, jaw_in_camera, look_at
from finforce.optional import import_cv2
from finforce.transforms import move_pose
from finforce_keypoints.detectors.side_plane import AnyFinger
from finforce_keypoints.errors import GeometryError
from finforce_keypoints.geometry.rib_pattern import RibPattern
from finforce_keypoints.geometry.side_picture import (
    PlaneGrid,
    SidePlane,
    find_side,
    map_picture,
    project_plane,
    take_picture,
)
from finforce_keypoints.geometry.template import find_shape, fit_grid
from finforce_keypoints.parameters import REFERENCE, JawMount
from finforce_keypoints.rib_check import (
    HERE,
    INDEPENDENT,
    RibComparison,
    compare_ribs,
    describe_ribs,
    find_places,
)

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

COARSER, FINER = 4, 2  # times as large as those of the network's pictures are the pixels of outlines, first and last
AROUND = 0.1  # of the finger's length: what surrounds the outline
UNHELD = 0.35  # of the finger's length: what is below is likely to be covered by a holder
DARK = 30.0  # of 255: what is added to the brightness by which colours are divided
# Directions of a holder's edge, shares of the finger beyond it, and what a share of it costs in contrast.
EDGES, HELD, HELD_COST = 12, (0.15, 0.3, 0.45), 0.15
BEYOND = 0.3  # share of the compared pixels outside the image, from which on nothing is said
WHOLE = 0  # the edge beyond which there is nothing
# Where wrist cameras are, in the gripper: y, z [m], tilt down [rad], half opening of the jaws [m].
LOW, HIGH = np.array([0.04, -0.15, -0.2, 0.015]), np.array([0.18, 0.05, 0.9, 0.08])
STARTS, PULLED, KEPT = 3000, 16, 3  # places that are tried; pulled to the jaws of one picture; and to those of all
POLISH = 15  # steps in which outlines move a guess
# Least contrast of outlines that are there, in the mean: a grey finger before a textured ground shows with 0.44.
LEAST_CONTRAST = 0.3
ALIKE = 8.0  # independent points that all the points of a jaw in a picture are worth: what they err by is shared
PIXEL = 1.0  # [px] standard deviation of one of those
# How far outlines may be off the camera's place: three in m, three in rad; and how far jaws are mounted askew [rad].
OUTLINE_STDDEV = np.array([0.015, 0.015, 0.015, 0.06, 0.06, 0.06])
GUESS_STDDEV = np.repeat((0.005, np.radians(2.0)), 3)  # the same of a guess of which nothing is said
TURN_STDDEV = 0.05
# Standard deviations of height [m] and scale [-] by what a network errs by in every picture of a finger: rendered ones.
FINGER_STDDEV = np.array([0.6e-3, 5e-3])
MIDDLE_STDDEV = 1e-3  # [m] of the middle between the jaws, which says where the gripper's middle is
CUTS = 48  # directions in which a holder may cover a jaw up to a straight edge
HALF_OPENING = 0.045  # [m] guess of half the distance of the jaws' origins
HIDDEN = 0.1  # likelihood of a point that is never seen, wherever it lies
LEAST_SEEN = 8  # key points of a jaw
# Likelihood that a rig makes of that of a typical point: a network is less sure of small and of unusual fingers.
TYPICAL, LEAST_TYPICAL, MOST_ODDS = 0.75, 0.15, 17.0
# [px] Typical distance of points seen from their places, over their likelihood: 0.9 to 2.6 of real fingers in holders,
# 3.1 and more of other fingers, of these one rib off, and of pictures without any.
MOST_LEFT = 2.8
RMS_OF_MEDIAN = 1.2  # root mean square over median of the length of normal errors in a plane: 1 / sqrt(ln 2)
RIB_ROUNDS, RIB_ROUNDS_PULLED = 4, 2  # of laying the jaws on their ribs, in all pictures and in one
# Key points are found with the place found before, in rounds until nothing changes by more than a share of its scale.
# As long as ribs speak against the place found, jaws are laid on ribs that are so far off before [pitches].
FARTHEST = (None, np.inf, HERE)
MOST_ROUNDS, ROUNDS_PULLED, SETTLED = 12, 3, 0.05
# How far aside a jaw is looked for [m], and by how much likelier its points have to be there.
ASIDE, LIKELIER = 4e-3 * np.arange(-6.0, 7.0), 0.1
OUTER_WEIGHT = 0.25  # of points off the face: how ribs slant differs more between fingers than where they meet the face


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraPlacement:
    """Pose of a camera, and the jaws before it.

    Attributes:
        T_gripper_camera: (4, 4).
        mounts: side -> turn, covered points, and how sure its place is.
        origins: side -> place of the jaw's origin on the closing axis in each picture (n,) [m].
        contrast: of the outlines, 0 to 1.
        residual: typical distance of the points seen from where they should be [px].
        strain: sum of squares of what camera and mounts are off their expected places [standard deviations].
        seen: side -> pixels of the points in each picture (n, K + 1, 2), NaN where one was not seen.
        ribs: side -> where the ribs may be.
    """

    T_gripper_camera: NDArray
    mounts: Mapping[str, JawMount]
    origins: Mapping[str, NDArray]
    contrast: float
    residual: float
    seen: Mapping[str, NDArray]
    strain: float = 0.0
    ribs: Mapping[str, RibComparison] = field(default_factory=dict)

    def pose(self, side: str, number: int) -> NDArray:
        """Return T_camera_jaw (4, 4) in a picture."""
        return jaw_in_camera(self.T_gripper_camera, side, self.origins[side][number], self.mounts[side].turn)

    @property
    def evidence(self) -> float:
        """Evidence of ribs and tips for this place, see `RibPlace`, less that against its camera and mounts."""
        count = len(next(iter(self.origins.values())))
        shown = float(np.mean([each.here.evidence for each in self.ribs.values()]))
        return shown - self.strain / (INDEPENDENT * count)


class OutlineContrast:
    """The contrast of the outline of a jaw with its surroundings.

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
        for angle in np.linspace(0.0, 2.0 * np.pi, EDGES, endpoint=False):
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
        x: y, z [m], tilt down [rad] (3,).
        right: direction of the image's rows along the gripper's x, 1 or -1.
    """
    y, z, tilt = x
    return look_at((0.0, y, z), (0.0, y - np.sin(tilt), z + np.cos(tilt)), (right, 0.0, 0.0))


def search_camera(
    image: NDArray, camera: CameraIntrinsics, jaws: Mapping[str, Jaw], progress: Callable[[int], Any]
) -> list[tuple[NDArray, float]]:
    """Return the T_gripper_camera (4, 4) and half openings of the jaws [m] with which outlines show best.

    Args:
        image: (h, w, 3) uint8 RGB.
        camera: intrinsics.
        jaws: by side.
        progress: called with the number of places tried since its last call.
    """
    outlines = {side: OutlineContrast(jaw) for side, jaw in jaws.items()}
    rng, tried, contrasts = np.random.default_rng(0), [], []
    for number in range(STARTS):
        x = rng.uniform(LOW, HIGH)
        T = place_camera(x[:3], -1.0 if number % 2 else 1.0)
        poses = {side: jaw_in_camera(T, side, _origin(side, x[3])) for side in jaws}
        shown = [outlines[side].contrasts(image, pose, camera) for side, pose in poses.items()]
        tried.append((T, float(x[3])))
        contrasts.append(np.mean(shown, axis=0))
        progress(1)
    # a holder that is not there explains much where something else stands
    whole, held = (
        np.argsort(-each, kind="stable") for each in (np.array(contrasts)[:, WHOLE], np.max(contrasts, axis=1))
    )
    return [tried[n] for n in dict.fromkeys([*whole[: PULLED // 2], *held[:PULLED]])][:PULLED]


def _origin(side: str, half: float) -> float:
    return -half if side == "left" else half


def count_steps(images: int, is_guessed: bool) -> int:
    """Return how many steps `find_placement` takes at most in so many images."""
    return len(FARTHEST) * images if is_guessed else 2 * STARTS + KEPT * len(FARTHEST) * images


def find_placement(
    task: PlacementTask,
    guess: NDArray | None = None,
    guess_stddev: NDArray = GUESS_STDDEV,
    progress: Callable[[int], Any] = lambda steps: None,
) -> CameraPlacement:
    """Return where the camera is and how the jaws are mounted.

    Args:
        task: jaws, and pictures of them.
        guess: T_gripper_camera (4, 4); None: it is searched for.
        guess_stddev: its standard deviations, three in m and three in rad (6,).
        progress: called with the number of steps done since its last call.

    Raises:
        GeometryError: there are no such jaws in the pictures.
    """
    if guess is None:
        fits = _pull_starts(task, progress)
    else:
        fits = [_Refinement(task, guess, task.half_opening or HALF_OPENING, guess_stddev)]
        fits[0].polish()
    found = _try_fits(fits, task, progress)
    best = max(found, key=lambda each: each.evidence)
    stddev = {side: _widen_stddev(best, found, side, jaw) for side, jaw in task.jaws.items()}
    return replace(best, mounts={side: replace(mount, stddev=stddev[side]) for side, mount in best.mounts.items()})


def _pull_starts(task: PlacementTask, progress: Callable[[int], Any]) -> list[_Refinement]:
    """Return the likeliest of the places to which the first picture pulls random ones, in all pictures."""
    one, pulled = replace(task, images=task.images[:1], opening=None), []
    for T, half in search_camera(task.images[0], task.camera, task.jaws, progress):
        fit = _Refinement(one, T, half, OUTLINE_STDDEV)
        likely, shows = fit.pull(), True
        try:
            place = _add_ribs(fit.describe(), one)
            likely += 0.5 * INDEPENDENT * np.mean([each.here.evidence for each in place.ribs.values()])
        except GeometryError:
            shows = False
        pulled.append((shows, likely, fit))
        progress(STARTS // PULLED)
    pulled.sort(key=lambda each: each[:2], reverse=True)
    return [fit.widen(task) for *_, fit in pulled[:KEPT]]


def _try_fits(
    fits: Sequence[_Refinement], task: PlacementTask, progress: Callable[[int], Any]
) -> list[CameraPlacement]:
    """Return the places to which fits lead; on ribs farther off only while ribs speak against the best.

    Raises:
        GeometryError: there is none.
    """
    found: list[CameraPlacement] = []
    failures: dict[float, GeometryError] = {}
    for farthest in FARTHEST:
        for fit in fits:
            first = fit.look_aside if farthest is None else partial(fit.follow_ribs, farthest)
            for step in (first, fit.settle):
                step()
                try:
                    place = _add_ribs(fit.describe(), task)
                except GeometryError as error:
                    failures[fit.likeliest] = error
                else:
                    found.append(place)
                    fit.keep(place.evidence)
            fit.go_back()
            progress(len(task.images))
        if found and not describe_ribs(max(found, key=lambda each: each.evidence).ribs):
            break
    if not found:
        raise failures[max(failures)]
    return found


def compare_poses(jaw: Jaw, T: NDArray, other: NDArray) -> NDArray:
    """Return what another T_camera_jaw (4, 4) makes of a jaw's inner face half way up (2,).

    It is higher by so much [m], and by so much larger appears what moves along the closing axis [-].
    """
    places = np.array([jaw.inner_face_x, 0.0, 0.5 * jaw.keypoints[:, 2].max()]) + [[0.0] * 3, [1e-4, 0.0, 0.0]]
    seen = [places @ each[:3, :3].T + each[:3, 3] for each in (T, other)]
    height = ((seen[1][0] - T[:3, 3]) @ T[:3, :3] - places[0])[2]
    one, two = (np.linalg.norm(np.diff(each[:, :2] / each[:, 2:], axis=0)) for each in seen)
    return np.array([height, two / one - 1.0])


def _widen_stddev(best: CameraPlacement, found: Sequence[CameraPlacement], side: str, jaw: Jaw) -> tuple[float, ...]:
    """Return a jaw's standard deviations (2,) with the spread of the places that explain the pictures nearly as well.

    Those found from other starts, each as likely as its ribs and tips, and the likeliest one of other ribs; with what a
    network errs by in every picture.
    """
    independent = 0.5 * INDEPENDENT * len(best.origins[side])
    weights = np.exp(independent * np.array([each.evidence - best.evidence for each in found]))
    away = np.array([compare_poses(jaw, best.pose(side, 0), each.pose(side, 0)) for each in found])
    variance = FINGER_STDDEV**2 + np.square(best.mounts[side].stddev) + weights @ away**2 / weights.sum()
    rival = best.ribs[side]
    variance[0] += rival.other.shift**2 / (1.0 + np.exp(independent * rival.margin))
    return tuple(np.sqrt(variance).tolist())


def _add_ribs(found: CameraPlacement, task: PlacementTask) -> CameraPlacement:
    """Return a placement with where its ribs may be."""
    poses = {side: [found.pose(side, number) for number in range(len(task.images))] for side in task.jaws}
    return replace(found, ribs=compare_ribs(task.patterns, task.images, poses, task.camera))


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


class _Setup(NamedTuple):
    """T_gripper_camera (4, 4); by side turn (3,) [rad] and origin in each picture (n,) [m]."""

    T: NDArray
    turns: dict[str, NDArray]
    origins: dict[str, NDArray]


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacementTask:
    """Jaws and the pictures in which they are looked for.

    Attributes:
        images: (h, w, 3) uint8 RGB, of open and unloaded jaws that may stand elsewhere in each.
        camera: intrinsics.
        jaws: by side.
        locator: finds the points in pictures of their sides.
        opening: gap between the inner faces of both jaws where they are widest open [m]; None: not known.
    """

    images: Sequence[NDArray]
    camera: CameraIntrinsics
    jaws: Mapping[str, Jaw]
    locator: AnyFinger
    opening: float | None = None

    @property
    def half_opening(self) -> float | None:
        """Half the distance of the jaws' origins where they are widest open [m]; None: not known."""
        return None if self.opening is None else 0.5 * self.opening + next(iter(self.jaws.values())).inner_face_x

    @cached_property
    def points(self) -> dict[str, NDArray]:
        """Key points and reference point of each jaw (K + 1, 3) [m]."""
        return {side: np.vstack((jaw.keypoints, jaw.reference_point)) for side, jaw in self.jaws.items()}

    @cached_property
    def planes(self) -> dict[str, SidePlane]:
        """Side of each jaw."""
        return {side: find_side(jaw) for side, jaw in self.jaws.items()}

    @cached_property
    def outlines(self) -> dict[str, OutlineContrast]:
        """Outline of each jaw."""
        return {side: OutlineContrast(jaw, FINER) for side, jaw in self.jaws.items()}

    @cached_property
    def patterns(self) -> dict[str, RibPattern]:
        """Ribs of each jaw."""
        return {side: RibPattern(jaw) for side, jaw in self.jaws.items()}


class _Refinement:
    """Camera, turns and origins by least squares over the pixels that a network finds, again and again."""

    def __init__(self, task: PlacementTask, T: NDArray, half: float, stddev: NDArray) -> None:
        """Begin with T_gripper_camera (4, 4) of standard deviations (6,), and half an opening [m]."""
        self._task, self._start, self._stddev = task, T, stddev
        count, sides = len(task.images), len(task.jaws)
        origins = [np.full(count, _origin(side, half)) for side in task.jaws]
        # step of the camera, turns of the jaws, origins by jaw and picture
        self._x = np.concatenate((np.zeros(6 + 3 * sides), *origins))
        self._scale = np.full(len(self._x), 5e-3)  # [m]
        self._scale[3 : 6 + 3 * sides] = 0.03  # [rad]
        self._best = (-1.0, self._x)
        self._kept = (-np.inf, self._x)

    def widen(self, task: PlacementTask) -> _Refinement:
        """Return the same for other pictures, in which jaws stand as in the first of these."""
        T, turns, origins = self._split(self._x)
        wider = _Refinement(task, T, 0.0, self._stddev)
        places = [np.full(len(task.images), each[0]) for each in origins.values()]
        wider._x = np.concatenate((np.zeros(6), *turns.values(), *places))
        wider._best = wider._kept = (-np.inf, wider._x)
        return wider

    def _split(self, x: NDArray) -> _Setup:
        """Return what the unknowns say of camera and jaws."""
        sides, count = len(self._task.jaws), len(self._task.images)
        turns = dict(zip(self._task.jaws, x[6 : 6 + 3 * sides].reshape(sides, 3), strict=True))
        origins = dict(zip(self._task.jaws, x[6 + 3 * sides :].reshape(sides, count), strict=True))
        half = self._task.half_opening
        if half is not None and len(origins) == len(SIDES):
            wider = 0.5 * np.max(origins["right"] - origins["left"]) - half
            origins = {"left": origins["left"] + wider, "right": origins["right"] - wider}
        return _Setup(move_pose(self._start, x[:6]), turns, origins)

    def contrast(self, x: NDArray | None = None, edge: int | None = None) -> float:
        """Return the mean contrast of the outlines."""
        T, turns, origins = self._split(self._x if x is None else x)
        each = np.mean(
            [
                outline.contrasts(color, jaw_in_camera(T, side, place, turns[side]), self._task.camera, edge)
                for side, outline in self._task.outlines.items()
                for color, place in zip(self._task.images, origins[side], strict=True)
            ],
            axis=0,
        )
        if edge is None:
            self._edge = int(np.argmax(each))
        return float(each.max())

    def polish(self) -> None:
        """Move camera and jaws until outlines show best."""
        known = np.concatenate((self._stddev, np.full(3 * len(self._task.jaws), TURN_STDDEV)))

        def judge(x: NDArray) -> float:
            away = x[: len(known)] * self._scale[: len(known)] / known
            return 0.01 * float(away @ away) - self.contrast(x * self._scale, WHOLE)

        fit = minimize(judge, self._x / self._scale, method="L-BFGS-B", options={"maxiter": POLISH, "eps": 0.02})
        self._x = fit.x * self._scale

    def pull(self) -> float:
        """Move camera and jaws to the points and ribs near by; return the logarithm of how likely these are."""
        self.look_aside()
        self.settle(ROUNDS_PULLED)
        self.keep(self._weigh())
        self.follow_ribs(np.inf, RIB_ROUNDS_PULLED)
        self.settle(ROUNDS_PULLED)
        self.keep(self._weigh())
        self.go_back()
        return self._kept[0]

    def _weigh(self) -> float:
        """Return the logarithm of how likely points, camera and mounts are."""
        points = sum(np.log(max(each.mean(), 1e-9)) for each in self._likelihood.values())
        return float(ALIKE * len(self._task.images) * points - 0.5 * self._strain())

    def _look(self) -> None:
        """Find the points of every jaw in every picture."""
        self._seen, self._likelihood = {}, {}
        for side in self._task.jaws:
            self._seen[side], self._likelihood[side] = self._find(side)

    def _find(self, side: str, aside: float = 0.0) -> tuple[NDArray, NDArray]:
        """Return pixels and likelihoods of a jaw's points, see `find_points`, looked for so far aside [m]."""
        T, turns, origins = self._split(self._x)
        poses = [jaw_in_camera(T, side, x + aside, turns[side]) for x in origins[side]]
        task = self._task
        seen, likelihood = find_points(task.images, task.camera, task.locator, side, task.planes[side], poses)
        inside = np.isfinite(seen).all(axis=2)
        inside &= (seen >= 0.0).all(axis=2)
        inside &= (seen < (task.camera.width, task.camera.height)).all(axis=2)
        return seen, np.where(inside, likelihood, 0.0)

    def look_aside(self) -> None:
        """Move jaws along the closing axis to where in a picture their points are much likelier."""
        moved = self._x[6 + 3 * len(self._task.jaws) :].reshape(len(self._task.jaws), -1)
        for origins, side in zip(moved, self._task.jaws, strict=True):
            likelihood = np.array([self._find(side, aside)[1].mean(axis=1) for aside in ASIDE])
            is_likelier = likelihood.max(axis=0) > likelihood[len(ASIDE) // 2] + LIKELIER
            origins += np.where(is_likelier, ASIDE[likelihood.argmax(axis=0)], 0.0)

    def _misses(self, x: NDArray) -> NDArray:
        """Return what is off, in standard deviations."""
        T, turns, origins = self._split(x)
        parts = self._strains(x[:6], turns)
        for side in self._task.jaws:
            away = self._away(side, T, turns[side], origins[side])
            share = np.minimum(1.0, ALIKE / np.maximum(self._likelihood[side].sum(axis=1), 1e-9))
            weight = np.sqrt(self._likelihood[side] * share[:, None])
            # soft L1: a point that is far off counts less; priors of camera and mounts hold in full
            off = (away * weight[:, :, None] / PIXEL).ravel()
            parts.append(np.sign(off) * np.sqrt(2.0 * (np.sqrt(1.0 + off**2) - 1.0)))
        if len(origins) == len(SIDES):
            parts.append([np.mean(sum(origins.values())) / 2.0 / MIDDLE_STDDEV])
        return np.concatenate(parts)

    def _strains(self, step: NDArray, turns: Mapping[str, NDArray]) -> list[NDArray]:
        """Return a camera's step (6,) and the turns of jaws, in standard deviations."""
        return [step / self._stddev, np.concatenate([*turns.values()]) / TURN_STDDEV]

    def _strain(self) -> float:
        """Return the sum of squares of `_strains` where camera and jaws are now."""
        return float(np.square(np.concatenate(self._strains(self._x[:6], self._split(self._x).turns))).sum())

    def _away(self, side: str, T: NDArray, turn: NDArray, origins: NDArray) -> NDArray:
        """Return by how many columns and rows the points seen are off their places (n, K + 1, 2) [px]."""
        away = []
        for x, seen in zip(origins, self._seen[side], strict=True):
            pose = jaw_in_camera(T, side, x, turn)
            away.append(seen - project(self._task.points[side] @ pose[:3, :3].T + pose[:3, 3], self._task.camera))
        return np.nan_to_num(np.array(away))

    def settle(self, rounds: int = MOST_ROUNDS) -> None:
        """Find the points, and with them camera, turns and origins, until these hardly change."""
        for _ in range(rounds):
            before = self._x
            self.improve()
            if np.abs((self._x - before) / self._scale).max() < SETTLED:
                return

    def improve(self) -> None:
        """Find the points, and with them camera, turns and origins."""
        self._look()
        self._keep_best()
        self._x = least_squares(self._misses, self._x, x_scale=self._scale).x

    def follow_ribs(self, farthest: float, rounds: int = RIB_ROUNDS) -> None:
        """Move camera, turns and origins to where ribs and tips are likeliest, so far off at most [pitches]."""
        for _ in range(rounds):
            T, turns, origins = self._split(self._x)
            poses = {side: [jaw_in_camera(T, side, x, turns[side]) for x in origins[side]] for side in self._task.jaws}
            found = find_places(self._task.patterns, self._task.images, poses, self._task.camera)
            self._seen, self._likelihood = {}, {}
            for side, jaw in self._task.jaws.items():
                places = found[side]
                near = [each for each in places if each.distance < farthest] or places
                if not near:
                    return
                warps, plane = max(near, key=lambda each: each.evidence).warps, self._task.planes[side]
                points = self._task.points[side][:, ::2]
                self._seen[side] = np.array(
                    [
                        project_plane(points @ warp[:, :2].T + warp[:, 2], plane, pose, self._task.camera)
                        for warp, pose in zip(warps, poses[side], strict=True)
                    ]
                )
                on_face = np.array([name.startswith("inner") for name in (*jaw.keypoint_names, REFERENCE)])
                weight = np.where(on_face, 1.0, OUTER_WEIGHT) * np.isfinite(self._seen[side]).all(axis=2)
                self._likelihood[side] = weight
            self._x = least_squares(self._misses, self._x, x_scale=self._scale).x
        self._best = (-1.0, self._x)

    def keep(self, evidence: float) -> None:
        """Keep what was found for its evidence, unless something better was kept before."""
        self._kept = max(self._kept, (evidence, self._x), key=lambda each: each[0])

    def go_back(self) -> None:
        """Go back to what was kept, if anything was."""
        if self._kept[0] > -np.inf:
            self._x = self._kept[1]
            self._best = (-1.0, self._x)

    @property
    def likeliest(self) -> float:
        """The mean of the points' largest likelihoods."""
        return self._best[0]

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
        first = next(iter(self._task.jaws))
        usual = np.array([np.median(each, axis=0) for each in self._likelihood.values()]).mean(axis=0)
        # a typical point is one that neither the edge of a holder nor that of the image covers
        _, across, edge = next(iter(self._task.outlines.values())).edges[self._edge]
        there = usual[(self._task.points[first][:, ::2] @ across > edge) & (usual > 0.0)]
        typical = float(np.clip(np.median(there), 1e-6, TYPICAL)) if there.size else 1e-6
        mount = JawMount(odds=float(np.clip(TYPICAL / (1.0 - TYPICAL) * (1.0 - typical) / typical, 1.0, MOST_ODDS)))
        visible = ~find_covered(mount.believe(usual), self._task.points[first][:, ::2])
        sure = {s: visible & (mount.believe(each) >= 0.5) for s, each in self._likelihood.items()}
        away = np.concatenate([self._away(s, T, turns[s], origins[s])[sure[s]] for s in self._task.jaws])
        # root mean square of normal errors with the median of these: a few points that are far off do not count
        residual = float(RMS_OF_MEDIAN * np.median(np.linalg.norm(away, axis=1))) if len(away) else 0.0
        count, most = int(visible[:-1].sum()), MOST_LEFT * typical
        if count < LEAST_SEEN or typical < LEAST_TYPICAL or contrast < LEAST_CONTRAST or residual > most:
            raise GeometryError(
                f"the images do not show the finger '{self._task.jaws[first].name}': make the jaw file of another one "
                "with finforce jaw PHOTO or STL; else check --lens, that the image is not mirrored and that jaws are "
                "in view, open and unloaded in all images (--images), or give --extrinsics where jaws look like their "
                f"background (contrast {contrast:.2f} of {LEAST_CONTRAST:g}, {count} of {LEAST_SEEN} key points, "
                f"likelihood {typical:.2f} of {LEAST_TYPICAL:g}, {residual:.1f} px off of {most:.1f})"
            )
        names = np.array([*self._task.jaws[first].keypoint_names, REFERENCE])
        covered = frozenset(names[~visible].tolist())
        return CameraPlacement(
            T_gripper_camera=T,
            mounts={
                side: replace(mount, turn=turns[side], covered=covered, stddev=stddev)
                for side, stddev in self._find_stddev().items()
            },
            origins=origins,
            contrast=contrast,
            residual=residual,
            strain=self._strain(),
            seen={side: np.where(sure[side][:, :, None], seen, np.nan) for side, seen in self._seen.items()},
        )

    def _find_stddev(self) -> dict[str, tuple[float, ...]]:
        """Return by side the standard deviations of height and scale that the points' errors make."""
        fit = least_squares(self._misses, self._x, x_scale=self._scale, max_nfev=1)
        _, sizes, directions = np.linalg.svd(fit.jac, full_matrices=False)
        told = sizes > 1e-9 * sizes[0]
        # one standard deviation in each of the independent directions
        steps, stddev = directions[told] / sizes[told, None], {}
        for side, jaw in self._task.jaws.items():
            T = self._pose(side, self._x)
            away = [compare_poses(jaw, T, self._pose(side, self._x + step)) for step in steps]
            stddev[side] = tuple(np.sqrt(np.square(away).sum(axis=0)).tolist())
        return stddev

    def _pose(self, side: str, x: NDArray) -> NDArray:
        """Return T_camera_jaw (4, 4) in the first picture."""
        T, turns, origins = self._split(x)
        return jaw_in_camera(T, side, origins[side][0], turns[side])
