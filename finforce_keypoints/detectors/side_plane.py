"""Key points from square pictures of the jaws' sides, all jaws in one pass of a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.gripper_frames import LOOKS_AWAY, OpeningRange, angle_off_jaws, jaw_in_camera, suggest_camera
from finforce.transforms import pose_numbers
from finforce_keypoints.errors import GeometryError, ModelError
from finforce_keypoints.geometry.jaw_pose import COVERED_STDDEV, SLIP
from finforce_keypoints.geometry.side_picture import PlaneGrid, find_side, map_picture, project_plane, take_picture
from finforce_keypoints.geometry.template import draw_template, find_motions, find_shape, fit_grid, span_shapes
from finforce_keypoints.images import PixelDetection
from finforce_keypoints.networks.side_network import Places
from finforce_keypoints.parameters import REFERENCE, JawMount

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw
    from finforce_keypoints.images import RgbdImage
    from finforce_keypoints.networks.model import KeypointModel
    from finforce_keypoints.networks.side_network import SideNetwork, Template

SAME_PLACE = 1e-3  # [m] by which a jaw may move before its picture is mapped anew; places are exact all the same
SEARCH_STEP = 24.0  # [px] between the places where a lost jaw is looked for; the network finds one half as far away
HELD_FINER = 4  # times as close together are those of a jaw in a holder, which may be bent where it is found
LEAST_SCORE = 0.35  # mean likelihood of a jaw's points that are not covered, below which it is not there
LIKELY_SCORE = 0.6  # the same, below which a jaw in a holder is looked for beside its place, too
# The same for one of two jaws in holders that was lost and whose mate is at no like opening: among many places one
# looks like the few points that a holder leaves, but hardly two at the same opening.
LONE_SCORE = 0.8
UNLIKE = np.sqrt(2.0) * COVERED_STDDEV  # [m] standard deviation of what the openings of two such jaws differ by
STRAIGHT = np.zeros((1, 2))  # pictures of a locator's own grid alone
# [px] between the pictures of a jaw in a holder: a network is surer of a bent finger in one of them than in the next.
AROUND = 6.0 * np.array([(x, z) for x in (0, -1, 1) for z in (0, -1, 1)])


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """One picture to be looked at: its jaw, where that is taken to be, its grid, and the map that makes the picture.

    `shift` (2,) [px] is that of the grid from the locator's own.
    """

    side: str
    T_camera_jaw: NDArray
    grid: PlaneGrid
    shift: NDArray
    mapping: NDArray


class SidePlaneDetector:
    """Finds key points with a network, in pictures that look the same from every camera.

    A jaw that was lost is looked for along the closing axis.

    Args:
        locator: network that finds the points of these jaws in pictures of their sides.
        jaws: by side.
        T_gripper_camera: (4, 4).
        opening: where a jaw can be.
        mounts: by side; without, jaws stand straight and nothing covers them.

    Raises:
        GeometryError: the camera is where it does not see the jaws' sides.
    """

    def __init__(
        self,
        locator: AnyFinger | OneFinger,
        jaws: Mapping[str, Jaw],
        T_gripper_camera: NDArray,
        opening: OpeningRange | None = None,
        mounts: Mapping[str, JawMount] | None = None,
    ) -> None:
        self.name, self.sha256 = f"network {locator.name}", locator.sha256
        self._locator, self._T_gripper_camera, self._opening = locator, T_gripper_camera, opening or OpeningRange()
        for jaw in jaws.values():
            check_camera_side(jaw, T_gripper_camera)
        self._planes = {side: find_side(jaw) for side, jaw in jaws.items()}
        self._rest = {side: find_rest(jaw) for side, jaw in jaws.items()}
        self._mounts = mounts or {side: JawMount() for side in jaws}
        self._seen = {side: self._mounts[side].seen_points(jaw) for side, jaw in jaws.items()}
        self.reset()

    def reset(self) -> None:
        """Forget where the points were, and begin anew with the first of the shifts."""
        self._kept: dict[tuple[str, int], _View] = {}
        self._turn = 0
        self._camera: CameraIntrinsics | None = None
        self._moves: dict[str, NDArray] = {}

    def detect(self, image: RgbdImage, expected: Mapping[str, NDArray | None]) -> Mapping[str, PixelDetection]:
        """Return where the key points of each jaw are; see `PixelDetector`."""
        if image.camera is not self._camera:
            self._kept, self._camera, self._moves = {}, image.camera, {}
        self._moves = {side: moves for side, moves in self._moves.items() if expected.get(side, moves) is not None}
        self._turn = (self._turn + 1) % len(self._locator.shifts)
        views = [view for side, pose in expected.items() for view in self._views_of(side, pose)]
        if not views:
            return {}
        places = self._locate(image, views)
        scores = self._score(views, places)
        found: dict[str, PixelDetection] = {}
        again: list[_View] = []
        for side, number in self._choose(views, scores).items():
            view, is_held = views[number], self._is_held(side)
            if expected[side] is None and scores[number] >= LEAST_SCORE:
                # the jaw lay near the border of the picture it was found in
                pose = self._centre(view, places, number)
                # points of a bent finger say little of its place: it may be where it was looked for, too
                poses = [(side, pose), (side, view.T_camera_jaw), *self._mirror(side, pose, expected)]
                poses, shifts = (poses, AROUND) if is_held else (poses[:1], STRAIGHT)
                again += [self._view(jaw, each, shift) for jaw, each in poses for shift in shifts]
            elif is_held and expected[side] is not None and scores[number] < LIKELY_SCORE:
                again += [self._view(side, view.T_camera_jaw, shift) for shift in AROUND]
            elif expected[side] is not None:
                found[side] = self._describe(view, places, number, scores[number])
        if again:
            places = self._locate(image, again)
            scores = self._score(again, places)
            chosen = self._choose(again, scores)
            there = {each: pose for each, pose in expected.items() if pose is not None}
            there |= {each: again[n].T_camera_jaw for each, n in chosen.items() if scores[n] >= LEAST_SCORE}
            for side, number in chosen.items():
                is_lone = expected[side] is None and scores[number] < LONE_SCORE and self._is_alone(side, there)
                found[side] = self._describe(again[number], places, number, 0.0 if is_lone else scores[number])
                if expected[side] is not None and scores[number] < LEAST_SCORE:
                    found |= self.detect(image, {side: None})
        return found

    def _is_held(self, side: str) -> bool:
        """Say whether a holder covers the reference point of a jaw."""
        return not self._seen[side][-1]

    def _opening_of(self, pose: NDArray) -> float:
        """Return where a jaw of T_camera_jaw (4, 4) is on the closing axis [m]."""
        return float((self._T_gripper_camera @ pose)[0, 3])

    def _mirror(self, side: str, pose: NDArray, expected: Mapping[str, NDArray | None]) -> list[tuple[str, NDArray]]:
        """Return the other jaw, if it is lost, too, and its pose where it is as open as this one."""
        x, T = -self._opening_of(pose), self._T_gripper_camera
        lost = [each for each, where in expected.items() if each != side and where is None]
        return [(each, jaw_in_camera(T, each, x, self._mounts[each].turn)) for each in lost]

    def _is_alone(self, side: str, there: Mapping[str, NDArray]) -> bool:
        """Say whether the mate of a jaw in a holder is not there, or not as open, by poses (4, 4) of those that are."""
        if len(self._planes) == 1 or not self._is_held(side):
            return False
        return len(there) == 1 or abs(sum(map(self._opening_of, there.values()))) > 3.0 * UNLIKE

    def _choose(self, views: Sequence[_View], scores: Sequence[float]) -> dict[str, int]:
        """Return the number of the likeliest view of each jaw.

        Two jaws in holders open alike: the square of what they do not, in standard deviations, counts half as much as
        one likely point.
        """
        numbers = {side: [n for n, view in enumerate(views) if view.side == side] for side in self._planes}
        numbers = {side: each for side, each in numbers.items() if each}
        best = {side: max(each, key=scores.__getitem__) for side, each in numbers.items()}
        if len(best) == 2 and all(self._is_held(side) and len(numbers[side]) > 1 for side in best):
            sums = np.add.outer(*([scores[n] for n in each] for each in numbers.values()))
            where = [[self._opening_of(views[n].T_camera_jaw) for n in each] for each in numbers.values()]
            unlike = np.add.outer(*where) / UNLIKE
            count = np.mean([np.count_nonzero(self._seen[side]) for side in best])
            pair = np.unravel_index(np.argmax(sums - 0.5 * unlike**2 / count), sums.shape)
            best = {side: numbers[side][n] for side, n in zip(best, pair, strict=True)}
        return best

    def _locate(self, image: RgbdImage, views: Sequence[_View]) -> Places:
        pictures = np.stack([take_picture(image.color, view.mapping) for view in views])
        moves = [self._moves.get(view.side) for view in views]
        starts = [None if move is None else move - view.shift for move, view in zip(moves, views, strict=True)]
        places = self._locator.locate(pictures, [view.side for view in views], starts)
        pairs = zip(views, places.likelihood, strict=True)
        return replace(places, likelihood=np.stack([self._mounts[view.side].believe(each) for view, each in pairs]))

    def _score(self, views: Sequence[_View], places: Places) -> list[float]:
        """Return the mean likelihoods of the points that can be seen of the jaw of each picture.

        Ribs look alike, and a holder gives by little: a picture in which all points are one rib off is less likely. The
        square of the slip in standard deviations counts half as much as one likely point.
        """
        scores = []
        for view, likelihood, pixels in zip(views, places.likelihood, places.pixels, strict=True):
            seen, jaw = self._seen[view.side], self._T_gripper_camera @ view.T_camera_jaw
            scores.append(float(likelihood[seen].mean()))
            if not seen[-1]:
                along = (view.grid.places(pixels) - self._rest[view.side])[seen, 1] + jaw[2, 3] / jaw[2, 2]
                slip = np.nan_to_num(np.average(along, weights=likelihood[seen] + 1e-9))
                scores[-1] -= 0.5 * float(slip / SLIP) ** 2 / np.count_nonzero(seen)
        return scores

    def _views_of(self, side: str, pose: NDArray | None) -> list[_View]:
        """Return where to look for one jaw: where it is expected, or all along the closing axis."""
        if pose is None:
            step = SEARCH_STEP * self._locator.grids[side].scale / (1.0 if self._seen[side][-1] else HELD_FINER)
            turn = self._mounts[side].turn
            places = self._opening.place_jaw(self._T_gripper_camera, side, step, turn)
            return [self._view(side, place) for place in places]
        kept = self._kept.get((side, self._turn))
        if kept is None or np.abs(kept.T_camera_jaw - pose).max() > SAME_PLACE:
            kept = self._kept[side, self._turn] = self._view(side, pose, self._locator.shifts[self._turn])
        return [kept]

    def _view(self, side: str, pose: NDArray, shift: NDArray = STRAIGHT[0]) -> _View:
        grid = self._locator.grids[side].shifted(shift)
        mapping = map_picture(grid, self._planes[side], pose, self._camera)
        return _View(side=side, T_camera_jaw=pose, grid=grid, shift=shift, mapping=mapping)

    def _centre(self, view: _View, places: Places, number: int) -> NDArray:
        """Return the pose of a jaw whose reference point, or else base, was seen beside its place."""
        jaw, rest = view.T_camera_jaw.copy(), self._rest[view.side]
        moved = view.grid.places(places.pixels[number])
        sure = places.likelihood[number] >= 0.5
        weight = np.where(sure, 1.0 / (rest[:, 1] - rest[:, 1].min() + 0.01), 0.0)
        if weight.sum() > 0.0:
            shift = np.nansum(weight[:, None] * (moved - rest), axis=0) / weight.sum()
            jaw[:3, 3] += shift[0] * jaw[:3, 0]
            if not self._seen[view.side][-1]:
                jaw[:3, 3] += shift[1] * jaw[:3, 2]
        return jaw

    def _describe(self, view: _View, places: Places, number: int, score: float) -> PixelDetection:
        """Return the detection of one picture, in pixels of the image; the next one begins where its points are."""
        if places.moves is not None and score >= LEAST_SCORE:
            self._moves[view.side] = places.moves[number] + view.shift
        plane, grid, camera = self._planes[view.side], view.grid, self._camera
        on_plane = grid.places(places.pixels[number])
        pixels = project_plane(on_plane, plane, view.T_camera_jaw, camera)
        beside = [project_plane(on_plane + step, plane, view.T_camera_jaw, camera) for step in np.eye(2) * 1e-3]
        # pixels of the image per pixel of the picture, both ways
        across = [np.hypot(*(other - pixels).T) * grid.scale / 1e-3 for other in beside]
        stddev = places.stddev[number] * np.sqrt(0.5 * (across[0] ** 2 + across[1] ** 2))
        known, seen = np.isfinite(pixels).all(axis=1), self._seen[view.side]
        return PixelDetection(
            pixels=pixels,
            likelihood=np.where(known & seen & (seen[-1] or score >= LEAST_SCORE), places.likelihood[number], 0.0),
            stddev=np.where(known, stddev, np.inf),
        )


def check_camera_side(jaw: Jaw, T_gripper_camera: NDArray) -> None:
    """Refuse a camera, T_gripper_camera (4, 4), that is not beyond the side of a jaw on which its key points lie.

    One that looks away from the jaws is refused, too, where its pose is that of another frame.

    Raises:
        GeometryError: it is not; the message says what its pose is likely of, and what to give then.
    """
    y, side_y = float(T_gripper_camera[1, 3]), float(np.abs(jaw.keypoints[:, 1]).mean())
    angle, likely = angle_off_jaws(T_gripper_camera), suggest_camera(T_gripper_camera)
    if y > side_y and (angle < LOOKS_AWAY or not likely):
        return
    found = f", at y = {y:g} m, does not see the sides of the jaws, y = {side_y:g} m; expected it beyond them"
    if y > side_y:
        found = f" looks {np.degrees(angle):.0f} degrees past the jaws"
    hints = [
        f"is it {what}? then T_gripper_camera is [{', '.join(f'{number:.4f}' for number in pose_numbers(T))}]"
        for what, T in likely.items()
    ]
    raise GeometryError("; ".join((f"T_gripper_camera: the camera{found}", *hints)))


def find_rest(jaw: Jaw) -> NDArray:
    """Return x and z (K + 1, 2) [m] of a jaw's key points and its reference point at rest."""
    return np.vstack((jaw.keypoints, jaw.reference_point))[:, [0, 2]]


# Where in its picture a point lies decides by how much a network of heat maps puts it beside its place: in pictures two
# pixels apart those errors are hardly alike, so that they average out over time.
SHIFTS = 6.0 * (np.outer(np.arange(8), [0.7549, 0.5698]) % 1.0) - 3.0  # [px]


class AnyFinger:
    """The network of any finger, which is told what a finger looks like at rest.

    Attributes:
        name: of the network's folder.
        sha256: of its files.
        grids: of its pictures, by side.
        shifts: of the grids from picture to picture (n, 2) [px], over and over again.

    Args:
        network: that compares pictures with templates.
        jaws: by side.
        mounts: by side, whose covered points are not looked for; without, all are.
    """

    shifts = STRAIGHT

    def __init__(
        self, network: SideNetwork, jaws: Mapping[str, Jaw], mounts: Mapping[str, JawMount] | None = None
    ) -> None:
        self._network, self.name, self.sha256 = network, network.path.name, network.sha256
        shapes = {side: find_shape(jaw) for side, jaw in jaws.items()}
        self.grids = {side: fit_grid(shape, network.width, network.height) for side, shape in shapes.items()}
        self._templates: dict[str, Template] = {}
        for side, grid in self.grids.items():
            points = grid.pixels(find_rest(jaws[side]))
            together = span_shapes(find_motions(jaws[side]), points, grid.scale)
            seen = mounts[side].seen_points(jaws[side]) if mounts else None
            self._templates[side] = network.prepare(draw_template(shapes[side], grid), points, together, seen)

    def locate(self, pictures: NDArray, sides: Sequence[str], starts: Sequence[NDArray | None] = ()) -> Places:
        """Return where the points are: of each picture the jaw's key points, then its reference point.

        Args:
            pictures: (B, h, w, 3) uint8 RGB, on the grids of the sides.
            sides: B, the jaw that each shows.
            starts: B, how its points had moved in the picture before; None where nobody knows.
        """
        return self._network.locate(pictures, [self._templates[side] for side in sides], starts)


class OneFinger:
    """A network with a heat map for each point of one finger; with the attributes of `AnyFinger`.

    Args:
        model: whose body parts are the jaw file's key points and "reference", with `finforce: plane` in its metadata.
        jaws: by side.

    Raises:
        ModelError: names or plane of the metadata do not fit.
    """

    shifts = SHIFTS

    def __init__(self, model: KeypointModel, jaws: Mapping[str, Jaw]) -> None:
        self._model, self.name, self.sha256 = model, model.path.parent.name, model.sha256
        self.grids = dict.fromkeys(jaws, grid_from_metadata(model.metadata.finforce.plane))
        self._rows = {side: _order_names(model, jaw) for side, jaw in jaws.items()}

    def locate(self, pictures: NDArray, sides: Sequence[str], starts: Sequence[NDArray | None] = ()) -> Places:
        """Return where the points are, wherever they were before; see `AnyFinger`."""
        peaks = self._model.locate(pictures)
        rows = np.stack([self._rows[side] for side in sides])
        return Places(
            pixels=np.take_along_axis(peaks.pixels, rows[..., None], axis=1),
            likelihood=np.take_along_axis(peaks.likelihood, rows, axis=1),
            stddev=np.take_along_axis(peaks.stddev, rows, axis=1),
        )


def _order_names(model: KeypointModel, jaw: Jaw) -> NDArray:
    """Return which peak is which key point of a jaw, the reference point last, (K + 1,).

    Raises:
        ModelError: a name is missing, or there is one that the jaw does not have.
    """
    wanted = (*jaw.keypoint_names, REFERENCE)
    if set(model.names) != set(wanted):
        missing, more = sorted(set(wanted) - set(model.names)), sorted(set(model.names) - set(wanted))
        raise ModelError(
            f"{model.path.name}: body parts missing: {', '.join(missing) or 'none'}; not of the jaw '{jaw.name}': "
            f"{', '.join(more) or 'none'}; expected its key points and '{REFERENCE}' (another jaw file?)"
        )
    return np.array([model.names.index(name) for name in wanted])


def grid_from_metadata(plane: Mapping[str, Any] | None) -> PlaneGrid:
    """Return the grid that a network's metadata tell.

    Raises:
        ModelError: there is none, or it is incomplete.
    """
    names = [entry.name for entry in fields(PlaneGrid)]
    if not isinstance(plane, Mapping) or any(not isinstance(plane.get(name), (int, float)) for name in names):
        raise ModelError(
            f"finforce.plane: got {plane!r}, expected numbers {', '.join(names)} [m, px]; a network of whole images "
            "is used as a frame model"
        )
    return PlaneGrid(**{name: plane[name] for name in names})
