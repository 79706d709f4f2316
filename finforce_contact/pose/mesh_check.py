"""The agreement of a posed mesh with depth images, and the turn, scale or shift of it that would agree."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.transforms import invert_pose, rotation_between
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.parameters import TrackerSettings
from finforce_contact.pose.alignment import DepthImage, Effort, MeshAligner

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

PIXELS = 400  # of the object that are compared in an image
TOLERANCE = 0.003  # [m], six standard deviations of `pose_bias`; farther off, surface and depth disagree
DEPTH_ERROR = 0.01  # [-], error of depth over distance, in addition
SHORTEST_ARM = 0.04  # [m], of the part of an object that a gripper holds: by how much a turn moves that
LEAST_IMAGES = 3  # images before a verdict
MOST_IMAGES = 12  # images that a verdict rests on
FIRST_PERIOD = 0.3  # [s], between comparisons of the first images
PERIOD = 2.0  # [s], between later comparisons
LEAST_PIXELS = 30  # per image that a verdict rests on
BEHIND = 0.12  # [-], share of the surface that the camera sees through, from which on the mesh is another one
LEAST_GAIN = 0.35  # [-], of the visible surface, from which on a mesh fits
NO_GAIN = 0.25  # [-], of the visible surface, below which an aligned mesh has another shape
NAMED_IN = 3  # images that another reading is looked for in
_NEAR = (0.01, 0.006)  # [m], gates of the alignment of a mesh that fits as posed
_FAR = (0.02, 0.01, 0.006)  # [m], gates of the alignment of a mesh that does not
FARTHEST = 0.045  # [m], of a shift that is named: farther off, a table may look like the object
_REACH = 0.012 * np.arange(-2, 3)  # [m], shifts along each axis of the camera that are tried
MOST_STARTS = 12  # of those, aligned: the nearest to the depth may slide to another place
_UNITS = np.array([1e-3, 1e-2, 0.0254, 0.1, 10.0, 1.0 / 0.0254, 100.0, 1e3])
_SCALES = np.concatenate((2.0 ** (np.arange(-8, 9) / 6.0), _UNITS))
_FINER = np.linspace(0.92, 1.08, 9)  # [-], of the best scale


def _tolerance(distance: NDArray | float) -> NDArray | float:
    """Return by how much surface and depth may differ at a distance [m] from the camera [m]."""
    return np.maximum(TOLERANCE, DEPTH_ERROR * distance)


def is_due(count: int, elapsed: float) -> bool:
    """Say whether an image is to be compared so long [s] after the last one, `count` having been compared."""
    return elapsed >= (FIRST_PERIOD if count < LEAST_IMAGES else PERIOD)


class Fit(NamedTuple):
    """The score of one reading of the mesh against an image, in pixels of its grid.

    Attributes:
        gain: pixels at the mesh's depth, minus those behind it; each counts less as it lies off.
        seen: pixels of the mesh that nothing hides.
        behind: those of them whose depth lies clearly behind the mesh.
    """

    gain: float
    seen: int
    behind: int

    @property
    def fits(self) -> bool:
        """True if the mesh is where the camera sees something, and nowhere else."""
        return self.gain >= LEAST_GAIN * max(self.seen, 1) and self.behind <= BEHIND * self.seen


class _Evidence(NamedTuple):
    """The evidence of one image.

    Attributes:
        posed: fit of the mesh as posed.
        aligned: fit of the mesh as aligned.
        change: (4, 4) by alignment, in the object's frame.
        rotation: (3, 3) from the object's axes to those of the camera.
        distance: of the object from the camera [m].
    """

    posed: Fit
    aligned: Fit
    change: NDArray
    rotation: NDArray
    distance: float


class _View(NamedTuple):
    """An image, the mesh's pose in it (4, 4), and every how many pixels they are compared."""

    image: DepthImage
    T_camera_object: NDArray
    step: int

    def moved(self, change: NDArray) -> _View:
        """Return the view of a mesh whose own frame a map (4, 4) has changed."""
        return self._replace(T_camera_object=self.T_camera_object @ change)


class Reading(NamedTuple):
    """Another way to read the mesh: in words, and as a map (4, 4) of its own frame."""

    text: str
    change: NDArray


class MeshCheck:
    """Compares a mesh, posed by whoever tracks it, with depth images of one camera.

    A surface that the camera sees through is not there, and one that alignment moves by more than poses err is
    elsewhere. What hides the object, as jaws and hands do, says nothing.

    Attributes:
        contradiction: why the mesh cannot be where it is said to be, with the reading that would fit; "" for none.

    Args:
        mesh: of the object.
        camera: of the depth images.

    Raises:
        MissingDependencyError: Open3D is not installed.
    """

    def __init__(self, mesh: ObjectMesh, camera: CameraIntrinsics) -> None:
        self._mesh, self._camera, self._settings = mesh, camera, TrackerSettings()
        self._aligner, self._view = MeshAligner(mesh, camera, self._settings), MeshView(mesh)
        self.reset()

    def reset(self) -> None:
        """Forget all images."""
        self._evidence: deque[_Evidence] = deque(maxlen=MOST_IMAGES)
        self._views: deque[_View] = deque(maxlen=NAMED_IN)
        self._reading: str | None = None
        self.contradiction = ""

    def add(self, depth: NDArray, T_camera_object: NDArray) -> str:
        """Compare an image, and return the contradiction by this and those before.

        Args:
            depth: (h, w) [m], NaN where nothing was measured.
            T_camera_object: (4, 4), of the same time.

        Raises:
            ImageError: the image has another size than the camera, or no depth.
        """
        step = self._aligner.render_view(T_camera_object, PIXELS).step
        view = _View(DepthImage(depth, self._camera), T_camera_object, step)
        posed = self._compare(view)
        effort = Effort(gates=_NEAR if posed.fits else _FAR, steps=2, points=PIXELS)
        change = invert_pose(T_camera_object) @ self._align(view, effort)
        self._views.append(view)
        aligned, distance = self._compare(view.moved(change)), float(self._aligner.middle_of(T_camera_object)[2])
        self._evidence.append(_Evidence(posed, aligned, change, T_camera_object[:3, :3], distance))
        trouble = self._find_trouble()
        if trouble and self._reading is None:
            self._reading = self._find_reading()
        self.contradiction = (
            trouble and f"the camera contradicts the mesh {self._mesh.name}: {trouble}; {self._reading}"
        )
        return self.contradiction

    @property
    def sees_mesh(self) -> bool:
        """True if enough of the mesh is seen where its poses have it, or nearby, for a verdict."""
        totals = [_sum(fits) for fits in zip(*((each.posed, each.aligned) for each in self._evidence), strict=True)]
        return any(total.seen >= LEAST_PIXELS * len(self._evidence) for total in totals)

    def _find_trouble(self) -> str:
        """Return what speaks against the mesh as posed, "" where nothing does or too little is seen."""
        evidence = self._evidence
        posed, aligned = _sum(each.posed for each in evidence), _sum(each.aligned for each in evidence)
        if len(evidence) < LEAST_IMAGES or not self.sees_mesh:
            return ""
        if posed.behind > BEHIND * posed.seen and posed.seen >= LEAST_PIXELS * len(evidence):
            return f"it sees through {100.0 * posed.behind / posed.seen:.0f} % of its surface"
        fitting = [each for each in evidence if each.aligned.fits and each.aligned.gain > each.posed.gain]
        off = self._find_distance(fitting) if 2 * len(fitting) > len(evidence) else 0.0
        if off > _tolerance(np.mean([each.distance for each in evidence])):
            return f"it sees the surface {1e3 * off:.0f} mm elsewhere"
        if posed.gain < LEAST_GAIN * posed.seen and aligned.gain < NO_GAIN * aligned.seen:
            return "its surface has another shape"
        return ""

    def _find_distance(self, evidence: Sequence[_Evidence]) -> float:
        """Return how far alignment moves what is held of the object [m], by the medians of shift and turn."""
        from scipy.spatial.transform import Rotation

        shifts = np.array([self._shift(each.change) for each in evidence])
        turns = Rotation.from_matrix([each.change[:3, :3] for each in evidence]).as_rotvec()
        # what is wrong may move with the object, as a shifted mesh, or with the camera, as one that is too small
        seen = np.array([each.rotation @ shift for each, shift in zip(evidence, shifts, strict=True)])
        return max(float(np.linalg.norm(np.median(each, axis=0))) for each in (shifts, seen, SHORTEST_ARM * turns))

    def _shift(self, change: NDArray) -> NDArray:
        """Return the shift (3,) of the object's middle [m] by a change (4, 4) of the mesh's frame, along its axes."""
        middle = self._aligner.middle
        return change[:3, :3] @ middle + change[:3, 3] - middle

    def _align(self, view: _View, effort: Effort) -> NDArray:
        return self._aligner.align(view.T_camera_object, view.image, effort).T_camera_object

    def _compare(self, view: _View) -> Fit:
        """Return how the mesh, under an affine map into the camera's frame, explains an image."""
        step, image = view.step, view.image
        expected = self._view.render(view.T_camera_object, self._camera, step).depth
        inner = np.isfinite(expected)
        inner[1:-1, 1:-1] &= inner[:-2, 1:-1] & inner[2:, 1:-1] & inner[1:-1, :-2] & inner[1:-1, 2:]
        behind = (image.depth[::step, ::step] - expected)[inner]
        tolerance = _tolerance(expected[inner])
        hidden = behind <= -tolerance
        gains = np.clip(1.0 - np.abs(behind) / tolerance, -1.0, 1.0)[~hidden & np.isfinite(behind)]
        return Fit(float(gains.sum()), len(gains), int((behind > 2.0 * tolerance).sum()))

    def _find_reading(self) -> str:
        """Return which turn, scale or shift of the mesh fits best, in words."""
        fitting = [(fit.gain, reading.text) for reading, fit in self._tried() if fit.fits]
        if fitting:
            return f"if the depth is right, the mesh fits when {max(fitting, key=lambda each: each[0])[1]}"
        return "no turn, scale or shift of it fits: is it the mesh of this object, in this frame, and the depth right?"

    def _tried(self) -> Iterator[tuple[Reading, Fit]]:
        """Yield other readings of the mesh with their fits to the newest images."""
        for reading in list_turns():
            yield reading, self._fit(reading.change)
        scale = max(_SCALES, key=lambda scale: self._fit(_scaled(scale)).gain)
        scale = max(scale * _FINER, key=lambda scale: self._fit(_scaled(scale)).gain)
        yield Reading(f"scaled by {scale:.3g}", _scaled(scale)), self._fit(_scaled(scale))
        for axis, name in enumerate("xyz"):
            mirror = np.diag(np.where(np.arange(4) == axis, -1.0, 1.0))
            yield Reading(f"mirrored along {name}", mirror), self._fit(mirror)
        change = self._find_shift()
        if np.linalg.norm(self._shift(change)) <= FARTHEST:
            yield Reading(self._describe_shift(change), change), self._fit(change)

    def _fit(self, change: NDArray) -> Fit:
        return _sum(self._compare(view.moved(change)) for view in self._views)

    def _find_shift(self) -> NDArray:
        """Return the change (4, 4) of the mesh's frame by which it fits the newest image, pushed about and aligned."""
        view, starts = self._views[-1], [self._views[-1].moved(self._evidence[-1].change)]
        for shift in product(_REACH, repeat=3):
            T = view.T_camera_object.copy()
            T[:3, 3] += shift
            starts.append(view._replace(T_camera_object=T))
        starts.sort(key=lambda start: self._compare(start).gain, reverse=True)
        found = [self._align(start, Effort(gates=_FAR, steps=3, points=PIXELS)) for start in starts[:MOST_STARTS]]
        best = max(found, key=lambda T: self._compare(view._replace(T_camera_object=T)).gain)
        return invert_pose(view.T_camera_object) @ best

    def _describe_shift(self, change: NDArray) -> str:
        """Return a change of the mesh's frame (4, 4) in words."""
        x, y, z = np.rint(1e3 * self._shift(change)).astype(int)
        turn = np.degrees(rotation_between(np.eye(4), change))
        turned = f" and turned by {turn:.0f} degrees about its middle" if turn >= 1.0 else ""
        return f"shifted by ({x}, {y}, {z}) mm along its axes{turned}"


def _sum(fits: Iterable[Fit]) -> Fit:
    return Fit(*map(sum, zip(*fits, strict=True)))


def _scaled(scale: float) -> NDArray:
    return np.diag([scale, scale, scale, 1.0])


def list_turns() -> list[Reading]:
    """Return the 23 turns that lay axes on axes, those by right angles first."""
    from scipy.spatial.transform import Rotation

    turns = []
    for rotation in sorted(Rotation.create_group("O"), key=_order_of_turn):
        turn, change = rotation.magnitude(), np.eye(4)
        if turn < 1e-6:
            continue
        axis = np.rint(rotation.as_rotvec() / np.abs(rotation.as_rotvec()).max()).astype(int)
        if axis[np.flatnonzero(axis)[0]] < 0:  # by -90 degrees about x, not by 90 about -x
            axis, turn = -axis, -turn
        name = "xyz"[int(axis.argmax())] if np.abs(axis).sum() == 1 else str(tuple(axis.tolist()))
        change[:3, :3] = rotation.as_matrix()
        turns.append(Reading(f"turned by {np.degrees(turn):.0f} degrees about {name}", change))
    return turns


def _order_of_turn(rotation: Rotation) -> tuple[float, float]:
    """Return what sorts small turns before large ones, and positive ones before negative."""
    return round(rotation.magnitude(), 3), -round(float(rotation.as_rotvec().sum()), 3)
