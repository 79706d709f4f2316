"""The contact of an object with one jaw, image by image: poses in; outline, first touch and slip out."""

from collections import Counter
from dataclasses import dataclass
from math import inf, isfinite

import numpy as np
from numpy.typing import NDArray

from finforce.errors import ObservationError, PoseError
from finforce.transforms import check_pose, invert_pose
from finforce_contact.location import ClosestLocalizer, ContactLocation, Localizer, OutlineLocalizer, build_inner_face
from finforce_contact.mesh.object_mesh import ObjectMesh, surrounds
from finforce_contact.paper_contact import IntersectionLocalizer
from finforce_contact.parameters import ContactSettings
from finforce_contact.pose.filter import FilteredPose, PoseFilter
from finforce_contact.pose.symmetry import parse_symmetry, read_symmetry
from finforce_contact.section import ObjectSection, SectionKeeper, count_inside
from finforce_contact.slip import Slip, SlipWatch, TouchedFace, face_at
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.observation import Contact, ObjectOutline


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactEstimate:
    """The contact of an object with a jaw in one image.

    Attributes:
        stamp: of the image [s].
        status: "touching", "apart", "no_object", "no_pose" or "contradicted".
        message: note for the user, or empty.
        contact: where the object touches or would touch first, as one point, with its outline in mode "estimate";
            whether it touches is what pose and mesh say. Without points when there is no object; None when nobody
            knows.
        T_jaw_object: (4, 4), None when not known.
        slip: of the object over the jaw, None when it is not known.
    """

    stamp: float
    status: str
    message: str
    contact: Contact | None = None
    T_jaw_object: NDArray | None = None
    slip: Slip | None = None

    @property
    def touching(self) -> bool:
        """True if the meshes of object and jaw intersect."""
        return self.contact is not None and bool(self.contact.touching)


_JAW_SAMPLES = 300  # vertices compared
_BACK = 1.0 / 3.0  # [-], fraction of the vertices farthest behind the face, which no pressed object reaches
_SURROUNDED = 0.5  # share of these that lies within an object around the jaw
_OUT_OF_REACH = 1.0  # [m], distance of the origin of an object
_CERTAIN = 3.0  # sigma of the gap between jaw and object
_HELD = 10.0  # factor on the age of the pose of a held object, which the jaws hide and keep where it is
CONTRADICTED = "contradicted"  # status of an image whose object is not where mesh and pose say
_REASONS = ("solved", "no_object", "no_pose", CONTRADICTED, "surrounded", "out_of_reach", "late pose", "odd pose")


class ContactEstimator:
    """Estimates where an object touches one jaw, from its mesh and pose; deterministic, one thread.

    Attributes:
        jaw: with the calibration applied that the solver has.
        settings: of this estimator.
        face: the inner surface of the jaw's mesh.
        counts: images and poses by what was done with them, or why nothing was.
        contradiction: why the mesh cannot be where its poses say, as a `MeshCheck` found; "" for nothing.
    """

    def __init__(self, jaw: Jaw, *, mesh: ObjectMesh | None = None, settings: ContactSettings | None = None) -> None:
        """Prepare the jaw's inner face.

        Raises:
            FinforceError: The jaw has no mesh of that density, or symmetry or object do not do.
        """
        self.jaw, self.settings = jaw, settings or ContactSettings()
        parse_symmetry(self.settings.symmetry)
        self.face = build_inner_face(jaw, self.settings.mesh)
        self._back = _sample_back(jaw, self.face.mesh.nodes)
        self._poses, self._slips = PoseFilter(self.settings), SlipWatch(self.settings)
        self.set_object(mesh)

    @property
    def needs_surface(self) -> bool:
        """True if the deformed surface of the jaw is looked at."""
        return self._localizer is not None and self._localizer.needs_surface

    @property
    def mesh(self) -> ObjectMesh | None:
        """Of the object; None while it is unknown."""
        return self._mesh

    def set_object(self, mesh: ObjectMesh | None) -> None:
        """Take another object, or none; its pose is not known yet.

        Raises:
            ObjectMeshError: The mode needs a watertight mesh, and this one is not.
            MissingDependencyError: The mode needs a library that is not installed.
        """
        self._mesh: ObjectMesh | None = None
        self._poses.symmetry = read_symmetry(self.settings.symmetry, mesh) if mesh is not None else None
        self._localizer = self._build_localizer(mesh) if mesh is not None else None
        if mesh is not None:
            low, high = mesh.bounds
            self._centre, self._half = mesh.middle, 0.5 * (high - low)
            span = (float(self.face.heights[0]), float(self.face.heights[-1]))
            self._sections = SectionKeeper(mesh, self.face.half_width, span)
        self._mesh = mesh
        self.reset()

    def reset(self) -> None:
        """Forget poses, contact, counts and contradiction; jaw and object stay."""
        self.contradiction = ""
        self._poses.reset()
        if self._localizer is not None:
            self._localizer.reset()
        self.counts: Counter[str] = Counter(dict.fromkeys(_REASONS, 0))
        self._slips.reset()
        self._touched: TouchedFace | None = None
        self._held_since = inf

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
        outcome = self._poses.update(stamp, T, covariance, is_free=self._touched is None)
        if outcome in ("used", "rejected") and self._touched is not None:
            closing = self._poses.at(stamp).speed
            self._slips.update(stamp, self._poses.latest, self._touched, closing=closing, odd=outcome == "rejected")
        self.counts["late pose"] += outcome == "late"
        self.counts["odd pose"] += outcome == "rejected"

    def carry(self, T: NDArray) -> None:
        """Take the jaw's own motion since the last pose: T (4, 4) leads from its frame then to its frame now."""
        self._poses.carry(T)

    def update(self, stamp: float, surface: NDArray | None = None) -> ContactEstimate:
        """Return what the object shows in the image of a stamp [s].

        Args:
            stamp: image capture time [s].
            surface: (n, 3) [m] deformed vertices in mesh order, which mode "paper" alone looks at; None: the jaw is
                taken as undeformed.

        Raises:
            MeshError: The surface is not that of the jaw's mesh.
            ObservationError: The stamp is not finite.
        """
        if not isfinite(stamp):
            raise ObservationError(f"image: got stamp {stamp}, expected the capture time in seconds")
        if self._mesh is None:
            return self._give_up(stamp, "no_object", "no object mesh: load one, or give the contact's height")
        if self._poses.stamp is None:
            return self._give_up(stamp, "no_pose", f"no pose of {self._mesh.name} has come yet")
        if self.contradiction:
            return self._give_up(stamp, CONTRADICTED, self.contradiction)
        if message := self._find_stale_pose(stamp):
            return self._give_up(stamp, "no_pose", message)
        pose = self._poses.at(stamp, self._held_since)
        section = self._sections.at(pose.T, touching=self._touched is not None)
        if self._surrounds_jaw(pose.T, section):
            message = f"this pose puts {self._mesh.name} around the jaw: check its pose, mesh and unit"
            return self._give_up(stamp, "no_pose", message, "surrounded")
        location = self._localizer.locate(pose.T, section, surface)
        if location is None or np.abs(section.origin).max() > _OUT_OF_REACH:
            away = f"its origin lies {1e3 * np.linalg.norm(pose.T[:3, 3]):.0f} mm from the jaw's"
            message = (
                f"{self._mesh.name} does not stand before the inner surface: {away}; check its poses' unit and frame, "
                "and that they are T_camera_object, not its inverse"
            )
            return self._give_up(stamp, "apart", message, "out_of_reach")
        self.counts["solved"] += 1
        self._follow_face(stamp, location, pose)
        contact = Contact(
            points=np.array([[self.jaw.face.read(location.height), 0.0, location.height]]),
            weights=np.ones(1),
            touching=location.touching,
            outline=self._outline(pose, section) if self.settings.mode == "estimate" else None,
        )
        return ContactEstimate(
            stamp=stamp,
            status="touching" if location.touching else "apart",
            message="",
            contact=contact,
            T_jaw_object=pose.T,
            slip=self._slips.slip,
        )

    def _find_stale_pose(self, stamp: float) -> str:
        """Return why no pose tells of the image of a stamp [s]; empty if one does."""
        name, timeout, age = self._mesh.name, self.settings.pose_timeout, stamp - self._poses.believed
        if age < -timeout:
            return f"the last pose of {name} lies {-age:.1f} s ahead; reset after time has jumped back"
        if self._held_since < inf:
            timeout *= _HELD
        if age <= timeout:
            return ""
        if stamp - self._poses.stamp > timeout:
            return f"the last pose of {name} is {age:.1f} s old, expected one every second"
        return f"for {age:.1f} s no pose of {name} has followed from the one before; check their unit"

    def _surrounds_jaw(self, T: NDArray, section: ObjectSection) -> bool:
        """Return whether most of the jaw's back lies within the object."""
        inside = np.abs((self._back - T[:3, 3]) @ T[:3, :3] - self._centre) < self._half
        if inside.all(axis=1).mean() < _SURROUNDED:
            return False
        points = np.ascontiguousarray(self._back[:, ::2])
        return count_inside(points, section.edges) > _SURROUNDED * len(points)

    def _follow_face(self, stamp: float, location: ContactLocation, pose: FilteredPose) -> None:
        """Keep the face where the object touches in an image [s], for the slip of the next pose.

        The object is held once it may touch as far as poses err, until it has parted from the jaw for certain.
        """
        if location.touching:
            self._touched = face_at(self.face.line, self._slips.follow(location.height))
        else:
            self._let_go()
        if location.gap < _CERTAIN * self.settings.pose_bias:
            self._held_since = min(self._held_since, stamp)
        elif location.gap > _CERTAIN * pose.stddev[0]:
            self._held_since = inf

    def _let_go(self) -> None:
        """Forget the face that the object touched."""
        self._touched = None
        self._slips.release()

    def _outline(self, pose: FilteredPose, section: ObjectSection) -> ObjectOutline:
        """Return the outline for the solver, with the errors of the pose that no average removes."""
        shift = float(np.hypot(self.settings.pose_bias, self.mesh.unseen_stddev))
        bias = np.array([shift, shift, self.settings.rotation_bias])
        stddev = np.hypot(pose.stddev[[0, 2, 4]], bias)
        middle, spread = section.across
        across = np.array([middle, float(np.sqrt(spread**2 + pose.stddev[1] ** 2 + shift**2))])
        return ObjectOutline(
            polygons=section.polygons, origin=section.origin, tilt=section.tilt, stddev=stddev, across=across
        )

    def _give_up(self, stamp: float, status: str, message: str, reason: str = "") -> ContactEstimate:
        """Return an estimate without a contact; nothing of the last one is kept."""
        self.counts[reason or status] += 1
        if self._localizer is not None:
            self._localizer.reset()
        self._let_go()
        self._held_since = inf
        nothing = Contact(points=np.empty((0, 3)), weights=np.empty(0), touching=False)
        return ContactEstimate(
            stamp=stamp,
            status=status,
            message=message,
            contact=None if status in ("no_pose", CONTRADICTED) else nothing,
        )


def _sample_back(jaw: Jaw, nodes: NDArray) -> NDArray:
    """Return some of a jaw's vertices (n, 3) [m] far behind its inner face, which no pressed object reaches."""
    samples = nodes[np.unique(np.linspace(0, len(nodes) - 1, _JAW_SAMPLES).astype(int))]
    behind = jaw.face.read(samples[:, 2]) - samples[:, 0]
    return samples[behind >= np.quantile(behind, 1.0 - _BACK)]
