"""Follows an object through depth images on one core, and finds its first pose: turns over the whole sphere."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finforce.camera import CameraIntrinsics, project
from finforce.errors import PoseError
from finforce.transforms import check_pose, invert_pose, move_pose, rotation_between
from finforce_contact.errors import PoseLostError
from finforce_contact.mesh.object_mesh import ObjectMesh, surrounds
from finforce_contact.parameters import TrackerSettings
from finforce_contact.pose.alignment import LEAST_PIXELS, Alignment, DepthImage, Effort, MeshAligner

_WIDE_GATE = 0.006  # [m], largest distance of depth that belongs to the object, in the first steps
_GATE = 0.003  # [m], the same in the last steps
# Depths farther apart than this [m] disagree altogether.
_WORST = 0.01
_COARSE = Effort(gates=(0.03, 0.015), steps=3, points=150, outline=False)
_MIDDLE = Effort(gates=(0.012, 0.006), steps=4, points=400)
_KEPT = 24  # coarse poses that are looked at again
_TURNS = 6  # about the line of sight, for each direction


def search_pose(aligner: MeshAligner, image: DepthImage, kept: int = 4) -> list[NDArray]:
    """Return the poses (4, 4) that agree best with a masked image, best first.

    Args:
        aligner: the object.
        image: with a mask.
        kept: number of candidates.
    """
    starts = [_place(aligner, image, rotation) for rotation in spread_rotations()]
    coarse = _best(aligner, image, [aligner.align(start, image, _COARSE) for start in starts], _KEPT)
    return _best(aligner, image, [aligner.align(start, image, _MIDDLE) for start in coarse], kept)


def spread_rotations() -> NDArray:
    """Return 252 rotations (n, 3, 3) over the sphere: 42 directions of an icosphere, 6 turns about each.

    Among them is one within 34 degrees of any rotation.
    """
    from scipy.spatial.transform import Rotation

    rotations = []
    for direction in _icosphere():
        towards, _ = Rotation.align_vectors(direction[None], [[0.0, 0.0, 1.0]])
        for turn in range(_TURNS):
            about = Rotation.from_rotvec([0.0, 0.0, 2.0 * np.pi * turn / _TURNS])
            rotations.append((about * towards.inv()).as_matrix())
    return np.array(rotations)


def compute_agreement(aligner: MeshAligner, T_camera_object: NDArray, image: DepthImage) -> float:
    """Return how well a pose explains a masked image, 0 to 1.

    One minus the mean of min(|z_mesh - z|, 10 mm) / 10 mm over the pixels of mesh and mask; a pixel of one of them
    alone disagrees altogether, unless something stands in front of the mesh there.
    """
    view = aligner.render_view(T_camera_object, _MIDDLE.points)
    depth, mask = image.depth[:: view.step, :: view.step], image.mask[:: view.step, :: view.step]
    on_mesh, on_mask = np.isfinite(view.depth), mask & np.isfinite(depth)
    hidden = ~mask & on_mesh & (depth < view.depth)
    unknown = mask & ~np.isfinite(depth)
    counted = (on_mesh | on_mask) & ~hidden & ~unknown
    if not counted.any():
        return 0.0
    cost = np.where(on_mesh & on_mask, np.minimum(np.abs(view.depth - depth) / _WORST, 1.0), 1.0)
    return 1.0 - float(cost[counted].mean())


def _place(aligner: MeshAligner, image: DepthImage, rotation: NDArray) -> NDArray:
    """Return a pose (4, 4) of a given rotation that covers the mask: its box and its depth."""
    rows, columns = np.nonzero(image.mask)
    box = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2.0
    depth = float(np.nanmedian(image.depth[image.mask]))
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = image.ray(box) * (depth + 0.5 * aligner.radius) - rotation @ aligner.middle
    for _ in range(2):
        seen = aligner.render_view(T, _COARSE.points).surface.points
        if not len(seen):
            break
        pixels = project(seen, image.camera)
        middle = aligner.middle_of(T)
        shift = box - 0.5 * (pixels.min(axis=0) + pixels.max(axis=0))
        target = project(middle[None], image.camera)[0] + shift
        T[:3, 3] += image.ray(target) * (middle[2] + depth - np.median(seen[:, 2])) - middle
    return T


def _best(aligner: MeshAligner, image: DepthImage, alignments: list[Alignment], kept: int) -> list[NDArray]:
    poses = [alignment.T_camera_object for alignment in alignments]
    agreement = [compute_agreement(aligner, pose, image) for pose in poses]
    return [poses[i] for i in np.argsort(agreement)[::-1][:kept]]


def _icosphere() -> NDArray:
    """Return the vertices and edge midpoints (42, 3) of an icosahedron, on the unit sphere."""
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    corners = np.array([np.roll([0.0, a, b * golden], k) for k in range(3) for a in (-1, 1) for b in (-1, 1)])
    middles = [a + b for i, a in enumerate(corners) for b in corners[:i] if np.linalg.norm(a - b) < 2.1]
    points = np.concatenate([corners, middles])
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectPose:
    """The pose of the object in one image.

    Attributes:
        stamp: capture time of the image [s].
        T_camera_object: pose of the mesh file's own frame in the camera optical frame (4, 4) [m].
        covariance: of x, y, z [m] and the rotations about x, y, z [rad], camera axes, about the object's origin (6, 6);
            a direction that nothing determines has a large variance; None where the source tells none.
        fitness: share of what should be seen that was seen where it should be, 0 to 1; 1 where the source tells none.
        source: who says so.
    """

    stamp: float
    T_camera_object: NDArray
    covariance: NDArray | None
    fitness: float
    source: str


def check_camera_outside(T_camera_object: ArrayLike, mesh: ObjectMesh) -> NDArray:
    """Return a checked pose (4, 4) after having refused one that puts the object around the camera.

    Raises:
        PoseError: The pose is not rigid, or the mesh surrounds the camera's origin.
    """
    T_camera_object = check_pose(T_camera_object, "object pose")
    camera = invert_pose(T_camera_object)[:3, 3]
    if surrounds(mesh, camera):
        raise PoseError(
            f"object pose: got one that puts the camera inside the object '{mesh.name}', at {camera.round(4)} m of its "
            "frame; expected the object in front of the camera (z forward), with T_camera_object and not its inverse"
        )
    return T_camera_object


_SOURCE = "tracker"
# Without any image, an object is known to be within reach [m], turned anyhow [rad]: a uniform angle's deviation.
_UNKNOWN = np.array([0.1] * 3 + [np.pi / np.sqrt(3.0)] * 3)
# A lost object is searched for around its last pose, in rings at one, two and three times these distances.
_NEAR = 0.012  # [m]
_TURNED = np.deg2rad(15.0)  # [rad]
_RINGS = 3  # rings
_NEARBY = 12  # starts around the last pose, for each image
_FINALISTS = 3  # of them that are looked at closely
_QUICK = Effort(gates=(0.012, 0.006), steps=3, points=250)
# Without a pose before, a pose must agree better than from one image to the next; a wall has no outline.
_FIT = 0.85  # [-], least fitness
_SHOWN = 0.6  # [-], least visible fraction of the surface
_OUTLINED = 0.35  # [-], least matched fraction of the outline
# The least agreement with a mask; the right mesh has 0.83 to 0.92 at a D405's noise, and loses 0.1 by a mask that is
# two pixels wide of an object of 80.
_AGREEING = 0.7
# After a longer time [s] without a pose, a new one must convince by itself.
_LONGEST_GAP = 0.1
# A search over all turns takes about a second; it is not done more often than this [s].
_SEARCH_PERIOD = 1.0


class PoseTracker:
    """The pose of one object in the images of one camera, from its mesh and the depths alone.

    The visible part of the mesh is brought into agreement with the depths by point-to-plane steps, its outline with the
    places where the depth falls back. Depth in front of the mesh belongs to something that hides it and is left out.
    Directions that the image does not tell, such as the turn of a cylinder about its axis, keep the last pose.

    Attributes:
        latest: the newest pose; None before the first and after a reset. A lost object does not change it.
    """

    def __init__(self, mesh: ObjectMesh, camera: CameraIntrinsics, settings: TrackerSettings | None = None) -> None:
        """Prepare the mesh.

        Args:
            mesh: the object.
            camera: of the depth images.
            settings: None for the defaults.

        Raises:
            MissingDependencyError: Open3D is not installed.
        """
        self.latest: ObjectPose | None = None
        self._settings = settings or TrackerSettings()
        self._mesh, self._camera = mesh, camera
        self._aligner = MeshAligner(mesh, camera, self._settings)
        self._counts: Counter[str] = Counter()
        self._searched, self._missed = -np.inf, 0

    @property
    def counts(self) -> Mapping[str, int]:
        """The number of images by outcome: `located`, `tracked`, `recovered`, `lost`."""
        return MappingProxyType(self._counts)

    def reset(self) -> None:
        """Forget the pose; `locate` is needed again."""
        self.latest, self._searched, self._missed = None, -np.inf, 0

    def locate(self, stamp: float, depth: NDArray, mask: NDArray, guesses: Sequence[ArrayLike] = ()) -> ObjectPose:
        """Find the object in an image with no pose before it.

        The guesses come first; where none of them fits, turns over the whole sphere are tried (a second).

        Args:
            stamp: capture time [s].
            depth: (h, w) [m], NaN where nothing was measured.
            mask: (h, w) bool, the object's pixels.
            guesses: poses (4, 4) near which it may be.

        Raises:
            ImageError: The image or the mask cannot be used.
            PoseError: The stamp is not finite, or a guess is no pose or puts the camera inside the object.
            PoseLostError: No pose agrees with the image; the last one stays as it was.
        """
        if not np.isfinite(stamp):
            raise PoseError(f"image: got stamp {stamp}, expected the capture time in seconds")
        image = DepthImage(depth, self._camera, mask)
        starts = [check_camera_outside(guess, self._mesh) for guess in guesses]
        alignment = self._best_of(starts, image) or self._search(stamp, image)
        if alignment is None:
            raise self._lost("no pose of it agrees with depth and mask; check that the mesh is that of the object")
        self._counts["located"] += 1
        return self._accept(stamp, alignment, np.diag(_UNKNOWN**2))

    def track(self, stamp: float, depth: NDArray, mask: NDArray | None = None) -> ObjectPose:
        """Follow the object into the next image.

        Args:
            stamp: capture time [s], after that of the last pose.
            depth: (h, w) [m], NaN where nothing was measured.
            mask: (h, w) bool, the object's pixels where they are known; not needed.

        Raises:
            ImageError: The image or the mask cannot be used.
            PoseError: The stamp is not after that of the last pose.
            PoseLostError: There is no pose yet, or the object was not found again; the next image may show it.
        """
        if self.latest is None:
            raise PoseLostError(f"object '{self._mesh.name}': no pose yet; locate it in an image with a mask first")
        if not stamp > self.latest.stamp:
            raise PoseError(f"image: got stamp {stamp:.6f} s, expected one after {self.latest.stamp:.6f} s, or a reset")
        image = DepthImage(depth, self._camera, mask)
        alignment = self._aligner.align(self.latest.T_camera_object, image, self._near_effort())
        outcome = "tracked"
        if not (self._is_good(alignment) and self._is_near(alignment, stamp - self.latest.stamp)):
            alignment, outcome = self._recover(stamp, image), "recovered"
        if alignment is None:
            raise self._lost(
                "it is hidden, has left the image or has moved too far; its last pose is kept to look near"
            )
        self._counts[outcome] += 1
        elapsed = stamp - self.latest.stamp
        moved = elapsed * np.array([self._settings.speed] * 3 + [self._settings.turn_rate] * 3)
        return self._accept(stamp, alignment, self.latest.covariance + np.diag(moved**2))

    def _near_effort(self) -> Effort:
        gates = (_WIDE_GATE, _GATE, _GATE)
        return Effort(gates=gates, steps=3, points=self._settings.points)

    def _recover(self, stamp: float, image: DepthImage) -> Alignment | None:
        """Look for a lost object around its last pose and, where there is a mask, everywhere."""
        starts = [move_pose(self.latest.T_camera_object, step) for step in _steps_around(self._missed)]
        tried = [self._aligner.align(start, image, _QUICK) for start in [self.latest.T_camera_object, *starts]]
        tried.sort(key=lambda one: -self._rate(one, image))
        self._missed += 1
        found = self._best_of([one.T_camera_object for one in tried[:_FINALISTS]], image)
        if found is None and image.mask is not None and abs(stamp - self._searched) > _SEARCH_PERIOD:
            found = self._search(stamp, image)
        return found

    def _search(self, stamp: float, image: DepthImage) -> Alignment | None:
        self._searched = stamp
        return self._best_of(search_pose(self._aligner, image), image)

    def _best_of(self, starts: Sequence[NDArray], image: DepthImage) -> Alignment | None:
        """Return the alignment that explains the image best, of those that are good enough."""
        found = [self._aligner.align(start, image, self._near_effort()) for start in starts]
        good = [one for one in found if self._is_good(one) and self._is_convincing(one, image)]
        return max(good, key=lambda one: self._rate(one, image), default=None)

    def _is_convincing(self, alignment: Alignment, image: DepthImage) -> bool:
        """Return whether a pose can be believed that does not follow from the one before."""
        if image.mask is not None:
            return self._rate(alignment, image) > _AGREEING
        return alignment.fitness > _FIT and alignment.visible > _SHOWN and alignment.outlined > _OUTLINED

    def _rate(self, alignment: Alignment, image: DepthImage) -> float:
        if image.mask is None:
            return alignment.fitness * alignment.visible
        return compute_agreement(self._aligner, alignment.T_camera_object, image)

    def _is_good(self, alignment: Alignment) -> bool:
        try:
            check_camera_outside(alignment.T_camera_object, self._mesh)
        except PoseError:
            return False
        return (
            alignment.seen >= LEAST_PIXELS
            and alignment.visible >= self._settings.least_visible
            and alignment.fitness >= self._settings.least_fitness
        )

    def _is_near(self, alignment: Alignment, elapsed: float) -> bool:
        """Return whether the object's middle and rim moved no farther than it can; the gates follow little more."""
        before, after = self.latest.T_camera_object, alignment.T_camera_object
        way = np.linalg.norm(self._aligner.middle_of(after) - self._aligner.middle_of(before))
        way = max(way, self._aligner.radius * rotation_between(before, after))
        return way < _WIDE_GATE + self._settings.speed * min(elapsed, _LONGEST_GAP)

    def _accept(self, stamp: float, alignment: Alignment, prior: NDArray) -> ObjectPose:
        """Keep a pose: covariance = (information + prior^-1 + unknown^-2)^-1."""
        known = alignment.information + np.linalg.inv(prior) + np.diag(_UNKNOWN**-2)
        self._missed = 0
        self.latest = ObjectPose(
            stamp=stamp,
            T_camera_object=alignment.T_camera_object,
            covariance=np.linalg.inv(known),
            fitness=alignment.fitness,
            source=_SOURCE,
        )
        return self.latest

    def _lost(self, why: str) -> PoseLostError:
        self._counts["lost"] += 1
        return PoseLostError(f"object '{self._mesh.name}' is not found: {why}")


def _steps_around(missed: int) -> NDArray:
    """Return steps (n, 6) [m, rad] in random directions, their lengths by how many images did not show the object."""
    steps = np.random.default_rng(missed).standard_normal((_NEARBY, 6))
    for part, length in ((slice(0, 3), _NEAR), (slice(3, 6), _TURNED)):
        lengths = np.linalg.norm(steps[:, part], axis=1, keepdims=True)
        steps[:, part] *= length * (1 + missed % _RINGS) / lengths
    return steps
