"""Where an object touches a jaw, image after image: poses and the deformed jaw in, a contact patch out."""

from collections import Counter
from dataclasses import dataclass, field
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from finforce.errors import ObservationError, PoseError
from finforce.health import STILL, Skips
from finforce.transforms import check_pose, invert_pose
from finforce_contact.localization.outline_localizer import (
    ClosestLocalizer,
    ContactLocation,
    ContactPatch,
    ContactScene,
    Localizer,
    OutlineLocalizer,
    build_inner_face,
)
from finforce_contact.localization.section import ObjectSection, SectionKeeper, count_inside
from finforce_contact.localization.touch import (
    SURELY_BENT,
    Slip,
    SlipWatch,
    StillnessWatch,
    TouchBelief,
    TouchedFace,
    describe_conflict,
    face_at,
)
from finforce_contact.mesh.object_mesh import ObjectMesh, surrounds
from finforce_contact.paper_contact import IntersectionLocalizer
from finforce_contact.parameters import ContactSettings
from finforce_contact.pose.filter import FilteredPose, PoseFilter
from finforce_contact.pose.symmetry import parse_symmetry, read_symmetry
from finforce_ifea.errors import ContactError
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.observation import Contact, ObjectOutline


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactEstimate:
    """Where the object touches a jaw, or would touch first; without rows when nobody knows.

    Attributes:
        stamp: of the image [s].
        status: "touching", "apart", "no_object" or "no_pose".
        message: what to tell the user, empty when there is nothing to tell.
        points: (n, 3) [m] on the undeformed inner surface.
        candidates: (n,) the jaw's candidate nearest to each point.
        weights: (n,) shares of the force, sum 1.
        touching: whether object and jaw touch.
        skipped: why no contact was looked for, empty when it was.
        outline: of the object in the finger's plane, None when its pose is not known or the mode has no use for it.
        T_jaw_object: (4, 4), None when not known.
        probability: of contact, as far as the mode tells.
        slip: of the object over the jaw, None when it is not known.
    """

    stamp: float
    status: str
    message: str
    points: NDArray = field(default_factory=lambda: np.empty((0, 3)))
    candidates: NDArray = field(default_factory=lambda: np.empty(0, np.int64))
    weights: NDArray = field(default_factory=lambda: np.empty(0))
    touching: bool = False
    skipped: str = ""
    outline: ObjectOutline | None = None
    T_jaw_object: NDArray | None = None
    probability: float = 0.0
    slip: Slip | None = None

    @property
    def contact(self) -> Contact | None:
        """The contact for the solver, None when there are no rows."""
        if not len(self.points):
            return None
        return Contact(points=self.points, weights=self.weights, touching=self.touching, outline=self.outline)


# A rotation's entries times this are about the way that the object's surface moves [m].
_LEVER = 0.03
# A surface that is deformed by less [m] is that of a solver that has not begun.
_UNDEFORMED = 1e-7
# A bent jaw farther from the object than this [m], and what the pose may err, is bent by something else.
_REACH = 4e-3
_JAW_SAMPLES = 100
_SURROUNDED = 0.5
# Motion [m] and change of force [N] that are not worth a new search.
_STILL, _STILL_FORCE = 0.02e-3, 0.01
# An object with its origin farther off [m] is out of reach.
_OUT_OF_REACH = 1.0
_REASONS = ("solved", "still", "no_object", "no_pose", "surrounded", "out_of_reach", "late pose", "odd pose")


class ContactEstimator:
    """Estimates where an object touches one jaw; deterministic, one thread.

    Attributes:
        jaw: with the calibration applied that the solver has.
        settings: of this estimator.
        face: the inner surface of the jaw's mesh.
        skips: rules of what need not be done.
        counts: images and poses by what was done with them, or why nothing was.
    """

    def __init__(
        self,
        jaw: Jaw,
        *,
        mesh: ObjectMesh | None = None,
        settings: ContactSettings | None = None,
        skips: Skips | None = None,
    ) -> None:
        """Prepare the jaw's inner face; without `skips` every rule of what need not be done is applied.

        Raises:
            FinforceError: The jaw has no mesh of that density, or symmetry or object do not do.
        """
        self.jaw, self.settings = jaw, settings or ContactSettings()
        parse_symmetry(self.settings.symmetry)
        self.face = build_inner_face(jaw, self.settings.mesh)
        self._undeformed = self.face.deform(self.face.mesh.nodes)
        self._samples = np.unique(np.linspace(0, len(self.face.mesh.nodes) - 1, _JAW_SAMPLES).astype(int))
        self._poses, self._belief = PoseFilter(self.settings), TouchBelief()
        self._slips = SlipWatch(self.settings)
        self._stillness, self.skips = StillnessWatch(), skips or Skips()
        self.set_object(mesh)

    @property
    def still(self) -> bool:
        """Whether the grasp holds still, so that no new pose is needed."""
        return self._stillness.still

    def set_object(self, mesh: ObjectMesh | None) -> None:
        """Take another object, or none; its pose is not known yet.

        Raises:
            ObjectMeshError: The mode needs a watertight mesh, and this one is not.
            MissingDependencyError: The mode needs a library that is not installed.
        """
        self._mesh: ObjectMesh | None = None
        self._symmetry = read_symmetry(self.settings.symmetry, mesh) if mesh is not None else None
        self._localizer = self._build_localizer(mesh) if mesh is not None else None
        if mesh is not None:
            low, high = mesh.bounds
            self._centre, self._half = mesh.middle, 0.5 * (high - low)
            span = (float(self.face.heights[0]), float(self.face.heights[-1]))
            self._sections = SectionKeeper(mesh, self.face.half_width, span)
        self._mesh = mesh
        self.reset()

    def reset(self) -> None:
        """Forget poses, contact and counts; jaw and object stay."""
        self._poses.reset()
        self._belief.reset()
        self._stillness.reset()
        if self._localizer is not None:
            self._localizer.reset()
        self.counts: Counter[str] = Counter(dict.fromkeys(_REASONS, 0))
        self._slips.reset()
        self._face: TouchedFace | None = None
        self._solved: ContactScene | None = None
        self._located: ContactLocation | None = None

    def _build_localizer(self, mesh: ObjectMesh) -> Localizer:
        if self.settings.mode == "paper":
            return IntersectionLocalizer(self.jaw, self.face, mesh)
        if self.settings.mode == "closest":
            return ClosestLocalizer(self.jaw, self.face)
        return OutlineLocalizer(self.face)

    def take_pose(
        self,
        stamp: float,
        T_jaw_object: NDArray,
        covariance: NDArray | None = None,
        *,
        camera: NDArray | None = None,
    ) -> None:
        """Take a pose of the object.

        Args:
            stamp: image capture time [s].
            T_jaw_object: (4, 4).
            covariance: (6, 6) of x, y, z [m] and the rotations about the jaw's axes [rad]; None: learnt from the poses.
            camera: (3,) [m], position of the camera in the jaw frame; a pose that puts the object around it is refused.

        Raises:
            PoseError: The stamp, the pose or its covariance is none, or the object would surround the camera.
        """
        T = check_pose(T_jaw_object, "T_jaw_object")
        watched = camera is not None and self._mesh is not None
        if watched and surrounds(self._mesh, (invert_pose(T) @ np.append(camera, 1.0))[:3]):
            raise PoseError("this pose puts the object around the camera: check its pose, mesh and unit")
        if self._symmetry is not None and self._poses.latest is not None:
            T = self._symmetry.choose(T, self._poses.at(stamp).T)
        outcome = self._poses.update(stamp, T, covariance)
        if outcome in ("used", "rejected") and self._face is not None:
            self._slips.update(stamp, T, self._face, odd=outcome == "rejected")
        self.counts["late pose"] += outcome == "late"
        self.counts["odd pose"] += outcome == "rejected"

    def carry(self, T: NDArray) -> None:
        """Take the jaw's own motion since the last pose: T (4, 4) leads from its frame then to its frame now."""
        self._poses.carry(T)

    def update(
        self, stamp: float, surface: NDArray | None = None, wrench: tuple[NDArray, NDArray] | None = None
    ) -> ContactEstimate:
        """Return where the object touches in the image of a stamp [s].

        Args:
            stamp: image capture time [s].
            surface: (n, 3) [m] deformed vertices in mesh order; None: the jaw is taken as undeformed.
            wrench: force (3,) [N] and torque (3,) [N m] about the jaw's origin of the last trusted image.

        Raises:
            MeshError: The surface is not that of the jaw's mesh.
            ContactError: The wrench is none.
            ObservationError: The stamp is not finite.
        """
        surface = self.face.mesh.nodes if surface is None else self.face.check_surface(surface)
        if wrench is not None and not (np.shape(wrench) == (2, 3) and np.isfinite(wrench).all()):
            raise ContactError(f"wrench: got {wrench}, expected a force [N] and a torque [N m] of three finite numbers")
        if not isfinite(stamp):
            raise ObservationError(f"image: got stamp {stamp}, expected the capture time in seconds")
        if self._mesh is None:
            return self._give_up(stamp, "no_object", "no object mesh: load one, or give the contact's height")
        if self._poses.stamp is None:
            return self._give_up(stamp, "no_pose", f"no pose of {self._mesh.name} has come yet")
        age = min(stamp - self._poses.believed, stamp - self._stillness.ended)
        if not self._stillness.still and age > self.settings.pose_timeout:
            message = f"the last pose of {self._mesh.name} is {age:.1f} s old, expected one every second"
            return self._give_up(stamp, "no_pose", message)
        if age < -self.settings.pose_timeout:
            message = f"the last pose of {self._mesh.name} lies {-age:.1f} s ahead; reset after time has jumped back"
            return self._give_up(stamp, "no_pose", message)
        pose = self._poses.at(self._poses.stamp if self._stillness.still else stamp)
        section = self._sections.at(pose.T)
        scene = ContactScene(T=pose.T, section=section, surface=surface, line=self.face.deform(surface), wrench=wrench)
        return self._follow(stamp, pose, scene)

    def _follow(self, stamp: float, pose: FilteredPose, scene: ContactScene) -> ContactEstimate:
        """Find the contact in a scene, or keep the last one, and decide whether the object touches."""
        is_still = self.skips.allows(STILL) and self._is_still(scene)
        if not is_still:
            if self._surrounds_jaw(scene):
                message = f"this pose puts {self._mesh.name} around the jaw: check its pose, mesh and unit"
                return self._give_up(stamp, "no_pose", message, "surrounded")
            self._solved, self._located = scene, self._localizer.locate(scene)
            if self._located is None or np.abs(scene.section.origin).max() > _OUT_OF_REACH:
                message = f"{self._mesh.name} does not stand before the inner surface"
                return self._give_up(stamp, "apart", message, "out_of_reach")
            self._rows = self._find_rows(self._located.patch)
        self.counts["still" if is_still else "solved"] += 1
        self.skips.count(STILL, is_still)
        message = self._judge_touch(pose, scene)
        self._stillness.update(stamp, scene.line if self._belief.touching and self._is_live(scene) else None)
        return self._report(stamp, pose, scene, is_still, message)

    def _is_still(self, scene: ContactScene) -> bool:
        """Return whether neither object, surface nor force moved since the last contact state was found."""
        before = self._solved
        if before is None or self._located is None or not scene.section.polygons:
            return False
        moved = np.abs(scene.T - before.T)
        moved[:3, :3] *= _LEVER
        if moved.max() > _STILL or np.abs(scene.line - before.line).max() > _STILL:
            return False
        if scene.wrench is None or before.wrench is None:
            return scene.wrench is before.wrench
        return bool(np.abs(scene.wrench[0] - before.wrench[0]).max() < _STILL_FORCE)

    def _is_live(self, scene: ContactScene) -> bool:
        """Return whether the surface is that of a solver at work."""
        return bool(np.abs(scene.line - self._undeformed).max() > _UNDEFORMED)

    def _surrounds_jaw(self, scene: ContactScene) -> bool:
        """Return whether most of the jaw lies within the object."""
        jaw = scene.surface[self._samples]
        inside = np.abs((jaw - scene.T[:3, 3]) @ scene.T[:3, :3] - self._centre) < self._half
        if inside.all(axis=1).mean() < _SURROUNDED:
            return False
        return count_inside(np.ascontiguousarray(jaw[:, ::2]), scene.section.edges) > _SURROUNDED * len(jaw)

    def _judge_touch(self, pose: FilteredPose, scene: ContactScene) -> str:
        """Decide whether the object touches, and return what is odd about that."""
        located, settings = self._located, self.settings
        if located.touching is not None:
            self._belief.set(located.touching)
            return ""
        stddev = float(np.hypot(pose.stddev[0], settings.pose_bias))
        slack, live = _REACH + 3.0 * stddev, self._is_live(scene)
        if located.gap > slack or (live and located.gap < -slack and located.bend < SURELY_BENT):
            self._belief.set(False)
            return describe_conflict(self._mesh.name, located.gap, located.bend)
        self._belief.update(located.bend - located.gap, stddev, located.bend if live else None)
        return ""

    def _report(
        self, stamp: float, pose: FilteredPose, scene: ContactScene, is_still: bool, message: str
    ) -> ContactEstimate:
        """Return the estimate of an image."""
        touching = self._belief.touching
        self._follow_face(scene, touching)
        return ContactEstimate(
            stamp=stamp,
            status="touching" if touching else "apart",
            message=message,
            **self._rows,
            touching=touching,
            skipped="still" if is_still else "",
            outline=self._outline(pose, scene.section),
            T_jaw_object=pose.T,
            probability=self._belief.probability,
            slip=self._slips.slip,
        )

    def _find_rows(self, patch: ContactPatch) -> dict[str, NDArray]:
        """Return points on the undeformed inner surface, candidates and weights of a contact patch."""
        points = np.zeros((len(patch.heights), 3))
        points[:, 0], points[:, 2] = self.jaw.face.read(patch.heights), patch.heights
        candidates = np.abs(self.jaw.candidates[:, 2] - patch.heights[:, None]).argmin(axis=1)
        return {"points": points, "candidates": candidates, "weights": patch.weights}

    def _follow_face(self, scene: ContactScene, touching: bool) -> None:
        """Keep the face where the object touches, for the slip of the next pose."""
        if not touching or self._located is None:
            self._face = None
            self._slips.release()
            return
        height = self._slips.follow(self._located.patch.mean)
        self._face = face_at(scene.line, self.face.heights, height)

    def _outline(self, pose: FilteredPose, section: ObjectSection) -> ObjectOutline | None:
        """Return the outline for the solver, with the errors of the pose that no average removes."""
        if self.settings.mode != "estimate":
            return None
        bias = np.array([self.settings.pose_bias, self.settings.pose_bias, self.settings.rotation_bias])
        stddev = np.hypot(pose.stddev[[0, 2, 4]], bias)
        middle, spread = section.across
        across = np.array([middle, float(np.sqrt(spread**2 + pose.stddev[1] ** 2 + self.settings.pose_bias**2))])
        return ObjectOutline(
            polygons=section.polygons, origin=section.origin, tilt=section.tilt, stddev=stddev, across=across
        )

    def _give_up(self, stamp: float, status: str, message: str, reason: str = "") -> ContactEstimate:
        """Return an estimate without rows; nothing of the last contact is kept."""
        self.counts[reason or status] += 1
        self._belief.reset()
        self._stillness.update(stamp, None)
        if self._localizer is not None:
            self._localizer.reset()
        self._solved = self._located = self._face = None
        self._slips.release()
        return ContactEstimate(stamp=stamp, status=status, message=message)
